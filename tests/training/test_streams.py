"""Training in two streams: one coin per episode says whether experience has a part in it."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS

from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, collect_rollout, ppo_loss, replay_rollout
from jaxnav.training.trainer import Trainer

SHARE, ROLLOUTS = 0.7, 3
#: In parallel over time, attending with the memory, and adapting.
HOSTS = ["org", "support.methods:ATTENTIVE", "support.methods:ADAPTIVE"]


def spec_of(method):
    return dataclasses.replace(tiny.STREAMS, method=find_method(method), method_sizes=())


def acting_with(method):
    return AgentLoop(ENV, spec_of(method), tiny.ESTIMATOR)


def scalars_of(config):
    return config.ppo.stage_scalars(config.stages, config.stage_by_chunk, config.chunk)


def learner_with(method, **settings):
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=4, **settings)
    return Learner(acting_with(method), config, "none")


@functools.cache
def rolled(method):
    """Weights, and rollouts that go on from one another."""
    learner = learner_with(method, experience=SHARE)
    acting, weights = learner.agent_loop, tiny.random_params(3, spec_of(method))

    @jax.jit
    def go(agent, key, share):
        return collect_rollout(
            acting, acting.bind(weights), agent, key, PARAMS, KNOWLEDGE, num_steps=LENGTH, experience_prob=share
        )

    agent, rollouts = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE).agent, []
    for number in range(ROLLOUTS):
        agent, rollout = go(agent, jax.random.key(number), jnp.float32(SHARE))
        rollouts.append(rollout)
    return weights, rollouts


# The coin


@pytest.mark.slow
def test_the_coin_is_constant_within_an_episode():
    _, rollouts = rolled("org")
    coins, ended = (
        np.concatenate([getattr(rollout.transitions, name) for rollout in rollouts])
        for name in ("use_experience", "ended")
    )
    changes = coins[1:] != coins[:-1]
    assert set(np.unique(coins)) == {0, 1}
    assert not changes[~ended[:-1]].any()
    # Of the episodes that follow one another many differ: their coins are their own.
    expected = 2 * SHARE * (1 - SHARE)
    assert changes[ended[:-1]].mean() == pytest.approx(expected, abs=0.15)
    for before, after in itertools.pairwise(rollouts):
        goes_on = ~before.transitions.ended[-1]
        np.testing.assert_array_equal(
            after.initial_memory.use_experience[goes_on], before.transitions.use_experience[-1][goes_on]
        )


@pytest.mark.parametrize("share", [0.25, pytest.param(0.8, marks=pytest.mark.slow)])
def test_its_share_is_as_configured(share):
    learner, weights = learner_with("org", experience=share), tiny.random_params(3, tiny.STREAMS)
    learner = dataclasses.replace(learner, config=dataclasses.replace(learner.config, num_envs=1024))
    state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    first = state.agent.memory.use_experience
    assert first.mean() == pytest.approx(share, abs=0.05)
    again = jax.jit(learner.restart_episodes)(state, PARAMS, KNOWLEDGE).agent.memory.use_experience
    assert again.mean() == pytest.approx(share, abs=0.05)
    assert (again != first).any()

    acting = learner.agent_loop
    after, rollout = jax.jit(
        lambda share: collect_rollout(
            acting,
            acting.bind(weights),
            state.agent,
            jax.random.key(1),
            PARAMS,
            KNOWLEDGE,
            num_steps=LENGTH,
            experience_prob=share,
        )
    )(jnp.float32(share))
    fresh = rollout.transitions.ended.any(axis=0)
    assert fresh.sum() > 500
    assert after.memory.use_experience[fresh].mean() == pytest.approx(share, abs=0.06)
    np.testing.assert_array_equal(after.memory.use_experience[~fresh], first[~fresh])


@pytest.mark.parametrize("drawn", ["episode", pytest.param("step", marks=pytest.mark.slow)])
def test_experience_comes_and_goes_within_an_episode_only_if_drawn_at_every_step(drawn):
    learner = learner_with("org", experience=0.5, experience_drawn=drawn)
    state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    before = np.asarray(state.agent.memory.use_experience)
    scalars = learner.config.scalars(num_updates=1)
    agent = jax.jit(learner.update)(state, scalars, PARAMS, KNOWLEDGE)[0].agent
    goes_on = np.asarray(agent.state.time) == LENGTH  # no episode has begun since
    assert goes_on.sum() > ENVS / 4
    other = agent.memory.use_experience[goes_on] != before[goes_on]
    assert other.mean() == (pytest.approx(0.5, abs=0.25) if drawn == "step" else 0.0)


def moved(before, after):
    """Which parts of the parameters differ."""
    changed = jax.tree.map(lambda old, new: bool((old != new).any()), before, after)
    return {name for name, part in changed.items() if any(jax.tree.leaves(part))}


@pytest.mark.slow
def test_the_direct_stream_is_alone_first():
    """Two updates of it, then two of both; each stage has an optimizer and a course of the rate of its own."""
    config = RunConfig(decision="streams", arms=("layout",), seeds=1, chunk=2, total_steps=4 * ENVS * LENGTH)
    config = check_config(dataclasses.replace(config, ppo=learner_with("org", experience=SHARE).config))
    assert config.stage_by_chunk == [0, 1]
    trainer = Trainer(
        {"layout": learner_with("org", experience=SHARE)},
        config.stages,
        scalars_of(config),
        KNOWLEDGE,
        jax.random.key(0),
        num_seeds=1,
        chunk_size=2,
    )
    first = trainer.init(PARAMS)
    begin = jax.device_get(first["layout"][0])
    assert not begin.agent.memory.use_experience.any()
    assert not jax.device_get(trainer.restart(first, PARAMS, 0)["layout"][0]).agent.memory.use_experience.any()
    middle = jax.device_get(trainer.train(trainer.init(PARAMS), PARAMS, 0)[0]["layout"][0])
    direct = {"actor", "critic", "core", "fuse", "detections", "appearance", "sought", "view"}
    assert moved(begin.params, middle.params) == direct

    states, _ = trainer.train(trainer.init(PARAMS), PARAMS, 0)
    states = trainer.restart(states, PARAMS, 1)
    assert states["layout"][0].agent.memory.use_experience.mean() == pytest.approx(SHARE, abs=0.25)
    after = jax.device_get(trainer.train(states, PARAMS, 1)[0]["layout"][0])
    assert {"experience_stream", "known_appearance", "method"} <= moved(middle.params, after.params)
    counts = [leaf for leaf in jax.tree.leaves(after.opt_state.inner_state) if leaf.dtype == jnp.int32]
    assert [int(count) for count in counts] == [2 * learner_with("org").config.minibatches]  # those of its stage alone


def test_the_direct_stream_is_alone_in_the_stage_that_learns_last():
    """Of ten chunks the tentative policy's imitation has the last two."""
    config = RunConfig(method="tpn", decision="streams", chunk=2, total_steps=10 * 2 * 3840)
    assert config.stage_by_chunk == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2]
    assert [(stage.direct_stream_only, stage.uses_expert, stage.adapts_online) for stage in config.stages] == [
        (True, False, False),
        (False, False, False),
        (False, True, True),
    ]


def test_the_rate_runs_its_course_in_every_stage():
    """Of ten chunks VTNet's imitation has two, the direct stream alone four; Adam's first step is the rate."""
    config = RunConfig(method="vtnet", decision="streams", chunk=2, total_steps=10 * 2 * 3840)
    assert config.stage_by_chunk == [0, 0, 1, 1, 1, 1, 2, 2, 2, 2]
    assert [stage.direct_stream_only for stage in config.stages] == [False, True, False]
    assert [(float(scalars.first_update), float(scalars.num_updates)) for scalars in scalars_of(config)] == [
        (0, 4),
        (4, 8),
        (12, 8),
    ]
    assert [float(scalars.learning_rate) for scalars in scalars_of(config)] == pytest.approx([4e-3, 4e-3, 2e-3])
    assert config.steps_by_purpose["imitation"] == 2 * 2 * 3840
    fused = dataclasses.replace(config, method="org", decision="fused")
    assert [(float(scalars.first_update), float(scalars.num_updates)) for scalars in scalars_of(fused)] == [(0, 20)]


# Replay


@pytest.mark.parametrize("method", [HOSTS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in HOSTS[1:])])
def test_replay_decides_as_the_rollout_did(method):
    weights, rollouts = rolled(method)
    again = jax.jit(lambda t, memory: replay_rollout(acting_with(method).bind(weights), t, memory, PARAMS).factual)
    for transitions, memory, _ in rollouts[1:]:
        assert transitions.ended[:-1].sum() > 20
        assert 0.5 < transitions.use_experience.mean() < 0.9
        result = again(transitions, memory)
        log_pi = jax.nn.log_softmax(result.logits)
        log_prob = jnp.take_along_axis(log_pi, transitions.choice[..., None], axis=-1)[..., 0]
        error = np.abs(log_prob - transitions.log_prob)
        assert error.max() < 2.0**-9  # logits are rounded to 2**-10, now and then to the other side
        assert (error < 1e-5).mean() > 0.98
        np.testing.assert_allclose(result.value, transitions.value, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", [HOSTS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in HOSTS[1:])])
def test_each_stream_learns_where_it_acts_last(method):
    """The direct stream where it is alone, experience where it adds to it."""
    weights, rollouts = rolled(method)
    transitions, memory, _ = rollouts[1]
    advantage = jnp.asarray(np.random.default_rng(0).normal(size=(LENGTH, ENVS)), jnp.float32)
    scalars, acting = PPOConfig().scalars(1), acting_with(method)

    @jax.jit
    def gradient(coin):
        given = transitions._replace(use_experience=jnp.full((LENGTH, ENVS), coin))

        def loss(weights):
            replayed = replay_rollout(acting.bind(weights), given, memory, PARAMS)
            return ppo_loss(replayed, advantage, scalars, False, find_method(method))[0]

        return jax.grad(loss)(weights)

    for coin in (0.0, 1.0):
        result = gradient(coin)
        views = jnp.split(result["view"]["kernel"], 2, axis=-1)
        result |= {"view": views[0], "experience_view": views[1]}
        taught = {name: any(leaf.any() for leaf in jax.tree.leaves(node)) for name, node in result.items()}
        direct = {"actor", "critic", "core", "fuse", "view", "detections", "appearance", "sought"}
        assert {taught[name] for name in direct} == {not coin}
        unread = {"known_appearance"} if method.endswith("ATTENTIVE") else set()  # it does not read them
        assert {taught[name] for name in result.keys() - direct - unread} == {bool(coin)}


@pytest.mark.slow
def test_an_update_teaches_both_streams():
    learner = learner_with("org")
    before = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    after, metrics = jax.jit(learner.update)(before, learner.config.scalars(4), PARAMS, KNOWLEDGE)
    assert all(np.isfinite(value) for value in metrics.values())
    changed = jax.tree.map(lambda old, new: bool((old != new).any()), before.params, after.params)
    assert all(jax.tree.leaves([changed["actor"], changed["experience_stream"]["actor"]]))
