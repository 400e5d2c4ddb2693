"""The training command."""

from pathlib import Path

from rich.console import Console

from jaxnav.cli.console import exit_code
from jaxnav.cli.options import parse
from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import Run
from jaxnav.runs.train import train
from jaxnav.training.devices import by_first_process

#: File in a run directory: the learning curves.
LEARNING = "learning.png"


def main(arguments: list[str] | None = None, prog: str = "jaxnav train") -> int:
    """Run the command and return its exit code."""
    what = "Train a method with and without the layout estimator."

    def command(console: Console) -> None:
        run = train(parse(RunConfig(), arguments, prog, what), console)
        by_first_process(lambda: _draw(run, console))

    return exit_code(command)


def _draw(run: Run, console: Console) -> None:
    """Draw the learning curves, where what draws is installed."""
    from jaxnav.viz import require_pictures

    try:
        require_pictures()
    except InputError as error:
        console.print(f"no learning curves: {error}")
        return
    from jaxnav.viz.figure import save_figure
    from jaxnav.viz.learning import learning_figure

    config, path = run.config, run.config.run_dir / LEARNING
    title = f"{config.method.upper()} in {Path(config.source).name}, {config.seeds} seed{'s' * (config.seeds > 1)}"
    save_figure(learning_figure(run.log(), run.reach(), title), path)
    console.print(f"learning curves: {path}")
