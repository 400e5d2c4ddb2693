"""Statistics of scenes: sizes, objects, co-occurrence and path lengths.

`compute_scene_statistics` compiles one scene and counts its content. The `summarize_...` functions and `fit_priors`
combine the statistics of many scenes into the rows of tables.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.env.objectnav import prior_index
from jaxnav.evaluation.similarity import count_co_detections, scene_layout_gap, scene_layout_similarity
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import SPLITS, Scene, scene_size
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task


class SceneStatistics(NamedTuple):
    """Statistics of one scene with K categories.

    Attributes:
      scene: the scene.
      num_cells: number of standable cells.
      size: float64 [2], metres, see `scene_size`.
      num_objects: int [K], number of objects of each category.
      num_detected: int [K], number of poses at which each category is detected.
      num_poses: number of poses.
      co_detections: float64 [K, K], see `count_co_detections`.
      path_lengths: int [K, ...], number of starts (level poses) by category and L*; column 0 counts starts without a
        path.
    """

    scene: Scene
    num_cells: int
    size: np.ndarray
    num_objects: np.ndarray
    num_detected: np.ndarray
    num_poses: int
    co_detections: np.ndarray
    path_lengths: np.ndarray

    @property
    def has_goal(self) -> bool:
        """True if some start has a path to a goal."""
        return bool(self.path_lengths[:, 1:].any())


class RoomSummary(NamedTuple):
    """Summary of the scenes of one room type.

    Attributes:
      room_type: name of the room type, or `all`.
      splits: number of scenes of each split, in the order of `SPLITS`.
      cells: float64 [5], minimum, quartiles and maximum of the number of standable cells.
      size: float64 [2], medians of width and depth, metres.
      num_objects: median number of objects.
      num_categorized: median number of objects that belong to a category.
    """

    room_type: str
    splits: tuple[int, ...]
    cells: np.ndarray
    size: np.ndarray
    num_objects: float
    num_categorized: float


class CategorySummary(NamedTuple):
    """Summary of the objects of one category.

    Attributes:
      name: name of the category.
      share: share of the scenes that contain the category, in (0, 1].
      number: mean number of objects in those scenes.
      height: median height of the centre, metres.
      path_lengths: median and 95th percentile of L* over all starts of all scenes; None if no start has a path.
    """

    name: str
    share: float
    number: float
    height: float
    path_lengths: tuple[int, int] | None


class PairSummary(NamedTuple):
    """Co-detection of two categories over all poses of all scenes.

    Attributes:
      rarer, other: names of the categories.
      conditional: P(other | rarer).
      marginal: P(other).
      phi: correlation of the two detections.
    """

    rarer: str
    other: str
    conditional: float
    marginal: float
    phi: float


class PriorFit(NamedTuple):
    """Fit of the scenes of one room type to the prior.

    Attributes:
      room_type: name of the room type, or `all`.
      gaps: float64 [S], see `scene_layout_gap`, of the scenes with co-occurrence.
      similarities: float64 [S], see `scene_layout_similarity`.
    """

    room_type: str
    gaps: np.ndarray
    similarities: np.ndarray


def compute_scene_statistics(scene: Scene, task: Task) -> SceneStatistics:
    """Compile a scene and count its content."""
    # Objects whose type belongs to no category have the id -1 and are not counted.
    scene_table = compile_scene(scene, task)
    num_categories = len(task.categories)
    known_ids = []
    for category in category_ids(scene.types, task.categories):
        if category >= 0:
            known_ids.append(category)

    # Histogram of L* for each category, over level poses only.
    start_lengths = scene_table.best_length[:: len(task.rules.horizons)]  # [starts, K]
    num_lengths = start_lengths.max() + 1
    path_lengths = np.stack([np.bincount(lengths, minlength=num_lengths) for lengths in start_lengths.T])

    return SceneStatistics(
        scene=scene,
        num_cells=len(scene_table.ahead),
        size=scene_size(scene),
        num_objects=np.bincount(known_ids, minlength=num_categories),
        num_detected=RowFormat(num_categories).presence(scene_table.rows).sum(axis=0),
        num_poses=len(scene_table.rows),
        co_detections=count_co_detections(scene_table.rows, num_categories),
        path_lengths=path_lengths,
    )


def summarize_rooms(statistics: Sequence[SceneStatistics]) -> list[RoomSummary]:
    """Summarize the scenes of each room type."""
    summaries = []
    for room_type, room_scenes in _group_by_room_type(statistics):
        split_names = [scene.scene.split for scene in room_scenes]
        cell_counts = [scene.num_cells for scene in room_scenes]
        object_counts = [len(scene.scene.types) for scene in room_scenes]
        categorized_counts = [scene.num_objects.sum() for scene in room_scenes]

        # Medians and quartiles, because sizes of scenes are skewed.
        room_summary = RoomSummary(
            room_type=room_type,
            splits=tuple(map(split_names.count, SPLITS)),
            cells=np.quantile(cell_counts, np.linspace(0, 1, 5)),
            size=np.median([scene.size for scene in room_scenes], axis=0),
            num_objects=float(np.median(object_counts)),
            num_categorized=float(np.median(categorized_counts)),
        )
        summaries.append(room_summary)
    return summaries


def summarize_categories(statistics: Sequence[SceneStatistics], task: Task) -> list[CategorySummary]:
    """Summarize the objects of each category that occurs in some scene."""
    object_counts = np.stack([scene.num_objects for scene in statistics])  # [N, K]

    # Category and height of all objects of all scenes, and the length of the longest histogram of L*.
    id_parts = []
    height_parts = []
    max_lengths = 2
    for scene_statistics in statistics:
        id_parts.append(category_ids(scene_statistics.scene.types, task.categories))
        height_parts.append(scene_statistics.scene.boxes[:, 1])
        max_lengths = max(max_lengths, scene_statistics.path_lengths.shape[1])
    object_ids = np.concatenate(id_parts)
    object_heights = np.concatenate(height_parts)

    # Sum the histograms of L*, which differ in length between scenes, into [K, max_lengths].
    path_lengths = np.zeros((len(task.categories), max_lengths), int)
    for scene_statistics in statistics:
        path_lengths[:, : scene_statistics.path_lengths.shape[1]] += scene_statistics.path_lengths

    # Share, number and height refer to the scenes that contain the category.
    summaries = []
    for category in np.flatnonzero(object_counts.any(axis=0)):
        present_counts = object_counts[:, category][object_counts[:, category] > 0]
        category_summary = CategorySummary(
            name=task.categories[category],
            share=len(present_counts) / len(statistics),
            number=float(present_counts.mean()),
            height=float(np.median(object_heights[object_ids == category])),
            path_lengths=_median_and_95th_percentile(path_lengths[category]),
        )
        summaries.append(category_summary)
    return summaries


def summarize_pairs(statistics: Sequence[SceneStatistics], task: Task, count: int) -> list[PairSummary]:
    """Find the pairs of categories whose detections correlate most.

    Pairs are among the categories that some scene contains; any other category is detected by false alarms alone.

    With P over all poses of all scenes, phi = (P(i, j) - P(i) P(j)) / sqrt(P(i) (1 - P(i)) P(j) (1 - P(j))).

    Returns:
      At most `count` pairs with phi > 0, the greatest first.
    """
    # Pool the poses of all scenes.
    num_poses = sum(scene.num_poses for scene in statistics)

    # P(i) [K] and P(i, j) [K, K].
    marginal_share = np.sum([scene.num_detected for scene in statistics], axis=0) / num_poses
    joint_share = np.sum([scene.co_detections for scene in statistics], axis=0) / num_poses

    # Categories with an object in some scene, bool [K].
    is_present = np.sum([scene.num_objects for scene in statistics], axis=0) > 0
    can_correlate = np.outer(is_present, is_present)

    # Correlation [K, K]; 0 for a category that is never, or always, detected, or only by false alarms.
    spread = np.sqrt(np.outer(marginal_share * (1 - marginal_share), marginal_share * (1 - marginal_share)))
    covariance = joint_share - np.outer(marginal_share, marginal_share)
    phi = np.divide(covariance, spread, out=np.zeros_like(joint_share), where=can_correlate & (spread > 0))

    # Rank the pairs i < j by phi.
    row_ids, column_ids = np.triu_indices(len(marginal_share), 1)
    pair_phi = phi[row_ids, column_ids]
    best_pairs = np.argsort(-pair_phi, kind="stable")[:count]

    # P(other | rarer) is the informative direction, so the rarer category of a pair comes first.
    summaries = []
    for pair in best_pairs[pair_phi[best_pairs] > 0]:
        rarer, other = sorted((row_ids[pair], column_ids[pair]), key=lambda category: marginal_share[category])
        pair_summary = PairSummary(
            rarer=task.categories[rarer],
            other=task.categories[other],
            conditional=float(joint_share[rarer, other] / marginal_share[rarer]),
            marginal=float(marginal_share[other]),
            phi=float(phi[rarer, other]),
        )
        summaries.append(pair_summary)
    return summaries


def fit_priors(statistics: Sequence[SceneStatistics], priors: np.ndarray) -> list[PriorFit]:
    """Compare the scenes of each room type with the priors of their room types.

    Args:
      statistics: statistics of the scenes.
      priors: real [rooms, K, K], concentrations, in the order of `ROOM_TYPES`, followed by the prior of other rooms.
    """
    fits = []
    for room_type, room_scenes in _group_by_room_type(statistics):
        # A scene where no two categories are seen together has no layout to compare.
        scene_counts = []
        prior_indices = []
        for scene_statistics in room_scenes:
            if scene_statistics.co_detections.any():
                scene_counts.append(scene_statistics.co_detections)
                prior_indices.append(prior_index(scene_statistics.scene.room_type))

        # Each scene is compared with the prior of its own room type, both [S, K, K].
        if scene_counts:
            prior = priors[prior_indices]
            counts = np.stack(scene_counts)
            fit = PriorFit(room_type, scene_layout_gap(counts, prior), scene_layout_similarity(counts, prior))
        else:
            fit = PriorFit(room_type, np.zeros(0), np.zeros(0))
        fits.append(fit)
    return fits


def _group_by_room_type(statistics: Sequence[SceneStatistics]) -> Iterator[tuple[str, list[SceneStatistics]]]:
    """Yield the scenes of each room type; with several types, all scenes last."""
    scenes_by_type: dict[str, list[SceneStatistics]] = {}
    for scene_statistics in statistics:
        scenes_by_type.setdefault(scene_statistics.scene.room_type, []).append(scene_statistics)

    for room_type in sorted(scenes_by_type):
        yield room_type, scenes_by_type[room_type]
    if len(scenes_by_type) > 1:
        yield "all", list(statistics)


def _median_and_95th_percentile(path_lengths: np.ndarray) -> tuple[int, int] | None:
    """Compute two percentiles of L* from a histogram of starts, int [...]; None if no start has a path."""
    cumulative_starts = np.cumsum(path_lengths[1:])  # column 0 counts starts without a path
    num_starts = cumulative_starts[-1]
    if not num_starts:
        return None

    # The shortest lengths that at least 50 % and 95 % of the starts do not exceed.
    median_length, high_length = 1 + np.searchsorted(cumulative_starts, np.array([0.5, 0.95]) * num_starts)
    return int(median_length), int(high_length)
