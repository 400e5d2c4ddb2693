"""Speed of the search by belief: evaluation beside ORG's, and the time of a belief and a plan.

`python benchmarks/belief_speed.py [--episodes 256]` times in turns

* the first 50 steps of parallel episodes with best actions and sTDE, for the packaged policies `houses-belief` and
  `houses-org`, in equal homes: environment steps per second, and their ratio;
* one plan (both beliefs, the walking steps to all squares, the scores of all targets) on maps of 64 x 64 and 96 x 96
  random cells, one map at a time.
"""

import argparse
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report, ratio_by_turn, steps_per_second, summarize, time_in_turns

from jaxnav.evaluation.grid import DecisionContext, infer_and_act, start_states
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.plain_console import PlainConsole
from jaxnav.policies.methods.belief_map import read_squares, score_targets, travel_costs
from jaxnav.policies.methods.map_tracker import (
    EXPLORED_BIT,
    FREE_BIT,
    NUM_LOOK_DISTANCES,
    SQUARE_CELLS,
    WALL_BIT,
)
from jaxnav.policies.network import bind
from jaxnav.runs.policies import Policies, load_policy_as_run
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, draw_episode_lists

NUM_STEPS = 50
TURNS = 7
MAP_SIZES = (64, 96)
#: Maps in a timed call.
NUM_MAPS = 64


def main(num_episodes: int) -> None:
    config, belief_policies = load_policy_as_run("houses-belief")
    belief_policies = belief_policies.with_estimator("surprise")
    _, org_policies = load_policy_as_run("houses-org")
    compiled_world = compile_evaluation_world(config, "val", None, 0.0, PlainConsole(stderr=True))
    calls = {
        "belief": make_steps_call(belief_policies, compiled_world, num_episodes),
        "org": make_steps_call(org_policies, compiled_world, num_episodes),
    }
    step_times = time_in_turns(calls, TURNS)
    num_steps = num_episodes * NUM_STEPS
    report: dict[str, Any] = {"episodes": num_episodes}
    report["steps_per_s"] = {name: steps_per_second(times, num_steps) for name, times in step_times.items()}
    report["belief_over_org"] = ratio_by_turn(step_times["org"], step_times["belief"])

    plan_times = time_in_turns({str(size): make_plan_call(belief_policies, size) for size in MAP_SIZES}, TURNS)
    report["microseconds_per_plan"] = {
        f"{size} x {size}": summarize([1e6 * call_time / NUM_MAPS for call_time in plan_times[str(size)]])
        for size in MAP_SIZES
    }
    print_report(report)


def make_steps_call(policies: Policies, compiled_world: CompiledWorld, num_episodes: int) -> Callable[[], Any]:
    """Make a call that runs parallel episodes from their start, with sTDE."""
    agent_loop = policies.make_agent_loop(compiled_world)
    env_params = compiled_world.make_env_params(0)
    episodes = draw_episode_lists(compiled_world, num_episodes, 0)[0]
    grid = inference_grid([table_row("stde", 0.0, "paper", "argmax")], policies.arms, policies.num_seeds)
    config = jax.tree.map(lambda leaf: leaf[0], grid)
    policy = agent_loop.bind_decider(jax.tree.map(lambda leaf: leaf[0], policies.params))
    context = DecisionContext(policy, config.use_layout, agent_loop, policies.knowledge, env_params)
    episode_keys = jax.random.split(jax.random.key(0), num_episodes)
    running = jnp.ones(num_episodes, bool)

    @jax.jit
    def run_steps() -> jax.Array:
        memory = policy.initial_memory((num_episodes,))
        agent = agent_loop.start_from(start_states(episodes), memory, policies.knowledge, env_params)

        def step(agent: Any, _: None) -> tuple[Any, jax.Array]:
            next_agent, result, _trace = infer_and_act(
                config, context, agent, running, episode_keys, has_controls=False
            )
            return next_agent, result.success

        return jax.lax.scan(step, agent, None, length=NUM_STEPS)[1]

    return run_steps


def make_plan_call(policies: Policies, size: int) -> Callable[[], Any]:
    """Make a call that scores the targets of `NUM_MAPS` random maps, one after another."""
    # Half of the cells are explored, one in seven is a wall, and one in fifty shows a category.
    rng = np.random.default_rng(0)
    shape = (NUM_MAPS, size, size)
    cells = np.where(rng.random(shape) < 1 / 2, EXPLORED_BIT, np.uint32(0)) | np.where(
        rng.random(shape) < 1 / 7, WALL_BIT, FREE_BIT
    )
    num_categories = policies.spec.num_categories
    category_bits = np.uint32(1) << rng.integers(0, num_categories, shape, dtype=np.uint32)
    cells |= np.where(rng.random(shape) < 1 / 50, category_bits, np.uint32(0))
    maps = jnp.asarray(cells, jnp.uint32)
    num_squares = size // SQUARE_CELLS
    look_counts = jnp.asarray(rng.integers(0, 3, (NUM_MAPS, NUM_LOOK_DISTANCES, num_squares, num_squares)), jnp.uint8)
    policy: Any = bind(policies.spec, jax.tree.map(lambda leaf: leaf[0], policies.params))

    def score_map(one_map: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cells, look_counts = one_map
        beliefs = policy.log_beliefs(read_squares(cells, look_counts), jnp.int32(0), jnp.ones(num_categories))
        log_cost, _ = travel_costs(cells, jnp.full(2, size // 2, jnp.int32))
        return score_targets(beliefs.places, log_cost), score_targets(beliefs.layout, log_cost)

    score_maps = jax.jit(lambda maps, look_counts: jax.lax.map(score_map, (maps, look_counts)))
    return lambda: score_maps(maps, look_counts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--episodes", type=int, default=256)
    options = parser.parse_args()
    main(options.episodes)
