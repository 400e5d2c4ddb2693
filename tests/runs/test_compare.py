"""The results of a comparison beside those of an evaluation."""

import json

import pytest

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.compare import scores_by_scene
from jaxnav.study.records import METRIC_SCALE, RunScores, TrainingSummary, from_json, to_json

TRAINING = TrainingSummary({"exploration": 1280, "imitation": 0, "learning": 512}, 60.0, None, ("A note.",))


@pytest.fixture(scope="module")
def measured(evaluated):
    """The evaluation's results by scene, written and read again."""
    return from_json(RunScores, json.loads(json.dumps(to_json(scores_by_scene(evaluated, TRAINING)))))


def same(one, report):
    """Return whether an interval is that of a report; its runs are told apart in reports alone."""
    other = Interval.from_json(report)
    bounds = [(interval.mean, interval.low, interval.high, interval.std) for interval in (one, other)]
    return bounds[0] == pytest.approx(bounds[1], rel=1e-9, abs=1e-9, nan_ok=True)


def test_sums_by_scene_tell_what_the_episodes_tell(evaluated, measured):
    """Means and intervals are those of `jaxnav eval`."""
    assert sum(measured.episodes) == 24
    rows = evaluated.report["rows"]
    assert len(rows) == len(measured.lines) == 30
    for row, line in zip(rows, measured.lines, strict=True):
        assert (line.variant, line.decoding) == (row["variant"], row["decoding"])
        assert all(same(measured.metric_interval(line, metric), row[metric]) for metric in METRIC_SCALE)
        # Bit-identical, because the mean is rounded for the document.
        assert measured.metric_interval(line, "sr").mean == row["sr"]["mean"]


def test_differences_are_those_of_the_evaluation(evaluated, measured):
    """Of the layout, which are other networks, and of what is removed from it, which are the same."""
    lines = {
        (row.variant, row.epsilon, row.form, row.decoding): measured.lines[i] for i, row in enumerate(evaluated.rows)
    }
    for entry in evaluated.report["differences"]:
        line = lines[entry["to"], entry["epsilon"], entry["form"], entry["decoding"]]
        reference = lines[entry["from"], None, None, entry["decoding"]]
        assert same(measured.metric_difference(line, measured, reference, entry["metric"]), entry)


def test_agents_are_found_by_name(measured):
    assert measured.find_agent("layout", "sample").decoding == "sample"
    assert measured.find_agent("random", "argmax") is measured.find_agent("random", "sample")  # it has no best action
    assert measured.find_agent("frontier", "argmax") is None
    assert measured.training == TRAINING
