"""Other layout estimators: at evaluation by name, in training one prior for all rooms."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.variants import table_row
from jaxnav.layout import SETTINGS
from jaxnav.runs.evaluate import run_rows
from jaxnav.runs.prepare import explore_world
from jaxnav.runs.replay import replay
from jaxnav.runs.worlds import evaluation_world, training_world
from jaxnav.study.bench import Bench, Subject
from jaxnav.study.config import StudyConfig
from jaxnav.study.trials import Trial
from jaxnav.training.calibration import layout_priors
from jaxnav.training.exchange import chances

EPSILON, EPISODES = np.linspace(0, 1, 11), 24  # those of `evaluated`


@pytest.mark.slow
@pytest.mark.parametrize("setting", ["evidence", "learned", "overdue", "clock"])
def test_another_gap_changes_what_is_taken_out_and_nothing_else(drawn_run, evaluated, setting):
    other = jaxnav.evaluate(drawn_run, epsilon=EPSILON, episodes=EPISODES, setting=setting)
    assert other.rows == evaluated.rows
    assert other.report["run"]["evaluation_setting"] == setting
    for i, row in enumerate(evaluated.rows):
        same = all(np.array_equal(a[i], b[i]) for a, b in zip(evaluated.outcome, other.outcome, strict=True))
        if row.variant != "stde" or row.epsilon == 1.0:
            assert same, row
        elif row.epsilon == 0.0:
            assert not same, row


@pytest.mark.slow
def test_the_papers_estimator_makes_weights_of_its_own(drawn_run, evaluated):
    other = jaxnav.evaluate(drawn_run, epsilon=EPSILON, episodes=EPISODES, setting="paper")
    by_arm = {"baseline": [], "layout": []}
    for i, row in enumerate(evaluated.rows):
        if row.variant in by_arm:
            by_arm[row.variant].append(np.array_equal(evaluated.outcome.length[i], other.outcome.length[i]))
    assert all(by_arm["baseline"])
    assert not all(by_arm["layout"])


def test_settings_keep_what_they_do_not_name(drawn_run):
    policies = drawn_run.policies()
    assert policies.estimating(None) is policies
    evidence = policies.estimating("evidence")
    assert evidence.setting == dataclasses.replace(policies.setting, gap="evidence")
    np.testing.assert_array_equal(evidence.knowledge.layout, policies.knowledge.layout)
    released = policies.estimating("released")
    assert released.setting == SETTINGS["released"]
    np.testing.assert_array_equal(released.knowledge.layout, layout_priors(policies.counts, "released"))


def test_gaps_that_a_run_did_not_learn_are_refused(drawn_run):
    policies = drawn_run.policies()
    np.testing.assert_array_equal(policies.knowledge.signs.chance, chances(policies.counts))  # as exported
    without = policies._replace(knowledge=policies.knowledge._replace(signs=None))
    for name in ("learned", "overdue"):
        assert policies.estimating(name).setting == dataclasses.replace(policies.setting, gap=name)
        with pytest.raises(InputError, match=f"--setting {name}: the run learned no signs of another layout"):
            without.estimating(name)


def test_holding_is_for_every_estimator(drawn_run):
    policies = drawn_run.policies()
    for name in (None, "evidence", "released", "clock"):
        plain, held = policies.estimating(name).setting, policies.estimating(name, hold=True).setting
        assert held == dataclasses.replace(plain, hold=True)
    with pytest.raises(InputError, match="--hold: needs policies with the layout"):
        policies._replace(setting=None).estimating(None, hold=True)


def test_policies_without_the_layout_have_no_estimator(drawn_run):
    with pytest.raises(InputError, match="--setting evidence: needs policies with the layout"):
        drawn_run.policies(("baseline",))._replace(setting=None).estimating("evidence")


def test_policies_adapt_by_as_many_steps_as_they_can(drawn_run):
    policies = drawn_run.policies()
    assert policies.adapting(None) is policies
    with pytest.raises(
        InputError, match=r"^inner_steps is 0; method 'org' does not adapt in an episode, leave it out$"
    ):
        policies.adapting(0)
    adaptive = policies._replace(spec=dataclasses.replace(policies.spec, method="savn"))
    with pytest.raises(
        InputError, match=r"^inner_steps is 5; an episode remembers 4 windows of 6 actions: give 0 to 4$"
    ):
        adaptive.adapting(5)
    world = evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))
    assert adaptive.adapting(0).acting(world).inner_steps == 0
    assert adaptive.acting(world).inner_steps is None


def test_scenes_that_a_method_cannot_act_in_are_refused_wherever_it_acts(drawn_run):
    """A map of 12 lines holds a cell and the 11 of a view."""
    world = evaluation_world(drawn_run.config, "val", None, None, Console(quiet=True))
    policies = drawn_run.policies()
    searching = policies._replace(
        spec=dataclasses.replace(policies.spec, method="semexp"),
        knowledge=policies.knowledge._replace(method={"lines": jnp.arange(12)}),
    )
    subject = Subject(searching, world, episode_list(world.banks[0], 4))
    row = table_row("baseline", None, None, "argmax")
    config = StudyConfig(split="val", shifts=(0.0,), episodes=4)
    for act in (
        lambda: searching.acting(world),
        lambda: run_rows([row], searching, world, 4, 0),
        lambda: replay(searching, world, subject.episodes, row),
        lambda: Bench(config).run(subject, None, [Trial("baseline", "argmax")]),
    ):
        with pytest.raises(InputError, match=r"needs a map of .* cells, and that of the training homes has 12"):
            act()


def test_a_pooled_prior_is_one_for_all_rooms(config):
    world = training_world(config, Console(quiet=True))
    pooled = dataclasses.replace(config, layout=dataclasses.replace(config.layout, prior="pooled"))
    by_room, whole = (np.asarray(explore_world(each, world).counts) for each in (config, pooled))
    assert np.abs(by_room - by_room[0]).max() > 0  # rooms differ
    for room in whole:
        np.testing.assert_allclose(room, by_room.sum(axis=0))
