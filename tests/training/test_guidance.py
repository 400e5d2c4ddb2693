"""Guidance adds to the loss the cross-entropy to the next action of a shortest path along the policy's rollouts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny
from support.rollouts import AGENT_LOOP, CONFIG, LEARNER, PARAMS, record_rollout

from jaxnav.env.make import build_environment
from jaxnav.errors import InputError
from jaxnav.policies.methods import METHODS
from jaxnav.runs.config import RunConfig, WorldConfig, check_config, fill_world_defaults
from jaxnav.runs.worlds import compile_training_world
from jaxnav.scenes.worlds import WORLDS
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import ppo_loss, replay_rollout

#: The drawn rooms with the actions of shortest paths.
LIMITS = {"kitchen": tiny.STEP_LIMITS[0], "bedroom": tiny.STEP_LIMITS[1]}
_, GUIDED_PARAMS = build_environment(tiny.BANK, LIMITS, 0, with_expert=True)
METHOD = METHODS["org"]


def guided_ppo(**settings):
    return dataclasses.replace(CONFIG, **settings)


def loss_terms(config, env_params):
    """The loss of a recorded rollout, its terms by name, and the factual logits."""
    recorded = record_rollout(False)
    transitions, memory = jax.tree.map(jnp.asarray, (recorded.transitions, recorded.memory))

    def compute(weights):
        replay = replay_rollout(AGENT_LOOP.bind(weights), transitions, memory, env_params)
        return *ppo_loss(replay, transitions.reward, config.scalars(10), False, METHOD), replay.factual.logits

    return jax.tree.map(np.asarray, jax.jit(compute)(recorded.weights))


@pytest.mark.slow
def test_guidance_adds_the_weighted_cross_entropy_to_shortest_paths():
    loss, terms, logits = loss_terms(guided_ppo(guidance=0.3), GUIDED_PARAMS)
    plain_loss, plain_terms, _ = loss_terms(CONFIG, PARAMS)

    # Step by step: minus the log-probability of the action that the table of shortest paths holds.
    transitions = record_rollout(False).transitions
    expert = tiny.BANK.expert
    cross_entropies = []
    for time, env in np.ndindex(transitions.pose.shape):
        action = expert[transitions.pose[time, env], transitions.goal[time, env]]
        step_logits = logits[time, env].astype(np.float64)
        log_probs = step_logits - np.log(np.exp(step_logits).sum())
        has_action = action < len(log_probs)
        cross_entropies.append(-log_probs[action] if has_action else 0.0)
    np.testing.assert_allclose(terms["imitation_loss"], np.mean(cross_entropies), rtol=1e-5)
    np.testing.assert_allclose(loss, plain_loss + 0.3 * np.mean(cross_entropies), rtol=1e-5)
    assert set(terms) - set(plain_terms) == {"imitation_loss", "imitation_agreement"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("final_guidance", "expected_guidance"), [pytest.param(None, 0.8, marks=pytest.mark.exhaustive), (0.0, 0.6)]
)
def test_guidance_changes_to_its_final_weight_within_a_stage(final_guidance, expected_guidance):
    """Update 1 of 4: a quarter of the way from 0.8 to 0 is 0.6; without a final weight it stays 0.8."""
    config = guided_ppo(guidance=0.8, final_guidance=final_guidance, learning_rate=0.0, epochs=1, minibatches=1)
    learner = dataclasses.replace(LEARNER, config=config)
    knowledge = tiny.knowledge()
    state = learner.init(jax.random.key(0), GUIDED_PARAMS, knowledge).replace(update=jnp.int32(1))

    # The learning rate is 0, so the gradients of all learners belong to the same parameters and the same rollout.
    learners = {
        "guided": learner,
        "plain": constant_guidance_learner(config, 0.0),
        "reference": constant_guidance_learner(config, expected_guidance),
    }
    gradient_norms = {}
    for name, compared_learner in learners.items():
        update = jax.jit(compared_learner.update)
        _, metrics = update(state, compared_learner.config.scalars(4), GUIDED_PARAMS, knowledge)
        gradient_norms[name] = float(metrics["gradient_norm"])
    assert gradient_norms["guided"] != pytest.approx(gradient_norms["plain"], rel=1e-3)
    assert gradient_norms["guided"] == pytest.approx(gradient_norms["reference"], rel=1e-5)


def constant_guidance_learner(config, guidance):
    """A learner whose guidance has a constant weight."""
    return dataclasses.replace(LEARNER, config=dataclasses.replace(config, guidance=guidance, final_guidance=guidance))


@pytest.mark.slow
def test_a_guided_policy_agrees_with_shortest_paths_more_often():
    """Ten updates in the small world, with and without guidance, start from equal parameters."""
    knowledge = tiny.knowledge()
    agreement = {}
    for weight in (1e-9, 3.0):  # a negligible weight still measures the agreement
        config = guided_ppo(guidance=weight, learning_rate=2e-2)
        learner = dataclasses.replace(LEARNER, config=config)
        state = learner.init(jax.random.key(0), GUIDED_PARAMS, knowledge)
        train = jax.jit(learner.train, static_argnums=4)
        state, _ = train(state, config.scalars(11), GUIDED_PARAMS, knowledge, 10)
        _, metrics = train(state, config.scalars(11), GUIDED_PARAMS, knowledge, 1)
        agreement[weight] = float(metrics["imitation_agreement"])
    assert agreement[3.0] > agreement[1e-9] + 0.1


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("method", METHODS)
def test_the_default_weight_is_that_of_the_world_if_the_method_chooses_actions(world, method):
    config = check_config(RunConfig(world=world, method=method, total_steps=10**7))
    assert config.ppo.guidance == (0.0 if method in ("semexp", "belief") else WORLDS[world].guidance)
    assert fill_world_defaults(RunConfig(world=world)).ppo.guidance == WORLDS[world].guidance


def test_explicit_guidance_weight_overrides_the_default_of_the_world():
    config = check_config(RunConfig(ppo=PPOConfig(guidance=0.25)))
    assert config.ppo.guidance == 0.25


def test_has_guidance_if_the_first_or_final_weight_is_positive():
    assert PPOConfig(guidance=0.1, final_guidance=0.0).has_guidance
    assert not PPOConfig(guidance=0.0).has_guidance
    assert PPOConfig(guidance=0.0, final_guidance=0.1).has_guidance


def test_guidance_can_rise_from_zero():
    scalars = PPOConfig(final_guidance=0.1).scalars(num_updates=3)
    assert (scalars.guidance_weight, scalars.final_guidance_weight) == (0.0, pytest.approx(0.1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "semexp", "ppo": PPOConfig(guidance=0.1)}, "ppo.guidance is 0.1; method 'semexp' does not choose"),
        ({"ppo": PPOConfig(guidance=-0.1)}, "ppo.guidance is -0.1; give 0 or more"),
        ({"ppo": PPOConfig(guidance=float("nan"))}, "ppo.guidance must be float or null, but is nan"),
        ({"ppo": PPOConfig(final_guidance=float("inf"))}, "ppo.final_guidance is inf; give 0 or more"),
    ],
)
def test_impossible_weights_are_refused_in_one_line(options, message):
    with pytest.raises(InputError, match="config: ") as refusal:
        check_config(RunConfig(**options))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("guidance", [0.0, 0.1])
def test_tables_hold_shortest_paths_only_where_training_reads_them(guidance):
    config = RunConfig(worlds=WorldConfig(num_train=4), ppo=PPOConfig(guidance=guidance))
    compiled_world = compile_training_world(config, Console(quiet=True))
    assert compiled_world.has_expert == (guidance > 0)
