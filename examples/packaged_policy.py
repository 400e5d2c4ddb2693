"""Sweep the threshold of sTDE over a trained policy in unseen rooms, with the layout as trained and shifted.

The packaged policy is a pytree, so the sweep is a plain `jax.vmap`. Success counts within 100 actions.

python examples/packaged_policy.py
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxnav
from jaxnav.env.objectnav import EnvParams

NUM_EPISODES = 256
NUM_STEPS = 100

env, unshifted_params = jaxnav.make("rooms", split="val")
policy = jaxnav.load_policy("rooms-org", env=env)


def run_episode(key: jax.Array, epsilon: jax.Array, params: EnvParams) -> jax.Array:
    """Act until Done, and return whether Done succeeds."""

    def step(carry, _):
        state, memory, moved, ended, success = carry
        _, heading, horizon = env.task.rules.split_pose(state.pose)
        observation = env.observe(state, params)
        action, memory = policy.act(observation, memory, epsilon, heading=heading, moved=moved, horizon=horizon)
        next_state, _, done, _ = env.advance(state, action, params)

        # Steps after the end of the episode do not count.
        success = success | (~ended & done & env.done_succeeds(next_state, params))
        moved = env.cell_of_pose(next_state.pose) != env.cell_of_pose(state.pose)
        return (next_state, memory, moved, ended | done, success), None

    _, state = env.reset(key, params)
    memory = policy.begin(params.room[state.scene])
    start = (state, memory, jnp.bool_(False), jnp.bool_(False), jnp.bool_(False))
    (*_, success), _ = jax.lax.scan(step, start, length=NUM_STEPS)
    return success


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, None))  # over thresholds
def success_rate(keys: jax.Array, epsilon: jax.Array, params: EnvParams) -> jax.Array:
    """Return the share of episodes that succeed."""
    return jax.vmap(run_episode, (0, None, None))(keys, epsilon, params).mean()


_, shifted_params = jaxnav.make("rooms", split="val", shift=1)
keys = jax.random.split(jax.random.key(0), NUM_EPISODES)
thresholds = np.array([0.0, 0.25, 0.5, 1.0], np.float32)
for shift, params in ((0, unshifted_params), (1, shifted_params)):
    rates = success_rate(keys, thresholds, params)
    for epsilon, rate in zip(thresholds, rates, strict=True):
        print(f"shift {shift}, epsilon {epsilon:.2f}: {100 * rate:.1f} % of {NUM_EPISODES} episodes")
