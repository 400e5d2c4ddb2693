"""An offline Scene_Data folder of a 3 x 3 room."""

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: Step (dx, dz) of a move ahead by rotation in degrees.
HEADINGS = {0: (0, 1), 45: (1, 1), 90: (1, 0), 135: (1, -1), 180: (0, -1), 225: (-1, -1), 270: (-1, 0), 315: (-1, 1)}

HORIZONS = (0, 30)

# Cells (ix, iz): x is 0 to 0.5 and z is -0.25 to 0.25 in steps of 0.25. The agent is at 0.9 m, so the floor is at 0.
CELLS = list(itertools.product(range(3), (-1, 0, 1)))
GRID = [{"x": 0.25 * ix, "y": 0.9, "z": 0.25 * iz} for ix, iz in CELLS]


def state(ix: int, iz: int, rotation: int, horizon: int) -> str:
    """Return the key of a state.

    Zero is written as -0.00, as some files do.
    """
    return f"{0.25 * ix or -0.0:.2f}|{0.25 * iz or -0.0:.2f}|{rotation}|{horizon}"


def links() -> list[dict[str, str]]:
    """Return a link from every state to each state that one action leads to."""
    link_records = []
    for (ix, iz), rotation, horizon in itertools.product(CELLS, HEADINGS, HORIZONS):
        source = state(ix, iz, rotation, horizon)

        # Turns to the right and to the left, a tilt of the camera, and a move ahead.
        targets = [
            state(ix, iz, (rotation + 45) % 360, horizon),
            state(ix, iz, (rotation - 45) % 360, horizon),
            state(ix, iz, rotation, 30 - horizon),
        ]
        dx, dz = HEADINGS[rotation]
        if (ix + dx, iz + dz) in CELLS:
            targets.append(state(ix + dx, iz + dz, rotation, horizon))
        for target in targets:
            link_records.append({"source": source, "target": target})
    return link_records


NODES = [
    {"id": state(ix, iz, rotation, horizon)}
    for (ix, iz), rotation, horizon in itertools.product(CELLS, HEADINGS, HORIZONS)
]
GRAPH = {"directed": True, "multigraph": False, "graph": {}, "nodes": NODES, "links": links()}
VISIBLE = {
    "Fridge|+01.00|+00.00|-00.25": [state(2, 0, 90, 0), state(2, 0, 90, 30)],
    "Apple|+00.50|+01.02|00.00": [],
    "Sink|-01.00|+00.90|+00.25": [state(0, 0, 270, 0)],
    "Sink|-01.00|+00.90|+00.25|SinkBasin": [state(0, 0, 270, 30)],
    "Floor|+00.00|+00.00|+00.00": [state(0, 0, 270, 30)],
}
FILES: dict[str, Any] = {"grid.json": GRID, "graph.json": GRAPH, "visible_object_map_1.5.json": VISIBLE}


def write_folder(folder: Path, files: Mapping[str, object]) -> Path:
    """Write the files of a scene.

    A string is written unchanged and any other value as JSON; None removes a file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in files.items():
        (folder / name).unlink(missing_ok=True)
        if value is not None:
            (folder / name).write_text(value if isinstance(value, str) else json.dumps(value))
    return folder
