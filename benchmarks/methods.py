"""What each method costs.

`python benchmarks/methods.py [METHOD ...]` times one update of every stage of the methods (all of this package's unless
some are named) in turns with ORG's: environment steps per second, learning included, on the default networks, rooms and
arm `baseline`. Beside them stand parameters of the policy and of its method alone, and lines: of the files that hold
its experience, tracker, knowledge, adaptation and control, without what these use.
"""

import dataclasses
import inspect
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _common import in_turns, rates, ratios, report
from _phases import program
from _setup import set_up

from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.methods.base import Primitive
from jaxnav.runs.config import RunConfig, WorldConfig

TURNS, REFERENCE = 5, "org"


def main(names: list[str]) -> None:
    calls, about, steps = {}, {}, RunConfig().update_steps
    for name in dict.fromkeys([REFERENCE, *(names or METHODS)]):
        config = RunConfig(method=name, arms=("baseline",), seeds=1, worlds=WorldConfig(num_train=16))
        setup = set_up(config, explore=False)
        learner, arguments = setup.trainer.learners["baseline"], setup.arguments("baseline")
        about[name] = size(name, arguments[0].params)
        for stage, kind in enumerate(config.stages):
            call = program(dataclasses.replace(learner, stage=kind).update, *arguments).call
            calls[name if stage == len(config.stages) - 1 else f"{name}, stage {stage + 1}"] = call
    taken = in_turns(calls, TURNS)
    rows = {
        name: {"steps_per_s": rates(seconds, steps), "over_org": ratios(taken[REFERENCE], seconds)}
        | about.get(name, {})
        for name, seconds in taken.items()
    }
    report({"update_steps": steps, "methods": rows})


def size(name: str, params: dict[str, Any]) -> dict[str, int]:
    """Return parameters and lines of a method."""
    counts = {part: sum(np.size(leaf) for leaf in jax.tree.leaves(tree)) for part, tree in params.items()}
    return {"parameters": sum(counts.values()), "of_the_method": counts.get("method", 0), "lines": lines(name)}


def lines(name: str) -> int:
    """Return the lines of the files that are a method's own."""
    method = find_method(name)
    parts = [method.experience, method.learn, *map(type, (method.tracker, method.adaptation, method.control))]
    files = {inspect.getfile(part) for part in parts if part not in (None, type(None), Primitive)}
    return sum(Path(file).read_text(encoding="utf-8").count("\n") for file in files)


if __name__ == "__main__":
    main(sys.argv[1:])
