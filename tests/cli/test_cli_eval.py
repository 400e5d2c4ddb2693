"""The eval command end to end, and all that it refuses."""

import contextlib
import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.commands import contents, evaluate, refusal
from support.mutations import resigned
from support.tiny_run import NUM_SEEDS, finished_run

from jaxnav.cli.eval import EvalConfig, _find_target
from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.worlds import make_generated_scenes


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return finished_run(tmp_path_factory)[1]


ROWS = 2 * (2 + 1 + 2) + 2  # of each decoding baseline, layout, TDE and sTDE at two epsilons; Random; the oracle


PRINTED = io.StringIO()


@pytest.fixture(scope="module")
def evaluated(run_dir, tmp_path_factory):
    """The report and the episodes of an evaluation, written into a folder that is not there yet."""
    target = tmp_path_factory.mktemp("eval") / "new" / "table.json"
    with contextlib.redirect_stdout(PRINTED):
        assert evaluate(run_dir, "--episodes", 18, "--epsilon", 0, 0.5, "--json", target) == 0
    return target


def _episodes(report):
    with report.with_suffix(".episodes.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_eval_report_holds_all_rows_and_differences(evaluated):
    report = json.loads(evaluated.read_text())
    assert list(report) == ["run", "rows", "differences", "notes", "compilations", "versions", "format"]
    assert report["run"]["method"] == "org"
    assert report["run"]["steps_per_policy"] == 512
    assert report["run"]["prior_steps"] == 64 * 20
    assert report["compilations"] == 1
    assert len(report["rows"]) == ROWS
    for row in report["rows"]:
        assert (row["method"], row["world"], row["split"], row["seeds"]) == ("ORG", "rooms", "val", NUM_SEEDS)
        assert row["episodes"] == 20  # rounded up to a multiple of the four room types
        for metric in ("sr", "spl", "dts", "sae", "timeout", "wrong_done"):
            # The only scenes of four room types are one stratum, and two training runs are enough.
            low, high = row[metric]["ci95"]
            assert low <= row[metric]["mean"] <= high
            assert (row[metric]["std"] is None) == (row["variant"] in ("random", "oracle"))
    settings = [(row["variant"], row["epsilon"], row["decoding"], row["form"]) for row in report["rows"]]
    assert len(set(settings)) == ROWS
    assert ("stde", 0.5, "argmax", "residual") in settings
    oracle = next(row for row in report["rows"] if row["variant"] == "oracle")
    short = np.array([float(r["best_length"]) for r in _episodes(evaluated) if r["variant"] == "oracle"]) <= 12
    assert oracle["sr"]["mean"] == oracle["spl"]["mean"] >= 100 * short.mean()  # all but those beyond the step limit
    # Layout against baseline, the others against layout: four rows of each decoding, three metrics.
    assert len(report["differences"]) == 2 * 4 * 3


@pytest.mark.slow
def test_eval_prints_the_notes_below_the_table(evaluated):
    notes = json.loads(evaluated.read_text())["notes"]
    assert any("are told the type of the room by their prior" in note for note in notes)
    # Four updates are no training.
    assert any(note.startswith("baseline (argmax) is no better than Random") for note in notes)
    printed = " ".join(PRINTED.getvalue().split())
    assert printed.index("Difference, paired") < printed.index(" ".join(notes))


@pytest.mark.slow
def test_eval_episode_file_averages_to_the_report(evaluated):
    rows = _episodes(evaluated)
    assert len(rows) == ROWS * NUM_SEEDS * 20
    report = json.loads(evaluated.read_text())
    for row in report["rows"]:
        epsilon = "" if row["epsilon"] is None else str(row["epsilon"])
        own = [
            r for r in rows if (r["variant"], r["epsilon"], r["decoding"]) == (row["variant"], epsilon, row["decoding"])
        ]
        assert len(own) == NUM_SEEDS * 20
        for metric, scale in (("sr", 100), ("spl", 100), ("dts", 1)):
            assert scale * np.mean([float(r[metric]) for r in own]) == pytest.approx(row[metric]["mean"], rel=1e-4)
    for row in rows:
        limit = 14 if row["room"] == "living_room" else 12
        assert 1 <= int(row["length"]) <= limit
        assert row["goal"] in ITHOR_CATEGORIES
        assert 0 <= float(row["mean_weight"]) <= 1


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--epsilon", "nan"], "--epsilon nan: give numbers from 0 to below infinity"),
        (["--epsilon", "0.5", "-0.5"], "--epsilon -0.5: give"),
        (["--epsilon", "inf"], "--epsilon inf: give"),
        (["--episodes", "0"], "--episodes 0: give at least 1"),
        (["--seed", "-1"], "--seed -1: give a whole number from 0"),
    ],
)
def test_eval_refuses_bad_options_and_writes_nothing(run_dir, capsys, options, problem):
    before = contents(run_dir)
    assert evaluate(run_dir, *options) == 2
    assert problem in refusal(capsys)
    assert contents(run_dir) == before


def test_eval_refuses_a_directory_without_a_run(tmp_path, capsys):
    for folder in (tmp_path, tmp_path / "none"):
        assert evaluate(folder) == 2
        assert f"{folder}: holds no run (config.json is missing); train one there first" in refusal(capsys)
    assert not (tmp_path / "none").exists()


def test_eval_refuses_an_unfinished_run(tmp_path, run_dir, capsys):
    shutil.copy(run_dir / "config.json", tmp_path)
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/policies/baseline-0: is missing, so training has not finished" in refusal(capsys)
    # One policy is missing still: training was ended while it exported them.
    shutil.copytree(run_dir / "policies", tmp_path / "policies")
    (tmp_path / "policies" / "layout-1" / "policy.json").unlink()
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/policies/layout-1: not an exported policy" in refusal(capsys)
    assert not list(tmp_path.glob("eval*"))


def test_eval_refuses_a_run_of_an_unknown_method(tmp_path, run_dir, capsys):
    run = shutil.copytree(run_dir, tmp_path / "run")
    for name, problem in {
        "no_such_package:MINE": "cannot be imported (ModuleNotFoundError: No module named 'no_such_package'); inst",
        "orgy": "is unknown; did you mean 'org'?",
    }.items():
        with resigned(run / "config.json") as config:
            config["method"] = name
        assert evaluate(run) == 2
        assert f"method {name!r}: {problem}" in refusal(capsys)
    assert not list(run.glob("eval*"))


@pytest.mark.slow
def test_eval_is_reproducible_byte_for_byte(run_dir, evaluated, tmp_path):
    for seed, equal in ((0, True), (1, False)):
        again = tmp_path / f"{seed}.json"
        assert evaluate(run_dir, "--episodes", 18, "--epsilon", 0, 0.5, "--json", again, "--seed", seed) == 0
        assert (again.read_bytes() == evaluated.read_bytes()) == equal
        episodes = [path.with_suffix(".episodes.csv").read_bytes() for path in (again, evaluated)]
        assert (episodes[0] == episodes[1]) == equal


def test_eval_names_damaged_files(tmp_path, run_dir, capsys):
    scenes = tmp_path / "scenes.jsonl.gz"
    scenes.write_bytes(b"not compressed")
    assert evaluate(run_dir, "--scenes", scenes) == 2
    assert f"{scenes}, line 1: not JSON" in refusal(capsys)
    text = (run_dir / "config.json").read_text()
    (tmp_path / "config.json").write_text(text[: len(text) // 2])
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/config.json" in refusal(capsys)


@pytest.mark.slow
def test_eval_of_a_shift_is_named_in_file_and_report(run_dir, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(run_dir, run)
    assert evaluate(run, "--episodes", 4, "--shift", 1) == 0
    report = json.loads((run / "eval-val-shift1.json").read_text())
    assert report["run"]["evaluation_shift"] == 1.0
    assert report["run"]["worlds"]["shift"] == 0.0
    assert not (run / "eval-val.json").exists()
    capsys.readouterr()
    assert evaluate(run, "--shift", 1.5) == 2
    assert "give a seed of at least 0, a shift from 0 to 1" in refusal(capsys)


@pytest.mark.slow
def test_eval_shifts_the_scenes_of_a_file(run_dir, tmp_path, capsys):
    run, file = tmp_path / "run", tmp_path / "a.jsonl.gz"
    shutil.copytree(run_dir, run)
    with resigned(run / "config.json") as config:
        config["worlds"]["shift"] = 0.5  # of the run's own scenes; a file is taken as it is
    write_scenes(file, (make_generated_scenes("rooms", "val")[i] for i in range(2)))
    outputs = {}
    for shift, options in ((0.0, ()), (1.0, ("--shift", 1))):
        target = tmp_path / f"{shift}.json"
        assert evaluate(run, "--episodes", 40, "--scenes", file, "--json", target, *options) == 0
        assert json.loads(target.read_text())["run"]["evaluation_shift"] == shift
        outputs[shift] = [
            (row["scene"], row["goal"], row["start_pose"], row["best_length"]) for row in _episodes(target)
        ]
    assert outputs[0.0] != outputs[1.0]
    capsys.readouterr()
    assert evaluate(run, "--shift", 1.5, "--scenes", file) == 2
    assert "layout shift: seed 0, shift 1.5; give" in refusal(capsys)


def test_eval_report_names_differ_for_a_world_and_a_file():
    run, file = Path("run"), Path("elsewhere/rooms.jsonl.gz")
    configs = [EvalConfig(run), EvalConfig(run, world="rooms"), EvalConfig(run, scenes=file)]
    names = [str(_find_target(config)) for config in configs]
    assert names == ["run/eval-val.json", "run/eval-rooms-val.json", "run/eval-scenes-rooms-val.json"]


@pytest.mark.slow
def test_eval_of_a_run_on_a_file_accepts_a_generated_world(run_dir, tmp_path, capsys):
    run, file = tmp_path / "run", tmp_path / "a.jsonl.gz"
    shutil.copytree(run_dir, run)
    assert evaluate(run, "--episodes", 8) == 0  # in the run's own rooms
    with resigned(run / "config.json") as config:
        config["scenes"] = str(file)
        config["worlds"]["shift"] = 0.5  # of the scenes of the file
    write_scenes(file, (make_generated_scenes("rooms", "val", seed=1)[i] for i in range(2)))
    assert evaluate(run, "--episodes", 8, "--world", "rooms") == 0
    rooms, own = (json.loads((run / name).read_text()) for name in ("eval-rooms-val.json", "eval-val.json"))
    assert rooms["rows"] == own["rows"]
    assert (rooms["run"]["evaluation_source"], rooms["run"]["evaluation_shift"]) == ("rooms", 0.0)
    assert evaluate(run, "--episodes", 8, "--json", tmp_path / "file.json") == 0
    assert json.loads((tmp_path / "file.json").read_text())["rows"] != own["rows"]
    # Its categories are the run's in another world too, whose limit of actions the run's settings replace.
    assert evaluate(run, "--episodes", 8, "--world", "houses") == 0
    assert {row["world"] for row in json.loads((run / "eval-houses-val.json").read_text())["rows"]} == {"houses"}
    assert {row["goal"] for row in _episodes(run / "eval-houses-val.json")} <= set(ITHOR_CATEGORIES)
    capsys.readouterr()
    assert evaluate(run, "--world", "rooms", "--scenes", file) == 2
    assert f"--scenes, --world: both are given ({file}, rooms); leave one out" in refusal(capsys)


def test_eval_refuses_an_export_of_another_task(run_dir, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(run_dir, run)
    with resigned(run / "config.json") as config:
        config["detector"]["false_alarm"] = 0.25
    assert evaluate(run) == 2
    assert "was trained for another task than its run says" in refusal(capsys)
