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

from jaxnav.causal import do, stde, tde
from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.network import StreamsPolicy, bind, init_params
from jaxnav.policies.pathways import Decision, PolicyInputs, PolicyState
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import NUM_ACTIONS

K, BATCH, HIDDEN = len(CATEGORIES), 48, tiny.SIZES.hidden
#: The package's methods, one that attends with its memory, and one that adapts.
HOSTS = [*METHODS, "support.methods:ATTENTIVE", "support.methods:ADAPTIVE"]


def streams(method, **options):
    sizes = tiny.SPEC.method_sizes if method == "org" else ()
    return dataclasses.replace(tiny.STREAMS, method=find_method(method), method_sizes=sizes, **options)


class Decisions(NamedTuple):
    """One decision under interventions."""

    factual: Decision
    counterfactual: Decision
    direct: Decision
    nothing: Decision


@functools.cache
def compiled(spec):
    """Decisions as a function of parameters, observation, layout weights, surroundings and memory."""
    reading = tiny.first_reading(spec.method, BATCH)

    @jax.jit
    def decide(weights, observation, layout, surroundings, memory):
        policy = bind(spec, weights)
        pathways = policy.pathways(PolicyInputs(observation, layout, reading, surroundings), memory)
        counterfactual = do(pathways, scene=0.0, goal=0.0)
        given = pathways, counterfactual, do(pathways, experience=0.0), do(counterfactual, experience=0.0)
        return Decisions(*(policy.decide(pathways_i, memory) for pathways_i in given))

    return decide


def observations(generator):
    """Random rows and goals: what is seen need not exist."""
    row = generator.integers(0, 256, (BATCH, tiny.BANK.rows.shape[1]), np.uint8)
    row[:, 4 * K :] = tiny.BANK.rows[generator.integers(0, len(tiny.BANK.rows), BATCH), 4 * K :]
    row[:, : 4 * K].reshape(BATCH, K, 4)[generator.random((BATCH, K)) < 0.5] = 0
    return Observation(jnp.asarray(row), jnp.asarray(generator.integers(0, K, BATCH)))


def memories(generator, experienced=1.0, spec=tiny.STREAMS):
    """Random memories; an adaptation has changed the policy."""
    hidden = jnp.asarray(generator.uniform(-1, 1, (BATCH, 2 * HIDDEN)), jnp.float32)
    action = jnp.asarray(generator.integers(0, NUM_ACTIONS + 1, BATCH), jnp.int32)
    fast = bind(spec, tiny.random_params(0, spec)).initial_memory((BATCH,)).fast
    if spec.method.name == "tpn":
        random_change = generator.normal(size=fast.actor_change.shape)
        fast = fast._replace(num_decisions=fast.num_decisions + 7, actor_change=jnp.asarray(random_change))
    if spec.method.name == "savn":
        layer_changes = jax.tree.map(
            lambda leaf: jnp.asarray(generator.normal(size=leaf.shape), jnp.float32), fast.layer_changes
        )
        fast = fast._replace(layer_changes=layer_changes)
    return PolicyState(hidden, action, fast, jnp.full(BATCH, experienced))


def decisions(spec, seed, experienced=1.0):
    generator = np.random.default_rng(seed)
    observation, layout = observations(generator), jnp.asarray(generator.random((BATCH, K)), jnp.float32)
    surroundings = None
    if spec.spatial_memory is not None:
        read = jax.eval_shape(lambda: spec.spatial_memory.read(spec.spatial_memory.init()))
        surroundings = jnp.asarray(generator.integers(0, 2, (BATCH, *read.shape)), read.dtype)
    weights = tiny.random_params(seed, spec)
    return compiled(spec)(weights, observation, layout, surroundings, memories(generator, experienced, spec))


def bits(values):
    return np.asarray(values).view(np.uint32)


# Equations 1 and 2


#: The others take seconds each to compile.
QUICK = ("org", "rgb", "anonymous", "eotp")
EACH = [pytest.param(method, marks=() if method in QUICK else pytest.mark.slow) for method in HOSTS]


@pytest.mark.parametrize("method", EACH)
def test_removing_experience_leaves_the_direct_stream_to_the_bit(method):
    for seed in range(4):
        result = decisions(streams(method), seed)
        alone = result.direct.logits
        if method.endswith("ADAPTIVE"):  # whose habit is part of either decision
            alone = alone - result.nothing.logits
        effect = tde(result.factual.logits, result.counterfactual.logits)
        np.testing.assert_array_equal(bits(effect + 0.0), bits(alone + 0.0))  # zeros have one sign
        assert np.std(alone) > 0.1
        assert np.std(result.counterfactual.logits) > 0.1


@pytest.mark.parametrize(
    "method",
    [name if name in ("rgb", "org", "hoz") else pytest.param(name, marks=pytest.mark.slow) for name in HOSTS],
)
def test_soft_removal_keeps_a_share_of_experience(method):
    result = decisions(streams(method), seed=5)
    direct, experience = result.direct.logits - result.nothing.logits, result.counterfactual.logits
    share = jnp.linspace(0, 1, BATCH)
    softened = stde(result.factual.logits, experience, 1.0 - share, 0.0, "paper")
    np.testing.assert_allclose(softened, direct + share[:, None] * experience, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("options", [{"done_gate": True}, {"spatial_memory": SpatialMemory(4)}])
def test_options_leave_the_equations_as_they_are(options):
    result = decisions(streams("org", **options), seed=3)
    effect = tde(result.factual.logits, result.counterfactual.logits)
    np.testing.assert_array_equal(bits(effect + 0.0), bits(result.direct.logits + 0.0))
    assert np.std(effect) > 0.1


def test_without_either_stream_nothing_is_left():
    result = decisions(streams("org"), seed=1)
    assert not result.nothing.logits.any()
    assert not result.nothing.value.any()
    np.testing.assert_allclose(result.direct.value + result.counterfactual.value, result.factual.value, rtol=1e-5)


# What the streams get


@pytest.mark.parametrize(("experienced", "changes"), [(0.0, False), (1.0, True)])
@pytest.mark.parametrize("method", ["org", "rgb", "support.methods:ATTENTIVE"])
def test_detections_other_than_the_goals_matter_with_experience_alone(method, experienced, changes):
    generator = np.random.default_rng(0)
    one = observations(generator)
    others = np.ones((BATCH, K, 1), bool)
    others[np.arange(BATCH), one.goal] = False
    changed = np.array(one.row)
    table = changed[:, : 4 * K].reshape(BATCH, K, 4)
    table[:] = np.where(others, 255 - table, table)
    spec, memory = streams(method), memories(generator, experienced)
    decide, layout = compiled(spec), jnp.ones((BATCH, K))
    original, altered = (
        decide(tiny.random_params(0, spec), one.replace(row=row), layout, None, memory) for row in (one.row, changed)
    )
    differ = (original.factual.logits != altered.factual.logits).any(axis=1)
    assert differ.tolist() == [changes and method != "rgb"] * BATCH  # the experience of rgb is its view
    np.testing.assert_array_equal(original.direct.logits, altered.direct.logits)
    chex.assert_trees_all_equal(original.factual.value == altered.factual.value, ~differ)


def test_episodes_without_experience_are_decided_by_the_direct_stream():
    for seed in range(3):
        on, off = (decisions(streams("org"), seed, experienced) for experienced in (1.0, 0.0))
        np.testing.assert_array_equal(off.factual.logits, on.direct.logits)
        np.testing.assert_allclose(off.factual.value, on.direct.value, rtol=2e-6, atol=2e-7)  # a sum, rounded once
        np.testing.assert_array_equal(off.factual.hidden[:, :HIDDEN], on.factual.hidden[:, :HIDDEN])
        np.testing.assert_array_equal(off.factual.use_experience, np.zeros(BATCH))


def test_each_stream_has_a_core_of_its_own():
    """The hidden states are those of two cells of Flax."""
    generator = np.random.default_rng(0)
    observation, memory, spec = observations(generator), memories(generator), streams("org")
    policy = cast(StreamsPolicy, bind(spec, tiny.random_params(0, spec)))
    pathways = policy.pathways(PolicyInputs(observation, jnp.ones((BATCH, K))))
    after = policy.decide(pathways, memory).hidden
    previous = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
    entering = {
        "direct": jnp.concatenate([pathways.scene, pathways.goal, previous], axis=-1),
        "experience": jnp.concatenate([pathways.experience, previous], axis=-1),
    }
    cores = {"direct": policy, "experience": policy.experience_stream}
    for half, (name, core) in enumerate(cores.items()):
        place = slice(half * HIDDEN, (half + 1) * HIDDEN)
        expected, _ = core.core(memory.hidden[:, place], jax.nn.relu(core.fuse(entering[name])))
        np.testing.assert_allclose(after[:, place], expected, rtol=1e-4, atol=1e-5)


def test_an_episode_begins_with_experience():
    spec = streams("support.methods:ADAPTIVE")
    memory = bind(spec, tiny.random_params(0, spec)).initial_memory((2, 3))
    np.testing.assert_array_equal(memory.hidden, np.zeros((2, 3, 2 * HIDDEN)))
    np.testing.assert_array_equal(memory.use_experience, np.ones((2, 3)))
    assert memory.fast.shape == (2, 3, NUM_ACTIONS)


# Parameters


def test_streams_add_a_view_and_a_stream():
    specs = tiny.SPEC, tiny.STREAMS
    fused, both = (jax.eval_shape(functools.partial(init_params, spec), jax.random.key(0)) for spec in specs)
    assert both.keys() - fused.keys() == {"experience_stream", "known_appearance"}
    assert both["experience_stream"].keys() == {"fuse", "core", "actor", "critic"}
    assert both["view"]["bias"].shape == (2 * tiny.SIZES.view_outputs,)
    for name in ("core", "actor", "critic", "method", "detections", "sought", "appearance"):
        assert both[name] == fused[name]


def test_unknown_decisions_are_refused():
    with pytest.raises(ValueError, match=r"^decision is 'both'; choose one of fused, streams$"):
        PolicySpec(METHODS["org"], decision="both")  # type: ignore[arg-type]
