"""Progress bar, success and number of steps that a training run prints and logs."""

import dataclasses
import io
import math

import pytest
from rich.text import Text

from jaxnav.plain_console import PlainConsole
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import ProgressDisplay, mark_undefined_means, warn_if_more_steps
from jaxnav.store.files import append_log_rows, read_log_rows


@pytest.mark.parametrize("num_skipped", [0, 12])
def test_progress_bar_and_times_fit_80_columns(num_skipped):
    config = dataclasses.replace(RunConfig(), total_steps=5_000_000)  # four digits of updates
    metrics = [{"success": 0.876, "skipped_steps": num_skipped}]
    output = io.StringIO()
    console = PlainConsole(file=output, force_terminal=True, width=80)
    with ProgressDisplay(config, 0, console) as progress:
        progress.stop_timing()
        progress.show_chunk({"baseline": metrics, "layout": metrics}, config.total_updates - config.chunk)

    last_line = Text.from_ansi(output.getvalue()).plain.strip().splitlines()[-1]
    description, bar, elapsed_time, remaining_time = last_line.rsplit(maxsplit=3)
    assert description.startswith(f"{config.total_updates - config.chunk}/{config.total_updates}")
    assert num_skipped or "layout 88 %" in description
    assert len(bar) >= 10
    assert (len(elapsed_time), len(remaining_time)) == (7, 7)


def test_success_is_undefined_before_an_episode_has_ended():
    config = RunConfig()
    output = io.StringIO()
    metrics = {
        "baseline": [{"success": math.nan, "skipped_steps": 0}, {"success": 0.5, "skipped_steps": 0}],
        "layout": [{"success": math.nan, "skipped_steps": 0}] * 2,
    }
    with ProgressDisplay(config, 0, PlainConsole(file=output, width=200)) as progress:
        progress.stop_timing()
        progress.show_chunk(metrics, config.total_updates)
    assert "training SR: baseline 50 %, layout undefined (no episode ended)" in output.getvalue()


def test_means_over_no_episode_are_undefined_in_the_log(tmp_path):
    """Means over episodes are kept, and losses are always defined."""
    means = {"success": 0.0, "return": 0.0, "length": 0.0, "truncated": 0.0}
    metrics = {"layout": [means | {"episodes": 0.0, "loss": 1.0}, means | {"episodes": 3.0, "loss": 2.0}]}
    rows = []
    for seed, seed_metrics in enumerate(mark_undefined_means(metrics)["layout"]):
        rows.append({"step": seed} | seed_metrics)
    append_log_rows(tmp_path / "metrics.jsonl", rows)
    assert read_log_rows(tmp_path / "metrics.jsonl") == [
        {"step": 0} | dict.fromkeys(means) | {"episodes": 0.0, "loss": 1.0},
        {"step": 1} | means | {"episodes": 3.0, "loss": 2.0},
    ]


def test_steps_beyond_the_requested_number_are_printed():
    chunk_steps = RunConfig().chunk * RunConfig().steps_per_update
    for total_steps, is_printed in ((chunk_steps, False), (chunk_steps - 1, False), (chunk_steps + 1, True)):
        config = dataclasses.replace(RunConfig(), total_steps=total_steps)
        output = io.StringIO()
        warn_if_more_steps(config, PlainConsole(file=output, width=200))
        printed = output.getvalue()
        assert bool(printed) == is_printed
        assert not is_printed or f"{2 * chunk_steps:,}" in printed
