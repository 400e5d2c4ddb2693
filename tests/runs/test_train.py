"""Training from Python: runs are trained, opened, evaluated, and restricted to one arm."""

import dataclasses
import itertools
import math
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny
from support.commands import contents
from support.refusals import assert_message_names
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

NUM_EPISODES = 4


@pytest.fixture(scope="module")
def finished_config(tmp_path_factory):
    """The settings of a run that the train command has finished."""
    config_file, run_dir = finished_run(tmp_path_factory)
    return dataclasses.replace(apply_yaml(jaxnav.RunConfig(), config_file), run_dir=run_dir)


# A finished run


@pytest.mark.exhaustive
def test_train_leaves_a_finished_run_unchanged(finished_config, capsys):
    files_before = contents(finished_config.run_dir)
    assert jaxnav.train(finished_config) == jaxnav.Run(check_config(finished_config))
    assert contents(finished_config.run_dir) == files_before
    assert capsys.readouterr() == ("", "")


def test_run_opens_from_its_path(finished_config):
    # The cache, the devices and the interval of checkpoints are not part of a run's identity.
    default_config = jaxnav.RunConfig()
    defaults = {name: getattr(default_config, name) for name in ("save_every", "cache", "devices")}
    run = jaxnav.Run(finished_config)
    for path in (finished_config.run_dir, str(finished_config.run_dir)):
        opened = jaxnav.Run.open(path)
        assert opened.config == check_config(dataclasses.replace(finished_config, **defaults))
        chex.assert_trees_all_equal(opened.policies(), run.policies())
        assert opened.log() == run.log()
    with pytest.raises(InputError, match="holds no run"):
        jaxnav.Run.open(finished_config.run_dir / "policies")


def test_run_policies_are_stacked_by_arm_and_seed(finished_config):
    policies = jaxnav.Run(finished_config).policies()
    assert policies.arms == ("baseline", "layout")
    assert policies.num_seeds == NUM_SEEDS
    assert policies.spec == finished_config.policy_spec(len(finished_config.task.categories))

    # Each is the exported policy of its name.
    for policy_name in POLICY_NAMES:
        arm, seed_text = policy_name.split("-")
        loaded = jaxnav.load_policy(finished_config.run_dir / "policies" / policy_name)
        seed_params = tiny.leaves_at(policies.arm_params(arm), int(seed_text))
        chex.assert_trees_all_equal(loaded.params, seed_params)
        chex.assert_trees_all_equal(loaded.knowledge, policies.knowledge)
        assert loaded.spec == policies.spec
        assert loaded.estimator_config == (policies.estimator_config if arm == "layout" else None)

    # One arm can be read alone.
    layout_policies = jaxnav.Run(finished_config).policies(("layout",))
    chex.assert_trees_all_equal(layout_policies.params, policies.arm_params("layout"))


def test_run_log_has_a_row_per_chunk_arm_and_seed(finished_config):
    log_rows = jaxnav.Run(finished_config).log()
    row_keys = [(row["step"], row["arm"], row["seed"]) for row in log_rows]
    assert row_keys == list(itertools.product((2, 4), ("baseline", "layout"), range(NUM_SEEDS)))
    assert all(math.isfinite(row["success"]) for row in log_rows)


# Settings


@pytest.mark.parametrize(
    ("changes", "named_parts"),
    [
        ({"method": "anonymous", "arms": ("layout", "baseline")}, ["method 'anonymous'", "layout weights; give"]),
        ({"arms": ()}, ["config: arms is ()", "give baseline and layout, or one of them"]),
        ({"arms": ("layout", "layout")}, ["give baseline and layout, or one of them"]),
    ],
)
def test_train_refuses_invalid_settings_before_writing(config, tmp_path, changes, named_parts):
    settings = {"method_sizes": {}, "run_dir": tmp_path / "run"} | changes
    with pytest.raises(InputError) as error:
        jaxnav.train(dataclasses.replace(config, **settings))
    assert_message_names(error.value, *named_parts)
    assert not (tmp_path / "run").exists()


def test_check_config_converts_strings_to_paths():
    config = check_config(dataclasses.replace(RunConfig(), run_dir="runs/two", scenes="rooms.jsonl.gz"))  # type: ignore[arg-type]
    assert config.run_dir == Path("runs/two")
    assert config.scenes == Path("rooms.jsonl.gz")


# One arm alone


def one_chunk_config(config, run_dir, **changes):
    """Return the settings of the smallest run: one seed, one chunk."""
    return dataclasses.replace(config, seeds=1, total_steps=256, run_dir=run_dir, **changes)


@pytest.mark.exhaustive
def test_method_without_layout_support_is_trained_as_baseline_alone(config, tmp_path):
    run_dir = tmp_path / "run"
    anonymous = one_chunk_config(config, run_dir, method="anonymous", method_sizes={})
    run = jaxnav.train(anonymous)
    assert anonymous.arms == ("baseline", "layout")
    assert run.config == dataclasses.replace(anonymous, arms=("baseline",))
    assert jaxnav.Run.open(run_dir).config.arms == ("baseline",)

    # One policy without an estimator, and one row of the log.
    assert [folder.name for folder in (run_dir / "policies").iterdir()] == ["baseline-0"]
    policies = run.policies()
    assert policies.arms == ("baseline",)
    assert policies.num_seeds == 1
    assert policies.estimator_config is None
    (log_row,) = run.log()
    assert (log_row["step"], log_row["arm"], log_row["seed"], log_row["env_steps"]) == (2, "baseline", 0, 256)

    # Training it again changes nothing.
    files_before = contents(run_dir)
    assert jaxnav.train(anonymous) == run
    assert contents(run_dir) == files_before

    # An evaluation has no rows of the layout, and so no differences.
    results = jaxnav.evaluate(run, episodes=NUM_EPISODES)
    assert results.rows == [
        EvaluationRow("baseline", None, None, "argmax"),
        EvaluationRow("baseline", None, None, "sample"),
        EvaluationRow("random", None, None, "sample"),
        EvaluationRow("oracle", None, None, "argmax"),
    ]
    assert {leaf.shape for leaf in results.outcome} == {(4, 1, NUM_EPISODES)}
    assert results.report["differences"] == []

    # What needs the layout is refused.
    with pytest.raises(InputError, match="layout"):
        jaxnav.sweep(run, (0.5,))
    with pytest.raises(InputError, match="layout"):
        run.policies(("layout",))


@pytest.mark.exhaustive
def test_layout_arm_is_trained_and_evaluated_alone(config, tmp_path):
    run = jaxnav.train(one_chunk_config(config, tmp_path / "run", arms=("layout",)))
    assert [folder.name for folder in (tmp_path / "run" / "policies").iterdir()] == ["layout-0"]
    assert run.policies().estimator_config is not None

    # The rows of two decodings, Random and the oracle.
    results = jaxnav.evaluate(run, episodes=NUM_EPISODES)
    decoding_rows = [("layout", None), ("tde", None), ("stde", 0.5)]
    row_settings = [(row.variant, row.epsilon) for row in results.rows]
    assert row_settings == [*decoding_rows, *decoding_rows, ("random", None), ("oracle", None)]

    # TDE and sTDE are compared with the layout's row, which has no baseline: two decodings, three metrics.
    assert len(results.report["differences"]) == 2 * 2 * 3

    # A sweep from the evaluation's epsilon to 1, where nothing is removed.
    sweep = jaxnav.sweep(run, (0.5, 1.0), episodes=NUM_EPISODES)
    np.testing.assert_array_equal(sweep.outcome.length, results.outcome.length[[2, 0]])


# Knowledge from the training scenes


def assert_run_can_be_evaluated(run_dir):
    results = jaxnav.evaluate(jaxnav.Run.open(run_dir), episodes=NUM_EPISODES)
    assert {leaf.shape[-1] for leaf in results.outcome} == {NUM_EPISODES}


@pytest.mark.exhaustive
def test_hoz_zones_are_learned_from_training_scenes_and_exported(config, tmp_path):
    hoz_config = one_chunk_config(config, tmp_path / "run", method="hoz", method_sizes={})
    exported_zones = jaxnav.train(hoz_config).policies().knowledge.method

    def learn_zones_of_split(split):
        num_scenes = getattr(hoz_config.worlds, f"num_{split}")
        scenes = make_generated_scenes(hoz_config.world, split, num_scenes, hoz_config.worlds.seed)
        bank = compile_bank((scenes[index] for index in range(len(scenes))), hoz_config.task)
        num_categories = len(hoz_config.task.categories)
        return learn_zones([bank], np.zeros((NUM_PRIORS, num_categories, num_categories)))

    chex.assert_trees_all_equal(exported_zones, learn_zones_of_split("train"))
    for split in ("val", "test"):
        assert (exported_zones["nodes"] != learn_zones_of_split(split)["nodes"]).any()
    assert_run_can_be_evaluated(tmp_path / "run")


@pytest.mark.exhaustive
def test_sp_graph_is_learned_from_training_scenes_and_exported(config, tmp_path):
    sp_config = one_chunk_config(config, tmp_path / "run", method="sp", method_sizes={})
    console = Console(quiet=True)
    exported_graph = jaxnav.train(sp_config).policies().knowledge.method

    def learn_graph_of_world(world):
        return learn_graph(world.banks, np.asarray(explore_world(sp_config, world).counts))

    chex.assert_trees_all_equal(exported_graph, learn_graph_of_world(compile_training_world(sp_config, console)))
    for split in ("val", "test"):
        other_graph = learn_graph_of_world(compile_evaluation_world(sp_config, split, None, None, console))
        assert np.abs(exported_graph["mixing"] - other_graph["mixing"]).max() > 0.01
    assert_run_can_be_evaluated(tmp_path / "run")


@pytest.mark.exhaustive
def test_prior_knowledge_depends_on_training_scenes_alone(config, tmp_path):
    """Other training scenes change priors, evidence and zones; other val and test scenes change nothing."""
    worlds = config.worlds

    def train_knowledge(name, **changes):
        run_config = one_chunk_config(
            config,
            tmp_path / name,
            method="hoz",
            method_sizes={},
            arms=("layout",),
            worlds=dataclasses.replace(worlds, **changes),
        )
        policies = jaxnav.train(run_config).policies()
        return policies.knowledge, policies.prior_counts, policies.estimator_config

    knowledge, prior_counts, estimator_config = train_knowledge("one")
    val_knowledge, val_prior_counts, val_estimator_config = train_knowledge(
        "val", num_val=worlds.num_val + 3, num_test=worlds.num_test + 3
    )
    chex.assert_trees_all_equal((knowledge, prior_counts), (val_knowledge, val_prior_counts))
    assert estimator_config == val_estimator_config

    train_scene_knowledge, _, _ = train_knowledge("train", num_train=worlds.num_train + 3)
    is_equal = jax.tree.map(np.array_equal, knowledge, train_scene_knowledge)
    assert not any(jax.tree.leaves((is_equal.layout, is_equal.cooccurrence, is_equal.method["nodes"])))
