"""Training in two streams: experience dropout, the stages, replay, and which stream a gradient reaches."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, LENGTH, PARAMS, changed_parts, choice_log_probs, collect_rollouts

from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, ppo_loss, replay_rollout
from jaxnav.training.trainer import Trainer

EXPERIENCE_PROB = 0.7
#: Steps of all environments in an update by the default settings.
STEPS_PER_UPDATE = PPOConfig().num_envs * PPOConfig().rollout
#: Steps of 10 chunks of 2 updates.
TOTAL_STEPS = 10 * 2 * STEPS_PER_UPDATE
NUM_ROLLOUTS = 3
#: Replayed in parallel over time; adapting; attending with the memory.
HOST_PARAMS = [
    "org",
    pytest.param("support.methods:ADAPTIVE", marks=pytest.mark.slow),
    pytest.param("support.methods:ATTENTIVE", marks=pytest.mark.exhaustive),
]
DIRECT_PARTS = {"actor", "critic", "core", "fuse", "view", "detections", "appearance", "sought"}


def make_spec(method_name):
    return dataclasses.replace(tiny.STREAMS, method=find_method(method_name), method_sizes=())


def make_learner(method_name, experience=0.8, **settings):
    config = PPOConfig(num_envs=ENVS, rollout=LENGTH, minibatches=4, experience=experience, **settings)
    return Learner(AgentLoop(ENV, make_spec(method_name), tiny.ESTIMATOR), config, "none")


def scalars_by_stage(config):
    return config.ppo.stage_scalars(config.stages, config.stage_by_chunk, config.chunk)


@functools.cache
def collect_stream_rollouts(method_name):
    """The weights of a policy, and rollouts that continue one another; transitions have leaves [LENGTH, ENVS, ...]."""
    learner = make_learner(method_name, experience=EXPERIENCE_PROB)
    weights = tiny.random_params(3, make_spec(method_name))
    first_state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    _, rollouts = collect_rollouts(
        learner.agent_loop,
        weights,
        range(NUM_ROLLOUTS),
        first_agent=first_state.agent,
        experience_prob=jnp.float32(EXPERIENCE_PROB),
    )
    return weights, rollouts


# Experience dropout: whether experience has a part in an episode


@pytest.mark.slow
def test_use_of_experience_is_constant_within_an_episode():
    _, rollouts = collect_stream_rollouts("org")
    use_experience = np.concatenate([rollout.transitions.use_experience for rollout in rollouts])
    ended = np.concatenate([rollout.transitions.ended for rollout in rollouts])
    has_changed = use_experience[1:] != use_experience[:-1]
    assert set(np.unique(use_experience)) == {0, 1}
    assert not has_changed[~ended[:-1]].any()

    # The draws of successive episodes are independent: two differ with probability 2 p (1 - p).
    expected_share = 2 * EXPERIENCE_PROB * (1 - EXPERIENCE_PROB)
    assert has_changed[ended[:-1]].mean() == pytest.approx(expected_share, abs=0.15)

    # The memory brings the draw into the next rollout.
    for rollout, next_rollout in itertools.pairwise(rollouts):
        running = ~rollout.transitions.ended[-1]
        expected = rollout.transitions.use_experience[-1]
        np.testing.assert_array_equal(next_rollout.initial_memory.use_experience[running], expected[running])


@pytest.mark.slow
@pytest.mark.parametrize("experience_prob", [0.25, pytest.param(0.8, marks=pytest.mark.exhaustive)])
def test_use_of_experience_has_the_configured_probability(experience_prob):
    learner = make_learner("org", experience=experience_prob)
    learner = dataclasses.replace(learner, config=dataclasses.replace(learner.config, num_envs=1024))

    # At the first start and at a restart.
    state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    first_use = state.agent.memory.use_experience
    restarted_use = jax.jit(learner.restart_episodes)(state, PARAMS, KNOWLEDGE).agent.memory.use_experience
    assert first_use.mean() == pytest.approx(experience_prob, abs=0.05)
    assert restarted_use.mean() == pytest.approx(experience_prob, abs=0.05)
    assert (restarted_use != first_use).any()

    # In episodes that begin during a rollout.
    weights = tiny.random_params(3, tiny.STREAMS)
    agents, (rollout,) = collect_rollouts(
        learner.agent_loop,
        weights,
        seeds=(1,),
        first_agent=state.agent,
        experience_prob=jnp.float32(experience_prob),
    )
    last_use = agents[-1].memory.use_experience
    is_new_episode = rollout.transitions.ended.any(axis=0)
    assert is_new_episode.sum() > 500
    assert last_use[is_new_episode].mean() == pytest.approx(experience_prob, abs=0.06)
    np.testing.assert_array_equal(last_use[~is_new_episode], first_use[~is_new_episode])


@pytest.mark.parametrize(
    ("drawn", "expected_share"),
    [
        pytest.param("step", pytest.approx(0.5, abs=0.25), marks=pytest.mark.slow),
        pytest.param("episode", 0.0, marks=pytest.mark.exhaustive),
    ],
)
def test_use_of_experience_changes_within_an_episode_only_if_drawn_every_step(drawn, expected_share):
    learner = make_learner("org", experience=0.5, experience_drawn=drawn)
    state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    use_before = np.asarray(state.agent.memory.use_experience)
    scalars = learner.config.scalars(num_updates=1)
    agent_after = jax.jit(learner.update)(state, scalars, PARAMS, KNOWLEDGE)[0].agent

    # Where no episode has begun since.
    is_same_episode = np.asarray(agent_after.state.time) == LENGTH
    assert is_same_episode.sum() > ENVS / 4
    has_changed = agent_after.memory.use_experience[is_same_episode] != use_before[is_same_episode]
    assert has_changed.mean() == expected_share


# Stages


@pytest.mark.exhaustive
def test_trainer_trains_the_direct_stream_alone_and_then_both():
    """Two updates of each; each stage has an optimizer of its own."""
    learner = make_learner("org", experience=EXPERIENCE_PROB)
    config = RunConfig(decision="streams", arms=("layout",), seeds=1, chunk=2, total_steps=4 * ENVS * LENGTH)
    config = check_config(dataclasses.replace(config, ppo=learner.config))
    assert config.stage_by_chunk == [0, 1]
    trainer = Trainer(
        {"layout": learner},
        config.stages,
        [jax.tree.map(lambda leaf: leaf[None], scalars) for scalars in scalars_by_stage(config)],
        KNOWLEDGE,
        jax.random.key(0),
        seeds=[0],
        chunk_size=2,
    )

    # The first stage starts without experience, also after a restart.
    first_states = trainer.init(PARAMS)
    first_state = jax.device_get(first_states["layout"][0])
    restarted_state = jax.device_get(trainer.restart(first_states, PARAMS, 0)["layout"][0])
    assert not first_state.agent.memory.use_experience.any()
    assert not restarted_state.agent.memory.use_experience.any()

    # The first stage changes the direct stream alone.
    states, _ = trainer.train(trainer.init(PARAMS), PARAMS, 0)
    params_after_first_stage = jax.device_get(states["layout"][0].params)
    assert changed_parts(first_state.params, params_after_first_stage) == DIRECT_PARTS

    # The second stage changes the experience stream too.
    states = trainer.restart(states, PARAMS, 1)
    use_experience = states["layout"][0].agent.memory.use_experience
    assert use_experience.mean() == pytest.approx(EXPERIENCE_PROB, abs=0.25)
    last_state = jax.device_get(trainer.train(states, PARAMS, 1)[0]["layout"][0])
    last_changed = changed_parts(params_after_first_stage, last_state.params)
    assert {"experience_stream", "known_appearance", "method"} <= last_changed

    # The optimizer counts the minibatches of its stage alone.
    optimizer_leaves = jax.tree.leaves(last_state.opt_state.inner_state)
    optimizer_counts = [int(leaf) for leaf in optimizer_leaves if leaf.dtype == jnp.int32]
    assert optimizer_counts == [2 * learner.config.minibatches]


def test_stages_of_tpn_in_streams_end_with_its_imitation():
    """Of ten chunks the tentative policy's imitation has the last two."""
    config = RunConfig(method="tpn", decision="streams", chunk=2, total_steps=TOTAL_STEPS)
    assert config.stage_by_chunk == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2]
    direct_alone, both_streams, imitation = config.stages
    assert (direct_alone.direct_stream_only, direct_alone.uses_expert, direct_alone.adapts_online) == (
        True,
        False,
        False,
    )
    assert (both_streams.direct_stream_only, both_streams.uses_expert, both_streams.adapts_online) == (
        False,
        False,
        False,
    )
    assert (imitation.direct_stream_only, imitation.uses_expert, imitation.adapts_online) == (False, True, True)


def test_stages_of_vtnet_in_streams_have_learning_rate_schedules_of_their_own():
    """Of ten chunks VTNet's imitation has two, the direct stream alone four, and both streams four."""
    config = RunConfig(method="vtnet", decision="streams", chunk=2, total_steps=TOTAL_STEPS)
    assert config.stage_by_chunk == [0, 0, 1, 1, 1, 1, 2, 2, 2, 2]
    assert [stage.direct_stream_only for stage in config.stages] == [False, True, False]
    assert config.steps_by_purpose["imitation"] == 2 * 2 * STEPS_PER_UPDATE

    stage_scalars = scalars_by_stage(config)
    assert [float(scalars.first_update) for scalars in stage_scalars] == [0, 4, 12]
    assert [float(scalars.num_updates) for scalars in stage_scalars] == [4, 8, 8]

    # Once the experience stream is added, the initial rate is half the default (`experience_rate`), since the added
    # stream disturbs a policy that has already learned.
    default_rate = PPOConfig().learning_rate
    expected_rates = [default_rate, default_rate, 0.5 * default_rate]
    assert [float(scalars.learning_rate) for scalars in stage_scalars] == pytest.approx(expected_rates)


def test_fused_training_has_one_learning_rate_schedule():
    config = RunConfig(method="org", decision="fused", chunk=2, total_steps=TOTAL_STEPS)
    (scalars,) = scalars_by_stage(config)
    assert float(scalars.first_update) == 0
    assert float(scalars.num_updates) == 20


# Replay and gradients


@pytest.mark.slow
@pytest.mark.parametrize("method_name", HOST_PARAMS)
def test_replay_of_streams_recomputes_log_probs_and_values(method_name):
    weights, rollouts = collect_stream_rollouts(method_name)
    agent_loop = make_learner(method_name).agent_loop

    @jax.jit
    def replay(transitions, memory):
        return replay_rollout(agent_loop.bind(weights), transitions, memory, PARAMS).factual

    for transitions, memory, _ in rollouts[1:]:
        assert transitions.ended[:-1].sum() > 20
        assert 0.5 < transitions.use_experience.mean() < 0.9
        decisions = replay(transitions, memory)
        error = np.abs(choice_log_probs(decisions.logits, transitions.choice) - transitions.log_prob)
        # Logits are rounded to 2**-10, now and then to the other side.
        assert error.max() < 2.0**-9
        assert (error < 1e-5).mean() > 0.98
        np.testing.assert_allclose(decisions.value, transitions.value, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("method_name", HOST_PARAMS)
def test_gradient_reaches_the_direct_stream_alone_or_the_experience_stream(method_name):
    """The direct stream learns where it acts alone, the experience stream where it adds to that."""
    weights, rollouts = collect_stream_rollouts(method_name)
    transitions, memory, _ = rollouts[1]
    advantage = jnp.asarray(np.random.default_rng(0).normal(size=(LENGTH, ENVS)), jnp.float32)
    scalars = PPOConfig().scalars(1)
    agent_loop = make_learner(method_name).agent_loop

    @jax.jit
    def compute_gradient(use_experience):
        changed_transitions = transitions._replace(use_experience=jnp.full((LENGTH, ENVS), use_experience))

        def loss(weights):
            replayed = replay_rollout(agent_loop.bind(weights), changed_transitions, memory, PARAMS)
            return ppo_loss(replayed, advantage, scalars, False, find_method(method_name))[0]

        return jax.grad(loss)(weights)

    for use_experience in (0.0, 1.0):
        # The kernel of the view holds those of both streams side by side.
        gradient = compute_gradient(use_experience)
        direct_view, experience_view = jnp.split(gradient["view"]["kernel"], 2, axis=-1)
        gradient |= {"view": direct_view, "experience_view": experience_view}
        zeros = jax.tree.map(jnp.zeros_like, gradient)
        reached = changed_parts(zeros, gradient)

        # Attention does not read the appearance.
        unread_parts = {"known_appearance"} if method_name.endswith("ATTENTIVE") else set()
        experience_parts = gradient.keys() - DIRECT_PARTS - unread_parts
        assert reached - unread_parts == (experience_parts if use_experience else DIRECT_PARTS)


@pytest.mark.slow
def test_update_changes_the_actors_of_both_streams():
    learner = make_learner("org")
    state = jax.jit(learner.init)(jax.random.key(0), PARAMS, KNOWLEDGE)
    next_state, metrics = jax.jit(learner.update)(state, learner.config.scalars(4), PARAMS, KNOWLEDGE)
    for value in metrics.values():
        assert np.isfinite(value)
    for old_params, new_params in (
        (state.params["actor"], next_state.params["actor"]),
        (state.params["experience_stream"]["actor"], next_state.params["experience_stream"]["actor"]),
    ):
        assert changed_parts(old_params, new_params) == {"kernel", "bias"}
