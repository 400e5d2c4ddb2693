"""The report command: the options it passes on, the place of the page, and refusals that write nothing."""

import json
import shutil

import pytest
from support.commands import contents, refusal
from support.tiny_run import finished_run

from jaxnav.cli import report as report_command


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return finished_run(tmp_path_factory)[1]


def run_report(*arguments):
    """Run the report command, and return its exit code."""
    return report_command.main([*map(str, arguments)])


@pytest.fixture
def report_calls(monkeypatch):
    """Arguments of every call of `make_report`, which returns a page of two words instead of measuring a run."""
    calls = []

    def record_call(*arguments):
        calls.append(arguments)
        return "a page"

    monkeypatch.setattr("jaxnav.report.make.make_report", record_call)
    return calls


def test_report_command_passes_options_and_writes_the_page(run_dir, tmp_path, report_calls):
    page_path = tmp_path / "new" / "page.html"
    options = ("--reference", run_dir, "--split", "test", "--shift", 0.5, "--replays", 6, "--out", page_path)
    assert run_report(run_dir, *options) == 0
    assert page_path.read_text() == "a page"

    run, reference_run, config, _ = report_calls[0]
    assert run.config.run_dir == reference_run.config.run_dir == run_dir
    assert (config.split, config.shift, config.replays, config.threshold) == ("test", (0.5,), 6, 0.5)
    assert config.episodes == 1000


def test_report_page_is_written_to_the_run_directory(run_dir, tmp_path, report_calls):
    run_copy = shutil.copytree(run_dir, tmp_path / "run")
    assert run_report(run_copy) == 0
    assert (run_copy / "report.html").read_text() == "a page"
    assert report_calls[0][1] is None  # no reference run


def test_report_refuses_folders_without_a_finished_run(run_dir, tmp_path, capsys):
    # A folder without a run, one whose training has not finished, and one with the config of another program.
    empty_dir = tmp_path / "empty"
    unfinished_dir = tmp_path / "unfinished"
    foreign_dir = tmp_path / "foreign"
    for folder in (empty_dir, unfinished_dir, foreign_dir):
        folder.mkdir()
    shutil.copy(run_dir / "config.json", unfinished_dir)
    (foreign_dir / "config.json").write_text(json.dumps({"model": "other"}))

    contents_before = contents(tmp_path)
    path_below_file = run_dir / "config.json" / "page.html"
    for arguments, problem in (
        ((empty_dir,), f"{empty_dir}: holds no run (config.json is missing); train one there first"),
        ((unfinished_dir,), f"{unfinished_dir}/policies/baseline-0: is missing, so training has not finished"),
        ((foreign_dir,), f"{foreign_dir}/config.json"),
        ((run_dir, "--reference", empty_dir), f"{empty_dir}: holds no run"),
        ((run_dir, "--reference", unfinished_dir), f"{unfinished_dir}/policies/baseline-0: is missing"),
        ((run_dir, "--out", empty_dir), f"--out {empty_dir}: is a folder"),
        ((run_dir, "--out", path_below_file), "lies in a file; give the name of a file to write"),
        ((run_dir, "--replays", 1), "--replays 1: give at least 2, one for each shift"),
    ):
        assert run_report(*arguments) == 2
        assert problem in refusal(capsys)

    # No refusal writes a file.
    assert contents(tmp_path) == contents_before
    assert not (run_dir / "report.html").exists()
