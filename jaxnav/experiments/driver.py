"""The driver of all experiments: `run_experiment` trains and measures what is missing, and writes the pages.

`MEASUREMENTS` lists what an experiment can measure of an agent. Every part of a measurement (a layout shift, or a
decoding rule) has a file of results, so that an interrupted experiment goes on with the first part that is missing.
"""

import dataclasses
import glob
import shutil
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from jaxnav.errors import InputError
from jaxnav.evaluation.report import package_versions
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import (
    AgentRun,
    ExperimentConfig,
    check_experiment,
    digest_settings,
    evaluation_settings,
    join_folds,
    matches_any,
    measured_runs,
    part_settings,
)
from jaxnav.experiments.gap_traces import measure_gaps
from jaxnav.experiments.instrument import measure_instrument
from jaxnav.experiments.mixture import RemainingDecision, list_removal_names, measure_removals
from jaxnav.experiments.pages import check_page, render_page
from jaxnav.experiments.scores import measure_account, measure_evaluation, measure_frontier, measure_groups
from jaxnav.experiments.table import ResultRow, ResultTable, has_part, read_part, read_settings, write_part
from jaxnav.experiments.trials import measure_growth, measure_trials, measure_variants
from jaxnav.plain_console import to_plain_console
from jaxnav.store.files import list_differences


def _no_agents(config: ExperimentConfig, run: AgentRun) -> list[str]:
    """No agents: the measurement compares a run with nothing but itself."""
    return []


def _compared_agents(config: ExperimentConfig, run: AgentRun) -> list[str]:
    """Agents that an evaluation compares a run with."""
    return [reference.partition("/")[0] for reference in run.against]


def _grouped_agents(config: ExperimentConfig, run: AgentRun) -> list[str]:
    """Members and references of all groups."""
    agents = []
    for group in config.groups.values():
        agents += [*group["agents"], group["against"].rpartition("/")[0]]
    return agents


def _layout_blind_agent(config: ExperimentConfig, run: AgentRun) -> list[str]:
    """The layout-blind agents."""
    return [config.reference_agent]


def _no_settings(config: ExperimentConfig, run: AgentRun) -> dict[str, Any]:
    """No settings besides those of every measurement."""
    return {}


def _comparisons(config: ExperimentConfig, run: AgentRun) -> dict[str, Any]:
    """The agents to compare with."""
    return {"against": list(run.against)}


def _groups(config: ExperimentConfig, run: AgentRun) -> dict[str, Any]:
    """The groups of agents."""
    return {"groups": config.groups}


def _selected_removals(config: ExperimentConfig, run: AgentRun) -> dict[str, Any]:
    """The removals, unless all are compared."""
    return {} if config.removals == ("*",) else {"removals": list(config.removals)}


class Measurement(NamedTuple):
    """Something that an experiment measures of an agent.

    Attributes:
      measure: called with the bench and the run, and with a shift or a decoding if `parts` names either.
      parts: setting of the experiment whose values are measured in parts of their own.
      references: names of the agents that a run is compared with.
      own_settings: settings that determine the results of this measurement alone.
      compares_shifts: True if it compares layout shifts, and so needs several.
      compares_removals: True if it compares removals: `removals` selects some, and the folds of a dataset are evaluated
        together.
    """

    measure: Callable[..., Iterator[ResultRow]]
    parts: str | None = None
    references: Callable[[ExperimentConfig, AgentRun], list[str]] = _no_agents
    own_settings: Callable[[ExperimentConfig, AgentRun], dict[str, Any]] = _no_settings
    compares_shifts: bool = False
    compares_removals: bool = False


def _removal_measurement(remaining: RemainingDecision) -> Measurement:
    """A measurement that compares removals, each of which leaves the same decision."""
    return Measurement(
        partial(measure_removals, remaining=remaining),
        parts="decodings",
        references=_layout_blind_agent,
        own_settings=_selected_removals,
        compares_shifts=True,
        compares_removals=True,
    )


MEASUREMENTS = {
    "evaluation": Measurement(measure_evaluation, references=_compared_agents, own_settings=_comparisons),
    "frontier": Measurement(measure_frontier),
    "groups": Measurement(measure_groups, references=_grouped_agents, own_settings=_groups),
    "account": Measurement(measure_account, references=_layout_blind_agent),
    "trials": Measurement(measure_trials, parts="shifts"),
    "variants": Measurement(measure_variants, parts="shifts"),
    "growth": Measurement(measure_growth, compares_shifts=True),
    "instrument": Measurement(measure_instrument, references=_layout_blind_agent, compares_shifts=True),
    "gaps": Measurement(measure_gaps, compares_shifts=True),
    "mixture": _removal_measurement("own"),
    "handover": _removal_measurement("layout-blind"),
    "cde": _removal_measurement("without experience"),
}


class Part(NamedTuple):
    """One file of results.

    Attributes:
      name: name of the file, without its ending.
      settings: settings that determine the results.
      measure: trains what is missing, and measures.
    """

    name: str
    settings: dict
    measure: Callable[[], Iterator[ResultRow]]


def check_measurements(config: ExperimentConfig) -> ExperimentConfig:
    """Return an experiment completed by `check_experiment`, if its measurements are possible too.

    Raises:
      InputError: names the first invalid setting.
    """
    unknown_names = sorted(set(config.measure) - set(MEASUREMENTS))
    if unknown_names:
        raise InputError(f"measure: {unknown_names[0]!r} is unknown; choose from {', '.join(MEASUREMENTS)}")
    for name in config.measure:
        if MEASUREMENTS[name].compares_shifts and len(config.shifts) < 2:
            raise InputError(f"shifts: {config.shifts}: give two or more, which the measurement {name} compares")
    removal_names = list_removal_names()
    for pattern in config.removals:
        if not any(matches_any(name, (pattern,)) for name in removal_names):
            raise InputError(f"removals: {pattern!r} matches none; choose from {'; '.join(removal_names)}")
    return check_experiment(config)


def run_experiment(config: ExperimentConfig, console: Console) -> list[str]:
    """Measure what is missing, and write the pages.

    Finished runs and results are reused, so an interrupted experiment goes on where it stopped. The pages are rewritten
    after every part, from the files of results alone.

    Args:
      config: the experiment; see `check_measurements`.
      console: prints progress.

    Returns:
      The text of each page.

    Raises:
      InputError: a document is not a page of an experiment, a run is impossible, or a file of results belongs to other
        settings.
    """
    console = to_plain_console(console)

    # Fail early: a page that cannot be written, or results that would be lost, would waste the measurements.
    for document, template in config.pages.items():
        check_page(Path(document), template)
    folder = config.results / config.split
    bench = Bench(config, console)
    parts = list_parts(config, bench)
    missing_parts = [part for part in parts if not _is_finished(folder, part)]
    # Pages show all agents, and tell what is missing of those that `only` leaves out, too.
    all_parts = list_parts(dataclasses.replace(config, only=("*",)), bench)

    # Pages are written again after every part. Only the last ones must be without faults.
    for part in missing_parts:
        path = folder / f"{part.name}.jsonl"
        console.print(f"{path}")
        # Outcomes of a part that was interrupted are kept until the part is finished, for the same versions.
        part_digest = digest_settings(part.settings | {"versions": package_versions()})
        bench.unfinished_folder = folder / f"{part.name}-{part_digest}.unfinished"
        write_part(path, part.settings, part.measure())
        for unfinished_folder in folder.glob(f"{glob.escape(part.name)}-*.unfinished"):
            shutil.rmtree(unfinished_folder, ignore_errors=True)
        try:
            write_pages(config, all_parts)
        except InputError as error:
            console.print(f"warning: {error}", style="yellow")

    num_reused = len(parts) - len(missing_parts)
    if num_reused:
        console.print(f"{num_reused} results in {folder} were there already; give another --results to measure again")
    texts = write_pages(config, all_parts)
    for document in config.pages:
        console.print(f"written to {document}")
    return texts


def _is_finished(folder: Path, part: Part) -> bool:
    """True if the results of a part exist.

    Raises:
      InputError: the file holds results of other settings, which must not be lost.
    """
    path = folder / f"{part.name}.jsonl"
    settings = read_settings(path)
    if settings is None or settings == part.settings:
        return settings is not None
    differences = "; ".join(list_differences(settings, part.settings))
    raise InputError(f"{path}: holds results of other settings ({differences}); delete it or give another --results")


def list_parts(config: ExperimentConfig, bench: Bench) -> list[Part]:
    """List the files of results of an experiment, in the order in which they are measured."""
    parts = []
    for name, measurement in MEASUREMENTS.items():
        runs = measured_runs(config, name) if name in config.measure else []
        if measurement.compares_removals:
            runs = join_folds(config, runs)
        for run in runs:
            references = []
            for fold_run in run.fold_runs:
                references += [bench.find_run(fold_run.world, agent) for agent in measurement.references(config, run)]
            settings = part_settings(config, run, [reference for reference in references if reference is not None])
            settings |= measurement.own_settings(config, run)
            measure = partial(measurement.measure, bench, run)
            if measurement.parts is None:
                parts.append(Part(f"{run.name}-{name}", settings, measure))
                continue
            for value in getattr(config, measurement.parts):
                value_name = f"{value:g}" if isinstance(value, float) else value
                part_name = f"{run.name}-{name}-{value_name}"
                parts.append(Part(part_name, settings | {measurement.parts: [value]}, partial(measure, value)))
    return parts


def write_pages(config: ExperimentConfig, parts: list[Part]) -> list[str]:
    """Write every page from the results that exist, and return their texts."""
    folder = config.results / config.split
    missing = [part.name for part in parts if not has_part(folder / f"{part.name}.jsonl", part.settings)]
    tables = load_results(config, missing)
    texts = []
    for document, template in config.pages.items():
        texts.append(render_page(Path(document), template, config, tables, missing))
    return texts


def load_results(config: ExperimentConfig, missing: Collection[str] = ()) -> dict[str, ResultTable]:
    """Load the results of an experiment on every split that has any.

    Results of other evaluation settings are ignored. Experiments may share a folder, and then a table.

    Args:
      config: the experiment.
      missing: names of parts of its split that are still to be measured, although there may be a file: a damaged one,
        or one of another run.

    Raises:
      InputError: another file is damaged.
    """
    tables = {}
    for split in ("train", "val", "test"):
        settings = evaluation_settings(config) | {"split": split, "shift_by": config.shift_by}
        for name in ("shifts", "decodings", "steps"):
            del settings[name]  # every part has its own
        rows: list[ResultRow] = []
        for path in sorted((config.results / split).glob("*.jsonl")):
            if split != config.split or path.stem not in missing:
                rows += read_part(path, settings)
        if rows:
            tables[split] = ResultTable(rows)
    return tables
