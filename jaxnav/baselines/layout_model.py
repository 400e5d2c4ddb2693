"""Where a goal may stand, given what has been detected: a fitted prior.

The score of site n for goal k is b[k] . s(n) + sum over categories j and relations r of W[k, j, r] f(j, r, n), where s
are the surroundings and f is 1 if a j has been detected at a site in relation r. The prior is the softmax over the
sites. It is fitted as a conditional likelihood: with the looks in vain so far it should foretell where the goals are.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnav.baselines.sites import BINS, NUM_RELATIONS, NUM_SURROUNDINGS, Sites

STEPS, BATCH, LEARNING_RATE = 1500, 32, 0.02
PENALTY = 1e-3  # of the squared weights, against the mean log likelihood
TRIES = 2.0  # looks that the mean rate counts for where a category was rarely in view


class LayoutModel(NamedTuple):
    """Hold the weights of the score for K goals.

    Attributes:
      relation: float32 [K, K, 3], W: goal, detected category, relation.
      surrounding: float32 [K, 3], b.
    """

    relation: np.ndarray
    surrounding: np.ndarray

    def scores(self, goal: int, features: np.ndarray, sites: Sites) -> np.ndarray:
        """Return the scores of the sites, float32 [N].

        Args:
          goal: index of the category.
          features: bool [K, 3, N], f.
          sites: of the scene.
        """
        return np.tensordot(self.relation[goal], features, 2) + self.surrounding[goal] @ sites.surroundings


class Glimpse(NamedTuple):
    """Hold what a searcher knows at some time.

    Attributes:
      sites: of its scene.
      features: bool [K, 3, N], see `LayoutModel.scores`.
      looks: uint16 [L, N], how often it has looked at a site in each way.
      detected: bool [K], the categories detected so far.
    """

    sites: Sites
    features: np.ndarray
    looks: np.ndarray
    detected: np.ndarray


def flat(categories: int) -> LayoutModel:
    """Return the model that thinks all sites equally likely."""
    return LayoutModel(
        np.zeros((categories, categories, NUM_RELATIONS), np.float32),
        np.zeros((categories, NUM_SURROUNDINGS), np.float32),
    )


def detection_counts(sites: Sites) -> np.ndarray:
    """Count looks at the nearest object of each category.

    Returns:
      int64 [2, K, L], looks, and those with a detection.
    """
    views, num_poses = sites.views, len(sites.seen)
    num_looks = (int(views.look.max(initial=0)) // BINS + 1) * BINS
    counts = np.zeros((2, len(sites.objects), num_looks), np.int64)
    for category, there in enumerate(sites.objects):
        at, nearest = there[views.site], np.full(num_poses, num_looks)
        np.minimum.at(nearest, views.pose[at], views.look[at])
        looked = nearest < num_looks
        hit = looked & (sites.seen[:, category] >= 0)
        counts[:, category] = [np.bincount(nearest[mask], minlength=num_looks) for mask in (looked, hit)]
    return counts


def detection_rates(counts: np.ndarray) -> np.ndarray:
    """Return how often a look at an object detects it.

    Args:
      counts: int [2, K, L], summed over scenes.

    Returns:
      float32 [K, L], above 0 and below 1; near the mean of all categories for one that was rarely in view.
    """
    looks, hits = counts
    mean = (hits.sum(axis=0) + 0.5) / (looks.sum(axis=0) + 1.0)
    return ((hits + TRIES * mean) / (looks + TRIES)).astype(np.float32)


def fit(glimpses: Sequence[Glimpse], rates: np.ndarray, *, relations: bool = True, seed: int = 0) -> LayoutModel:
    """Fit the model to where the goals were.

    Args:
      glimpses: of searches in training scenes.
      rates: float32 [K, L], see `detection_rates`.
      relations: whether categories matter; if not, all goals share the weights of the surroundings, and what is
        detected says nothing.
      seed: of the order of the examples.
    """
    categories = len(rates)
    sought = [glimpse.sites.objects.any(axis=1) & ~glimpse.detected for glimpse in glimpses]
    pairs = np.argwhere(sought).astype(np.int32)  # glimpse, goal
    order = np.random.default_rng(seed).integers(len(pairs), size=(STEPS, BATCH))
    weights = _Weights(
        shared=jnp.zeros(NUM_SURROUNDINGS),
        surrounding=jnp.zeros((categories, NUM_SURROUNDINGS)),
        relation=jnp.zeros((categories, categories, NUM_RELATIONS)),
    )
    fitted = _descend(weights, _examples(glimpses), jnp.log1p(-rates), pairs[order], jnp.float32(relations))
    return LayoutModel(np.asarray(fitted.relation), np.asarray(fitted.shared[None] + fitted.surrounding))


class _Weights(NamedTuple):
    """Hold what is fitted.

    Attributes:
      shared: float32 [3], of the surroundings, for all goals; free.
      surrounding: float32 [K, 3], what a goal differs by; drawn to 0.
      relation: float32 [K, K, 3]; drawn to 0.
    """

    shared: jax.Array
    surrounding: jax.Array
    relation: jax.Array


class _Examples(NamedTuple):
    """Hold G glimpses, filled up to M sites.

    Attributes:
      features: bool [G, K, 3, M].
      looks: uint16 [G, L, M].
      surroundings: float32 [G, 3, M].
      there: bool [G, K, M], where the objects are.
      real: bool [G, M], whether there is a site.
    """

    features: jax.Array
    looks: jax.Array
    surroundings: jax.Array
    there: jax.Array
    real: jax.Array


def _examples(glimpses: Sequence[Glimpse]) -> _Examples:
    most = max(glimpse.features.shape[-1] for glimpse in glimpses)

    def filled(arrays: Iterable[np.ndarray]) -> jax.Array:
        rows = [np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, most - array.shape[-1])]) for array in arrays]
        return jnp.asarray(np.stack(rows))

    return _Examples(
        features=filled(glimpse.features for glimpse in glimpses),
        looks=filled(glimpse.looks for glimpse in glimpses),
        surroundings=filled(glimpse.sites.surroundings for glimpse in glimpses),
        there=filled(glimpse.sites.objects for glimpse in glimpses),
        real=filled(np.ones(glimpse.features.shape[-1], bool) for glimpse in glimpses),
    )


@jax.jit
def _descend(
    weights: _Weights, examples: _Examples, in_vain: jax.Array, order: jax.Array, relations: jax.Array
) -> _Weights:
    """Return the weights after Adam's steps.

    Args:
      weights: to begin with.
      examples: of G glimpses.
      in_vain: float32 [K, L], log probability that a look at the goal does not detect it.
      order: int32 [steps, B, 2], glimpse and goal of each example.
      relations: float32, 1 or 0, factor of all weights that differ between categories.
    """
    optimiser = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, STEPS))

    def loss(weights: _Weights, batch: jax.Array) -> jax.Array:
        glimpse, goal = batch.T
        surrounding = weights.shared[None] + relations * weights.surrounding[goal]
        scores = jnp.einsum("bu,bun->bn", surrounding, examples.surroundings[glimpse])
        relation, features = relations * weights.relation[goal], examples.features[glimpse].astype(jnp.float32)
        scores += jnp.einsum("bjr,bjrn->bn", relation, features)
        scores += jnp.einsum("bl,bln->bn", in_vain[goal], examples.looks[glimpse].astype(jnp.float32))
        scores = jnp.where(examples.real[glimpse], scores, -jnp.inf)
        there = jax.nn.logsumexp(scores, axis=1, where=examples.there[glimpse, goal])
        squares = jnp.square(weights.surrounding).sum() + jnp.square(weights.relation).sum()
        return (jax.nn.logsumexp(scores, axis=1) - there).mean() + PENALTY * squares

    def step(carry: tuple[_Weights, optax.OptState], batch: jax.Array) -> tuple[tuple, None]:
        weights, state = carry
        gradient = jax.grad(loss)(weights, batch)
        with jax.numpy_dtype_promotion("standard"):  # optax counts in int32 beside float32
            updates, state = optimiser.update(gradient, state)
        return (optax.apply_updates(weights, updates), state), None

    (weights, _), _ = jax.lax.scan(step, (weights, optimiser.init(weights)), order)
    return jax.tree.map(lambda leaf: leaf * relations, weights)._replace(shared=weights.shared)
