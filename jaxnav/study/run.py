"""The whole study: `run_study` trains the runs, measures the results, and writes figures and document."""

from collections.abc import Callable
from functools import partial

from rich.console import Console

from jaxnav.study.config import UNAWARE_RUN, StudyConfig, ensure_trained, study_identity, study_run_configs
from jaxnav.study.document import check_document, write_study_document
from jaxnav.study.gap_traces import measure_gap_curves
from jaxnav.study.instrument import measure_instrument, study_instrument_config
from jaxnav.study.measure import DECODINGS, TrialRunner, best_val_epsilon, measure_condition
from jaxnav.study.mixture import measure_mixture
from jaxnav.study.results import (
    STUDY_WORLDS,
    StudyRecord,
    condition_name,
    has_record,
    mixture_name,
    reuse_note,
    write_record,
)
from jaxnav.viz import require_plotting_packages

#: Runs that are evaluated with all trials.
RUNS_WITH_ALL_TRIALS = ("main", "goal", "real")
#: Runs whose experience is accounted for, against agents without experience.
ACCOUNTED_RUNS = ("main", "streams")


def run_study(config: StudyConfig, console: Console) -> None:
    """Train and measure everything that is missing, then write figures and document.

    Finished runs and results are reused, so an interrupted study continues where it stopped.

    Raises:
      InputError: the plotting packages are missing, the document is not a study document, epsilon was not chosen on
        `val`, or a run is invalid.
    """
    # Fail early: plotting packages, the document, and the epsilon for `test`.
    require_plotting_packages()
    from jaxnav.study.figures import draw_study_figures

    check_document(config.document)
    if config.split == "test":
        best_val_epsilon(config)  # raises if the study has not been done on `val`

    # Train everything first: later parts compare runs with each other.
    runs = study_run_configs(config)
    for run in runs.values():
        ensure_trained(run, console)

    # A stored result is reused if it was measured with the same settings.
    results_folder = config.results / config.split
    study_settings = study_identity(config)
    runner = TrialRunner(config)
    reused_names: list[str] = []

    def write_if_missing(name: str, measure: Callable[[], StudyRecord]) -> None:
        path = results_folder / f"{name}.json"
        if has_record(path, study_settings):
            reused_names.append(name)
        else:
            console.print(f"{path}")
            write_record(path, study_settings, measure())

    for name, run in runs.items():
        # Agents without experience serve as a reference of other runs.
        if name == UNAWARE_RUN:
            continue

        # Trials at every shift.
        for shift in config.shifts:
            all_trials = name in RUNS_WITH_ALL_TRIALS
            measure = partial(measure_condition, run, all_trials, shift, runner, console)
            write_if_missing(condition_name(name, shift), measure)

        # Instrument and gap curves, once for each world.
        if name in STUDY_WORLDS:
            has_unaware_run = name == "main" and UNAWARE_RUN in runs
            unaware_folder = runs[UNAWARE_RUN].run_dir if has_unaware_run else None
            instrument_config = study_instrument_config(config, run, unaware_folder)
            write_if_missing(f"instrument-{name}", partial(measure_instrument, instrument_config, run, console))
            write_if_missing(f"gap-{name}", partial(measure_gap_curves, run, config, console))

        # Accounting of experience in a mixed population.
        if name in ACCOUNTED_RUNS and UNAWARE_RUN in runs:
            for decoding in DECODINGS:
                measure = partial(measure_mixture, run, runs[UNAWARE_RUN], decoding, runner, console)
                write_if_missing(mixture_name(name, decoding), measure)

    # Figures show `val` only; the document covers every split that has results.
    if config.split == "val":
        draw_study_figures(results_folder, config.document.parent / "images" / "study")
    write_study_document(config.results, config.document)
    if reused_names:
        console.print(reuse_note(len(reused_names), results_folder))
    console.print(f"written to {config.document}")
