"""The exchange of categories that misleads most: the permutation under which the learned layout is worst.

`fit_context_exchange` finds, in the training scenes of a world, which categories exchange their places so that goals
stand where experience least expects them. `jaxnav.scenes.layout_shift.exchange_places` applies the exchange.

Experience is a linear model of what stands at a place, fitted to the training scenes. The score of category k at a
place is b_k + sum over categories j and distances r of w_krj x_rj, where x_rj is 1 if an object of category j stands
within distance r of the place. The softmax of the scores is the probability of each category at the places of objects,
and of "nothing" at random standable cells.

Symbols in shapes: K categories, R distances, M places, N objects.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import detection_range, object_size
from jaxnav.scenes.tables.visibility import cell_centres, clear_of_walls
from jaxnav.scenes.task import Task

#: Distances within which objects count as neighbours of a place, metres.
NEIGHBOUR_DISTANCES = (1.0, 2.0, 4.0)
#: Number of random standable cells of each scene that stand for places without an object.
NUM_EMPTY_PLACES = 60
#: Mean detection range up to which a category counts as small, metres.
SMALL_RANGE = 3.0
#: Factor of the squared weights, added to the mean negative log likelihood.
PLACE_WEIGHT_PENALTY = 1e-3
#: Number of random permutations from which the search for the worst one starts.
NUM_RESTARTS = 16

#: Cycles of categories by room type. In a cycle, objects of every category go to the places of the one before it, those
#: of the first to the places of the last.
ContextExchange = Mapping[str, tuple[tuple[int, ...], ...]]


class Places(NamedTuple):
    """Places of objects, and random standable cells without one.

    Attributes:
      category: int [M], category of the object at the place; K where there is none.
      neighbours: float64 [M, R, K], 1 where an object of a category is within a distance of the place and no wall is
        between them, else 0. An object is no neighbour of its own place.
      mean_range: mean distance from which each category is detected, metres, float64 [K]; NaN for absent ones.
    """

    category: np.ndarray
    neighbours: np.ndarray
    mean_range: np.ndarray


def fit_context_exchange(scenes: Iterable[Scene], task: Task, seed: int = 0) -> ContextExchange:
    """Find the exchange of categories that misleads most, for each room type.

    The score of a permutation is the sum over goals of the mean score of their new places, less that of "nothing":
    how well experience finds the goals after the exchange. The permutation with the lowest score is searched by
    exchanges of two categories, from several random permutations (a quadratic assignment). Goals exchange with goals,
    other categories with other categories, and small ones with small ones (`SMALL_RANGE`).

    Args:
      scenes: training scenes, without a shift. All homes of a world have one room type.
      task: the K categories, and which of them are goals.
      seed: seed of the random permutations and of the random cells.

    Returns:
      The cycles by room type, ordered by the score of each cycle alone, the most misleading first. In rooms without
      cycles, no permutation was found that lowers the score.
    """
    exchange = {}
    for room_type, room_scenes in group_by_room(scenes).items():
        places = find_places(room_scenes, task, np.random.default_rng([seed, 0]))
        exchange[room_type] = find_misleading_cycles(places, task.is_goal(), np.random.default_rng([seed, 1]))
    return exchange


def find_misleading_cycles(
    places: Places, is_goal: np.ndarray, rng: np.random.Generator
) -> tuple[tuple[int, ...], ...]:
    """Find the cycles of the permutation with the lowest score; see `fit_context_exchange`. `is_goal` is bool [K]."""
    num_categories = len(is_goal)
    weights = fit_place_weights(places)

    # Mean neighbours of each category, [K, R, K].
    mean_neighbours = np.zeros((num_categories, len(NEIGHBOUR_DISTANCES), num_categories))
    present = np.flatnonzero(np.isfinite(places.mean_range))
    for category in present:
        mean_neighbours[category] = places.neighbours[places.category == category].mean(axis=0)

    goals = np.intersect1d(present, np.flatnonzero(is_goal))

    def score(place_of: np.ndarray) -> float:
        """Score of a permutation, int [K]: objects of category k stand where those of `place_of[k]` stood."""
        # The intercepts are left out: goals keep theirs under every permutation.
        new_neighbours = mean_neighbours[place_of[goals]][:, :, place_of]
        return float((weights[goals] * new_neighbours).sum())

    # Keep the best of several local minima, and order its cycles by the score of each cycle alone.
    groups = group_exchangeable(places.mean_range, is_goal)
    best_permutation = np.arange(num_categories)
    for _ in range(NUM_RESTARTS):
        permutation = search_permutation(score, groups, num_categories, rng)
        if score(permutation) < score(best_permutation):
            best_permutation = permutation
    cycles = list_cycles(best_permutation)
    cycles.sort(key=lambda cycle: score(apply_cycles([cycle], num_categories)))
    return tuple(cycles)


def draw_exchange(scenes: Iterable[Scene], task: Task, seed: int) -> ContextExchange:
    """Draw an exchange of each room type at random, from all that `fit_context_exchange` searches.

    Args:
      scenes: training scenes, without a shift.
      task: the K categories, and which of them are goals.
      seed: seed of the permutations.
    """
    exchange = {}
    for room_type, room_scenes in group_by_room(scenes).items():
        rng = np.random.default_rng(seed)
        mean_range = find_places(room_scenes, task, rng).mean_range
        permutation = draw_permutation(group_exchangeable(mean_range, task.is_goal()), len(mean_range), rng)
        exchange[room_type] = tuple(list_cycles(permutation))
    return exchange


def group_by_room(scenes: Iterable[Scene]) -> dict[str, list[Scene]]:
    """Group scenes by room type, in alphabetical order."""
    scenes_by_room: dict[str, list[Scene]] = {}
    for scene in scenes:
        scenes_by_room.setdefault(scene.room_type, []).append(scene)
    return dict(sorted(scenes_by_room.items()))


def group_exchangeable(mean_range: np.ndarray, is_goal: np.ndarray) -> list[list[int]]:
    """Group the categories that may exchange with each other: goals or others, small or large.

    Args:
      mean_range: mean detection range of each category, metres, float64 [K]; NaN for absent ones.
      is_goal: bool [K].
    """
    present = np.flatnonzero(np.isfinite(mean_range)).tolist()
    is_small = mean_range <= SMALL_RANGE
    groups = []
    for group_class in range(4):
        groups.append([k for k in present if 2 * is_goal[k] + is_small[k] == group_class])
    return groups


def draw_permutation(groups: Sequence[Sequence[int]], num_categories: int, rng: np.random.Generator) -> np.ndarray:
    """Draw a permutation within groups, int [K]."""
    permutation = np.arange(num_categories)
    for group in groups:
        permutation[list(group)] = rng.permutation(group)
    return permutation


def search_permutation(
    score: Callable[[np.ndarray], float],
    groups: Sequence[Sequence[int]],
    num_categories: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Descend from a random permutation within groups by the best exchange of two, until none lowers the score."""
    permutation = draw_permutation(groups, num_categories, rng)
    pairs = [(first, second) for group in groups for i, first in enumerate(group) for second in group[i + 1 :]]
    best_score = score(permutation)
    while True:
        # Try every exchange of two categories of a group, and take the best.
        candidates = []
        for first, second in pairs:
            candidate = permutation.copy()
            candidate[[first, second]] = permutation[[second, first]]
            candidates.append(candidate)
        scores = [score(candidate) for candidate in candidates]
        if not scores or min(scores) >= best_score - 1e-9:
            return permutation
        best_score = min(scores)
        permutation = candidates[int(np.argmin(scores))]


def apply_cycles(cycles: Iterable[Sequence[int]], num_categories: int) -> np.ndarray:
    """Permutation of cycles, int [K]: the category whose places each one gets."""
    place_of = np.arange(num_categories)
    for cycle in cycles:
        place_of[list(cycle)] = np.roll(cycle, 1)
    return place_of


def list_cycles(place_of: np.ndarray) -> list[tuple[int, ...]]:
    """List the cycles of a permutation, without categories that stay; the inverse of `apply_cycles`."""
    # Follow each category to the one that takes its places, until the cycle closes.
    next_of = np.argsort(place_of)
    remaining = set(range(len(place_of)))
    cycles = []
    while remaining:
        cycle = [min(remaining)]
        while next_of[cycle[-1]] != cycle[0]:
            cycle.append(int(next_of[cycle[-1]]))
        remaining -= set(cycle)
        if len(cycle) > 1:
            cycles.append(tuple(cycle))
    return cycles


def fit_place_weights(places: Places) -> np.ndarray:
    """Fit the model of what stands at a place; returns the weights less those of "nothing", float64 [K, R, K]."""
    from scipy.optimize import minimize  # slow to import

    num_places, num_distances, num_categories = places.neighbours.shape
    features = places.neighbours.reshape(num_places, -1)
    features = np.concatenate([features, np.ones((num_places, 1))], axis=1)
    labels = np.eye(num_categories + 1)[places.category]
    is_penalized = np.append(np.ones(features.shape[1] - 1), 0.0)  # all but the intercept

    def loss_and_gradient(flat_weights: np.ndarray) -> tuple[float, np.ndarray]:
        # Mean cross-entropy with the penalty, and its gradient.
        weights = flat_weights.reshape(num_categories + 1, -1)
        scores = features @ weights.T
        scores -= scores.max(axis=1, keepdims=True)
        log_probabilities = scores - np.log(np.exp(scores).sum(axis=1, keepdims=True))
        loss = (
            -(labels * log_probabilities).sum() / num_places + PLACE_WEIGHT_PENALTY * (is_penalized * weights**2).sum()
        )
        gradient = (np.exp(log_probabilities) - labels).T @ features / num_places
        return loss, (gradient + 2 * PLACE_WEIGHT_PENALTY * is_penalized * weights).ravel()

    start = np.zeros((num_categories + 1) * features.shape[1])
    result = minimize(loss_and_gradient, start, jac=True, method="L-BFGS-B", options={"maxiter": 300})
    weights = result.x.reshape(num_categories + 1, -1)[:, :-1]
    return (weights[:-1] - weights[-1]).reshape(num_categories, num_distances, num_categories)


def find_places(scenes: Iterable[Scene], task: Task, rng: np.random.Generator) -> Places:
    """Find the places of all objects of the categories, and random standable cells of each scene."""
    num_categories = len(task.categories)
    categories = []
    neighbours = []
    range_sums = np.zeros(num_categories)
    for scene in scenes:
        # Objects first, then empty cells: `_find_neighbours` relies on this order.
        object_category = np.array(category_ids(scene.types, task.categories), int)
        boxes = scene.boxes[object_category >= 0]
        object_category = object_category[object_category >= 0]
        np.add.at(range_sums, object_category, detection_range(object_size(boxes)))

        cells = cell_centres(scene, standable_cells(scene.reach))
        empty_places = rng.permutation(cells)[:NUM_EMPTY_PLACES]
        positions = np.concatenate([boxes[:, [0, 2]], empty_places])
        categories.append(np.append(object_category, np.full(len(empty_places), num_categories)))
        neighbours.append(_find_neighbours(scene, positions, boxes[:, [0, 2]], object_category, num_categories))

    category = np.concatenate(categories)
    counts = np.bincount(category, minlength=num_categories + 1)[:num_categories]
    mean_range = np.divide(range_sums, counts, out=np.full(num_categories, np.nan), where=counts > 0)
    return Places(category, np.concatenate(neighbours), mean_range)


def _find_neighbours(
    scene: Scene, positions: np.ndarray, objects: np.ndarray, object_category: np.ndarray, num_categories: int
) -> np.ndarray:
    """Neighbours of places, float64 [M, R, K]; the first N of the M positions are those of the N objects."""
    distance = np.linalg.norm(positions[:, None] - objects, axis=-1)
    own_place = np.arange(len(objects))
    distance[own_place, own_place] = np.inf

    # Objects behind walls are no neighbours.
    place, other = np.nonzero(distance <= NEIGHBOUR_DISTANCES[-1])
    is_hidden = ~clear_of_walls(scene, positions[place], objects[other], objects[other])
    distance[place[is_hidden], other[is_hidden]] = np.inf

    membership = np.eye(num_categories)[object_category]  # [N, K]
    by_distance = [(distance <= limit) @ membership > 0 for limit in NEIGHBOUR_DISTANCES]
    return np.stack(by_distance, axis=1).astype(float)
