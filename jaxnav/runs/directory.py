"""Run directories: the settings and the exported policies of a run."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import ObjectNav
from jaxnav.errors import InputError
from jaxnav.layout import Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.methods import Knowledge, find_method
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.runs.config import RunConfig, check
from jaxnav.runs.overlay import apply_yaml
from jaxnav.store.export import export_params, load_params
from jaxnav.store.files import write_atomic
from jaxnav.store.manifest import differences
from jaxnav.store.runlog import read_rows
from jaxnav.training.exploration import Exploration

CONFIG_FILE, LOG_FILE, POLICIES = "config.json", "metrics.jsonl", "policies"


class Policies(NamedTuple):
    """Hold all policies of a run, or some of its arms.

    Attributes:
      params: leaves [A S, ...], the S seeds of each arm after those of the arm before.
      arms: names of the A arms.
      knowledge: what was learned before training.
      counts: float32 [rooms, K, K], that the layout priors were made of.
      spec: what the policies are built from.
      setting: of the layout estimator, as calibrated; None without the arm `layout`.
      prior_steps: random steps that the priors were collected in.
    """

    params: dict[str, Any]
    arms: tuple[str, ...]
    knowledge: Knowledge
    counts: jax.Array
    spec: PolicySpec
    setting: Setting | None
    prior_steps: int

    @property
    def seeds(self) -> int:
        """Return the number of seeds of each arm."""
        return len(jax.tree.leaves(self.params)[0]) // len(self.arms)

    def of(self, arm: str) -> dict[str, Any]:
        """Return the parameters of an arm, leaves [S, ...]."""
        first = self.seeds * self.arms.index(arm)
        return jax.tree.map(lambda leaf: leaf[first : first + self.seeds], self.params)

    def acting(self, env: ObjectNav) -> Acting:
        """Return how they act in an environment."""
        return Acting(env, self.spec, self.setting)


@dataclasses.dataclass(frozen=True)
class Run:
    """Hold a training run.

    Attributes:
      config: its settings; `config.run_dir` is where it is kept.
    """

    config: RunConfig

    @classmethod
    def open(cls, run_dir: str | Path) -> "Run":
        """Open an earlier run.

        Raises:
          InputError: the directory holds no run, or its config file is damaged or of another version.
        """
        return cls(load_run(Path(run_dir)))

    def policies(self, arms: Sequence[str] | None = None) -> Policies:
        """Load the exported policies; see `load_policies`."""
        return load_policies(self.config, arms)

    def log(self) -> list[dict[str, Any]]:
        """Return the rows of the training log, one per chunk, arm and seed."""
        return read_rows(self.config.run_dir / LOG_FILE)


def settings(config: RunConfig) -> dict[str, Any]:
    """Return what makes a run the run it is, as JSON.

    All its settings but where it runs and how often what is kept where.
    """
    plain = dataclasses.asdict(config)
    plain = json.loads(json.dumps(plain, default=str))  # as it is read again: tuples are lists
    return {name: value for name, value in plain.items() if name not in ("run_dir", "save_every", "cache", "devices")}


def claim(config: RunConfig) -> None:
    """Claim the run directory for this run, or leave it.

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
    """Read the settings of an earlier run.

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


def load_policies(run: RunConfig, arms: Sequence[str] | None = None) -> Policies:
    """Load the exported policies of a run.

    Args:
      run: its settings.
      arms: names of the arms to load; None for all.

    Raises:
      InputError: training has not finished, or left an arm out, or an export is damaged.
    """
    arms = tuple(run.arms if arms is None else arms)
    if absent := [arm for arm in arms if arm not in run.arms]:
        raise InputError(f"{run.run_dir}: was trained without the arm {absent[0]!r}; train one with all --arms")
    folders = {arm: [run.run_dir / POLICIES / f"{arm}-{seed}" for seed in range(run.seeds)] for arm in arms}
    if missing := [folder for paths in folders.values() for folder in paths if not folder.exists()]:
        raise InputError(f"{missing[0]}: is missing, so training has not finished; run train.py again with this run")
    loaded = {arm: [load_params(folder) for folder in paths] for arm, paths in folders.items()}
    told = "layout" if "layout" in arms else arms[-1]  # its last seed says what holds for all
    tensors, spec = loaded[told][-1]
    where = folders[told][-1]
    stacked = [seed["policy"] for seeds in loaded.values() for seed, _ in seeds]
    policies = _policies_of(where, tensors, spec)
    policies = policies._replace(params=jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked), arms=arms)
    if different := differences(spec["task"], json.loads(json.dumps(dataclasses.asdict(run.task)))):
        raise InputError(
            f"{where}: was trained for another task than its run says (there != here): {'; '.join(different)}; "
            "use the version that trained the run"
        )
    return policies


def read_export(folder: Path) -> Policies:
    """Read one exported policy; its parameters have no leading axis.

    Raises:
      InputError: no export there, or a damaged one, or one of another version.
    """
    return _policies_of(folder, *load_params(folder))


def _policies_of(where: Path, tensors: dict[str, Any], spec: dict[str, Any]) -> Policies:
    """Return what an export says, its parameters without a leading axis.

    Raises:
      InputError: the spec is of another version, or the method cannot be found.
    """
    try:
        find_method(spec["method"])
        sizes, method_sizes = Sizes(**spec["sizes"]), tuple(sorted(spec["method_sizes"].items()))
        built = spec["method"], len(spec["categories"]), sizes, method_sizes, spec["direct"], spec["done_gate"]
        return Policies(
            params=jax.tree.map(jnp.asarray, tensors["policy"]),
            arms=(),
            knowledge=Knowledge(
                layout=jnp.asarray(tensors["layout"]["prior"]),
                method=jax.tree.map(jnp.asarray, tensors.get("knowledge", {})),
            ),
            counts=jnp.asarray(tensors["layout"]["counts"]),
            spec=PolicySpec(*built),
            setting=None if spec["layout"] is None else Setting(**spec["layout"]),
            prior_steps=spec["prior_steps"],
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{where}: its spec does not fit this code ({type(error).__name__}: {error}); train the run anew"
        ) from error


def export_policy(
    folder: Path,
    config: RunConfig,
    params: dict[str, Any],
    knowledge: Knowledge,
    setting: Setting | None,
    explored: Exploration,
) -> None:
    """Export one policy with all that is needed to act with it.

    Args:
      folder: made if missing.
      config: of its run.
      params: of the policy.
      knowledge: what was learned before training.
      setting: of the layout estimator; None without the layout.
      explored: what the priors were made of.
    """
    spec = {
        "method": config.method,
        "categories": list(config.task.categories),
        "task": dataclasses.asdict(config.task),
        "sizes": dataclasses.asdict(config.sizes),
        "method_sizes": config.method_sizes,
        "direct": config.direct,
        "done_gate": config.done_gate,
        "layout": None if setting is None else dataclasses.asdict(setting),
        "prior_steps": int(explored.steps),
        "prior_poses": int(explored.poses),
    }
    layout = {"prior": np.asarray(knowledge.layout), "counts": np.asarray(explored.counts)}
    tensors = {"policy": jax.device_get(params), "layout": layout}
    if knowledge.method:
        tensors["knowledge"] = jax.device_get(knowledge.method)
    export_params(folder, tensors, spec)
