"""A trained policy as an agent: acting on observations, exporting its step as a program, and its model card.

`load_policy` reads an exported policy as a `LoadedPolicy`. Call `LoadedPolicy.init` at the start of an episode and
`LoadedPolicy.act` at every step; `decide` and `apply_choice` are the two halves of `act`. `export_program` compiles the
step with `jax.export`, for programs that run without this package, and `format_model_card` describes an export.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
from flax import struct

from jaxnav import __version__
from jaxnav.causal import FORMS, remove_experience
from jaxnav.choices import EstimatorName, Form
from jaxnav.env.objectnav import OTHER_ROOM, ObjectNav, Observation, prior_index
from jaxnav.errors import InputError, check_choice
from jaxnav.layout import EstimatorConfig
from jaxnav.policies.agent_loop import Perception, PerceptionState, decide_counterfactually
from jaxnav.policies.method import Knowledge, Percept
from jaxnav.policies.network import Params, bind
from jaxnav.policies.pathways import Decision, PolicyState
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.policies import find_policy_folder, read_exported_policy
from jaxnav.runs.run import Run
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.task import Task
from jaxnav.store.files import list_differences

#: Platforms that exported programs are compiled for.
PLATFORMS = ("cpu", "cuda", "tpu")
#: Arrays of an episode memory by name.
NamedArrays = Mapping[str, jax.Array]


class EpisodeMemory(NamedTuple):
    """State of an agent between two steps of an episode.

    Attributes:
      policy_state: recurrent state of the network and the previous action.
      perception_state: layout belief, spatial map and tracker state.
      room: int32 [], index of the room type's layout prior.
    """

    policy_state: PolicyState
    perception_state: PerceptionState
    room: jax.Array


class PolicyOutput(NamedTuple):
    """Decision for one observation, with its factual and counterfactual parts.

    Attributes:
      logits: float32 [C], logits of the choice: sTDE (eq. 2) where the policy uses the layout, else the factual logits.
      factual: float32 [C], factual logits a.
      counterfactual: float32 [C], counterfactual logits a_bar; None where the policy does not use the layout.
      gap: float32 [], layout gap D; None where the policy does not use the layout.
      weights: float32 [K], layout weights, the goal's column of w (eq. 7); None where the policy does not use the
        layout.
      perception_state: layout belief, spatial map and tracker state, with this observation.
      decision: factual output of the network, which becomes the policy state once the action is known.
    """

    logits: jax.Array
    factual: jax.Array
    counterfactual: jax.Array | None
    gap: jax.Array | None
    weights: jax.Array | None
    perception_state: PerceptionState
    decision: Decision


class LoadedPolicy(struct.PyTreeNode):
    """Agent that acts on observations.

    The agent is a pytree, so its methods may be jitted and vmapped.

    Attributes:
      params: network parameters.
      knowledge: priors and method knowledge from before training.
      spec: specification of the network.
      estimator_config: layout estimator; None where the policy does not use the layout.
      task: task of the training.
    """

    params: Params
    knowledge: Knowledge
    spec: PolicySpec = struct.field(pytree_node=False)
    estimator_config: EstimatorConfig | None = struct.field(pytree_node=False)
    task: Task = struct.field(pytree_node=False)

    def init(self, room_type: str | None = None) -> EpisodeMemory:
        """Memory at the start of an episode.

        Args:
          room_type: `kitchen`, `living_room`, `bedroom` or `bathroom`, which selects the layout prior; None for homes
            and unknown rooms.

        Raises:
          InputError: unknown room type.
        """
        if room_type is not None and room_type not in ROOM_TYPES:
            raise InputError(f"room_type {room_type!r}: choose one of {', '.join(ROOM_TYPES)}, or None")
        return self.begin(jnp.int32(OTHER_ROOM if room_type is None else prior_index(room_type)))

    def begin(self, room: jax.Array) -> EpisodeMemory:
        """Memory at the start of an episode in a room with layout prior `room`, int32 []."""
        policy_state = bind(self.spec, self.params).initial_memory()
        return EpisodeMemory(policy_state, self._perception.init(self.knowledge, room), room)

    def act(
        self,
        observation: Observation,
        memory: EpisodeMemory,
        epsilon: jax.Array | float = 0.5,
        *,
        key: jax.Array | None = None,
        heading: jax.Array | int | None = None,
        moved: jax.Array | bool | None = None,
        horizon: jax.Array | int | None = None,
    ) -> tuple[jax.Array, EpisodeMemory]:
        """Choose an action for one observation.

        A policy that uses the layout removes experience by sTDE (eq. 2).

        Args:
          observation: observation of one episode.
          memory: memory from `init`, or from the previous step.
          epsilon: threshold of sTDE, may be traced. No experience is removed for epsilon >= 1.
          key: PRNG key to sample the action with; None for the best action.
          heading: compass heading, needed by policies with a spatial memory and by methods with a tracker.
          moved: True where the previous action changed the cell; needed like `heading`.
          horizon: index of the camera's horizon, 0 for level; needed by methods with a tracker.

        Returns:
          The action int32 [], and the memory for the next step.

        Raises:
          InputError: heading, moved or horizon is needed and missing.
        """
        # Best action, or one sampled from the logits.
        output = self.decide(observation, memory, epsilon, heading=heading, moved=moved, horizon=horizon)
        choice = jnp.argmax(output.logits) if key is None else jax.random.categorical(key, output.logits)
        return self.apply_choice(output, choice.astype(jnp.int32), memory.room)

    def decide(
        self,
        observation: Observation,
        memory: EpisodeMemory,
        epsilon: jax.Array | float = 0.5,
        *,
        heading: jax.Array | int | None = None,
        moved: jax.Array | bool | None = None,
        horizon: jax.Array | int | None = None,
    ) -> PolicyOutput:
        """Perceive one observation and compute the logits of all choices; see `act`.

        Raises:
          InputError: heading, moved or horizon is needed and missing.
        """
        # Refuse observations without the odometry that this policy reads.
        perception = self._perception
        if perception.uses_odometry and (heading is None or moved is None):
            raise InputError("act: this policy reads compass and odometry; give `heading` and `moved`")
        if perception.tracker is not None and horizon is None:
            raise InputError("act: this policy reads the tilt of the camera; give `horizon`")

        # Update belief, map and tracker with the observation.
        percept = Percept(
            observation.row,
            heading=jnp.int32(0 if heading is None else heading),
            action=memory.policy_state.action,
            moved=jnp.bool_(moved is not None and moved),
            horizon=jnp.int32(0 if horizon is None else horizon),
            goal=observation.goal,
        )
        perception_state = perception.update(memory.perception_state, percept, self.knowledge, memory.room)
        inputs = perception.policy_inputs(perception_state, observation, self.knowledge)

        # Factual decision.
        policy = bind(self.spec, self.params)
        pathways = policy.pathways(inputs, memory.policy_state)
        decision = policy.decide(pathways, memory.policy_state)
        factual = decision.logits
        layout = perception_state.layout
        if layout is None or self.estimator_config is None:
            return PolicyOutput(
                logits=factual,
                factual=factual,
                counterfactual=None,
                gap=None,
                weights=None,
                perception_state=perception_state,
                decision=decision,
            )

        # Counterfactual decision under do(S = 0, G = 0) with the factual experience, and its removal.
        counterfactual = decide_counterfactually(policy, pathways, memory.policy_state).logits
        logits = remove_experience(
            factual,
            counterfactual,
            layout.gap,
            epsilon,
            self.estimator_config.form,
            has_additive_scores=policy.has_additive_scores,
        )
        return PolicyOutput(
            logits, factual, counterfactual, layout.gap, inputs.layout_weights, perception_state, decision
        )

    def apply_choice(self, output: PolicyOutput, choice: jax.Array, room: jax.Array) -> tuple[jax.Array, EpisodeMemory]:
        """Turn a choice into an action, and advance the memory.

        Args:
          output: result of `decide`.
          choice: int32 [], index into the logits.
          room: int32 [], index of the layout prior; `EpisodeMemory.room` of the same episode.

        Returns:
          The action int32 [], and the memory for the next step.
        """
        # Methods with a control of their own turn choices into actions; their tracker follows.
        perception_state = output.perception_state
        action, tracker_state = self.spec.method.control.act(choice, perception_state.tracker_state, self.knowledge)
        perception_state = perception_state._replace(tracker_state=tracker_state)
        return action, EpisodeMemory(output.decision.next_state(action), perception_state, room)

    @property
    def _perception(self) -> Perception:
        return Perception(self.task.row_format, self.spec, self.estimator_config, self.task.rules)


def load_policy(
    path: str | Path,
    setting: EstimatorName | None = None,
    hold: bool = False,
    form: Form | None = None,
    env: ObjectNav | None = None,
) -> LoadedPolicy:
    """Load an exported policy.

    Args:
      path: folder of one policy, such as `runs/rooms/policies/layout-0`; or the name of one that comes with the
        package: `rooms-org`, `apartments-org`, `houses-org`, `apartments-belief` or `houses-belief`.
      setting, hold: layout estimator to use in place of the policy's; see `Policies.with_estimator`.
      form: form in which sTDE combines the logits; None for the form of the estimator.
      env: environment in which the policy will act, to check that they fit; None skips the check.

    Raises:
      InputError: the export is missing or damaged, its method cannot be found, the setting or form is impossible, or
        the policy was trained with other categories or rules than `env` has.
    """
    check_choice("--form", form, FORMS)

    # The layout estimator may replace the one in the export.
    policies = read_exported_policy(find_policy_folder(path)).with_estimator(setting, hold)
    estimator_config = policies.estimator_config
    if estimator_config is not None and form is not None:
        estimator_config = dataclasses.replace(estimator_config, form=form)
    # Categories and rules must equal the trained ones, and so must the kind of rows if the estimator counts instances.
    if env is not None:
        _check_task(path, policies.task, env.task, estimator_config)
    return LoadedPolicy(policies.params, policies.knowledge, policies.spec, estimator_config, policies.task)


def _check_task(path: str | Path, trained_task: Task, env_task: Task, estimator_config: EstimatorConfig | None) -> None:
    """Check that an environment has the categories and rules of training; goals and detector errors may differ.

    An estimator that counts instances also needs the rows of training.
    """
    counts_instances = estimator_config is not None and estimator_config.counts == "instances"

    def compared_fields(task: Task) -> dict[str, Any]:
        fields: dict[str, Any] = {"categories": task.categories, "rules": dataclasses.asdict(task.rules)}
        return fields | {"instance_counts": task.instance_counts} if counts_instances else fields

    task_differences = list_differences(compared_fields(trained_task), compared_fields(env_task))
    if task_differences:
        raise InputError(
            f"{path}: was trained for another task than that of `env` (policy != env): {'; '.join(task_differences)}; "
            "make an environment with the task of the policy: jaxnav.make(..., task=jaxnav.load_policy(...).task)"
        )


def export_program(policy: LoadedPolicy) -> bytes:
    """Export `policy_step` as a program for any number of parallel episodes.

    `jax.export.deserialize(program).call(inputs, epsilon)` runs it where JAX and flatbuffers are installed.

    Raises:
      InputError: flatbuffers, which writes the program, is missing.
    """

    def step_episodes(inputs: Mapping[str, Any], epsilon: jax.Array) -> dict[str, Any]:
        return jax.vmap(functools.partial(policy_step, policy), (0, None))(inputs, epsilon)

    # A symbolic batch size allows any number of episodes.
    (num_episodes,) = jax.export.symbolic_shape("episodes")
    epsilon_shape = jax.ShapeDtypeStruct((), jnp.float32)
    export = jax.export.export(jax.jit(step_episodes), platforms=PLATFORMS)
    exported_program = export(input_shapes(policy, num_episodes), epsilon_shape)
    try:
        return bytes(exported_program.serialize())
    except ImportError as error:
        raise InputError("stablehlo: needs flatbuffers; install it with: pip install 'jaxnav[export]'") from error


def policy_step(policy: LoadedPolicy, inputs: Mapping[str, Any], epsilon: jax.Array) -> dict[str, Any]:
    """Take one step of one episode, with named arrays.

    Args:
      policy: the agent.
      inputs: arrays as described in `input_shapes`, without the leading axis.
      epsilon: float32 [], threshold of sTDE.

    Returns:
      `action` int32 [], the best action; `logits` and `factual` float32 [C]; where the policy uses the layout
      `counterfactual` float32 [C], `gap` float32 [] and `weights` float32 [K], the goal's column of w (eq. 7);
      `memory`.
    """
    # Programs take detections, view and counts as arrays; the policy reads them packed into a row.
    row_format = policy.task.row_format
    row = row_format.pack(inputs["detections"], inputs["view"], inputs["counts"] if row_format.has_counts else None)
    observation = Observation(row, inputs["goal"])

    # Memory of the first step of an episode, or memory of the previous step with its action.
    initial_memory = policy.begin(inputs["room"])
    previous_memory = _memory_from_names(inputs["memory"], initial_memory)
    policy_state = previous_memory.policy_state._replace(action=inputs["action"])
    previous_memory = previous_memory._replace(policy_state=policy_state, room=inputs["room"])
    memory = jax.tree.map(functools.partial(jnp.where, inputs["first"]), initial_memory, previous_memory)

    # Decide on the best action.
    output = policy.decide(
        observation,
        memory,
        epsilon,
        heading=inputs["heading"],
        moved=inputs["moved"] & ~inputs["first"],
        horizon=inputs["horizon"],
    )
    choice = jnp.argmax(output.logits).astype(jnp.int32)
    action, memory = policy.apply_choice(output, choice, memory.room)

    # Counterfactual outputs exist only with the layout.
    step_outputs = {
        "action": action,
        "logits": output.logits,
        "factual": output.factual,
        "memory": _memory_by_name(memory),
    }
    if output.counterfactual is not None:
        step_outputs |= {
            "counterfactual": output.counterfactual,
            "gap": output.gap,
            "weights": output.weights,
        }
    return step_outputs


def input_shapes(policy: LoadedPolicy, batch: Any) -> dict[str, Any]:
    """Shapes and dtypes of the inputs of a step.

    Args:
      policy: the agent.
      batch: number of episodes B, may be symbolic.

    Returns:
      detections: uint8 [B, K, 4], confidence, ahead, right and apparent size; see `RowFormat`.
      view: uint8 [B, V, V], 0 unknown, 1 free, 2 blocked; row 0 is nearest to the agent, column 0 leftmost.
      counts: uint8 [B, K], detected instances of each category; only for tasks with instance counts.
      goal: int32 [B], index of a category.
      action: int32 [B], previous action.
      heading: int32 [B], clockwise.
      moved: bool [B], True where the previous action changed the cell.
      horizon: int32 [B], index of the camera's horizon.
      room: int32 [B], index of the room type's prior.
      first: bool [B], True where an episode begins; `action`, `moved` and `memory` are not read there.
      memory: output `memory` of the previous step, by name.
    """
    row_format = policy.task.row_format
    index_shape = jax.ShapeDtypeStruct((), jnp.int32)
    flag_shape = jax.ShapeDtypeStruct((), jnp.bool_)
    # Shapes of one episode; the batch axis comes last.
    episode_shapes = {
        "detections": jax.ShapeDtypeStruct((row_format.num_categories, 4), jnp.uint8),
        "view": jax.ShapeDtypeStruct((row_format.view, row_format.view), jnp.uint8),
        "goal": index_shape,
        "action": index_shape,
        "heading": index_shape,
        "horizon": index_shape,
        "room": index_shape,
        "moved": flag_shape,
        "first": flag_shape,
        "memory": _memory_by_name(jax.eval_shape(policy.begin, index_shape)),
    }
    if row_format.has_counts:
        episode_shapes["counts"] = jax.ShapeDtypeStruct((row_format.num_categories,), jnp.uint8)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((batch, *leaf.shape), leaf.dtype), episode_shapes)


def _memory_by_name(memory: EpisodeMemory) -> dict[str, Any]:
    """Arrays of a memory by their paths, such as `policy_state/hidden`."""
    leaves_with_path, _ = jax.tree.flatten_with_path(memory)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves_with_path}


def _memory_from_names(arrays: NamedArrays, template: EpisodeMemory) -> EpisodeMemory:
    """Memory with the structure of `template` and the arrays of `_memory_by_name`."""
    # Both directions use the same order of leaves.
    memory_leaves = [arrays[name] for name in _memory_by_name(template)]
    return jax.tree.unflatten(jax.tree.structure(template), memory_leaves)


#: Sentence by which a model card of this package is recognized.
MODEL_CARD_SIGNATURE = "A policy for object navigation on a grid, exported by jaxnav."

_ARM_DESCRIPTIONS = {
    "baseline": "no layout weights",
    "layout": "layout weights (eq. 7); experience is removed by sTDE (eq. 2)",
}

_MODEL_CARD = """\
# {title}

{signature}

{facts}

## Files

{files}

## Use

{usage}

## Limits

The policy was trained on a grid with a simulated detector, never on images, and only for the categories of its task.
The val scenes also selected the policy during training, so the success in them is not a test result.
"""


def format_model_card(
    run: Run, policy_name: str, policy: LoadedPolicy, file_descriptions: Mapping[str, str], usage_lines: Iterable[str]
) -> str:
    """Format the model card of a policy of a run.

    Args:
      run: the run that trained the policy.
      policy_name: name of the policy in the run, such as `layout-0`.
      policy: the policy.
      file_descriptions: description of each file of the export, by name.
      usage_lines: lines of Markdown that show how to use the export.

    Returns:
      The card, as Markdown.
    """
    config = run.config
    arm, _, seed = policy_name.rpartition("-")

    # Scenes, environment steps and size, in words.
    num_categories = len(config.task.categories)
    scene_text = f"scenes of `{config.scenes.name}`" if config.scenes else "generated scenes"
    step_texts = []
    for purpose, num_steps in config.steps_by_purpose.items():
        if num_steps:
            step_texts.append(f"{num_steps:,} of {purpose}")
    num_parameters = sum(leaf.size for leaf in jax.tree.leaves(policy.params))

    # Method, training and goals of the policy.
    card_facts = {
        "Method": f"`{config.method}`, decision `{config.decision}`, {_ARM_DESCRIPTIONS[arm]}",
        "Trained in": f"{scene_text}, rules of `{config.world}`, {num_categories} categories, training seed {seed}",
        "Environment steps": ", ".join(step_texts),
        "Success in val scenes": _describe_success(run.success_by_budget(), arm),
        "Parameters": f"{num_parameters:,}",
        "Looks for": ", ".join(config.task.goals or config.task.categories),
        "Version": f"jaxnav {__version__}",
    }
    # Lists in Markdown.
    fact_lines = []
    for fact_name, fact_text in card_facts.items():
        fact_lines.append(f"* **{fact_name}**: {fact_text}")
    file_lines = []
    for file_name, file_description in file_descriptions.items():
        file_lines.append(f"* `{file_name}`: {file_description}")

    return _MODEL_CARD.format(
        title=f"{policy_name} of {config.run_dir.name}",
        signature=MODEL_CARD_SIGNATURE,
        facts="\n".join(fact_lines),
        files="\n".join(file_lines),
        usage="\n".join(usage_lines),
    )


def _describe_success(success_by_budget: dict[str, Any] | None, arm: str) -> str:
    """Success of an arm's policies within the longest budget."""
    if success_by_budget is None:
        return "not measured"
    # The last budget is the longest step limit, so it has the success of whole episodes.
    success_curves = success_by_budget["val"][arm]
    best_success = 100.0 * success_curves["argmax"][-1]
    sampled_success = 100.0 * success_curves["sample"][-1]
    return (
        f"{best_success:.1f} % with best actions, {sampled_success:.1f} % with sampled ones, "
        f"the mean of all seeds of `{arm}`"
    )
