"""The train command: train a method, then draw its learning curves."""

from pathlib import Path

from rich.console import Console

from jaxnav.cli.console import parse_config, run_command
from jaxnav.errors import InputError
from jaxnav.policies.methods import method_label
from jaxnav.runs.config import RunConfig
from jaxnav.runs.run import Run
from jaxnav.runs.train import train
from jaxnav.training.devices import run_on_first_process

#: File of the learning curves in a run directory.
LEARNING_CURVES_FILE = "learning.png"


def main(arguments: list[str] | None = None, prog: str = "jaxnav train") -> int:
    """Run the command and return its exit code."""
    description = "Train a method with and without the layout estimator."

    def command(console: Console) -> None:
        run = train(parse_config(RunConfig(), arguments, prog, description), console)
        run_on_first_process(lambda: _draw_learning_curves(run, console))

    return run_command(command)


def _draw_learning_curves(run: Run, console: Console) -> None:
    """Draw the learning curves if the plotting packages are installed."""
    from jaxnav.viz import require_plotting_packages

    try:
        require_plotting_packages()
    except InputError as error:
        console.print(f"no learning curves: {error}")
        return

    # Import only now: the plotting packages are optional.
    from jaxnav.viz.learning import learning_figure
    from jaxnav.viz.style import save_figure

    config = run.config
    scenes_name = Path(config.scene_source).name
    plural = "s" if config.seeds > 1 else ""
    title = f"{method_label(config.method)} in {scenes_name}, {config.seeds} seed{plural}"
    path = config.run_dir / LEARNING_CURVES_FILE
    save_figure(learning_figure(run.log(), run.success_by_budget(), title), path)
    console.print(f"learning curves: {path}")
