"""Gaps along walks, against a plain loop and closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.dirichlet import exact_kl

from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.layout import EstimatorConfig, LayoutEstimator
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.pathways import NO_ACTION, PolicyState
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, LOOK_UP
from jaxnav.study.gap_traces import FROZEN, UPDATED, GapTraces, trace_gaps

ENV, PARAMS = tiny.world()
ACTING = AgentLoop(ENV, tiny.SPEC, tiny.SETTING)
KNOWLEDGE = tiny.knowledge()


def presence(pose):
    return RowFormat(len(tiny.CATEGORIES)).presence(tiny.BANK.rows[pose])


def episodes():
    """Return five in each scene.

    The first two start where two categories are in view, looking level (horizon 0).
    """
    drawn = draw_episodes(tiny.BANK, 10, seed=1)
    poses = np.arange(len(tiny.BANK.rows))
    poses = poses[(presence(poses).sum(axis=1) >= 2) & (poses % len(tiny.BANK.task.rules.horizons) == 0)]
    in_bedroom = poses >= tiny.BANK.first_cell[1] * tiny.POSES_PER_CELL
    for scene in (0, 1):
        drawn.pose[np.flatnonzero(drawn.scene == scene)[:2]] = poses[in_bedroom == scene][[0, -1]]
    return drawn


EPISODES = episodes()
OPEN = EstimatorConfig(gate=False)
#: `paper` sees every row, `calibrated` has a gate that shuts, OPEN none; each has another prior.
SETTINGS = ("paper", "calibrated", OPEN)
PRIORS = jnp.stack([KNOWLEDGE.layout, 0.3 * KNOWLEDGE.layout, 2 * KNOWLEDGE.layout])
STEPS = max(tiny.LIMITS) + 1
KEY = jax.random.key(4)
WEIGHTS = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(tiny.lively, (6, 11)))


def traced(weights) -> GapTraces:
    return trace_gaps(weights, EPISODES, PARAMS, ACTING, KNOWLEDGE, SETTINGS, PRIORS, STEPS, KEY)


def always(action):
    """Return policies that take one action only."""
    bias = WEIGHTS["actor"]["bias"].at[:, action].set(1e4)
    return WEIGHTS | {"actor": WEIGHTS["actor"] | {"bias": bias}}


@pytest.fixture(scope="module")
def traces():
    return traced(WEIGHTS)


@pytest.fixture(scope="module")
def standing():
    """Return traces of policies that always see one view."""
    return traced(always(LOOK_UP))


# Traces


@functools.partial(jax.jit, static_argnums=0)
def update(setting, prior, belief, seen):
    return LayoutEstimator(prior, setting).update(belief, seen)


@jax.jit
def follow(n, e, t, pose, logits):
    """Return the sampled action, and the pose after it."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(KEY, n), e), t)
    action = jax.random.categorical(key, logits).astype(jnp.int32)
    return action, ENV.next_pose(pose, action, PARAMS)


@pytest.mark.slow
def test_traces_are_those_of_a_plain_loop(traces):
    assert traces.gap.shape == (3, 2, 2, len(EPISODES.pose), STEPS + 1)
    assert traces.gap.dtype == np.float32
    lengths = set()
    for n, e in ((0, 0), (0, 6), (1, 1), (1, 9)):
        scene, goal = EPISODES.scene[e], jnp.int32(EPISODES.goal[e])
        room = int(PARAMS.room[scene])
        layout, memory = None, PolicyState(jnp.zeros(tiny.SIZES.hidden), jnp.int32(NO_ACTION))
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
            layout = tiny.believe(KNOWLEDGE.layout[room], layout, row)
            decision, _ = tiny.decide(tiny.leaves_at(WEIGHTS, n), row, goal, tiny.goal_weights(layout, goal), memory)
            action, pose = follow(n, e, t, pose, decision.logits)
            memory = PolicyState(decision.hidden, action)
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
