"""Steps per second of the environment alone, and its limit.

In `python benchmarks/environment.py` 2,048 parallel episodes take random actions with auto-reset. They deliver poses
(by which an update gathers rows again), the last rows, their sum, or all. The limit is a loop that gathers the same
rows and does nothing else. Keys are split at every step, or all before the first.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from _common import in_turns, rates, ratios, report

from jaxnav.env.make import make

EPISODES, STEPS = 2048, 500

KEEP: dict[str, Callable] = {
    "poses": lambda kept, row, pose: (kept, pose),
    "last_row": lambda kept, row, pose: (row, None),
    "sum_of_rows": lambda kept, row, pose: (kept + row, None),
    "all_rows": lambda kept, row, pose: (kept, row),
}


def main() -> None:
    env, params = make("rooms")
    key = jax.random.key(0)
    actions = jax.random.randint(key, (STEPS, EPISODES), 0, env.num_actions)
    observation, start = jax.vmap(env.reset, (0, None))(jax.random.split(key, EPISODES), params)

    @partial(jax.jit, static_argnums=(0, 1))
    def act(keep, keys_first, state, row, actions, params):
        def split(time):
            return jax.random.split(jax.random.fold_in(key, time), EPISODES)

        def step(carry, inputs):
            action, keys = inputs
            keys = keys if keys_first else split(keys)
            observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, carry[0], action, params)
            kept, out = KEEP[keep](carry[1], observation.row, state.pose)
            return (state, kept), out

        keys = jnp.arange(STEPS)
        return jax.lax.scan(step, (state, row), (actions, jax.vmap(split)(keys) if keys_first else keys))

    @partial(jax.jit, static_argnums=0)
    def gather(keep, row, poses, rows):
        return jax.lax.scan(lambda kept, pose: KEEP[keep](kept, rows[pose], pose), row, poses)

    _, poses = act("poses", False, start, observation.row, actions, params)
    calls = {f"steps_{name}": partial(act, name, False) for name in KEEP}
    calls |= {"steps_sum_of_rows_keys_first": partial(act, "sum_of_rows", True)}
    calls = {name: partial(call, start, observation.row, actions, params) for name, call in calls.items()}
    for name in ("sum_of_rows", "all_rows"):
        calls[f"gather_{name}"] = partial(gather, name, observation.row, poses, params.tables.rows)
    taken = in_turns(calls)
    report(
        {
            "episodes": EPISODES,
            "steps": STEPS,
            "row_bytes": env.row_format.num_bytes,
            "table_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(params.tables)),
            "steps_per_s": {name: rates(values, EPISODES * STEPS) for name, values in taken.items()},
            "over_gather": {
                "sum_of_rows": ratios(taken["gather_sum_of_rows"], taken["steps_sum_of_rows"]),
                "sum_of_rows_keys_first": ratios(taken["gather_sum_of_rows"], taken["steps_sum_of_rows_keys_first"]),
                "all_rows": ratios(taken["gather_all_rows"], taken["steps_all_rows"]),
            },
        }
    )


if __name__ == "__main__":
    main()
