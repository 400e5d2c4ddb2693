"""An evaluation from Python: its rows, numbers and files."""

import csv
import json

import numpy as np
import pytest

import jaxnav
from jaxnav.errors import InputError
from jaxnav.evaluation.notes import budget_note, evaluation_notes
from jaxnav.evaluation.variants import EvaluationRow

LAYOUT, TDE = EvaluationRow("layout", None, None, "argmax"), EvaluationRow("tde", None, "paper", "argmax")


def test_evaluate_returns_the_rows_of_the_table_and_the_oracle(evaluated):
    rows, epsilon = evaluated.rows, np.linspace(0, 1, 11)
    assert rows[-2:] == [EvaluationRow("random", None, None, "sample"), EvaluationRow("oracle", None, None, "argmax")]
    for decoding, part in (("argmax", rows[:14]), ("sample", rows[14:28])):
        assert [row.variant for row in part] == ["baseline", "layout", "tde", *["stde"] * 11]
        assert [row.epsilon for row in part[3:]] == epsilon.tolist()
        assert {row.form for row in part[3:]} == {"residual"}  # that of the run's layout setting
        assert {row.decoding for row in part} == {decoding}
    assert len(rows) == 30


def test_evaluate_returns_an_outcome_per_row_seed_and_episode(evaluated):
    shape = (30, 2, len(evaluated.episodes.goal))
    assert {leaf.shape for leaf in evaluated.outcome} == {shape}
    metrics = evaluated.metrics()
    assert list(metrics) == ["sr", "spl", "dts", "sae", "timeout", "wrong_done", "sr@20", "sr@50"]
    for name, values in metrics.items():
        assert (values.shape, values.dtype) == (shape, np.float64)
        assert (values >= 0).all()
        assert name == "dts" or (values <= 1).all()
    np.testing.assert_array_equal(metrics["sr"], evaluated.outcome.success)
    assert 0 < metrics["sr"][:-1].mean() < metrics["sr"][-1].mean()  # the oracle's


def test_evaluation_report_equals_the_results(evaluated):
    rows, metrics = evaluated.report["rows"], evaluated.metrics()
    assert [(row["variant"], row["epsilon"], row["form"], row["decoding"]) for row in rows] == [*evaluated.rows]
    for name, scale in (("sr", 100), ("spl", 100), ("dts", 1)):
        means = scale * metrics[name].mean((1, 2))
        assert [row[name]["mean"] for row in rows] == pytest.approx(means, rel=1e-6, abs=1e-9)
    assert evaluated.report["compilations"] == 1


def test_evaluation_reports_a_deviation_over_seeds_of_trained_rows_alone(evaluated):
    for row in evaluated.report["rows"]:
        trained = row["variant"] not in ("random", "oracle")
        for metric in ("sr", "spl", "dts", "sae", "timeout", "wrong_done"):
            assert (len(row[metric].get("seeds", [])), row[metric]["std"] is not None) == (2 * trained, trained)
    for difference in evaluated.report["differences"]:
        # The baseline was trained apart; the others are the layout's networks, run by run.
        assert len(difference.get("seeds", [])) == (0 if difference["from"] == "baseline" else 2)
        assert difference["std"] is not None
    differences = evaluated.report["differences"]
    (tde,) = (row for row in differences if (row["metric"], row["to"], row["decoding"]) == ("sr", "tde", "argmax"))
    rows, success = evaluated.rows, 100 * evaluated.metrics()["sr"].mean(axis=2)
    gain = success[rows.index(TDE)] - success[rows.index(LAYOUT)]
    assert tde["seeds"] == pytest.approx(gain)


def test_evaluation_notes_describe_the_rows_and_the_run(evaluated):
    success = evaluated.metrics()["sr"]
    expected = evaluation_notes(evaluated.rows, success, evaluated.episodes, has_room_prior=True)
    assert evaluated.report["notes"] == [*expected, budget_note(evaluated.report["run"]["budget"])]
    assert any("told the type of the room" in note for note in expected)
    assert expected != evaluation_notes(evaluated.rows, success, evaluated.episodes, has_room_prior=False)


def test_results_are_written_as_json_and_csv(evaluated, tmp_path):
    target = tmp_path / "new" / "table.json"
    evaluated.write(target)
    assert {path.name for path in target.parent.iterdir()} == {"table.json", "table.episodes.csv"}
    assert json.loads(target.read_text()) == json.loads(json.dumps(evaluated.report))
    with target.with_name("table.episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["length"]) for row in rows] == evaluated.outcome.length.ravel().tolist()
    assert [float(row["spl"]) for row in rows] == pytest.approx(evaluated.metrics()["spl"].ravel(), rel=1e-5)
    goals = [evaluated.categories[goal] for goal in evaluated.episodes.goal]
    assert [row["goal"] for row in rows] == goals * (len(rows) // len(goals))
    with pytest.raises(OSError, match=r"table\.json"):
        evaluated.write(target / "table.json")


@pytest.mark.parametrize(("option", "value"), [("world", "cellar"), ("split", "all")])
def test_evaluate_refuses_unknown_worlds_and_splits(drawn_run, option, value):
    with pytest.raises(InputError, match=rf"^--{option} {value}: choose one of "):
        jaxnav.evaluate(drawn_run, **{option: value})
