"""The study command end to end on runs of a few small rooms, and all that it refuses."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from support import study_results as made_up
from support.commands import CONFIG, contents, refusal

from jaxnav import __main__ as commands
from jaxnav.cli import study as command
from jaxnav.runs.directory import load_run
from jaxnav.runs.policies import load_policies
from jaxnav.study.config import CHANGES, StudyConfig, parse_study, training
from jaxnav.study.document import READING
from jaxnav.study.trials import USES
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, layout_priors

SHIFTS = (0.0, 1.0)
STUDY = f"""
trainings: [coin]
shifts: {list(SHIFTS)}
epsilon: [0.0, 0.5, 1.0]
episodes: 24
steps: 6
base:
  direct: goal
  done_gate: true
{"".join(f"  {line}{chr(10)}" for line in CONFIG.strip().splitlines())}
"""

#: Variant, decoding, epsilon and form of what is told of a run of the layout's arm alone.
LAYOUT_ARM = [(variant, "argmax", None, None) for variant in ("layout", "tde")]
LAYOUT_ARM += [("stde", "argmax", *use) for use in USES]


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
    assert study(tmp_path, "--base.seeds", 1) == 0
    names = {f"{run}-shift{shift:g}" for run in ("main", "coin") for shift in SHIFTS} | {"gap-main", "instrument-main"}
    results = tmp_path / "results" / "val"
    assert {path.stem for path in results.iterdir()} == names
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

    keys = ("gap", "variant", "decoding", "epsilon", "form", "control")
    for shift in SHIFTS:
        main, coin = (json.loads((results / f"{run}-shift{shift:g}.json").read_text()) for run in ("main", "coin"))
        rows, others = ({tuple(row[key] for key in keys): row for row in part["rows"]} for part in (main, coin))
        for part, own in ((main, rows), (coin, others)):
            assert (part["shift"], part["episodes"], part["scenes"]) == (shift, 24, 4)
            assert len(own) == len(part["rows"])
        assert main["parameters"] == coin["parameters"] > 1000
        assert {row["gap"] for row in rows.values()} == {"novelty", "evidence", "clock"}
        for gap in ("novelty", "evidence"):
            own, constant = (rows[gap, "stde", "argmax", 0.0, "paper", c] for c in (None, "constant"))
            assert constant["mean_weight"] == pytest.approx(own["mean_weight"], rel=1e-5) != 0
        # Where nothing is taken out, everything is as with the weights.
        still = rows["novelty", "stde", "argmax", 1.0, "residual", None]
        assert still["difference"]["sr"] == {"mean": 0.0, "std": 0.0, "ci95": [0.0, 0.0]}
        assert ("novelty", "baseline", "argmax", None, None, None) in rows
        assert set(others) == {("novelty", *about, None) for about in LAYOUT_ARM}

    # Again: nothing is done anew.
    before = contents(tmp_path)
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
    assert study(tmp_path, "--base.seeds", 1) == 0
    assert contents(tmp_path) == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")} == written


# The command alone, on results made up


@pytest.fixture
def made(monkeypatch):
    """Nothing is trained, evaluated or drawn; the names of what would be, in order."""
    parts = []

    def make(name, result):
        parts.append(name)
        return result

    def table(run, full, shift, bench, console):
        name = run.run_dir.name
        assert full == (name in ("main", "real"))
        return make(f"{name}-shift{shift:g}", made_up.part(shift, "main" if full else name) | {"chosen": 0.5})

    monkeypatch.setattr(command, "ensure", lambda run, console: parts.append(run.run_dir.name))
    monkeypatch.setattr(command, "instrument_report", lambda *_: make("instrument", made_up.instrument()))
    monkeypatch.setattr(command, "table", table)
    monkeypatch.setattr(command, "gaps", lambda *_: make("gap", made_up.course()))
    monkeypatch.setattr(command, "draw", lambda folder, images: parts.append(f"figures of {folder.name}"))
    return parts


ASKED = ["main", "coin"]  # whether they are finished
MAIN, COIN = ["main-shift0", "main-shift1", "instrument", "gap"], ["coin-shift0", "coin-shift1"]
DRAWN = ["figures of val"]


def test_only_what_is_missing_or_of_another_study_is_done(made, tmp_path):
    def again(*options):
        made.clear()
        assert study(tmp_path, *options) == 0
        return made

    assert again() == ASKED + MAIN + COIN + DRAWN
    document = tmp_path / "docs" / "study.md"
    text = document.read_text().replace(f"{READING}\n\n{READING}", f"{READING}\nBy hand.\n{READING}")
    document.write_text(text)
    before = contents(tmp_path)
    assert again() == ASKED + DRAWN
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


def test_test_is_a_section_of_its_own_and_leaves_the_figures(made, tmp_path):
    assert study(tmp_path) == 0
    made.clear()
    assert study(tmp_path, "--split", "test") == 0
    assert made == ASKED + MAIN + COIN
    names = [{path.name for path in (tmp_path / "results" / split).iterdir()} for split in ("val", "test")]
    assert names[0] == names[1]
    assert len(names[0]) == 6
    assert "## Test, touched once" in (tmp_path / "docs" / "study.md").read_text()


# Refusals


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--trainings", "main", "coins"], "trainings: 'coins' is unknown; choose from main, none, coin"),
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


def test_a_document_of_ones_own_is_refused_before_any_training(untrained, tmp_path, capsys):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "study.md").write_text("My own notes.")
    assert study(tmp_path) == 2
    assert "without two lines <!-- reading -->; give another --document" in refusal(capsys)
    assert set(contents(tmp_path)) == {"study.yaml", "docs/study.md"}


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
    config = parse_study(["--config", str(Path(__file__).parents[2] / "configs" / f"{name}.yaml")])
    assert config.shifts == (0.0, 0.5, 1.0)
    assert training(config, "main").worlds.num_val == 80
    assert {0.0, 0.5, 1.0} <= set(config.epsilon)
    assert (config.document == Path("docs/study.md")) == (name == "study")


def test_both_commands_lead_here(capsys, monkeypatch):
    assert commands.main(["study", "--shifts", "1"]) == 2
    assert "give two or more from 0 to 1" in refusal(capsys)
    monkeypatch.setattr("sys.argv", ["eval.py", "study", "--shifts", "1"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(Path(commands.__file__).parents[1] / "eval.py"), run_name="__main__")
    assert "give two or more from 0 to 1" in refusal(capsys)
