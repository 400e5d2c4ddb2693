"""The study command end to end, and what it refuses."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from support import study_results
from support.commands import SHIFTS, contents, refusal, study_command

from jaxnav import __main__ as commands
from jaxnav.cli import study as command
from jaxnav.runs.policies import load_policies
from jaxnav.runs.run import load_run_config
from jaxnav.study import figures
from jaxnav.study import run as study_run
from jaxnav.study.config import study_run_config
from jaxnav.study.document import READING_MARK
from jaxnav.study.records import STDE_OPTIONS
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, layout_priors

#: Variant, decoding, epsilon and form of the rows of a run of the layout arm alone.
LAYOUT_ARM = [(variant, "argmax", None, None) for variant in ("layout", "tde")]
LAYOUT_ARM += [("stde", "argmax", *use) for use in STDE_OPTIONS.values()]


def study(folder, *options):
    """Run the command with all its files below a folder."""
    return command.main([*map(str, study_command(folder)), *map(str, options)])


@pytest.fixture
def untrained(monkeypatch):
    """Fail a study that gets as far as training."""

    def ensure_trained(run, console):
        pytest.fail(f"{run.run_dir} is trained before the request is refused")

    monkeypatch.setattr(study_run, "ensure_trained", ensure_trained)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_study_from_training_to_document(tmp_path):
    assert study(tmp_path, "--base.seeds", 1) == 0
    names = {f"{run}-shift{shift:g}" for run in ("main", "coin") for shift in SHIFTS} | {"gap-main", "instrument-main"}
    results = tmp_path / "results" / "val"
    assert {path.stem for path in results.iterdir()} == names
    # The runs are what they are called, and their policies carry it.
    runs = [load_run_config(tmp_path / "runs" / name) for name in ("main", "coin")]
    assert [run.counterfactual for run in runs] == ["distil", "coin"]
    for run in runs:
        policies = load_policies(run, run.arms)
        assert (policies.spec.direct, policies.spec.done_gate) == ("goal", True)
        # The priors are those of the exported counts, and the setting is the calibrated one.
        setting = policies.estimator_config
        assert setting is not None
        np.testing.assert_allclose(policies.knowledge.layout, layout_priors(policies.prior_counts, setting), rtol=1e-6)
        assert setting.strength in STRENGTHS
        assert setting.reduction in REDUCTIONS

    keys = ("gap", "variant", "decoding", "epsilon", "form", "control")
    for shift in SHIFTS:
        main, coin = (json.loads((results / f"{run}-shift{shift:g}.json").read_text()) for run in ("main", "coin"))
        rows, others = ({tuple(row[key] for key in keys): row for row in part["rows"]} for part in (main, coin))
        for part, by_key in ((main, rows), (coin, others)):
            assert (part["shift"], part["episodes"], part["scenes"]) == (shift, 24, 4)
            assert len(by_key) == len(part["rows"])
        assert main["parameters"] == coin["parameters"] > 1000
        assert {row["gap"] for row in rows.values()} == {"novelty", "evidence", "clock"}
        for gap in ("novelty", "evidence"):
            plain, constant = (rows[gap, "stde", "argmax", 0.0, "paper", c] for c in (None, "constant"))
            assert constant["mean_weight"] == pytest.approx(plain["mean_weight"], rel=1e-5) != 0
        # Where nothing is taken out, everything is as with the weights.
        still = rows["novelty", "stde", "argmax", 1.0, "residual", None]
        assert still["difference"]["sr"] == {"mean": 0.0, "std": None, "ci95": None, "seeds": [0.0]}  # of one run
        # Effects of sTDE in each scene, of which the mean is that of all.
        effects, stde = main["effects"], rows["novelty", "stde", "argmax", 0.5, "residual", None]
        assert (len(effects["scenes"]), sum(effects["episodes"])) == (4, 24)
        assert np.sum(effects["gain"]) / 24 == pytest.approx(stde["difference"]["sr"]["mean"], abs=1e-4)
        assert ("novelty", "baseline", "argmax", None, None, None) in rows
        assert set(others) == {("novelty", *about, None) for about in LAYOUT_ARM}

    # Again: nothing is done anew.
    before = contents(tmp_path)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    assert study(tmp_path, "--base.seeds", 1) == 0
    assert contents(tmp_path) == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")} == written


# The command alone, on given results


@pytest.fixture
def steps(monkeypatch):
    """Replace all work; return the names of its steps."""
    names = []

    def measured(name, record):
        names.append(name)
        return record

    def measure_condition(run, full, shift, bench, console):
        name = run.run_dir.name
        assert full == (name in ("main", "real"))
        condition = (
            study_results.full_condition(shift, chosen_epsilon=0.5) if full else study_results.condition(shift, name)
        )
        return measured(f"{name}-shift{shift:g}", condition)

    monkeypatch.setattr(study_run, "ensure_trained", lambda run, console: names.append(run.run_dir.name))
    monkeypatch.setattr(study_run, "measure_instrument", lambda *_: measured("instrument", study_results.instrument()))
    monkeypatch.setattr(study_run, "measure_condition", measure_condition)
    monkeypatch.setattr(study_run, "measure_gap_curves", lambda *_: measured("gap", study_results.course()))
    monkeypatch.setattr(figures, "draw_study_figures", lambda folder, images: names.append(f"figures of {folder.name}"))
    return names


ASKED = ["main", "coin"]  # whether they are finished
MAIN, COIN = ["main-shift0", "main-shift1", "instrument", "gap"], ["coin-shift0", "coin-shift1"]
DRAWN = ["figures of val"]


def test_only_what_is_missing_or_of_another_study_is_done(steps, tmp_path, capsys):
    def again(*options):
        steps.clear()
        assert study(tmp_path, *options) == 0
        return steps

    assert again() == ASKED + MAIN + COIN + DRAWN
    document = tmp_path / "docs" / "study.md"
    text = document.read_text().replace(
        f"{READING_MARK}\n\n{READING_MARK}", f"{READING_MARK}\nBy hand.\n{READING_MARK}"
    )
    document.write_text(text)
    before = contents(tmp_path)
    assert "were there already" not in capsys.readouterr().err
    assert again() == ASKED + DRAWN
    assert "6 results in" in (output := " ".join(capsys.readouterr().err.split()))
    assert "were there already; measure them anew with another --results" in output
    assert contents(tmp_path) == before
    assert "By hand." in document.read_text()
    # A part that is missing, and one that is damaged.
    (tmp_path / "results" / "val" / "main-shift1.json").unlink()
    (tmp_path / "results" / "val" / "gap-main.json").write_text("{")
    assert again() == [*ASKED, "main-shift1", "gap", *DRAWN]
    assert contents(tmp_path) == before
    # A run more leaves what is there; other episodes do not.
    assert again("--trainings", "coin", "gate") == [*ASKED, "gate", "gate-shift0", "gate-shift1", *DRAWN]
    assert again("--episodes", 30) == ASKED + MAIN + COIN + DRAWN


def test_test_is_a_separate_section_and_leaves_the_figures(steps, tmp_path):
    assert study(tmp_path) == 0
    steps.clear()
    assert study(tmp_path, "--split", "test") == 0
    assert steps == ASKED + MAIN + COIN
    names = [{path.name for path in (tmp_path / "results" / split).iterdir()} for split in ("val", "test")]
    assert names[0] == names[1]
    assert len(names[0]) == 6
    assert "## Test, touched once" in (tmp_path / "docs" / "study.md").read_text()


# Refusals


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (
            ["--trainings", "main", "coins"],
            "trainings: 'coins' is unknown; choose from main, anonymous, streams, none, coin",
        ),
        (["--shifts", "0.5"], "shifts: (0.5,): give two or more from 0 to 1, rising"),
        (["--shifts", "0.5", "0.5"], "rising"),
        (["--shifts", "1", "0"], "rising"),
        (["--shifts", "0", "2"], "from 0 to 1"),
        (["--epsilon", "-1"], "epsilon: (-1.0,): give numbers from 0"),
        (["--epsilon", "inf"], "below infinity"),
        (["--episodes", "0"], "episodes: 0: give at least 1"),
        (["--steps", "0"], "steps: 0: give at least 1"),
        (["--real", "missing.jsonl"], "real: missing.jsonl: there is no such file"),
        (["--split", "test"], "run the study with --split val first, epsilon is chosen there"),
        (["--base.seeds", "0"], "config: seeds is 0; give at least 1"),
        (["--base.ppo.rollout", "99"], "config: ppo.rollout is 99"),
        (["--trainings", "paper", "--base.layout.strength", "7"], "only `calibrated` takes a strength and a reduction"),
    ],
)
def test_bad_requests_are_refused_before_any_training(untrained, tmp_path, capsys, options, problem):
    assert study(tmp_path, *options) == 2
    assert problem in refusal(capsys)
    assert set(contents(tmp_path)) == {"study.yaml"}


def test_another_document_is_refused_before_any_training(untrained, tmp_path, capsys):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "study.md").write_text("My own notes.")
    assert study(tmp_path) == 2
    assert "without two lines <!-- reading -->; give another --document" in refusal(capsys)
    assert set(contents(tmp_path)) == {"study.yaml", "docs/study.md"}


@pytest.mark.parametrize(("name", "scenes"), [("study", 40), ("study_quick", 80)])
def test_the_configs_that_come_with_it(name, scenes):
    config = command.parse_study(["--config", name])
    assert config.shifts == (0.0, 0.5, 1.0)
    assert study_run_config(config, "main").worlds.num_val == scenes
    assert {0.0, 0.5, 1.0} <= set(config.epsilon)
    assert (config.document == Path("docs/study.md")) == (name == "study")


def test_both_commands_lead_here(capsys, monkeypatch):
    assert commands.main(["study", "--shifts", "1"]) == 2
    assert "give two or more from 0 to 1" in refusal(capsys)
    monkeypatch.setattr("sys.argv", ["eval.py", "study", "--shifts", "1"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(Path(commands.__file__).parents[1] / "eval.py"), run_name="__main__")
    assert "give two or more from 0 to 1" in refusal(capsys)
