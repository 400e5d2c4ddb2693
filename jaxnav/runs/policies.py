"""Exported policies: writing them, checking them, and loading the policies of a run.

A run exports one folder per arm and seed (`export_policy`). `load_policies` reads all of them as `Policies`, which the
evaluation runs side by side; `read_exported_policy` reads a single folder. Policies that come with the package are
found by name (`find_policy_folder`), and `load_policy_as_run` treats a single policy like a run with one seed.
"""

import dataclasses
import functools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.choices import CounterfactualMemory, EstimatorName, GapName
from jaxnav.env.objectnav import NUM_PRIORS, Observation
from jaxnav.errors import InputError, check_choice
from jaxnav.gaps import NUM_NEAR_FEATURES, CooccurrenceEvidence
from jaxnav.layout import ESTIMATORS, EstimatorConfig
from jaxnav.policies.adaptation import limit_inner_steps
from jaxnav.policies.agent_loop import AgentLoop, Perception
from jaxnav.policies.method import Knowledge, Method, Percept
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.policies.network import Params, bind, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import LayoutConfig, RunConfig, WorldConfig
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS
from jaxnav.store.checkpoint import describe_arrays
from jaxnav.store.export import POLICY_FILE, export_params, load_params
from jaxnav.store.files import expand_home, list_differences
from jaxnav.training.calibration import Exploration, layout_priors
from jaxnav.training.devices import require_float32

#: Folder of the exported policies in a run directory, and the settings of the run.
POLICIES_DIR = "policies"
CONFIG_FILE = "config.json"
#: Folder of the policies that come with the package, each in a folder of its own.
PACKAGED_POLICIES = Path(__file__).parents[1] / "weights"
#: Gaps that read the co-occurrence evidence.
EVIDENCE_GAPS: tuple[str, ...] = ("learned", "surprise", "overdue")


class Policies(NamedTuple):
    """Policies of a run: A arms with S seeds each.

    Attributes:
      params: network parameters, leaves [A S, ...]; the seeds of an arm are adjacent.
      arms: names of the A arms.
      knowledge: priors and method knowledge from before training.
      prior_counts: float32 [rooms, K, K], co-occurrence counts behind the layout priors; None for a policy in memory.
      spec: specification of the networks.
      estimator_config: calibrated layout estimator; None without the arm `layout`.
      prior_steps: random steps in which the counts were collected.
      task: task of the training.
      inner_steps: limit of adaptation steps in an episode; None for the method's default.
      fallback_spec: specification of the policies that decide once experience is removed; None without handover.
      use_own_fallback: whether these policies themselves decide once experience is removed, under do(Z = 0).
    """

    params: dict[str, Any]
    arms: tuple[str, ...]
    knowledge: Knowledge
    prior_counts: jax.Array | None
    spec: PolicySpec
    estimator_config: EstimatorConfig | None
    prior_steps: int
    task: Task
    inner_steps: int | None = None
    fallback_spec: PolicySpec | None = None
    use_own_fallback: bool = False

    @property
    def num_seeds(self) -> int:
        """Number of seeds S of each arm."""
        return len(jax.tree.leaves(self.params)[0]) // len(self.arms)

    @property
    def has_room_priors(self) -> bool:
        """True if the layout priors of two room types differ; those of homes are all equal."""
        priors = np.asarray(self.knowledge.priors)
        return bool((priors != priors[0]).any())

    def supports_gap(self, gap: str) -> bool:
        """True if the policies hold the evidence that a gap needs; runs of earlier versions lack that of `surprise`."""
        evidence = self.knowledge.cooccurrence
        if gap not in EVIDENCE_GAPS:
            return True
        return evidence is not None and (gap != "surprise" or evidence.near_log_odds is not None)

    def arm_params(self, arm: str) -> dict[str, Any]:
        """Parameters of one arm, leaves [S, ...]."""
        start = self.num_seeds * self.arms.index(arm)
        return jax.tree.map(lambda leaf: leaf[start : start + self.num_seeds], self.params)

    def with_estimator(self, name: EstimatorName | None, hold: bool = False) -> "Policies":
        """Policies with another layout estimator.

        Args:
          name: `paper` and `released` replace the layout weights too; other names change only the measure of the gap;
            None keeps the estimator.
          hold: keep the gap from falling within an episode.

        Raises:
          InputError: an unknown name, no policy uses the layout, the run learned no co-occurrence evidence, which
            `learned`, `surprise` and `overdue` need, or the counts that `paper` and `released` need are not in memory.
        """
        if name is None and not hold:
            return self
        check_choice("--setting", name, get_args(EstimatorName))

        # Refuse an estimator for which the run has no data.
        if self.estimator_config is None:
            option = "--hold" if name is None else f"--setting {name}"
            raise InputError(f"{option}: needs policies with the layout estimator; train a run with the arm `layout`")
        if name is not None and not self.supports_gap(name):
            raise InputError(f"--setting {name}: the run or policy holds no evidence for this gap; train the run again")

        # `paper` and `released` also build the priors in their own way.
        estimator_config = self.estimator_config
        knowledge = self.knowledge
        if name in ("paper", "released"):
            if self.prior_counts is None:
                raise InputError(
                    f"setting {name!r} needs the counts behind the priors, which a policy in memory lacks; give the "
                    "policy by its folder or its name"
                )
            estimator_config = adapt_counts(ESTIMATORS[name], self.task)
            knowledge = knowledge._replace(priors=layout_priors(self.prior_counts, estimator_config))
            # Removal from a sum has forms of its own.
            if self.spec.method.has_additive_scores:
                estimator_config = dataclasses.replace(estimator_config, form=self.estimator_config.form)
        elif name is not None:
            estimator_config = estimators_by_gap(estimator_config)[name]

        estimator_config = dataclasses.replace(estimator_config, hold=hold or estimator_config.hold)
        return self._replace(estimator_config=estimator_config, knowledge=knowledge)

    def with_inner_steps(self, inner_steps: int | None) -> "Policies":
        """Policies with another limit of adaptation steps in an episode.

        Args:
          inner_steps: the limit; 0 switches adaptation off, None keeps the limit.

        Raises:
          InputError: the method does not adapt, or cannot take so many steps.
        """
        if inner_steps is None:
            return self
        method = self.spec.method
        if method.adaptation is None:
            raise InputError(
                f"inner_steps is {inner_steps}, but method {method.name!r} does not adapt within an episode; omit it"
            )
        limit_inner_steps(method.adaptation, inner_steps)  # raises for an impossible number
        return self._replace(inner_steps=inner_steps)

    def with_permuted_evidence(self, seed: int) -> "Policies":
        """Policies whose co-occurrence evidence has randomly permuted categories, as a control.

        The decisions of the policies stay, and `EVIDENCE_GAPS` change. Policies without evidence stay as they are.

        Args:
          seed: seed of the permutation of the categories.
        """
        evidence = self.knowledge.cooccurrence
        if evidence is None:
            return self
        permutation = np.random.default_rng(seed).permutation(self.spec.num_categories)

        def permute(matrices: jax.Array) -> jax.Array:
            return matrices[..., permutation, :][..., permutation]

        def permute_pairs(pairs: jax.Array) -> jax.Array:
            # Each pair has its value above the diagonal.
            return jnp.triu(permute(pairs + jnp.swapaxes(pairs, -1, -2)), 1)

        near_log_odds = evidence.near_log_odds
        permuted_evidence = CooccurrenceEvidence(
            log_odds=permute_pairs(evidence.log_odds),
            co_visibility=permute(evidence.co_visibility),
            near_log_odds=None if near_log_odds is None else permute_pairs(near_log_odds),
        )
        return self._replace(knowledge=self.knowledge._replace(cooccurrence=permuted_evidence))

    def with_handover_to(self, fallback_policies: "Policies") -> "Policies":
        """Policies that hand over to fallback policies once experience is removed.

        Args:
          fallback_policies: equally many layout-blind policies, trained for the same task.

        Returns:
          Policies with parameters {"primary": ..., "fallback": ...}.

        Raises:
          InputError: the fallback policies have a tracker, another number of choices or another spatial memory, or are
            more or fewer.
        """
        # Both policies share choices and spatial memory, and no tracker runs for the fallback policy.
        method = self.spec.method
        fallback_method = fallback_policies.spec.method
        if fallback_method.tracker is not None or method.control.num_choices != fallback_method.control.num_choices:
            raise InputError(
                f"hand-over: method {method.name!r} cannot hand over to {fallback_method.name!r}; train the reference "
                "run with --method anonymous, and the other run with a method that chooses actions"
            )
        if self.spec.spatial_memory != fallback_policies.spec.spatial_memory:
            raise InputError("hand-over: the runs have different spatial memories; train both with the same settings")
        num_policies = len(jax.tree.leaves(self.params)[0])
        num_fallbacks = len(jax.tree.leaves(fallback_policies.params)[0])
        if num_policies != num_fallbacks:
            raise InputError(
                f"hand-over: {num_policies} policies cannot hand over to {num_fallbacks}; train both runs with equal "
                "arms and seeds"
            )
        paired_params = {"primary": self.params, "fallback": fallback_policies.params}
        return self._replace(params=paired_params, fallback_spec=fallback_policies.spec)

    def with_own_fallback(self) -> "Policies":
        """Policies that hand over to themselves under do(Z = 0) once experience is removed.

        Raises:
          InputError: the policies had experience in every episode of training.
        """
        if not self.spec.can_drop_experience:
            raise InputError(
                "cde: these policies had experience in every episode of training, so they never learned to act "
                "without it (Z = 0); train a run with --ppo.experience below 1, such as 0.8"
            )
        return self._replace(use_own_fallback=True)

    def with_counterfactual_memory(self, memory: CounterfactualMemory | None) -> "Policies":
        """Policies whose counterfactual branch decides from a given memory; None keeps that of the training.

        Raises:
          InputError: an unknown name, or the policies were trained without a memory of the branch itself.
        """
        if memory is None:
            return self
        check_choice("--counterfactual-memory", memory, get_args(CounterfactualMemory))
        if memory == "own" and self.spec.counterfactual_memory != "own":
            raise InputError(
                "--counterfactual-memory own: the counterfactual branch of these policies was trained without a memory "
                "of its own; train a run with --counterfactual-memory own"
            )
        return self._replace(spec=dataclasses.replace(self.spec, counterfactual_memory=memory))

    def make_agent_loop(self, compiled_world: CompiledWorld) -> AgentLoop:
        """Agent loop of these policies in the scenes of a world.

        Raises:
          InputError: the scenes are compiled for other rules, or the method cannot act in them.
        """
        rule_differences = list_differences(
            dataclasses.asdict(self.task.rules), dataclasses.asdict(compiled_world.env.task.rules)
        )
        if rule_differences:
            raise InputError(
                f"the policies were trained under other rules than those of the scenes (policy != scenes): "
                f"{'; '.join(rule_differences)}; train with the rules of the scenes, such as by --worlds.front-cell"
            )

        # Some methods refuse scenes, such as those that are larger than their map.
        compiled_world.check_method(self.spec.method, self.knowledge)
        return AgentLoop(
            compiled_world.env,
            spec=self.spec,
            estimator_config=self.estimator_config,
            inner_steps=self.inner_steps,
            fallback_spec=self.fallback_spec,
            use_own_fallback=self.use_own_fallback,
        )


def adapt_counts(estimator_config: EstimatorConfig, task: Task) -> EstimatorConfig:
    """Let an estimator count presence where the observation rows of a task hold no instance counts."""
    if task.instance_counts:
        return estimator_config
    return dataclasses.replace(estimator_config, counts="presence")


def estimators_by_gap(estimator_config: EstimatorConfig) -> dict[GapName, EstimatorConfig]:
    """Variants of a layout estimator, one for each measure of the gap.

    All variants keep the layout weights. `clock` reproduces the gap of the released code: the gap appears at once when
    a new category is seen, and then vanishes in steps.
    """
    gap_estimators: dict[GapName, EstimatorConfig] = {}
    for gap_name in get_args(GapName):
        gap_estimators[gap_name] = dataclasses.replace(estimator_config, gap=gap_name)
    gap_estimators["clock"] = dataclasses.replace(gap_estimators["clock"], passes=ESTIMATORS["released"].passes)
    return gap_estimators


def export_policy(
    folder: Path,
    config: RunConfig,
    params: dict[str, Any],
    knowledge: Knowledge,
    estimator_config: EstimatorConfig | None,
    explored: Exploration,
) -> None:
    """Export one policy, with everything that acting with it takes.

    Args:
      folder: target folder, made if missing.
      config: configuration of the run.
      params: network parameters.
      knowledge: priors and method knowledge from before training.
      estimator_config: layout estimator; None without the layout.
      explored: random walks behind the priors.
    """
    # Fields, as JSON.
    policy_spec = config.policy_spec(len(config.task.categories))
    fields = policy_spec.to_json() | {
        "categories": list(config.task.categories),
        "task": dataclasses.asdict(config.task),
        "layout": None if estimator_config is None else dataclasses.asdict(estimator_config),
        "prior_steps": int(explored.steps),
        "prior_poses": int(explored.poses),
    }

    # Arrays, by group.
    arrays = knowledge_to_arrays(knowledge) | {"policy": jax.device_get(params)}
    arrays["layout"]["counts"] = np.asarray(explored.prior_counts)

    export_params(folder, arrays, fields, _complete_fields)


def _complete_fields(fields: dict[str, Any]) -> dict[str, Any]:
    """Add the fields that an export of an earlier version lacks, with the values that its loader gives them."""
    try:
        policy_spec = PolicySpec.from_json(fields, find_method(fields["method"]), len(fields["categories"]))
        estimator_fields = fields["layout"]
        completed = policy_spec.to_json() | {
            "task": dataclasses.asdict(Task.from_json(fields["task"])),
            "layout": None if estimator_fields is None else dataclasses.asdict(EstimatorConfig(**estimator_fields)),
        }
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return fields  # this version cannot load it, so it is another policy
    return fields | json.loads(json.dumps(completed))


def knowledge_to_arrays(knowledge: Knowledge) -> dict[str, Any]:
    """Return knowledge from before training as nested dicts of NumPy arrays, by groups of an export."""
    arrays = {"layout": {"prior": np.asarray(knowledge.priors)}}
    if knowledge.method:
        arrays["knowledge"] = jax.device_get(knowledge.method)
    if knowledge.cooccurrence is not None:
        evidence = jax.device_get(knowledge.cooccurrence)
        arrays["signs"] = {"odds": evidence.log_odds, "chance": evidence.co_visibility}
        if evidence.near_log_odds is not None:
            arrays["signs"]["near_odds"] = evidence.near_log_odds
    return arrays


def knowledge_from_arrays(arrays: Mapping[str, Any]) -> Knowledge:
    """Return the knowledge in the arrays of an export, on the device; the inverse of `knowledge_to_arrays`."""
    # Exports of baselines have no co-occurrence evidence.
    cooccurrence = None
    if "signs" in arrays:
        evidence_arrays = arrays["signs"]
        near_log_odds = evidence_arrays.get("near_odds")  # missing in exports of earlier versions
        cooccurrence = CooccurrenceEvidence(
            jnp.asarray(evidence_arrays["odds"]),
            jnp.asarray(evidence_arrays["chance"]),
            None if near_log_odds is None else jnp.asarray(near_log_odds),
        )
    return Knowledge(
        priors=jnp.asarray(arrays["layout"]["prior"]),
        method=jax.tree.map(jnp.asarray, arrays.get("knowledge", {})),
        cooccurrence=cooccurrence,
    )


def load_policies(config: RunConfig, arms: Sequence[str] | None = None) -> Policies:
    """Load the exported policies of a run.

    Args:
      config: configuration of the run.
      arms: names of the arms to load; None for all.

    Raises:
      InputError: training has not finished, an arm was not trained, or an export is damaged.
    """
    arms = tuple(config.arms if arms is None else arms)
    for arm in arms:
        if arm not in config.arms:
            raise InputError(f"{config.run_dir}: was trained without the arm {arm!r}; train a run with both --arms")

    # Look for all folders before reading any.
    export_folders = []
    for arm in arms:
        for seed in range(config.seeds):
            export_folders.append((arm, config.run_dir / POLICIES_DIR / f"{arm}-{seed}"))
    for _, folder in export_folders:
        if not folder.exists():
            raise InputError(
                f"{folder}: is missing, so training has not finished; resume it by jaxnav train (of a batch, give the "
                "folder of one run, such as RUN/0)"
            )
    loaded_exports = [load_params(folder) for _, folder in export_folders]

    # The last seed of the layout arm (else of the last arm) is the reference: its settings hold for all.
    reference_arm = "layout" if "layout" in arms else arms[-1]
    reference_index = config.seeds * (arms.index(reference_arm) + 1) - 1
    reference_folder = export_folders[reference_index][1]
    reference_fields = loaded_exports[reference_index][1]

    # Every policy must agree with the reference, except that baselines have no layout estimator.
    parsed_policies = []
    for (arm, folder), (arrays, fields) in zip(export_folders, loaded_exports, strict=True):
        parsed_policies.append(_parse_export(folder, arrays, fields))
        if arm != reference_arm:
            fields = fields | {"layout": reference_fields["layout"]}
        field_differences = list_differences(fields, reference_fields)
        if field_differences:
            raise InputError(
                f"{folder}: was not trained in the run of {reference_folder}: {'; '.join(field_differences)}; "
                "train the run again"
            )

    # The task may have changed with the version of jaxnav. Fields that are new since then have their default values.
    trained_task = parsed_policies[reference_index].task
    field_differences = list_differences(_task_fields(trained_task), _task_fields(config.task))
    if field_differences:
        raise InputError(
            f"{reference_folder}: its task differs from that of its run (policy != run): "
            f"{'; '.join(field_differences)}; use the version that trained the run"
        )

    # Leaves [A S, ...], arm by arm.
    params_by_policy = [policies.params for policies in parsed_policies]
    params = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *params_by_policy)
    return parsed_policies[reference_index]._replace(params=params, arms=arms)


def read_exported_policy(folder: Path) -> Policies:
    """Read one exported policy; its parameters have no leading axis, and `arms` is empty.

    Raises:
      InputError: the export is missing, damaged or of another version.
    """
    return _parse_export(folder, *load_params(folder))


def _parse_export(folder: Path, arrays: dict[str, Any], fields: dict[str, Any]) -> Policies:
    """Build policies from the contents of one export; see `read_exported_policy`."""
    require_float32()
    try:
        # The specification decides which arrays there must be.
        method = find_method(fields["method"])
        _refuse_former_relations(method, fields)
        if method.learn is not None and "knowledge" not in arrays:
            raise InputError(f"the statistics of method {fields['method']!r} are missing; train the run again")
        policy_spec = PolicySpec.from_json(fields, method, len(fields["categories"]))
        check_arrays(folder, arrays, policy_spec)

        # Network parameters, on the device.
        params = jax.tree.map(jnp.asarray, arrays["policy"])

        # Knowledge from before training.
        knowledge = knowledge_from_arrays(arrays)
        if knowledge.method:
            check_knowledge(params, policy_spec, knowledge)

        # A single policy has no arms.
        estimator_fields = fields["layout"]
        return Policies(
            params=params,
            arms=(),
            knowledge=knowledge,
            prior_counts=jnp.asarray(arrays["layout"]["counts"]),
            spec=policy_spec,
            estimator_config=None if estimator_fields is None else EstimatorConfig(**estimator_fields),
            prior_steps=fields["prior_steps"],
            task=Task.from_json(fields["task"]),
        )
    except InputError as error:
        raise InputError(f"{folder}: {str(error).removeprefix(f'{folder}: ')}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{folder}: its spec does not fit this code ({type(error).__name__}: {error}); train the run again"
        ) from error


def _refuse_former_relations(method: Method, fields: Mapping[str, Any]) -> None:
    """Refuse a policy that was trained while ORG's relation matrix was not transposed (jaxnav 0.3 and earlier).

    Its arrays fit this code, so that without a refusal the policy would load and decide differently.

    Raises:
      InputError: the method computes ORG's relations, and the specification is of jaxnav 0.3 or earlier.
    """
    # Exports have the kind of the layout weights since 0.4.
    is_earlier_export = "weight_kind" not in fields
    if is_earlier_export and issubclass(method.experience, ObjectRelations):
        raise InputError(
            "was trained before jaxnav 0.4, which corrected the relations of org; "
            "train it again, or use it with jaxnav 0.3"
        )


def check_arrays(folder: Path, arrays: Mapping[str, Any], spec: PolicySpec) -> None:
    """Refuse arrays of the wrong shape or dtype, or with numbers that are not finite.

    Args:
      folder: folder of the export, for messages.
      arrays: arrays of the export, as `load_params` returns them.
      spec: specification of the policy.

    Raises:
      InputError: names the arrays.
    """
    # Shapes and dtypes. Exports of runs without the layout have no group `signs`.
    expected_arrays = dict(_expected_arrays(spec))
    if "signs" not in arrays:
        del expected_arrays["signs"]
    elif "near_odds" not in arrays["signs"]:  # an export of an earlier version
        expected_arrays["signs"] = {name: expected_arrays["signs"][name] for name in ("odds", "chance")}
    present_arrays = {name: arrays.get(name, {}) for name in expected_arrays}
    field_differences = list_differences(describe_arrays(present_arrays), describe_arrays(expected_arrays))
    if field_differences:
        raise InputError(
            f"{folder}: its arrays do not fit its spec (found != expected): {'; '.join(field_differences)}; "
            "train the run again"
        )

    # Refuse NaN and infinities.
    for path, leaf in jax.tree_util.tree_leaves_with_path(arrays):
        if not np.isfinite(leaf).all():
            array_name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise InputError(f"{folder}: {array_name} contains numbers that are not finite; train the run again")


@functools.lru_cache(maxsize=16)
def _expected_arrays(spec: PolicySpec) -> dict[str, Any]:
    """Shapes and dtypes of all arrays but the method's knowledge."""
    category_pairs = jax.ShapeDtypeStruct((NUM_PRIORS, spec.num_categories, spec.num_categories), jnp.float32)
    near_pairs = jax.ShapeDtypeStruct((NUM_PRIORS, NUM_NEAR_FEATURES, *category_pairs.shape[1:]), jnp.float32)
    return {
        "policy": jax.eval_shape(functools.partial(init_params, spec), jax.random.key(0)),
        "layout": {"prior": category_pairs, "counts": category_pairs},
        "signs": {"odds": category_pairs, "chance": category_pairs, "near_odds": near_pairs},
    }


def check_knowledge(params: Params, spec: PolicySpec, knowledge: Knowledge) -> None:
    """Refuse method knowledge with which the policy cannot act.

    One step is traced without computing it.

    Raises:
      InputError: names the error of the trace.
    """
    row_format = RowFormat(spec.num_categories)
    perception = Perception(row_format, spec)
    zero_index = jnp.int32(0)

    def act_once(params: Params, knowledge: Knowledge) -> Any:
        # Perceive an empty view.
        row = jnp.zeros(row_format.num_bytes, jnp.uint8)
        percept = Percept(
            row, heading=zero_index, action=zero_index, moved=jnp.bool_(False), horizon=zero_index, goal=zero_index
        )
        perception_state = perception.init(knowledge, zero_index)
        perception_state = perception.update(perception_state, percept, knowledge, zero_index)
        inputs = perception.policy_inputs(perception_state, Observation(row, goal=zero_index), knowledge)

        # Build the pathways, and turn a choice into an action.
        policy = bind(spec, params)
        pathways = policy.pathways(inputs, policy.initial_memory())
        return pathways, spec.method.control.act(zero_index, perception_state.tracker_state, knowledge)

    try:
        jax.eval_shape(act_once, params, knowledge)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        error_line = str(error).split("\n", maxsplit=1)[0]
        raise InputError(
            f"the statistics of method {spec.method.name!r} do not fit the method "
            f"({type(error).__name__}: {error_line}); train the run again"
        ) from error


def find_policy_folder(path: str | Path) -> Path:
    """Folder of an exported policy.

    Args:
      path: the folder, or the name of a policy that comes with the package.

    Raises:
      InputError: neither exists, or a run is there; names the policies of the package, or those of the run.
    """
    folder = _resolve_folder(path)
    if not folder.exists():
        packaged_names = ", ".join(list_packaged_policies())
        raise InputError(
            f"{path}: not an exported policy (No such file or directory: {path}); export it, "
            f"or load one of the package: {packaged_names}"
        )
    if (folder / CONFIG_FILE).exists() and not (folder / POLICY_FILE).exists():
        policy_folders = sorted(
            str(policy_file.parent) for policy_file in folder.glob(f"{POLICIES_DIR}/*/{POLICY_FILE}")
        )
        remedy = f"give one of its policies: {', '.join(policy_folders)}"
        if not policy_folders:
            remedy = "its training has not finished; resume it by jaxnav train"
        raise InputError(
            f"{path}: not an exported policy (No such file or directory: {folder / POLICY_FILE}) but a run; {remedy}"
        )
    return folder


def list_packaged_policies() -> list[str]:
    """Names of the policies that come with the package, sorted."""
    return sorted(folder.parent.name for folder in PACKAGED_POLICIES.glob(f"*/{POLICY_FILE}"))


def is_policy(path: str | Path) -> bool:
    """True where an exported policy exists; see `find_policy_folder`."""
    return (_resolve_folder(path) / POLICY_FILE).exists()


def check_path(path: object) -> None:
    """Refuse an argument that is no path.

    Raises:
      InputError: names the type of the argument.
    """
    if not isinstance(path, str | os.PathLike):
        raise InputError(
            f"{type(path).__name__} is no path; give the directory of a run, the folder of an exported policy or the "
            "name of a packaged one, as text"
        )


def _resolve_folder(path: str | Path) -> Path:
    check_path(path)
    folder = expand_home(path)
    return folder if folder.exists() else PACKAGED_POLICIES / path


def load_policy_as_run(path: str | Path) -> tuple[RunConfig, Policies]:
    """Load one exported policy as if a run had trained it with one seed.

    Raises:
      InputError: see `config_for_policy`.
    """
    config = config_for_policy(path)
    policies = read_exported_policy(find_policy_folder(path))
    params = jax.tree.map(lambda leaf: leaf[None], policies.params)
    return config, policies._replace(params=params, arms=config.arms)


def config_for_policy(path: str | Path) -> RunConfig:
    """Run configuration with the generated world whose task an exported policy was trained for.

    Raises:
      InputError: no such policy, or no generated world has its task.
    """
    folder = find_policy_folder(path)
    policies = read_exported_policy(folder)
    arm = "baseline" if policies.estimator_config is None else "layout"
    config = config_for_task(policies.task, policies.spec.method.name, arm)
    if config is None:
        raise InputError(
            f"{folder}: was trained for a task that no generated world has; give the run that it comes from"
        )
    return config


def config_for_task(task: Task, method: str, arm: str) -> RunConfig | None:
    """Run configuration of one seed in the generated world of a task; None if no generated world has the task.

    Args:
      task: task of the policy.
      method: name of its method.
      arm: `baseline` or `layout`.
    """
    # Rules and categories identify a generated world; goals, detector and front cell may differ from its defaults.
    layout = LayoutConfig(counts="instances" if task.instance_counts else "presence")
    for name, world in WORLDS.items():
        goals = None if world.task.goals == task.goals else task.goals
        config = dataclasses.replace(
            RunConfig(),
            world=name,
            method=method,
            arms=(arm,),
            seeds=1,
            layout=layout,
            worlds=WorldConfig(goals=goals, front_cell=task.rules.front_cell),
            detector=task.detector,
        )
        if config.task == task:
            return config
    return None


def _task_fields(task: Task) -> dict[str, Any]:
    """Fields of a task as JSON reads them back, with lists in place of tuples."""
    return json.loads(json.dumps(dataclasses.asdict(task)))
