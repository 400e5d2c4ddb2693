"""Configuration of a training run.

`RunConfig` holds the settings of a run and derives from them its task, stages and schedule. `check_config` completes a
configuration and refuses impossible settings.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from jaxnav.errors import InputError
from jaxnav.layout import Reduction
from jaxnav.policies.method import Method, Stage
from jaxnav.policies.methods import find_method
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import DecisionKind, Direct, PolicySpec, Sizes
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import NUM_ACTIONS, Task
from jaxnav.scenes.worlds import WORLDS
from jaxnav.training.config import CounterfactualTraining, PPOConfig, stage_index_at
from jaxnav.training.devices import Devices

Arm = Literal["baseline", "layout"]
#: Kinds of policies: without and with the layout estimator. They differ only in the layout weights.
ARMS: tuple[Arm, ...] = ("baseline", "layout")


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Scenes and lengths of episodes.

    None stands for the default of the world.

    Attributes:
      num_train, num_val, num_test: number of generated scenes in each split.
      seed: seed of the scene generator.
      shift: layout shift of the scenes, from 0 to 1: share of the categories that exchange their places.
      categories: categories that the agent can detect.
      goals: categories that can be goals; None with `categories` of your own: all of them.
      train_step_limit: maximum number of actions in a training episode.
      step_limit: maximum number of actions in an evaluation episode.
      large_step_limit: maximum number of actions in an evaluation episode in a living room.
      shaping: training reward for every metre by which the agent is nearer to the goal than before in the episode.
      near_starts: probability that a training episode starts near its goal, in the nearest of eight random cells.
      shard_scenes: number of scenes in a shard. With more scenes, they are compiled to disk and streamed from there.
    """

    num_train: int | None = None
    num_val: int | None = None
    num_test: int | None = None
    seed: int = 0
    shift: float = 0.0
    categories: tuple[str, ...] | None = None
    goals: tuple[str, ...] | None = None
    train_step_limit: int | None = None
    step_limit: int | None = None
    large_step_limit: int | None = None
    shaping: float | None = None
    near_starts: float | None = None
    shard_scenes: int = 128


@dataclasses.dataclass(frozen=True)
class LayoutConfig:
    """Estimation of the layout.

    Attributes:
      setting: layout estimator.
      strength, reduction: strength of the prior's rows, and reduction over rows in the gap; None calibrates them so
        that the gap behaves as in the paper in the training scenes. Not used by `paper` and `released`.
      prior: one prior for each `room` type, which tells the policy the type of the room, or one `pooled` over all
        rooms.
      walks, steps: number and length of the random walks in the training scenes that collect the prior; the gap
        `learned` takes four times as many walks.
    """

    setting: Literal["paper", "released", "calibrated"] = "calibrated"
    strength: float | None = None
    reduction: Reduction | None = None
    prior: Literal["room", "pooled"] = "room"
    walks: int = 2048
    steps: int = 100


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Settings of a training run.

    Attributes:
      run_dir: directory of the run. Training resumes from its last checkpoint.
      method: how experience is made: a name of this package, an entry point of the group `jaxnav.methods`, or
        `package.module:NAME`.
      world: generated world that sets the task, and the scenes unless `scenes` is given.
      scenes: scene file to read in place of generated scenes; its splits are used.
      arms: kinds of policies to train. A method that cannot host the layout has only the baseline.
      seeds: number of policies of each kind.
      total_steps: environment steps of each policy, imitation included, rounded up to whole chunks; None: the world's
        default. The layout policies have also seen the random steps of the prior (`layout.walks x layout.steps`).
      imitation: share of the steps in which the method imitates shortest paths, in whole chunks; None: the method's
        default.
      seed: seed of all randomness in training.
      counterfactual: training of the branch that counterfactual decisions use.
      decision: how pathways become logits: `fused` before one recurrent core, as in the paper, or as the sum of two
        `streams`. The stream of experience is off at first and in some training episodes (see `ppo.alone` and
        `ppo.experience`); with streams, `direct` is goal and `counterfactual` none.
      direct: detections that the direct pathway of the goal sees.
      spatial_memory: let policies remember, on the direct pathway of the scene, which cells they have seen and visited;
        not in the paper.
      goal_row: give the direct pathway the goal's detection in a separate row too, independent of its category; in the
        paper it is only in the row of its category.
      done_gate: multiply the logit of Done by 0.58 times the confidence that the goal is in sight.
      chunk: updates per compiled call. Between calls the run logs, saves (every `save_every` calls) and, where scenes
        are streamed, continues in the next shard with new episodes.
      save_every: calls between checkpoints.
      validations: number of times that policies are measured in val scenes during training, evenly spaced. The policy
        of each seed with the most success under best actions is exported; with 0, the last one.
      val_episodes: number of episodes in each of these measurements.
      cache: folder for compiled scenes that are streamed from disk.
      method_sizes: sizes that only the method has, whole numbers, where they differ from its defaults.
      devices: devices to train on, which change results only by rounding: a number of devices of this process,
        `cluster` for all that Slurm, Open MPI, Kubernetes or a TPU pod has started this command on, or
        `HOST:PORT,INDEX,PROCESSES` for command number INDEX of several equal ones, which meet at that address of number
        0 and share the file system of `run_dir`; None: one device, with seeds side by side on its cores.
    """

    run_dir: Path = Path("runs/rooms")
    method: str = "org"
    world: Literal["rooms", "apartments", "houses"] = "rooms"
    scenes: Path | None = None
    arms: tuple[Arm, ...] = ARMS
    seeds: int = 3
    total_steps: int | None = None
    imitation: float | None = None
    seed: int = 0
    counterfactual: CounterfactualTraining = "distil"
    decision: DecisionKind = "fused"
    direct: Direct = "all"
    spatial_memory: bool = True
    goal_row: bool = True
    done_gate: bool = False
    chunk: int = 16
    save_every: int = 4
    validations: int = 8
    val_episodes: int = 200
    cache: Path = Path("~/.cache/jaxnav")
    devices: int | str | None = None
    worlds: WorldConfig = WorldConfig()
    detector: Detector = Detector()
    layout: LayoutConfig = LayoutConfig()
    sizes: Sizes = Sizes()
    method_sizes: dict[str, int] = dataclasses.field(default_factory=dict)
    ppo: PPOConfig = PPOConfig()

    @property
    def scene_source(self) -> str | Path:
        """The scene file where one is given, else the name of the generated world."""
        return self.scenes or self.world

    @property
    def task(self) -> Task:
        """Task of the world, with the categories, goals and detector of this configuration."""
        task = WORLDS[self.world].task

        # Your own categories may lack the goals of the world; by default all of them are goals.
        if self.worlds.categories is not None:
            task = dataclasses.replace(task, categories=self.worlds.categories, goals=())

        goals = task.goals if self.worlds.goals is None else self.worlds.goals
        return dataclasses.replace(task, goals=goals, detector=self.detector)

    def policy_spec(self, num_categories: int) -> PolicySpec:
        """Specification from which the run's policies are built."""
        return PolicySpec(
            method=find_method(self.method),
            num_categories=num_categories,
            sizes=self.sizes,
            method_sizes=tuple(sorted(self.method_sizes.items())),
            direct=self.direct,
            done_gate=self.done_gate,
            spatial_memory=SpatialMemory(self.task.rules.headings) if self.spatial_memory else None,
            decision=self.decision,
            goal_row=self.goal_row,
        )

    @property
    def train_step_limit(self) -> int:
        """Maximum number of actions in a training episode."""
        return self.worlds.train_step_limit or WORLDS[self.world].train_step_limit

    @property
    def near_starts(self) -> float:
        """Share of training episodes that start near their goals."""
        if self.worlds.near_starts is None:
            return WORLDS[self.world].near_starts
        return self.worlds.near_starts

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Stages of training, in order.

        The stages are those of the method, with shares rescaled to `imitation` where it is given. With streams, the
        last stage that does not imitate is split in two, so that the direct stream learns alone first.
        """
        # Stages of the method, with `imitation` as their share of imitation if it is set.
        stages = list(find_method(self.method).stages)
        if self.imitation is not None:
            stages = _rescale_imitation(stages, self.imitation)

        # With streams, the direct stream learns alone in the first part of the last learning stage.
        last_learning_index = None
        for index, stage in enumerate(stages):
            if not stage.uses_expert:
                last_learning_index = index
        if self.decision == "streams" and self.ppo.alone and last_learning_index is not None:
            split_stages = _split_by_stream(stages[last_learning_index], self.ppo)
            stages[last_learning_index : last_learning_index + 1] = split_stages
        return tuple(stages)

    @property
    def stage_by_chunk(self) -> list[int]:
        """Index of the training stage of every chunk, in order."""
        num_chunks = self.total_updates // self.chunk
        return [stage_index_at(self.stages, chunk / num_chunks) for chunk in range(num_chunks)]

    @property
    def steps_by_purpose(self) -> dict[str, int]:
        """Environment steps behind each policy: exploration for the prior, imitation, and learning."""
        steps_per_chunk = self.chunk * self.steps_per_update
        stage_by_chunk = self.stage_by_chunk
        imitation_chunks = sum(self.stages[index].uses_expert for index in stage_by_chunk)
        return {
            "exploration": self.layout.walks * self.layout.steps,
            "imitation": steps_per_chunk * imitation_chunks,
            "learning": steps_per_chunk * (len(stage_by_chunk) - imitation_chunks),
        }

    @property
    def steps_per_update(self) -> int:
        """Environment steps that each policy takes between two updates."""
        return self.ppo.num_envs * self.ppo.rollout

    @property
    def validation_updates(self) -> frozenset[int]:
        """Updates after which the policies are measured in val scenes, evenly spaced."""
        num_chunks = self.total_updates // self.chunk
        num_validations = min(self.validations, num_chunks)
        chunk_ends = set()
        for index in range(num_validations):
            chunks_before = -(-num_chunks * (index + 1) // num_validations)  # rounded up
            chunk_ends.add(chunks_before * self.chunk)
        return frozenset(chunk_ends)

    @property
    def total_updates(self) -> int:
        """Updates of each policy, rounded up to whole chunks."""
        total_steps = self.total_steps or WORLDS[self.world].total_steps
        return -(-self.ppo.num_updates(total_steps) // self.chunk) * self.chunk


def _rescale_imitation(stages: Sequence[Stage], imitation: float) -> list[Stage]:
    """Rescale shares so that the stages that imitate take `imitation` of training, and the rest the remainder."""
    # Total share of either kind of stages, as the method has them.
    imitation_share = sum(stage.share for stage in stages if stage.uses_expert)
    learning_share = sum(stage.share for stage in stages if not stage.uses_expert)

    # Keep the proportions among the stages of a kind.
    rescaled_stages = []
    for stage in stages:
        if stage.uses_expert:
            stage_share = stage.share * imitation / imitation_share
        else:
            stage_share = stage.share * (1.0 - imitation) / learning_share
        rescaled_stages.append(dataclasses.replace(stage, share=stage_share))
    return rescaled_stages


def _split_by_stream(stage: Stage, ppo: PPOConfig) -> list[Stage]:
    """Split a stage into one for the direct stream alone and one for both streams, at a lower learning rate."""
    direct_stage = dataclasses.replace(stage, share=ppo.alone * stage.share, direct_stream_only=True)
    both_stage = dataclasses.replace(
        stage, share=(1.0 - ppo.alone) * stage.share, lr_scale=stage.lr_scale * ppo.experience_rate
    )
    return [direct_stage, both_stage]


#: Upper bounds of the run's own settings. Larger values would exhaust memory or counters before the run finishes.
_MAX_VALUES = {
    "seeds": 1024,
    "total_steps": 10**12,
    "chunk": 10**5,
    "save_every": 10**6,
    "validations": 10**4,
    "val_episodes": 10**5,
}
#: Upper bound of every whole number in the groups `worlds`, `layout`, `sizes` and `ppo`.
_MAX_GROUP_VALUE = 10**6
#: Upper bound of environment steps that are held in memory at once.
_MAX_STEPS_IN_MEMORY = 2**28
_MAX_CHUNKS = 4 * 10**6


def check_config(config: RunConfig) -> RunConfig:
    """Check the settings of a run, and fill in those that follow from others.

    A method that cannot host the layout loses the arm `layout`, and paths that are given as text become `Path`. With
    streams, the direct pathway sees only the goal's detection, and the counterfactual branch needs no training of its
    own, because both streams are policies.

    Returns:
      The completed configuration.

    Raises:
      InputError: names the first impossible setting.
    """
    # Paths from files and Python callers may be text.
    for name in ("run_dir", "scenes", "cache"):
        path_setting = getattr(config, name)
        if path_setting is not None:
            config = dataclasses.replace(config, **{name: Path(path_setting)})

    # Settings that follow from the method and the decision.
    method = find_method(config.method)
    if not method.hosts_layout and config.arms == ARMS:
        config = dataclasses.replace(config, arms=("baseline",))
    if config.decision == "streams":
        config = dataclasses.replace(config, direct="goal", counterfactual="none")

    # The method and the numbers come first: later checks compute with them.
    _check_method(config, method)
    _check_numbers(config)
    _check_stages(config, method)
    _check_layout(config)
    _check_learning(config)
    _check_world(config)
    return config


def _check_method(config: RunConfig, method: Method) -> None:
    arms = config.arms
    _require(len(set(arms)) == len(arms) > 0, "arms", arms, f"give {' and '.join(ARMS)}, or one of them")
    has_host = method.hosts_layout or "layout" not in arms
    _require(has_host, "arms", arms, f"method {config.method!r} cannot use layout weights; give only baseline")

    # The gate multiplies the logit of Done, which exists only where the method chooses actions.
    can_gate = not config.done_gate or method.control.num_choices == NUM_ACTIONS
    advice = f"method {config.method!r} does not choose actions, so there is no Done to gate; omit the option"
    _require(can_gate, "done_gate", True, advice)

    # Sizes of the method's networks.
    size_names = method.experience.sizes
    if size_names:
        known_sizes = f"{config.method!r} has {', '.join(size_names)}"
    else:
        known_sizes = f"{config.method!r} has no such sizes"
    for name, value in config.method_sizes.items():
        _require(name in size_names, f"method_sizes.{name}", value, f"is unknown; {known_sizes}")
        _require(value >= 1, f"method_sizes.{name}", value, "give at least 1")


def _check_numbers(config: RunConfig) -> None:
    # The run's own numbers.
    for name, max_value in _MAX_VALUES.items():
        value = getattr(config, name)
        min_value = 0 if name == "validations" else 1
        _require(value is None or value >= min_value, name, value, f"give at least {min_value}")
        _require(value is None or value <= max_value, name, value, f"give at most {max_value:,}")

    if config.devices is not None:
        accepted_forms = "give a number, `cluster` or HOST:PORT,INDEX,PROCESSES with INDEX from 0"
        _require(Devices.parse(str(config.devices)) is not None, "devices", repr(config.devices), accepted_forms)

    # NumPy's generators take seeds of 32 bits.
    seed_settings = {"seed": config.seed, "worlds.seed": config.worlds.seed, "detector.seed": config.detector.seed}
    for name, seed in seed_settings.items():
        _require(0 <= seed < 2**32, name, seed, "give a whole number from 0 to 2**32 - 1")

    # Whole numbers in the nested groups.
    for group_name in ("worlds", "layout", "sizes", "ppo"):
        group = getattr(config, group_name)
        for config_field in dataclasses.fields(group):
            value = getattr(group, config_field.name)
            if isinstance(value, int) and config_field.name != "seed":
                name = f"{group_name}.{config_field.name}"
                _require(value >= 1, name, value, "give at least 1")
                _require(value <= _MAX_GROUP_VALUE, name, value, f"give at most {_MAX_GROUP_VALUE:,}")

    # Products of settings that decide about memory and the length of the schedule.
    step_products = {
        "layout.walks x layout.steps": config.layout.walks * config.layout.steps,
        "ppo.num_envs x ppo.rollout": config.steps_per_update,
    }
    for name, num_steps in step_products.items():
        _require(num_steps <= _MAX_STEPS_IN_MEMORY, name, num_steps, f"give at most {_MAX_STEPS_IN_MEMORY:,}")
    num_chunks = config.total_updates // config.chunk
    advice = f"this makes {num_chunks:,} chunks; give a larger chunk"
    _require(num_chunks <= _MAX_CHUNKS, "total_steps", config.total_steps, advice)


def _check_stages(config: RunConfig, method: Method) -> None:
    imitation = config.imitation
    if imitation is not None:
        advice = "give a share between 0 and 1, both excluded"
        _require(0.0 < imitation < 1.0, "imitation", imitation, advice)
        stage_kinds = {stage.uses_expert for stage in method.stages}
        advice = f"method {config.method!r} does not have stages both with and without imitation; omit the option"
        _require(len(stage_kinds) == 2, "imitation", imitation, advice)

    # Every stage needs a chunk of its own.
    stage_by_chunk = config.stage_by_chunk
    if imitation is None:
        name, value = "total_steps", config.total_steps
    else:
        name, value = "imitation", imitation
    for index, stage in enumerate(config.stages):
        advice = (
            f"stage {index + 1} of method {config.method!r}, a share of {stage.share:.3g}, gets none of the "
            f"{len(stage_by_chunk)} chunks of {config.chunk} updates: give more total_steps or a smaller chunk"
        )
        _require(index in stage_by_chunk, name, value, advice)


def _check_layout(config: RunConfig) -> None:
    layout = config.layout
    prior_strength = layout.strength
    # The estimators of the paper and its code have constants of their own.
    is_fixed = layout.setting != "calibrated"
    has_choices = prior_strength is not None or layout.reduction is not None
    advice = "only `calibrated` takes a strength and a reduction"
    _require(not (is_fixed and has_choices), "layout.setting", layout.setting, advice)
    _require(
        prior_strength is None or 0.0 < prior_strength < math.inf,
        "layout.strength",
        prior_strength,
        "give a positive number",
    )


def _check_learning(config: RunConfig) -> None:
    ppo = config.ppo

    # Ranges of single settings.
    discount_names = ("gamma", "gae_lambda")
    positive_names = ("learning_rate", "experience_rate", "clip", "max_grad_norm")
    loss_weights = ("entropy", "final_entropy", "value", "distil")
    _require_each(ppo, "ppo", discount_names, lambda number: 0.0 <= number <= 1.0, "give a number from 0 to 1")
    advice = "give a number between 0 and 1, both excluded"
    _require_each(ppo, "ppo", ("experience",), lambda number: 0.0 < number < 1.0, advice)
    _require_each(ppo, "ppo", ("alone",), lambda number: 0.0 <= number < 1.0, "give a share from 0 to below 1")
    _require_each(ppo, "ppo", positive_names, lambda number: 0.0 < number < math.inf, "give a positive number")
    _require_each(ppo, "ppo", loss_weights, lambda number: 0.0 <= number < math.inf, "give 0 or more")

    # Minibatches divide the environments into equal parts.
    lower_multiple = ppo.num_envs // ppo.minibatches * ppo.minibatches
    upper_multiple = lower_multiple + ppo.minibatches
    nearest_multiples = f"{lower_multiple} or {upper_multiple}" if lower_multiple else str(upper_multiple)
    advice = f"give a multiple of ppo.minibatches ({ppo.minibatches}), such as {nearest_multiples}"
    _require(ppo.num_envs == lower_multiple, "ppo.num_envs", ppo.num_envs, advice)

    advice = f"give at most worlds.train_step_limit ({config.train_step_limit})"
    _require(ppo.rollout <= config.train_step_limit, "ppo.rollout", ppo.rollout, advice)


def _check_world(config: RunConfig) -> None:
    # Errors of the detector.
    error_rates = ("miss_near", "miss_far", "false_alarm")
    advice = "give a probability from 0 to 1"
    _require_each(config.detector, "detector", error_rates, lambda number: 0.0 <= number <= 1.0, advice)

    # Scenes and rewards.
    worlds = config.worlds
    _require(0.0 <= worlds.shift <= 1.0, "worlds.shift", worlds.shift, "give a number from 0 to 1")
    is_valid_shaping = worlds.shaping is None or 0.0 <= worlds.shaping < math.inf
    _require(is_valid_shaping, "worlds.shaping", worlds.shaping, "give 0 or more")
    is_valid_share = worlds.near_starts is None or 0.0 <= worlds.near_starts <= 1.0
    _require(is_valid_share, "worlds.near_starts", worlds.near_starts, advice)

    # Categories and goals.
    task = config.task
    is_unique = len(set(task.categories)) == len(task.categories)
    _require(len(task.categories) >= 2, "worlds.categories", task.categories, "give at least 2")
    _require(is_unique, "worlds.categories", task.categories, "give each once")
    unknown_goals = []
    for goal_category in task.goals:
        if goal_category not in task.categories:
            unknown_goals.append(goal_category)
    advice = f"choose from the categories {', '.join(task.categories)}"
    _require(not unknown_goals, "worlds.goals", unknown_goals, advice)


def _require(condition: bool, name: str, value: object, advice: str) -> None:
    if not condition:
        raise InputError(f"config: {name} is {value}; {advice}")


def _require_each(
    group: Any, group_name: str, names: tuple[str, ...], is_valid: Callable[[float], bool], advice: str
) -> None:
    for name in names:
        value = getattr(group, name)
        _require(is_valid(value), f"{group_name}.{name}", value, advice)
