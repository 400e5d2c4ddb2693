"""Success and gain against similarity: worked scenes, SciPy on repeated points, and data without any relation."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cosine
from scipy.stats import linregress, pearsonr, rankdata, spearmanr

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.study.association import (
    gain_by_similarity,
    interval,
    scene_draws,
    success_by_similarity,
    weight_below,
)

K = 4


def listed(scene, goal, room=None, names=None) -> EpisodeList:
    """Episodes of these scenes and goals; scenes are of one room type unless `room` [N] says otherwise."""
    scene = np.array(scene, np.int32)
    room = np.zeros(scene.max() + 1, int) if room is None else np.array(room)
    ones = np.ones(len(scene), np.int32)
    return EpisodeList(
        scene=scene,
        goal=np.array(goal, np.int32),
        pose=ones,
        best_length=ones,
        room=room[scene],
        rooms=("bedroom", "kitchen"),
        scenes=tuple(f"room{i:02}" for i in range(scene.max() + 1)) if names is None else names,
    )


def rng(seed=0):
    return np.random.default_rng(seed)


def made(seed=0, scenes=12, per_scene=10):
    """Episodes, counts of the scenes and a prior, all by chance."""
    draw = rng(seed)
    counts = draw.integers(0, 20, (scenes, K, K)) * draw.integers(0, 2, (scenes, K, K))
    prior = np.broadcast_to(draw.integers(1, 20, (K, K)), counts.shape)
    episodes = listed(np.repeat(np.arange(scenes), per_scene), draw.integers(0, K, scenes * per_scene))
    return episodes, counts, prior


# Figure 4


def test_a_worked_example():
    # Scene 0 shows category 0 as training does: cosine 1. It shows 1 with 2 alone, where training has 0 and 2 alike:
    # (0, 1) . (1, 1) / (1 * sqrt 2) = 0.7071. Category 2 is shown with nothing else: left out.
    counts = np.array([[[0, 1, 2], [0, 0, 5], [0, 0, 0]]])
    prior = np.array([[[0, 10, 20], [30, 0, 30], [1, 1, 0]]])
    episodes = listed([0] * 6, [1, 0, 1, 2, 1, 0])
    success = np.array([[1, 0, 0, 1, 0, 1], [1, 1, 1, 1, 0, 1]])
    result = success_by_similarity(success, episodes, counts, prior, rng())
    assert result.category.tolist() == [0, 1]
    assert result.scene.tolist() == [0, 0]
    assert result.episodes.tolist() == [2, 3]
    assert result.similarity == pytest.approx([1, np.sqrt(0.5)])
    assert result.success == pytest.approx([3 / 4, 3 / 6])  # of two seeds
    assert result.left_out == 1
    # Two points make a line; the only scene is drawn every time.
    assert result.pearson["mean"] == pytest.approx(1)
    assert result.spearman["ci95"] == pytest.approx([1, 1])


@pytest.mark.parametrize("seed", range(3))
def test_a_point_weighs_as_many_as_its_episodes(seed):
    episodes, counts, prior = made(seed)
    success = rng(seed).random((3, len(episodes.goal))) < 0.5
    result = success_by_similarity(success, episodes, counts, prior, rng())
    for i, (scene, category) in enumerate(zip(result.scene, result.category, strict=True)):
        others = np.arange(K) != category
        same = (episodes.scene == scene) & (episodes.goal == category)
        rows = counts[scene, category, others], prior[scene, category, others]
        assert result.similarity[i] == pytest.approx(1 - cosine(*rows))
        assert result.success[i] == pytest.approx(success[:, same].mean())
        assert result.episodes[i] == same.sum()
    x, y = (np.repeat(values, result.episodes) for values in (result.similarity, result.success))
    assert result.pearson["mean"] == pytest.approx(pearsonr(x, y).statistic)
    assert result.spearman["mean"] == pytest.approx(spearmanr(x, y).statistic)
    json.dumps([result.pearson, result.spearman], allow_nan=False)


def test_the_interval_is_that_of_scenes_drawn_with_all_their_episodes():
    episodes, counts, prior = made(scenes=8)
    success = rng(1).random((2, len(episodes.goal))) < 0.4
    resamples = 30
    result = success_by_similarity(success, episodes, counts, prior, rng(5), resamples)
    (draws,) = scene_draws([episodes], rng(5), resamples)
    some_episode = [np.flatnonzero(episodes.scene == scene)[0] for scene in result.scene]
    repeats = result.episodes[:, None] * draws[some_episode].astype(int)
    expected = [
        (pearsonr(x, y).statistic, spearmanr(x, y).statistic)
        for own in repeats[:, 1:].T
        for x, y in [[np.repeat(values, own) for values in (result.similarity, result.success)]]
    ]
    low, high = np.percentile(expected, (2.5, 97.5), axis=0)
    assert result.pearson["ci95"] == pytest.approx([low[0], high[0]])
    assert result.spearman["ci95"] == pytest.approx([low[1], high[1]])


def test_success_that_follows_similarity_shows_and_success_by_chance_does_not():
    episodes, counts, prior = made(scenes=30)
    points = success_by_similarity(np.zeros((1, 300)), episodes, counts, prior, rng())
    chance = np.full(300, 0.5)
    of_point = {
        (scene, category): own
        for scene, category, own in zip(points.scene, points.category, points.similarity, strict=True)
    }
    for e, pair in enumerate(zip(episodes.scene, episodes.goal, strict=True)):
        chance[e] = of_point.get(pair, 0.5) ** 2
    draws = rng(2).random((5, 300))
    related = success_by_similarity(draws < chance, episodes, counts, prior, rng())
    unrelated = success_by_similarity(draws < 0.5, episodes, counts, prior, rng())
    for r in ("pearson", "spearman"):
        assert getattr(related, r)["ci95"][0] > 0.3
        low, high = getattr(unrelated, r)["ci95"]
        assert low < 0 < high


def test_no_relation_is_told_where_all_points_are_alike():
    episodes, counts, prior = made()
    result = success_by_similarity(np.ones((2, len(episodes.goal))), episodes, counts, prior, rng())
    assert result.pearson == result.spearman == {"mean": None, "ci95": [None, None]}


# Figure 5


@pytest.mark.parametrize("seed", range(3))
def test_gain_by_category_and_its_slope(seed):
    episodes, counts, prior = made(seed)
    draw = rng(seed)
    baseline, variant = draw.random((3, len(episodes.goal))) < 0.5, draw.random((2, len(episodes.goal))) < 0.6
    points = success_by_similarity(baseline, episodes, counts, prior, rng())
    result = gain_by_similarity(baseline, variant, episodes, counts, prior, rng())
    kept = np.isin(episodes.scene * K + episodes.goal, points.scene * K + points.category)
    assert result.left_out == points.left_out
    assert result.category.tolist() == sorted(set(episodes.goal[kept]))
    for i, category in enumerate(result.category):
        same = kept & (episodes.goal == category)
        own = points.category == category
        assert result.episodes[i] == same.sum()
        assert result.baseline[i] == pytest.approx(100 * baseline[:, same].mean())
        assert result.gain[i] == pytest.approx(100 * (variant[:, same].mean() - baseline[:, same].mean()))
        assert result.similarity[i] == pytest.approx(np.average(points.similarity[own], weights=points.episodes[own]))
    x, y = (np.repeat(values, result.episodes) for values in (result.similarity, result.gain))
    line = linregress(x, y)
    assert result.slope["mean"] == pytest.approx(0.1 * line.slope)
    assert result.pearson["mean"] == pytest.approx(line.rvalue)
    low, high = result.slope["ci95"]
    assert low < result.slope["mean"] < high
    json.dumps([result.slope, result.pearson], allow_nan=False)


def test_a_gain_that_falls_with_similarity():
    # gain = 60 points x (1 - similarity): 6 points less for each 0.1, in every resample.
    episodes, counts, prior = made()
    points = success_by_similarity(np.zeros((1, len(episodes.goal))), episodes, counts, prior, rng())
    baseline, variant = np.full((2, len(episodes.goal)), 0.2), np.full((2, len(episodes.goal)), 0.9)
    for scene, category, similarity in zip(points.scene, points.category, points.similarity, strict=True):
        variant[:, (episodes.scene == scene) & (episodes.goal == category)] = 0.2 + 0.6 * (1 - similarity)
    result = gain_by_similarity(baseline, variant, episodes, counts, prior, rng())
    assert result.slope["mean"] == pytest.approx(-6)
    assert result.slope["ci95"] == pytest.approx([-6, -6])
    assert result.pearson["ci95"] == pytest.approx([-1, -1])


def test_an_equal_gain_has_no_slope():
    # Chance of 0.3 against 0.5 whatever the similarity: the interval of the slope covers 0.
    episodes, counts, prior = made(scenes=30)
    draw = rng(3)
    baseline, variant = (draw.random((5, 300)) < chance for chance in (0.3, 0.5))
    low, high = gain_by_similarity(baseline, variant, episodes, counts, prior, rng()).slope["ci95"]
    assert low < 0 < high


# Resamples and ranks


def test_scenes_are_drawn_within_room_types_with_their_twins():
    # Twins stand in the second list in another order, and one scene is there alone.
    here = listed([0, 1, 1, 2], [0] * 4, room=[0, 0, 1], names=("a", "b", "c"))
    there = listed([0, 0, 1, 2, 3], [0] * 5, room=[1, 0, 0, 0], names=("c", "b", "a", "only here"))
    one, other = scene_draws([here, there], rng(), 500)
    assert one.shape == (4, 501)
    assert one.dtype == np.float32
    assert (one[:, 0] == 1).all()
    assert (other[:, 0] == 1).all()
    a, b, again, c = one
    np.testing.assert_array_equal(b, again)
    np.testing.assert_array_equal(other, [c, c, b, a, 3 - a - b])  # three bedrooms are drawn each time,
    np.testing.assert_array_equal(c, 1)  # and the only kitchen always
    # Each of three draws falls on `a` with probability 1/3: none does in (2/3)^3 = 0.296 +- 0.020 (s.e. of 500).
    assert (a[1:] == 0).mean() == pytest.approx(0.296, abs=0.08)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), min_size=1, max_size=30))
def test_weights_below_are_midranks_of_repeated_values(pairs):
    values, repeats = np.array(pairs).T
    ranks = weight_below(values, values, np.stack([np.ones(len(values)), repeats], axis=1))
    np.testing.assert_allclose(ranks[:, 0], rankdata(values) - 0.5)
    repeated = rankdata(np.repeat(values, repeats)) - 0.5
    np.testing.assert_allclose(np.repeat(ranks[:, 1], repeats), repeated)


def test_an_interval_leaves_out_what_is_not_defined():
    # 101 resamples 0 ... 100 and one without a value: percentiles 2.5 and 97.5 of 0 ... 100.
    result = interval(np.array([7.0, np.nan, *range(101)]))
    assert result == {"mean": 7.0, "ci95": pytest.approx([2.5, 97.5])}
    assert interval(np.array([np.nan, 1.0]))["mean"] is None
