"""Pathways, decisions and interventions on them, and parameters as plain data."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support.scenes import CATEGORIES
from support.tiers import params_by_tier
from support.tiny_world import BANK, SIZES, SPEC, decide, leaves_at, random_params

from jaxnav.causal import do
from jaxnav.env.objectnav import Observation
from jaxnav.policies.methods import METHODS, find_method
from jaxnav.policies.network import INITIAL_DONE_LOGIT, bind, init_params
from jaxnav.policies.pathways import NO_ACTION, PolicyInputs, PolicyState
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.lattice import NUM_ACTIONS
from jaxnav.store.export import export_params

REPOSITORY = Path(__file__).parents[2]
NUM_CATEGORIES = len(CATEGORIES)
BATCH_SIZE = 12
#: Layout weights that differ from 1 and from each other.
LAYOUT_WEIGHTS = jnp.linspace(0.1, 1.6, BATCH_SIZE * NUM_CATEGORIES).reshape(BATCH_SIZE, NUM_CATEGORIES)


def random_batch(seed=0):
    """Observations of random poses and memories in the middle of an episode, leaves [BATCH_SIZE, ...]."""
    rng = np.random.default_rng(seed)
    pose = rng.integers(0, len(BANK.rows), BATCH_SIZE)
    observation = Observation(
        row=jnp.asarray(BANK.rows[pose]), goal=jnp.asarray(rng.integers(0, NUM_CATEGORIES, BATCH_SIZE))
    )
    hidden = jnp.asarray(rng.normal(size=(BATCH_SIZE, SIZES.hidden)), jnp.float32)
    action = jnp.asarray(rng.integers(0, NUM_ACTIONS + 1, BATCH_SIZE), jnp.int32)
    return observation, PolicyState(hidden=hidden, action=action)


class CompiledPolicy:
    """A policy with compiled methods."""

    def __init__(self, method_name):
        method_sizes = SPEC.method_sizes if method_name == "org" else ()
        spec = dataclasses.replace(SPEC, method=find_method(method_name), method_sizes=method_sizes)
        policy = bind(spec, random_params(0, spec))
        self.experience_width = policy.experience.width
        self.pathways = jax.jit(lambda *inputs: policy.pathways(PolicyInputs(*inputs)))
        self.decide = jax.jit(lambda pathways, memory: policy.decide(pathways, memory))
        self.initial_memory = policy.initial_memory


@pytest.fixture(scope="module", params=["rgb", "org"])
def policy(request):
    return CompiledPolicy(request.param)


@pytest.fixture(scope="module")
def org():
    return CompiledPolicy("org")


# Pathways and decisions


@pytest.mark.parametrize("shape", [(), (3, 4)])
def test_pathways_and_decision_keep_the_batch_shape(policy, shape):
    num_members = np.prod(shape, dtype=int)
    observation, memory = jax.tree.map(lambda leaf: leaf.reshape(BATCH_SIZE, -1)[:num_members], random_batch())
    observation = Observation(row=observation.row.reshape(*shape, -1), goal=observation.goal.reshape(shape))
    memory = PolicyState(hidden=memory.hidden.reshape(*shape, -1), action=memory.action.reshape(shape))
    pathways = policy.pathways(observation, jnp.ones((*shape, NUM_CATEGORIES)))
    decision = policy.decide(pathways, memory)
    chex.assert_shape(pathways.scene, (*shape, SIZES.view_outputs))
    chex.assert_shape(pathways.goal, (*shape, NUM_CATEGORIES * SIZES.row_outputs + SIZES.appearance))
    chex.assert_shape(pathways.experience, (*shape, policy.experience_width))
    chex.assert_shape(decision.logits, (*shape, NUM_ACTIONS))
    chex.assert_shape(decision.value, shape)
    chex.assert_shape(decision.hidden, (*shape, SIZES.hidden))
    chex.assert_type(jax.tree.leaves((pathways, decision)), jnp.float32)


def test_batch_decides_as_its_single_members(policy):
    observation, memory = random_batch()
    pathways = policy.pathways(observation, LAYOUT_WEIGHTS)
    decision = policy.decide(pathways, memory)
    assert float(decision.logits.std()) > 0.1  # logits that vary, so that the comparison is not trivial
    for index in range(BATCH_SIZE):
        single_pathways = policy.pathways(leaves_at(observation, index), LAYOUT_WEIGHTS[index])
        single_decision = policy.decide(single_pathways, leaves_at(memory, index))
        chex.assert_trees_all_close(single_pathways, leaves_at(pathways, index), rtol=1e-5, atol=1e-6)
        chex.assert_trees_all_close(single_decision, leaves_at(decision, index), rtol=1e-5, atol=1e-6)


def test_initial_memory_is_zero_with_no_previous_action(org):
    memory = org.initial_memory((2, 3))
    np.testing.assert_array_equal(memory.hidden, np.zeros((2, 3, SIZES.hidden)))
    np.testing.assert_array_equal(memory.action, np.full((2, 3), NO_ACTION))
    assert NO_ACTION == NUM_ACTIONS  # one past the actions: its one-hot vector is zero


@pytest.mark.slow
def test_fresh_policy_is_close_to_uniform_with_a_rare_done():
    weights = init_params(SPEC, jax.random.key(0))
    memory = PolicyState(jnp.zeros(SIZES.hidden), jnp.int32(NO_ACTION))
    for index, row in enumerate(BANK.rows[::16]):
        factual, _ = decide(weights, row, index % NUM_CATEGORIES, LAYOUT_WEIGHTS[0], memory)
        assert 0 < np.abs(np.asarray(factual.logits) - [0, 0, 0, 0, 0, INITIAL_DONE_LOGIT]).max() < 0.1
    done_probability = np.exp(INITIAL_DONE_LOGIT) / (5 + np.exp(INITIAL_DONE_LOGIT))
    assert 1 / 70 < done_probability < 1 / 50


# Interventions


def test_do_zeroes_scene_and_goal_and_keeps_experience(org):
    observation, _ = random_batch()
    pathways = org.pathways(observation, LAYOUT_WEIGHTS)
    counterfactual = do(pathways, scene=0.0, goal=0.0)
    assert counterfactual.experience is pathways.experience
    assert not counterfactual.scene.any()
    assert not counterfactual.goal.any()
    assert pathways.scene.any()
    assert pathways.goal.any()


def test_counterfactual_logits_depend_only_on_experience_memory_and_previous_action(org):
    observation, memory = random_batch(0)
    other_observation, _ = random_batch(1)
    pathways = org.pathways(observation, LAYOUT_WEIGHTS)
    other_pathways = org.pathways(other_observation, LAYOUT_WEIGHTS)

    def counterfactual_logits(pathways, memory):
        return org.decide(do(pathways, scene=0.0, goal=0.0), memory).logits

    # With the view, the direct detections and the goal of other poses, the factual logits differ and the
    # counterfactual ones are equal to the bit.
    logits = counterfactual_logits(pathways, memory)
    mixed_pathways = other_pathways._replace(experience=pathways.experience)
    np.testing.assert_array_equal(counterfactual_logits(mixed_pathways, memory), logits)
    factual_change = org.decide(mixed_pathways, memory).logits - org.decide(pathways, memory).logits
    assert np.abs(factual_change).max() > 0.01

    # Another experience, memory or previous action changes them.
    for changed_logits in (
        counterfactual_logits(other_pathways, memory),
        counterfactual_logits(pathways, memory._replace(hidden=-memory.hidden)),
        counterfactual_logits(pathways, memory._replace(action=(memory.action + 1) % NUM_ACTIONS)),
    ):
        assert (np.abs(changed_logits - logits).max(axis=-1) > 1e-4).sum() > BATCH_SIZE / 2


def test_layout_weights_change_only_experience(org):
    observation, _ = random_batch()
    pathways = org.pathways(observation, jnp.ones((BATCH_SIZE, NUM_CATEGORIES)))
    weighted_pathways = org.pathways(observation, LAYOUT_WEIGHTS)
    chex.assert_trees_all_equal(weighted_pathways[:2], pathways[:2])
    assert np.abs(weighted_pathways.experience - pathways.experience).max() > 0.01


def test_layout_weight_changes_only_its_category_of_the_experience(org):
    observation, _ = random_batch()
    row_shape = (BATCH_SIZE, NUM_CATEGORIES, SIZES.row_outputs)
    changed_weights = LAYOUT_WEIGHTS.at[:, 1].set(3.0)
    experience = org.pathways(observation, LAYOUT_WEIGHTS).experience.reshape(row_shape)
    changed_experience = org.pathways(observation, changed_weights).experience.reshape(row_shape)
    np.testing.assert_allclose(changed_experience[:, [0, 2]], experience[:, [0, 2]], rtol=1e-6, atol=1e-7)
    assert np.abs(changed_experience[:, 1] - experience[:, 1]).max() > 0.01


def test_layout_weights_have_no_gradient(org):
    observation, memory = random_batch()

    def loss(layout_weights):
        return org.decide(org.pathways(observation, layout_weights), memory).logits[:, 0].sum()

    np.testing.assert_array_equal(jax.grad(loss)(LAYOUT_WEIGHTS), np.zeros((BATCH_SIZE, NUM_CATEGORIES)))
    assert abs(float(loss(LAYOUT_WEIGHTS) - loss(2 * LAYOUT_WEIGHTS))) > 1e-3  # the logits do depend on the weights


@pytest.mark.parametrize("method", params_by_tier(METHODS, fast=["org", "rgb"], slow=METHODS))
def test_only_methods_without_a_mechanism_in_z_have_no_experience(method):
    spec = dataclasses.replace(SPEC, method=find_method(method), method_sizes=())
    assert METHODS[method].experience.is_empty == (bind(spec, init_params(spec, jax.random.key(0))).method.width == 0)
    assert METHODS[method].experience.is_empty == (method in {"rgb", "anonymous", "savn"})


def test_rgb_has_no_experience():
    policy = CompiledPolicy("rgb")
    observation, _ = random_batch()
    pathways = policy.pathways(observation, jnp.ones((BATCH_SIZE, NUM_CATEGORIES)))
    assert pathways.experience.shape == (BATCH_SIZE, 0)
    chex.assert_trees_all_equal(policy.pathways(observation, LAYOUT_WEIGHTS), pathways)


# Parameters


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_init_params_returns_nested_dicts_that_bind_restores(method):
    spec = PolicySpec(method=find_method(method), num_categories=NUM_CATEGORIES, sizes=SIZES)
    params = init_params(spec, jax.random.key(3))

    def assert_plain_data(node):
        assert type(node) is dict
        for name, value in node.items():
            assert type(name) is str
            if isinstance(value, dict):
                assert_plain_data(value)
            else:
                assert isinstance(value, jax.Array)
                assert value.dtype == jnp.float32
                assert value.size > 0

    assert_plain_data(params)

    # A network holds the parameters that it is bound to; they depend only on the key.
    chex.assert_trees_all_equal(nnx.to_pure_dict(nnx.state(bind(spec, params), nnx.Param)), params)
    chex.assert_trees_all_equal(init_params(spec, jax.random.key(3)), params)
    other_params = init_params(spec, jax.random.key(4))
    same_leaves = jax.tree.map(np.array_equal, other_params, params)
    assert not all(jax.tree.leaves(same_leaves))


# Script that prints the imported modules and the logits of an exported policy.
USE_EXPORT = """
import json, sys
from pathlib import Path
import jaxnav
import jax.numpy as jnp
import numpy as np
from jaxnav.policies.network import bind
from jaxnav.policies.methods.org import ORG
from jaxnav.policies.pathways import PolicyInputs
from jaxnav.policies.spec import PolicySpec
from jaxnav.store.export import load_params
from jaxnav.env.objectnav import Observation
params, fields = load_params(Path(sys.argv[1]))
policy = bind(PolicySpec.from_json(fields, ORG, fields["num_categories"]), params)
inputs = np.load(sys.argv[2])
observation = Observation(row=jnp.asarray(inputs["row"]), goal=jnp.asarray(inputs["goal"]))
pathways = policy.pathways(PolicyInputs(observation, jnp.asarray(inputs["weights"])))
decision = policy.decide(pathways, policy.initial_memory((len(inputs["goal"]),)))
print(json.dumps({"modules": sorted(sys.modules), "logits": decision.logits.tolist()}))
"""


@pytest.mark.slow
def test_exported_policy_decides_without_importing_the_trainer(tmp_path, org):
    # Export a policy and use it in another process.
    export_params(tmp_path / "policy", random_params(0), SPEC.to_json() | {"num_categories": NUM_CATEGORIES})
    observation, _ = random_batch()
    np.savez(tmp_path / "inputs.npz", row=observation.row, goal=observation.goal, weights=LAYOUT_WEIGHTS)
    command = [sys.executable, "-c", USE_EXPORT, str(tmp_path / "policy"), str(tmp_path / "inputs.npz")]
    completed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    output = json.loads(completed.stdout)

    # Logits and imports.
    expected = org.decide(org.pathways(observation, LAYOUT_WEIGHTS), org.initial_memory((BATCH_SIZE,))).logits
    np.testing.assert_allclose(output["logits"], expected, rtol=1e-5, atol=1e-6)
    heavy_modules = {"matplotlib", "orbax", "tyro", "PIL", "jaxnav.training", "jaxnav.evaluation", "jaxnav.cli"}
    assert not heavy_modules & set(output["modules"])
