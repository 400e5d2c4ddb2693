"""Run directories: what a run is, its settings, its policies, and the worlds they are evaluated in."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.runs.config import ARMS, RunConfig, check
from jaxnav.runs.overlay import apply_yaml
from jaxnav.errors import InputError
from jaxnav.layout import Setting
from jaxnav.policies.methods import METHODS
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.store.export import load_params
from jaxnav.store.files import write_atomic
from jaxnav.store.manifest import differences

CONFIG_FILE, LOG_FILE, POLICIES = "config.json", "metrics.jsonl", "policies"


class Policies(NamedTuple):
    """All policies of a run.

    Attributes:
      params: leaves [2 S, ...], baseline seeds first, then layout seeds.
      priors: float32 [rooms, K, K].
      counts: float32 [rooms, K, K], that the priors were made of.
      spec: sizes.
      setting: of the layout estimator, as calibrated.
      prior_steps: random steps that the priors were collected in.
    """

    params: dict[str, Any]
    priors: jax.Array
    counts: jax.Array
    spec: PolicySpec
    setting: Setting
    prior_steps: int


def settings(config: RunConfig) -> dict[str, Any]:
    """What makes a run the run it is, as JSON: all its settings but where it runs and how often what is kept where."""
    plain = dataclasses.asdict(config)
    plain = json.loads(json.dumps(plain, default=str))  # as it is read again: tuples are lists
    return {name: value for name, value in plain.items() if name not in ("run_dir", "save_every", "cache", "devices")}


def claim(config: RunConfig) -> None:
    """Make the run directory this run's, or leave it as it is.

    Raises:
      InputError: it holds another run, or something else.
    """
    path, run_dir = config.run_dir / CONFIG_FILE, config.run_dir
    if path.exists():
        if different := differences(settings(load_run(run_dir)), settings(config)):
            raise InputError(
                f"{run_dir}: holds another run (there != asked for): {'; '.join(different)}; "
                "choose another --run-dir or the same settings"
            )
        return
    if run_dir.exists() and not run_dir.is_dir():
        raise InputError(f"{run_dir}: is a file; choose another --run-dir")
    # A kill while the config is written leaves its temporary file alone in the directory.
    if run_dir.exists() and any(not item.match(f".{CONFIG_FILE}.*.tmp") for item in run_dir.iterdir()):
        raise InputError(f"{run_dir}: is not empty and holds no run; choose another --run-dir")
    write_atomic(path, (json.dumps(settings(config), indent=2) + "\n").encode())


def load_run(run_dir: Path) -> RunConfig:
    """Settings of an earlier run.

    Raises:
      InputError: the directory holds no run, or its config file is damaged or of another version.
    """
    path = run_dir / CONFIG_FILE
    if not path.exists():
        raise InputError(f"{run_dir}: holds no run ({CONFIG_FILE} is missing); train one there first")
    config = apply_yaml(RunConfig(), path)
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}); restore the file or train in another --run-dir") from error
    if different := differences(held or {}, settings(config)):
        raise InputError(f"{path}: lacks settings ({'; '.join(different)}); restore the file or train the run anew")
    return check(dataclasses.replace(config, run_dir=run_dir))


def load_policies(run: RunConfig, arms: Sequence[str] = ARMS) -> Policies:
    """The exported policies of a run, of all arms or some; the last must be `layout`.

    Raises:
      InputError: training has not finished, or left an arm out, or an export is damaged.
    """
    if absent := [arm for arm in arms if arm not in run.arms]:
        raise InputError(f"{run.run_dir}: was trained without the arm {absent[0]!r}; train one with all --arms")
    folders = [run.run_dir / POLICIES / f"{arm}-{seed}" for arm in arms for seed in range(run.seeds)]
    if missing := [folder for folder in folders if not folder.exists()]:
        raise InputError(f"{missing[0]}: is missing, so training has not finished; run train.py again with this run")
    loaded = [load_params(folder) for folder in folders]
    tensors, spec = loaded[-1]
    try:
        policy_spec = PolicySpec(
            spec["method"], len(spec["categories"]), Sizes(**spec["sizes"]), spec["direct"], spec["done_gate"]
        )
        task = spec["task"]
        policies = Policies(
            params=jax.tree.map(lambda *leaves: jnp.stack(leaves), *(tensors["policy"] for tensors, _ in loaded)),
            priors=jnp.asarray(tensors["layout"]["prior"]),
            counts=jnp.asarray(tensors["layout"]["counts"]),
            spec=policy_spec,
            setting=Setting(**spec["layout"]),
            prior_steps=spec["prior_steps"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folders[-1]}: its spec does not fit this code ({type(error).__name__}: {error}); train the run anew"
        ) from error
    if different := differences(task, json.loads(json.dumps(dataclasses.asdict(run.task)))):
        raise InputError(
            f"{folders[-1]}: was trained for another task than its run says (there != here): {'; '.join(different)}; "
            "use the version that trained the run"
        )
    if policy_spec.method not in METHODS:
        raise InputError(
            f"{folders[-1]}: method {policy_spec.method!r} is unknown here; use the version that trained the run"
        )
    return policies
