"""Validation: what is measured, logged and exported."""

import dataclasses
import io

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
def validated(drawn_run):
    """The validator of a run, and its policies as training holds them."""
    config = dataclasses.replace(drawn_run.config, val_episodes=12)
    policies = drawn_run.policies()
    training = compile_training_world(config, QUIET)
    validator = Validator(config, policies.make_agent_loop(training), policies.knowledge, training, QUIET)
    held = {
        arm: [
            jaxnav.load_policy(drawn_run.config.run_dir / "policies" / f"{arm}-{seed}").params
            for seed in range(policies.num_seeds)
        ]
        for arm in policies.arms
    }
    return config, policies, validator, held


@pytest.mark.slow
def test_validator_equals_evaluation_on_the_same_episodes(validated):
    config, policies, validator, held = validated
    rows = [EvaluationRow(arm, None, None, decoding) for arm in policies.arms for decoding in DECODINGS]
    compiled_world = compile_evaluation_world(config, "val", None, None, QUIET)
    _, outcome, _ = evaluate_rows(rows, policies, compiled_world, config.val_episodes, 2**32)
    scores = validator.measure(held)
    for row, success, done in zip(rows, np.asarray(outcome.success), np.asarray(outcome.done), strict=True):
        if row.decoding == "sample":
            continue  # the draws are others
        for seed, score in enumerate(scores[row.variant]):
            assert score["val_success"] == success[seed].mean()
            assert score["val_timeout"] == pytest.approx(1 - done[seed].mean())
            assert score["val_success"] + score["val_timeout"] + score["val_wrong_done"] == pytest.approx(1)
    assert 0 < np.asarray(outcome.done).mean() < 1


@pytest.mark.slow
def test_success_by_budget_grows_to_the_validation_success(validated):
    _, policies, validator, held = validated
    reach = validator.success_by_budget(held)
    scores = validator.measure(held)
    assert reach["budgets"] == sorted(set(reach["budgets"]))
    for arm in policies.arms:
        for split in ("val", "train"):
            curve = reach[split][arm]["argmax"]
            assert curve == sorted(curve)
        success = np.mean([score["val_success"] for score in scores[arm]])
        assert reach["val"][arm]["argmax"][-1] == pytest.approx(success, abs=1e-4)


@pytest.mark.parametrize(
    ("validations", "after"), [(0, []), (1, [12]), (2, [6, 12]), (5, [4, 6, 8, 10, 12]), (99, [2, 4, 6, 8, 10, 12])]
)
def test_validation_updates_are_evenly_spaced_and_end_with_the_last_chunk(validations, after):
    ppo = PPOConfig(num_envs=64, rollout=10, minibatches=4)
    config = RunConfig(chunk=2, total_steps=12 * 640, ppo=ppo, validations=validations)
    assert sorted(config.validation_updates) == after


@pytest.mark.exhaustive
def test_train_exports_the_policy_with_the_highest_validation_success(config, tmp_path):
    config = dataclasses.replace(config, run_dir=tmp_path / "run", total_steps=8 * config.total_steps, val_episodes=40)
    run = train(dataclasses.replace(config, validations=4))
    last = train(dataclasses.replace(config, validations=0, run_dir=tmp_path / "last"))
    rows = [row for row in run.log() if "val_success" in row]
    assert len({row["step"] for row in rows}) == 4
    differ = []
    for arm in config.arms:
        for seed in range(config.seeds):
            course = [row["val_success"] for row in rows if (row["arm"], row["seed"]) == (arm, seed)]
            best = len(course) - 1 - int(np.argmax(course[::-1]))
            exported, final = (
                jaxnav.load_policy(one_run.config.run_dir / "policies" / f"{arm}-{seed}").params
                for one_run in (run, last)
            )
            same = np.array_equal(exported["fuse"]["kernel"], final["fuse"]["kernel"])
            assert same == (best == len(course) - 1)  # measuring changes nothing of training
            differ.append(not same)
    assert run.success_by_budget() is not None
    assert last.success_by_budget() is None


@pytest.mark.slow
def test_validator_uses_layout_weights_in_any_order_of_the_arms(validated):
    config, policies, validator, held = validated
    training = compile_training_world(config, QUIET)
    reversed_config = dataclasses.replace(config, arms=("layout", "baseline"), validations=1)
    trainer = make_trainer(reversed_config, training.env, policies.estimator_config, policies.knowledge)
    reversed_validator = _make_validator(reversed_config, trainer, policies.knowledge, training, QUIET)
    assert reversed_validator is not None
    expected = validator.measure(held)
    measured = reversed_validator.measure({arm: held[arm] for arm in reversed_config.arms})
    for seed in range(policies.num_seeds):
        for name in ("val_success", "val_timeout", "val_wrong_done"):  # of best actions, so no draws enter
            assert measured["layout"][seed][name] == expected["layout"][seed][name]
    # The weights matter: without them the same policies end other episodes.
    plain = trainer.learners["baseline"].agent_loop
    unweighted = Validator(config, plain, policies.knowledge, training, QUIET).measure(held)
    assert unweighted["layout"] != expected["layout"]


@pytest.mark.exhaustive
def test_train_without_val_scenes_exports_the_last_policy(config, tmp_path):
    scenes = tmp_path / "train_only.jsonl"
    write_scenes(scenes, [make_generated_scenes("rooms", "train", 2)[i] for i in range(2)])
    output = io.StringIO()
    console = PlainConsole(file=output, width=400)
    run = train(dataclasses.replace(config, run_dir=tmp_path / "run", scenes=scenes, validations=1), console)
    assert "no val scenes, so the policies of the last update are exported" in output.getvalue()
    assert run.success_by_budget() is None
    assert not any("val_success" in row for row in run.log())
