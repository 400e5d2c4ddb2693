"""The study command: train every run, put the paper's claims to the test, and write results, figures and a document."""

import dataclasses
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxnav.cli.console import exit_code
from jaxnav.cli.instrument import instrument_report, of_study
from jaxnav.evaluation.report import FORMAT, versions
from jaxnav.store.files import write_atomic
from jaxnav.study.config import StudyConfig, ensure, parse_study, training
from jaxnav.study.document import check_document, write_document
from jaxnav.study.measure import Bench, chosen, gaps, table
from jaxnav.study.results import draw

#: Runs that have every trial, and those whose worlds are proved as instruments and whose gaps are followed.
FULL, PROVED = ("main", "goal", "real"), ("main", "real")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    return exit_code(lambda console: study(parse_study(arguments), console))


def study(config: StudyConfig, console: Console) -> None:
    """Run whatever of the study is missing, then draw its figures and write its document."""
    check_document(config.document)
    if config.split == "test":
        chosen(config)  # val comes first
    names = list(dict.fromkeys(("main", *config.trainings, *(("real",) if config.real else ()))))
    runs = {name: training(config, name) for name in names}
    for run in runs.values():
        ensure(run, console)
    folder = config.results / config.split
    about = {"study": plain(config), "versions": versions(), "format": FORMAT}

    def part(name: str, make: Callable[[], dict[str, Any]]) -> None:
        path = folder / f"{name}.json"
        if finished(path, about["study"]):
            return
        console.print(f"{path}")
        write_atomic(path, (json.dumps(rounded(about | make()), allow_nan=False) + "\n").encode())

    bench = Bench(config)
    for name, run in runs.items():
        for shift in config.shifts:
            part(f"{name}-shift{shift:g}", partial(table, run, name in FULL, shift, bench, console))
        if name in PROVED:
            part(f"instrument-{name}", partial(instrument_report, of_study(config, run), run, console))
            part(f"gap-{name}", partial(gaps, run, config, console))
    if config.split == "val":
        draw(folder, config.document.parent / "images" / "study")
    write_document(config.results, config.document)
    console.print(f"written to {config.document}")


def finished(path: Path, study: dict[str, Any]) -> bool:
    """Whether a part of this very study is there; a damaged file is not, and is made anew."""
    try:
        return json.loads(path.read_text())["study"] == study
    except (FileNotFoundError, ValueError, KeyError):
        return False


def plain(config: StudyConfig) -> dict[str, Any]:
    """What makes a part of the study what it is, as JSON: not which other parts there are, nor where files are."""
    settings = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    for name in ("results", "document", "runs", "split", "trainings", "real"):
        settings.pop(name)
    for name in ("run_dir", "save_every", "cache", "devices"):
        settings["base"].pop(name)
    return settings


def rounded(value: Any) -> Any:
    """JSON with numbers of six digits: what is behind them is no result."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
