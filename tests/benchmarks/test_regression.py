"""Tests of the regression check: worked arithmetic of a band, and runs inside and outside of it."""

import importlib
import json
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def regression(tmp_path, monkeypatch):
    """Module `regression` without stored bands."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    module = importlib.import_module("regression")
    monkeypatch.setattr(module, "BANDS_FILE", tmp_path / "regression.json")
    return module


def use_runs(monkeypatch, regression, successes, options=()):
    """Replace training by a given success per seed, and set the options of the command."""
    monkeypatch.setattr(regression, "measure_success", lambda name, seed: successes[seed])
    monkeypatch.setattr("sys.argv", ["regression.py", *options])


def test_band_is_the_prediction_interval_of_two_further_runs(regression):
    # Mean 84, standard deviation sqrt(10), t(99.5 %, 4) = 4.6041: 4.6041 * 3.1623 * sqrt(1/5 + 1/2) = 12.18.
    assert regression.compute_band([80, 82, 84, 86, 88]) == pytest.approx([71.82, 96.18], abs=0.01)

    # A band never goes below 0 or above 100.
    assert regression.compute_band([1, 99, 50, 2, 98]) == [0.0, 100.0]


@pytest.mark.parametrize(("checked_success", "expected"), [((83, 73), True), ((73, 70), False), ((97, 99), False)])
def test_check_passes_only_within_the_band(regression, monkeypatch, capsys, checked_success, expected):
    # Record the band of five runs.
    band_runs = dict(enumerate([80, 82, 84, 86, 88]))
    use_runs(monkeypatch, regression, band_runs, ["--record", "org"])
    assert regression.main()
    assert json.loads(regression.BANDS_FILE.read_text())["org"]["success"] == [80, 82, 84, 86, 88]

    # Check the mean of two further runs against it.
    checked_runs = dict(zip(regression.CHECK_SEEDS, checked_success, strict=True))
    use_runs(monkeypatch, regression, checked_runs, ["org"])
    assert regression.main() is expected
    assert ("outside" in capsys.readouterr().out) is not expected


def test_recording_keeps_stored_bands_and_a_method_without_one_fails(regression, monkeypatch, capsys):
    regression.BANDS_FILE.write_text(json.dumps({"org": {"success": [50] * 5, "band": [40, 60]}}))
    use_runs(monkeypatch, regression, dict.fromkeys(range(7), 90.0), ["--record", "org"])
    assert regression.main()
    assert json.loads(regression.BANDS_FILE.read_text())["org"]["band"] == [40, 60]

    use_runs(monkeypatch, regression, dict.fromkeys(range(7), 90.0), ["savn"])
    assert not regression.main()
    assert "savn: no band; record one by --record savn" in capsys.readouterr().err
