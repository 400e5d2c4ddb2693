"""Exported policies by name, and the world that one is made for."""

import dataclasses
import json
import os
from pathlib import Path

import jax

from jaxnav.errors import InputError
from jaxnav.runs.config import RunConfig
from jaxnav.runs.policies import Policies, read_export
from jaxnav.scenes.worlds import WORLDS
from jaxnav.store.export import POLICY_FILE, load_params
from jaxnav.store.manifest import differences

#: Policies that come with the package, a folder each.
WEIGHTS = Path(__file__).parents[1] / "weights"


def policy_folder(path: str | Path) -> Path:
    """Return the folder of a policy.

    Args:
      path: of the folder, or the name of a policy that comes with the package.

    Raises:
      InputError: there is neither; names those of the package.
    """
    folder = _folder(path)
    if not folder.exists():
        names, what = ", ".join(sorted(os.listdir(WEIGHTS))), "not an exported policy (No such file or directory: "
        raise InputError(f"{path}: {what}{path}); export it, or load one of the package: {names}")
    return folder


def is_policy(path: str | Path) -> bool:
    """Return whether there is an exported policy; see `policy_folder`."""
    return (_folder(path) / POLICY_FILE).exists()


def _folder(path: str | Path) -> Path:
    return Path(path) if Path(path).exists() else WEIGHTS / path


def world_of(path: str | Path) -> RunConfig:
    """Return settings with the world that has a policy's task.

    Raises:
      InputError: no such policy, or a task that none of the generated worlds has.
    """
    folder = policy_folder(path)
    _, spec = load_params(folder)
    arm = "baseline" if spec["layout"] is None else "layout"
    for world in WORLDS:
        config = dataclasses.replace(RunConfig(), world=world, method=spec["method"], arms=(arm,), seeds=1)
        if not differences(spec["task"], json.loads(json.dumps(dataclasses.asdict(config.task)))):
            return config
    raise InputError(f"{folder}: was trained for a task that no generated world has; give the run that it comes from")


def as_run(path: str | Path) -> tuple[RunConfig, Policies]:
    """Read a policy as if it were a run with one seed.

    Raises:
      InputError: as `world_of`.
    """
    config, policies = world_of(path), read_export(policy_folder(path))
    return config, policies._replace(params=jax.tree.map(lambda leaf: leaf[None], policies.params), arms=config.arms)
