"""The study command end to end on runs of a few small rooms, and all that it refuses."""

import json
import runpy
from pathlib import Path

import made_up
import numpy as np
import pytest
from commands import CONFIG, contents, refusal

from jaxnav import __main__ as commands
from jaxnav.cli import study as command
from jaxnav.cli.runs import load_policies, load_run
from jaxnav.cli.trainings import CHANGES, StudyConfig, parse_study, training
from jaxnav.evaluation.study import READING
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, layout_priors

SHIFTS = (0.0, 1.0)
STUDY = f"""
trainings: [coin]
shifts: {list(SHIFTS)}
epsilon: [0.0, 0.5, 1.0]
episodes: 100
steps: 6
base:
  direct: goal
  done_gate: true
{"".join(f"  {line}{chr(10)}" for line in CONFIG.strip().splitlines())}
"""


def study(folder, *options):
    """Run the command with all its files below a folder."""
    config = folder / "study.yaml"
    config.write_text(STUDY)
    places = {"results": "results", "document": "docs/study.md", "runs": "runs"}
    own = [part for name, place in places.items() for part in (f"--{name}", str(folder / place))]
    return command.main(["--config", str(config), *own, *map(str, options)])


@pytest.fixture
def untrained(monkeypatch):
    """Fails a study that gets as far as training."""

    def ensure(run, console):
        pytest.fail(f"{run.run_dir} is trained before the request is refused")

    monkeypatch.setattr(command, "ensure", ensure)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_study_from_training_to_document(tmp_path):
    assert study(tmp_path) == 0
    names = {f"main-shift{shift:g}" for shift in SHIFTS} | {"gap-main", "instrument-main"}
    results = tmp_path / "results"
    assert {path.stem for path in (results / "val").iterdir()} == names
    # The runs are what they are called, and their policies carry it.
    runs = [load_run(tmp_path / "runs" / name) for name in ("main", "coin")]
    assert [run.counterfactual for run in runs] == ["distil", "coin"]
    for run in runs:
        policies = load_policies(run, run.arms)
        assert (policies.spec.direct, policies.spec.done_gate) == ("goal", True)
        # The priors are those of the exported counts, and the setting is the calibrated one.
        np.testing.assert_allclose(policies.priors, layout_priors(policies.counts, policies.setting), rtol=1e-6)
        assert policies.setting.strength in STRENGTHS
        assert policies.setting.reduction in REDUCTIONS

    parts = [json.loads((results / "val" / f"main-shift{shift:g}.json").read_text()) for shift in SHIFTS]
    for part, shift in zip(parts, SHIFTS, strict=True):
        assert (part["shift"], part["episodes"], part["scenes"]) == (shift, 100, 4)
        rows = part["rows"]
        assert {row["training"] for row in rows} == {"main", "coin"}
        assert {row["gap"] for row in rows} == {"novelty", "evidence", "clock"}
        keys = ("training", "gap", "variant", "decoding", "epsilon", "form", "control")
        assert len({tuple(row[key] for key in keys) for row in rows}) == len(rows)
        by_key = {tuple(row[key] for key in keys): row for row in rows}
        for gap in ("novelty", "evidence"):
            own, constant = (by_key["main", gap, "stde", "argmax", 0.0, "paper", c] for c in (None, "constant"))
            assert constant["mean_weight"] == pytest.approx(own["mean_weight"], rel=1e-5) != 0
        still = by_key["main", "novelty", "stde", "argmax", 1.0, "residual", None]
        assert still["difference"]["sr"] == {"mean": 0.0, "std": 0.0, "ci95": [0.0, 0.0]}
        assert ("coin", "novelty", "baseline", "argmax", None, None, None) not in by_key
        assert ("main", "novelty", "baseline", "argmax", None, None, None) in by_key

    # Again: nothing is done anew.
    before = contents(tmp_path)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    assert study(tmp_path) == 0
    assert contents(tmp_path) == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")} == written


# The command alone, on results made up


@pytest.fixture
def made(monkeypatch):
    """Nothing is trained or evaluated; the names of the parts that would be, in order."""
    parts = []

    def make(name, result):
        def made(*arguments):
            parts.append(name)
            return result(*arguments)

        return made

    monkeypatch.setattr(command, "ensure", lambda run, console: parts.append(run.run_dir.name))
    monkeypatch.setattr(command, "instrument_report", make("instrument", lambda *_: made_up.instrument()))
    monkeypatch.setattr(command, "table", make("table", lambda condition, *_: made_up.part(condition.shift)))
    monkeypatch.setattr(command, "gaps", make("gap", lambda *_: made_up.course()))
    return parts


def test_only_what_is_missing_or_of_another_study_is_done(made, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "draw", lambda folder, images: None)
    assert study(tmp_path) == 0
    assert made == ["main", "coin", "instrument", "table", "table", "gap"]
    document = tmp_path / "docs" / "study.md"
    text = document.read_text().replace(f"{READING}\n\n{READING}", f"{READING}\nBy hand.\n{READING}")
    document.write_text(text)
    before = contents(tmp_path)
    made.clear()
    assert study(tmp_path) == 0
    assert made == ["main", "coin"]  # asked whether they are finished
    assert contents(tmp_path) == before
    assert "By hand." in document.read_text()
    # A part that is missing, and one that is damaged.
    (tmp_path / "results" / "val" / "main-shift1.json").unlink()
    (tmp_path / "results" / "val" / "gap-main.json").write_text("{")
    made.clear()
    assert study(tmp_path) == 0
    assert made == ["main", "coin", "table", "gap"]
    assert contents(tmp_path) == before
    made.clear()
    assert study(tmp_path, "--episodes", 30) == 0
    assert made == ["main", "coin", "instrument", "table", "table", "gap"]


def test_test_is_a_section_of_its_own(made, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "draw", lambda folder, images: None)
    assert study(tmp_path) == study(tmp_path, "--split", "test") == 0
    names = [{path.name for path in (tmp_path / "results" / split).iterdir()} for split in ("val", "test")]
    assert names[0] == names[1]
    assert len(names[0]) == 4
    assert "## Test, touched once" in (tmp_path / "docs" / "study.md").read_text()


def test_the_figures_remain_those_of_val(made, tmp_path, monkeypatch):
    drawn = set()
    monkeypatch.setattr(command, "draw", lambda folder, images: drawn.add(folder))
    assert study(tmp_path) == study(tmp_path, "--split", "test") == 0
    assert drawn == {tmp_path / "results" / "val"}


# Refusals


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--trainings", "main", "coins"], "trainings: 'coins' is unknown; choose from main, none, coin"),
        (["--shifts", "0.5"], "give at least two different ones"),
        (["--shifts", "1", "1"], "give at least two different ones"),
        (["--base.seeds", "0"], "config: seeds is 0; give at least 1"),
        (["--base.ppo.rollout", "99"], "config: ppo.rollout is 99"),
    ],
)
def test_bad_requests_are_refused_before_any_training(untrained, tmp_path, capsys, options, problem):
    assert study(tmp_path, *options) == 2
    assert problem in refusal(capsys)
    assert set(contents(tmp_path)) == {"study.yaml"}


@pytest.mark.xfail(strict=True, reason="noticed only after training")
@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--split", "test"], "run the study with --split val first, epsilon is chosen there"),
        (["--shifts", "0", "2"], "from 0 to 1"),
        (["--shifts", "1", "0"], "rising"),
        (["--epsilon", "-1"], "give numbers from 0"),
        (["--episodes", "0"], "give at least 1"),
        (["--real", "missing.jsonl"], "missing.jsonl"),
    ],
)
def test_these_too(untrained, tmp_path, capsys, options, problem):
    assert study(tmp_path, *options) == 2
    assert problem in refusal(capsys)
    assert set(contents(tmp_path)) == {"study.yaml"}


def test_every_training_changes_what_it_is_called_after():
    config = StudyConfig(runs=Path("somewhere"))
    main = training(config, "main")
    assert main.run_dir == Path("somewhere/main")
    for name in CHANGES:
        run = training(config, name)
        assert run.run_dir == Path("somewhere") / name
        assert (run == main) == (name == "main")
        assert (run.seeds, run.total_steps, run.worlds.num_val) == (5, 2_000_000, 80)
    assert training(config, "coin").arms == ("layout",)
    assert training(config, "released").layout.setting == "released"
    assert training(config, "shaping").worlds.shaping == 1.0
    assert training(config, "shaping").worlds.num_test == 80
    assert training(StudyConfig(real=Path("file.jsonl")), "real").scenes == Path("file.jsonl")


@pytest.mark.parametrize("name", ["study", "study_quick"])
def test_the_configs_that_come_with_it(name):
    config = parse_study(["--config", str(Path(__file__).parents[1] / "configs" / f"{name}.yaml")])
    assert config.shifts == (0.0, 0.5, 1.0)
    assert training(config, "main").worlds.num_val == 80
    assert {0.0, 0.5, 1.0} <= set(config.epsilon)
    assert (config.document == Path("docs/study.md")) == (name == "study")


def test_both_commands_lead_here(capsys, monkeypatch):
    assert commands.main(["study", "--shifts", "1"]) == 2
    assert "give at least two different ones" in refusal(capsys)
    monkeypatch.setattr("sys.argv", ["eval.py", "study", "--shifts", "1"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(Path(commands.__file__).parents[1] / "eval.py"), run_name="__main__")
    assert "give at least two different ones" in refusal(capsys)
