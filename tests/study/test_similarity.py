"""Success and gain against similarity: worked scenes, SciPy, chance."""

import functools

import numpy as np
import pytest
from scipy.spatial.distance import cosine
from scipy.stats import linregress, pearsonr, spearmanr
from support.intervals import around, bounds, left_out
from support.study_results import episodes_in

from jaxnav.study.similarity import (
    SimilarityPoints,
    compute_similarity_points,
    relate_gain_to_similarity,
    relate_success_to_similarity,
)

CATEGORIES = ("Book", "Chair", "Pan", "Sink")
K = len(CATEGORIES)


def rng(seed=0):
    return np.random.default_rng(seed)


def random_scenes(seed=0, scenes=12, per_scene=10):
    """Return random episodes, counts of scenes and a prior."""
    draw = rng(seed)
    counts = draw.integers(0, 20, (scenes, K, K)) * draw.integers(0, 2, (scenes, K, K))
    prior = np.broadcast_to(draw.integers(1, 20, (K, K)), counts.shape)
    episodes = episodes_in(np.repeat(np.arange(scenes), per_scene), draw.integers(0, K, scenes * per_scene))
    return episodes, counts, prior


def similarity_of(points: SimilarityPoints) -> np.ndarray:
    """Return the similarity of each episode's point, else NaN."""
    of_point = dict(zip(zip(points.scene, points.category, strict=True), points.similarity, strict=True))
    return np.array(
        [of_point.get(pair, np.nan) for pair in zip(points.episodes.scene, points.episodes.goal, strict=True)]
    )


# Figure 4


def test_a_worked_example():
    # Scene 0 shows category 0 as training does: cosine 1. It shows 1 with 2 alone, where training has 0 and 2 alike:
    # (0, 1) . (1, 1) / (1 * sqrt 2) = 0.7071. Category 2 is shown with nothing else: left out.
    counts = np.array([[[0, 1, 2], [0, 0, 5], [0, 0, 0]]])
    prior = np.array([[[0, 10, 20], [30, 0, 30], [1, 1, 0]]])
    points = compute_similarity_points(episodes_in([0] * 6, [1, 0, 1, 2, 1, 0]), counts, prior)
    success = np.array([[1, 0, 0, 1, 0, 1], [1, 1, 1, 1, 0, 1]])
    result = relate_success_to_similarity(points, success)
    assert result.category.tolist() == [0, 1]
    assert result.scene.tolist() == [0, 0]
    assert result.episodes.tolist() == [2, 3]
    assert result.similarity == pytest.approx([1, np.sqrt(0.5)])
    assert result.success == pytest.approx([3 / 4, 3 / 6])  # of two seeds
    assert result.left_out == 1
    # Two points make a line; a single scene has no interval.
    for r in (result.pearson, result.spearman):
        assert r.mean == pytest.approx(1)
        assert not r.has_bounds


@pytest.mark.parametrize("seed", range(3))
def test_a_point_weighs_as_many_as_its_episodes(seed):
    episodes, counts, prior = random_scenes(seed)
    success = rng(seed).random((3, len(episodes.goal))) < 0.5
    result = relate_success_to_similarity(compute_similarity_points(episodes, counts, prior), success)
    for i, (scene, category) in enumerate(zip(result.scene, result.category, strict=True)):
        others = np.arange(K) != category
        same = (episodes.scene == scene) & (episodes.goal == category)
        rows = counts[scene, category, others], prior[scene, category, others]
        assert result.similarity[i] == pytest.approx(1 - cosine(*rows))
        assert result.success[i] == pytest.approx(success[:, same].mean())
        assert result.episodes[i] == same.sum()
    x, y = (np.repeat(values, result.episodes) for values in (result.similarity, result.success))
    assert result.pearson.mean == pytest.approx(pearsonr(x, y)[0])
    assert result.spearman.mean == pytest.approx(spearmanr(x, y)[0])
    assert result.pearson.has_bounds
    assert result.spearman.has_bounds


def test_the_interval_is_that_of_a_plain_loop():
    """It leaves out each scene, each training run and both."""
    scenes, runs = 8, 3
    episodes, counts, prior = random_scenes(scenes=scenes)
    success = rng(1).random((runs, len(episodes.goal))) < 0.4
    result = relate_success_to_similarity(compute_similarity_points(episodes, counts, prior), success)

    def correlation(kind, out, run) -> float:
        remains = result.scene != out
        rates = np.array(
            [
                success[np.arange(runs) != run][:, (episodes.scene == scene) & (episodes.goal == category)].mean()
                for scene, category in zip(result.scene, result.category, strict=True)
            ]
        )
        return float(kind(*(np.repeat(x[remains], result.episodes[remains]) for x in (result.similarity, rates)))[0])

    for interval, kind in ((result.pearson, pearsonr), (result.spearman, spearmanr)):
        expected = left_out(functools.partial(correlation, kind), scenes, runs)
        assert bounds(interval) == pytest.approx(expected)


def test_training_runs_that_disagree_widen_the_interval():
    # Success that follows similarity in one run and runs against it in the other, or half of both in both: on average
    # the same, but other runs would not do the same.
    points = compute_similarity_points(*random_scenes())
    similarity = np.nan_to_num(similarity_of(points), nan=0.5)
    noise = rng(4).normal(0, 0.05, len(similarity))
    agreeing = np.stack([0.5 + 0.2 * similarity + noise] * 2)
    disagreeing = agreeing + np.stack([0.6 * similarity, -0.6 * similarity])
    same, other = (relate_success_to_similarity(points, success) for success in (agreeing, disagreeing))
    for agreed, disagreed in ((same.pearson, other.pearson), (same.spearman, other.spearman)):
        assert agreed.mean == pytest.approx(disagreed.mean)
        assert agreed.low > 0.5
        assert disagreed.low < -0.5
    # Equal runs add nothing: they say what a single one does, over scenes alone.
    assert bounds(same.pearson) == pytest.approx(
        bounds(relate_success_to_similarity(points, agreeing[[0, 1, 0, 1]]).pearson)
    )


def test_room_types_keep_their_shares():
    # Without a scene the others of its room type count the more.
    episodes, counts, prior = random_scenes(scenes=7)
    room = np.array([0, 1, 0, 1, 1, 0, 1])
    episodes = episodes._replace(room=room[episodes.scene])
    success = np.stack([rng(1).random(len(episodes.goal)) < 0.4] * 2)  # equal runs: the scenes alone vary
    result = relate_success_to_similarity(compute_similarity_points(episodes, counts, prior), success)

    def pearson(out):
        size = (room == room[out]).sum()
        share = np.where(np.arange(7) == out, 0, np.where(room == room[out], size / (size - 1), 1))
        # np.cov's weights are those of the points.
        cov = np.cov(result.similarity, result.success, aweights=result.episodes * share[result.scene])
        return cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])

    sizes = np.bincount(room)[room]
    squares = [(pearson(scene) - result.pearson.mean) ** 2 for scene in range(7)]
    variance = ((sizes - 1) / sizes * squares).sum()
    assert bounds(result.pearson) == pytest.approx(around(result.pearson.mean, variance, 7 - 2))


def test_success_that_follows_similarity_shows_and_success_by_chance_does_not():
    points = compute_similarity_points(*random_scenes(scenes=30))
    similarity = similarity_of(points)
    chance = np.where(np.isnan(similarity), 0.5, similarity**2)
    draws = rng(2).random((5, 300))
    related = relate_success_to_similarity(points, draws < chance)
    unrelated = relate_success_to_similarity(points, draws < 0.5)
    assert related.pearson.low > 0.3
    assert related.spearman.low > 0.3
    assert unrelated.pearson.low < 0 < unrelated.pearson.high
    assert unrelated.spearman.low < 0 < unrelated.spearman.high


def test_there_is_no_relation_where_all_points_are_alike():
    points = compute_similarity_points(*random_scenes())
    result = relate_success_to_similarity(points, np.ones((2, len(points.episodes.goal))))
    for r in (result.pearson, result.spearman):
        assert np.isnan(r.mean)
        assert not r.has_bounds


# Figure 5


@pytest.mark.parametrize("seed", range(3))
def test_gain_by_category_and_its_slope(seed):
    points, draw = compute_similarity_points(*random_scenes(seed)), rng(seed)
    episodes = points.episodes
    baseline, variant = draw.random((2, 3, len(episodes.goal))) < [[[0.5]], [[0.6]]]
    result = relate_gain_to_similarity(points, baseline, variant, CATEGORIES)
    is_used = np.isin(episodes.scene * K + episodes.goal, points.scene * K + points.category)
    assert result.left_out == points.num_left_out
    assert result.category.tolist() == sorted(set(episodes.goal[is_used]))
    assert result.categories == tuple(CATEGORIES[k] for k in result.category)
    for i, category in enumerate(result.category):
        same = is_used & (episodes.goal == category)
        of_category = points.category == category
        similarity = np.average(points.similarity[of_category], weights=points.num_episodes[of_category])
        assert result.episodes[i] == same.sum()
        assert result.baseline[i] == pytest.approx(100 * baseline[:, same].mean())
        assert result.gain[i] == pytest.approx(100 * (variant[:, same].mean() - baseline[:, same].mean()))
        assert result.similarity[i] == pytest.approx(similarity)
    x, y = (np.repeat(values, result.episodes) for values in (result.similarity, result.gain))
    line = np.asarray(linregress(x, y))  # slope, intercept, r, ...
    assert result.slope.mean == pytest.approx(0.1 * line[0])
    assert result.pearson.mean == pytest.approx(line[2])
    assert result.slope.low < result.slope.mean < result.slope.high
    assert result.pearson.has_bounds


def test_the_interval_of_gains_is_that_of_a_plain_loop():
    """It leaves out each scene, each run of either arm and both."""
    scenes, runs = 6, 3
    episodes, counts, prior = random_scenes(4, scenes)
    # The last category is a goal in the first scene alone: without that there are three.
    goal = np.where(episodes.scene == 0, episodes.goal, episodes.goal % (K - 1))
    points = compute_similarity_points(episodes._replace(goal=goal), counts + 1, prior)
    success = rng(4).random((2 * runs, len(goal))) < 0.5
    result = relate_gain_to_similarity(points, success[:runs], success[runs:], CATEGORIES)
    assert len(result.category) == K
    similarity = similarity_of(points)

    def line(scene, run):
        x, y, arms = [], [], np.arange(2 * runs) // runs
        for category in range(K):
            selected = (goal == category) & (episodes.scene != scene)
            baseline, variant = (success[(arms == arm) & (np.arange(2 * runs) != run)][:, selected] for arm in (0, 1))
            if selected.any():
                x += [similarity[selected].mean()] * selected.sum()
                y += [100 * (variant.mean() - baseline.mean())] * selected.sum()
        return np.asarray(linregress(x, y))  # slope, intercept, r, ...

    assert bounds(result.slope) == pytest.approx(left_out(lambda *out: 0.1 * line(*out)[0], scenes, runs, arms=2))
    assert bounds(result.pearson) == pytest.approx(left_out(lambda *out: line(*out)[2], scenes, runs, arms=2))


def test_runs_that_disagree_on_the_slope_widen_its_interval():
    points = compute_similarity_points(*random_scenes())
    similarity = np.nan_to_num(similarity_of(points), nan=0.5)
    baseline = np.full((2, len(similarity)), 0.2)
    slopes = {}
    for more in (0.0, 0.3):  # of one run, and as much less of the other
        variant = np.stack([0.3 + (0.4 + more) * similarity, 0.3 + (0.4 - more) * similarity])
        slopes[more] = relate_gain_to_similarity(points, baseline, variant, CATEGORIES).slope
    # Gains rise by 4 points per 0.1 in all scenes. Where it is 7 and 1 in the runs of the variant, the mean
    # without each moves by 3: 1 / 2 x (3^2 + 3^2) by run, of two arms of two runs, so with two degrees of freedom.
    assert bounds(slopes[0.0]) == pytest.approx((4, 4, 4))
    assert bounds(slopes[0.3]) == pytest.approx(around(4, 9, 2))


def test_a_gain_that_falls_with_similarity():
    # gain = 60 points x (1 - similarity): 6 points less for each 0.1, without any scene or run.
    points = compute_similarity_points(*random_scenes())
    episodes = points.episodes
    baseline, variant = np.full((2, len(episodes.goal)), 0.2), np.full((2, len(episodes.goal)), 0.9)
    for scene, category, similarity in zip(points.scene, points.category, points.similarity, strict=True):
        variant[:, (episodes.scene == scene) & (episodes.goal == category)] = 0.2 + 0.6 * (1 - similarity)
    result = relate_gain_to_similarity(points, baseline, variant, CATEGORIES)
    assert (result.slope.mean, result.slope.low, result.slope.high) == pytest.approx((-6, -6, -6))
    assert (result.pearson.low, result.pearson.high) == pytest.approx((-1, -1))


def test_an_equal_gain_has_no_slope():
    # Chance of 0.3 against 0.5 whatever the similarity: the interval of the slope covers 0.
    points, draw = compute_similarity_points(*random_scenes(scenes=30)), rng(3)
    baseline, variant = (draw.random((5, 300)) < chance for chance in (0.3, 0.5))
    slope = relate_gain_to_similarity(points, baseline, variant, CATEGORIES).slope
    assert slope.low < 0 < slope.high
