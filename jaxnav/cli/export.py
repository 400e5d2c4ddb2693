"""The export command: one policy of a run, with its model card."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import jax
import tyro
from rich.console import Console

from jaxnav.cli.console import command_line, exit_code
from jaxnav.errors import InputError
from jaxnav.policies.methods import find_method
from jaxnav.runs.directory import Run
from jaxnav.runs.exported import program
from jaxnav.runs.model_card import SIGNATURE, model_card
from jaxnav.runs.policies import POLICIES
from jaxnav.runs.policy import LoadedPolicy, load_policy
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE
from jaxnav.scenes.task import ACTIONS
from jaxnav.store.files import write_atomic

CARD = "README.md"
FILES = PROGRAM, NAMES, PARAMS, POLICY = "step.stablehlo", "step.json", "params.safetensors", "policy.json"


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """Configure an export.

    Attributes:
      run: the run directory.
      format: `safetensors`, the parameters, for `jaxnav.load_policy`; or `stablehlo`, the whole step with sTDE as a
        program that needs JAX and flatbuffers alone.
      policy: a name in the run's `policies`; default: seed 0 of its last arm.
      out: folder to write; default: in the run directory.
    """

    run: Annotated[Path, tyro.conf.Positional]
    format: Literal["safetensors", "stablehlo"] = "safetensors"
    policy: str | None = None
    out: Path | None = None


def main(arguments: list[str] | None = None, prog: str = "jaxnav export") -> int:
    """Run the command and return its exit code."""
    what = "Export a policy of a run with its model card: as parameters, or as a program that runs without jaxnav."
    config = command_line(ExportConfig, arguments, prog, what)
    return exit_code(lambda console: _export(config, console))


class Export(NamedTuple):
    """Hold what an export consists of besides its card.

    Attributes:
      files: their contents, by name.
      about: what each file is.
      use: lines of Markdown.
    """

    files: dict[str, bytes]
    about: dict[str, str]
    use: tuple[str, ...]


def _export(config: ExportConfig, console: Console) -> None:
    """Write the files of an export, the card last."""
    run = Run.open(config.run)
    names = [f"{arm}-{seed}" for arm in run.config.arms for seed in range(run.config.seeds)]
    name = config.policy or f"{run.config.arms[-1]}-0"
    if name not in names:
        raise InputError(f"--policy {name}: {config.run} has {', '.join(names)}")
    source = config.run / POLICIES / name
    policy = load_policy(source)
    out = config.out or config.run / "exports" / f"{name}-{config.format}"
    if not _is_replaceable(out):
        raise InputError(f"{out}: is there and holds no export; give another --out")
    export = _parameters(source) if config.format == "safetensors" else _program(policy, run)
    card = model_card(run, name, policy, export.about, export.use)
    try:
        for file in (CARD, *FILES):  # without its card nothing of an earlier export is taken for one
            (out / file).unlink(missing_ok=True)
        for file, data in (export.files | {CARD: card.encode()}).items():
            write_atomic(out / file, data)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); give another --out") from error
    console.print(f"written to {out}")


def _is_replaceable(out: Path) -> bool:
    """Return whether a folder is missing, empty or an earlier export."""
    if not out.is_dir() or not any(out.iterdir()):
        return not out.is_file()
    card = out / CARD
    return card.is_file() and SIGNATURE in card.read_text(encoding="utf-8", errors="replace")


def _parameters(source: Path) -> Export:
    """Return the parameters as the run keeps them."""
    about = {PARAMS: "parameters and what was learned before", POLICY: "what they are built into"}
    return Export({name: (source / name).read_bytes() for name in about}, about, _code(_LOADING))


def _program(policy: LoadedPolicy, run: Run) -> Export:
    """Return the step as a program, and the names of what it takes."""
    written, task = program(policy), run.config.task
    names = {"categories": task.categories, "actions": ACTIONS, "rooms": [*ROOM_TYPES, "any other"]}
    described = names | {"jax": jax.__version__, "sha256": hashlib.sha256(written).hexdigest()}
    files = {PROGRAM: written, NAMES: (json.dumps(described, indent=2) + "\n").encode()}
    about = {
        PROGRAM: f"the step, for CPU, CUDA and TPU; written by JAX {jax.__version__}, runs with JAX and flatbuffers",
        NAMES: "names by index, and the digest",
    }
    inputs = _INPUTS.format(choices=find_method(policy.spec.method).control.num_choices)
    return Export(files, about, (*_code(_CALLING), *inputs.rstrip().split("\n")))


def _code(text: str) -> tuple[str, ...]:
    return ("```python", *text.strip().split("\n"), "```")


_LOADING = """
import jaxnav

policy = jaxnav.load_policy(".")  # this folder
memory = policy.init()
"""

_CALLING = """
import hashlib
import json
from pathlib import Path

import jax.export
import numpy as np

program = Path("step.stablehlo").read_bytes()
assert hashlib.sha256(program).hexdigest() == json.loads(Path("step.json").read_text())["sha256"]
step = jax.export.deserialize(bytearray(program))
(shapes, _), _ = jax.tree.unflatten(step.in_tree, step.in_avals)
inputs = jax.tree.map(lambda each: np.zeros((8, *each.shape[1:]), each.dtype), shapes)  # eight episodes
inputs["first"][:] = True  # they begin
outputs = step.call(inputs, np.float32(0.5))  # epsilon
inputs |= {"memory": outputs["memory"], "action": outputs["action"], "first": np.zeros(8, bool)}
"""

_INPUTS = f"""
Inputs, a row for each episode:

* `detections` uint8 [K, 4]: for each category, by the nearest object of it, confidence x 255 (0: not detected), metres
  ahead x {AHEAD_SCALE:g}, metres to the right x {RIGHT_SCALE:g} + 128, apparent size x {SIZE_SCALE:g}
* `view` uint8 [V, V]: cells of 0.25 m before the agent, 0 unknown, 1 free, 2 blocked; row 0 is nearest, column 0
  leftmost
* `goal`, `action`, `heading`, `horizon`, `room` int32: what is sought, the action taken last, compass heading, the
  camera's horizon, the type of the room (it picks the layout prior)
* `moved` bool: whether the last action changed the cell; `first` bool: whether an episode begins
* `memory`: what the step before returned; not read where an episode begins

Outputs: `action` int32, the best one (where `logits` are of actions, you may sample one and give it as the next
`action`); `logits`, `factual` and, where the policy uses the layout, `counterfactual` float32 [{{choices}}]; there also
the layout gap `gap` and the weights `weights` [K] of eq. 7; `memory`.
"""
