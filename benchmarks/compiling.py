"""Seconds to generate and to compile scenes on one core.

Run with `python benchmarks/compiling.py`.
"""

import time

from _common import report, seconds, spread

from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.worlds import WORLDS, generated

REPEATS = 7
LARGE = 1300  # standable cells, as many as a ProcTHOR house has in the median


def main() -> None:
    results = {}
    for name, world in WORLDS.items():
        split = generated(name, "train")
        began = time.perf_counter()
        scenes = [split[i] for i in range(len(split))]
        generating = time.perf_counter() - began
        began = time.perf_counter()
        tables = [compile_scene(scene, world.task) for scene in scenes]
        compiling = time.perf_counter() - began
        results[name] = {
            "scenes": len(scenes),
            "generate_s": round(generating, 2),
            "compile_s": round(compiling, 2),
            "cells": sum(len(table.ahead) for table in tables),
        }
    houses, task = generated("houses", "train", 500), WORLDS["houses"].task
    large = next(house for house in (houses[i] for i in range(500)) if house.reach.sum() >= LARGE)
    results["large_house"] = {
        "name": large.name,
        "cells": len(compile_scene(large, task).ahead),
        "compile_s": spread([seconds(lambda: compile_scene(large, task)) for _ in range(REPEATS)]),
    }
    report(results)


if __name__ == "__main__":
    main()
