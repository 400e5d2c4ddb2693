"""The eval command: evaluate a run; prints a table and writes it as JSON, with a row per episode."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jaxnav.causal import Form
from jaxnav.cli.console import make_result_console, parse_arguments, refuse_unwritable, run_command
from jaxnav.errors import InputError
from jaxnav.evaluation.report import difference_table, results_table
from jaxnav.runs.evaluate import evaluate
from jaxnav.runs.policies import EstimatorName
from jaxnav.runs.run import Run


@dataclasses.dataclass(frozen=True)
class EvalConfig:
    """Configure an evaluation of a training run.

    Attributes:
      run: the run directory.
      split: scenes to evaluate on.
      scenes: scene file to read instead of the run's own world or file.
      world: generated world instead, for a policy that was trained in scenes of a file; categories and rules stay the
        run's.
      shift: layout shift, from 0 to 1: the share of the categories that exchange their places; default: the run's, and
        0 with `--scenes` or `--world`.
      episodes: in the fixed list, balanced over room types and scenes; where scenes are streamed equally many in every
        shard, and balanced there.
      epsilon: thresholds of sTDE; all of them in one compiled call.
      form: how sTDE combines the logits; default: the run's layout setting's.
      setting: layout estimator to use instead of the run's: `paper` and `released` change the layout's weights too,
        the others measure the gap in another way; see docs/methods.md.
      hold: the gap never falls within an episode; with `--form switch` experience is then out for good.
      inner_steps: by which a method that learns within an episode may adapt, 0 for none; default: its usual number.
      seed: of the episode list and the sampled actions.
      json: where to write the table; default: in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    split: Literal["train", "val", "test"] = "val"
    scenes: Path | None = None
    world: Literal["rooms", "apartments", "houses"] | None = None
    shift: float | None = None
    episodes: int = 1000
    epsilon: tuple[float, ...] = (0.5,)
    form: tuple[Form, ...] | None = None
    setting: EstimatorName | None = None
    hold: bool = False
    inner_steps: int | None = None
    seed: int = 0
    json: Path | None = None


def main(arguments: list[str] | None = None, prog: str = "jaxnav eval") -> int:
    """Run the command and return its exit code."""
    config = parse_arguments(EvalConfig, arguments, prog, "Evaluate a training run.")
    return run_command(lambda console: _print_evaluation(config, console, make_result_console()))


def _print_evaluation(config: EvalConfig, console: Console, result_console: Console) -> None:
    """Evaluate a run, print the table and write the files."""
    # Find the file first: an evaluation takes minutes.
    target = _find_target(config)
    results = evaluate(
        Run.open(config.run),
        split=config.split,
        scenes=config.scenes,
        world=config.world,
        shift=config.shift,
        episodes=config.episodes,
        epsilon=config.epsilon,
        form=config.form,
        setting=config.setting,
        hold=config.hold,
        inner_steps=config.inner_steps,
        seed=config.seed,
        console=console,
    )

    # Print the table, the paired differences and the notes.
    result_console.print(results_table(results.report))
    if results.report["differences"]:
        result_console.print(difference_table(results.report))
    for note in results.report["notes"]:
        result_console.print(note)

    with refuse_unwritable(target, "--json"):
        results.write(target)
    compilations = results.report["compilations"]
    console.print(f"{len(results.episodes.goal)} episodes, {compilations} compilation; written to {target}")


def _find_target(config: EvalConfig) -> Path:
    """Return the JSON file to write, or raise an `InputError` before anything is evaluated."""
    # The default name lists every option that changes the results.
    parts = ["eval"]
    if config.world:
        parts.append(config.world)
    elif config.scenes:
        parts.append(f"scenes-{config.scenes.name.split('.')[0]}")  # never the name of a world
    parts.append(config.split)
    if config.shift is not None:
        parts.append(f"shift{config.shift:g}")
    if config.setting is not None:
        parts.append(config.setting)
    if config.inner_steps is not None:
        parts.append(f"inner{config.inner_steps}")

    target = config.json or config.run / f"{'-'.join(parts)}.json"
    if target.is_dir() or not target.name or (target.parent.exists() and not target.parent.is_dir()):
        raise InputError(f"--json {target}: is a folder or lies in a file; give the name of a file to write")
    return target
