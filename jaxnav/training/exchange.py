"""Signs of another layout, learned from random walks under random exchanges of categories."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.gaps import Signs, seen_together
from jaxnav.policies.acting import Acting, Agent
from jaxnav.scenes.task import DONE

#: What a walk has seen is taken after one of these numbers of steps.
STEPS = (1, 2, 5, 10, 20, 40, 60)
#: Standard deviation, in ranks, of the noise on the order of categories, neighbours in which exchange.
SPREAD = 3.0
#: Weight of the squared odds in the loss, and the share of the scenes that only calibrates.
RIDGE, HELD_OUT = 1e-3, 0.25
#: Of the descent to the least loss.
UPDATES, RATE = 100, 0.1


def learn_signs(
    env: ObjectNav,
    params: EnvParams,
    counts: jax.Array,
    key: jax.Array,
    num_walks: int = 8192,
    pooled: bool = False,
) -> Signs:
    """Learn what sightings tell of the layout.

    The odds are those of a logistic regression on the pairs of categories that a random walk has seen together: walks
    in the training scenes as they are, against the same walks with categories exchanged at random (`exchange`). They
    are rescaled by what calibrates, in a quarter of the scenes, the odds that were learned in the others. A room type
    without scenes gets odds of 0.

    Args:
      env: the environment.
      params: of the training scenes.
      counts: float32 [rooms, K, K], from `explore`; the diagonal holds how often each category was seen.
      key: consumed.
      num_walks: W, parallel walks.
      pooled: learn the same for all room types.
    """
    walk_key, exchange_key, step_key, scene_key = (jax.random.fold_in(key, purpose) for purpose in range(4))
    presence, scene = _walks(env, params, walk_key, num_walks)
    present = _present(env, params)[scene]  # [W, K]
    room = params.room[scene]
    often = jnp.diagonal(counts, axis1=1, axis2=2)[room]
    steps = jax.random.choice(step_key, jnp.array(STEPS), (num_walks,))
    taken = jnp.arange(presence.shape[1])[None] <= steps[:, None]  # [W, T + 1]
    together = jax.vmap(seen_together)(presence & taken[..., None])  # [W, K, K]
    exchanged = jax.vmap(exchange)(jax.random.split(exchange_key, num_walks), present, often)
    other = jax.vmap(lambda pairs, order: pairs[order][:, order])(together, exchanged)
    rows, columns = jnp.triu_indices(counts.shape[-1], 1)
    pairs = jnp.concatenate([together, other])[:, rows, columns]  # [2 W, pairs]
    held_out = jax.random.bernoulli(scene_key, HELD_OUT, params.room.shape)[scene]
    rooms = jnp.zeros_like(room) if pooled else room
    odds = _regression(pairs, jnp.tile(rooms, 2), jnp.tile(held_out, 2), len(counts))
    odds = jnp.broadcast_to(odds[0], odds.shape) if pooled else odds
    return Signs(odds=jnp.zeros_like(counts).at[:, rows, columns].set(odds), chance=chances(counts))


def exchange(key: jax.Array, present: jax.Array, often: jax.Array) -> jax.Array:
    """Draw an exchange of categories.

    The categories present, in the order of how often they are seen, with noise on their ranks, exchange two by two;
    the last of an odd number stays.

    Args:
      key: consumed.
      present: bool [K], in the scene.
      often: float32 [K], how often each is seen.

    Returns:
      int32 [K], for each category the one whose sightings become its; its own inverse.
    """
    ranks = jnp.argsort(jnp.argsort(jnp.where(present, often, jnp.inf))).astype(jnp.float32)
    noisy = ranks + SPREAD * jax.random.normal(key, ranks.shape)
    order = jnp.argsort(jnp.where(present, noisy, jnp.inf)).astype(jnp.int32)
    place = jnp.arange(len(order))
    partner = jnp.where((place ^ 1) < present.sum(), place ^ 1, place)
    partner = jnp.where(place < present.sum(), partner, place)
    return jnp.zeros_like(order).at[order].set(order[partner])


def chances(counts: jax.Array) -> jax.Array:
    """Return the chance to see one category with another.

    Args:
      counts: float32 [rooms, K, K], poses at which two were detected together, and each one on the diagonal.

    Returns:
      float32 [rooms, K, K] in [0, 1], the share of the poses showing i that show j too; 0 on the diagonal and where i
      was never seen. A room type that training has no scene of gets those of all its scenes together.
    """
    met = counts.any(axis=(1, 2), keepdims=True)
    counts = jnp.where(met, counts, counts.sum(axis=0, keepdims=True))
    alone = jnp.diagonal(counts, axis1=1, axis2=2)[..., None]
    others = 1 - jnp.eye(counts.shape[-1], dtype=counts.dtype)
    return counts / jnp.maximum(alone, 1) * others[None]


def _present(env: ObjectNav, params: EnvParams) -> jax.Array:
    """Return which categories stand in each scene, bool [S, K].

    They are those that are detected at more poses than false alarms explain.
    """
    detected = env.row_format.presence(params.tables.rows).astype(jnp.int32)
    so_far = jnp.concatenate([jnp.zeros_like(detected[:1]), jnp.cumsum(detected, axis=0)])
    tables, poses_per_cell = params.tables, env.task.rules.poses_per_cell
    first, poses = tables.first_cell * poses_per_cell, tables.num_cells * poses_per_cell
    shares = (so_far[first + poses] - so_far[first]).astype(jnp.float32) / poses[:, None].astype(jnp.float32)
    return shares > 2 * env.task.detector.false_alarm


def _walks(env: ObjectNav, params: EnvParams, key: jax.Array, num_walks: int) -> tuple[jax.Array, jax.Array]:
    """Return what random walks detect, bool [W, T + 1, K], and their scenes [W]."""
    start_key, walk_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
    acting = Acting(env)
    agent = acting.start(start_key, num_walks, None, None, params)
    actions = jax.random.randint(walk_key, (STEPS[-1], num_walks), 0, DONE)

    def step(agent: Agent, action: jax.Array) -> tuple[Agent, jax.Array]:
        after, _ = acting.step(agent, action, None, params)
        return after, after.state.pose

    _, poses = jax.lax.scan(step, agent, actions)
    poses = jnp.concatenate([agent.state.pose[None], poses]).T
    return env.row_format.presence(params.tables.rows[poses]), agent.state.scene


def _regression(pairs: jax.Array, rooms: jax.Array, held_out: jax.Array, num_rooms: int) -> jax.Array:
    """Return calibrated log odds of every pair.

    Args:
      pairs: bool [2 W, pairs], what was seen together; the second W walks are those of another layout.
      rooms: int32 [2 W], whose odds a walk goes by.
      held_out: bool [2 W], left out of the regression.
      num_rooms: number of room types.

    Returns:
      float32 [rooms, pairs].
    """
    examples = pairs.astype(jnp.float32)
    truth = (jnp.arange(len(pairs)) >= len(pairs) // 2).astype(jnp.float32)

    def evidence(odds: jax.Array) -> jax.Array:
        return jnp.take_along_axis(examples @ odds.T, rooms[:, None], axis=-1)[:, 0]

    def loss(evidence: jax.Array, kept: jax.Array) -> jax.Array:
        each = optax.sigmoid_binary_cross_entropy(evidence, truth)
        return (each * kept.astype(jnp.float32)).sum() / jnp.maximum(kept.sum(), 1).astype(jnp.float32)

    def fitted(kept: jax.Array) -> jax.Array:
        start = jnp.zeros((num_rooms, pairs.shape[-1]))
        return _minimum(lambda odds: loss(evidence(odds), kept) + RIDGE * (odds**2).sum(), start)

    unseen = evidence(fitted(~held_out))
    scale = _minimum(lambda scale: loss(jnp.exp(scale) * unseen, held_out), jnp.zeros(()))
    return jnp.exp(scale) * fitted(jnp.ones_like(held_out))


def _minimum(loss: Callable[[jax.Array], jax.Array], start: jax.Array) -> jax.Array:
    """Return where a loss is least, by gradients."""
    optimizer = optax.adam(RATE)

    def update(state: tuple, _: None) -> tuple[tuple, None]:
        weights, moments = state
        gradient = jax.grad(loss)(weights)
        with jax.numpy_dtype_promotion("standard"):  # optax counts in int32 beside float32
            step, moments = optimizer.update(gradient, moments)
        return (optax.apply_updates(weights, step), moments), None

    return jax.lax.scan(update, (start, optimizer.init(start)), length=UPDATES)[0][0]
