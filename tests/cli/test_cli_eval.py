"""The eval command end to end, and its refusals."""

import contextlib
import csv
import dataclasses
import io
import json
import re
import shutil
import tarfile
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from support.commands import contents, evaluate, refusal
from support.mutations import resigned
from support.refusals import assert_message_names
from support.tiny_run import NUM_SEEDS, finished_run

from jaxnav.cli.eval import EvalConfig, _find_target
from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.worlds import make_generated_scenes


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return finished_run(tmp_path_factory)[1]


#: In each decoding: baseline, layout, TDE and sTDE, the last three at two epsilons in all; then Random and the oracle.
NUM_ROWS = 2 * (2 + 1 + 2) + 2
NUM_EPISODES = 20  # 18, rounded up to a multiple of the four room types
OPTIONS = ("--episodes", 18, "--epsilon", 0, 0.5)
DATA = Path(__file__).parents[1] / "data"

#: What the evaluation below prints.
PRINTED_TABLE = io.StringIO()


@pytest.fixture(scope="module")
def report_file(run_dir, tmp_path_factory):
    """The report of an evaluation, written with its episodes into a new folder."""
    path = tmp_path_factory.mktemp("eval") / "new" / "table.json"
    with contextlib.redirect_stdout(PRINTED_TABLE):
        assert evaluate(run_dir, *OPTIONS, "--json", path) == 0
    return path


def read_report(path):
    return json.loads(path.read_text())


def read_episodes(path):
    """Return the rows of the episode file beside a report."""
    with path.with_suffix(".episodes.csv").open() as file:
        return list(csv.DictReader(file))


# Reports


@pytest.mark.slow
def test_eval_report_holds_all_rows_and_differences(report_file):
    report = read_report(report_file)
    parts = ["run", "rows", "differences", "decision_shares", "notes", "compilations", "versions", "format"]
    assert list(report) == parts
    assert report["run"]["method"] == "org"
    assert report["run"]["steps_per_policy"] == 512
    assert report["run"]["prior_steps"] == 64 * 20
    assert report["compilations"] == 1

    # Every row holds the mean within its interval of all metrics.
    assert len(report["rows"]) == NUM_ROWS
    for row in report["rows"]:
        assert (row["method"], row["world"], row["split"], row["seeds"]) == ("ORG", "rooms", "val", NUM_SEEDS)
        assert row["episodes"] == NUM_EPISODES
        for metric in ("sr", "spl", "dts", "sae", "timeout", "wrong_done"):
            # The only scenes of four room types are one stratum, and two training runs are enough.
            low, high = row[metric]["ci95"]
            assert low <= row[metric]["mean"] <= high
            assert (row[metric]["std"] is None) == (row["variant"] in ("random", "oracle"))

    # No two rows have the same settings.
    row_settings = [(row["variant"], row["epsilon"], row["decoding"], row["form"]) for row in report["rows"]]
    assert len(set(row_settings)) == NUM_ROWS
    assert ("stde", 0.5, "argmax", "residual") in row_settings

    # The oracle finds all goals but those beyond the step limit.
    oracle = next(row for row in report["rows"] if row["variant"] == "oracle")
    oracle_episodes = [row for row in read_episodes(report_file) if row["variant"] == "oracle"]
    is_reachable = np.array([float(row["best_length"]) for row in oracle_episodes]) <= 12
    assert oracle["sr"]["mean"] == oracle["spl"]["mean"] >= 100 * is_reachable.mean()

    # Layout against baseline, the rest against layout: four rows of each decoding, three metrics.
    assert len(report["differences"]) == 2 * 4 * 3


@pytest.mark.slow
def test_eval_prints_the_notes_below_the_table(report_file):
    notes = read_report(report_file)["notes"]
    assert any("room type" in note and "prior" in note for note in notes)
    # Four updates are no training.
    assert any(note.startswith("baseline (argmax) is no better than Random") for note in notes)
    printed_text = " ".join(PRINTED_TABLE.getvalue().split())
    assert printed_text.index("Difference, paired") < printed_text.index(" ".join(notes))


@pytest.mark.slow
def test_eval_episode_file_averages_to_the_report(report_file):
    episodes = read_episodes(report_file)
    assert len(episodes) == NUM_ROWS * NUM_SEEDS * NUM_EPISODES
    episodes_by_row = {}
    for episode in episodes:
        row_key = (episode["variant"], episode["epsilon"], episode["decoding"])
        episodes_by_row.setdefault(row_key, []).append(episode)

    for row in read_report(report_file)["rows"]:
        epsilon = "" if row["epsilon"] is None else str(row["epsilon"])
        row_episodes = episodes_by_row[row["variant"], epsilon, row["decoding"]]
        assert len(row_episodes) == NUM_SEEDS * NUM_EPISODES
        for metric, scale in (("sr", 100), ("spl", 100), ("dts", 1)):
            mean_value = scale * np.mean([float(episode[metric]) for episode in row_episodes])
            assert mean_value == pytest.approx(row[metric]["mean"], rel=1e-4)

    for episode in episodes:
        step_limit = 14 if episode["room"] == "living_room" else 12
        assert 1 <= int(episode["length"]) <= step_limit
        assert episode["goal"] in ITHOR_CATEGORIES
        assert 0 <= float(episode["mean_weight"]) <= 1


@pytest.mark.exhaustive
def test_eval_is_reproducible_byte_for_byte(run_dir, report_file, tmp_path):
    for seed, is_equal in ((0, True), (1, False)):
        path = tmp_path / f"{seed}.json"
        assert evaluate(run_dir, *OPTIONS, "--json", path, "--seed", seed) == 0
        assert (path.read_bytes() == report_file.read_bytes()) == is_equal
        first, second = (file.with_suffix(".episodes.csv").read_bytes() for file in (path, report_file))
        assert (first == second) == is_equal


def test_eval_report_names_differ_for_a_world_and_a_file():
    run_path = Path("run")
    scene_file = Path("elsewhere/rooms.jsonl.gz")
    configs = [
        EvalConfig(str(run_path)),
        EvalConfig(str(run_path), world="rooms"),
        EvalConfig(str(run_path), scenes=scene_file),
    ]
    report_names = [str(_find_target(config)) for config in configs]
    assert report_names[:2] == ["run/eval-val.json", "run/eval-rooms-val.json"]
    assert re.fullmatch("run/eval-scenes-rooms-[0-9a-f]{8}-val.json", report_names[2])

    # Agents take a world and a file, and names of agents stay apart.
    agents = [
        EvalConfig("my:agent_x", world="houses"),
        EvalConfig("my:agent_x", world="houses", scenes=scene_file),
        EvalConfig("my:agent_x", world="houses", scenes=Path("elsewhere/homes.jsonl.gz")),
        EvalConfig("my_agent:x", world="houses"),
        EvalConfig("my:ägent", world="houses"),
        EvalConfig("my:ögent", world="houses"),
    ]
    assert len({_find_target(config) for config in agents}) == len(agents)


def test_scores_of_other_settings_have_other_files():
    config = EvalConfig("rooms-org", benchmark="v2")
    configs = [config, dataclasses.replace(config, subject="runs/rooms")]
    configs += [dataclasses.replace(config, tracks=tracks) for tracks in (("rooms",), ("rooms", "houses"))]
    for name in ("epsilon", "form", "setting", "hold", "inner_steps", "removal", "counterfactual_memory", "costs"):
        configs += [dataclasses.replace(config, **{name: value}) for value in OTHER_OPTIONS[name]]
    targets = [str(_find_target(config)) for config in configs]
    assert targets[0] == "benchmark-v2-rooms-org-all.json"
    assert len(set(targets)) == len(configs)


#: For every option that changes an evaluation, other values than the default.
OTHER_OPTIONS = {
    "split": ("train", "test"),
    "world": ("rooms", "houses"),
    "scenes": tuple(
        Path(name)
        for name in ("homes.v1.jsonl.gz", "homes.v2.jsonl.gz", "a/homes.jsonl", "b/homes.jsonl", "a\nb.gz", "x" * 250)
    ),
    "shift": (0.0, 1.0, 0.1234567, 0.12345678),
    "shift_by": ("context",),
    "episodes": (8, 100),
    "epsilon": ((0.0,), (0.5, 0.0), (0.25, 0.5), tuple(range(50)), tuple(range(51)), ()),
    "form": (("paper",), ("switch",), ("paper", "switch"), ("switch",) * 99),
    "setting": ("paper", "learned"),
    "hold": (True,),
    "inner_steps": (0, 3),
    "removal": (("cde",), ("tde", "cde")),
    "counterfactual_memory": ("factual", "own"),
    "costs": ("all", "none"),
    "seed": (1, 2**32 - 1),
}


def test_evaluations_of_other_settings_have_other_files():
    fields = {field.name for field in dataclasses.fields(EvalConfig)}
    assert OTHER_OPTIONS.keys() == fields - {"subject", "json", "format", "benchmark", "tracks"}

    run_path = Path("run")
    configs = [EvalConfig(str(run_path)), EvalConfig(str(run_path), seed=1, hold=True)]
    for name, values in OTHER_OPTIONS.items():
        configs += [dataclasses.replace(EvalConfig(str(run_path)), **{name: value}) for value in values]
    targets = [_find_target(config) for config in configs]
    assert len({str(target).lower() for target in targets}) == len(configs)
    for config, target in zip(configs, targets, strict=True):
        assert _find_target(config) == target
        assert target.parent == run_path
        assert re.fullmatch(r"eval-[A-Za-z0-9._-]{1,200}\.json", target.name)

    # How a report is printed changes no name, and a scene file has one name by any path.
    assert _find_target(EvalConfig(str(run_path), format="json")) == targets[0]
    scene_path = Path("homes.jsonl.gz")
    absolute_config = EvalConfig(str(run_path), scenes=Path.cwd() / scene_path)
    assert _find_target(EvalConfig(str(run_path), scenes=scene_path)) == _find_target(absolute_config)


# Layout shifts, scene files and other worlds


@pytest.mark.exhaustive
def test_eval_of_a_shift_is_named_in_file_and_report(run_dir, tmp_path, capsys):
    copied_run = shutil.copytree(run_dir, tmp_path / "run")
    assert evaluate(copied_run, "--episodes", 4, "--shift", 1) == 0
    report = read_report(copied_run / "eval-val-shift1-episodes4.json")
    assert report["run"]["evaluation_shift"] == 1.0
    assert report["run"]["worlds"]["shift"] == 0.0
    assert report["run"]["evaluation_shift_by"] == "size"
    assert not (copied_run / "eval-val-episodes4.json").exists()

    # The exchange that misleads most is another one, and the file is named after it.
    assert evaluate(copied_run, "--episodes", 4, "--shift", 1, "--shift-by", "context") == 0
    assert (copied_run / "latest-eval.txt").read_text() == "eval-val-shift1-by-context-episodes4.json\n"
    context_report = read_report(copied_run / "eval-val-shift1-by-context-episodes4.json")
    assert context_report["run"]["evaluation_shift_by"] == "context"

    capsys.readouterr()
    assert evaluate(copied_run, "--shift", 1.5) == 2
    assert "a shift from 0 to 1" in refusal(capsys)


@pytest.mark.exhaustive
def test_eval_shifts_the_scenes_of_a_file(run_dir, tmp_path, capsys):
    copied_run = shutil.copytree(run_dir, tmp_path / "run")
    scene_file = tmp_path / "a.jsonl.gz"
    with resigned(copied_run / "config.json") as config:
        config["worlds"]["shift"] = 0.5  # of the run's own scenes; the scenes of a file are not shifted by it
    scenes = make_generated_scenes("rooms", "val")
    write_scenes(scene_file, (scenes[index] for index in range(2)))

    # Scenes, goals, starts and path lengths with and without a shift.
    tasks_by_shift = {}
    for shift, options in ((0.0, ()), (1.0, ("--shift", 1))):
        path = tmp_path / f"{shift}.json"
        assert evaluate(copied_run, "--episodes", 40, "--scenes", scene_file, "--json", path, *options) == 0
        assert read_report(path)["run"]["evaluation_shift"] == shift
        tasks_by_shift[shift] = [
            (row["scene"], row["goal"], row["start_pose"], row["best_length"]) for row in read_episodes(path)
        ]
    assert tasks_by_shift[0.0] != tasks_by_shift[1.0]

    capsys.readouterr()
    assert evaluate(copied_run, "--shift", 1.5, "--scenes", scene_file) == 2
    assert "shift 1.5; give" in refusal(capsys)


@pytest.mark.exhaustive
def test_eval_of_a_run_on_a_file_accepts_a_generated_world(run_dir, tmp_path, capsys):
    copied_run = shutil.copytree(run_dir, tmp_path / "run")
    scene_file = tmp_path / "a.jsonl.gz"

    # First in the run's own rooms, then the run becomes one that was trained on a file.
    assert evaluate(copied_run, "--episodes", 8) == 0
    with resigned(copied_run / "config.json") as config:
        config["scenes"] = str(scene_file)
        config["worlds"]["shift"] = 0.5  # of the scenes of the file
    scenes = make_generated_scenes("rooms", "val", seed=1)
    write_scenes(scene_file, (scenes[index] for index in range(2)))

    # The generated world gives the rows of the run's own rooms, the file gives other ones.
    assert evaluate(copied_run, "--episodes", 8, "--world", "rooms") == 0
    rooms_report = read_report(copied_run / "eval-rooms-val-episodes8.json")
    own_report = read_report(copied_run / "eval-val-episodes8.json")
    assert rooms_report["rows"] == own_report["rows"]
    assert rooms_report["run"]["evaluation_source"] == "rooms"
    assert rooms_report["run"]["evaluation_shift"] == 0.0
    assert evaluate(copied_run, "--episodes", 8, "--json", tmp_path / "file.json") == 0
    assert read_report(tmp_path / "file.json")["rows"] != own_report["rows"]

    # In another world the categories are still the run's, whose step limit replaces that of the world.
    assert evaluate(copied_run, "--episodes", 8, "--world", "houses") == 0
    houses_file = copied_run / "eval-houses-val-episodes8.json"
    assert {row["world"] for row in read_report(houses_file)["rows"]} == {"houses"}
    assert {row["goal"] for row in read_episodes(houses_file)} <= set(ITHOR_CATEGORIES)

    capsys.readouterr()
    assert evaluate(copied_run, "--world", "rooms", "--scenes", scene_file) == 2
    assert_message_names(refusal(capsys), "--scenes, --world", f"{scene_file}, rooms", "give only one")


# Refusals


@pytest.mark.parametrize(
    ("options", "named_parts"),
    [
        (["--epsilon", "nan"], ["--epsilon nan", "give finite numbers of at least 0"]),
        (["--epsilon", "0.5", "-0.5"], ["--epsilon -0.5", "give"]),
        (["--epsilon", "inf"], ["--epsilon inf", "give"]),
        (["--episodes", "0"], ["--episodes 0", "give at least 1"]),
        (["--seed", "-1"], ["--seed -1", "give a whole number from 0"]),
    ],
)
def test_eval_refuses_bad_options_and_writes_nothing(run_dir, capsys, options, named_parts):
    files_before = contents(run_dir)
    assert evaluate(run_dir, *options) == 2
    assert_message_names(refusal(capsys), *named_parts)
    assert contents(run_dir) == files_before


def test_eval_refuses_a_directory_without_a_run(tmp_path, capsys):
    for folder in (tmp_path, tmp_path / "none"):
        assert evaluate(folder) == 2
        assert_message_names(refusal(capsys), f"{folder}: ", "config.json is missing", "train one there first")
    assert not (tmp_path / "none").exists()


def test_eval_refuses_an_unfinished_run(tmp_path, run_dir, capsys):
    shutil.copy(run_dir / "config.json", tmp_path)
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/policies/baseline-0: is missing" in refusal(capsys)

    # A training that ended during the export left one policy incomplete.
    shutil.copytree(run_dir / "policies", tmp_path / "policies")
    (tmp_path / "policies" / "layout-1" / "policy.json").unlink()
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/policies/layout-1: not an exported policy" in refusal(capsys)
    assert not list(tmp_path.glob("eval*"))


@pytest.mark.parametrize(
    ("method_name", "named_parts"),
    [
        ("no_such_package:MINE", ["No module named 'no_such_package'", "inst"]),
        ("orgy", ["did you mean 'org'?"]),
    ],
)
def test_eval_refuses_a_run_of_an_unknown_method(tmp_path, run_dir, capsys, method_name, named_parts):
    copied_run = shutil.copytree(run_dir, tmp_path / "run")
    with resigned(copied_run / "config.json") as config:
        config["method"] = method_name
    assert evaluate(copied_run) == 2
    assert_message_names(refusal(capsys), f"method {method_name!r}: ", *named_parts)
    assert not list(copied_run.glob("eval*"))


def test_eval_names_damaged_files(tmp_path, run_dir, capsys):
    scene_file = tmp_path / "scenes.jsonl.gz"
    scene_file.write_bytes(b"not compressed")
    assert evaluate(run_dir, "--scenes", scene_file) == 2
    assert f"{scene_file}, line 1: not JSON" in refusal(capsys)
    config_text = (run_dir / "config.json").read_text()
    (tmp_path / "config.json").write_text(config_text[: len(config_text) // 2])
    assert evaluate(tmp_path) == 2
    assert f"{tmp_path}/config.json" in refusal(capsys)


def test_eval_refuses_an_export_of_another_task(run_dir, tmp_path, capsys):
    copied_run = shutil.copytree(run_dir, tmp_path / "run")
    with resigned(copied_run / "config.json") as config:
        config["detector"]["false_alarm"] = 0.25
    assert evaluate(copied_run) == 2
    assert "its task differs from that of its run" in refusal(capsys)


def test_results_are_written_before_they_are_printed(monkeypatch, tmp_path):
    """The reader of a pipe may end first, as in `jaxnav eval RUN | head`."""

    class FakeResults:
        report: ClassVar[dict] = {}

        def write(self, path):
            path.write_text("written")

    def break_pipe(*_):
        raise BrokenPipeError

    monkeypatch.setattr("jaxnav.runs.evaluate.evaluate", lambda *_, **__: FakeResults())
    monkeypatch.setattr("jaxnav.cli.eval._print_report", break_pipe)
    target = tmp_path / "eval.json"
    with pytest.raises(BrokenPipeError):
        evaluate("my:agent", "--json", target)
    assert target.read_text() == "written"


# Finished evaluations


@pytest.fixture
def finished_report(tmp_path):
    """The JSON file of an evaluation."""
    with tarfile.open(DATA / "run_of_version_0_2.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    (path,) = tmp_path.rglob("eval-val.json")
    return path


def test_eval_prints_a_finished_evaluation_in_each_format(finished_report, monkeypatch, capsys):
    monkeypatch.delenv("COLUMNS", raising=False)
    files_before = contents(finished_report.parent)
    assert evaluate(finished_report) == 0
    table = capsys.readouterr().out
    assert "Difference, paired on episodes" in table
    for note in read_report(finished_report)["notes"]:
        assert note in table

    assert evaluate(finished_report, "--format", "markdown") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| Variant | SR (%) |")
    assert all(line.startswith("|") or not line.count("|") for line in lines)

    assert evaluate(finished_report, "--format", "json") == 0
    assert json.loads(capsys.readouterr().out) == read_report(finished_report)
    assert contents(finished_report.parent) == files_before


def test_eval_table_fits_a_narrow_terminal(finished_report, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    assert evaluate(finished_report) == 0
    table_lines = [line for line in capsys.readouterr().out.splitlines() if line[:1] in "│┃"]
    assert max(map(len, table_lines)) <= 80
    row = read_report(finished_report)["rows"][0]
    assert any(f"{row['sr']['mean']:.1f}" in line for line in table_lines)


@pytest.mark.parametrize(
    ("text", "problem"),
    [(None, "no evaluation can be read"), ("{", "no evaluation can be read"), ('{"rows": []}', "is not an evaluation")],
)
def test_eval_refuses_a_file_that_is_no_evaluation(text, problem, tmp_path, capsys):
    path = tmp_path / "a.json"
    if text is not None:
        path.write_text(text)
    assert evaluate(path) == 2
    assert_message_names(refusal(capsys), f"{path}: ", problem, "jaxnav eval")


@pytest.mark.parametrize("options", [("--epsilon", 0.1), ("--hold",), ("--split", "test")])
def test_eval_refuses_options_of_a_run_for_a_finished_evaluation(options, finished_report, capsys):
    assert evaluate(finished_report, *options) == 2
    assert refusal(capsys).startswith(f"error: {options[0]}: ")
