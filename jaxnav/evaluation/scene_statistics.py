"""Statistics of scenes: sizes, objects, co-occurrence and path lengths."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.env.objectnav import prior_index
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, seen_together
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import SPLITS, Scene, scene_size
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task


class SceneStatistics(NamedTuple):
    """Hold the statistics of one scene; K categories.

    Attributes:
      scene: the scene.
      cells: number of standable cells.
      size: float64 [2], metres, see `scene_size`.
      objects: int [K], number of objects by category.
      detected: int [K], poses at which a category is detected, of `poses`.
      poses: number of poses.
      together: float64 [K, K], see `seen_together`.
      lengths: int [K, ...], starts (level poses) by category and L*; column 0 counts starts without a path.
    """

    scene: Scene
    cells: int
    size: np.ndarray
    objects: np.ndarray
    detected: np.ndarray
    poses: int
    together: np.ndarray
    lengths: np.ndarray

    @property
    def has_goal(self) -> bool:
        """Return whether a goal can be reached from any start."""
        return bool(self.lengths[:, 1:].any())


class RoomSummary(NamedTuple):
    """Summarize the scenes of one room type.

    Attributes:
      room_type: its name, or `all`.
      splits: number of scenes of each split, in the order of `SPLITS`.
      cells: float64 [5], minimum, quartiles and maximum of the number of standable cells.
      size: float64 [2], medians of width and depth, metres.
      objects: median number of objects.
      known: median number of objects of categories.
    """

    room_type: str
    splits: tuple[int, ...]
    cells: np.ndarray
    size: np.ndarray
    objects: float
    known: float


class CategorySummary(NamedTuple):
    """Summarize the objects of one category.

    Attributes:
      name: of the category.
      share: of the scenes that have such an object, in (0, 1].
      number: mean number of objects in those scenes.
      height: median height of the centre, metres.
      lengths: median and 95th percentile of L* over all starts of all scenes; None if no start has a path.
    """

    name: str
    share: float
    number: float
    height: float
    lengths: tuple[int, int] | None


class PairSummary(NamedTuple):
    """Summarize how often two categories are detected together.

    Probabilities are over all poses of all scenes.

    Attributes:
      rarer, other: names of the categories.
      given: P(other | rarer).
      base: P(other).
      phi: their correlation.
    """

    rarer: str
    other: str
    given: float
    base: float
    phi: float


class PriorFit(NamedTuple):
    """Hold the fit of one room type to its prior.

    Attributes:
      room_type: its name, or `all`.
      gaps: float64 [S], see `layout_gap`, of the scenes that show two categories together.
      similarities: float64 [S], see `layout_similarity`.
    """

    room_type: str
    gaps: np.ndarray
    similarities: np.ndarray


def scene_statistics(scene: Scene, task: Task) -> SceneStatistics:
    """Compile a scene and count what it holds."""
    table, num_categories = compile_scene(scene, task), len(task.categories)
    ids = [category for category in category_ids(scene.types, task.categories) if category >= 0]
    starts = table.best_length[:: len(task.rules.horizons)]
    return SceneStatistics(
        scene=scene,
        cells=len(table.ahead),
        size=scene_size(scene),
        objects=np.bincount(ids, minlength=num_categories),
        detected=RowFormat(num_categories).presence(table.rows).sum(axis=0),
        poses=len(table.rows),
        together=seen_together(table.rows, num_categories),
        lengths=np.stack([np.bincount(lengths, minlength=starts.max() + 1) for lengths in starts.T]),
    )


def room_summaries(statistics: Sequence[SceneStatistics]) -> list[RoomSummary]:
    """Summarize the scenes by room type."""
    summaries = []
    for room_type, scenes in _by_room_type(statistics):
        splits = [s.scene.split for s in scenes]
        objects, known = np.median([(len(s.scene.types), s.objects.sum()) for s in scenes], axis=0)
        cells = np.quantile([s.cells for s in scenes], np.linspace(0, 1, 5))
        size = np.median([s.size for s in scenes], axis=0)
        counts = tuple(splits.count(split) for split in SPLITS)
        summaries.append(RoomSummary(room_type, counts, cells, size, float(objects), float(known)))
    return summaries


def category_summaries(statistics: Sequence[SceneStatistics], task: Task) -> list[CategorySummary]:
    """Summarize the objects of each category that a scene has."""
    counts = np.stack([s.objects for s in statistics])
    ids = [np.array(category_ids(s.scene.types, task.categories), int) for s in statistics]
    lengths = np.zeros((len(task.categories), max(2, *(s.lengths.shape[1] for s in statistics))), int)
    for s in statistics:
        lengths[:, : s.lengths.shape[1]] += s.lengths
    summaries = []
    for k in np.flatnonzero(counts.any(axis=0)):
        present = counts[:, k][counts[:, k] > 0]
        heights = np.concatenate([s.scene.boxes[i == k, 1] for s, i in zip(statistics, ids, strict=True)])
        share, number = len(present) / len(statistics), float(present.mean())
        paths = _percentiles(lengths[k])
        summaries.append(CategorySummary(task.categories[k], share, number, float(np.median(heights)), paths))
    return summaries


def pair_summaries(statistics: Sequence[SceneStatistics], task: Task, count: int) -> list[PairSummary]:
    """Return the pairs of categories whose detections correlate most.

    With P over all poses of all scenes, phi = (P(i, j) - P(i) P(j)) / sqrt(P(i) (1 - P(i)) P(j) (1 - P(j))).

    Returns:
      At most `count` pairs with phi > 0, the greatest first.
    """
    poses = sum(s.poses for s in statistics)
    single = np.sum([s.detected for s in statistics], axis=0) / poses
    both = np.sum([s.together for s in statistics], axis=0) / poses
    spread = np.sqrt(np.outer(single * (1 - single), single * (1 - single)))
    phi = np.divide(both - np.outer(single, single), spread, out=np.zeros_like(both), where=spread > 0)
    rows, columns = np.triu_indices(len(single), 1)
    order = np.argsort(-phi[rows, columns], kind="stable")[:count]
    summaries = []
    for pair in order[phi[rows, columns][order] > 0]:
        i, j = sorted((rows[pair], columns[pair]), key=lambda k: single[k])
        names = task.categories[i], task.categories[j]
        given, base, correlation = float(both[i, j] / single[i]), float(single[j]), float(phi[i, j])
        summaries.append(PairSummary(*names, given, base, correlation))
    return summaries


def prior_fits(statistics: Sequence[SceneStatistics], priors: np.ndarray) -> list[PriorFit]:
    """Compare scenes with the priors of their room types.

    Args:
      statistics: of the scenes.
      priors: real [rooms, K, K], concentrations, in the order of `ROOM_TYPES`, then that of other rooms.
    """
    fits = []
    for room_type, scenes in _by_room_type(statistics):
        shown = [s for s in scenes if s.together.any()]
        gaps = similarities = np.zeros(0)
        if shown:
            rooms = [s.scene.room_type for s in shown]
            prior = priors[[prior_index(room) for room in rooms]]
            together = np.stack([s.together for s in shown])
            gaps, similarities = layout_gap(together, prior), layout_similarity(together, prior)
        fits.append(PriorFit(room_type, gaps, similarities))
    return fits


def _by_room_type(statistics: Sequence[SceneStatistics]) -> Iterator[tuple[str, list[SceneStatistics]]]:
    """Yield scenes by room type, then all of several types."""
    types = sorted({s.scene.room_type for s in statistics})
    yield from ((name, [s for s in statistics if s.scene.room_type == name]) for name in types)
    if len(types) > 1:
        yield "all", list(statistics)


def _percentiles(lengths: np.ndarray) -> tuple[int, int] | None:
    """Return median and 95th percentile of L*.

    `lengths` is int [...], the number of starts by L*; None if no start has a path.
    """
    up_to = np.cumsum(lengths[1:])
    if not up_to[-1]:
        return None
    median, high = 1 + np.searchsorted(up_to, np.array([0.5, 0.95]) * up_to[-1])
    return int(median), int(high)
