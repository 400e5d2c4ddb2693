"""Steps per second of the environment alone: `python benchmarks/environment.py`.

1,024 parallel episodes take random actions with auto-reset, and every step delivers all observation rows. The limit is
a loop that does nothing but gather the same rows.
"""

import jax
import jax.numpy as jnp
from _common import rates, report, timings

from jaxnav.env.make import make

EPISODES, STEPS, REPEATS = 1024, 1000, 15


def main() -> None:
    env, params = make("rooms")
    key = jax.random.key(0)
    actions = jax.random.randint(key, (STEPS, EPISODES), 0, env.num_actions)
    observation, state = jax.vmap(env.reset, (0, None))(jax.random.split(key, EPISODES), params)

    @jax.jit
    def act(state, row, actions, params):
        def step(carry, inputs):
            time, action = inputs
            keys = jax.random.split(jax.random.fold_in(key, time), EPISODES)
            observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, carry[0], action, params)
            return (state, observation.row), state.pose

        return jax.lax.scan(step, (state, row), (jnp.arange(STEPS), actions))

    @jax.jit
    def gather(row, poses, rows):
        return jax.lax.scan(lambda _, pose: (rows[pose], None), row, poses)[0]

    _, poses = act(state, observation.row, actions, params)
    steps = EPISODES * STEPS
    stepping = timings(act, state, observation.row, actions, params, repeats=REPEATS)
    gathering = timings(gather, observation.row, poses, params.tables.rows, repeats=REPEATS)
    report(
        {
            "episodes": EPISODES,
            "steps_per_call": steps,
            "row_bytes": env.layout.num_bytes,
            "table_bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(params.tables)),
            "environment_steps_per_s": rates(stepping, steps),
            "gather_steps_per_s": rates(gathering, steps),
            "environment_over_gather": round(gathering["wall_median_ms"] / stepping["wall_median_ms"], 3),
        }
    )


if __name__ == "__main__":
    main()
