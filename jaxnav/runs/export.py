"""Exports of a run: one policy with its model card, as parameters or as a program that runs without jaxnav."""

import hashlib
import json
from pathlib import Path
from typing import Literal, NamedTuple

import jax

from jaxnav.errors import InputError
from jaxnav.runs.loaded_policy import MODEL_CARD_SIGNATURE, LoadedPolicy, export_program, format_model_card, load_policy
from jaxnav.runs.policies import POLICIES_DIR
from jaxnav.runs.run import Run
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_ORIGIN, RIGHT_SCALE, SIZE_SCALE
from jaxnav.scenes.task import ACTIONS
from jaxnav.store.export import PARAMS_FILE, POLICY_FILE
from jaxnav.store.files import write_atomic

# Files of an export, in addition to those of the policy itself.
CARD_FILE = "README.md"
PROGRAM_FILE = "step.stablehlo"
NAMES_FILE = "step.json"


class Export(NamedTuple):
    """Contents of an export without its card.

    Attributes:
      files: contents by file name.
      descriptions: one line for each file.
      usage: lines of Markdown that show how to use the files.
    """

    files: dict[str, bytes]
    descriptions: dict[str, str]
    usage: tuple[str, ...]


def export_policy_of_run(
    run_dir: Path,
    export_format: Literal["safetensors", "stablehlo"] = "safetensors",
    policy_name: str | None = None,
    out: Path | None = None,
) -> Path:
    """Write one policy of a run with its model card, and return the folder.

    Args:
      run_dir: directory of a finished run.
      export_format: `safetensors` for the parameters, `stablehlo` for a program that runs without jaxnav.
      policy_name: name of a folder in the `policies` of the run; None for seed 0 of the last arm.
      out: folder to write; None for a folder in `exports` of the run.

    Raises:
      InputError: no finished run, no such policy, or a folder that holds other files.
      OSError: the folder cannot be written.
    """
    # Find the policy in the run.
    run = Run.open(run_dir)
    policy_names = [f"{arm}-{seed}" for arm in run.config.arms for seed in range(run.config.seeds)]
    policy_name = policy_name or f"{run.config.arms[-1]}-0"
    if policy_name not in policy_names:
        raise InputError(f"--policy {policy_name}: {run_dir} has {', '.join(policy_names)}")
    source = run_dir / POLICIES_DIR / policy_name
    policy = load_policy(source)
    out = out or run_dir / "exports" / f"{policy_name}-{export_format}"
    if not _is_replaceable(out):
        raise InputError(f"{out}: exists and is not an export; give another --out")

    # Contents of the files, and the card that describes them.
    is_program = export_format == "stablehlo"
    export = _make_program_export(policy, run) if is_program else _make_parameter_export(source)
    card = format_model_card(run, policy_name, policy, export.descriptions, export.usage)

    # The card marks a complete export: it is removed first and written last.
    for file_name in (CARD_FILE, PROGRAM_FILE, NAMES_FILE, PARAMS_FILE, POLICY_FILE):
        (out / file_name).unlink(missing_ok=True)
    for file_name, file_bytes in export.files.items():
        write_atomic(out / file_name, file_bytes)
    write_atomic(out / CARD_FILE, card.encode(errors="backslashreplace"))
    return out


def _is_replaceable(out: Path) -> bool:
    """True if a folder is missing, empty or an earlier export."""
    if not out.is_dir() or not any(out.iterdir()):
        return not out.is_file()
    card = out / CARD_FILE
    return card.is_file() and MODEL_CARD_SIGNATURE in card.read_text(encoding="utf-8", errors="replace")


def _make_parameter_export(source: Path) -> Export:
    """Return the files of the policy as the run stores them."""
    descriptions = {
        PARAMS_FILE: "parameters, priors and method knowledge",
        POLICY_FILE: "specification of the network, task and layout estimator",
    }
    files = {file_name: (source / file_name).read_bytes() for file_name in descriptions}
    return Export(files, descriptions, _code_block(_LOADING_CODE))


def _make_program_export(policy: LoadedPolicy, run: Run) -> Export:
    """Return the step as a program, and the names of its inputs' categories, actions and rooms."""
    # The program, and the names that its indices stand for.
    program = export_program(policy)
    names_by_kind = {
        "categories": run.config.task.categories,
        "actions": ACTIONS,
        "rooms": [*ROOM_TYPES, "any other"],
        "jax": jax.__version__,
        "sha256": hashlib.sha256(program).hexdigest(),
    }
    files = {PROGRAM_FILE: program, NAMES_FILE: (json.dumps(names_by_kind, indent=2) + "\n").encode()}

    # Descriptions for the model card, and the use of the program.
    descriptions = {
        PROGRAM_FILE: f"the step, for CPU, CUDA and TPU; written by JAX {jax.__version__}, "
        "runs with JAX and flatbuffers",
        NAMES_FILE: "names by index, and the digest",
    }
    num_choices = policy.spec.method.control.num_choices
    inputs_text = _INPUTS_TEXT.format(choices=num_choices, front_cell=_FRONT_CELL_TEXT[policy.task.rules.front_cell])
    usage = (*_code_block(_CALLING_CODE), *inputs_text.rstrip().split("\n"))
    return Export(files, descriptions, usage)


def _code_block(text: str) -> tuple[str, ...]:
    return ("```python", *text.strip().split("\n"), "```")


_LOADING_CODE = """
import jaxnav

policy = jaxnav.load_policy(".")  # this folder
memory = policy.init()
"""

_CALLING_CODE = """
import hashlib
import json
from pathlib import Path

import jax.export
import numpy as np

program = Path("step.stablehlo").read_bytes()
assert hashlib.sha256(program).hexdigest() == json.loads(Path("step.json").read_text())["sha256"]
step = jax.export.deserialize(bytearray(program))
(shapes, _), _ = jax.tree.unflatten(step.in_tree, step.in_avals)
inputs = jax.tree.map(lambda leaf: np.zeros((8, *leaf.shape[1:]), leaf.dtype), shapes)  # eight episodes
inputs["first"][:] = True  # they begin
outputs = step.call(inputs, np.float32(0.5))  # epsilon
inputs |= {"memory": outputs["memory"], "action": outputs["action"], "first": np.zeros(8, bool)}
"""

_FRONT_CELL_TEXT = {
    "move": "the cell that MoveAhead leads to",
    "nearest": "the cell nearest to the point 0.25 m along the heading",
}

_INPUTS_TEXT = f"""
Inputs, a row for each episode:

* `detections` uint8 [K, 4]: for each category, by the nearest object of it, confidence x 255 (0: not detected), metres
  ahead x {AHEAD_SCALE:g}, metres to the right x {RIGHT_SCALE:g} + {RIGHT_ORIGIN:g}, apparent size x {SIZE_SCALE:g}
* `view` uint8 [V, V]: cells of 0.25 m before the agent, 0 unknown, 1 free, 2 blocked; row 0 is nearest, column 0
  leftmost; the middle of row 1 is {{front_cell}}
* `goal`, `action`, `heading`, `horizon`, `room` int32: category of the goal, previous action, compass heading, horizon
  of the camera, type of the room (which selects the layout prior)
* `moved` bool: true where the previous action changed the cell; `first` bool: true where an episode begins
* `memory`: output `memory` of the previous step; not read where an episode begins

Outputs: `action` int32, the best action (where `logits` are of actions, you may sample one and give it as the next
`action`); `logits`, `factual` and, where the policy uses the layout, `counterfactual` float32 [{{choices}}]; there also
the layout gap `gap` and the weights `weights` [K] of eq. 7; `memory`.
"""
