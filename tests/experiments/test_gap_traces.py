"""Layout gaps along walks: traces equal a plain loop and closed forms, statistics equal SciPy and worked values."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu
from support import tiny_world as tiny
from support.episodes import episodes_in
from support.intervals import student_interval, two_way_jackknife_interval
from support.numerics import exact_kl

from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.experiments.gap_traces import (
    FROZEN,
    UPDATED,
    GapTraces,
    auc_by_step,
    calibration_at_steps,
    mean_by_step,
    trace_gaps,
    truncate_to_shortest,
    weighted_auc,
)
from jaxnav.layout import EstimatorConfig, LayoutEstimator
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.pathways import NO_ACTION, PolicyState
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, LOOK_UP

# Area under the ROC curve

VALUES = st.lists(st.integers(-3, 3), min_size=1, max_size=20).map(np.array)


def unweighted_auc(positive: np.ndarray, negative: np.ndarray) -> float:
    """AUC where all weights are 1."""
    return weighted_auc(positive, negative, np.ones((len(positive), 1)), np.ones((len(negative), 1)))[0]


def test_auc_counts_pairs_won_and_half_of_the_ties():
    # Against 2, the values 1, 2 and 2 lose once and tie twice; against 0 all three win: (0.5 + 0.5 + 3) / 6.
    assert unweighted_auc(np.array([1, 2, 2]), np.array([2, 0])) == pytest.approx(4 / 6)


@given(VALUES, VALUES)
def test_auc_is_the_statistic_of_mann_and_whitney(positive, negative):
    expected = mannwhitneyu(positive, negative).statistic / (len(positive) * len(negative))
    assert unweighted_auc(positive, negative) == pytest.approx(expected)
    assert unweighted_auc(negative, positive) == pytest.approx(1 - expected)


# Statistics by step


def make_traces(gap, scene, room=None, names=None, running=None) -> GapTraces:
    """Traces of one estimator, with equal gaps [N, E, T + 1] by both beliefs."""
    gap = np.asarray(gap, np.float32)
    return GapTraces(
        gap=np.stack([gap, gap])[None],
        running=np.ones(gap.shape, bool) if running is None else np.array(running),
        episodes=episodes_in(scene, room=room, names=names),
    )


def first_step(curves: np.ndarray) -> tuple[float, float, float]:
    """Mean, low and high of the updated belief at step 0."""
    mean, low, high = curves[:, 0, UPDATED, 0].tolist()
    return mean, low, high


def test_intervals_by_step_are_those_of_a_plain_loop():
    # Six scenes, in another order and with more episodes at the shift; some episodes end early.
    rng = np.random.default_rng(2)
    num_runs = 3
    num_scenes = 6
    unshifted_scene = np.repeat(np.arange(num_scenes), 4)
    unshifted = make_traces(
        rng.integers(0, 9, (num_runs, 24, 2)) / 10, unshifted_scene, running=rng.random((num_runs, 24, 2)) < 0.8
    )
    shifted = make_traces(
        rng.integers(2, 9, (num_runs, 30, 2)) / 10,
        np.tile(np.arange(num_scenes), 5),
        names=unshifted.episodes.scenes[::-1],
    )

    def remaining_gaps(traces: GapTraces, step: int, scene: int | None, run: int | None) -> np.ndarray:
        """Gaps of the running episodes, without those of a scene and of a run."""
        name = None if scene is None else f"room{scene:02}"
        is_other_scene = np.array([traces.episodes.scenes[index] != name for index in traces.episodes.scene])
        is_other_run = np.arange(num_runs)[:, None] != run
        return traces.gap[0, UPDATED, ..., step][traces.running[..., step] & is_other_scene & is_other_run]

    def auc_without(step, scene, run):
        shifted_gaps = remaining_gaps(shifted, step, scene, run)
        unshifted_gaps = remaining_gaps(unshifted, step, scene, run)
        num_pairs = len(shifted_gaps) * len(unshifted_gaps)
        return mannwhitneyu(shifted_gaps, unshifted_gaps).statistic / num_pairs

    def mean_without(step, scene, run):
        return remaining_gaps(unshifted, step, scene, run).mean(dtype=float)

    # The jackknife leaves out each scene and each run of both shifts at once.
    aucs = auc_by_step(shifted, unshifted)
    means = mean_by_step(unshifted)
    for step in (0, 1):
        expected_auc = two_way_jackknife_interval(functools.partial(auc_without, step), num_scenes, num_runs)
        expected_mean = two_way_jackknife_interval(functools.partial(mean_without, step), num_scenes, num_runs)
        assert aucs[:, 0, UPDATED, step] == pytest.approx(expected_auc)
        assert means[:, 0, FROZEN, step] == pytest.approx(expected_mean, rel=1e-5)


def test_calibration_compares_mean_gaps_of_bins_with_shares_of_shifted_episodes():
    # Of the gaps in [0.9, 1], 2 of 3 are of shifted episodes, and their mean is 0.95; of those in [0.1, 0.2), 1 of 3
    # is, and their mean is 0.13. So the error is (3 x |0.95 - 2 / 3| + 3 x |0.13 - 1 / 3|) / 6. Ended episodes do not
    # count.
    shifted = make_traces([[[0.9], [1.0], [0.11], [0.5]]], [0, 1, 2, 3], running=[[[True], [True], [True], [False]]])
    unshifted = make_traces(
        [[[0.95], [0.13], [0.15], [0.5]]], [0, 1, 2, 3], running=[[[True], [True], [True], [False]]]
    )
    ((calibration,),) = calibration_at_steps(shifted, unshifted, [0]).values()
    assert calibration.shifted_share.positions == pytest.approx([0.13, 0.95])
    assert calibration.shifted_share.mean == pytest.approx([1 / 3, 2 / 3])
    assert calibration.error.mean == pytest.approx((0.95 - 2 / 3) / 2 + (1 / 3 - 0.13) / 2)


@pytest.mark.slow
def test_a_gap_drawn_from_its_own_probability_is_calibrated():
    # An episode with gap D is shifted with probability D. The share in a bin of 4,000 episodes has a standard
    # deviation of at most 0.8 points. The square of the gap keeps the order of the episodes and changes the level.
    rng = np.random.default_rng(0)
    gap = rng.random(40_000)
    is_shifted = rng.random(40_000) < gap

    def calibrate(values):
        def tile_traces(gaps: np.ndarray) -> GapTraces:
            return make_traces(np.tile(gaps[:, None], (2, 1, 1)), np.arange(len(gaps)) % 20)

        shifted = tile_traces(values[is_shifted])
        unshifted = tile_traces(values[~is_shifted])
        ((calibration,),) = calibration_at_steps(shifted, unshifted, [0]).values()
        return calibration

    calibrated = calibrate(gap)
    assert len(calibrated.shifted_share.mean) == 10
    np.testing.assert_allclose(calibrated.shifted_share.mean, calibrated.shifted_share.positions, atol=0.04)
    assert calibrated.error.mean < 0.02

    # The mean of |D^2 - D| over uniform D is 1 / 2 - 1 / 3.
    assert calibrate(gap**2).error.mean == pytest.approx(1 / 6, abs=0.01)


def test_scenes_of_a_floor_plan_are_left_out_of_both_shifts_at_once():
    # The gap of scene i is i / 20 unshifted and a little more shifted. Of n scenes, each wins against itself and all
    # lower ones: AUC = (1 + 1 / n) / 2. Without any one scene and its twin the AUC is (1 + 1 / 19) / 2, so scenes have
    # a variance of 19 / 20 x 20 x (0.5 / 19 - 0.5 / 20)^2, and runs have none.
    scenes = np.arange(20)
    unshifted = make_traces(np.tile(scenes[:, None] / 20, (2, 1, 1)), scenes)
    reversed_names = unshifted.episodes.scenes[::-1]
    shifted = make_traces(np.tile(scenes[::-1, None] / 20 + 0.01, (2, 1, 1)), scenes, names=reversed_names)
    variance = 19 * (0.5 / 19 - 0.5 / 20) ** 2
    assert first_step(auc_by_step(shifted, unshifted)) == pytest.approx(student_interval(0.525, variance, 19))

    # Copies of a floor plan with other objects are left out with it; other floor plans are not.
    for name_format, has_same_plans in (("room{:02}-replaced-1", True), ("other{:02}", False)):
        names = tuple(name_format.format(scene) for scene in scenes)
        renamed_traces = make_traces(np.tile(scenes[:, None] / 20 + 0.01, (2, 1, 1)), scenes, names=names)
        mean, low, _ = first_step(auc_by_step(renamed_traces, unshifted))
        assert mean == pytest.approx(0.525)
        assert (low > 0.5) == has_same_plans


def test_room_types_keep_their_shares():
    # Kitchens have gaps of 0.1 and 0.3, bedrooms of 0.6, 0.7 and 0.8, equal in two runs. With sample variances of 0.02
    # and 0.01, the mean has a variance of (2 / 5)^2 0.02 / 2 + (3 / 5)^2 0.01 / 3 = 0.0028. A single stratum would give
    # 0.085 / 5.
    gaps = np.tile(np.array([0.1, 0.3, 0.6, 0.7, 0.8])[:, None], (2, 1, 1))
    for room, variance, degrees in (([1, 1, 0, 0, 0], 0.0028, 3), ([1, 1, 1, 1, 1], 0.085 / 5, 4)):
        means = mean_by_step(make_traces(gaps, range(5), room=room))
        assert first_step(means) == pytest.approx(student_interval(0.5, variance, degrees), rel=1e-5)


def test_a_policy_is_left_out_of_both_shifts_at_once():
    # In three equal scenes, the first policy shows the shift and the second does not.
    shifted = make_traces(np.repeat([[0.9], [0.3]], 3, axis=1)[..., None], range(3))
    unshifted = make_traces(np.repeat([[0.5], [0.3]], 3, axis=1)[..., None], range(3))

    # 0.9 > 0.5 and 0.3, 0.3 < 0.5, 0.3 = 0.3: 2.5 of 4. The AUC of the second policy is 0.5, that of the first is 1, so
    # the variance by run is 1 / 2 x (0.125^2 + 0.375^2), with one degree of freedom.
    variance = 0.5 * (0.125**2 + 0.375**2)
    assert first_step(auc_by_step(shifted, unshifted)) == pytest.approx(student_interval(0.625, variance, 1))

    # Equal policies show no variance.
    equal_traces = make_traces(np.repeat([[0.9], [0.9]], 3, axis=1)[..., None], range(3))
    assert first_step(mean_by_step(equal_traces)) == pytest.approx([0.9, 0.9, 0.9])


def test_only_running_episodes_count():
    # At step 1 only one episode of one run is running, so its scene and run cannot be left out; at step 2 none is.
    running = [[[True, True, False], [True, False, False], [True, False, False]], [[True, False, False]] * 3]
    shifted = make_traces([[[0.5, 0.5, 9], [0.1, 9, 9], [0.3, 9, 9]]] * 2, range(3), running=running)
    unshifted = make_traces([[[0.3, 0.6, 0.0], [0.3, 0.4, 0.0], [0.3, 0.5, 0.0]]] * 2, range(3))
    means = mean_by_step(shifted)
    aucs = auc_by_step(shifted, unshifted)
    assert means[0, 0, FROZEN, :2] == pytest.approx([0.3, 0.5])
    assert aucs[0, 0, UPDATED, :2] == pytest.approx([0.5, 0.5])
    for mean, low, high in (means, aucs):
        assert np.isfinite(low[..., 0]).all()
        assert np.isnan(low[..., 1:]).all()
        assert np.isnan(high[..., 1:]).all()
        assert np.isnan(mean[..., 2]).all()


def test_the_auc_of_noise_is_a_half_and_that_of_a_shift_is_not():
    rng = np.random.default_rng(7)
    scene = np.repeat(np.arange(20), 5)
    noise, unshifted_noise = rng.random((2, 3, 100, 1))
    unshifted = make_traces(unshifted_noise, scene)
    _, low, high = first_step(auc_by_step(make_traces(noise, scene), unshifted))
    assert 0.3 < low < 0.5 < high < 0.7

    # Uniform against uniform + 0.4: 1 - 0.6^2 / 2 = 0.82, with a standard error of about 0.02.
    mean, low, _ = first_step(auc_by_step(make_traces(noise + 0.4, scene), unshifted))
    assert mean == pytest.approx(0.82, abs=0.06)
    assert low > 0.7


def test_traces_end_with_the_last_step_that_every_shift_reaches():
    # Episodes of one shift have two and three steps, those of the second one and two: two steps remain.
    long_traces = make_traces(np.zeros((1, 2, 4)), range(2), running=[[[1, 1, 0, 0], [1, 1, 1, 0]]])
    short_traces = make_traces(np.zeros((1, 2, 4)), range(2), running=[[[1, 0, 0, 0], [1, 1, 0, 0]]])
    for traces in truncate_to_shortest([long_traces, short_traces]):
        assert traces.gap.shape == (1, 2, 1, 2, 2)
        assert traces.running.shape == (1, 2, 2)


# Walks

ENV, ENV_PARAMS = tiny.world()
AGENT_LOOP = AgentLoop(ENV, tiny.SPEC, tiny.ESTIMATOR)
KNOWLEDGE = tiny.knowledge()
UNGATED = EstimatorConfig(gate=False)
#: `paper` updates on every row, `calibrated` has a gate that shuts, UNGATED has no gate. Their priors differ.
ESTIMATORS = ("paper", "calibrated", UNGATED)
PRIORS = jnp.stack([KNOWLEDGE.priors, 0.3 * KNOWLEDGE.priors, 2 * KNOWLEDGE.priors])
NUM_STEPS = max(tiny.STEP_LIMITS) + 1
KEY = jax.random.key(4)
WEIGHTS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(tiny.random_params, (6, 11)))


def detected_categories(pose) -> np.ndarray:
    """True for the categories that are detected at poses, bool [..., K]."""
    return RowFormat(len(tiny.CATEGORIES)).presence(tiny.BANK.rows[pose])


def draw_walks() -> EpisodeList:
    """Five episodes in each scene, of which two start with a level view of two categories or more."""
    episodes = draw_episodes(tiny.BANK, 10, seed=1)

    # Level poses with a view of two categories or more; those of scene 1, the bedroom, come last.
    poses = np.arange(len(tiny.BANK.rows))
    is_level = poses % len(tiny.BANK.task.rules.horizons) == 0
    poses = poses[is_level & (detected_categories(poses).sum(axis=1) >= 2)]
    is_in_bedroom = poses >= tiny.BANK.first_cell[1] * tiny.POSES_PER_CELL

    # The first two episodes of each scene start at the first and the last of these poses.
    for scene in (0, 1):
        first_episodes = np.flatnonzero(episodes.scene == scene)[:2]
        episodes.pose[first_episodes] = poses[is_in_bedroom == scene][[0, -1]]
    return episodes


EPISODES = draw_walks()
STEP_LIMITS = np.array(tiny.STEP_LIMITS)[EPISODES.scene]


def walk(weights) -> GapTraces:
    settings = {"estimators": ESTIMATORS, "priors": PRIORS, "num_steps": NUM_STEPS, "key": KEY}
    return trace_gaps(weights, EPISODES, ENV_PARAMS, AGENT_LOOP, KNOWLEDGE, **settings)


def single_action_weights(action: int):
    """Parameters of policies that always take one action."""
    bias = WEIGHTS["actor"]["bias"].at[:, action].set(1e4)
    return WEIGHTS | {"actor": WEIGHTS["actor"] | {"bias": bias}}


@pytest.fixture(scope="module")
def standing_traces() -> GapTraces:
    """Traces of policies that always see one view."""
    return walk(single_action_weights(LOOK_UP))


@functools.partial(jax.jit, static_argnums=0)
def update_belief(estimator, prior, belief, presence):
    return LayoutEstimator(prior, estimator).update(belief, presence)


@jax.jit
def sample_step(policy_index, episode, time, pose, logits):
    """Sampled action and next pose."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(KEY, policy_index), episode), time)
    action = jax.random.categorical(key, logits).astype(jnp.int32)
    return action, ENV.next_pose(pose, action, ENV_PARAMS)


@pytest.mark.slow
def test_traces_are_those_of_a_plain_loop():
    traces = walk(WEIGHTS)
    assert traces.gap.shape == (3, 2, 2, len(EPISODES.pose), NUM_STEPS + 1)
    assert traces.gap.dtype == np.float32
    lengths = set()
    for policy_index, episode in ((0, 0), (0, 6), (1, 1), (1, 9)):
        scene = EPISODES.scene[episode]
        goal = jnp.int32(EPISODES.goal[episode])
        room = int(ENV_PARAMS.room[scene])

        # Before the first view, both beliefs of every estimator equal its prior.
        beliefs = []
        for estimator, prior in zip(ESTIMATORS, PRIORS[:, room], strict=True):
            beliefs.append([LayoutEstimator(prior, estimator).init()] * 2)
        layout = None
        memory = PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
        pose = int(EPISODES.pose[episode])
        running = True
        time = 0
        while running:
            # Every estimator observes the view; its frozen belief returns to the prior.
            for index, (estimator, prior) in enumerate(zip(ESTIMATORS, PRIORS[:, room], strict=True)):
                presence = detected_categories(pose)
                updated = update_belief(estimator, prior, beliefs[index][UPDATED], presence)
                frozen = update_belief(estimator, prior, beliefs[index][FROZEN], presence)
                gaps = traces.gap[index, :, policy_index, episode, time]
                np.testing.assert_allclose(gaps, [updated.gap, frozen.gap], atol=1e-6)
                beliefs[index] = [updated, frozen.replace(alpha=prior)]

            # The policy acts by its own estimate of the layout.
            row = jnp.asarray(tiny.BANK.rows[pose])
            layout = tiny.believe(KNOWLEDGE.priors[room], layout, row)
            weights = tiny.leaves_at(WEIGHTS, policy_index)
            decision, _ = tiny.decide(weights, row, goal, tiny.goal_weights(layout, goal), memory)
            action, pose = sample_step(policy_index, episode, time, pose, decision.logits)
            memory = PolicyState(decision.hidden, action)
            time += 1
            running = action != DONE and time < STEP_LIMITS[episode]
        lengths.add(time)
        assert traces.running[policy_index, episode].tolist() == [True] * time + [False] * (NUM_STEPS + 1 - time)
    assert len(lengths) > 1


def test_the_gap_of_a_view_that_stays_has_a_closed_form(standing_traces):
    for episode in (0, 1, 5, 6):
        presence = detected_categories(EPISODES.pose[episode]).astype(int)
        assert presence.sum() >= 2
        counts = np.outer(presence, presence) * (1 - np.eye(len(presence), dtype=int))
        prior = np.asarray(PRIORS[2][ENV_PARAMS.room[EPISODES.scene[episode]]])[presence > 0]

        # The belief of UNGATED gains the view's counts at every step.
        num_steps = STEP_LIMITS[episode]
        updated = standing_traces.gap[2, UPDATED, 0, episode, :num_steps]
        for step in range(num_steps):
            divergences = []
            for row, row_counts in zip(prior, counts[presence > 0], strict=True):
                is_other = row > 0
                divergences.append(exact_kl((row + step * row_counts)[is_other], row_counts[is_other]))
            np.testing.assert_allclose(updated[step], np.tanh(np.mean(divergences)), rtol=2e-4)

        # The frozen gap is that of the first step at every step.
        frozen = standing_traces.gap[2, FROZEN, 0, episode, :num_steps]
        np.testing.assert_array_equal(frozen, np.full(num_steps, frozen[0]))
        assert frozen[0] == updated[0] > updated[1]

        # The gate of `calibrated` stays shut: both gaps decay by 0.8 a step.
        for belief in (UPDATED, FROZEN):
            gap = standing_traces.gap[1, belief, 0, episode, :num_steps]
            np.testing.assert_allclose(gap, gap[0] * 0.8 ** np.arange(num_steps), rtol=1e-5)


def test_episodes_run_to_their_limit_or_to_done(standing_traces):
    # With a limit of L, steps 0 ... L - 1 are running; with Done as the first action, only step 0 is.
    np.testing.assert_array_equal(standing_traces.running[0], np.arange(NUM_STEPS + 1) < STEP_LIMITS[:, None])
    np.testing.assert_array_equal(walk(single_action_weights(DONE)).running.sum(axis=-1), 1)
