"""The sweep command end to end, the names of its files, and its refusals."""

import dataclasses
import json
import sys
from pathlib import Path

import pytest
from support.commands import refusal
from support.tiny_run import draw_run, tiny_config

import jaxnav
from jaxnav.cli.sweep import SweepConfig, _find_figure_path, main
from jaxnav.runs.sweep import SWEPT_THRESHOLDS

OPTIONS = ("--epsilon", "0", "0.5", "--episodes", "24")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return draw_run(tiny_config(tmp_path_factory.mktemp("sweep"))).config.run_dir


@pytest.mark.slow
def test_sweep_prints_a_table_and_writes_figure_and_numbers(run_dir, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([str(run_dir), *OPTIONS]) == 0

    # The table fits the terminal.
    output = capsys.readouterr()
    assert max(map(len, output.out.splitlines()[:20])) <= 80
    for shift in (0, 1):
        assert f"shift {shift} " in output.out
    assert "95 % intervals over 2 training seeds and 4 floor plans." in output.out
    assert "1 compilation for all thresholds, seeds and shifts\n" in output.err

    # File names hold the options that differ from the defaults.
    assert (run_dir / "sweep-val-episodes24-epsilon0-0.5.png").read_bytes().startswith(b"\x89PNG")
    assert (run_dir / "latest-sweep.txt").read_text() == "sweep-val-episodes24-epsilon0-0.5.json\n"

    # The function `jaxnav.sweep` gives the numbers of the file.
    numbers = json.loads((run_dir / "sweep-val-episodes24-epsilon0-0.5.json").read_text())
    assert numbers["compilations"] == 1
    assert numbers["settings"]["seeds"] == 2
    sweep = jaxnav.sweep(run_dir, (0.0, 0.5), shift=1.0, episodes=24)
    rows = [row for row in numbers["rows"] if row["shift"] == 1.0]
    assert [row["epsilon"] for row in rows] == [0.0, 0.5, None]
    assert rows[0]["sr"]["mean"] == pytest.approx(100 * sweep.sr[0].mean(), abs=1e-9)
    assert rows[0]["spl_change"] == sweep.rows()[0].changes["spl"].to_json()


@pytest.mark.slow
def test_sweep_prints_markdown(run_dir, tmp_path, capsys):
    figure_path = tmp_path / "figure.png"
    assert main([str(run_dir), *OPTIONS, "--shift", "0", "--out", str(figure_path), "--format", "markdown"]) == 0

    # All rows have equally many columns.
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| Shift | Threshold | SR (%) |")
    assert len({line.count("|") for line in lines if line.startswith("|")}) == 1
    assert figure_path.exists()
    assert figure_path.with_suffix(".json").exists()


@pytest.mark.slow
def test_sweep_without_plotting_packages_prints_and_writes_numbers(run_dir, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    figure_path = tmp_path / "figure.png"
    assert main([str(run_dir), *OPTIONS, "--shift", "0", "--out", str(figure_path)]) == 0
    output = capsys.readouterr()
    assert "Threshold" in output.out
    assert "no figure: " in output.err
    assert "pip install 'jaxnav[viz]'" in output.err
    assert [path.name for path in tmp_path.iterdir()] == ["figure.json"]


def test_default_thresholds_are_those_of_the_function():
    assert SweepConfig("run").epsilon == SWEPT_THRESHOLDS


def test_figure_name_holds_the_options_of_the_sweep():
    configs = [
        SweepConfig("run"),
        SweepConfig("run", world="houses", form="switch", hold=True),
        SweepConfig("rooms-org", decoding="sample"),
        SweepConfig("run", shift=(0.0, 0.5)),
    ]
    paths = [str(_find_figure_path(config)) for config in configs]
    assert paths == [
        "run/sweep-val.png",
        "run/sweep-houses-val-switch-hold.png",
        "sweep-rooms-org-val-sampled.png",
        "run/sweep-val-shift0-0.5.png",
    ]


def test_sweeps_of_other_settings_have_other_files(tmp_path):
    # Other values of every option that changes the results.
    other_options = {
        "split": ("train", "test"),
        "world": ("rooms",),
        "scenes": (Path("homes.v1.jsonl.gz"), Path("homes.v2.jsonl.gz")),
        "epsilon": ((0.5,), tuple(range(99))),
        "shift": ((0.0,), (1.0, 0.0)),
        "shift_by": ("context",),
        "episodes": (8,),
        "decoding": ("sample",),
        "form": ("paper", "switch"),
        "setting": ("paper", "learned"),
        "hold": (True,),
        "seed": (1,),
    }
    field_names = {field.name for field in dataclasses.fields(SweepConfig)}
    assert other_options.keys() == field_names - {"source", "out", "format"}

    configs = [SweepConfig("run")]
    for name, values in other_options.items():
        for value in values:
            configs.append(dataclasses.replace(SweepConfig("run"), **{name: value}))

    # Two policies of one name in two folders write into the working directory.
    for folder in ("a", "b"):
        policy_dir = tmp_path / folder / "layout-0"
        policy_dir.mkdir(parents=True)
        (policy_dir / "policy.json").touch()
        configs.append(SweepConfig(str(policy_dir)))
    assert len({_find_figure_path(config) for config in configs}) == len(configs)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("rooms-org", "--out", "figure.jpg"), "--out figure.jpg: give a name that ends in .png"),
        (("rooms-org", "--shift"), "--shift: give at least one number"),
        (("rooms-org", "--epsilon"), "--epsilon: give at least one number"),
        (("rooms-org", "--seed", "-1"), "--seed -1: give a whole number from 0"),
        (("nowhere",), "nowhere: neither a run directory (config.json is missing) nor an exported policy"),
    ],
)
def test_sweep_refuses_impossible_options(capsys, arguments, problem):
    assert main([*arguments]) == 2
    assert problem in refusal(capsys)


def test_sweep_refuses_policies_without_the_layout(run_dir, capsys):
    assert main([str(run_dir / "policies" / "baseline-0")]) == 2
    assert "a policy of the arm 'baseline', which does not use the layout" in refusal(capsys)
