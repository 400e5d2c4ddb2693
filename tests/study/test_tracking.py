"""The gap step by step: traces against a plain loop and closed forms, AUC against SciPy, twins, and noise alone."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu
from support import tiny_world as tiny
from support.dirichlet import exact_kl

from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.layout import LayoutEstimator, Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.pathways import NO_ACTION, Memory
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, LOOK_UP
from jaxnav.study.tracking import FROZEN, UPDATED, GapTraces, auc, auc_by_step, gap_traces, mean_by_step

ENV, PARAMS = tiny.world()
ACTING = Acting(ENV, tiny.SETTING)


def presence(pose):
    return RowFormat(len(tiny.CATEGORIES)).presence(tiny.BANK.rows[pose])


def episodes():
    """Five in each scene, the first two of them where two categories are in view, looking level (horizon 0)."""
    own = episode_list(tiny.BANK, 10, seed=1)
    poses = np.arange(len(tiny.BANK.rows))
    poses = poses[(presence(poses).sum(axis=1) >= 2) & (poses % len(tiny.BANK.task.rules.horizons) == 0)]
    in_bedroom = poses >= tiny.BANK.first_cell[1] * tiny.POSES_PER_CELL
    for scene in (0, 1):
        own.pose[np.flatnonzero(own.scene == scene)[:2]] = poses[in_bedroom == scene][[0, -1]]
    return own


EPISODES = episodes()
OPEN = Setting(gate=False)
#: `paper` sees every row, `calibrated` has a gate that shuts, OPEN none; each has a prior of its own.
SETTINGS = ("paper", "calibrated", OPEN)
PRIORS = jnp.stack([tiny.priors(), 0.3 * tiny.priors(), 2 * tiny.priors()])
STEPS = max(tiny.LIMITS) + 1
KEY = jax.random.key(4)
WEIGHTS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(tiny.lively, (6, 11)))


def traced(weights) -> GapTraces:
    return gap_traces(weights, EPISODES, PARAMS, ACTING, tiny.SPEC, tiny.priors(), SETTINGS, PRIORS, STEPS, KEY)


def always(action):
    """Policies that take one action only."""
    bias = WEIGHTS["actor"]["bias"].at[:, action].set(1e4)
    return WEIGHTS | {"actor": WEIGHTS["actor"] | {"bias": bias}}


@pytest.fixture(scope="module")
def traces():
    return traced(WEIGHTS)


@pytest.fixture(scope="module")
def standing():
    """Of policies that look up from where they start, which they do already: one view over and over."""
    return traced(always(LOOK_UP))


# Traces


@functools.partial(jax.jit, static_argnums=0)
def update(setting, prior, belief, seen):
    return LayoutEstimator(prior, setting).update(belief, seen)


@jax.jit
def follow(n, e, t, pose, logits):
    """The sampled action, and the pose after it."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(KEY, n), e), t)
    action = jax.random.categorical(key, logits).astype(jnp.int32)
    return action, ENV.after(pose, action, PARAMS)


def test_traces_are_those_of_a_plain_loop(traces):
    assert traces.gap.shape == (3, 2, 2, len(EPISODES.pose), STEPS + 1)
    assert traces.gap.dtype == np.float32
    lengths = set()
    for n, e in ((0, 0), (0, 6), (1, 1), (1, 9)):
        scene, goal = EPISODES.scene[e], jnp.int32(EPISODES.goal[e])
        room = int(PARAMS.room[scene])
        own, memory = None, Memory(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
        beliefs = [
            [LayoutEstimator(prior, name).init()] * 2 for name, prior in zip(SETTINGS, PRIORS[:, room], strict=True)
        ]
        pose, running, t = int(EPISODES.pose[e]), True, 0
        while running:
            for s, (name, prior) in enumerate(zip(SETTINGS, PRIORS[:, room], strict=True)):
                updated, frozen = (update(name, prior, belief, presence(pose)) for belief in beliefs[s])
                np.testing.assert_allclose(traces.gap[s, :, n, e, t], [updated.gap, frozen.gap], atol=1e-6)
                beliefs[s] = [updated, frozen.replace(alpha=prior)]
            row = jnp.asarray(tiny.BANK.rows[pose])
            own = tiny.believe(tiny.priors()[room], own, row)
            decision, _ = tiny.decide(tiny.at(WEIGHTS, n), row, goal, tiny.goal_weights(own, goal), memory)
            action, pose = follow(n, e, t, pose, decision.logits)
            memory = Memory(decision.hidden, action)
            t += 1
            running = action != DONE and t < tiny.LIMITS[scene]
        lengths.add(t)
        assert traces.running[n, e].tolist() == [True] * t + [False] * (STEPS + 1 - t)
    assert len(lengths) > 1


def test_a_view_that_stays_in_closed_form(standing):
    # The belief of OPEN gains the view's counts at every step; frozen, every step is the first again.
    limits = np.array(tiny.LIMITS)[EPISODES.scene]
    for e in (0, 1, 5, 6):
        seen = presence(EPISODES.pose[e]).astype(int)
        assert seen.sum() >= 2
        counts = np.outer(seen, seen) * (1 - np.eye(len(seen), dtype=int))
        prior = np.asarray(PRIORS[2][PARAMS.room[EPISODES.scene[e]]])[seen > 0]
        others = prior > 0
        for t in range(limits[e]):
            divergences = [
                exact_kl((row + t * n)[other], n[other])
                for row, n, other in zip(prior, counts[seen > 0], others, strict=True)
            ]
            np.testing.assert_allclose(standing.gap[2, UPDATED, 0, e, t], np.tanh(np.mean(divergences)), rtol=2e-4)
        frozen = standing.gap[2, FROZEN, 0, e, : limits[e]]
        np.testing.assert_array_equal(frozen, np.full(limits[e], frozen[0]))
        assert frozen[0] == standing.gap[2, UPDATED, 0, e, 0] > standing.gap[2, UPDATED, 0, e, 1]
        # The gate of `calibrated` stays shut: both gaps decay by 0.8 a step.
        for belief in (UPDATED, FROZEN):
            gap = standing.gap[1, belief, 0, e, : limits[e]]
            np.testing.assert_allclose(gap, gap[0] * 0.8 ** np.arange(limits[e]), rtol=1e-5)


def test_who_runs(standing):
    # A step limit of L leaves steps 0 ... L - 1; Done at once leaves step 0.
    limits = np.array(tiny.LIMITS)[EPISODES.scene]
    np.testing.assert_array_equal(standing.running[0], np.arange(STEPS + 1) < limits[:, None])
    np.testing.assert_array_equal(traced(always(DONE)).running.sum(axis=-1), 1)


# AUC

VALUES = st.lists(st.integers(-3, 3), min_size=1, max_size=20).map(np.array)


def test_auc_by_hand():
    # Against 2: lost, even, even; against 0: all three won. (0.5 + 0.5 + 3) / 6.
    assert auc(np.array([1, 2, 2]), np.array([2, 0])) == pytest.approx(4 / 6)


@given(VALUES, VALUES)
def test_auc_is_the_statistic_of_mann_and_whitney(positive, negative):
    expected = mannwhitneyu(positive, negative).statistic / (len(positive) * len(negative))
    assert auc(positive, negative) == pytest.approx(expected)
    assert auc(negative, positive) == pytest.approx(1 - expected)


# Courses


def made(gap, scene, room=None, names=None, running=None) -> GapTraces:
    """Traces of one setting, both beliefs alike, from gap [N, E, T + 1]."""
    gap, scene = np.asarray(gap, np.float32), np.asarray(scene)
    room = np.zeros(scene.max() + 1, int) if room is None else np.array(room)
    none = np.zeros(len(scene), np.int32)
    names = tuple(f"room{i:02}" for i in range(scene.max() + 1)) if names is None else names
    return GapTraces(
        gap=np.stack([gap, gap])[None],
        running=np.ones(gap.shape, bool) if running is None else np.array(running),
        episodes=EpisodeList(scene, none, none, none, room[scene], ("bedroom", "kitchen"), names),
    )


def at(course, step=0):
    """Mean, low and high at a step."""
    return [float(leaf[0, UPDATED, step]) for leaf in course]


def rng(seed=0):
    return np.random.default_rng(seed)


def test_twins_are_drawn_together():
    # Scene i has a gap of i / 20 unshifted, a little more shifted: a twin wins against itself, so with n scenes, each
    # drawn c_i times, AUC = (1 + sum c_i^2 / n^2) / 2 >= (1 + 1 / n) / 2. Draws of their own would often give less.
    scenes = np.arange(20)
    unshifted = made(scenes[None, :, None] / 20, scenes)
    names = unshifted.episodes.scenes[::-1]  # here in another order
    shifted = made((scenes[::-1] / 20 + 0.01)[None, :, None], scenes, names=names)
    mean, low, high = at(auc_by_step(shifted, unshifted, rng()))
    assert mean == pytest.approx(0.525)
    assert 0.525 <= low < high < 0.6
    stranger = made(scenes[None, :, None] / 20 + 0.01, scenes, names=tuple(f"other{i:02}" for i in scenes))
    assert at(auc_by_step(stranger, unshifted, rng()))[1] < 0.4


def test_room_types_keep_their_shares_and_policies_are_drawn():
    # One scene of each room type: every draw has both, and one policy is always drawn.
    alone = made([[[0.2], [0.6]]], [0, 1], room=[0, 1])
    assert at(mean_by_step(alone, rng())) == pytest.approx([0.4, 0.4, 0.4])
    # Two policies: both from the first in a quarter of the draws, both from the second in another.
    assert at(mean_by_step(made([[[0.2]], [[0.8]]], [0]), rng())) == pytest.approx([0.5, 0.2, 0.8])
    # The same policies act at both shifts: the first tells the shift, the second does not.
    shifted, unshifted = made([[[0.9]], [[0.3]]], [0]), made([[[0.5]], [[0.3]]], [0])
    mean, low, high = at(auc_by_step(shifted, unshifted, rng()))
    # 0.9 > 0.5 and 0.3, 0.3 < 0.5, 0.3 = 0.3: 2.5 of 4. Alone: 1 and 0.5.
    assert [mean, low, high] == pytest.approx([0.625, 0.5, 1])


def test_only_running_episodes_count():
    running = [[[True, True, False], [True, False, False]]]
    shifted = made([[[0.5, 0.5, 9], [0.1, 9, 9]]], [0, 1], running=running)
    unshifted = made([[[0.3, 0.6, 0.0], [0.3, 0.4, 0.0]]], [0, 1])
    means = mean_by_step(shifted, rng())
    assert means.mean[0, FROZEN, :2] == pytest.approx([0.3, 0.5])
    course = auc_by_step(shifted, unshifted, rng())
    assert course.mean[0, UPDATED, :2] == pytest.approx([0.5, 0.5])
    for leaf in (*means, *course):
        assert np.isnan(leaf[..., 2]).all()


def test_the_interval_of_noise_covers_a_half_and_that_of_a_shift_does_not():
    draw, scene = rng(7), np.repeat(np.arange(20), 5)
    noise, other = draw.random((2, 3, 100, 1))
    _, low, high = at(auc_by_step(made(noise, scene), made(other, scene), rng()))
    assert 0.3 < low < 0.5 < high < 0.7
    # Uniform against uniform + 0.4: 1 - 0.6^2 / 2 = 0.82, s.e. about 0.02.
    mean, low, _ = at(auc_by_step(made(noise + 0.4, scene), made(other, scene), rng()))
    assert mean == pytest.approx(0.82, abs=0.06)
    assert low > 0.7
