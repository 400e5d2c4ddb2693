"""The epsilon x seed grid against a call per cell.

`python benchmarks/sweep.py` evaluates 11 thresholds times 8 seeds of sTDE with best actions on fixed val episodes. The
cells one by one, each by an evaluator that was compiled once for a single cell, give the time of the grid's steps. With
a compilation for every cell, as if epsilon were a setting of the program, the time is extrapolated from two cells. The
seeds are trained for a few updates, so that episodes are of all lengths.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report, ratio_by_turn, summarize, time_call, time_in_turns
from _setup import set_up_training

from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator
from jaxnav.evaluation.removal import InferenceConfig
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.runs.config import RunConfig
from jaxnav.runs.worlds import compile_evaluation_world

ARM = "layout"
EPSILONS = [round(0.1 * tenths, 1) for tenths in range(11)]
NUM_SEEDS = 8
NUM_EPISODES = 128
NUM_UPDATES = 12
TURNS = 3
#: Cells that are evaluated with a compilation each.
NUM_COMPILED_CELLS = 2


def main() -> None:
    console = PlainConsole(stderr=True)

    # Train the seeds for one chunk.
    config = dataclasses.replace(RunConfig(), arms=(ARM,), seeds=NUM_SEEDS, chunk=NUM_UPDATES)
    setup = set_up_training(config)
    states, _ = setup.trainer.train(setup.trainer.init(setup.params), setup.params)
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(state.params for state in states[ARM]))

    # The grid has a cell for every threshold and seed.
    compiled_world = compile_evaluation_world(config, "val", None, None, console)
    episodes = [(draw_episodes(compiled_world.banks[0], NUM_EPISODES, 0), compiled_world.make_env_params(0))]
    rows = [table_row("stde", epsilon, "residual", "argmax") for epsilon in EPSILONS]
    grid = inference_grid(rows, config.arms, NUM_SEEDS)
    cells = [take_cell(grid, index) for index in range(len(grid.policy_index))]
    agent_loop = AgentLoop(
        compiled_world.env, config.policy_spec(len(compiled_world.env.categories)), setup.estimator_config
    )

    def evaluate(evaluator: Evaluator, grid: InferenceConfig) -> EpisodeOutcome:
        return evaluator(grid, weights, episodes, setup.knowledge, jax.random.key(0))

    grid_evaluator = Evaluator(agent_loop)
    cell_evaluator = Evaluator(agent_loop)
    first_grid_s = time_call(lambda: evaluate(grid_evaluator, grid))
    console.print(f"grid compiled and run in {first_grid_s:.1f} s")

    # Time the grid and its cells in turns, and compare the outcomes of the last turn.
    outcomes: dict[str, list[EpisodeOutcome]] = {}

    def evaluate_grid() -> None:
        outcomes["grid"] = [evaluate(grid_evaluator, grid)]

    def evaluate_cells() -> None:
        outcomes["cells"] = [evaluate(cell_evaluator, cell) for cell in cells]

    times = time_in_turns({"grid": evaluate_grid, "cells": evaluate_cells}, TURNS)
    (grid_outcome,) = outcomes["grid"]
    cell_outcome = [np.concatenate(leaves) for leaves in zip(*outcomes["cells"], strict=True)]
    is_equal = [np.array_equal(leaf, cell_leaf) for leaf, cell_leaf in zip(grid_outcome, cell_outcome, strict=True)]

    # Evaluate some cells with a compilation each.
    compiled_times = []
    for cell in cells[:NUM_COMPILED_CELLS]:
        compiled_times.append(time_call(partial(evaluate, Evaluator(agent_loop), cell)))
    print_report(
        {
            "epsilons": len(EPSILONS),
            "seeds": NUM_SEEDS,
            "episodes": len(episodes[0][0].goal),
            "mean_success": round(float(grid_outcome.success.mean()), 3),
            "mean_steps": round(float(grid_outcome.length.mean()), 1),
            "compilations": grid_evaluator.compilations,
            "grid_s": summarize(times["grid"]),
            "first_grid_with_compilation_s": round(first_grid_s, 2),
            "cells_one_by_one_s": summarize(times["cells"]),
            "grid_over_cells": ratio_by_turn(times["grid"], times["cells"]),
            "cells_each_compiled_s_extrapolated": round(len(cells) * sum(compiled_times) / NUM_COMPILED_CELLS, 1),
            "equal_outcomes": all(is_equal),
        }
    )


def take_cell(grid: InferenceConfig, index: int) -> InferenceConfig:
    """Return a grid of one cell."""
    return jax.tree.map(lambda leaf: leaf[index : index + 1], grid)


if __name__ == "__main__":
    main()
