"""Habitat ObjectNav episodes in a house of two floors."""

import gzip
import json
from pathlib import Path
from typing import Any


def write_json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(json.dumps(content).encode(), mtime=0))
    return path


def episode(x: float, y: float, z: float, **more: object) -> dict[str, Any]:
    return {"episode_id": "0", "scene_id": "gibson/Home.glb", "start_position": [x, y, z], "goals": []} | more


def goal(category: str, identity: int | str, position: list[float], points: list[list[float]]) -> dict[str, Any]:
    views = [{"agent_state": {"position": point, "rotation": [0, 0, 0, 1]}, "iou": 0.2} for point in points]
    return {"object_id": identity, "object_category": category, "position": position, "view_points": views}


#: Starts all over both floors of `l_shaped_floor` and `bedroom` where x is at most 3.4 m.
STARTS = [episode(2.05 + 0.25 * i, y, -0.95 + 0.25 * j) for y in (0.02, 2.88) for i in range(6) for j in range(12)]

#: A ground floor with a row of starts from x = 0 to 2 m (z = -1), an L of view points at its end, and a bed upstairs.
EPISODES: dict[str, Any] = {
    "episodes": [
        *[episode(0.25 * i + 0.03, 0.1, -1.02) for i in range(9)],
        *[episode(0.25 * i, 3.1, 0.0) for i in range(8)],
        episode(1.0, 1.6, 0.0),  # on the stairs
    ],
    "goals_by_category": {
        "Home.glb_chair": [goal("chair", 7, [2.5, 0.6, -1.5], [[2.0, 0.1, -1.25], [2.0, 0.1, -1.5]])],
        "Home.glb_bed": [goal("bed", "bed_3", [1.0, 3.5, 1.0], [[1.0, 3.1, 0.25]])] * 2,
        "Other.glb_sofa": [goal("sofa", 1, [0.0, 0.0, 0.0], [])],
    },
}
EPISODES["episodes"] += EPISODES["episodes"][:9]  # 27 starts: the one on the stairs is less than a twentieth
