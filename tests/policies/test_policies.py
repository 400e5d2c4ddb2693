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
K = len(CATEGORIES)
BATCH = 12
#: Weights of the layout that differ from one and from another.
WEIGHTS = jnp.linspace(0.1, 1.6, BATCH * K).reshape(BATCH, K)


def batch(seed=0):
    """Observations of random poses, and memories in the middle of an episode."""
    generator = np.random.default_rng(seed)
    pose = generator.integers(0, len(BANK.rows), BATCH)
    observation = Observation(row=jnp.asarray(BANK.rows[pose]), goal=jnp.asarray(generator.integers(0, K, BATCH)))
    hidden = jnp.asarray(generator.normal(size=(BATCH, SIZES.hidden)), jnp.float32)
    action = jnp.asarray(generator.integers(0, NUM_ACTIONS + 1, BATCH), jnp.int32)
    return observation, PolicyState(hidden=hidden, action=action)


class Compiled:
    """A policy with compiled methods."""

    def __init__(self, method):
        spec = dataclasses.replace(
            SPEC, method=find_method(method), method_sizes=SPEC.method_sizes if method == "org" else ()
        )
        policy = bind(spec, random_params(0, spec))
        self.experience_width = policy.method.width
        self.pathways = jax.jit(lambda *inputs: policy.pathways(PolicyInputs(*inputs)))
        self.decide = jax.jit(lambda pathways, memory: policy.decide(pathways, memory))
        self.initial_memory = policy.initial_memory


@pytest.fixture(scope="module", params=["rgb", "org"])
def policy(request):
    return Compiled(request.param)


@pytest.fixture(scope="module")
def org():
    return Compiled("org")


# Pathways and decisions


@pytest.mark.parametrize("shape", [(), (3, 4)])
def test_shapes(policy, shape):
    observation, memory = jax.tree.map(lambda x: x.reshape(BATCH, -1)[: np.prod(shape, dtype=int)], batch())
    observation = Observation(row=observation.row.reshape(*shape, -1), goal=observation.goal.reshape(shape))
    memory = PolicyState(hidden=memory.hidden.reshape(*shape, -1), action=memory.action.reshape(shape))
    pathways = policy.pathways(observation, jnp.ones((*shape, K)))
    decision = policy.decide(pathways, memory)
    chex.assert_shape(pathways.scene, (*shape, SIZES.view_outputs))
    chex.assert_shape(pathways.goal, (*shape, K * SIZES.row_outputs + SIZES.appearance))
    chex.assert_shape(pathways.experience, (*shape, policy.experience_width))
    chex.assert_shape(decision.logits, (*shape, NUM_ACTIONS))
    chex.assert_shape(decision.value, shape)
    chex.assert_shape(decision.hidden, (*shape, SIZES.hidden))
    chex.assert_type(jax.tree.leaves((pathways, decision)), jnp.float32)


def test_a_batch_is_its_single_members(policy):
    observation, memory = batch()
    pathways = policy.pathways(observation, WEIGHTS)
    decision = policy.decide(pathways, memory)
    assert float(decision.logits.std()) > 0.1  # lively, so that the comparison says something
    for i in range(BATCH):
        own = policy.pathways(leaves_at(observation, i), WEIGHTS[i])
        chex.assert_trees_all_close(own, leaves_at(pathways, i), rtol=1e-5, atol=1e-6)
        chex.assert_trees_all_close(
            policy.decide(own, leaves_at(memory, i)), leaves_at(decision, i), rtol=1e-5, atol=1e-6
        )


def test_an_episode_begins_with_nothing_remembered_and_no_action(org):
    memory = org.initial_memory((2, 3))
    np.testing.assert_array_equal(memory.hidden, np.zeros((2, 3, SIZES.hidden)))
    np.testing.assert_array_equal(memory.action, np.full((2, 3), NO_ACTION))
    assert NO_ACTION == NUM_ACTIONS  # one past the actions: its one-hot vector is zero


def test_the_first_policy_is_close_to_uniform_but_seldom_done():
    weights = init_params(SPEC, jax.random.key(0))
    for i, row in enumerate(BANK.rows[::16]):
        logits = decide(weights, row, i % K, WEIGHTS[0], PolicyState(jnp.zeros(SIZES.hidden), jnp.int32(NO_ACTION)))[
            0
        ].logits
        assert 0 < np.abs(np.asarray(logits) - [0, 0, 0, 0, 0, INITIAL_DONE_LOGIT]).max() < 0.1
    assert 1 / 70 < np.exp(INITIAL_DONE_LOGIT) / (5 + np.exp(INITIAL_DONE_LOGIT)) < 1 / 50


# Interventions


def test_an_intervention_leaves_experience_factual(org):
    observation, _ = batch()
    pathways = org.pathways(observation, WEIGHTS)
    counterfactual = do(pathways, scene=0.0, goal=0.0)
    assert counterfactual.experience is pathways.experience
    assert not counterfactual.scene.any()
    assert not counterfactual.goal.any()
    assert pathways.scene.any()
    assert pathways.goal.any()


def test_counterfactual_logits_depend_on_experience_memory_and_previous_action_alone(org):
    (observation, memory), (another, _) = batch(0), batch(1)
    here, elsewhere = (org.pathways(o, WEIGHTS) for o in (observation, another))

    def counterfactual(pathways, memory):
        return org.decide(do(pathways, scene=0.0, goal=0.0), memory).logits

    logits = counterfactual(here, memory)
    # The view, the direct detections and what is sought come from somewhere else: the same bits.
    same = counterfactual(elsewhere._replace(experience=here.experience), memory)
    np.testing.assert_array_equal(same, logits)
    # The factual logits do differ, and so do the counterfactual ones when any of the three is changed.
    mixed = elsewhere._replace(experience=here.experience)
    assert np.abs(org.decide(mixed, memory).logits - org.decide(here, memory).logits).max() > 0.01
    for changed in (
        counterfactual(elsewhere, memory),
        counterfactual(here, memory._replace(hidden=-memory.hidden)),
        counterfactual(here, memory._replace(action=(memory.action + 1) % NUM_ACTIONS)),
    ):
        assert (np.abs(changed - logits).max(axis=-1) > 1e-4).sum() > BATCH / 2


def test_layout_weights_change_experience_alone(org):
    observation, _ = batch()
    plain, weighted = org.pathways(observation, jnp.ones((BATCH, K))), org.pathways(observation, WEIGHTS)
    chex.assert_trees_all_equal(weighted[:2], plain[:2])
    assert np.abs(weighted.experience - plain.experience).max() > 0.01


def test_the_weight_of_a_category_changes_its_own_part_of_the_experience(org):
    observation, _ = batch()
    before = org.pathways(observation, WEIGHTS).experience.reshape(BATCH, K, SIZES.row_outputs)
    after = org.pathways(observation, WEIGHTS.at[:, 1].set(3.0)).experience.reshape(BATCH, K, SIZES.row_outputs)
    np.testing.assert_allclose(after[:, [0, 2]], before[:, [0, 2]], rtol=1e-6, atol=1e-7)
    assert np.abs(after[:, 1] - before[:, 1]).max() > 0.01


def test_no_gradient_flows_into_the_layout(org):
    observation, memory = batch()

    def loss(weights):
        return org.decide(org.pathways(observation, weights), memory).logits[:, 0].sum()

    np.testing.assert_array_equal(jax.grad(loss)(WEIGHTS), np.zeros((BATCH, K)))
    assert abs(float(loss(WEIGHTS) - loss(2 * WEIGHTS))) > 1e-3  # though the weights do matter


def test_rgb_has_no_experience():
    policy, (observation, _) = Compiled("rgb"), batch()
    plain = policy.pathways(observation, jnp.ones((BATCH, K)))
    assert plain.experience.shape == (BATCH, 0)
    chex.assert_trees_all_equal(policy.pathways(observation, WEIGHTS), plain)


# Parameters


@pytest.mark.parametrize("method", METHODS)
def test_parameters_are_plain_data_and_come_back(method):
    spec = PolicySpec(method=find_method(method), num_categories=K, sizes=SIZES)
    params = init_params(spec, jax.random.key(3))

    def check(node):
        assert type(node) is dict
        for name, value in node.items():
            assert type(name) is str
            if isinstance(value, dict):
                check(value)
            else:
                assert isinstance(value, jax.Array)
                assert value.dtype == jnp.float32
                assert value.size > 0

    check(params)
    chex.assert_trees_all_equal(nnx.to_pure_dict(nnx.state(bind(spec, params), nnx.Param)), params)
    chex.assert_trees_all_equal(init_params(spec, jax.random.key(3)), params)
    other = init_params(spec, jax.random.key(4))
    assert not np.array_equal(other["fuse"]["kernel"], params["fuse"]["kernel"])


# Says what was imported, then the logits of an exported policy.
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
bound = bind(PolicySpec.from_json(fields, ORG, fields["num_categories"]), params)
given = np.load(sys.argv[2])
observation = Observation(row=jnp.asarray(given["row"]), goal=jnp.asarray(given["goal"]))
pathways = bound.pathways(PolicyInputs(observation, jnp.asarray(given["weights"])))
decision = bound.decide(pathways, bound.initial_memory((len(given["goal"]),)))
print(json.dumps({"modules": sorted(sys.modules), "logits": decision.logits.tolist()}))
"""


@pytest.mark.slow
def test_an_exported_policy_runs_without_the_trainer(tmp_path, org):
    export_params(tmp_path / "policy", random_params(0), SPEC.to_json() | {"num_categories": K})
    observation, _ = batch()
    np.savez(tmp_path / "given.npz", row=observation.row, goal=observation.goal, weights=WEIGHTS)
    command = [sys.executable, "-c", USE_EXPORT, str(tmp_path / "policy"), str(tmp_path / "given.npz")]
    output = json.loads(subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout)
    expected = org.decide(org.pathways(observation, WEIGHTS), org.initial_memory((BATCH,))).logits
    np.testing.assert_allclose(output["logits"], expected, rtol=1e-5, atol=1e-6)
    heavy = {"matplotlib", "orbax", "tyro", "PIL", "jaxnav.training", "jaxnav.evaluation", "jaxnav.cli"}
    assert not heavy & set(output["modules"])
