"""Runs whose policies decide in two streams: settings, exports, training and evaluation."""

import dataclasses
import shutil

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support.mutations import resigned
from support.tiny_world import random_params

import jaxnav
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.policies import POLICIES_DIR, export_policy
from jaxnav.runs.worlds import compile_evaluation_world
from jaxnav.training.calibration import Exploration


@pytest.fixture(scope="module")
def stream_config(config):
    """Settings of a run with streams, whose `ppo.experience` has the default of this decision."""
    ppo = dataclasses.replace(config.ppo, experience=None)
    return check_config(dataclasses.replace(config, decision="streams", ppo=ppo))


def test_stream_config_disables_counterfactual_training(stream_config):
    assert (stream_config.direct, stream_config.counterfactual) == ("goal", "none")
    spec = stream_config.policy_spec(9)
    assert (spec.decision, spec.direct) == ("streams", "goal")
    fused_config = check_config(RunConfig())
    assert (fused_config.decision, fused_config.direct, fused_config.counterfactual) == ("fused", "goal", "distil")


@pytest.mark.slow
def test_exported_stream_policy_acts(drawn_run, stream_config, tmp_path):
    # Export random parameters with the knowledge of a drawn policy.
    drawn_policy = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0")
    knowledge = drawn_policy.knowledge
    spec = stream_config.policy_spec(len(stream_config.task.categories))
    params = random_params(0, spec)
    counts = jnp.ones_like(knowledge.priors)
    exploration = Exploration(counts, counts, jnp.int32(1), jnp.int32(1))
    policy_dir = tmp_path / "policy"
    export_policy(policy_dir, stream_config, params, knowledge, drawn_policy.estimator_config, exploration)

    policy = jaxnav.load_policy(policy_dir)
    assert policy.spec == spec
    chex.assert_trees_all_equal(policy.params, params)

    # The loaded policy acts in its world, with experience.
    compiled_world = compile_evaluation_world(stream_config, "val", None, None, Console(quiet=True))
    env_params = compiled_world.make_env_params(0)
    _, state = compiled_world.env.reset(jax.random.key(0), env_params)
    observation = compiled_world.env.observe(state, env_params)
    action, memory = jax.jit(policy.act)(observation, policy.init(), heading=0, moved=False)
    assert 0 <= int(action) < compiled_world.env.num_actions
    np.testing.assert_array_equal(memory.policy_state.use_experience, 1.0)


def test_load_policy_refuses_export_without_decision(drawn_run, tmp_path):
    folder = shutil.copytree(drawn_run.config.run_dir / POLICIES_DIR / "layout-0", tmp_path / "layout-0")
    with resigned(folder / "policy.json") as exported:
        assert exported["spec"].pop("decision") == "fused"
    with pytest.raises(InputError, match=r"layout-0: its spec does not fit this code \(KeyError: 'decision'\)"):
        jaxnav.load_policy(folder)


@pytest.mark.exhaustive
def test_stream_run_is_trained_and_evaluated(config, tmp_path):
    ppo = dataclasses.replace(config.ppo, experience=0.5)
    run = jaxnav.train(dataclasses.replace(config, decision="streams", ppo=ppo, run_dir=tmp_path / "run"))
    assert run.config.decision == "streams"
    policies = run.policies()
    assert policies.spec.decision == "streams"
    assert "experience_stream" in policies.params
    results = jaxnav.evaluate(run, epsilon=np.array([0.0, 1.0]), episodes=8)
    assert results.rows
