"""The instrument command end to end, and what it refuses."""

import json
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t
from support.commands import contents, evaluate, finished_run, refusal
from support.records import resigned

from jaxnav import __main__ as commands
from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.baselines.frontier import run_frontier_search
from jaxnav.cli.study import instrument_main
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import ROOMS
from jaxnav.scenes.worlds import make_generated_scenes, shift_scenes
from jaxnav.study.records import MEASURES


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    run = tmp_path_factory.mktemp("instrument") / "run"
    shutil.copytree(finished_run(tmp_path_factory)[1], run)
    return run


def instrument(*options):
    return instrument_main([*map(str, options)])


@pytest.mark.slow
def test_the_report_holds_what_is_measured_at_every_shift(run_dir, capsys):
    assert instrument(run_dir, "--shift", 1, 0, "--episodes", 12, "--without", run_dir) == 0
    printed = capsys.readouterr().out
    report = json.loads((run_dir / "instrument-val.json").read_text())
    assert list(report) == [
        *("run", "shifts", "matched", "categories", "discriminating", "without", "versions", "format")
    ]
    assert [column["shift"] for column in report["shifts"]] == [0.0, 1.0]
    for title, _ in MEASURES.values():
        assert title in printed
    assert evaluate(run_dir, "--episodes", 12, "--shift", 1, "--json", run_dir / "eval.json") == 0
    rows = json.loads((run_dir / "eval.json").read_text())["rows"]
    baseline = {row["decoding"]: row["sr"]["mean"] for row in rows if row["variant"] == "baseline"}
    for column in report["shifts"]:
        assert (column["scenes"], column["episodes"]) == (4, 12)
        # Three episodes in each scene: means over scenes are means over episodes.
        scenes = shift_scenes(make_generated_scenes("rooms", "val", 4), ROOMS, column["shift"])
        bank = compile_bank((scenes[i] for i in range(4)), ROOMS)
        limits = np.array([14 if room == "living_room" else 12 for room in bank.room_types])
        searched = run_frontier_search(bank, draw_episodes(bank, 12), limits)
        assert column["best_length"]["mean"] == pytest.approx(expected_length(bank).mean())
        assert column["random_sr"]["mean"] == pytest.approx(100 * random_success(bank, limits).mean())
        assert column["frontier_sr"]["mean"] == pytest.approx(100 * np.asarray(searched.success).mean())
        assert column["frontier_steps"]["mean"] == pytest.approx(np.asarray(searched.length).mean())
        assert column["layout_gap"]["mean"] > 0
        assert 0 < column["layout_similarity"]["mean"] < 1
        # Only scenes of their room types are one stratum: those of a mean of four.
        half = t.ppf(0.975, 3) * expected_length(bank).std(ddof=1) / 2
        low, high = column["best_length"]["ci95"]
        assert (high - low) / 2 == pytest.approx(half)
    last = report["shifts"][-1]
    assert last["baseline_argmax_sr"]["mean"] == pytest.approx(baseline["argmax"])
    assert last["baseline_sample_sr"]["mean"] == pytest.approx(baseline["sample"])
    # Here the run itself stands for agents without experience.
    assert last["without_argmax_sr"] == last["baseline_argmax_sr"]
    assert last["without_sample_sr"] == last["baseline_sample_sr"]


@pytest.mark.slow
def test_other_scenes_of_another_split(run_dir):
    assert instrument(run_dir, "--shift", 0, 1, "--episodes", 4, "--split", "test", "--scenes-per-split", 6) == 0
    report = json.loads((run_dir / "instrument-test.json").read_text())
    assert [column["scenes"] for column in report["shifts"]] == [6, 6]
    assert report["run"]["worlds"]["num_test"] == 6
    assert report["run"]["evaluation_split"] == "test"


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--shift", "0.5", "0.5"], "--shift 0.5 0.5: give at least two different shifts"),
        (["--shift", "-1", "0"], "give numbers from 0 to 1"),
        (["--episodes", "0"], "--episodes 0: give at least 1"),
        (["--seed", "-1"], "--seed -1: give a whole number from 0"),
        (["--scenes-per-split", "0"], "ask for at least one"),
        (["--without", "nowhere"], "nowhere"),
    ],
)
def test_bad_requests_are_refused_and_write_nothing(run_dir, capsys, options, problem):
    before = contents(run_dir)
    assert instrument(run_dir, *options) == 2
    assert problem in refusal(capsys)
    assert contents(run_dir) == before


@pytest.mark.slow
def test_a_run_on_scenes_of_a_file(run_dir, tmp_path, capsys):
    run, file = tmp_path / "run", tmp_path / "scenes.jsonl.gz"
    scenes = make_generated_scenes("rooms", "val", 4)
    write_scenes(file, [scenes[i] for i in range(4)])
    shutil.copytree(run_dir, run)
    with resigned(run / "config.json") as settings:
        settings["scenes"] = str(file)
    assert instrument(run, "--shift", 0, 1, "--episodes", 20) == 0
    first, last = json.loads((run / "instrument-val.json").read_text())["shifts"]
    # Places are exchanged: paths and goals nearly stay, what is seen together does not.
    assert last["best_length"]["mean"] == pytest.approx(first["best_length"]["mean"], rel=0.05)
    assert last["start_distance"]["mean"] == pytest.approx(first["start_distance"]["mean"], rel=0.01)
    assert last["layout_gap"]["mean"] != pytest.approx(first["layout_gap"]["mean"])
    assert instrument(run, "--scenes-per-split", 4) == 2
    assert "is a run on scenes of a file; leave it out" in refusal(capsys)


@pytest.mark.parametrize("joined", [False, True])
def test_with_a_config_it_is_that_of_a_study(tmp_path, capsys, joined):
    (tmp_path / "study.yaml").write_text("shifts: [1.0]")
    file = str(tmp_path / "study.yaml")
    assert instrument(*([f"--config={file}"] if joined else ["--config", file])) == 2
    assert "shifts: (1.0,): give two or more from 0 to 1, rising" in refusal(capsys)


def test_both_commands_lead_here(tmp_path, capsys, monkeypatch):
    assert commands.main(["instrument", str(tmp_path), "--shift", "1"]) == 2
    assert "give at least two different shifts" in refusal(capsys)
    monkeypatch.setattr("sys.argv", ["eval.py", "instrument", str(tmp_path), "--shift", "1"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(Path(commands.__file__).parents[1] / "eval.py"), run_name="__main__")
    assert "give at least two different shifts" in refusal(capsys)
