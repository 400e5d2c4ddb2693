"""The epsilon x seed grid against a call per cell.

`python benchmarks/sweep.py` evaluates 11 thresholds times 8 seeds of sTDE with best actions on fixed val episodes. The
cells one by one, each by an evaluator that was compiled once for a single cell, are the time of the grid's steps; with
a compilation for every cell, as where epsilon is a setting of the program, they are extrapolated from two. The seeds
are trained for a few updates, so that episodes are of all lengths.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from _common import in_turns, ratios, report, seconds, spread
from _setup import set_up
from rich.console import Console

from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.grid import Evaluator, Outcome
from jaxnav.evaluation.inference import Inference
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.acting import Acting
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import evaluation_world

ARM, EPSILONS, SEEDS, EPISODES = "layout", [round(0.1 * i, 1) for i in range(11)], 8, 128
UPDATES, TURNS, COMPILED = 12, 3, 2
GOALS = {"compilations": 1, "grid_over_cells": 1.2}


def main() -> None:
    console = Console(stderr=True)
    config = dataclasses.replace(RunConfig(), arms=(ARM,), seeds=SEEDS, chunk=UPDATES)
    setup = set_up(config)
    states, _ = setup.trainer.train(setup.trainer.init(setup.params), setup.params)
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(state.params for state in states[ARM]))

    world = evaluation_world(config, "val", None, None, console)
    episodes = [(episode_list(world.banks[0], EPISODES, 0), world.params(0))]
    rows = [table_row("stde", epsilon, "residual", "argmax") for epsilon in EPSILONS]
    grid = inference_grid(rows, config.arms, SEEDS)
    cells = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], grid) for i in range(len(grid.params))]
    acting = Acting(world.env, config.policy_spec(len(world.env.categories)), setup.setting)

    def run(evaluator: Evaluator, cells: Inference) -> Outcome:
        return evaluator(cells, weights, episodes, setup.knowledge, jax.random.key(0))

    whole, single = Evaluator(acting), Evaluator(acting)
    compiling = seconds(lambda: run(whole, grid))
    console.print(f"grid compiled and run in {compiling:.1f} s")
    outcomes: dict[str, list[Outcome]] = {}

    def together() -> None:
        outcomes["grid"] = [run(whole, grid)]

    def apart() -> None:
        outcomes["cells"] = [run(single, cell) for cell in cells]

    taken = in_turns({"grid": together, "cells": apart}, TURNS)
    (outcome,) = outcomes["grid"]
    joined = (np.concatenate(leaves) for leaves in zip(*outcomes["cells"], strict=True))
    equal = [np.array_equal(leaf, other) for leaf, other in zip(outcome, joined, strict=True)]
    anew = [seconds(lambda cell=cell: run(Evaluator(acting), cell)) for cell in cells[:COMPILED]]
    report(
        {
            "epsilons": len(EPSILONS),
            "seeds": SEEDS,
            "episodes": len(episodes[0][0].goal),
            "mean_success": round(float(outcome.success.mean()), 3),
            "mean_steps": round(float(outcome.length.mean()), 1),
            "goals": GOALS,
            "compilations": whole.compilations,
            "grid_s": spread(taken["grid"]),
            "first_grid_with_compilation_s": round(compiling, 2),
            "cells_one_by_one_s": spread(taken["cells"]),
            "grid_over_cells": ratios(taken["grid"], taken["cells"]),
            "cells_each_compiled_s_extrapolated": round(len(cells) * sum(anew) / COMPILED, 1),
            "equal_outcomes": all(equal),
        }
    )


if __name__ == "__main__":
    main()
