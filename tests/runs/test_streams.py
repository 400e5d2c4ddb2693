"""Runs whose policies decide in two streams: their settings, their exports, training and evaluation."""

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
def streams(config):
    # The default of `ppo.experience` depends on the decision.
    ppo = dataclasses.replace(config.ppo, experience=None)
    return check_config(dataclasses.replace(config, decision="streams", ppo=ppo))


def test_stream_config_disables_counterfactual_training(streams):
    assert (streams.direct, streams.counterfactual) == ("goal", "none")
    spec = streams.policy_spec(9)
    assert (spec.decision, spec.direct) == ("streams", "goal")
    fused = check_config(RunConfig())
    assert (fused.decision, fused.direct, fused.counterfactual) == ("fused", "goal", "distil")


@pytest.mark.slow
def test_exported_stream_policy_acts(drawn_run, streams, tmp_path):
    drawn = jaxnav.load_policy(drawn_run.config.run_dir / POLICIES_DIR / "layout-0")
    params = random_params(0, streams.policy_spec(len(streams.task.categories)))
    counts = jnp.ones_like(drawn.knowledge.layout)
    explored = Exploration(counts, counts, jnp.int32(1), jnp.int32(1))
    export_policy(tmp_path / "policy", streams, params, drawn.knowledge, drawn.estimator_config, explored)
    policy = jaxnav.load_policy(tmp_path / "policy")
    assert policy.spec == streams.policy_spec(len(streams.task.categories))
    chex.assert_trees_all_equal(policy.params, params)
    compiled_world = compile_evaluation_world(streams, "val", None, None, Console(quiet=True))
    _, state = compiled_world.env.reset(jax.random.key(0), compiled_world.make_env_params(0))
    observation = compiled_world.env.observe(state, compiled_world.make_env_params(0))
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
