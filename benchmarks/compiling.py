"""Seconds to generate and to compile scenes on one core.

Run with `python benchmarks/compiling.py`.
"""

import time

from _common import print_report, summarize, time_call

from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

REPEATS = 7
#: Standable cells of a large scene, as many as the median ProcTHOR house has.
MIN_LARGE_CELLS = 1300


def main() -> None:
    results = {}
    for name, world in WORLDS.items():
        # Indexing a split generates a scene.
        split = make_generated_scenes(name, "train")
        start_time = time.perf_counter()
        scenes = [split[index] for index in range(len(split))]
        generate_s = time.perf_counter() - start_time

        start_time = time.perf_counter()
        tables = [compile_scene(scene, world.task) for scene in scenes]
        compile_s = time.perf_counter() - start_time
        results[name] = {
            "scenes": len(scenes),
            "generate_s": round(generate_s, 2),
            "compile_s": round(compile_s, 2),
            "cells": sum(len(table.ahead) for table in tables),
        }

    # One large house, compiled several times.
    house = find_large_house()
    task = WORLDS["houses"].task
    results["large_house"] = {
        "name": house.name,
        "cells": len(compile_scene(house, task).ahead),
        "compile_s": summarize([time_call(lambda: compile_scene(house, task)) for _ in range(REPEATS)]),
    }
    print_report(results)


def find_large_house() -> Scene:
    """Return the first generated house with at least `MIN_LARGE_CELLS` standable cells."""
    num_houses = 500
    houses = make_generated_scenes("houses", "train", num_houses)
    for index in range(num_houses):
        if houses[index].reach.sum() >= MIN_LARGE_CELLS:
            return houses[index]
    raise ValueError(f"none of {num_houses} houses has {MIN_LARGE_CELLS} cells")


if __name__ == "__main__":
    main()
