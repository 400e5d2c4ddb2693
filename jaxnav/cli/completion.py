"""The completion command: print a script that completes commands and options in a shell."""

import contextlib
import dataclasses
import io
import textwrap
from typing import Annotated, Any, Literal, Union, get_args, get_type_hints

import tyro
from rich.console import Console
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructTypeInfo

from jaxnav.cli.console import REGISTRY, describe_fields, parse_arguments, run_command

Shell = Literal["bash", "zsh", "fish"]

DESCRIPTION = """Print a script that completes commands and options of jaxnav in your shell.

  bash:  jaxnav completion bash > DIR/jaxnav
         in DIR = ~/.local/share/bash-completion/completions
  zsh:   jaxnav completion zsh > DIR/_jaxnav
         in a folder DIR of your fpath
  fish:  jaxnav completion fish > DIR/jaxnav.fish
         in DIR = ~/.config/fish/completions

Create the folder first if it is missing, and start a new shell afterwards. \
Completion needs python3, but does not start jaxnav. Print the script again after an update of jaxnav."""

#: Bash completes file names where the script of tyro has nothing to complete.
_BASH_FALLBACK = """
_jaxnav_or_files() {
  _tyro_jaxnav
  [[ -n "${COMPREPLY[*]}" ]] || COMPREPLY=()
}
complete -o default -F _jaxnav_or_files jaxnav
"""
#: Longest description of an option, in characters: fish passes the script as an argument of at most 128 KiB.
_MAX_DESCRIPTION = 60

#: Rules by which tyro turns dataclasses into options with short descriptions.
_SHORT_REGISTRY = ConstructorRegistry()


@_SHORT_REGISTRY.struct_rule
def _describe_fields_shortly(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Describe the fields of a dataclass by the beginning of their descriptions."""
    spec = describe_fields(info)
    if spec is None:
        return None
    fields = []
    for field in spec.fields:
        description = textwrap.shorten(str(field.helptext or ""), _MAX_DESCRIPTION, placeholder=" ...")
        fields.append(dataclasses.replace(field, helptext=description))
    return dataclasses.replace(spec, fields=tuple(fields))


@dataclasses.dataclass(frozen=True)
class CompletionConfig:
    """Options of the completion command.

    Attributes:
      shell: shell to print the script for.
    """

    shell: Shell


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code."""

    def parse() -> CompletionConfig:
        return parse_arguments(CompletionConfig, arguments, "jaxnav completion", DESCRIPTION)

    return run_command(_print_script, parse, compiles=False)


def _print_script(config: CompletionConfig, console: Console) -> None:
    print(make_script(config.shell), end="")


def make_script(shell: Shell) -> str:
    """Return the script of a shell, which tyro writes."""
    output = io.StringIO()
    arguments = ["--tyro-write-completion", shell, "-"]
    with REGISTRY, contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        tyro.cli(_make_subcommands(list_command_types()), args=arguments, prog="jaxnav", registry=_SHORT_REGISTRY)
    script = _share_experiment_options(output.getvalue())

    # Complete file names where nothing else fits.
    if shell == "bash":
        return script + _BASH_FALLBACK
    if shell == "zsh":
        return script.replace('\n_tyro_jaxnav "$@"\n', '\n_tyro_jaxnav "$@" || _files\n')
    return script


def _share_experiment_options(script: str) -> str:
    """Keep the options of experiments once, which tyro writes for each name.

    All scripts hold a program in Python with a dictionary of the commands, `COMPLETION_SPEC`.
    """
    from jaxnav.experiments.config import EXPERIMENTS

    name = next(iter(EXPERIMENTS))
    _, _, after_name = script.partition(f"'{name}': {{'description': '{name}', 'options': ")
    options, _, _ = after_name.partition(", 'subcommands': {}")
    if not options:
        return script  # of another version of tyro: complete, but long
    shared = script.replace(options, "EXPERIMENT_OPTIONS")
    return shared.replace("COMPLETION_SPEC = ", f"EXPERIMENT_OPTIONS = {options}\nCOMPLETION_SPEC = ", 1)


def list_command_types() -> dict[str, Any]:
    """Return the dataclass of options of each command, or the commands of a group."""
    from jaxnav.cli import episode, eval, export, list, log, play, report, scenes, sweep, train
    from jaxnav.experiments.config import EXPERIMENTS, ExperimentConfig

    # The name of an experiment comes first, so it is completed like a command. Its options are repeated for each name,
    # so leave out those of the training runs, and all descriptions.
    hints = get_type_hints(ExperimentConfig)
    experiment_fields = []
    for field in dataclasses.fields(ExperimentConfig):
        if field.name != "base":
            experiment_fields.append((field.name, hints[field.name], field))
    experiment_type = dataclasses.make_dataclass("ExperimentOptions", experiment_fields)

    types: dict[str, Any] = {
        "train": train.Options,
        "eval": eval.EvalConfig,
        "sweep": sweep.SweepConfig,
        "study": dict.fromkeys(EXPERIMENTS, experiment_type),
        "report": report.ReportConfig,
        "episode": episode.EpisodeConfig,
        "play": play.PlayConfig,
        "scenes": {name: kind for name, (kind, _, _) in scenes.COMMANDS.items()},
        "export": export.ExportConfig,
        "log": log.LogConfig,
        "list": list.ListConfig,
        "completion": dict.fromkeys(get_args(Shell), _NoOptions),
    }
    types["help"] = dict.fromkeys(types, _NoOptions)
    return types


@dataclasses.dataclass(frozen=True)
class _NoOptions:
    """A word without options."""


def _make_subcommands(types: dict[str, Any]) -> Any:
    """Return a type that tyro reads as commands."""
    members = []
    for name, kind in types.items():
        if isinstance(kind, dict):
            fields = [("command", Annotated[_make_subcommands(kind), tyro.conf.arg(name="")])]
            kind = dataclasses.make_dataclass(f"Commands{name.capitalize()}", fields)
        members.append(Annotated[kind, tyro.conf.subcommand(name)])
    return Union[tuple(members)]  # noqa: UP007  (the members are not known before)
