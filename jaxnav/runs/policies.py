"""The policies of a run: how they are read again."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from jaxnav.errors import InputError
from jaxnav.gaps import Signs
from jaxnav.layout import SETTINGS, Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.adaptation import limited
from jaxnav.policies.methods import Knowledge, find_method
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec, Sizes
from jaxnav.runs.config import RunConfig
from jaxnav.runs.exports import check_arrays, check_knowledge
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.task import Task
from jaxnav.store.export import load_params
from jaxnav.store.manifest import differences
from jaxnav.training.calibration import layout_priors

#: Folder of the exported policies in a run directory.
POLICIES = "policies"
#: How the gap is measured: as a run's layout setting has it, or in another way.
Gap = Literal["novelty", "evidence", "learned", "overdue", "clock"]
#: Layout estimators that a run can be evaluated with, besides that of its training.
EstimatorName = Literal["paper", "released", "evidence", "learned", "overdue", "clock"]


class Policies(NamedTuple):
    """Hold the policies of a run, or some arms.

    Attributes:
      params: leaves [A S, ...], the S seeds of each arm after those of the arm before.
      arms: names of the A arms.
      knowledge: what was learned before training.
      counts: float32 [rooms, K, K], that the layout priors were made of.
      spec: what the policies are built from.
      setting: of the layout estimator, as calibrated; None without the arm `layout`.
      prior_steps: random steps that the priors were collected in.
      task: that they were trained for.
      inner_steps: by which they may adapt in an episode; None for the method's usual number.
      without: what the policies that they hand over to are built from; None without any.
    """

    params: dict[str, Any]
    arms: tuple[str, ...]
    knowledge: Knowledge
    counts: jax.Array
    spec: PolicySpec
    setting: Setting | None
    prior_steps: int
    task: Task
    inner_steps: int | None = None
    without: PolicySpec | None = None

    @property
    def seeds(self) -> int:
        """Return the number of seeds of each arm."""
        return len(jax.tree.leaves(self.params)[0]) // len(self.arms)

    def of(self, arm: str) -> dict[str, Any]:
        """Return the parameters of an arm, leaves [S, ...]."""
        first = self.seeds * self.arms.index(arm)
        return jax.tree.map(lambda leaf: leaf[first : first + self.seeds], self.params)

    def estimating(self, name: EstimatorName | None, hold: bool = False) -> "Policies":
        """Return these policies beside another layout estimator.

        Args:
          name: `paper` and `released` make weights too; the others measure the gap in another way and leave the
            layout's weights; None leaves the estimator.
          hold: the gap never falls within an episode.

        Raises:
          InputError: none of the policies uses the layout, or the run knows no signs for `learned` or `overdue`.
        """
        if name is None and not hold:
            return self
        if self.setting is None:
            asked = "--hold" if name is None else f"--setting {name}"
            raise InputError(f"{asked}: needs policies with the layout; train a run with the arm `layout`")
        if name in ("learned", "overdue") and self.knowledge.signs is None:
            raise InputError(f"--setting {name}: the run learned no signs of another layout; train it anew")
        setting, knowledge = self.setting, self.knowledge
        if name in ("paper", "released"):
            setting = SETTINGS[name]
            knowledge = knowledge._replace(layout=layout_priors(self.counts, setting))
        elif name is not None:
            setting = gap_settings(setting)[name]
        return self._replace(setting=dataclasses.replace(setting, hold=hold or setting.hold), knowledge=knowledge)

    def adapting(self, steps: int | None) -> "Policies":
        """Return these policies with so many inner steps in an episode.

        0 switches their adaptation off, None leaves it.

        Raises:
          InputError: the method does not adapt, or not by so many steps.
        """
        if steps is None:
            return self
        adaptation = find_method(self.spec.method).adaptation
        if adaptation is None:
            name = self.spec.method
            raise InputError(f"inner_steps is {steps}; method {name!r} does not adapt in an episode, leave it out")
        limited(adaptation, steps)
        return self._replace(inner_steps=steps)

    def handing_over(self, without: "Policies") -> "Policies":
        """Return pairs with policies that have no experience.

        Removal of experience then leaves these. Parameters are {"agent": ..., "without": ...}.

        Args:
          without: as many policies, of the same task.

        Raises:
          InputError: they note, choose or remember otherwise than agents of `anonymous`.
        """
        method, other = find_method(self.spec.method), find_method(without.spec.method)
        if other.tracker is not None or method.control.num_choices != other.control.num_choices:
            raise InputError(
                f"handing over: {self.spec.method!r} cannot hand over to {without.spec.method!r}; train a run with "
                "--method anonymous, and let a method that chooses actions hand over to it"
            )
        if self.spec.spatial_memory != without.spec.spatial_memory:
            raise InputError("handing over: one of the runs has no spatial memory; train both alike")
        return self._replace(params={"agent": self.params, "without": without.params}, without=without.spec)

    def acting(self, world: CompiledWorld) -> Acting:
        """Return how they act in the scenes of a world.

        Raises:
          InputError: their method cannot act there.
        """
        world.check(self.spec.method, self.knowledge)
        return Acting(world.env, self.spec, self.setting, self.inner_steps, self.without)


def gap_settings(setting: Setting) -> dict[Gap, Setting]:
    """Return the settings that measure the gap in each way.

    None changes the layout's weights. `clock` is what the gap of the released code comes to: all at once when something
    new is seen, then gone in steps.
    """
    settings: dict[Gap, Setting] = {gap: dataclasses.replace(setting, gap=gap) for gap in get_args(Gap)}
    settings["clock"] = dataclasses.replace(settings["clock"], passes=SETTINGS["released"].passes)
    return settings


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
        raise InputError(f"{missing[0]}: is missing, so training has not finished; train again with this --run-dir")
    loaded = {arm: [load_params(folder) for folder in paths] for arm, paths in folders.items()}
    told = "layout" if "layout" in arms else arms[-1]  # its last seed says what holds for all
    where, (_, spec) = folders[told][-1], loaded[told][-1]
    stacked = []
    for arm in arms:
        for folder, (tensors, other) in zip(folders[arm], loaded[arm], strict=True):
            policies = _policies_of(folder, tensors, other)
            stacked.append(policies.params)
            if different := differences(other if arm == told else other | {"layout": spec["layout"]}, spec):
                raise InputError(f"{folder}: is not of the run of {where}: {'; '.join(different)}; train the run anew")
    policies = _policies_of(where, *loaded[told][-1])
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
    """Return what an export says.

    Its parameters have no leading axis.

    Raises:
      InputError: the spec is of another version, or the method cannot be found or lacks what it learned.
    """
    try:
        if find_method(spec["method"]).learn is not None and "knowledge" not in tensors:
            raise InputError(f"what method {spec['method']!r} learns before training is missing; train the run anew")
        sizes, method_sizes = Sizes(**spec["sizes"]), tuple(sorted(spec["method_sizes"].items()))
        spatial = None if spec["spatial_memory"] is None else SpatialMemory(**spec["spatial_memory"])
        options = spec["direct"], spec["done_gate"], spatial, spec["decision"], spec["goal_row"]
        built = spec["method"], len(spec["categories"]), sizes, method_sizes
        policy = PolicySpec(*built, *options)
        check_arrays(where, tensors, policy)
        params = jax.tree.map(jnp.asarray, tensors["policy"])
        knowledge = Knowledge(
            layout=jnp.asarray(tensors["layout"]["prior"]),
            method=jax.tree.map(jnp.asarray, tensors.get("knowledge", {})),
            signs=jax.tree.map(jnp.asarray, Signs(**tensors["signs"])) if "signs" in tensors else None,
        )
        if knowledge.method:
            check_knowledge(params, policy, knowledge)
        return Policies(
            params=params,
            arms=(),
            knowledge=knowledge,
            counts=jnp.asarray(tensors["layout"]["counts"]),
            spec=policy,
            setting=None if spec["layout"] is None else Setting(**spec["layout"]),
            prior_steps=spec["prior_steps"],
            task=Task.from_json(spec["task"]),
        )
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{where}: its spec does not fit this code ({type(error).__name__}: {error}); train the run anew"
        ) from error
