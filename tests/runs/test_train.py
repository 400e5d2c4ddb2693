"""Runs from Python: trained, opened again, evaluated, with some of the arms."""

import csv
import dataclasses
import json

import chex
import jax
import numpy as np
import pytest
from support.commands import contents

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.variants import Row

EPISODES = 8


def small(config, run_dir, **changes):
    """The smallest run of the config: one seed, one chunk."""
    changes = {"seeds": 1, "total_steps": 256, "run_dir": run_dir} | changes
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def anonymous(config, tmp_path_factory):
    """A finished run of the method that cannot host the layout."""
    return small(config, tmp_path_factory.mktemp("train") / "run", method="anonymous", method_sizes={})


@pytest.fixture(scope="module")
def run(anonymous):
    return jaxnav.train(anonymous)


@pytest.fixture(scope="module")
def results(run):
    return jaxnav.evaluate(run, episodes=EPISODES)


def test_a_method_that_cannot_host_the_layout_trains_the_baseline_alone(run, anonymous):
    assert anonymous.arms == ("baseline", "layout")
    assert run.config == dataclasses.replace(anonymous, arms=("baseline",))
    assert [folder.name for folder in (run.config.run_dir / "policies").iterdir()] == ["baseline-0"]
    policies = run.policies()
    assert (policies.arms, policies.seeds, policies.setting) == (("baseline",), 1, None)
    assert {len(leaf) for leaf in jax.tree.leaves(policies.params)} == {1}
    assert policies.spec == run.config.policy_spec(len(run.config.task.categories))
    with pytest.raises(InputError, match="was trained without the arm 'layout'"):
        run.policies(("layout",))


def test_the_log_has_a_row_of_every_chunk_arm_and_seed(run):
    (row,) = run.log()
    assert (row["step"], row["arm"], row["seed"], row["env_steps"]) == (2, "baseline", 0, 256)
    assert np.isfinite(row["success"])


def test_what_is_exported_is_what_is_loaded(run):
    loaded = jaxnav.load_policy(run.config.run_dir / "policies" / "baseline-0")
    policies = run.policies()
    chex.assert_trees_all_equal(loaded.params, jax.tree.map(lambda leaf: leaf[0], policies.params))
    chex.assert_trees_all_equal(loaded.knowledge, policies.knowledge)
    assert (loaded.spec, loaded.setting) == (policies.spec, None)


def test_the_same_run_is_opened_from_its_path(run):
    for path in (run.config.run_dir, str(run.config.run_dir)):
        opened = jaxnav.Run.open(path)
        chex.assert_trees_all_equal(opened.policies(), run.policies())
        assert opened.log() == run.log()
        elsewhere = {name: getattr(jaxnav.RunConfig(), name) for name in ("save_every", "cache", "devices")}
        assert opened.config == dataclasses.replace(run.config, **elsewhere)  # no part of what a run is
    with pytest.raises(InputError, match="holds no run"):
        jaxnav.Run.open(run.config.run_dir / "policies")


def test_training_a_finished_run_leaves_it_as_it_is(run, anonymous, results):
    before = contents(run.config.run_dir)
    assert jaxnav.train(anonymous) == run
    assert contents(run.config.run_dir) == before


def test_an_evaluation_has_the_rows_of_the_arms_there_are(results):
    assert results.rows == [
        Row("baseline", None, None, "argmax"),
        Row("baseline", None, None, "sample"),
        Row("random", None, None, "sample"),
        Row("oracle", None, None, "argmax"),
    ]
    assert {leaf.shape for leaf in results.outcome} == {(4, 1, EPISODES)}
    metrics = results.metrics()
    assert list(metrics) == ["sr", "spl", "dts", "sae"]
    assert {values.shape for values in metrics.values()} == {(4, 1, EPISODES)}
    assert len(results.episodes.goal) == EPISODES
    assert results.report["compilations"] == 1
    assert results.report["differences"] == []
    assert [row["sr"]["mean"] for row in results.report["rows"]] == pytest.approx(100 * metrics["sr"].mean((1, 2)))


def test_an_evaluation_is_written_as_json_and_csv(results, tmp_path):
    results.write(tmp_path / "new" / "table.json")
    assert json.loads((tmp_path / "new" / "table.json").read_text()) == json.loads(json.dumps(results.report))
    with (tmp_path / "new" / "table.episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * EPISODES
    assert [int(row["length"]) for row in rows] == results.outcome.length.ravel().tolist()
    assert [float(row["spl"]) for row in rows] == pytest.approx(results.metrics()["spl"].ravel(), rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"arms": ("layout",)},
            "config: arms is ('layout',); method 'anonymous' cannot host the layout; give baseline",
        ),
        ({"arms": ("layout", "baseline")}, "cannot host the layout; give baseline"),
        ({"arms": ()}, "config: arms is (); give some of baseline, layout"),
        ({"method": "orgy"}, "method 'orgy': is unknown; did you mean 'org'?"),
        ({"method_sizes": {"relation_layers": 1}}, "method_sizes.relation_layers is 1; is unknown; 'anonymous' has no"),
    ],
)
def test_impossible_runs_are_refused_before_anything_is_made(anonymous, tmp_path, changes, problem):
    config = dataclasses.replace(anonymous, run_dir=tmp_path / "run", **changes)
    with pytest.raises(InputError) as error:
        jaxnav.train(config)
    assert problem in str(error.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_layout_is_trained_and_evaluated_alone(config, tmp_path):
    run = jaxnav.train(small(config, tmp_path / "run", arms=("layout",)))
    assert [folder.name for folder in (tmp_path / "run" / "policies").iterdir()] == ["layout-0"]
    assert run.policies().setting is not None
    results = jaxnav.evaluate(run, episodes=EPISODES)
    names = [(row.variant, row.epsilon) for row in results.rows]
    one = [("layout", None), ("tde", None), ("stde", 0.5)]
    assert names == [*one, *one, ("random", None), ("oracle", None)]
    # The others are compared with the layout's row, which has nothing to be compared with itself.
    assert len(results.report["differences"]) == 2 * 2 * 3
    sweep = jaxnav.sweep(run, (0.5, 1.0), episodes=EPISODES)
    np.testing.assert_array_equal(sweep.outcome.length, results.outcome.length[[2, 0]])
