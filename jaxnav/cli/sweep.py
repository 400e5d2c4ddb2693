"""The sweep command: evaluate sTDE at many thresholds in one compiled call; prints tables, draws them, writes them."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console

from jaxnav.choices import Decoding, EstimatorName, Form, ShiftKind, Split, WorldName
from jaxnav.cli.console import (
    make_result_console,
    name_evaluation,
    name_numbers,
    name_path,
    parse_arguments,
    print_table,
    refuse_folder,
    refuse_unwritable,
    run_command,
    write_latest,
)
from jaxnav.errors import InputError
from jaxnav.plain_console import escape_control_chars
from jaxnav.progress import show_activity
from jaxnav.store.files import expand_home

if TYPE_CHECKING:
    from jaxnav.evaluation.sweep_tables import ThresholdRow
    from jaxnav.runs.sweep import Sweep

DESCRIPTION = "Evaluate sTDE at many thresholds, for all seeds in one compiled call, and draw the result."
#: Version of the JSON layout.
_FORMAT = 1


@dataclasses.dataclass(frozen=True)
class SweepConfig:
    """Options of the sweep command.

    Attributes:
      source: a run directory, of which all seeds of the arm `layout` are evaluated; or one policy, as the folder of an
        export or the name of a packaged policy, such as `rooms-org`.
      epsilon: thresholds of sTDE, at least 0. Experience is removed where the layout gap exceeds the threshold; for
        thresholds of 1 and more nothing is removed.
      shift: layout shifts of the scenes, from 0 (as in training) to 1; each gets a section of the table and a curve.
      shift_by: categories that exchange their places under a shift. `size`: neighbours in size, drawn for each scene.
        `context`: the ones whose exchange misleads most, fitted to the training scenes and equal in all scenes.
      split: scenes to evaluate on.
      scenes: scene file to use instead of the scenes of the run or policy.
      world: generated world to use instead of the scenes of the run or policy.
      episodes: number of fixed episodes, at least 1, balanced over room types and scenes.
      decoding: `argmax` for best actions (the largest logit), `sample` for sampled actions.
      form: rule by which sTDE removes experience. `paper` subtracts from the logits of the policy a share of the logits
        with scene and goal set to zero; the share is the excess of the layout gap over the threshold. `residual` does
        this without changing the scale of the logits. `switch` subtracts these logits completely where the gap exceeds
        the threshold. `mixture` mixes the probabilities of the decisions with and without experience, with the same
        share. The default is `residual` (`paper` for the method `belief`), unless the layout estimator sets another.
      setting: layout estimator or layout gap to use instead of that of the run or policy, for example `learned`, a gap
        that detects another layout; `jaxnav list settings` describes all.
      hold: keep the gap from falling within an episode. With `--form switch`, experience then stays removed for the
        rest of the episode once the gap exceeds the threshold.
      seed: random seed of the episode list and of sampled actions, from 0 to 4,294,967,295.
      out: PNG to write the figure to; the numbers are written next to it as JSON. The default is a name
        after the options, such as `sweep-val-seed3.png`, in the run directory or, for a policy, in the working
        directory, where `latest-sweep.txt` names the newest sweep.
      format: format of the printed table.
    """

    source: str
    epsilon: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    shift: tuple[float, ...] = (0.0, 1.0)
    shift_by: ShiftKind = "size"
    split: Split = "val"
    scenes: Path | None = None
    world: WorldName | None = None
    episodes: int = 1000
    decoding: Decoding = "argmax"
    form: Form | None = None
    setting: EstimatorName | None = None
    hold: bool = False
    seed: int = 0
    out: Path | None = None
    format: Literal["table", "markdown"] = "table"


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(_run_sweep, lambda: parse_arguments(SweepConfig, arguments, "jaxnav sweep", DESCRIPTION))


def _run_sweep(config: SweepConfig, console: Console) -> None:
    """Evaluate, print the tables and write the files."""
    from jaxnav.runs.sweep import sweep_shifts

    # Check the options before anything is evaluated: an evaluation takes minutes.
    if not config.shift:
        raise InputError("--shift: give at least one number")
    figure_path = _find_figure_path(config)
    numbers_path = figure_path.with_suffix(".json")

    results = sweep_shifts(
        config.source,
        config.epsilon,
        config.shift,
        split=config.split,
        scenes=config.scenes,
        world=config.world,
        shift_by=config.shift_by,
        episodes=config.episodes,
        decoding=config.decoding,
        form=config.form,
        setting=config.setting,
        hold=config.hold,
        seed=config.seed,
        console=console,
    )
    rows = [row for result in results for row in result.rows()]

    # Write the numbers first, so that nothing is lost if the reader of a pipe ends or drawing fails.
    try:
        with refuse_unwritable(numbers_path, "--out"):
            _write_numbers(results, rows, numbers_path)
            if config.out is None:
                write_latest("sweep", numbers_path)
    finally:
        _print_tables(rows, results[0].notes(), config.format)
    compilations = sum(result.compilations for result in results)
    plural = "" if compilations == 1 else "s"
    console.print(f"{compilations} compilation{plural} for all thresholds, seeds and shifts")
    console.print(f"numbers: {numbers_path}")
    with refuse_unwritable(figure_path, "--out"):
        _draw_figure(results, figure_path, console)


def _find_figure_path(config: SweepConfig) -> Path:
    """Return the path of the figure, or raise an `InputError` if it cannot be written."""
    from jaxnav.runs.policies import is_policy

    # A policy is not in a run directory, so its name belongs to the file.
    is_single_policy = is_policy(config.source)
    folder = Path() if is_single_policy else expand_home(config.source)
    command = "sweep"
    if is_single_policy:
        source_path = expand_home(config.source)
        command = f"sweep-{name_path(source_path) if source_path.exists() else config.source}"

    details = (
        None if config.shift == SweepConfig.shift else name_numbers("shift", config.shift),
        None if config.shift_by == SweepConfig.shift_by else f"by-{config.shift_by}",
        None if config.episodes == SweepConfig.episodes else f"episodes{config.episodes}",
        None if config.epsilon == SweepConfig.epsilon else name_numbers("epsilon", config.epsilon),
        config.form,
        None if config.setting is None else f"setting-{config.setting}",
        "hold" if config.hold else None,
        "sampled" if config.decoding == "sample" else None,
        None if config.seed == SweepConfig.seed else f"seed{config.seed}",
    )
    name = name_evaluation(command, config.split, config.world, config.scenes, *details)

    path = config.out or folder / f"{name}.png"
    if path.suffix != ".png":
        raise InputError(f"--out {path}: give a name that ends in .png")
    refuse_folder(path, "--out")
    return path


def _print_tables(rows: "list[ThresholdRow]", notes: list[str], table_format: str) -> None:
    """Print the rows and notes on stdout."""
    from jaxnav.evaluation.sweep_tables import sweep_markdown, sweep_table

    if table_format == "markdown":
        print(escape_control_chars(sweep_markdown(rows, notes), keep="\n"), end="")
        return
    result_console = make_result_console()
    print_table(result_console, sweep_table(rows))
    for note in notes:
        result_console.print(note)


def _write_numbers(results: "list[Sweep]", rows: "list[ThresholdRow]", path: Path) -> None:
    """Write settings and rows as JSON."""
    from jaxnav.evaluation.report import package_versions
    from jaxnav.store.files import write_atomic

    # The settings of all shifts are equal but for the shift, which stands in the rows.
    settings = {name: value for name, value in results[0].settings.items() if name != "shift"}
    numbers: dict[str, Any] = {
        "settings": settings,
        "rows": [row.to_json() for row in rows],
        "notes": results[0].notes(),
        "compilations": sum(result.compilations for result in results),
        "versions": package_versions(),
        "format": _FORMAT,
    }
    write_atomic(path, (json.dumps(numbers, indent=2, allow_nan=False) + "\n").encode())


def _draw_figure(results: "list[Sweep]", path: Path, console: Console) -> None:
    """Draw the figure if the plotting packages are installed."""
    from jaxnav.viz import require_plotting_packages

    try:
        require_plotting_packages()
    except InputError as error:
        console.print(f"no figure: {error}")
        return

    from jaxnav.viz.style import save_figure
    from jaxnav.viz.sweep import sweep_figure

    with show_activity(console, "drawing the figure"):
        save_figure(sweep_figure(results), path)
    console.print(f"figure: {path}")
