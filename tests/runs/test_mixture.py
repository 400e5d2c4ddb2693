"""A run in a mixed population."""

import dataclasses
import json

import pytest
from rich.console import Console
from support import study_results

from jaxnav.cli import study as command
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.config import StudyConfig
from jaxnav.study.measure import TrialRunner
from jaxnav.study.mixture import ORACLE_NAME, REMOVAL_RULES, measure_mixture
from jaxnav.study.records import MixtureReport, from_json

QUIET = Console(quiet=True)
VALUES = {name: (Interval(50.0, 40.0, 60.0), Interval(30.0, 20.0, 40.0)) for name in ("sr", "spl", "sr@20", "sr@50")}
SOME = (REMOVAL_RULES[0], REMOVAL_RULES[-1])  # each is compiled anew
BENCH = TrialRunner(StudyConfig(shifts=(0.0, 1.0), episodes=8))


@pytest.mark.slow
def test_every_removal_is_measured_at_both_shifts(drawn_run):
    """The run's own baseline stands in for agents without experience."""
    config = drawn_run.config
    result = measure_mixture(config, config, "sample", BENCH, QUIET, SOME)
    assert result.episodes >= 8
    assert result.shifts == (0.0, 1.0)
    names = [removal.name for removal in result.removals]
    assert names[:2] == ["TDE", ORACLE_NAME]
    assert names[-len(SOME) :] == [str(way) for way in SOME]
    assert len(set(names)) == len(names)
    by_name = {removal.name: removal for removal in result.removals}
    assert by_name["TDE"].weight == (1.0, 1.0)
    assert by_name[ORACLE_NAME].weight == (0.0, 1.0)
    # Told the shift: nothing is changed where there is none, everything where there is one.
    assert [by_name[ORACLE_NAME].change["sr"][0].mean, by_name[ORACLE_NAME].change["sr"][1].mean] == [
        0.0,
        by_name["TDE"].change["sr"][1].mean,
    ]
    for removal in result.removals:
        assert all(0.0 <= weight <= 1.0 for weight in removal.weight)
        for metric, change in removal.change.items():
            lead, value = result.lead[metric], result.agent[metric]
            assert change[0].mean + value[0].mean >= -1e-9
            assert lead[0].mean == pytest.approx(value[0].mean - result.without[metric][0].mean)
    for way in SOME:
        clock = names[2 : -len(SOME)]
        assert sum(control in clock for control in by_name[str(way)].compared or ()) == 1


@pytest.mark.slow
def test_a_hand_over_leaves_the_agents_without_experience(drawn_run):
    """The run's own baseline stands in for them: told to hand over at once, the agent is worth what they are."""
    config = drawn_run.config
    result = measure_mixture(config, config, "argmax", BENCH, QUIET, (), hand_over=True)
    hard = result.removal("TDE")
    assert result.heir == config.run_dir.name
    for metric, without in result.without.items():
        expected = [
            agent.mean + change.mean for agent, change in zip(result.agent[metric], hard.change[metric], strict=True)
        ]
        assert expected == pytest.approx([interval.mean for interval in without])


def test_runs_that_differ_are_refused(drawn_run):
    config = drawn_run.config
    for name, value in {"seeds": config.seeds + 1, "world": "houses"}.items():
        other = dataclasses.replace(config, **{name: value})
        with pytest.raises(InputError, match=f"differ in {name}; train both alike"):
            measure_mixture(config, other, "sample", BENCH, QUIET)


# The command


MIXTURE = MixtureReport(
    run="streams",
    decoding="sample",
    world="rooms",
    shifts=(0.0, 1.0),
    scenes=6,
    episodes=8,
    length=(4.0, 5.0),
    without=VALUES,
    agent=VALUES,
    lead=VALUES,
    removals=(),
)


def test_the_command_prints_tables_and_writes_json(drawn_run, tmp_path, monkeypatch, capsys):
    asked = {}

    def measured(run, without, decoding, bench, console, *, hand_over):
        asked.update(run=run, without=without, decoding=decoding, study=bench.config, hand_over=hand_over)
        return dataclasses.replace(MIXTURE, heir="anonymous") if hand_over else MIXTURE

    monkeypatch.setattr(command, "measure_mixture", measured)
    monkeypatch.setattr(command, "measure_gap_curves", lambda run, study, console: study_results.course())
    folder, target = str(drawn_run.config.run_dir), tmp_path / "mixture.json"
    options = ["--shift", "0.5", "--decoding", "argmax", "--episodes", "8", "--json", str(target)]
    assert command.mixture_main([folder, folder, *options]) == 0
    assert (asked["decoding"], asked["study"].shifts, asked["study"].episodes) == ("argmax", (0.0, 0.5), 8)
    assert asked["run"].run_dir == asked["without"].run_dir == drawn_run.config.run_dir
    printed = capsys.readouterr().out
    assert "### What experience is worth" in printed
    assert "AUC of the gap" in printed
    report = json.loads(target.read_text())
    assert repr(from_json(MixtureReport, report["mixture"])) == repr(MIXTURE)  # NaN is not equal to itself
    assert report["settings"]["shift"] == "0.5"
    assert not asked["hand_over"]
    assert command.mixture_main([folder, folder, "--hand-over", "--json", str(target)]) == 0
    assert asked["hand_over"]
    assert "### Removal from `streams`, which hands over to `anonymous`, sampled actions" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "mend"),
    [
        (["--shift", "0"], "--shift 0: give a number above 0, at most 1"),
        (["--shift", "1.5"], "--shift 1.5: give a number above 0, at most 1"),
        (["--episodes", "0"], "episodes: 0: give at least 1"),
    ],
)
def test_the_command_refuses_what_is_impossible(drawn_run, options, mend, capsys):
    folder = str(drawn_run.config.run_dir)
    assert command.mixture_main([folder, folder, *options]) == 2
    assert mend in " ".join(capsys.readouterr().err.split())


def test_the_command_needs_finished_runs(tmp_path, capsys):
    assert command.mixture_main([str(tmp_path / "none"), str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
