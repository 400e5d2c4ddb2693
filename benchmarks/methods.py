"""Training speed and size of each method.

`python benchmarks/methods.py [METHOD ...]` times one update of every stage of the methods (all that PPO trains unless
some are named) in turns with ORG's: environment steps per second, learning included, on the default networks, rooms and
arm `baseline`. The report adds the numbers of parameters of the policy and of its method alone, and the lines of the
files that define its experience, tracker, knowledge, adaptation and control.
"""

import dataclasses
import inspect
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _common import print_report, ratio_by_turn, steps_per_second, time_in_turns
from _setup import compile_program, set_up_training

from jaxnav.policies.method import ActionControl
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.runs.config import RunConfig, WorldConfig

TURNS = 5
REFERENCE = "org"


def main(names: list[str]) -> None:
    # Compile one update of every stage; the last stage goes by the method's name.
    calls = {}
    sizes = {}
    trained_methods = [name for name, method in METHODS.items() if method.fit is None]
    for name in dict.fromkeys([REFERENCE, *(names or trained_methods)]):
        config = RunConfig(method=name, arms=("baseline",), seeds=1, worlds=WorldConfig(num_train=16))
        setup = set_up_training(config, explore=False)
        learner = setup.trainer.learners["baseline"]
        arguments = setup.update_arguments("baseline")
        sizes[name] = measure_size(name, arguments[0].params)
        for number, stage in enumerate(config.stages, start=1):
            program = compile_program(dataclasses.replace(learner, stage=stage).update, *arguments)
            is_last = number == len(config.stages)
            calls[name if is_last else f"{name}, stage {number}"] = program.call

    times = time_in_turns(calls, TURNS)
    num_steps = RunConfig().steps_per_update
    rows = {}
    for name, call_times in times.items():
        rows[name] = {
            "steps_per_s": steps_per_second(call_times, num_steps),
            "over_org": ratio_by_turn(times[REFERENCE], call_times),
            **sizes.get(name, {}),
        }
    print_report({"update_steps": num_steps, "methods": rows})


def measure_size(name: str, params: dict[str, Any]) -> dict[str, int]:
    """Return the numbers of parameters and lines of a method."""
    counts = {}
    for part, tree in params.items():
        counts[part] = sum(np.size(leaf) for leaf in jax.tree.leaves(tree))
    return {"parameters": sum(counts.values()), "of_the_method": counts.get("method", 0), "lines": count_lines(name)}


def count_lines(name: str) -> int:
    """Return the number of lines of the files that define a method's own parts."""
    method = find_method(name)
    parts = [method.experience, method.learn, type(method.tracker), type(method.adaptation), type(method.control)]
    files = {inspect.getfile(part) for part in parts if part not in (None, type(None), ActionControl)}
    return sum(Path(file).read_text(encoding="utf-8").count("\n") for file in files)


if __name__ == "__main__":
    main(sys.argv[1:])
