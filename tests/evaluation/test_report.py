"""The report: rows, differences, versions, its file."""

import importlib.metadata
import json
from typing import Any

import jax
import numpy as np
import pytest
from support.intervals import around
from support.study_results import episodes_in

from jaxnav.errors import InputError
from jaxnav.evaluation import report as reports

EPISODES = episodes_in([0, 1, 2, 3], best_length=np.array([1, 4, 5, 9]))
IDENTITY = {"variant": "baseline", "method": "ORG", "world": "ithor", "split": "test"}
SETTING = {"epsilon": None, "decoding": "argmax", "form": None}


def results(**changes):
    """Two seeds, four episodes."""
    metrics = {
        "sr": np.array([[1, 1, 0, 1], [1, 0, 0, 1]], bool),
        "spl": np.array([[1.0, 0.5, 0.0, 0.5], [1.0, 0.0, 0.0, 0.2]]),
        "dts": np.array([[0.0, 0.5, 2.0, 0.5], [0.0, 1.5, 2.0, 0.5]]),
        "sae": np.array([[0.0, 0.5, 0.0, 0.5], [0.0, 0.0, 0.0, 0.5]]),
        "timeout": np.array([[0, 0, 1, 0], [0, 1, 0, 0]], bool),
        "wrong_done": np.array([[0, 0, 0, 0], [0, 0, 1, 0]], bool),
    }
    return metrics | changes


def row(**changes: Any):
    arguments: dict[str, Any] = {"metrics": results(), "episodes": EPISODES, **IDENTITY, **SETTING, **changes}
    return reports.build_row(**arguments)


def with_lengths(*lengths):
    return EPISODES._replace(best_length=np.array(lengths))


def bounds_around(mean, variance, degrees):
    return pytest.approx([*around(mean, variance, degrees)[1:]])


def test_row_has_the_keys_of_the_format():
    metrics = ["sr", "spl", "dts", "sae", "timeout", "wrong_done"]
    built = row()
    assert list(built) == [*IDENTITY, *SETTING, "seeds", "episodes", *metrics, "buckets"]
    assert {name: list(bucket) for name, bucket in built["buckets"].items()} == {
        "L>=1": ["episodes", *metrics],
        "L>=5": ["episodes", *metrics],
    }
    assert list(built["sr"]) == ["mean", "std", "ci95", "seeds"]
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
    assert built["sr"]["seeds"] == [75, 50]
    # By scene 100, 50, 0 and 100 %, sample variance 6875 / 3, / 4; by run 312.5 / 2; what is left is 12.5 in six of
    # eight and 37.5 in two, 3750 / 3 / 8, which is as much.
    by_scene, by_run, both = 6875 / 12, 312.5 / 2, 3750 / 24
    degrees = by_scene**2 / (by_scene**2 / 3 + by_run**2 + both**2 / 3)
    assert built["sr"]["ci95"] == bounds_around(62.5, by_scene, degrees)


@pytest.mark.parametrize("variant", ["random", "oracle"])
def test_seeds_of_what_is_untrained_are_repetitions(variant):
    # Over scenes alone, by the mean of the repetitions; they have no spread that says anything of a training.
    built = row(variant=variant)
    assert built["sr"] == {"mean": pytest.approx(62.5), "std": None, "ci95": bounds_around(62.5, 6875 / 12, 3)}
    assert built["seeds"] == 2


def test_scenes_of_a_floor_plan_count_as_one():
    # Three floor plans: 75 % of two scenes, 0 and 100 %. Without them 50, 83.3 and 50 %: 2 / 3 of the squares.
    names = ("FloorPlan_Train1_1", "FloorPlan_Train1_2", "FloorPlan_Train2_1", "FloorPlan_Train3_1")
    built = row(variant="random", episodes=EPISODES._replace(scenes=names))
    assert built["sr"]["ci95"] == bounds_around(62.5, 2 / 3 * (12.5**2 + (250 / 3 - 62.5) ** 2 + 12.5**2), 2)


def test_buckets_by_best_length():
    built = row()
    assert built["buckets"]["L>=1"] == {key: built[key] for key in ["episodes", *results()]}
    # L* = 1, 4, 5, 9: the last two episodes have L* >= 5. Success 0, 1 in both seeds; DTS 2.0, 0.5 in both.
    long = built["buckets"]["L>=5"]
    assert long["episodes"] == 2
    assert long["sr"]["mean"] == pytest.approx(50)
    assert long["sr"]["std"] == pytest.approx(0)
    assert long["dts"]["mean"] == pytest.approx(1.25)
    assert long["sr"]["ci95"] is None  # of two scenes


def test_empty_bucket_holds_no_metrics():
    assert row(episodes=with_lengths(1, 2, 3, 4))["buckets"]["L>=5"] == {"episodes": 0}


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
        ({"episodes": with_lengths(0, 4, 5, 9)}, "below 1"),
        ({"episodes": with_lengths(1, 4, 5)}, "metrics have 4 episodes, and the list 3"),
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
        episodes=EPISODES,
        same_runs=True,
    )
    assert difference == {
        "metric": "sr",
        "from": "layout",
        "to": "stde",
        "epsilon": 0.5,
        "form": "residual",
        "decoding": "argmax",
        "mean": pytest.approx(25),
        "std": pytest.approx(1250**0.5),
        # By run 1250 / 2; by scene 0, 50, 50 and 0 points, 2500 / 3 / 4, as much as what is left: 1 degree of freedom.
        "ci95": bounds_around(25, 625, 1),
        "seeds": [0, 50],
    }


def test_json_round_trip(tmp_path):
    report = reports.build_report(
        [row(), row(variant="stde", epsilon=0.5, form="residual")], [], ["A note."], 2, run={"method": "org"}
    )
    path = tmp_path / "report.json"
    path.write_text("old")
    reports.write_report(path, report)
    assert json.loads(path.read_text(encoding="utf-8")) == report
    assert list(report) == ["run", "rows", "differences", "notes", "compilations", "versions", "format"]
    assert (report["notes"], report["compilations"], report["format"]) == (["A note."], 2, 1)
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_nan_never_reaches_the_file(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON compliant"):
        reports.write_report(path, reports.build_report([{"sr": float("nan")}], [], [], 1, {}))
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_versions():
    versions = reports.package_versions()
    assert list(versions) == ["jaxnav", "jax", "flax", "numpy", "python"]
    assert (versions["jax"], versions["numpy"]) == (jax.__version__, np.__version__)


@pytest.mark.parametrize(("installed", "expected"), [({"jaxnav": "1.2.3"}, "1.2.3"), ({}, "source")])
def test_version_of_an_installed_package_and_of_a_source_tree(monkeypatch, installed, expected):
    def version(name):
        if name == "jaxnav" and name not in installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed.get(name, "0")

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert reports.package_versions()["jaxnav"] == expected
