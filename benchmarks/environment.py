"""Steps per second of the environment alone, and their upper limit.

In `python benchmarks/environment.py` 2,048 parallel episodes take random actions with auto-reset. They deliver poses
(by which an update gathers rows again), the last rows, their sum, or all. The limit is a loop that gathers the same
rows and does nothing else. Keys are split at every step, or all before the first.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from _common import print_report, ratio_by_turn, steps_per_second, time_in_turns

from jaxnav.env.make import make

NUM_EPISODES = 2048
NUM_STEPS = 500

#: By what a step delivers: function of the rows carried so far, the step's rows and poses to the next carry and output.
KEEP: dict[str, Callable] = {
    "poses": lambda carried_row, row, pose: (carried_row, pose),
    "last_row": lambda carried_row, row, pose: (row, None),
    "sum_of_rows": lambda carried_row, row, pose: (carried_row + row, None),
    "all_rows": lambda carried_row, row, pose: (carried_row, row),
}


def main() -> None:
    env, params = make("rooms")
    key = jax.random.key(0)
    actions = jax.random.randint(key, (NUM_STEPS, NUM_EPISODES), 0, env.num_actions)
    observation, start = jax.vmap(env.reset, (0, None))(jax.random.split(key, NUM_EPISODES), params)

    @partial(jax.jit, static_argnums=(0, 1))
    def act(keep, split_keys_first, state, row, actions, params):
        def split(time_index):
            return jax.random.split(jax.random.fold_in(key, time_index), NUM_EPISODES)

        def step(carry, inputs):
            state, carried_row = carry
            action, step_input = inputs
            keys = step_input if split_keys_first else split(step_input)
            observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, state, action, params)
            carried_row, output = KEEP[keep](carried_row, observation.row, state.pose)
            return (state, carried_row), output

        time_indices = jnp.arange(NUM_STEPS)
        step_inputs = jax.vmap(split)(time_indices) if split_keys_first else time_indices
        return jax.lax.scan(step, (state, row), (actions, step_inputs))

    @partial(jax.jit, static_argnums=0)
    def gather(keep, row, poses, rows):
        return jax.lax.scan(lambda carried_row, pose: KEEP[keep](carried_row, rows[pose], pose), row, poses)

    # The environment, with every kind of output.
    calls = {}
    for name in KEEP:
        calls[f"steps_{name}"] = partial(act, name, False, start, observation.row, actions, params)
    calls["steps_sum_of_rows_keys_first"] = partial(act, "sum_of_rows", True, start, observation.row, actions, params)

    # The limit: gather the rows of the same poses.
    _, poses = act("poses", False, start, observation.row, actions, params)
    for name in ("sum_of_rows", "all_rows"):
        calls[f"gather_{name}"] = partial(gather, name, observation.row, poses, params.tables.rows)

    times = time_in_turns(calls)
    print_report(
        {
            "episodes": NUM_EPISODES,
            "steps": NUM_STEPS,
            "steps_per_s": {
                name: steps_per_second(call_times, NUM_EPISODES * NUM_STEPS) for name, call_times in times.items()
            },
            "over_gather": {
                "sum_of_rows": ratio_by_turn(times["gather_sum_of_rows"], times["steps_sum_of_rows"]),
                "sum_of_rows_keys_first": ratio_by_turn(
                    times["gather_sum_of_rows"], times["steps_sum_of_rows_keys_first"]
                ),
                "all_rows": ratio_by_turn(times["gather_all_rows"], times["steps_all_rows"]),
            },
        }
    )


if __name__ == "__main__":
    main()
