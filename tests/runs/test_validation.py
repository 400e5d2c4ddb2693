"""Validation during training: its measurements, its log rows and the exported policies."""

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest

import jaxnav
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.plain_console import PlainConsole
from jaxnav.runs.config import RunConfig
from jaxnav.runs.evaluate import evaluate_rows
from jaxnav.runs.train import _make_validator, make_trainer, train
from jaxnav.runs.validation import DECODINGS, Validator
from jaxnav.runs.worlds import compile_evaluation_world, compile_training_world
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.worlds import make_generated_scenes
from jaxnav.training.config import PPOConfig

QUIET = PlainConsole(quiet=True)


@pytest.fixture(scope="module")
def validator_setup(drawn_run):
    """Settings of a run, its policies, its validator, and parameters by arm and seed as training holds them."""
    config = dataclasses.replace(drawn_run.config, val_episodes=12)
    policies = drawn_run.policies()
    training_world = compile_training_world(config, QUIET)
    validator = Validator(config, policies.make_agent_loop(training_world), policies.knowledge, training_world, QUIET)
    params_by_arm = {arm: [] for arm in policies.arms}
    for arm in policies.arms:
        for seed in range(policies.num_seeds):
            policy = jaxnav.load_policy(drawn_run.config.run_dir / "policies" / f"{arm}-{seed}")
            params_by_arm[arm].append(policy.params)
    return config, policies, validator, params_by_arm


@pytest.mark.slow
def test_validator_equals_evaluation_on_equal_episodes(validator_setup):
    config, policies, validator, params_by_arm = validator_setup
    rows = [EvaluationRow(arm, None, None, decoding) for arm in policies.arms for decoding in DECODINGS]
    compiled_world = compile_evaluation_world(config, "val", None, None, QUIET)
    _, outcome, _ = evaluate_rows(rows, policies, compiled_world, config.val_episodes, 2**32)
    scores = validator.measure(params_by_arm)
    for row, success, done in zip(rows, np.asarray(outcome.success), np.asarray(outcome.done), strict=True):
        if row.decoding == "sample":
            continue  # the evaluation draws other actions
        for seed, score in enumerate(scores[row.variant]):
            assert score["val_success"] == success[seed].mean()
            assert score["val_timeout"] == pytest.approx(1 - done[seed].mean())
            assert score["val_success"] + score["val_timeout"] + score["val_wrong_done"] == pytest.approx(1)
    assert 0 < np.asarray(outcome.done).mean() < 1


@pytest.mark.slow
def test_success_by_budget_grows_to_the_validation_success(validator_setup):
    _, policies, validator, params_by_arm = validator_setup
    reach = validator.success_by_budget(params_by_arm)
    scores = validator.measure(params_by_arm)
    assert reach["budgets"] == sorted(set(reach["budgets"]))
    for arm in policies.arms:
        for split in ("val", "train"):
            curve = reach[split][arm]["argmax"]
            assert curve == sorted(curve)

        # The largest budget is the step limit.
        success = np.mean([score["val_success"] for score in scores[arm]])
        assert reach["val"][arm]["argmax"][-1] == pytest.approx(success, abs=1e-4)


@pytest.mark.parametrize(
    ("validations", "expected_updates"),
    [(0, []), (1, [12]), (2, [6, 12]), (5, [4, 6, 8, 10, 12]), (99, [2, 4, 6, 8, 10, 12])],
)
def test_validation_updates_are_evenly_spaced_and_end_with_the_last_chunk(validations, expected_updates):
    ppo = PPOConfig(num_envs=64, rollout=10, minibatches=4)
    config = RunConfig(chunk=2, total_steps=12 * 640, ppo=ppo, validations=validations)
    assert sorted(config.validation_updates) == expected_updates


@pytest.mark.exhaustive
def test_train_exports_the_policy_with_the_highest_validation_success(config, tmp_path):
    config = dataclasses.replace(config, run_dir=tmp_path / "run", total_steps=8 * config.total_steps, val_episodes=40)
    run = train(dataclasses.replace(config, validations=4))
    unvalidated_run = train(dataclasses.replace(config, validations=0, run_dir=tmp_path / "unvalidated"))
    rows = [row for row in run.log() if "val_success" in row]
    assert len({row["step"] for row in rows}) == 4

    for arm in config.arms:
        for seed in range(config.seeds):
            # The last of several best validations counts.
            success = [row["val_success"] for row in rows if (row["arm"], row["seed"]) == (arm, seed)]
            best_index = len(success) - 1 - int(np.argmax(success[::-1]))

            # Validation changes nothing of training, so a run without it exports the policy of the last update.
            policy_path = Path("policies") / f"{arm}-{seed}"
            exported_params = jaxnav.load_policy(run.config.run_dir / policy_path).params
            last_params = jaxnav.load_policy(unvalidated_run.config.run_dir / policy_path).params
            is_last = np.array_equal(exported_params["fuse"]["kernel"], last_params["fuse"]["kernel"])
            assert is_last == (best_index == len(success) - 1)

    assert run.success_by_budget() is not None
    assert unvalidated_run.success_by_budget() is None


@pytest.mark.slow
def test_validator_uses_layout_weights_in_any_order_of_the_arms(validator_setup):
    config, policies, validator, params_by_arm = validator_setup
    training_world = compile_training_world(config, QUIET)
    reversed_config = dataclasses.replace(config, arms=("layout", "baseline"), validations=1)
    trainer = make_trainer(reversed_config, training_world.env, policies.estimator_config, policies.knowledge)
    reversed_validator = _make_validator(reversed_config, trainer, policies.knowledge, training_world, QUIET)
    assert reversed_validator is not None

    # Scores of best actions are equal, because they depend on no draws.
    expected = validator.measure(params_by_arm)
    scores = reversed_validator.measure({arm: params_by_arm[arm] for arm in reversed_config.arms})
    for seed in range(policies.num_seeds):
        for name in ("val_success", "val_timeout", "val_wrong_done"):
            assert scores["layout"][seed][name] == expected["layout"][seed][name]

    # Without layout weights, these policies have other scores.
    baseline_loop = trainer.learners["baseline"].agent_loop
    unweighted_validator = Validator(config, baseline_loop, policies.knowledge, training_world, QUIET)
    unweighted_scores = unweighted_validator.measure(params_by_arm)
    assert unweighted_scores["layout"] != expected["layout"]


@pytest.mark.exhaustive
def test_train_without_val_scenes_exports_the_last_policy(config, tmp_path):
    scene_file = tmp_path / "train_only.jsonl"
    train_scenes = make_generated_scenes("rooms", "train", 2)
    write_scenes(scene_file, [train_scenes[index] for index in range(2)])
    output = io.StringIO()
    console = PlainConsole(file=output, width=400)
    run = train(dataclasses.replace(config, run_dir=tmp_path / "run", scenes=scene_file, validations=1), console)
    assert "no val scenes, so the policies of the last update are exported" in output.getvalue()
    assert run.success_by_budget() is None
    assert not any("val_success" in row for row in run.log())
