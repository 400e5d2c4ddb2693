"""Success and gain against similarity: worked scenes, SciPy, chance."""

import numpy as np
import pytest
from scipy.spatial.distance import cosine
from scipy.stats import linregress, pearsonr, spearmanr
from support.study_results import episodes_in

from jaxnav.study.association import gain_by_similarity, similarity_points, success_by_similarity
from jaxnav.study.bootstrap import scene_draws

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


# Figure 4


def test_a_worked_example():
    # Scene 0 shows category 0 as training does: cosine 1. It shows 1 with 2 alone, where training has 0 and 2 alike:
    # (0, 1) . (1, 1) / (1 * sqrt 2) = 0.7071. Category 2 is shown with nothing else: left out.
    counts = np.array([[[0, 1, 2], [0, 0, 5], [0, 0, 0]]])
    prior = np.array([[[0, 10, 20], [30, 0, 30], [1, 1, 0]]])
    points = similarity_points(episodes_in([0] * 6, [1, 0, 1, 2, 1, 0]), counts, prior)
    success = np.array([[1, 0, 0, 1, 0, 1], [1, 1, 1, 1, 0, 1]])
    result = success_by_similarity(points, success, rng())
    assert result.category.tolist() == [0, 1]
    assert result.scene.tolist() == [0, 0]
    assert result.episodes.tolist() == [2, 3]
    assert result.similarity == pytest.approx([1, np.sqrt(0.5)])
    assert result.success == pytest.approx([3 / 4, 3 / 6])  # of two seeds
    assert result.left_out == 1
    # Two points make a line; the only scene is drawn every time.
    assert result.pearson.mean == pytest.approx(1)
    assert (result.spearman.low, result.spearman.high) == pytest.approx((1, 1))


@pytest.mark.parametrize("seed", range(3))
def test_a_point_weighs_as_many_as_its_episodes(seed):
    episodes, counts, prior = random_scenes(seed)
    success = rng(seed).random((3, len(episodes.goal))) < 0.5
    result = success_by_similarity(similarity_points(episodes, counts, prior), success, rng())
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
    assert result.pearson.defined
    assert result.spearman.defined


def test_the_interval_is_that_of_scenes_drawn_with_all_their_episodes():
    episodes, counts, prior = random_scenes(scenes=8)
    success = rng(1).random((2, len(episodes.goal))) < 0.4
    resamples = 30
    result = success_by_similarity(similarity_points(episodes, counts, prior), success, rng(5), resamples)
    (draws,) = scene_draws([episodes], rng(5), resamples)
    some_episode = [np.flatnonzero(episodes.scene == scene)[0] for scene in result.scene]
    repeats = result.episodes[:, None] * draws[some_episode].astype(int)
    expected = [
        (pearsonr(x, y)[0], spearmanr(x, y)[0])
        for repeat in repeats[:, 1:].T
        for x, y in [[np.repeat(values, repeat) for values in (result.similarity, result.success)]]
    ]
    low, high = np.percentile(expected, (2.5, 97.5), axis=0)
    for i, interval in enumerate((result.pearson, result.spearman)):
        assert (interval.low, interval.high) == pytest.approx((low[i], high[i]))


def test_success_that_follows_similarity_shows_and_success_by_chance_does_not():
    points = similarity_points(*random_scenes(scenes=30))
    chance = np.full(300, 0.5)
    of_point = dict(zip(zip(points.scene, points.category, strict=True), points.similarity, strict=True))
    for e, pair in enumerate(zip(points.episodes.scene, points.episodes.goal, strict=True)):
        chance[e] = of_point.get(pair, 0.5) ** 2
    draws = rng(2).random((5, 300))
    related = success_by_similarity(points, draws < chance, rng())
    unrelated = success_by_similarity(points, draws < 0.5, rng())
    assert related.pearson.low > 0.3
    assert related.spearman.low > 0.3
    assert unrelated.pearson.low < 0 < unrelated.pearson.high
    assert unrelated.spearman.low < 0 < unrelated.spearman.high


def test_there_is_no_relation_where_all_points_are_alike():
    points = similarity_points(*random_scenes())
    result = success_by_similarity(points, np.ones((2, len(points.episodes.goal))), rng())
    assert not result.pearson.defined
    assert not result.spearman.defined


# Figure 5


@pytest.mark.parametrize("seed", range(3))
def test_gain_by_category_and_its_slope(seed):
    points, draw = similarity_points(*random_scenes(seed)), rng(seed)
    episodes = points.episodes
    baseline, variant = draw.random((3, len(episodes.goal))) < 0.5, draw.random((2, len(episodes.goal))) < 0.6
    result = gain_by_similarity(points, baseline, variant, CATEGORIES, rng())
    kept = np.isin(episodes.scene * K + episodes.goal, points.scene * K + points.category)
    assert result.left_out == points.left_out
    assert result.category.tolist() == sorted(set(episodes.goal[kept]))
    assert result.categories == tuple(CATEGORIES[k] for k in result.category)
    for i, category in enumerate(result.category):
        same = kept & (episodes.goal == category)
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
    assert result.pearson.defined


def test_a_gain_that_falls_with_similarity():
    # gain = 60 points x (1 - similarity): 6 points less for each 0.1, in every resample.
    points = similarity_points(*random_scenes())
    episodes = points.episodes
    baseline, variant = np.full((2, len(episodes.goal)), 0.2), np.full((2, len(episodes.goal)), 0.9)
    for scene, category, similarity in zip(points.scene, points.category, points.similarity, strict=True):
        variant[:, (episodes.scene == scene) & (episodes.goal == category)] = 0.2 + 0.6 * (1 - similarity)
    result = gain_by_similarity(points, baseline, variant, CATEGORIES, rng())
    assert (result.slope.mean, result.slope.low, result.slope.high) == pytest.approx((-6, -6, -6))
    assert (result.pearson.low, result.pearson.high) == pytest.approx((-1, -1))


def test_an_equal_gain_has_no_slope():
    # Chance of 0.3 against 0.5 whatever the similarity: the interval of the slope covers 0.
    points, draw = similarity_points(*random_scenes(scenes=30)), rng(3)
    baseline, variant = (draw.random((5, 300)) < chance for chance in (0.3, 0.5))
    slope = gain_by_similarity(points, baseline, variant, CATEGORIES, rng()).slope
    assert slope.low < 0 < slope.high
