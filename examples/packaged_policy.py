"""Sweep the threshold of sTDE over a trained policy, in rooms it has never seen, with the layout as it was and shifted.

The policy comes with jaxnav and is a pytree: the sweep is a vmap of one's own.

python examples/packaged_policy.py
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxnav
from jaxnav.env.types import EnvParams

EPISODES, STEPS = 256, 100

env, unshifted = jaxnav.make("rooms", split="val")
policy = jaxnav.load_policy("rooms-org", env=env)
horizons, headings = len(env.task.rules.horizons), env.task.rules.headings


def episode(key: jax.Array, epsilon: jax.Array, params: EnvParams) -> jax.Array:
    """Act until Done; return whether it succeeds."""

    def step(carry, _):
        state, memory, moved, over, found = carry
        heading, horizon = state.pose // horizons % headings, state.pose % horizons
        observation = env.observe(state, params)
        action, memory = policy.act(observation, memory, epsilon, heading=heading, moved=moved, horizon=horizon)
        after, _, done, _ = env.advance(state, action, params)
        found = found | (~over & done & env.succeeds(after, params))
        moved = env.cell(after.pose) != env.cell(state.pose)
        return (after, memory, moved, over | done, found), None

    _, state = env.reset(key, params)
    start = state, policy.begin(params.room[state.scene]), jnp.bool_(False), jnp.bool_(False), jnp.bool_(False)
    return jax.lax.scan(step, start, length=STEPS)[0][-1]


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, None))  # over thresholds
def success(keys: jax.Array, epsilon: jax.Array, params: EnvParams) -> jax.Array:
    """Return the share of episodes that succeed."""
    return jax.vmap(episode, (0, None, None))(keys, epsilon, params).mean()


thresholds = np.array([0.0, 0.25, 0.5, 1.0], np.float32)
for shift in (0, 1):
    params = unshifted if shift == 0 else jaxnav.make("rooms", split="val", shift=1)[1]
    rates = success(jax.random.split(jax.random.key(0), EPISODES), thresholds, params)
    for epsilon, rate in zip(thresholds, rates, strict=True):
        print(f"shift {shift}, epsilon {epsilon:.2f}: {100 * rate:.1f} % of {EPISODES} episodes")
