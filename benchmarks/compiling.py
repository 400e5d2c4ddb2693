"""Seconds to generate and to compile scenes on one core: `python benchmarks/compiling.py`."""

import statistics
import time

from _common import report

from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.worlds import WORLDS, generated

REPEATS = 7
LARGE = 1300  # standable cells, as many as a ProcTHOR house has in the median


def main() -> None:
    found = {}
    for name, world in WORLDS.items():
        scenes = generated(name, "train")
        began = time.perf_counter()
        made = [scenes[i] for i in range(len(scenes))]
        generating = time.perf_counter() - began
        began = time.perf_counter()
        tables = [compile_scene(scene, world.task) for scene in made]
        compiling = time.perf_counter() - began
        found[name] = {
            "scenes": len(made),
            "generate_s": round(generating, 2),
            "compile_s": round(compiling, 2),
            "cells": sum(len(table.ahead) for table in tables),
        }
    houses, task = generated("houses", "train", 500), WORLDS["houses"].task
    large = next(house for house in (houses[i] for i in range(500)) if house.reach.sum() >= LARGE)
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        cells = len(compile_scene(large, task).ahead)
        seconds.append(time.perf_counter() - began)
    found["large_house"] = {
        "name": large.name,
        "cells": cells,
        "compile_s": {
            "median": round(statistics.median(seconds), 3),
            "min": round(min(seconds), 3),
            "max": round(max(seconds), 3),
        },
    }
    report(found)


if __name__ == "__main__":
    main()
