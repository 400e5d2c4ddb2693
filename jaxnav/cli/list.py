"""The list command: print what jaxnav offers by name."""

import dataclasses
import json
from collections.abc import Callable
from typing import Annotated, Literal

import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from jaxnav.cli.console import make_result_console, parse_arguments, run_command
from jaxnav.registry import Entry, Kind, registered

DESCRIPTION = "List worlds, methods, policies, experiments, benchmarks, configurations and layout estimators by name."
#: Title of the table of each kind, and a command or call for which its names are.
_TITLES: dict[Kind, tuple[str, str]] = {
    "worlds": ("Generated worlds", "jaxnav train --world NAME, or jaxnav.make(NAME) in Python"),
    "methods": ("Methods", "jaxnav train --method NAME"),
    "policies": ("Packaged policies", "jaxnav sweep NAME, or jaxnav.load_policy(NAME) in Python"),
    "experiments": ("Experiments", "jaxnav study NAME"),
    "benchmarks": ("Frozen benchmarks", "jaxnav eval SUBJECT --benchmark NAME"),
    "configurations": ("Configurations of a training", "jaxnav train --config NAME --run-dir RUN"),
    "settings": ("Layout estimators and gaps for evaluations", "jaxnav eval RUN --setting NAME"),
}


@dataclasses.dataclass(frozen=True)
class ListConfig:
    """Options of the list command.

    Attributes:
      kind: list one kind only. The default is all kinds.
      format: `table` for the terminal, `json` for programs.
    """

    kind: Annotated[Kind | None, tyro.conf.Positional] = None
    format: Literal["table", "json"] = "table"


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return run_command(
        _print_list, lambda: parse_arguments(ListConfig, arguments, "jaxnav list", DESCRIPTION), compiles=False
    )


def _print_list(config: ListConfig, console: Console) -> None:
    """Print the entries as tables or as JSON."""
    entries_by_kind = registered(config.kind)
    if config.format == "json":
        print(json.dumps(entries_by_kind, indent=2))
        return

    result_console = make_result_console()
    for index, (kind, entries) in enumerate(entries_by_kind.items()):
        title, usage = _TITLES[kind]
        if index:
            result_console.print()
        result_console.print(f"{title}: {usage}", style="bold")
        result_console.print(_make_table(entries, _FORMATTERS.get(kind, {})))
        if kind in _NOTES:
            result_console.print(_NOTES[kind])


def _make_table(entries: list[Entry], formatters: dict[str, Callable[[Entry], str]]) -> Table:
    """Make a table of names, the columns of the formatters, and summaries, which may take several lines."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("Name", no_wrap=True)
    for column_title in formatters:
        table.add_column(column_title)
    table.add_column("Description")
    for entry in entries:
        cells = [format_cell(entry) for format_cell in formatters.values()]
        table.add_row(entry["name"], *cells, entry["summary"])
    return table


def _format_step_limit(entry: Entry) -> str:
    """Largest number of actions of an episode; living rooms may have more."""
    if entry["large_step_limit"] == entry["step_limit"]:
        return f"{entry['step_limit']}"
    return f"{entry['step_limit']} to {entry['large_step_limit']}"


def _format_hosts_layout(entry: Entry) -> str:
    """Whether the layout can enter; unknown for a method that cannot be imported."""
    return {True: "yes", False: "no", None: "?"}[entry["hosts_layout"]]


def _format_needs(entry: Entry) -> str:
    """Describe what an experiment needs: a finished run, or scene files and training."""
    if entry["needs_run"]:
        return "needs --run RUN"
    plural = "" if entry["runs"] == 1 else "s"
    training = f"trains: {entry['runs']} run{plural}, {entry['steps'] / 1e6:,.0f} M steps"
    if not entry["scene_files"]:
        return training
    return f"needs {', '.join(entry['scene_files'])}; {training}"


#: Lines below a table.
_NOTES: dict[Kind, str] = {
    "experiments": (
        "M steps: million environment steps of all policies. Finished runs and results are reused. `jaxnav scenes "
        "import` makes scene files."
    ),
}
#: Columns between name and description.
_FORMATTERS: dict[Kind, dict[str, Callable[[Entry], str]]] = {
    "worlds": {
        "Train": lambda entry: f"{entry['scenes']['train']}",
        "Val": lambda entry: f"{entry['scenes']['val']}",
        "Test": lambda entry: f"{entry['scenes']['test']}",
        "Categories": lambda entry: f"{entry['categories']}",
        "Goals": lambda entry: f"{entry['goals']}",
        "Step limit": _format_step_limit,
    },
    "methods": {"Layout": _format_hosts_layout},
    "experiments": {"Needs": _format_needs},
    "benchmarks": {"Tracks": lambda entry: ", ".join(entry["tracks"])},
    "policies": {
        "Method": lambda entry: f"{entry['method']}",
        "World": lambda entry: f"{entry['world']}",
    },
}
