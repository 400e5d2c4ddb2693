"""The seconds of a run."""

import time

import pytest

from jaxnav.runs.train import Stopwatch
from jaxnav.store.files import append_log_rows


def test_stopwatch_counts_from_its_start_and_continues_after_an_interruption(tmp_path):
    start_time = time.monotonic()
    clock = Stopwatch.start()
    assert clock.resume(tmp_path / "missing.jsonl") == clock
    path = tmp_path / "times.jsonl"
    append_log_rows(path, [{"step": step, "wall_s": 10.0 * step, "cpu_s": 4.0 * step} for step in (1, 2)])
    start_times = clock.read()
    resumed_times = clock.resume(path).read()
    assert 0 <= start_times["wall_s"] <= time.monotonic() - start_time + 0.01
    # Twenty and eight seconds were over when it was interrupted.
    assert resumed_times["wall_s"] == pytest.approx(start_times["wall_s"] + 20, abs=1)
    assert resumed_times["cpu_s"] == pytest.approx(start_times["cpu_s"] + 8, abs=1)
