"""The train command: train a method, then draw its learning curves."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from jaxnav.cli.console import make_options_class, parse_config, run_command
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig, fill_world_defaults
from jaxnav.scenes.worlds import WORLDS

if TYPE_CHECKING:
    from jaxnav.runs.run import Run

#: File of the learning curves in a run directory.
LEARNING_CURVES_FILE = "learning.png"

Options = make_options_class(RunConfig)
DESCRIPTION = (
    "Train policies of a method, without and with layout weights. The help shows the defaults of the world and of the "
    "configuration that you give with it: jaxnav train --world houses --help."
)


def main(arguments: list[str] | None = None, prog: str = "jaxnav train") -> int:
    """Run the command and return its exit code."""
    return run_command(
        _train, lambda: parse_config(RunConfig(), arguments, prog, DESCRIPTION, complete_help=_complete_help)
    )


def _complete_help(config: RunConfig, arguments: Sequence[str]) -> RunConfig:
    """Return the settings with the defaults of the world, which the command line may give."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--world", nargs="?", default=config.world)
    world = parser.parse_known_args(arguments)[0].world
    if world in WORLDS:
        config = dataclasses.replace(config, world=world)
    return fill_world_defaults(config)


def _train(config: RunConfig, console: Console) -> None:
    """Train, and draw the learning curves."""
    from jaxnav.runs.train import train
    from jaxnav.training.devices import run_on_first_process

    run = train(config, console)
    run_on_first_process(lambda: _draw_learning_curves(run, console))


def _draw_learning_curves(run: "Run", console: Console) -> None:
    """Draw the learning curves if the plotting packages are installed; a policy that was fitted has none."""
    if not run.log():
        return
    from jaxnav.viz import require_plotting_packages

    try:
        require_plotting_packages()
    except InputError as error:
        console.print(f"learning curves are not drawn: {error}")
        return

    # Import only now: the plotting packages are optional.
    from jaxnav.policies.methods import method_label
    from jaxnav.viz.learning import learning_figure
    from jaxnav.viz.style import save_figure

    config = run.config
    scenes_name = Path(config.scene_source).name
    plural = "s" if config.seeds > 1 else ""
    title = f"{method_label(config.method)} in {scenes_name}, {config.seeds} seed{plural}"
    path = config.run_dir / LEARNING_CURVES_FILE
    save_figure(learning_figure(run.log(), run.success_by_budget(), title), path)
    console.print(f"learning curves: {path}")
