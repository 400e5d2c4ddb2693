"""The export command: write one policy of a run with its model card."""

import dataclasses
from pathlib import Path
from typing import Literal

from rich.console import Console

from jaxnav.cli.console import parse_arguments, refuse_unwritable, run_command

DESCRIPTION = "Export one policy of a run with its model card: its parameters, or a program that runs without jaxnav."


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """Options of the export command.

    Attributes:
      run: run directory of a finished training.
      format: `safetensors` writes the parameters, for `jaxnav.load_policy`. `stablehlo` writes a program that computes
        one step of the agent with sTDE, and needs only JAX and flatbuffers.
      policy: name of a policy in the folder `policies` of the run. The default is seed 0 of the last arm, such as
        `layout-0`.
      out: folder to write. The default is a folder in `exports` of the run directory.
    """

    run: Path
    format: Literal["safetensors", "stablehlo"] = "safetensors"
    policy: str | None = None
    out: Path | None = None


def main(arguments: list[str] | None = None, prog: str = "jaxnav export") -> int:
    """Run the command and return its exit code."""
    return run_command(_export, lambda: parse_arguments(ExportConfig, arguments, prog, DESCRIPTION))


def _export(config: ExportConfig, console: Console) -> None:
    """Export the policy."""
    from jaxnav.runs.export import export_policy_of_run

    with refuse_unwritable(config.out or config.run / "exports", "--out"):
        folder = export_policy_of_run(config.run, config.format, config.policy, config.out)
    console.print(f"written to {folder}")
