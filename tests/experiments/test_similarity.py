"""Relations of success and gain to layout similarity, checked by hand, by SciPy, by plain loops and on noise."""

import functools

import numpy as np
import pytest
from scipy.spatial.distance import cosine
from scipy.stats import linregress, pearsonr, spearmanr
from support.episodes import episodes_in
from support.intervals import bounds, student_interval, two_way_jackknife_interval

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import correlation_interval, scene_clusters
from jaxnav.experiments.similarity import (
    GainBySimilarity,
    SimilarityPoints,
    SuccessBySimilarity,
    compute_similarity_points,
    gain_of_table,
    gain_rows,
    relate_gain_to_similarity,
    relate_success_to_similarity,
    success_of_table,
    success_rows,
)
from jaxnav.experiments.table import ResultTable, read_part, write_part

CATEGORIES = ("Book", "Chair", "Pan", "Sink")
NUM_CATEGORIES = len(CATEGORIES)


def draw_scenes(
    seed: int = 0, num_scenes: int = 12, episodes_per_scene: int = 10
) -> tuple[EpisodeList, np.ndarray, np.ndarray]:
    """Random episodes, counts of scenes and a prior."""
    rng = np.random.default_rng(seed)
    shape = (num_scenes, NUM_CATEGORIES, NUM_CATEGORIES)
    counts = rng.integers(0, 20, shape) * rng.integers(0, 2, shape)
    prior = np.broadcast_to(rng.integers(1, 20, shape[1:]), shape)
    scene = np.repeat(np.arange(num_scenes), episodes_per_scene)
    return episodes_in(scene, rng.integers(0, NUM_CATEGORIES, len(scene))), counts, prior


def draw_points(seed: int = 0, num_scenes: int = 12) -> SimilarityPoints:
    return compute_similarity_points(*draw_scenes(seed, num_scenes))


def draw_success(seed: int, num_runs: int, points: SimilarityPoints, chance: float = 0.5) -> np.ndarray:
    return np.random.default_rng(seed).random((num_runs, len(points.episodes.goal))) < chance


def is_of_point(points: SimilarityPoints, scene: int, category: int) -> np.ndarray:
    """True for the episodes with a point's goal in its scene, bool [E]."""
    return (points.episodes.scene == scene) & (points.episodes.goal == category)


def similarity_by_episode(points: SimilarityPoints, default: float) -> np.ndarray:
    """Similarity of each episode's point, [E]; the default for episodes without a point."""
    similarity = np.full(len(points.episodes.goal), default)
    for scene, category, value in zip(points.scene, points.category, points.similarity, strict=True):
        similarity[is_of_point(points, scene, category)] = value
    return similarity


# Success (Fig. 4)


def test_points_and_correlation_are_as_worked():
    # In scene 0, category 0 co-occurs with 1 and 2 as in training: cosine 1. Category 1 co-occurs with 2 only, but in
    # training equally with 0 and 2: (0, 1) . (1, 1) / (1 * sqrt 2) = 0.7071. Category 2 has no counts, so no point.
    counts = np.array([[[0, 1, 2], [0, 0, 5], [0, 0, 0]]])
    prior = np.array([[[0, 10, 20], [30, 0, 30], [1, 1, 0]]])
    points = compute_similarity_points(episodes_in([0] * 6, [1, 0, 1, 2, 1, 0]), counts, prior)
    assert points.category.tolist() == [0, 1]
    assert points.scene.tolist() == [0, 0]
    assert points.num_episodes.tolist() == [2, 3]
    assert points.similarity == pytest.approx([1, np.sqrt(0.5)])

    # Two runs: category 0 succeeds 0 + 1 and 1 + 1 times of 2 + 2, category 1 1 + 0 + 0 and 1 + 1 + 0 times of 3 + 3.
    success = np.array([[1, 0, 0, 1, 0, 1], [1, 1, 1, 1, 0, 1]])
    relation = relate_success_to_similarity(points, success)
    assert relation.success == pytest.approx([3 / 4, 3 / 6])

    # Two points make a line; a single scene has no interval.
    for correlation in (relation.pearson, relation.spearman):
        assert correlation.mean == pytest.approx(1)
        assert not correlation.has_bounds


@pytest.mark.parametrize("seed", range(3))
def test_a_point_weighs_as_much_as_its_episodes(seed):
    episodes, counts, prior = draw_scenes(seed)
    points = compute_similarity_points(episodes, counts, prior)
    success = draw_success(seed, 3, points)
    relation = relate_success_to_similarity(points, success)

    # Every point by SciPy, from the co-occurrence of its category with all others.
    for index, (scene, category) in enumerate(zip(points.scene, points.category, strict=True)):
        is_other = np.arange(NUM_CATEGORIES) != category
        members = is_of_point(points, scene, category)
        distance = cosine(counts[scene, category, is_other], prior[scene, category, is_other])
        assert relation.similarity[index] == pytest.approx(1 - distance)
        assert relation.success[index] == pytest.approx(success[:, members].mean())
        assert relation.episodes[index] == members.sum()

    # SciPy has no weights, so every point is repeated once per episode.
    similarity = np.repeat(relation.similarity, relation.episodes)
    rates = np.repeat(relation.success, relation.episodes)
    assert relation.pearson.mean == pytest.approx(pearsonr(similarity, rates)[0])
    assert relation.spearman.mean == pytest.approx(spearmanr(similarity, rates)[0])
    assert relation.pearson.has_bounds
    assert relation.spearman.has_bounds


def test_the_interval_of_success_is_that_of_a_plain_loop():
    """The loop leaves out each scene, each training run, and each pair of a scene and a run."""
    num_scenes = 8
    num_runs = 3
    points = draw_points(num_scenes=num_scenes)
    success = draw_success(1, num_runs, points, chance=0.4)
    relation = relate_success_to_similarity(points, success)

    def fisher_z_without(correlate, left_out_scene, left_out_run) -> float:
        """Fisher's z of the remaining points, each repeated once per episode."""
        remaining_runs = np.arange(num_runs) != left_out_run
        similarity = []
        rates = []
        for index, (scene, category) in enumerate(zip(points.scene, points.category, strict=True)):
            if scene != left_out_scene:
                rate = success[remaining_runs][:, is_of_point(points, scene, category)].mean()
                similarity += [points.similarity[index]] * points.num_episodes[index]
                rates += [rate] * points.num_episodes[index]
        return np.arctanh(correlate(similarity, rates)[0])

    # The bounds are those of z, transformed back.
    for interval, correlate in ((relation.pearson, pearsonr), (relation.spearman, spearmanr)):
        expected_z = two_way_jackknife_interval(functools.partial(fisher_z_without, correlate), num_scenes, num_runs)
        assert bounds(interval) == pytest.approx(np.tanh(expected_z))


def test_training_runs_that_disagree_widen_the_interval_of_success():
    # The slope of success over similarity is 0.2 in two equal runs, or 0.8 in one run and -0.4 in the other. The mean
    # over the runs is equal, but further runs would differ in the second case.
    points = draw_points()
    similarity = similarity_by_episode(points, default=0.5)
    noise = np.random.default_rng(4).normal(0, 0.05, len(similarity))
    equal_success = np.stack([0.5 + 0.2 * similarity + noise] * 2)
    opposite_success = equal_success + np.stack([0.6 * similarity, -0.6 * similarity])
    equal_relation = relate_success_to_similarity(points, equal_success)
    opposite_relation = relate_success_to_similarity(points, opposite_success)
    for name in ("pearson", "spearman"):
        assert getattr(equal_relation, name).mean == pytest.approx(getattr(opposite_relation, name).mean)
        assert getattr(equal_relation, name).low > 0.5
        assert getattr(opposite_relation, name).low < -0.5

    # Further equal runs do not change the interval.
    repeated_relation = relate_success_to_similarity(points, equal_success[[0, 1, 0, 1]])
    assert bounds(equal_relation.pearson) == pytest.approx(bounds(repeated_relation.pearson))


def test_room_types_keep_their_shares():
    # If a scene is left out, the remaining scenes of its room type get its weight.
    episodes, counts, prior = draw_scenes(num_scenes=7)
    room = np.array([0, 1, 0, 1, 1, 0, 1])
    episodes = episodes._replace(room=room[episodes.scene])
    points = compute_similarity_points(episodes, counts, prior)
    success = np.repeat(draw_success(1, 1, points, chance=0.4), 2, axis=0)  # equal runs, so only scenes vary
    relation = relate_success_to_similarity(points, success)

    def pearson_without(left_out_scene: int) -> float:
        same_room = room == room[left_out_scene]
        scene_weights = np.where(same_room, same_room.sum() / (same_room.sum() - 1), 1.0)
        scene_weights[left_out_scene] = 0.0
        point_weights = relation.episodes * scene_weights[points.scene]
        covariance = np.cov(relation.similarity, relation.success, aweights=point_weights)
        return covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])

    # Jackknife variance of Fisher's z within each of the two strata: 7 scenes - 2 degrees of freedom.
    room_sizes = np.bincount(room)[room]
    fisher_z = np.arctanh(relation.pearson.mean)
    squares = np.array([(np.arctanh(pearson_without(scene)) - fisher_z) ** 2 for scene in range(7)])
    variance = ((room_sizes - 1) / room_sizes * squares).sum()
    assert bounds(relation.pearson) == pytest.approx(np.tanh(student_interval(fisher_z, variance, 7 - 2)))


def test_only_success_that_follows_similarity_correlates():
    points = draw_points(num_scenes=30)
    chance = similarity_by_episode(points, default=np.sqrt(0.5)) ** 2
    draws = np.random.default_rng(2).random((5, len(chance)))
    rising_relation = relate_success_to_similarity(points, draws < chance)
    level_relation = relate_success_to_similarity(points, draws < 0.5)
    assert rising_relation.pearson.low > 0.3
    assert rising_relation.spearman.low > 0.3
    assert level_relation.pearson.low < 0 < level_relation.pearson.high
    assert level_relation.spearman.low < 0 < level_relation.spearman.high


def test_equal_success_has_no_correlation():
    points = draw_points()
    relation = relate_success_to_similarity(points, np.ones((2, len(points.episodes.goal))))
    for correlation in (relation.pearson, relation.spearman):
        assert np.isnan(correlation.mean)
        assert not correlation.has_bounds


# Gain (Fig. 5)


@pytest.mark.parametrize("seed", range(3))
def test_gain_is_averaged_by_category(seed):
    points = draw_points(seed)
    goal = points.episodes.goal
    baseline = draw_success(seed, 3, points, chance=0.5)
    variant = draw_success(seed + 10, 3, points, chance=0.6)
    relation = relate_gain_to_similarity(points, baseline, variant, CATEGORIES)

    # Only episodes with a similarity count.
    has_point = ~np.isnan(similarity_by_episode(points, default=np.nan))
    category_indices = sorted(set(goal[has_point]))
    assert relation.categories == tuple(CATEGORIES[category] for category in category_indices)
    num_episodes = []
    for index, category in enumerate(category_indices):
        members = has_point & (goal == category)
        category_points = points.category == category
        similarity = np.average(points.similarity[category_points], weights=points.num_episodes[category_points])
        num_episodes.append(members.sum())
        assert relation.similarity[index] == pytest.approx(similarity)
        assert relation.baseline[index] == pytest.approx(100 * baseline[:, members].mean())
        gain = variant[:, members].mean() - baseline[:, members].mean()
        assert relation.gain[index] == pytest.approx(100 * gain)

    # A line through the categories, each repeated as often as it has episodes.
    line = linregress(np.repeat(relation.similarity, num_episodes), np.repeat(relation.gain, num_episodes))
    slope, _, pearson, *_ = np.asarray(line)
    assert relation.slope.mean == pytest.approx(0.1 * slope)
    assert relation.pearson.mean == pytest.approx(pearson)
    assert relation.slope.low < relation.slope.mean < relation.slope.high
    assert relation.pearson.has_bounds


def test_the_interval_of_gains_is_that_of_a_plain_loop():
    """The loop leaves out each scene, each run of either arm, and each pair of a scene and a run."""
    num_scenes = 6
    num_runs = 3
    episodes, counts, prior = draw_scenes(4, num_scenes)

    # The last category is a goal in the first scene only, so that three categories remain without this scene.
    goal = np.where(episodes.scene == 0, episodes.goal, episodes.goal % (NUM_CATEGORIES - 1))
    points = compute_similarity_points(episodes._replace(goal=goal), counts + 1, prior)
    success = draw_success(4, 2 * num_runs, points)
    relation = relate_gain_to_similarity(points, success[:num_runs], success[num_runs:], CATEGORIES)
    assert relation.categories == CATEGORIES

    similarity = similarity_by_episode(points, default=np.nan)
    arm = np.repeat([0, 1], num_runs)

    def line_without(left_out_scene, left_out_run) -> np.ndarray:
        """Slope, intercept, r, ... of the line through the remaining categories."""
        similarities = []
        gains = []
        remaining_runs = np.arange(2 * num_runs) != left_out_run
        for category in range(NUM_CATEGORIES):
            members = (goal == category) & (episodes.scene != left_out_scene)
            if members.any():
                baseline = success[(arm == 0) & remaining_runs][:, members].mean()
                variant = success[(arm == 1) & remaining_runs][:, members].mean()
                similarities += [similarity[members].mean()] * members.sum()
                gains += [100 * (variant - baseline)] * members.sum()
        return np.asarray(linregress(similarities, gains))

    def slope_without(left_out_scene, left_out_run) -> float:
        return 0.1 * line_without(left_out_scene, left_out_run)[0]

    def fisher_z_without(left_out_scene, left_out_run) -> float:
        return np.arctanh(line_without(left_out_scene, left_out_run)[2])

    # The slope is in points per 0.1 of similarity.
    expected_slope = two_way_jackknife_interval(slope_without, num_scenes, num_runs, arms=2)
    expected_z = two_way_jackknife_interval(fisher_z_without, num_scenes, num_runs, arms=2)
    assert bounds(relation.slope) == pytest.approx(expected_slope)
    assert bounds(relation.pearson) == pytest.approx(np.tanh(expected_z))


def test_runs_that_disagree_widen_the_interval_of_the_slope():
    points = draw_points()
    similarity = similarity_by_episode(points, default=0.5)
    baseline = np.full((2, len(similarity)), 0.2)
    slopes = {}
    for deviation in (0.0, 0.3):
        variant = np.stack([0.3 + (0.4 + deviation) * similarity, 0.3 + (0.4 - deviation) * similarity])
        slopes[deviation] = relate_gain_to_similarity(points, baseline, variant, CATEGORIES).slope

    # Gains rise by 4 points per 0.1 in all scenes. With 7 and 1 points in the runs of the variant, the mean without
    # either run moves by 3: variance 1 / 2 x (3^2 + 3^2) by run, with two degrees of freedom for two arms of two runs.
    assert bounds(slopes[0.0]) == pytest.approx((4, 4, 4))
    assert bounds(slopes[0.3]) == pytest.approx(student_interval(4, 9, 2))


def test_a_gain_that_falls_with_similarity_has_a_negative_slope():
    # Gain = 60 points x (1 - similarity): 6 points less for each 0.1, whichever scene or run is left out.
    points = draw_points()
    baseline = np.full((2, len(points.episodes.goal)), 0.2)
    variant = baseline + 0.6 * (1 - similarity_by_episode(points, default=0.0))
    relation = relate_gain_to_similarity(points, baseline, variant, CATEGORIES)
    assert bounds(relation.slope) == pytest.approx((-6, -6, -6))
    assert bounds(relation.pearson) == pytest.approx((-1, -1, -1))


def test_an_equal_gain_has_no_slope():
    # The chance rises from 0.3 to 0.5 at every similarity, so the interval of the slope covers 0.
    points = draw_points(num_scenes=30)
    baseline = draw_success(3, 5, points, chance=0.3)
    variant = draw_success(4, 5, points, chance=0.5)
    slope = relate_gain_to_similarity(points, baseline, variant, CATEGORIES).slope
    assert slope.low < 0 < slope.high


# Rows


Relation = SuccessBySimilarity | GainBySimilarity


def assert_same_relation(
    relation: Relation, expected_relation: Relation, array_names: tuple[str, ...], interval_names: tuple[str, ...]
) -> None:
    """Assert that a relation read from a file equals the written one, up to the seven digits of files."""
    for name in array_names:
        np.testing.assert_allclose(getattr(relation, name), getattr(expected_relation, name), rtol=1e-6)
    for name in interval_names:
        interval = bounds(getattr(relation, name))
        assert interval == pytest.approx(bounds(getattr(expected_relation, name)), rel=1e-6)


def test_both_relations_are_read_back_from_a_file_of_rows(tmp_path):
    points = draw_points()
    baseline = draw_success(0, 3, points)
    variant = draw_success(1, 3, points)
    fields = {"world": "rooms", "run": "main", "shift": 1.0}
    variant_fields = fields | {"variant": "stde", "epsilon": 0.5}
    rows = [*success_rows(fields, points, baseline), *gain_rows(variant_fields, points, baseline, variant, CATEGORIES)]

    # The file also has rows of another shift, which are ignored.
    other_rows = success_rows(fields | {"shift": 0.0}, points, variant)
    write_part(tmp_path / "part.jsonl", {}, [*rows, *other_rows])
    table = ResultTable(read_part(tmp_path / "part.jsonl"))

    expected_success = relate_success_to_similarity(points, baseline)
    expected_gain = relate_gain_to_similarity(points, baseline, variant, CATEGORIES)
    success = success_of_table(table, **fields)
    gain = gain_of_table(table, **variant_fields)

    assert_same_relation(success, expected_success, ("episodes", "similarity", "success"), ("pearson", "spearman"))
    assert gain.categories == expected_gain.categories
    assert_same_relation(gain, expected_gain, ("similarity", "baseline", "gain"), ("slope", "pearson"))


def test_the_interval_of_a_perfect_correlation_is_finite():
    # All leave-one-out correlations are 1, so the interval has no width.
    replicates = np.ones((1, 1 + 5))
    interval = correlation_interval(replicates, scene_clusters(np.arange(5), np.zeros(5, int)))
    assert bounds(interval) == pytest.approx((1.0, 1.0, 1.0))
