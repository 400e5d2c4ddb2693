"""The whole study: training, results, figures and document."""

from collections.abc import Callable
from functools import partial

from rich.console import Console

from jaxnav.study.bench import Bench
from jaxnav.study.config import WITHOUT, StudyConfig, study_identity
from jaxnav.study.document import check_document, write_document
from jaxnav.study.gap_course import gap_course
from jaxnav.study.instrument import instrument_report, study_instrument
from jaxnav.study.measure import DECODINGS, chosen_epsilon, measure_condition
from jaxnav.study.mixture import measure_mixture
from jaxnav.study.results import WORLDS, Record, condition_name, is_written, kept_note, mixture_name, write_record
from jaxnav.study.runs import ensure_trained, study_runs
from jaxnav.viz import require_pictures

#: Runs that have every trial.
FULL = ("main", "goal", "real")
#: Runs whose experience is accounted for, beside agents without any.
ACCOUNTED = ("main", "streams")


def run_study(config: StudyConfig, console: Console) -> None:
    """Run what is missing, then write figures and document.

    Finished runs and results are kept, so an interrupted study goes on where it stopped.

    Raises:
      InputError: what draws is not installed, the document is another one, epsilon was not chosen on `val`, or a run
        is impossible.
    """
    require_pictures()
    from jaxnav.study.draw import draw_figures

    check_document(config.document)
    if config.split == "test":
        chosen_epsilon(config)  # refuses where val is missing
    runs = study_runs(config)
    for run in runs.values():
        ensure_trained(run, console)
    folder, study, bench = config.results / config.split, study_identity(config), Bench(config)
    kept: list[str] = []

    def write(name: str, measure: Callable[[], Record]) -> None:
        path = folder / f"{name}.json"
        if is_written(path, study):
            kept.append(name)
        else:
            console.print(f"{path}")
            write_record(path, study, measure())

    for name, run in runs.items():
        if name == WITHOUT:
            continue
        for shift in config.shifts:
            write(condition_name(name, shift), partial(measure_condition, run, name in FULL, shift, bench, console))
        if name in WORLDS:
            without = runs[WITHOUT].run_dir if name == "main" and WITHOUT in runs else None
            instrument = study_instrument(config, run, without)
            write(f"instrument-{name}", partial(instrument_report, instrument, run, console))
            write(f"gap-{name}", partial(gap_course, run, config, console))
        if name in ACCOUNTED and WITHOUT in runs:
            for decoding in DECODINGS:
                mixed = partial(measure_mixture, run, runs[WITHOUT], decoding, bench, console)
                write(mixture_name(name, decoding), mixed)
    if config.split == "val":
        draw_figures(folder, config.document.parent / "images" / "study")
    write_document(config.results, config.document)
    if kept:
        console.print(kept_note(len(kept), folder))
    console.print(f"written to {config.document}")
