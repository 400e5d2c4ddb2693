"""Tests of reports: their numbers equal those of `eval` and of the accounting, and their replays the evaluation."""

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
from support.tiny_run import draw_run, tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.report import accounting_table, results_table
from jaxnav.plain_console import PlainConsole
from jaxnav.report.config import ReportConfig
from jaxnav.report.make import make_report, make_sections
from jaxnav.report.measure import measure_shift
from jaxnav.report.replays import ReplayAgent, select_episodes
from jaxnav.runs.evaluate import measure_leads
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import NUM_ACTIONS

QUIET = PlainConsole(quiet=True)
NUM_EPISODES = 24
NUM_REPLAYS = 10
OPTIONS = ReportConfig(
    Path("run"), shift=(1.0,), episodes=NUM_EPISODES, epsilon=(0.0,), threshold=0.2, replays=NUM_REPLAYS
)
#: Rows of the evaluation, with best actions, that belong to the agents of the replays.
AGENT_ROWS = [
    ("baseline", None, None, "argmax"),
    ("layout", None, None, "argmax"),
    ("stde", 0.2, "residual", "argmax"),
    ("baseline", None, None, "argmax"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return draw_run(tiny_config(tmp_path_factory.mktemp("report")))


@pytest.fixture(scope="module")
def measurements(run):
    return measure_shift(run, run, 1.0, OPTIONS, QUIET)


@pytest.fixture(scope="module")
def evaluation(run):
    return jaxnav.evaluate(run, shift=1.0, episodes=NUM_EPISODES, epsilon=(0.0, 0.2))


def unpack_shares(packed, *shape):
    """Numbers from 0 to 1 that were packed as bytes."""
    return np.frombuffer(base64.b64decode(packed), np.uint8).reshape(*shape) / 255


def decimal_numbers(text):
    return re.findall(r"[-+]?\d+\.\d+", text)


def printed_numbers(table):
    """Numbers of a table on the terminal, in order."""
    text = io.StringIO()
    Console(file=text, width=400).print(table)
    return decimal_numbers(text.getvalue())


@pytest.mark.slow
def test_report_tables_show_the_numbers_of_the_evaluation(run, measurements, evaluation):
    results_section, experience_section, *_ = make_sections(run, {1.0: measurements}, 0.2)

    # The folded table has every threshold, and the open tables have only the threshold of the report.
    (threshold_table,) = (table for table in results_section.folded if table.title.endswith("every threshold"))
    assert decimal_numbers(str(threshold_table.rows)) == printed_numbers(results_table(evaluation.report))
    row_names = []
    for table in results_section.tables:
        row_names += [row[0] for row in table.rows]
    assert "+ w + sTDE (eps=0.2)" in row_names
    assert "+ w + sTDE (eps=0)" not in row_names

    # The section on experience leaves out the leads at the threshold 0.
    leads = [lead for lead in measure_leads(evaluation, evaluation) if "eps=0)" not in lead.variant]
    assert decimal_numbers(str(experience_section.tables[0].rows)) == printed_numbers(accounting_table(leads))

    assert results_section.notes == tuple(dict.fromkeys(evaluation.report["notes"]))


@pytest.mark.slow
def test_similarity_chart_shows_the_success_of_the_baseline(measurements, evaluation):
    # Points (scene, goal) partition the episodes that have a similarity, which are all of them here.
    similarity = measurements.similarity
    assert similarity.episodes.sum() == len(evaluation.episodes.goal)
    mean_success = np.average(similarity.success, weights=similarity.episodes)
    assert mean_success == pytest.approx(np.asarray(evaluation.outcome.success)[0].mean())


def evaluated_outcomes(evaluation):
    """Success and length of the first seed of each agent in each episode, [P, E]."""
    success = []
    length = []
    for row in AGENT_ROWS:
        row_index = evaluation.rows.index(row)
        success.append(np.asarray(evaluation.outcome.success)[row_index, 0])
        length.append(np.asarray(evaluation.outcome.length)[row_index, 0])
    return np.stack(success), np.stack(length)


@pytest.mark.slow
def test_replays_compare_the_agents_of_the_evaluation(measurements, evaluation):
    replays = measurements.replays
    assert replays.players == ["ORG (baseline)", "+ w (layout)", "+ w + sTDE (eps=0.2)", "ORG (baseline)"]
    assert replays.comparisons == {"Removal": (1, 2), "Experience": (1, 3), "Layout weights": (1, 0)}
    assert replays.evaluated == NUM_EPISODES

    success, length = evaluated_outcomes(evaluation)
    pair_differs = (success[:, None] != success) | (length[:, None] != length)  # [P, P, E]
    assert pair_differs.any()
    assert replays.differ == pair_differs.sum(axis=-1).tolist()


@pytest.mark.slow
def test_replays_end_as_the_episodes_of_the_evaluation(measurements, evaluation):
    replays = measurements.replays
    success, length = evaluated_outcomes(evaluation)

    # Episodes in which the most pairs differ come first.
    pair_differs = (success[:, None] != success) | (length[:, None] != length)  # [P, P, E]
    order = np.argsort(-pair_differs.sum(axis=(0, 1)), kind="stable")[:NUM_REPLAYS]
    episodes = evaluation.episodes
    for replay, index in zip(replays.episodes, order, strict=True):
        assert [trace.success for trace in replay.courses] == success[:, index].tolist()
        assert [len(trace.actions) for trace in replay.courses] == length[:, index].tolist()
        assert replay.best == episodes.best_length[index]
        assert replays.categories[replay.goal] == evaluation.categories[episodes.goal[index]]
        assert replays.plans[replay.plan].name == episodes.scenes[episodes.scene[index]]


@pytest.mark.slow
def test_replays_take_the_likeliest_of_the_corrected_actions(measurements):
    for replay in measurements.replays.episodes:
        for trace in replay.courses:
            num_steps = len(trace.actions)
            probabilities = unpack_shares(trace.chances, num_steps, 3, NUM_ACTIONS)
            np.testing.assert_allclose(probabilities.sum(axis=-1), 1, atol=NUM_ACTIONS / 510)
            corrected = probabilities[:, 2]
            np.testing.assert_array_equal(corrected[np.arange(num_steps), trace.actions], corrected.max(axis=1))


@pytest.mark.slow
def test_replays_weigh_the_removal_by_the_gap_above_the_threshold(measurements):
    num_categories = len(measurements.replays.categories)
    largest_weight = 0.0
    for replay in measurements.replays.episodes:
        for agent_index, trace in enumerate(replay.courses):
            num_steps = len(trace.actions)
            gap = unpack_shares(trace.gap, num_steps)
            weight = unpack_shares(trace.weight, num_steps)

            # Only the third agent removes experience, by ReLU(D - 0.2); both numbers are rounded to 1 / 255.
            expected_weight = np.maximum(gap - 0.2, 0) if agent_index == 2 else np.zeros(num_steps)
            np.testing.assert_allclose(weight, expected_weight, atol=1 / 255)
            largest_weight = max(largest_weight, weight.max())

            # Only the second and the third agent use layout weights.
            layout_weights = unpack_shares(trace.layout, -1, num_categories)
            assert len(layout_weights) == (num_steps if agent_index in (1, 2) else 0)
    assert largest_weight > 0.1


@pytest.mark.exhaustive
def test_report_of_sixty_replays_is_below_eight_megabytes(run, measurements):
    """Twenty replays take less than a third of eight megabytes."""
    page_text = make_report(run, run, dataclasses.replace(OPTIONS, replays=20), QUIET)
    assert len(page_text.encode()) < 8e6 * 20 / 60

    # One player with all replays.
    (player_data,) = json.loads(page_text.partition('id="data">')[2].partition("</script>")[0])
    assert len(player_data["episodes"]) == 20
    assert player_data["players"] == measurements.replays.players

    # All sections but the learning curves: a drawn run has no log.
    for title in (
        "Results",
        "Value and cost of experience",
        "Thresholds",
        "Layout gap",
        "Success and layout similarity",
    ):
        assert f"<h2>{html.escape(title)}</h2>" in page_text
    assert "<h2>Learning</h2>" not in page_text


def test_select_episodes_puts_the_most_differing_pairs_first():
    def make_agent(success, length):
        unused: Any = None
        return ReplayAgent("layout", "", unused, unused, unused, np.array(success, bool), np.array(length))

    # Pairs that differ, by episode: none; two of three; all three; two of three, but only in success.
    agents = [
        make_agent([1, 1, 1, 1], [4, 4, 4, 4]),
        make_agent([1, 1, 1, 1], [4, 4, 5, 4]),
        make_agent([1, 1, 1, 0], [4, 5, 6, 4]),
    ]
    assert select_episodes(agents, 3).tolist() == [2, 1, 3]
    assert select_episodes(agents, 9).tolist() == [2, 1, 3, 0]


@pytest.fixture
def no_measurement(monkeypatch):
    """Fail a test that measures before it checks the options."""
    monkeypatch.setattr("jaxnav.report.make.measure_shift", lambda *_: pytest.fail("measured"))


@pytest.mark.usefixtures("no_measurement")
@pytest.mark.parametrize(
    ("changes", "problem"),
    [({"shift": ()}, "--shift: give at least one number"), ({"replays": 0}, "--replays 0: give at least 1")],
)
def test_make_report_refuses_invalid_options_before_measuring(run, changes, problem):
    with pytest.raises(InputError, match=problem):
        make_report(run, None, dataclasses.replace(OPTIONS, **changes), QUIET)


@pytest.mark.usefixtures("no_measurement")
def test_make_report_refuses_a_reference_run_without_a_policy(run, tmp_path):
    incomplete_run = draw_run(tiny_config(tmp_path / "run", detector=run.config.detector))
    (incomplete_run.config.run_dir / "policies" / "layout-1" / "policy.json").unlink()
    with pytest.raises(InputError, match="layout-1: not an exported policy"):
        make_report(run, incomplete_run, OPTIONS, QUIET)


@pytest.mark.usefixtures("no_measurement")
def test_make_report_refuses_a_reference_run_with_another_detector(run, tmp_path):
    other_run = draw_run(tiny_config(tmp_path / "run", detector=Detector(seed=1)))
    with pytest.raises(InputError, match=r"--reference: .* task or detector"):
        make_report(run, other_run, OPTIONS, QUIET)
