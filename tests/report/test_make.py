"""A report's numbers are those of `eval` and `account`, and its replays those of the evaluation."""

import base64
import dataclasses
import html
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from support.drawn_run import draw_run, tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.report import accounting_table, results_table
from jaxnav.report.config import ReportConfig
from jaxnav.report.make import make_report, make_sections
from jaxnav.report.measure import measure_shift
from jaxnav.report.replays import ReplayAgent, select_episodes
from jaxnav.runs.evaluate import measure_leads
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import NUM_ACTIONS

QUIET = Console(quiet=True)
OPTIONS = ReportConfig(Path("run"), shift=(1.0,), episodes=24, epsilon=(0.0,), threshold=0.2, replays=10)
EVALUATION = {"shift": 1.0, "episodes": 24, "epsilon": (0.0, 0.2)}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return draw_run(tiny_config(tmp_path_factory.mktemp("report")))


@pytest.fixture(scope="module")
def measured(run):
    return measure_shift(run, run, 1.0, OPTIONS, QUIET)


@pytest.fixture(scope="module")
def evaluated(run):
    return jaxnav.evaluate(run, **EVALUATION)


def unpack(text, *shape):
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(*shape) / 255


def printed(table):
    """The numbers of a terminal's table, in order."""
    text = io.StringIO()
    Console(file=text, width=400).print(table)
    return re.findall(r"[-+]?\d+\.\d+", text.getvalue())


@pytest.mark.slow
def test_tables_hold_the_numbers_of_eval_and_account(run, measured, evaluated):
    results, experience, *_ = make_sections(run, {1.0: measured}, 0.2)
    (threshold_table,) = (table for table in results.folded if table.title.endswith("every threshold"))
    assert re.findall(r"[-+]?\d+\.\d+", str(threshold_table.rows)) == printed(results_table(evaluated.report))
    short = [row[0] for table in results.tables for row in table.rows]
    assert "+ w + sTDE (eps=0.2)" in short
    assert "+ w + sTDE (eps=0)" not in short
    entries = [e for e in measure_leads(evaluated, evaluated) if "eps=0)" not in e.variant]
    assert re.findall(r"[-+]?\d+\.\d+", str(experience.tables[0].rows)) == printed(accounting_table(entries))
    assert results.notes == tuple(dict.fromkeys(evaluated.report["notes"]))


@pytest.mark.slow
def test_courses_end_as_in_the_evaluation(measured, evaluated):
    rows = {row: i for i, row in enumerate(evaluated.rows)}
    replays = measured.replays
    assert replays.players == ["ORG (baseline)", "+ w (layout)", "+ w + sTDE (eps=0.2)", "ORG (baseline)"]
    arguments = (("baseline", None, None), ("layout", None, None), ("stde", 0.2, "residual"), ("baseline", None, None))
    success, length = (
        np.stack([np.asarray(leaf)[rows[(*key, "argmax")], 0] for key in arguments])
        for leaf in (evaluated.outcome.success, evaluated.outcome.length)
    )
    differ = (success[:, None] != success) | (length[:, None] != length)  # [P, P, E]
    assert replays.differ == differ.sum(axis=-1).tolist()
    assert replays.evaluated == 24
    assert replays.comparisons == {"Removal": (1, 2), "Experience": (1, 3), "Layout weights": (1, 0)}
    order = np.argsort(-differ.sum(axis=(0, 1)), kind="stable")[:10]
    assert differ.any()
    for episode, index in zip(replays.episodes, order, strict=True):
        assert [course.success for course in episode.courses] == success[:, index].tolist()
        assert [len(course.actions) for course in episode.courses] == length[:, index].tolist()
        assert episode.best == evaluated.episodes.best_length[index]
        assert replays.categories[episode.goal] == evaluated.categories[evaluated.episodes.goal[index]]
        assert replays.plans[episode.plan].name == evaluated.episodes.scenes[evaluated.episodes.scene[index]]


@pytest.mark.slow
def test_courses_say_why_an_action_was_taken(measured):
    categories, weights = len(measured.replays.categories), []
    for episode in measured.replays.episodes:
        for number, course in enumerate(episode.courses):
            steps = len(course.actions)
            chances = unpack(course.chances, steps, 3, NUM_ACTIONS)
            np.testing.assert_allclose(chances.sum(axis=-1), 1, atol=NUM_ACTIONS / 510)
            action_chances = np.take_along_axis(chances[:, 2], np.array(course.actions)[:, None], axis=1)[:, 0]
            np.testing.assert_array_equal(action_chances, chances[:, 2].max(axis=1))  # the best of the corrected
            gap, weight = unpack(course.gap, steps), unpack(course.weight, steps)
            removes = number == 2
            # ReLU(D - 0.2), of two numbers that are rounded to 1 / 255.
            np.testing.assert_allclose(weight, np.maximum(gap - 0.2, 0) if removes else 0 * gap, atol=1 / 255)
            layout = unpack(course.layout, -1, categories)
            assert len(layout) == (steps if number in (1, 2) else 0)
            weights += weight.tolist()
    assert max(weights) > 0.1


@pytest.mark.slow
def test_a_page_of_sixty_episodes_is_small(run, measured):
    """Twenty take less than a third of eight megabytes."""
    text = make_report(run, run, dataclasses.replace(OPTIONS, replays=20), QUIET)
    assert len(text.encode()) < 8e6 * 20 / 60
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert [len(part["episodes"]) for part in data] == [20]
    assert data[0]["players"] == measured.replays.players
    for title in ("Results", "What experience is worth", "Thresholds", "The gap", "Success and similarity"):
        assert f"<h2>{html.escape(title)}</h2>" in text
    assert "<h2>Learning</h2>" not in text  # the run was drawn: it has no log


def test_the_most_disputed_episodes_come_first():
    def agent(success, length):
        nothing: Any = None
        return ReplayAgent("layout", "", nothing, nothing, nothing, np.array(success, bool), np.array(length))

    # Pairs that differ, by episode: none; two of three; all three; two of three, in success alone.
    agents = [
        agent([1, 1, 1, 1], [4, 4, 4, 4]),
        agent([1, 1, 1, 1], [4, 4, 5, 4]),
        agent([1, 1, 1, 0], [4, 5, 6, 4]),
    ]
    assert select_episodes(agents, 3).tolist() == [2, 1, 3]
    assert select_episodes(agents, 9).tolist() == [2, 1, 3, 0]


def test_what_is_refused_is_refused_before_anything_is_run(run, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxnav.report.make.measure_shift", lambda *_: pytest.fail("measured"))
    other, unlike = (
        draw_run(tiny_config(folder, detector=detector))
        for folder, detector in ((tmp_path / "a", run.config.detector), (tmp_path / "b", Detector(seed=1)))
    )
    (other.config.run_dir / "policies" / "layout-1" / "policy.json").unlink()
    for reference_run, changes, problem in (
        (None, {"shift": ()}, "--shift: give at least one number"),
        (None, {"replays": 0}, "--replays 0: give at least 1"),
        (other, {}, "layout-1: not an exported policy"),
        (unlike, {}, "--beside: has another task or detector than the run"),
    ):
        with pytest.raises(InputError, match=problem):
            make_report(run, reference_run, dataclasses.replace(OPTIONS, **changes), QUIET)
