"""A fitted prior: where a goal stands, given the objects detected so far.

The score of site n for goal k is b[k] . s(n) + sum over categories j and relations r of W[k, j, r] f(j, r, n). Here s
are the surroundings of the site, and f is 1 if category j was detected at a site in relation r to n. The prior is the
softmax over the sites.

`fit_layout_model` fits W and b to snapshots of searches by conditional likelihood: together with the looks in vain so
far, the prior should predict the sites of the goals. `detection_counts` and `estimate_detection_rates` measure how
often a look at an object detects it.

Symbols in shapes: K categories, N sites, L kinds of looks, G snapshots.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnav.baselines.sites import NUM_DISTANCE_BINS, NUM_RELATIONS, NUM_SURROUNDINGS, Sites

NUM_STEPS, BATCH_SIZE, LEARNING_RATE = 1500, 32, 0.02
WEIGHT_PENALTY = 1e-3  # factor of the squared weights, added to the mean negative log likelihood
PRIOR_LOOKS = 2.0  # number of looks at the mean rate that are added to those at each category


class LayoutModel(NamedTuple):
    """Weights of the score for K goals.

    Attributes:
      relation_weights: float32 [K, K, 3], W, by goal, detected category and relation.
      surrounding_weights: float32 [K, 3], b.
    """

    relation_weights: np.ndarray
    surrounding_weights: np.ndarray

    def scores(self, goal: int, features: np.ndarray, sites: Sites) -> np.ndarray:
        """Return the scores of the sites, float32 [N].

        Args:
          goal: index of the category.
          features: bool [K, 3, N], f.
          sites: sites of the scene.
        """
        relation_scores = np.tensordot(self.relation_weights[goal], features, 2)
        return relation_scores + self.surrounding_weights[goal] @ sites.surroundings


class PlannerSnapshot(NamedTuple):
    """Knowledge of a searcher at one time.

    Attributes:
      sites: sites of its scene.
      features: bool [K, 3, N], see `LayoutModel.scores`.
      look_counts: uint16 [L, N], number of looks of each kind at each site.
      detected: bool [K], True for the categories detected so far.
    """

    sites: Sites
    features: np.ndarray
    look_counts: np.ndarray
    detected: np.ndarray


def uniform_layout_model(num_categories: int) -> LayoutModel:
    """Return the model with equal scores for all sites."""
    return LayoutModel(
        np.zeros((num_categories, num_categories, NUM_RELATIONS), np.float32),
        np.zeros((num_categories, NUM_SURROUNDINGS), np.float32),
    )


def fit_layout_model(
    snapshots: Sequence[PlannerSnapshot], rates: np.ndarray, *, use_relations: bool = True
) -> LayoutModel:
    """Fit the model to the sites of the goals.

    Args:
      snapshots: snapshots of searches in training scenes.
      rates: float32 [K, L], see `estimate_detection_rates`.
      use_relations: False for a model without categories: all goals share the weights of the surroundings, and
        detections have no effect.
    """
    # An example is a snapshot and a goal that is in the scene but was not detected.
    num_categories = len(rates)
    is_example = [snapshot.sites.object_sites.any(axis=1) & ~snapshot.detected for snapshot in snapshots]
    examples = np.argwhere(is_example).astype(np.int32)  # [examples, (snapshot, goal)]
    order = np.random.default_rng(0).integers(len(examples), size=(NUM_STEPS, BATCH_SIZE))

    initial_weights = _Weights(
        shared=jnp.zeros(NUM_SURROUNDINGS),
        surrounding=jnp.zeros((num_categories, NUM_SURROUNDINGS)),
        relation=jnp.zeros((num_categories, num_categories, NUM_RELATIONS)),
    )
    category_factor = jnp.float32(use_relations)
    fitted = _optimize(
        initial_weights, _batch_snapshots(snapshots), jnp.log1p(-rates), examples[order], category_factor
    )
    return LayoutModel(np.asarray(fitted.relation), np.asarray(fitted.shared[None] + fitted.surrounding))


class _Weights(NamedTuple):
    """Trained weights.

    Attributes:
      shared: float32 [3], weights of the surroundings for all goals, not penalised.
      surrounding: float32 [K, 3], difference of each goal from them, penalised.
      relation: float32 [K, K, 3], penalised.
    """

    shared: jax.Array
    surrounding: jax.Array
    relation: jax.Array


class _SnapshotBatch(NamedTuple):
    """G snapshots, padded to M sites.

    Attributes:
      features: bool [G, K, 3, M].
      look_counts: uint16 [G, L, M].
      surroundings: float32 [G, 3, M].
      object_sites: bool [G, K, M].
      is_site: bool [G, M], False for padding.
    """

    features: jax.Array
    look_counts: jax.Array
    surroundings: jax.Array
    object_sites: jax.Array
    is_site: jax.Array


def _batch_snapshots(snapshots: Sequence[PlannerSnapshot]) -> _SnapshotBatch:
    """Stack snapshots of scenes with different numbers of sites."""
    max_sites = max(snapshot.features.shape[-1] for snapshot in snapshots)

    def stack_padded(arrays: Iterable[np.ndarray]) -> jax.Array:
        padded_arrays = []
        for array in arrays:
            padding = [(0, 0)] * (array.ndim - 1) + [(0, max_sites - array.shape[-1])]
            padded_arrays.append(np.pad(array, padding))
        return jnp.asarray(np.stack(padded_arrays))

    return _SnapshotBatch(
        features=stack_padded(snapshot.features for snapshot in snapshots),
        look_counts=stack_padded(snapshot.look_counts for snapshot in snapshots),
        surroundings=stack_padded(snapshot.sites.surroundings for snapshot in snapshots),
        object_sites=stack_padded(snapshot.sites.object_sites for snapshot in snapshots),
        is_site=stack_padded(np.ones(snapshot.features.shape[-1], bool) for snapshot in snapshots),
    )


@jax.jit
def _optimize(
    weights: _Weights, snapshots: _SnapshotBatch, log_miss: jax.Array, batches: jax.Array, category_factor: jax.Array
) -> _Weights:
    """Return the weights after Adam's steps.

    Args:
      weights: initial weights.
      snapshots: G snapshots.
      log_miss: float32 [K, L], log probability that a look at the goal does not detect it.
      batches: int32 [steps, B, 2], snapshot and goal of each example.
      category_factor: float32, 1 or 0, factor of all weights that differ between categories.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, NUM_STEPS))

    def loss_fn(weights: _Weights, batch: jax.Array) -> jax.Array:
        snapshot, goal = batch.T

        # Log belief of each site: score of the prior, and log probability of the looks in vain, [B, M].
        surrounding = weights.shared[None] + category_factor * weights.surrounding[goal]
        scores = jnp.einsum("bu,bun->bn", surrounding, snapshots.surroundings[snapshot])
        relation = category_factor * weights.relation[goal]
        features = snapshots.features[snapshot].astype(jnp.float32)
        scores += jnp.einsum("bjr,bjrn->bn", relation, features)
        look_counts = snapshots.look_counts[snapshot].astype(jnp.float32)
        scores += jnp.einsum("bl,bln->bn", log_miss[goal], look_counts)
        scores = jnp.where(snapshots.is_site[snapshot], scores, -jnp.inf)

        # Negative log likelihood that the goal is at one of its sites.
        log_goal_mass = jax.nn.logsumexp(scores, axis=1, where=snapshots.object_sites[snapshot, goal])
        squared_weights = jnp.square(weights.surrounding).sum() + jnp.square(weights.relation).sum()
        return (jax.nn.logsumexp(scores, axis=1) - log_goal_mass).mean() + WEIGHT_PENALTY * squared_weights

    def train_step(carry: tuple[_Weights, optax.OptState], batch: jax.Array) -> tuple[tuple, None]:
        weights, opt_state = carry
        gradient = jax.grad(loss_fn)(weights, batch)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes int32 counts with float32
            updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(weights, updates), opt_state), None

    (weights, _), _ = jax.lax.scan(train_step, (weights, optimizer.init(weights)), batches)
    return _Weights(
        shared=weights.shared,
        surrounding=weights.surrounding * category_factor,
        relation=weights.relation * category_factor,
    )


def detection_counts(sites: Sites) -> np.ndarray:
    """Count looks at the nearest object of each category.

    Returns:
      int64 [2, K, L], number of looks, and number of looks with a detection.
    """
    views = sites.views
    num_poses = len(sites.detected_site)
    num_kinds = (int(views.look.max(initial=0)) // NUM_DISTANCE_BINS + 1) * NUM_DISTANCE_BINS
    counts = np.zeros((2, len(sites.object_sites), num_kinds), np.int64)
    for category, has_object in enumerate(sites.object_sites):
        # Within a horizon the least kind is the nearest look; `num_kinds` stands for poses without a look.
        shows_object = has_object[views.site]
        nearest_look = np.full(num_poses, num_kinds)
        np.minimum.at(nearest_look, views.pose[shows_object], views.look[shows_object])

        is_look = nearest_look < num_kinds
        is_hit = is_look & (sites.detected_site[:, category] >= 0)
        counts[0, category] = np.bincount(nearest_look[is_look], minlength=num_kinds)
        counts[1, category] = np.bincount(nearest_look[is_hit], minlength=num_kinds)
    return counts


def estimate_detection_rates(counts: np.ndarray) -> np.ndarray:
    """Return the probability that a look at an object detects it.

    Args:
      counts: int [2, K, L], see `detection_counts`, summed over scenes.

    Returns:
      float32 [K, L], in (0, 1); close to the mean of all categories for a category that was rarely in view.
    """
    num_looks, num_hits = counts
    mean_rate = (num_hits.sum(axis=0) + 0.5) / (num_looks.sum(axis=0) + 1.0)
    return ((num_hits + PRIOR_LOOKS * mean_rate) / (num_looks + PRIOR_LOOKS)).astype(np.float32)
