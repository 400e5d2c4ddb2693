"""The epsilon x seed grid in one call against a call per cell: `python benchmarks/sweep.py`.

11 thresholds times 8 seeds of sTDE with best actions on fixed val episodes. The cells one by one, each by an evaluator
that was compiled once for a single cell, are the time of the grid's steps; with a compilation for every cell, as where
epsilon is a setting of the program, they are extrapolated from two. The seeds are trained for a few updates, so that
episodes are of all lengths.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from _common import in_turns, ratios, report, seconds, spread
from rich.console import Console

from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.grid import Evaluator
from jaxnav.evaluation.inference import Inference
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.layout import SETTINGS
from jaxnav.policies.acting import Acting
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import evaluation_world, training_world
from jaxnav.training.calibration import layout_priors
from jaxnav.training.exploration import explore
from jaxnav.training.trainer import Arms

ARM, EPSILONS, SEEDS, EPISODES = "layout", [round(0.1 * i, 1) for i in range(11)], 8, 128
UPDATES, TURNS, COMPILED = 12, 3, 2
GOALS = {"compilations": 1, "grid_over_cells": 1.2}


def main() -> None:
    console = Console(stderr=True)
    config = dataclasses.replace(RunConfig(), arms=(ARM,), seeds=SEEDS, chunk=UPDATES)
    setting = SETTINGS[config.layout.setting]
    training = training_world(config, console)
    counts = jax.jit(explore, static_argnums=0)(training.env, training.params(0), jax.random.key(0)).counts
    priors = layout_priors(counts, setting)
    arms = Arms(config, training.env, setting, priors)
    states, _ = arms.train(arms.init(training.params(0)), training.params(0))
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(state.params for state in states[ARM]))

    world = evaluation_world(config, "val", None, None, console)
    episodes = [(episode_list(world.banks[0], EPISODES, 0), world.params(0))]
    grid = inference_grid([table_row("stde", epsilon, "residual", "argmax") for epsilon in EPSILONS], SEEDS)
    grid = grid.replace(params=grid.params - SEEDS)  # of the layout's seeds alone
    cells = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], grid) for i in range(len(grid.params))]

    def evaluator() -> Evaluator:
        return Evaluator(Acting(world.env, setting), arms.learners[ARM].spec)

    def run(evaluator: Evaluator, cells: Inference):
        return evaluator(cells, weights, episodes, priors, jax.random.key(0))

    whole, single = evaluator(), evaluator()
    compiling = seconds(lambda: run(whole, grid))
    console.print(f"grid compiled and run in {compiling:.1f} s")
    found = {}

    def together() -> None:
        found["grid"] = run(whole, grid)

    def apart() -> None:
        found["cells"] = [run(single, cell) for cell in cells]

    taken = in_turns({"grid": together, "cells": apart}, TURNS)
    outcome = found["grid"]
    equal = [np.array_equal(leaf, np.concatenate(own)) for leaf, *own in zip(outcome, *found["cells"], strict=True)]
    anew = [seconds(lambda cell=cell: run(evaluator(), cell)) for cell in cells[:COMPILED]]
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
