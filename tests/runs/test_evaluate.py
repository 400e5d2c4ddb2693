"""An evaluation from Python: its rows, numbers and files."""

import csv
import io
import json

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import jaxnav
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.errors import InputError
from jaxnav.evaluation.notes import budget_note, decision_share_notes, evaluation_notes
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.training.calibration import layout_priors

LAYOUT = EvaluationRow("layout", None, None, "argmax")
TDE = EvaluationRow("tde", None, "paper", "argmax")


def test_evaluate_returns_the_rows_of_the_table_and_the_oracle(evaluated):
    rows = evaluated.rows
    epsilon_grid = np.linspace(0, 1, 11)
    assert rows[-2:] == [EvaluationRow("random", None, None, "sample"), EvaluationRow("oracle", None, None, "argmax")]
    for decoding, decoding_rows in (("argmax", rows[:14]), ("sample", rows[14:28])):
        assert [row.variant for row in decoding_rows] == ["baseline", "layout", "tde", *["stde"] * 11]
        assert [row.epsilon for row in decoding_rows[3:]] == epsilon_grid.tolist()
        assert {row.form for row in decoding_rows[3:]} == {"residual"}  # that of the run's layout setting
        assert {row.decoding for row in decoding_rows} == {decoding}
    assert len(rows) == 30


def test_evaluate_returns_an_outcome_per_row_seed_and_episode(evaluated):
    shape = (30, 2, len(evaluated.episodes.goal))
    assert {leaf.shape for leaf in evaluated.outcome} == {shape}
    metrics = evaluated.metrics()
    assert list(metrics) == ["sr", "spl", "dts", "sae", "timeout", "wrong_done", "sr@20", "sr@50"]
    for name, metric_values in metrics.items():
        assert (metric_values.shape, metric_values.dtype) == (shape, np.float64)
        assert (metric_values >= 0).all()
        assert name == "dts" or (metric_values <= 1).all()
    np.testing.assert_array_equal(metrics["sr"], evaluated.outcome.success)
    assert 0 < metrics["sr"][:-1].mean() < metrics["sr"][-1].mean()  # the oracle's


def test_evaluation_report_equals_the_results(evaluated):
    rows = evaluated.report["rows"]
    metrics = evaluated.metrics()
    assert [(row["variant"], row["epsilon"], row["form"], row["decoding"]) for row in rows] == [*evaluated.rows]
    for name, scale in (("sr", 100), ("spl", 100), ("dts", 1)):
        means = scale * metrics[name].mean((1, 2))
        assert [row[name]["mean"] for row in rows] == pytest.approx(means, rel=1e-6, abs=1e-9)
    assert evaluated.report["compilations"] == 1


@pytest.mark.exhaustive
def test_evaluation_names_its_phases_on_a_terminal_alone(drawn_run):
    printed_texts = []
    for is_terminal in (True, False):
        output = io.StringIO()
        console = Console(file=output, force_terminal=is_terminal, width=80)
        jaxnav.evaluate(drawn_run, shift=1.0, episodes=4, console=console)
        printed_texts.append(output.getvalue())
    on_terminal, in_pipe = printed_texts
    assert on_terminal.index("compiling") < on_terminal.index("poses") < on_terminal.index("evaluating")
    assert "shift 1" in on_terminal
    assert in_pipe.count("\n") == 1
    assert "poses" in in_pipe


def test_evaluation_reports_a_deviation_over_seeds_of_trained_rows_alone(evaluated):
    for row in evaluated.report["rows"]:
        is_trained = row["variant"] not in ("random", "oracle")
        for metric in ("sr", "spl", "dts", "sae", "timeout", "wrong_done"):
            assert (len(row[metric].get("seeds", [])), row[metric]["std"] is not None) == (2 * is_trained, is_trained)
    for difference in evaluated.report["differences"]:
        # The baseline was trained apart; the others are the layout's networks, run by run.
        assert len(difference.get("seeds", [])) == (0 if difference["from"] == "baseline" else 2)
        assert difference["std"] is not None
    differences = evaluated.report["differences"]
    (tde_difference,) = (
        row for row in differences if (row["metric"], row["to"], row["decoding"]) == ("sr", "tde", "argmax")
    )
    rows = evaluated.rows
    success_rates = 100 * evaluated.metrics()["sr"].mean(axis=2)
    success_gain = success_rates[rows.index(TDE)] - success_rates[rows.index(LAYOUT)]
    assert tde_difference["seeds"] == pytest.approx(success_gain)


def test_every_policy_row_has_decision_shares(evaluated):
    entries = evaluated.report["decision_shares"]
    parts = {"baseline": 4, "layout": 6}
    assert len(entries) == sum(parts.values())
    for entry in entries:
        assert entry["decoding"] == "argmax"
        assert min(entry["weighted_decisions"]) > 0
        assert 0.0 <= entry["share"]["mean"] <= 100.0
        assert len(entry["share"]["seeds"]) == 2
        # Weights have no partner, and so no difference between partners; by default only one cost is measured.
        assert (entry["partner_difference"] is None) == entry["part"].endswith("_weights")
        assert (entry["cost"] is None) == (entry["part"] != "other_categories")
    for variant, num_parts in parts.items():
        assert sum(entry["variant"] == variant for entry in entries) == num_parts


def test_evaluation_notes_describe_the_rows_and_the_run(evaluated):
    success_rates = evaluated.metrics()["sr"]
    expected_notes = evaluation_notes(evaluated.rows, success_rates, evaluated.episodes, has_room_prior=True)
    share_notes = decision_share_notes(evaluated.report["decision_shares"])
    budget = budget_note(evaluated.report["run"]["budget"])
    assert evaluated.report["notes"] == [*expected_notes, *share_notes, budget]
    assert any("receive the room type" in note for note in expected_notes)
    assert expected_notes != evaluation_notes(evaluated.rows, success_rates, evaluated.episodes, has_room_prior=False)


def test_homes_have_one_prior_for_all_room_types(drawn_run):
    """Homes belong to none of the room types, so every type has the prior of all training homes."""
    policies = drawn_run.policies()
    room_counts = jnp.arange(policies.prior_counts.size, dtype=jnp.float32).reshape(policies.prior_counts.shape)
    home_counts = jnp.zeros_like(room_counts).at[OTHER_ROOM].set(room_counts[OTHER_ROOM])
    for counts, is_different in ((room_counts, True), (home_counts, False)):
        knowledge = policies.knowledge._replace(priors=layout_priors(counts, policies.estimator_config))
        assert policies._replace(knowledge=knowledge).has_room_priors == is_different


def test_results_are_written_as_json_and_csv(evaluated, tmp_path):
    report_file = tmp_path / "new" / "table.json"
    evaluated.write(report_file)
    assert {path.name for path in report_file.parent.iterdir()} == {"table.json", "table.episodes.csv"}
    assert json.loads(report_file.read_text()) == json.loads(json.dumps(evaluated.report))
    with report_file.with_name("table.episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["length"]) for row in rows] == evaluated.outcome.length.ravel().tolist()
    assert [float(row["spl"]) for row in rows] == pytest.approx(evaluated.metrics()["spl"].ravel(), rel=1e-5)
    goals = [evaluated.categories[goal] for goal in evaluated.episodes.goal]
    assert [row["goal"] for row in rows] == goals * (len(rows) // len(goals))
    with pytest.raises(OSError, match=r"table\.json"):
        evaluated.write(report_file / "table.json")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("world", "cellar"),
        ("split", "all"),
        ("shift_by", "colour"),
        ("form", "plain"),
        ("removal", "ted"),
        ("setting", "learnt"),
        ("costs", "category"),
        ("counterfactual_memory", "none"),
    ],
)
def test_evaluate_refuses_names_that_it_does_not_accept(drawn_run, option, value):
    # A misspelt word would otherwise select a default, or fail after the scenes are compiled.
    with pytest.raises(InputError, match=rf"^--{option.replace('_', '-')} '{value}': choose one of "):
        jaxnav.evaluate(drawn_run, **{option: value})
