"""How well predictors of the search by belief know where goals are, and how long they take.

`python benchmarks/predictors.py RUN [--predictors LogLinear ...] [--penalty 0.0001]` fits predictors to the same
searches in the training homes of a run of the method `belief`, and measures them on searches in its `val` homes: the
packaged predictors `Dirichlet` and `LogLinear`, and `Convolution`, a small network over the same map, defined here.

*Bits* is the information about a goal's squares beyond that of a flat belief that changes only by looks in vain: the
mean over the unseen goals of each search, then over the searches that have any. *Places bits* is that of places alone,
fitted in the same run, and *train bits* is the predictor's own in the training homes. Intervals are over searches,
which share homes, so they are too narrow. *Microseconds* is the time of one belief on one map, in batches of 16, timed
in turns.
"""

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report, summarize, time_in_turns
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import mean_interval, scene_clusters
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import belief_fit
from jaxnav.policies.methods.belief import Dirichlet, LogLinear, Predictor, TargetPolicy, make_belief_method
from jaxnav.policies.methods.belief_fit import (
    Snapshots,
    detection_rates,
    explore_homes,
    fit_weights,
    goal_losses,
    locate_objects,
)
from jaxnav.policies.methods.belief_map import MapSquares
from jaxnav.policies.methods.map_tracker import SQUARE_CELLS
from jaxnav.policies.network import Params, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.run import Run
from jaxnav.runs.worlds import compile_evaluation_world

#: Maps in a batch, as in `map_selected_rows`.
BATCH = 16
TURNS = 9


class Convolution(Predictor):
    """Small convolutional network over categories and floor, with an output for each goal.

    Attributes:
      embedding: float32 [C, K + 3], embedding of a square's categories and floor.
      kernels: float32 [L, C, C, 3, 3], layers with the dilations of `DILATIONS`, which together see 4.5 m.
      output: float32 [K, C], weights of each goal; initially 0.
    """

    CHANNELS = 12
    DILATIONS = (1, 2, 3, 3)

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        num_inputs = spec.num_categories + 3
        embedding = jax.random.normal(rngs.params(), (self.CHANNELS, num_inputs))
        kernels = jax.random.normal(rngs.params(), (len(self.DILATIONS), self.CHANNELS, self.CHANNELS, 3, 3))
        self.embedding = nnx.Param(embedding)
        self.kernels = nnx.Param(kernels / np.sqrt(9 * self.CHANNELS))
        self.output = nnx.Param(jnp.zeros((spec.num_categories, self.CHANNELS)))

    def score_squares(self, squares: MapSquares, goal: jax.Array, weights: jax.Array) -> jax.Array:
        # Flags of the categories in each square, [K, n, n], beside the floor, [3, n, n].
        num_categories = self.output.shape[0]
        shifts = np.arange(num_categories, dtype=np.uint32)[:, None, None]
        flags = ((squares.categories[None] >> shifts) & np.uint32(1)).astype(jnp.float32)
        hidden = jnp.tensordot(self.embedding[...], jnp.concatenate([flags, squares.floor]), 1)

        # Residual layers on a map that wraps around.
        for layer, dilation in enumerate(self.DILATIONS):
            padded = jnp.pad(nnx.relu(hidden), ((0, 0), (dilation, dilation), (dilation, dilation)), mode="wrap")
            hidden += jax.lax.conv_general_dilated(
                padded[None], self.kernels[...][layer], (1, 1), "VALID", rhs_dilation=(dilation, dilation)
            )[0]
        return jnp.tensordot(self.output[...][goal], nnx.relu(hidden), 1)


PREDICTORS: dict[str, type[Predictor]] = {
    "Dirichlet": Dirichlet,
    "LogLinear": LogLinear,
    "Convolution": Convolution,
}


def main(run_dir: str, predictor_names: Sequence[str], penalty: float, num_searches: int, num_steps: int) -> None:
    belief_fit.WEIGHT_PENALTY = penalty

    # Searches with a flat belief in training homes and in `val` homes, the same for all predictors.
    run = Run.open(run_dir)
    policies = run.policies(("layout",))
    key = jax.random.key(run.config.seed)
    console = PlainConsole(stderr=True)
    snapshots = {}
    look_counts = {}
    agent_loops = {}
    for index, split in enumerate(("train", "val")):
        compiled_world = compile_evaluation_world(run.config, split, None, 0.0, console)
        agent_loops[split] = policies.make_agent_loop(compiled_world)
        explore = jax.jit(explore_homes, static_argnums=(0, 6, 7))
        snapshots[split], look_counts[split] = explore(
            agent_loops[split],
            init_params(policies.spec, key),
            locate_objects(compiled_world.banks[0]),
            compiled_world.make_env_params(0),
            policies.knowledge,
            jax.random.fold_in(key, index),
            num_searches,
            num_steps,
        )
    agent_loop = agent_loops["train"]
    rates = detection_rates(look_counts["train"])

    # The layout's weights before the first view, as in a fit.
    goals = np.flatnonzero(agent_loop.env.task.is_goal())
    prior = policies.knowledge.priors[-1]
    goal_weights = (prior / prior.sum(axis=-1, keepdims=True) + jnp.eye(len(prior))).T[goals]
    goal_inputs = (jnp.asarray(goals), goal_weights)

    rows: dict[str, Any] = {}
    belief_calls = {}
    for name in predictor_names:
        console.print(f"fitting {name} ...")
        spec = dataclasses.replace(policies.spec, method=make_belief_method(PREDICTORS[name]))
        fitted_loop = dataclasses.replace(agent_loop, spec=spec)
        start_params = init_params(spec, key) | {"detection_rates": rates}
        params = fit_weights(fitted_loop, start_params, snapshots["train"], *goal_inputs, key)

        zeros = {group: jax.tree.map(jnp.zeros_like, params[group]) for group in ("places", "method")}
        bits = {}
        for split, split_snapshots in snapshots.items():
            flat_losses, _ = measure_losses(fitted_loop, params | zeros, split_snapshots, *goal_inputs, num_searches)
            losses = measure_losses(fitted_loop, params, split_snapshots, *goal_inputs, num_searches)
            bits[split] = [flat_losses - loss for loss in losses]
        rows[name] = {
            "bits": interval_over_searches(bits["val"][1]),
            "places_bits": interval_over_searches(bits["val"][0]),
            "train_bits": interval_over_searches(bits["train"][1]),
            "parameters": sum(leaf.size for leaf in jax.tree.leaves(params["method"])),
        }
        belief_calls[name] = make_belief_call(fitted_loop, params, snapshots["val"], *goal_inputs)

    for name, call_times in time_in_turns(belief_calls, TURNS).items():
        rows[name]["microseconds"] = summarize([1e6 * call_time / BATCH for call_time in call_times])
    settings = {"run": Path(run_dir).name, "penalty": penalty, "searches": num_searches, "steps": num_steps}
    print_report(settings | {"predictors": rows})


def measure_losses(
    agent_loop: AgentLoop,
    params: Params,
    snapshots: Snapshots,
    goals: jax.Array,
    goal_weights: jax.Array,
    num_searches: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean negative log likelihoods of places and layout in each search, in bits; NaN without an unseen goal."""
    policy: Any = agent_loop.bind(params)
    one_map = jax.jit(lambda snapshot: goal_losses(policy, snapshot, goals, goal_weights))
    places_loss, layout_loss, num_goals = jax.lax.map(one_map, snapshots, batch_size=BATCH)

    # Snapshots are listed time by time, [T searches].
    total_goals = np.asarray(num_goals).reshape(-1, num_searches).sum(axis=0)
    mean_losses = []
    for loss in (places_loss, layout_loss):
        total_loss = np.asarray(loss).reshape(-1, num_searches).sum(axis=0)
        mean_losses.append(np.where(total_goals > 0, total_loss, np.nan) / np.maximum(total_goals, 1.0) / np.log(2))
    return mean_losses[0], mean_losses[1]


def interval_over_searches(bits: np.ndarray) -> dict[str, Any]:
    """Mean of one value for each search, with its interval; searches without a value are NaN."""
    counted_bits = bits[np.isfinite(bits)]
    names = np.arange(len(counted_bits)).astype(str)
    clusters = scene_clusters(names, np.full(len(names), ""))
    return mean_interval(counted_bits[None], clusters, trained=False).to_json()


def make_belief_call(
    agent_loop: AgentLoop, params: Params, snapshots: Snapshots, goals: jax.Array, goal_weights: jax.Array
) -> Callable[[], jax.Array]:
    """Make a call that computes the beliefs on the last maps of a batch of searches."""
    policy = cast(TargetPolicy, agent_loop.bind(params))
    last_maps = jax.tree.map(lambda leaf: leaf[-BATCH:], snapshots)
    floor_shares = last_maps.floor.astype(jnp.float32) / SQUARE_CELLS**2
    squares = MapSquares(last_maps.categories, floor_shares, last_maps.looks.astype(jnp.float32))
    beliefs = jax.jit(jax.vmap(lambda one_map: policy.log_beliefs(one_map, goals[0], goal_weights[0]).layout))
    return lambda: beliefs(squares)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run")
    parser.add_argument("--predictors", choices=list(PREDICTORS), nargs="+", default=list(PREDICTORS))
    parser.add_argument("--penalty", type=float, default=belief_fit.WEIGHT_PENALTY, help="of the squared weights")
    parser.add_argument("--searches", type=int, default=256)
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    try:
        main(options.run, options.predictors, options.penalty, options.searches, options.steps)
    except InputError as error:
        sys.exit(f"error: {error}")
