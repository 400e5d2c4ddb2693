"""An offline Scene_Data folder of a 3 x 3 room."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

HEADINGS = {0: (0, 1), 45: (1, 1), 90: (1, 0), 135: (1, -1), 180: (0, -1), 225: (-1, -1), 270: (-1, 0), 315: (-1, 1)}

# x 0 to 0.5 and z -0.25 to 0.25 in steps of 0.25; the agent is at 0.9 m, so the floor is at 0.
PLACES = [(i, j) for i in range(3) for j in (-1, 0, 1)]
GRID = [{"x": 0.25 * i, "y": 0.9, "z": 0.25 * j} for i, j in PLACES]


def state(i: int, j: int, rotation: int, horizon: int) -> str:
    """Return the key of a state.

    Zero is written as -0.00, as some files do.
    """
    return f"{0.25 * i or -0.0:.2f}|{0.25 * j or -0.0:.2f}|{rotation}|{horizon}"


def links() -> list[dict[str, str]]:
    """Return what one action leads to, by the action rules."""
    pairs = []
    for i, j in PLACES:
        for rotation, (dx, dz) in HEADINGS.items():
            for horizon in (0, 30):
                reached = [
                    (i, j, (rotation + 45) % 360, horizon),
                    (i, j, (rotation - 45) % 360, horizon),
                    (i, j, rotation, 30 - horizon),
                    *([(i + dx, j + dz, rotation, horizon)] if (i + dx, j + dz) in PLACES else []),
                ]
                pairs += [(state(i, j, rotation, horizon), state(*target)) for target in reached]
    return [{"source": source, "target": target} for source, target in pairs]


NODES = [{"id": state(i, j, rotation, horizon)} for i, j in PLACES for rotation in HEADINGS for horizon in (0, 30)]
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

    A text is written as it is, any other value as JSON; None removes a file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in files.items():
        (folder / name).unlink(missing_ok=True)
        if value is not None:
            (folder / name).write_text(value if isinstance(value, str) else json.dumps(value))
    return folder
