"""The report command: what it hands on, where it writes, and what it refuses."""

import json
import shutil

import pytest
from support.commands import contents, refusal
from support.tiny_run import finished_run

from jaxnav.cli import report as command


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return finished_run(tmp_path_factory)[1]


def report(*arguments):
    return command.main([*map(str, arguments)])


@pytest.fixture
def made(monkeypatch):
    """The arguments of each report that is made; a page of two words."""
    calls = []
    monkeypatch.setattr("jaxnav.report.make.make_report", lambda *arguments: calls.append(arguments) or "a page")
    return calls


def test_report_command_passes_options_and_writes_the_page(run_dir, tmp_path, made):
    out = tmp_path / "new" / "page.html"
    assert report(run_dir, "--reference", run_dir, "--split", "test", "--shift", 0.5, "--replays", 6, "--out", out) == 0
    assert out.read_text() == "a page"
    run, reference_run, options, _ = made[0]
    assert run.config.run_dir == reference_run.config.run_dir == run_dir
    assert (options.split, options.shift, options.replays, options.threshold) == ("test", (0.5,), 6, 0.5)
    assert options.episodes == 1000


def test_report_page_is_written_to_the_run_directory(run_dir, tmp_path, made):
    run = shutil.copytree(run_dir, tmp_path / "run")
    assert report(run) == 0
    assert (run / "report.html").read_text() == "a page"
    assert made[0][1] is None


def test_report_refuses_folders_without_a_finished_run(run_dir, tmp_path, capsys):
    empty, unfinished, foreign = (tmp_path / name for name in ("empty", "unfinished", "foreign"))
    for folder in (empty, unfinished, foreign):
        folder.mkdir()
    shutil.copy(run_dir / "config.json", unfinished)
    (foreign / "config.json").write_text(json.dumps({"model": "other"}))
    before = contents(tmp_path)
    for arguments, problem in (
        ((empty,), f"{empty}: holds no run (config.json is missing); train one there first"),
        ((unfinished,), f"{unfinished}/policies/baseline-0: is missing, so training has not finished"),
        ((foreign,), f"{foreign}/config.json"),
        ((run_dir, "--reference", empty), f"{empty}: holds no run"),
        ((run_dir, "--reference", unfinished), f"{unfinished}/policies/baseline-0: is missing"),
        ((run_dir, "--out", empty), f"--out {empty}: is a folder"),
        ((run_dir, "--out", run_dir / "config.json" / "page.html"), "lies in a file; give the name of a file to write"),
        ((run_dir, "--replays", 1), "--replays 1: give at least 2, one for each shift"),
    ):
        assert report(*arguments) == 2
        assert problem in refusal(capsys)
    assert contents(tmp_path) == before
    assert not (run_dir / "report.html").exists()
