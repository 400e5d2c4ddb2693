"""Runs from Python: trained, opened again, evaluated, with some of the arms."""

import dataclasses
import math
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
from rich.console import Console
from support.commands import contents
from support.tiny_run import NUM_SEEDS, POLICY_NAMES, finished_run

import jaxnav
from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.errors import InputError
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.policies.methods.hoz import learn_zones
from jaxnav.policies.methods.sp import learn_graph
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.config_files import apply_yaml
from jaxnav.runs.train import explore_world
from jaxnav.runs.worlds import compile_evaluation_world, compile_training_world
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.worlds import make_generated_scenes

EPISODES = 4


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The settings of a run that the train command has finished."""
    config_file, run_dir = finished_run(tmp_path_factory)
    return dataclasses.replace(apply_yaml(jaxnav.RunConfig(), config_file), run_dir=run_dir)


@pytest.mark.slow
def test_train_leaves_a_finished_run_unchanged(trained, capsys):
    before = contents(trained.run_dir)
    assert jaxnav.train(trained) == jaxnav.Run(trained)
    assert contents(trained.run_dir) == before
    assert capsys.readouterr() == ("", "")


def test_run_opens_from_its_path(trained):
    # Where it runs and what is kept how often is no part of what a run is.
    usual = {name: getattr(jaxnav.RunConfig(), name) for name in ("save_every", "cache", "devices")}
    for path in (trained.run_dir, str(trained.run_dir)):
        opened = jaxnav.Run.open(path)
        assert opened.config == dataclasses.replace(trained, **usual)
        chex.assert_trees_all_equal(opened.policies(), jaxnav.Run(trained).policies())
        assert opened.log() == jaxnav.Run(trained).log()
    with pytest.raises(InputError, match="holds no run"):
        jaxnav.Run.open(trained.run_dir / "policies")


def test_run_policies_are_stacked_by_arm_and_seed(trained):
    policies = jaxnav.Run(trained).policies()
    assert (policies.arms, policies.num_seeds) == (("baseline", "layout"), NUM_SEEDS)
    assert policies.spec == trained.policy_spec(len(trained.task.categories))
    for name in POLICY_NAMES:
        arm, seed = name.split("-")
        loaded = jaxnav.load_policy(trained.run_dir / "policies" / name)
        chex.assert_trees_all_equal(
            loaded.params, jax.tree.map(lambda leaf, i=int(seed): leaf[i], policies.arm_params(arm))
        )
        chex.assert_trees_all_equal(loaded.knowledge, policies.knowledge)
        assert loaded.spec == policies.spec
        assert loaded.estimator_config == (policies.estimator_config if arm == "layout" else None)
    layout = jaxnav.Run(trained).policies(("layout",))
    chex.assert_trees_all_equal(layout.params, policies.arm_params("layout"))


def test_run_log_has_a_row_per_chunk_arm_and_seed(trained):
    rows = jaxnav.Run(trained).log()
    identities = [(row["step"], row["arm"], row["seed"]) for row in rows]
    assert identities == [
        (step, arm, seed) for step in (2, 4) for arm in ("baseline", "layout") for seed in range(NUM_SEEDS)
    ]
    assert all(math.isfinite(row["success"]) for row in rows)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"method": "anonymous", "arms": ("layout",)},
            "config: arms is ('layout',); method 'anonymous' cannot host",
        ),
        ({"method": "anonymous", "arms": ("layout", "baseline")}, "method 'anonymous' cannot host the layout; give"),
        ({"arms": ()}, "config: arms is (); give some of baseline, layout"),
        ({"arms": ("layout", "layout")}, "give some of baseline, layout, each once"),
        ({"method": "orgy"}, "method 'orgy': is unknown; did you mean 'org'?"),
        ({"method_sizes": {"layers": 1}}, "method_sizes.layers is 1; is unknown; 'org' has relation_layers"),
    ],
)
def test_train_refuses_invalid_settings_before_writing(config, tmp_path, changes, problem):
    changed = {"method_sizes": {}, "run_dir": tmp_path / "run"} | changes
    with pytest.raises(InputError) as error:
        jaxnav.train(dataclasses.replace(config, **changed))
    assert problem in str(error.value)
    assert not (tmp_path / "run").exists()


def small(config, run_dir, **changes):
    """The smallest run of the config: one seed, one chunk."""
    return dataclasses.replace(config, seeds=1, total_steps=256, run_dir=run_dir, **changes)


@pytest.mark.slow
def test_method_without_layout_support_is_trained_as_baseline_alone(config, tmp_path):
    anonymous = small(config, tmp_path / "run", method="anonymous", method_sizes={})
    run = jaxnav.train(anonymous)
    assert anonymous.arms == ("baseline", "layout")
    assert run.config == dataclasses.replace(anonymous, arms=("baseline",))
    assert jaxnav.Run.open(tmp_path / "run").config.arms == ("baseline",)
    assert [folder.name for folder in (tmp_path / "run" / "policies").iterdir()] == ["baseline-0"]
    policies = run.policies()
    assert (policies.arms, policies.num_seeds, policies.estimator_config) == (("baseline",), 1, None)
    (row,) = run.log()
    assert (row["step"], row["arm"], row["seed"], row["env_steps"]) == (2, "baseline", 0, 256)

    before = contents(tmp_path / "run")
    assert jaxnav.train(anonymous) == run
    assert contents(tmp_path / "run") == before

    results = jaxnav.evaluate(run, episodes=EPISODES)
    baseline = [EvaluationRow("baseline", None, None, decoding) for decoding in ("argmax", "sample")]
    assert results.rows == [
        *baseline,
        EvaluationRow("random", None, None, "sample"),
        EvaluationRow("oracle", None, None, "argmax"),
    ]
    assert {leaf.shape for leaf in results.outcome} == {(4, 1, EPISODES)}
    assert results.report["differences"] == []
    for problem in (lambda: jaxnav.sweep(run, (0.5,)), lambda: run.policies(("layout",))):
        with pytest.raises(InputError, match="was trained without the arm 'layout'"):
            problem()


@pytest.mark.slow
def test_layout_arm_is_trained_and_evaluated_alone(config, tmp_path):
    run = jaxnav.train(small(config, tmp_path / "run", arms=("layout",)))
    assert [folder.name for folder in (tmp_path / "run" / "policies").iterdir()] == ["layout-0"]
    assert run.policies().estimator_config is not None
    results = jaxnav.evaluate(run, episodes=EPISODES)
    one = [("layout", None), ("tde", None), ("stde", 0.5)]
    assert [(row.variant, row.epsilon) for row in results.rows] == [*one, *one, ("random", None), ("oracle", None)]
    # The others are compared with the layout's row, which has nothing to be compared with itself.
    assert len(results.report["differences"]) == 2 * 2 * 3
    sweep = jaxnav.sweep(run, (0.5, 1.0), episodes=EPISODES)
    np.testing.assert_array_equal(sweep.outcome.length, results.outcome.length[[2, 0]])


def test_check_config_converts_strings_to_paths():
    config = check_config(dataclasses.replace(RunConfig(), run_dir="runs/two", scenes="rooms.jsonl.gz"))  # type: ignore[arg-type]
    assert (config.run_dir, config.scenes) == (Path("runs/two"), Path("rooms.jsonl.gz"))


@pytest.mark.slow
def test_hoz_zones_are_learned_from_training_scenes_and_exported(config, tmp_path):
    hoz = small(config, tmp_path / "run", method="hoz", method_sizes={})
    exported = jaxnav.train(hoz).policies().knowledge.method

    def learned(split):
        scenes = make_generated_scenes(hoz.world, split, getattr(hoz.worlds, f"num_{split}"), hoz.worlds.seed)
        bank = compile_bank((scenes[i] for i in range(len(scenes))), hoz.task)
        return learn_zones([bank], np.zeros((NUM_PRIORS, *2 * [len(hoz.task.categories)])))

    chex.assert_trees_all_equal(exported, learned("train"))
    for split in ("val", "test"):
        assert (exported["nodes"] != learned(split)["nodes"]).any()
    results = jaxnav.evaluate(jaxnav.Run.open(tmp_path / "run"), episodes=EPISODES)
    assert {leaf.shape[-1] for leaf in results.outcome} == {EPISODES}


@pytest.mark.slow
def test_prior_knowledge_depends_on_training_scenes_alone(config, tmp_path):
    """Priors, signs, calibration and zones: other training scenes change all of them, other val scenes nothing."""

    def known(name, **worlds):
        changed = dataclasses.replace(config.worlds, **worlds)
        policies = jaxnav.train(
            small(config, tmp_path / name, method="hoz", method_sizes={}, arms=("layout",), worlds=changed)
        ).policies()
        return (policies.knowledge, policies.prior_counts), policies.estimator_config

    worlds = config.worlds
    one, setting = known("one")
    elsewhere, of_elsewhere = known("val", num_val=worlds.num_val + 3, num_test=worlds.num_test + 3)
    chex.assert_trees_all_equal(one, elsewhere)
    assert setting == of_elsewhere
    same, _ = jax.tree.map(np.array_equal, one, known("train", num_train=worlds.num_train + 3)[0])
    assert not any(jax.tree.leaves((same.layout, same.cooccurrence, same.method["nodes"])))


@pytest.mark.slow
def test_sp_graph_is_learned_from_training_scenes_and_exported(config, tmp_path):
    sp, console = small(config, tmp_path / "run", method="sp", method_sizes={}), Console(quiet=True)
    exported = jaxnav.train(sp).policies().knowledge.method

    def learned(world):
        return learn_graph(world.banks, np.asarray(explore_world(sp, world).counts))

    chex.assert_trees_all_equal(exported, learned(compile_training_world(sp, console)))
    for split in ("val", "test"):
        other = learned(compile_evaluation_world(sp, split, None, None, console))
        assert np.abs(exported["mixing"] - other["mixing"]).max() > 0.01
    results = jaxnav.evaluate(jaxnav.Run.open(tmp_path / "run"), episodes=EPISODES)
    assert {leaf.shape[-1] for leaf in results.outcome} == {EPISODES}
