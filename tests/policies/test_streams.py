"""The decision in two streams: what an intervention leaves, and what equations 1 and 2 then say."""

import dataclasses
import functools
from typing import NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import CATEGORIES
from support.tiers import params_by_tier

from jaxnav.causal import do, stde, tde
from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.network import StreamsPolicy, bind, init_params
from jaxnav.policies.pathways import Decision, PolicyInputs, PolicyState
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import NUM_ACTIONS

NUM_CATEGORIES = len(CATEGORIES)
BATCH_SIZE = 48
HIDDEN_SIZE = tiny.SIZES.hidden
#: The package's methods with its networks, one method that attends with its memory, and one that adapts.
HOSTS = [name for name, method in METHODS.items() if method.policy_class is None]
HOSTS += ["support.methods:ATTENTIVE", "support.methods:ADAPTIVE"]


def make_spec(method_name, **options):
    method_sizes = tiny.SPEC.method_sizes if method_name == "org" else ()
    return dataclasses.replace(tiny.STREAMS, method=find_method(method_name), method_sizes=method_sizes, **options)


class Decisions(NamedTuple):
    """One decision under interventions: on nothing, on both direct pathways, on experience, and on all of them."""

    factual: Decision
    counterfactual: Decision
    direct: Decision
    neither: Decision


@functools.cache
def compile_decisions(spec):
    """Decisions as a function of parameters, observation, layout weights, surroundings and memory."""
    reading = tiny.first_reading(spec.method, BATCH_SIZE)

    @jax.jit
    def decide(weights, observation, layout_weights, surroundings, memory):
        policy = bind(spec, weights)
        pathways = policy.pathways(PolicyInputs(observation, layout_weights, reading, surroundings), memory)
        without_direct = do(pathways, scene=0.0, goal=0.0)
        return Decisions(
            factual=policy.decide(pathways, memory),
            counterfactual=policy.decide(without_direct, memory),
            direct=policy.decide(do(pathways, experience=0.0), memory),
            neither=policy.decide(do(without_direct, experience=0.0), memory),
        )

    return decide


def random_observation(rng):
    """Random rows and goals [BATCH_SIZE]: real views of cells with detections that need not exist."""
    row = rng.integers(0, 256, (BATCH_SIZE, tiny.BANK.rows.shape[1]), np.uint8)
    real_poses = rng.integers(0, len(tiny.BANK.rows), BATCH_SIZE)
    row[:, 4 * NUM_CATEGORIES :] = tiny.BANK.rows[real_poses, 4 * NUM_CATEGORIES :]
    is_invisible = rng.random((BATCH_SIZE, NUM_CATEGORIES)) < 0.5
    row[:, : 4 * NUM_CATEGORIES].reshape(BATCH_SIZE, NUM_CATEGORIES, 4)[is_invisible] = 0
    goal = rng.integers(0, NUM_CATEGORIES, BATCH_SIZE)
    return Observation(jnp.asarray(row), jnp.asarray(goal))


def random_memory(rng, use_experience=1.0, spec=tiny.STREAMS):
    """Random memories [BATCH_SIZE]; an adaptation has changed the policy."""
    hidden = jnp.asarray(rng.uniform(-1, 1, (BATCH_SIZE, 2 * HIDDEN_SIZE)), jnp.float32)
    action = jnp.asarray(rng.integers(0, NUM_ACTIONS + 1, BATCH_SIZE), jnp.int32)
    fast = bind(spec, tiny.random_params(0, spec)).initial_memory((BATCH_SIZE,)).fast
    if spec.method.name == "tpn":
        actor_change = jnp.asarray(rng.normal(size=fast.actor_change.shape))
        fast = fast._replace(num_decisions=fast.num_decisions + 7, actor_change=actor_change)
    if spec.method.name == "savn":
        layer_changes = jax.tree.map(
            lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), fast.layer_changes
        )
        fast = fast._replace(layer_changes=layer_changes)
    return PolicyState(hidden, action, fast, jnp.full(BATCH_SIZE, use_experience))


def random_decisions(spec, seed, use_experience=1.0):
    """Decisions of random parameters on random inputs."""
    rng = np.random.default_rng(seed)
    observation = random_observation(rng)
    layout_weights = jnp.asarray(rng.random((BATCH_SIZE, NUM_CATEGORIES)), jnp.float32)
    surroundings = None
    if spec.spatial_memory is not None:
        spatial_memory = spec.spatial_memory
        reading = jax.eval_shape(lambda: spatial_memory.read(spatial_memory.init()))
        surroundings = jnp.asarray(rng.integers(0, 2, (BATCH_SIZE, *reading.shape)), reading.dtype)
    memory = random_memory(rng, use_experience, spec)
    weights = tiny.random_params(seed, spec)
    return compile_decisions(spec)(weights, observation, layout_weights, surroundings, memory)


def assert_bit_identical(actual, desired):
    """Compare float32 arrays to the bit, but for the sign of zeros."""
    np.testing.assert_array_equal(np.asarray(actual + 0.0).view(np.uint32), np.asarray(desired + 0.0).view(np.uint32))


# Equations 1 and 2


@pytest.mark.parametrize("method_name", params_by_tier(HOSTS, slow=["anonymous", "org", "support.methods:ADAPTIVE"]))
def test_tde_of_streams_is_bit_identical_to_the_direct_stream(method_name):
    for seed in range(4):
        decisions = random_decisions(make_spec(method_name), seed)
        direct_logits = decisions.direct.logits
        if method_name.endswith("ADAPTIVE"):  # whose habit is part of either decision
            direct_logits = direct_logits - decisions.neither.logits
        effect = tde(decisions.factual.logits, decisions.counterfactual.logits)
        assert_bit_identical(effect, direct_logits)
        assert np.std(direct_logits) > 0.1
        assert np.std(decisions.counterfactual.logits) > 0.1


@pytest.mark.parametrize("method_name", params_by_tier(HOSTS, slow=["rgb", "org"]))
def test_stde_of_streams_keeps_a_share_of_the_experience_stream(method_name):
    decisions = random_decisions(make_spec(method_name), seed=5)
    direct_logits = decisions.direct.logits - decisions.neither.logits
    experience_logits = decisions.counterfactual.logits
    kept_share = jnp.linspace(0, 1, BATCH_SIZE)
    effect = stde(decisions.factual.logits, experience_logits, 1.0 - kept_share, 0.0, "paper")
    np.testing.assert_allclose(effect, direct_logits + kept_share[:, None] * experience_logits, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"done_gate": True}, {"spatial_memory": SpatialMemory(4)}])
def test_tde_of_streams_is_the_direct_stream_with_gate_and_spatial_memory(options):
    decisions = random_decisions(make_spec("org", **options), seed=3)
    effect = tde(decisions.factual.logits, decisions.counterfactual.logits)
    assert_bit_identical(effect, decisions.direct.logits)
    assert np.std(effect) > 0.1


@pytest.mark.slow
def test_decision_without_either_stream_is_zero():
    decisions = random_decisions(make_spec("org"), seed=1)
    assert not decisions.neither.logits.any()
    assert not decisions.neither.value.any()
    value_sum = decisions.direct.value + decisions.counterfactual.value
    np.testing.assert_allclose(value_sum, decisions.factual.value, rtol=1e-5)


# Inputs of the streams


@pytest.mark.slow
@pytest.mark.parametrize(("use_experience", "is_changed"), [(0.0, False), (1.0, True)])
@pytest.mark.parametrize("method_name", ["org", "rgb", "support.methods:ATTENTIVE"])
def test_detections_of_other_categories_reach_only_the_experience_stream(method_name, use_experience, is_changed):
    rng = np.random.default_rng(0)
    observation = random_observation(rng)
    spec = make_spec(method_name)
    memory = random_memory(rng, use_experience)

    # Invert the detections of all categories but the goal.
    is_other_category = np.ones((BATCH_SIZE, NUM_CATEGORIES, 1), bool)
    is_other_category[np.arange(BATCH_SIZE), observation.goal] = False
    changed_row = np.array(observation.row)
    detections = changed_row[:, : 4 * NUM_CATEGORIES].reshape(BATCH_SIZE, NUM_CATEGORIES, 4)
    detections[:] = np.where(is_other_category, 255 - detections, detections)

    decide = functools.partial(compile_decisions(spec), tiny.random_params(0, spec))
    layout_weights = jnp.ones((BATCH_SIZE, NUM_CATEGORIES))
    decisions = decide(observation, layout_weights, None, memory)
    changed_decisions = decide(observation.replace(row=changed_row), layout_weights, None, memory)

    # The experience of rgb is its view, which stays.
    differs = (decisions.factual.logits != changed_decisions.factual.logits).any(axis=1)
    assert differs.tolist() == [is_changed and method_name != "rgb"] * BATCH_SIZE
    np.testing.assert_array_equal(decisions.direct.logits, changed_decisions.direct.logits)
    chex.assert_trees_all_equal(decisions.factual.value == changed_decisions.factual.value, ~differs)


@pytest.mark.parametrize("seed", range(3))
def test_episode_without_experience_is_decided_by_the_direct_stream(seed):
    with_experience = random_decisions(make_spec("org"), seed, use_experience=1.0)
    without_experience = random_decisions(make_spec("org"), seed, use_experience=0.0)
    decision = without_experience.factual
    np.testing.assert_array_equal(decision.logits, with_experience.direct.logits)
    np.testing.assert_allclose(decision.value, with_experience.direct.value, rtol=2e-6, atol=2e-7)  # rounded once
    direct_hidden = with_experience.factual.hidden[:, :HIDDEN_SIZE]
    np.testing.assert_array_equal(decision.hidden[:, :HIDDEN_SIZE], direct_hidden)
    np.testing.assert_array_equal(decision.use_experience, np.zeros(BATCH_SIZE))


@pytest.mark.slow
def test_each_stream_updates_its_half_of_the_hidden_state_by_its_own_core():
    """The hidden states are those of two cells of Flax."""
    rng = np.random.default_rng(0)
    observation = random_observation(rng)
    memory = random_memory(rng)
    spec = make_spec("org")
    policy = cast(StreamsPolicy, bind(spec, tiny.random_params(0, spec)))
    pathways = policy.pathways(PolicyInputs(observation, jnp.ones((BATCH_SIZE, NUM_CATEGORIES))))
    hidden = policy.decide(pathways, memory).hidden

    previous_action = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
    direct_inputs = jnp.concatenate([pathways.scene, pathways.goal, previous_action], axis=-1)
    experience_inputs = jnp.concatenate([pathways.experience, previous_action], axis=-1)
    for stream, stream_inputs, half in (
        (policy, direct_inputs, slice(HIDDEN_SIZE)),
        (policy.experience_stream, experience_inputs, slice(HIDDEN_SIZE, None)),
    ):
        expected_hidden, _ = stream.core(memory.hidden[:, half], jax.nn.relu(stream.fuse(stream_inputs)))
        np.testing.assert_allclose(hidden[:, half], expected_hidden, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_initial_memory_of_streams_uses_experience():
    spec = make_spec("support.methods:ADAPTIVE")
    memory = bind(spec, tiny.random_params(0, spec)).initial_memory((2, 3))
    np.testing.assert_array_equal(memory.hidden, np.zeros((2, 3, 2 * HIDDEN_SIZE)))
    np.testing.assert_array_equal(memory.use_experience, np.ones((2, 3)))
    assert memory.fast.shape == (2, 3, NUM_ACTIONS)


# Parameters


def test_streams_add_a_view_and_a_stream_to_the_parameters():
    fused_params = jax.eval_shape(functools.partial(init_params, tiny.SPEC), jax.random.key(0))
    streams_params = jax.eval_shape(functools.partial(init_params, tiny.STREAMS), jax.random.key(0))
    assert streams_params.keys() - fused_params.keys() == {"experience_stream", "known_appearance"}
    assert streams_params["experience_stream"].keys() == {"fuse", "core", "actor", "critic"}
    assert streams_params["view"]["bias"].shape == (2 * tiny.SIZES.view_outputs,)
    for name in ("core", "actor", "critic", "method", "detections", "sought", "appearance"):
        assert streams_params[name] == fused_params[name]


def test_policy_spec_refuses_an_unknown_decision():
    with pytest.raises(ValueError, match=r"decision is 'both'.*fused, streams"):
        PolicySpec(METHODS["org"], decision="both")  # type: ignore[arg-type]
