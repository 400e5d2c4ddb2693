import importlib.metadata
import io
import json
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation import report as reports
from jaxnav.evaluation import report_tables

STRATA = np.array([0, 0, 1, 1])
LENGTHS = np.array([1, 4, 5, 9])
IDENTITY = {"variant": "baseline", "method": "ORG", "world": "ithor", "split": "test"}
SETTING = {"epsilon": None, "decoding": "argmax", "form": None}


def results(**changes):
    """Two seeds, four episodes."""
    metrics = {
        "sr": np.array([[1, 1, 0, 1], [1, 0, 0, 1]], bool),
        "spl": np.array([[1.0, 0.5, 0.0, 0.5], [1.0, 0.0, 0.0, 0.2]]),
        "dts": np.array([[0.0, 0.5, 2.0, 0.5], [0.0, 1.5, 2.0, 0.5]]),
        "sae": np.array([[0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.0, 0.5]]),
    }
    return metrics | changes


def row(**changes: Any):
    arguments: dict[str, Any] = {"metrics": results(), "best_lengths": LENGTHS, "strata": STRATA}
    arguments |= {"generator": np.random.default_rng(0), **IDENTITY, **SETTING, **changes}
    return reports.build_row(**arguments)


def fixed_row(**changes):
    """A row with numbers chosen by hand, for the tables."""
    metrics = {
        "sr": {"mean": 66.48, "std": 0.22, "ci95": [63.5, 69.44]},
        "spl": {"mean": 38.42, "std": 0.39, "ci95": [36.0, 40.0]},
        "dts": {"mean": 0.541, "std": 0.01, "ci95": [0.5, 0.6]},
    }
    return IDENTITY | SETTING | metrics | changes


def fixed_report(*rows):
    return {"rows": list(rows)}


CELLS = "66.5 ± 0.2 [63.5, 69.4] | 38.4 ± 0.4 [36.0, 40.0] | 0.54 ± 0.01 [0.50, 0.60]"


def test_row_has_the_keys_of_the_format():
    metrics = ["sr", "spl", "dts", "sae"]
    built = row()
    assert list(built) == [*IDENTITY, *SETTING, "seeds", "episodes", *metrics, "buckets"]
    assert {name: list(bucket) for name, bucket in built["buckets"].items()} == {
        "L>=1": ["episodes", *metrics],
        "L>=5": ["episodes", *metrics],
    }
    assert list(built["sr"]) == ["mean", "std", "ci95"]
    assert (built["seeds"], built["episodes"]) == (2, 4)


def test_row_in_percent_and_metres():
    built = row()
    # Success: 3 of 4 and 2 of 4 -> 75 % and 50 %; mean 62.5, std 25 / sqrt(2) = 17.678.
    assert built["sr"]["mean"] == pytest.approx(62.5)
    assert built["sr"]["std"] == pytest.approx(17.678, abs=1e-3)
    # SPL: 2.0 / 4 and 1.2 / 4 -> mean 40 %. DTS: 3 / 4 and 4 / 4 -> 0.875 m. SAE: 1.0 / 4 and 0.5 / 4 -> 18.75 %.
    assert built["spl"]["mean"] == pytest.approx(40)
    assert built["dts"]["mean"] == pytest.approx(0.875)
    assert built["sae"]["mean"] == pytest.approx(18.75)
    low, high = built["sr"]["ci95"]
    assert 0 <= low < 62.5 < high <= 100


def test_buckets_by_best_length():
    built = row()
    assert built["buckets"]["L>=1"] == {key: built[key] for key in ["episodes", "sr", "spl", "dts", "sae"]}
    # L* = 1, 4, 5, 9: the last two episodes have L* >= 5. Success 0, 1 in both seeds; DTS 2.0, 0.5 in both.
    long = built["buckets"]["L>=5"]
    assert long["episodes"] == 2
    assert long["sr"]["mean"] == pytest.approx(50)
    assert long["sr"]["std"] == pytest.approx(0)
    assert long["dts"]["mean"] == pytest.approx(1.25)


def test_empty_bucket_holds_no_metrics():
    assert row(best_lengths=np.array([1, 2, 3, 4]))["buckets"]["L>=5"] == {"episodes": 0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metrics": results(sr=100.0 * results()["sr"])}, "sr .* fractions"),
        ({"metrics": results(dts=-results()["dts"])}, "dts .* metres"),
        ({"metrics": results(spl=np.full((2, 4), np.nan))}, "spl holds NaN"),
        ({"metrics": results(dts=np.full((2, 4), np.inf))}, "dts holds NaN"),
        ({"metrics": results(sae=np.zeros((3, 4)))}, "differ in shape"),
        ({"metrics": {name: values[0] for name, values in results().items()}}, r"\[seeds, episodes\]"),
        ({"metrics": {"sr": np.zeros((2, 4))}}, "exactly"),
        ({"best_lengths": np.array([0, 4, 5, 9])}, "below 1"),
        ({"best_lengths": LENGTHS[:3]}, "best_lengths"),
        ({"strata": STRATA[:3]}, "strata"),
    ],
)
def test_bad_results_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        row(**changes)


def test_difference_in_report_units():
    # Mean success 0.625 against 0.875: +25 points; the two seeds gain 0 and 50 points.
    better = np.array([[1, 1, 0, 1], [1, 1, 1, 1]], bool)
    difference = reports.build_difference(
        "sr",
        ("layout", results()["sr"]),
        ("stde", better),
        epsilon=0.5,
        form="residual",
        decoding="argmax",
        strata=STRATA,
        generator=np.random.default_rng(0),
        same_seeds=True,
    )
    low, high = difference.pop("ci95")
    assert difference == {
        "metric": "sr",
        "from": "layout",
        "to": "stde",
        "epsilon": 0.5,
        "form": "residual",
        "decoding": "argmax",
        "mean": pytest.approx(25),
    }
    assert 0 == low < 25 < high <= 100


def test_json_round_trip(tmp_path):
    report = reports.build_report(
        [row(), row(variant="stde", epsilon=0.5, form="residual")], [], compilations=2, run={"method": "org"}
    )
    path = tmp_path / "report.json"
    path.write_text("old")
    reports.write_report(path, report)
    assert json.loads(path.read_text(encoding="utf-8")) == report
    assert list(report) == ["run", "rows", "differences", "compilations", "versions", "format"]
    assert (report["compilations"], report["format"]) == (2, 1)
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_nan_never_reaches_the_file(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON compliant"):
        reports.write_report(path, reports.build_report([fixed_row(sr=float("nan"))], [], 1, {}))
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_versions():
    found = reports.versions()
    assert list(found) == ["jaxnav", "jax", "flax", "numpy", "python"]
    assert (found["jax"], found["numpy"]) == (jax.__version__, np.__version__)


@pytest.mark.parametrize(("installed", "expected"), [({"jaxnav": "1.2.3"}, "1.2.3"), ({}, "source")])
def test_version_of_an_installed_package_and_of_a_source_tree(monkeypatch, installed, expected):
    def version(name):
        if name == "jaxnav" and name not in installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed.get(name, "0")

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert reports.versions()["jaxnav"] == expected


def test_markdown_table_with_the_label_of_every_variant():
    report = fixed_report(
        fixed_row(variant="random", method="random"),
        fixed_row(),
        fixed_row(variant="layout"),
        fixed_row(variant="tde", form="residual"),
        fixed_row(variant="stde", form="residual", epsilon=0.5),
        fixed_row(variant="stde", form="paper", epsilon=0.25),
    )
    assert report_tables.markdown_table(report) == (
        "| Variant | SR (%) | SPL (%) | DTS (m) |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| **ithor test, argmax decoding** |  |  |  |\n"
        f"| Random | {CELLS} |\n"
        f"| ORG (baseline) | {CELLS} |\n"
        f"| + w (layout) | {CELLS} |\n"
        f"| + w + TDE | {CELLS} |\n"
        f"| + w + sTDE (eps=0.5) | {CELLS} |\n"
        f"| + w + sTDE (eps=0.25), paper form | {CELLS} |\n"
    )


def test_rows_are_grouped_by_decoding():
    report = fixed_report(fixed_row(), fixed_row(decoding="sample"), fixed_row(variant="layout"))
    first_cells = [line.split(" | ")[0].strip("| ") for line in report_tables.markdown_table(report).splitlines()[2:]]
    assert first_cells == [
        "**ithor test, argmax decoding**",
        "ORG (baseline)",
        "+ w (layout)",
        "**ithor test, sample decoding**",
        "ORG (baseline)",
    ]


def test_console_table():
    report = fixed_report(fixed_row(method="[bold]X[/bold]"), fixed_row(decoding="sample", method="VTNet"))
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(report_tables.console_table(report))
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in console.export_text().splitlines()]
    assert [cells for cells in lines if cells] == [
        ["ithor test, argmax decoding", "", "", ""],
        ["[bold]X[/bold] (baseline)", *CELLS.split(" | ")],  # names are text, never markup
        ["ithor test, sample decoding", "", "", ""],
        ["VTNet (baseline)", *CELLS.split(" | ")],
    ]


def test_difference_table_has_a_line_per_comparison():
    entry = {"from": "layout", "to": "stde", "epsilon": 0.5, "form": "residual", "decoding": "argmax"}
    values = [("sr", 25.0, [10.0, 40.0]), ("spl", -1.25, [-2.0, 0.5]), ("dts", -0.031, [-0.1, 0.0])]
    report = {"differences": [{**entry, "metric": name, "mean": mean, "ci95": ci} for name, mean, ci in values]}
    table = report_tables.difference_table(report)
    cells = [str(next(iter(column.cells))) for column in table.columns]
    expected = [
        "+ w + sTDE (eps=0.5) - + w",
        "argmax",
        "+25.0 [+10.0, +40.0]",
        "-1.2 [-2.0, +0.5]",
        "-0.03 [-0.10, +0.00]",
    ]
    assert (cells, table.row_count) == (expected, 1)
