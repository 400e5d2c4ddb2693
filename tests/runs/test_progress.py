"""What a training run prints about its progress and its length."""

import dataclasses
import io

import pytest
from rich.console import Console
from rich.text import Text

from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import ProgressDisplay, warn_if_more_steps


@pytest.mark.parametrize("num_skipped", [0, 12])
def test_bar_and_both_times_fit_80_columns(num_skipped):
    config = dataclasses.replace(RunConfig(), total_steps=5_000_000)  # four digits of updates
    metrics = [{"success": 0.876, "skipped_steps": num_skipped}]
    output = io.StringIO()
    console = Console(file=output, force_terminal=True, width=80)
    with ProgressDisplay(config, 0, console) as progress:
        progress.stop_timing()
        progress.show_chunk({"baseline": metrics, "layout": metrics}, config.total_updates - config.chunk)

    last_line = Text.from_ansi(output.getvalue()).plain.strip().splitlines()[-1]
    words, bar, elapsed, remaining = last_line.rsplit(maxsplit=3)
    assert words.startswith(f"{config.total_updates - config.chunk}/{config.total_updates}")
    assert num_skipped or "layout 88 %" in words
    assert len(bar) >= 10
    assert [len(cell) for cell in (elapsed, remaining)] == [7, 7]


def test_steps_beyond_those_asked_for_are_printed():
    chunk_steps = RunConfig().chunk * RunConfig().steps_per_update
    for total_steps, is_printed in ((chunk_steps, False), (chunk_steps - 1, False), (chunk_steps + 1, True)):
        output = io.StringIO()
        warn_if_more_steps(dataclasses.replace(RunConfig(), total_steps=total_steps), Console(file=output, width=200))
        printed = output.getvalue()
        assert bool(printed) == is_printed
        assert not is_printed or f"{2 * chunk_steps:,}" in printed
