"""Let a trained policy that comes with jaxnav act in rooms it has never seen, with sTDE at several thresholds.

python examples/packaged_policy.py
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxnav

EPISODES, STEPS = 256, 100

env, params = jaxnav.make("rooms", split="val")
policy = jaxnav.load_policy("rooms-org", env=env)
horizons, headings = len(env.task.rules.horizons), env.task.rules.headings


def episode(key: jax.Array, epsilon: jax.Array) -> jax.Array:
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
@functools.partial(jax.vmap, in_axes=(None, 0))  # over thresholds
def success(keys: jax.Array, epsilon: jax.Array) -> jax.Array:
    """Return the share of episodes that succeed."""
    return jax.vmap(episode, (0, None))(keys, epsilon).mean()


thresholds = np.array([0.0, 0.25, 0.5, 1.0], np.float32)
rates = success(jax.random.split(jax.random.key(0), EPISODES), thresholds)
for epsilon, rate in zip(thresholds, rates, strict=True):
    print(f"epsilon {epsilon:.2f}: {100 * rate:.1f} % of {EPISODES} episodes")
