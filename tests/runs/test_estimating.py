"""Other layout estimators: at evaluation by name, in training one prior for all rooms."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.variants import table_row
from jaxnav.experiments.trials import EvaluatedRun, Trial, TrialRunner
from jaxnav.layout import ESTIMATORS
from jaxnav.policies.methods import METHODS
from jaxnav.runs.evaluate import evaluate_rows, replay_episodes
from jaxnav.runs.train import explore_world
from jaxnav.runs.worlds import compile_evaluation_world, compile_training_world
from jaxnav.training.calibration import co_visibility_from_counts, layout_priors

EPSILON, EPISODES = np.linspace(0, 1, 11), 24  # those of `evaluated`


@pytest.mark.exhaustive
@pytest.mark.parametrize("setting", ["evidence", "clock"])
def test_gap_estimator_changes_stde_rows_alone(drawn_run, evaluated, setting):
    other = jaxnav.evaluate(drawn_run, epsilon=EPSILON, episodes=EPISODES, setting=setting)
    assert other.rows == evaluated.rows
    assert other.report["run"]["evaluation_setting"] == setting
    for i, row in enumerate(evaluated.rows):
        same = all(np.array_equal(a[i], b[i]) for a, b in zip(evaluated.outcome, other.outcome, strict=True))
        if row.variant != "stde" or row.epsilon == 1.0:
            assert same, row
        elif row.epsilon == 0.0:
            assert not same, row


@pytest.mark.exhaustive
def test_paper_estimator_changes_layout_rows_alone(drawn_run, evaluated):
    other = jaxnav.evaluate(drawn_run, epsilon=EPSILON, episodes=EPISODES, setting="paper")
    by_arm = {"baseline": [], "layout": []}
    for i, row in enumerate(evaluated.rows):
        if row.variant in by_arm:
            by_arm[row.variant].append(np.array_equal(evaluated.outcome.length[i], other.outcome.length[i]))
    assert all(by_arm["baseline"])
    assert not all(by_arm["layout"])


def test_with_estimator_keeps_fields_that_the_setting_does_not_name(drawn_run):
    policies = drawn_run.policies()
    assert policies.with_estimator(None) is policies
    evidence = policies.with_estimator("evidence")
    assert evidence.estimator_config == dataclasses.replace(policies.estimator_config, gap="evidence")
    np.testing.assert_array_equal(evidence.knowledge.priors, policies.knowledge.priors)
    released = policies.with_estimator("released")
    assert released.estimator_config == ESTIMATORS["released"]
    np.testing.assert_array_equal(released.knowledge.priors, layout_priors(policies.prior_counts, "released"))


def test_with_estimator_refuses_gaps_without_learned_cooccurrence(drawn_run):
    policies = drawn_run.policies()
    np.testing.assert_array_equal(
        policies.knowledge.cooccurrence.co_visibility, co_visibility_from_counts(policies.prior_counts)
    )  # as exported
    without = policies._replace(knowledge=policies.knowledge._replace(cooccurrence=None))
    for name in ("learned", "overdue"):
        assert policies.with_estimator(name).estimator_config == dataclasses.replace(
            policies.estimator_config, gap=name
        )
        with pytest.raises(InputError, match=f"--setting {name}: the run or policy holds no evidence for this gap"):
            without.with_estimator(name)


def test_with_estimator_holds_the_gap_of_every_estimator(drawn_run):
    policies = drawn_run.policies()
    for name in (None, "evidence", "released", "clock"):
        plain = policies.with_estimator(name).estimator_config
        held = policies.with_estimator(name, hold=True).estimator_config
        assert held == dataclasses.replace(plain, hold=True)
    with pytest.raises(InputError, match="--hold: needs policies with the layout"):
        policies._replace(estimator_config=None).with_estimator(None, hold=True)


def test_with_estimator_refuses_policies_without_the_layout(drawn_run):
    with pytest.raises(InputError, match="--setting evidence: needs policies with the layout"):
        drawn_run.policies(("baseline",))._replace(estimator_config=None).with_estimator("evidence")


def test_with_inner_steps_refuses_more_steps_than_the_method_adapts(drawn_run):
    policies = drawn_run.policies()
    assert policies.with_inner_steps(None) is policies
    with pytest.raises(
        InputError, match=r"^inner_steps is 0, but method 'org' does not adapt within an episode; omit it$"
    ):
        policies.with_inner_steps(0)
    adaptive = policies._replace(spec=dataclasses.replace(policies.spec, method=METHODS["savn"]))
    with pytest.raises(
        InputError, match=r"^inner_steps is 5, but an episode stores 4 windows of 6 actions; give 0 to 4$"
    ):
        adaptive.with_inner_steps(5)
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))
    assert adaptive.with_inner_steps(0).make_agent_loop(compiled_world).inner_steps == 0
    assert adaptive.make_agent_loop(compiled_world).inner_steps is None


@pytest.mark.slow
def test_semexp_refuses_scenes_larger_than_its_map_at_every_entry_point(drawn_run):
    """A map of 12 lines holds a cell and the 11 of a view."""
    compiled_world = compile_evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))
    policies = drawn_run.policies()
    searching = policies._replace(
        spec=dataclasses.replace(policies.spec, method=METHODS["semexp"]),
        knowledge=policies.knowledge._replace(method={"lines": jnp.arange(12)}),
    )
    subject = EvaluatedRun(searching, compiled_world, draw_episodes(compiled_world.banks[0], 4))
    row = table_row("baseline", None, None, "argmax")
    for act in (
        lambda: searching.make_agent_loop(compiled_world),
        lambda: evaluate_rows([row], searching, compiled_world, 4, 0),
        lambda: replay_episodes(searching, compiled_world, subject.episodes, row),
        lambda: TrialRunner(seed=0).run_trials(subject, None, [Trial("baseline", "argmax")]),
    ):
        with pytest.raises(InputError, match=r"needs a map of .* cells, but the map of the training homes has 12"):
            act()


@pytest.mark.slow
def test_pooled_prior_sums_the_counts_of_all_rooms(config):
    compiled_world = compile_training_world(config, Console(quiet=True))
    pooled = dataclasses.replace(config, layout=dataclasses.replace(config.layout, prior="pooled"))
    by_room, whole = (np.asarray(explore_world(one_config, compiled_world).counts) for one_config in (config, pooled))
    assert np.abs(by_room - by_room[0]).max() > 0  # rooms differ
    for room in whole:
        np.testing.assert_allclose(room, by_room.sum(axis=0))
