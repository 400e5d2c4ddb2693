"""Configuration of a training run.

`RunConfig` holds the settings of a run and derives from them its task, stages and schedule. `check_config` completes a
configuration and refuses impossible settings.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from jaxnav.choices import CounterfactualMemory, Counts, Reduction, WorldName
from jaxnav.errors import InputError
from jaxnav.policies.spec import DecisionKind, Direct, PolicySpec, Sizes, WeightKind
from jaxnav.runs.config_files import apply_values
from jaxnav.scenes.tables.observation_row import Detector
from jaxnav.scenes.task import FrontCell, Task
from jaxnav.scenes.worlds import WORLDS
from jaxnav.training.config import CounterfactualTraining, PPOConfig, stage_index_at

if TYPE_CHECKING:
    from jaxnav.policies.method import Method, Stage

#: Environment steps of the searches to which a policy is fitted, for methods that are fitted (`Method.fit`).
FITTED_STEPS = 76_800

Arm = Literal["baseline", "layout"]
#: Kinds of policies: without and with the layout estimator. They differ only in the layout weights.
ARMS: tuple[Arm, ...] = ("baseline", "layout")


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Scenes, episodes and rewards. The defaults depend on the world.

    Attributes:
      num_train: number of generated training scenes, at least 1.
      num_val: number of generated validation scenes, at least 1.
      num_test: number of generated test scenes, at least 1.
      seed: random seed of the scene generator, from 0 to 4,294,967,295.
      shift: layout shift of all scenes, from 0 to 1: share of the categories that exchange their places. At 0, things
        stand at their usual places. Evaluations have their own `--shift`.
      categories: object categories that the agent can detect, at least 2.
      goals: categories that can be goals, a part of `categories`. With your own `categories`, the default is all.
      train_step_limit: largest number of actions in a training episode, at least 1.
      step_limit: largest number of actions in an evaluation episode, at least 1.
      large_step_limit: largest number of actions in an evaluation episode in a living room, at least 1.
      shaping: training reward, at least 0, for every metre by which the agent comes nearer to the goal than before in
        the episode.
      near_starts: probability, from 0 to 1, that a training episode starts near its goal: in the nearest of eight
        random cells.
      front_cell: cell in front of the agent that a view shows: the one that MoveAhead leads to (`move`, usual in
        apartments and houses), or the one `nearest` to the point a cell's length along the heading, as in runs from
        before this setting. In rooms both are the same.
      shard_scenes: number of scenes in a shard, a part of the scenes that is loaded at once, at least 1. With more
        scenes than this, all are compiled to disk (`cache`), and training takes the shards in turn. Smaller shards need
        less memory.
    """

    # None stands for the default of the world, see `fill_world_defaults`.
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
    front_cell: FrontCell | None = None
    shard_scenes: int = 128


@dataclasses.dataclass(frozen=True)
class LayoutConfig:
    """Layout estimator, the belief about which things stand near each other.

    Attributes:
      setting: variant of the layout estimator: `paper`, its equations as printed; `released`, as in the authors'
        released code; or `calibrated`, with numbers that are chosen in the training scenes (`strength`, `reduction`).
      strength: weight of the prior (the belief before the episode, from the training scenes), above 0: each of its rows
        counts as this many sightings. With larger values, new views change the belief less. Only with `calibrated`,
        which by default chooses the value whose layout gap (doubt about the layout, from 0 to 1) is nearest to 0.75 in
        the first views and 0.25 after twenty steps, as in the paper.
      reduction: one layout gap (doubt about the layout) from the changes that a view makes to the rows of the belief,
        one row for each category: mean over visible categories (`mean_visible`), mean over all (`mean`), or `sum`. Only
        with `calibrated`, which by default chooses it together with `strength`.
      counts: numbers that a view adds to the belief: 1 for each visible category (`presence`), or the number of its
        visible instances (`instances`). The default is `instances` with `paper`, else `presence`.
      weights: scale of the layout weights w that multiply the experience features of each category (eq. 7). `raw`, as
        in the paper: w itself, about 1 / (number of categories) except for the goal. `relative`: w over its mean over
        all categories but the goal, at most 4. `pixel`: w itself, with the geometry of the experience features
        (offsets, distance, bearing and size) times 300, the scale of boxes in pixels in the authors' code.
      prior: belief at the start of an episode: a separate one for each type of `room`, so that the policy knows the
        type of the room, or one `pooled` over all rooms.
      walks: number of random walks in the training scenes before training, at least 1. They count which things are seen
        together, and so make the prior (the first belief) of the layout estimator. The layout gap `learned` (see
        `jaxnav list settings`) learns from four times as many walks, with more than 256 categories from fewer.
      steps: number of steps of each random walk, at least 1.
    """

    setting: Literal["paper", "released", "calibrated"] = "calibrated"
    strength: float | None = None
    reduction: Reduction | None = None
    counts: Counts | None = None
    weights: WeightKind = "relative"
    prior: Literal["room", "pooled"] = "room"
    walks: int = 2048
    steps: int = 100


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Settings of a training run.

    Attributes:
      run_dir: directory of the run. Training resumes from the last checkpoint in it.
      method: method that makes experience (features of the things that stand near each other) from detections: a method
        of jaxnav (`jaxnav list methods` prints them), an entry point of the group `jaxnav.methods`, or
        `package.module:NAME`.
      world: generated world, which sets the task. The scenes are from this world unless you give `scenes`.
      scenes: scene file to read instead of generating scenes. The splits in the file are used.
      arms: kinds of policies to train: without layout weights (`baseline`) and with them (`layout`). The weights
        multiply the experience features of each category by how often the goal is expected near it. Methods that cannot
        use them train only the baseline.
      seeds: number of policies of each arm, from 1 to 1,024.
      total_steps: number of environment steps of each policy, at least 1, with imitation; rounded up to whole chunks
        (see `chunk`). The random walks before training, from which the layout estimator starts, are not included
        (`layout.walks` x `layout.steps`).
      imitation: share of the steps in which the policy imitates shortest paths, between 0 and 1, rounded to whole
        chunks. Of the methods of jaxnav, only `vtnet` and `tpn` imitate; the rest refuse the option. By default, the
        method chooses the share.
      seed: random seed of training, from 0 to 4,294,967,295.
      counterfactual: training of the counterfactual branch (logits with scene and goal set to zero but with factual
        experience, which sTDE subtracts): `distil` teaches these logits to match those of the complete policy; `coin`
        sets scene and goal to zero in half of the steps, as the authors' code does; `none` does not train them.
      counterfactual_memory: memory from which the counterfactual branch decides. `factual`, as in the paper: the memory
        of the complete policy, which has read scene and goal. `own`: a memory of its own, for which scene and goal have
        been zero since the start of the episode; only with `--decision fused`.
      decision: network from the inputs to the actions. `fused`, as in the paper: one recurrent network gets scene, goal
        and experience. `streams`: two recurrent networks, one without experience (the direct stream) and one with it,
        add their logits, so that the part that remains without experience is trained too. `streams` sets `--direct goal
        --counterfactual none`.
      direct: detections that the policy also gets directly, not only through experience; sTDE keeps this direct input.
        Those of `all` categories (as in the authors' code), of the `goal` only, or `none`. The default is `goal`, so
        that other categories act through experience alone, and `all` for methods without experience (rgb, savn).
      spatial_memory: give the policy a map of the cells that it has seen and visited. The map holds no objects, so it
        is not a part of experience. The paper has no such map, so turn it off to compare with the paper.
      goal_row: give the policy the detection of its goal as a separate input. In the paper, this detection stands only
        among those of all categories, so turn the option off to compare with the paper.
      done_gate: multiply the logit of Done by 0.58 times the confidence of the detection of the goal (0 where the goal
        is not detected). The factor is that of the authors' released code; use the option to compare with this code.
      chunk: number of updates in one compiled call (a chunk), from 1 to 100,000. Between two chunks, the run writes its
        log and, if there are more scenes than `worlds.shard_scenes`, loads other scenes. Fewer updates give a finer
        log, more updates less overhead.
      save_every: number of chunks (of `chunk` updates each) between two checkpoints, from 1 to 1,000,000. An
        interrupted run continues from its last checkpoint.
      validations: number of times that the policies are evaluated in validation scenes during training, from 0 to
        10,000, evenly spaced. Of each seed, the policy with the highest success under best actions (the action with the
        largest logit) is exported; with 0, the last policy.
      val_episodes: number of episodes in each evaluation during training (see `validations`), from 1 to 100,000.
      cache: folder for compiled scenes, which are streamed from disk if there are more scenes than
        `worlds.shard_scenes`.
      devices: devices to train on, by default one; results change only by rounding. Give the number of devices of this
        process, or `cluster` for all devices of the Slurm, Open MPI, Kubernetes or TPU job that started this command,
        or `HOST:PORT,INDEX,PROCESSES` for command number INDEX of several equal commands. These commands meet at the
        address of command 0 and share the file system of `run_dir`.
      method_sizes: sizes of layers that only this method has, each at least 1: name and number, as often as needed. An
        unknown name prints the names that the method has.
    """

    run_dir: Path = Path("runs/rooms")
    method: str = "org"
    world: WorldName = "rooms"
    scenes: Path | None = None
    arms: tuple[Arm, ...] = ARMS
    seeds: int = 3
    total_steps: int | None = None
    imitation: float | None = None
    seed: int = 0
    counterfactual: CounterfactualTraining = "distil"
    counterfactual_memory: CounterfactualMemory = "factual"
    decision: DecisionKind = "fused"
    direct: Direct | None = None
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
    def policy_method(self) -> "Method":
        """The method that `method` names.

        Raises:
          InputError: there is no such method.
        """
        from jaxnav.policies.methods import find_method  # imports JAX, and the help of a command needs no JAX

        return find_method(self.method)

    @property
    def task(self) -> Task:
        """Task of the world, with the categories, goals and detector of this configuration."""
        task = WORLDS[self.world].task

        # Your own categories may lack the goals of the world; by default all of them are goals.
        if self.worlds.categories is not None:
            task = dataclasses.replace(task, categories=self.worlds.categories, goals=())

        goals = task.goals if self.worlds.goals is None else self.worlds.goals
        front_cell = self.worlds.front_cell or task.rules.front_cell
        return dataclasses.replace(
            task,
            goals=goals,
            rules=dataclasses.replace(task.rules, front_cell=front_cell),
            detector=self.detector,
            instance_counts=self.layout_counts == "instances",
        )

    @property
    def layout_counts(self) -> Counts:
        """Counts of a view in the layout belief, see `LayoutConfig.counts`."""
        usual_counts: Counts = "instances" if self.layout.setting == "paper" else "presence"
        return self.layout.counts or usual_counts

    def policy_spec(self, num_categories: int) -> PolicySpec:
        """Specification from which the run's policies are built."""
        from jaxnav.policies.spatial_memory import SpatialMemory

        rules = self.task.rules
        return PolicySpec(
            method=self.policy_method,
            num_categories=num_categories,
            sizes=self.sizes,
            method_sizes=tuple(sorted(self.method_sizes.items())),
            direct=self.direct or usual_direct(self.policy_method),
            done_gate=self.done_gate,
            spatial_memory=SpatialMemory(rules.headings, front_cell=rules.front_cell) if self.spatial_memory else None,
            decision=self.decision,
            goal_row=self.goal_row,
            weight_kind=self.layout.weights,
            experience_dropout=self.decision == "fused" and self.ppo.experience_prob < 1.0,
            counterfactual_memory=self.counterfactual_memory,
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
    def stages(self) -> tuple["Stage", ...]:
        """Stages of training, in order.

        The stages are those of the method, with shares rescaled to `imitation` where it is given. With streams, the
        last stage that does not imitate is split in two, so that the direct stream learns alone first.
        """
        # Stages of the method, with `imitation` as their share of imitation if it is set.
        stages = list(self.policy_method.stages)
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
        """Environment steps behind each policy: exploration for the prior, then imitation and learning, or searches."""
        if self.policy_method.fit is not None:
            return {
                "exploration": self.layout.walks * self.layout.steps,
                "searches": self.total_updates * self.steps_per_update,
            }
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


def _rescale_imitation(stages: Sequence["Stage"], imitation: float) -> list["Stage"]:
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


def _split_by_stream(stage: "Stage", ppo: PPOConfig) -> list["Stage"]:
    """Split a stage into one for the direct stream alone and one for both streams, at a lower learning rate."""
    direct_stage = dataclasses.replace(stage, share=ppo.alone * stage.share, direct_stream_only=True)
    both_stage = dataclasses.replace(
        stage, share=(1.0 - ppo.alone) * stage.share, lr_scale=stage.lr_scale * ppo.experience_rate
    )
    return [direct_stage, both_stage]


def fill_world_defaults(config: RunConfig) -> RunConfig:
    """Replace the settings that are None by the values that are usual in the world of the run."""
    world = WORLDS[config.world]
    task = config.task
    usual_settings = {
        "num_train": world.counts["train"],
        "num_val": world.counts["val"],
        "num_test": world.counts["test"],
        "categories": task.categories,
        "goals": task.goals or task.categories,
        "train_step_limit": world.train_step_limit,
        "step_limit": world.step_limit,
        "large_step_limit": world.large_step_limit,
        "shaping": world.shaping,
        "near_starts": world.near_starts,
        "front_cell": task.rules.front_cell,
    }

    # Settings that are given stay.
    missing_settings = {}
    for name, value in usual_settings.items():
        if getattr(config.worlds, name) is None:
            missing_settings[name] = value
    total_steps = world.total_steps if config.total_steps is None else config.total_steps
    ppo = config.ppo
    if ppo.guidance is None:
        ppo = dataclasses.replace(ppo, guidance=world.guidance)
    return dataclasses.replace(
        config, worlds=dataclasses.replace(config.worlds, **missing_settings), total_steps=total_steps, ppo=ppo
    )


#: Largest number of policies of each arm.
MAX_SEEDS = 1024
#: Upper bounds of the run's own settings. Larger values would exhaust memory or counters before the run finishes.
_MAX_VALUES = {
    "seeds": MAX_SEEDS,
    "total_steps": 10**12,
    "chunk": 10**5,
    "save_every": 10**6,
    "validations": 10**4,
    "val_episodes": 10**5,
}
#: Upper bound of every whole number in the groups `worlds`, `layout`, `sizes` and `ppo`.
_MAX_GROUP_VALUE = 10**6
#: Upper bound of every other number in these groups and `detector`, near the largest float32.
_MAX_FLOAT = 3.4e38
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
    config = _convert_fields(config)

    # Settings that follow from the world, the method and the decision.
    worlds = dataclasses.replace(config.worlds, front_cell=config.task.rules.front_cell)
    config = dataclasses.replace(config, worlds=worlds)
    method = config.policy_method
    if not method.hosts_layout and config.arms == ARMS:
        config = dataclasses.replace(config, arms=("baseline",))
    if config.decision == "streams":
        config = dataclasses.replace(config, direct="goal", counterfactual="none")
    if config.direct is None:
        config = dataclasses.replace(config, direct=usual_direct(method))
    if config.layout.counts is None:
        layout = dataclasses.replace(config.layout, counts=config.layout_counts)
        config = dataclasses.replace(config, layout=layout)
    if config.ppo.guidance is None:
        guidance = _usual_guidance(config, method)
        config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, guidance=guidance))
    if config.ppo.experience is None:
        usual_experience = 0.8 if config.decision == "streams" else 1.0
        config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, experience=usual_experience))

    if method.fit is not None:
        config = _complete_fitted(config)

    # The method and the numbers come first: later checks compute with them.
    _check_method(config, method)
    _check_numbers(config)
    _check_stages(config, method)
    _check_layout(config)
    _check_learning(config)
    _check_world(config)
    return config


def _complete_fitted(config: RunConfig) -> RunConfig:
    """Settings of a method that is fitted to searches: no map for a network, no training of a counterfactual branch."""
    # The agent without experience is part of the policy.
    arms = ("layout",) if config.arms == ARMS else config.arms
    total_steps = FITTED_STEPS if config.total_steps is None else config.total_steps
    return dataclasses.replace(
        config, arms=arms, total_steps=total_steps, spatial_memory=False, counterfactual="none", direct="goal"
    )


def usual_direct(method: "Method") -> Direct:
    """Detections of the direct pathway by default: of the goal; of all categories where experience is empty.

    With `goal`, experience is the only way by which other categories reach the decision, so that removing experience
    removes them.
    """
    return "all" if method.experience.is_empty else "goal"


def _usual_guidance(config: RunConfig, method: "Method") -> float:
    """Weight of guidance by default: that of the world, and 0 for methods that do not choose actions."""
    return WORLDS[config.world].guidance if method.chooses_actions else 0.0


def _check_method(config: RunConfig, method: "Method") -> None:
    arms = config.arms
    _require(len(set(arms)) == len(arms) > 0, "arms", arms, f"give {' and '.join(ARMS)}, or one of them")
    has_host = method.hosts_layout or "layout" not in arms
    _require(has_host, "arms", arms, f"method {config.method!r} cannot use layout weights; give only baseline")

    # A policy of the method's own holds its agent without experience, and needs no second stream for it.
    if method.policy_class is not None:
        advice = f"method {config.method!r} holds its agent without experience, the row with TDE; give only layout"
        _require(arms == ("layout",), "arms", arms, advice)
        advice = f"the scores of method {config.method!r} are a sum already; give fused"
        _require(config.decision == "fused", "decision", config.decision, advice)

    # The gate multiplies the logit of Done, which exists only where the method chooses actions.
    can_gate = not config.done_gate or method.chooses_actions
    advice = f"method {config.method!r} does not choose actions, so there is no Done to gate; omit the option"
    _require(can_gate, "done_gate", True, advice)

    # Guidance compares the choices with the actions of shortest paths.
    can_guide = not config.ppo.has_guidance or method.chooses_actions
    advice = f"method {config.method!r} does not choose actions, so shortest paths cannot guide it; omit the option"
    _require(can_guide, "ppo.guidance", config.ppo.guidance, advice)

    # Sizes of the method's networks.
    size_names = method.experience.sizes
    if size_names:
        known_sizes = f"method {config.method!r} has the sizes {', '.join(size_names)}"
    else:
        known_sizes = f"method {config.method!r} has no sizes"
    for name, value in config.method_sizes.items():
        _require(name in size_names, f"method_sizes.{name}", value, f"this size is unknown, {known_sizes}")
        _require(value >= 1, f"method_sizes.{name}", value, "give at least 1")


def _check_numbers(config: RunConfig) -> None:
    # The run's own numbers.
    for name, max_value in _MAX_VALUES.items():
        value = getattr(config, name)
        min_value = 0 if name == "validations" else 1
        _require(value is None or value >= min_value, name, value, f"give at least {min_value}")
        _require(value is None or value <= max_value, name, value, f"give at most {max_value:,}")

    if config.devices is not None:
        from jaxnav.training.devices import MAX_DEVICES, Devices

        accepted_forms = (
            f"give a number, `cluster` or HOST:PORT,INDEX,PROCESSES with INDEX from 0; at most {MAX_DEVICES:,} of each"
        )
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

    # Larger numbers would become infinite in the networks.
    for group_name in ("worlds", "detector", "layout", "ppo"):
        group = getattr(config, group_name)
        for config_field in dataclasses.fields(group):
            value = getattr(group, config_field.name)
            if isinstance(value, float) and math.isfinite(value):
                name = f"{group_name}.{config_field.name}"
                _require(abs(value) <= _MAX_FLOAT, name, value, f"give at most {_MAX_FLOAT:g}")

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


def _check_stages(config: RunConfig, method: "Method") -> None:
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
    # The direct stream learns only in episodes without experience; a fused network needs none of these.
    experience = ppo.experience_prob
    if config.decision == "streams":
        advice = "give a number between 0 and 1, both excluded"
        _require(0.0 < experience < 1.0, "ppo.experience", experience, advice)
    else:
        _require(0.0 < experience <= 1.0, "ppo.experience", experience, "give a number above 0, at most 1")
    advice = "two streams have separate memories already; omit the option"
    has_memory = config.counterfactual_memory == "factual" or config.decision == "fused"
    _require(has_memory, "counterfactual_memory", config.counterfactual_memory, advice)
    _require_each(ppo, "ppo", ("alone",), lambda number: 0.0 <= number < 1.0, "give a share from 0 to below 1")
    _require_each(ppo, "ppo", positive_names, lambda number: 0.0 < number < math.inf, "give a positive number")
    _require_each(ppo, "ppo", loss_weights, lambda number: 0.0 <= number < math.inf, "give 0 or more")
    for name in ("guidance", "final_guidance"):
        weight = getattr(ppo, name)
        _require(weight is None or 0.0 <= weight < math.inf, f"ppo.{name}", weight, "give 0 or more")

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


def _convert_fields(config: RunConfig) -> RunConfig:
    """Convert settings that were given in Python to their types, as those of a file.

    Raises:
      InputError: a value has another type than its setting.
    """
    settings = _to_plain_values(dataclasses.asdict(config))
    # Only a world on disk needs the cache, and thus a home folder.
    cache = Path(settings.pop("cache"))
    return dataclasses.replace(apply_values(RunConfig(), settings, Path("config")), cache=cache)


def _to_plain_values(value: Any) -> Any:
    """Return a value as a file holds it: paths are text, tuples lists, and numbers of NumPy those of Python."""
    if isinstance(value, dict):
        return {name: _to_plain_values(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_plain_values(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


def _require(condition: bool, name: str, value: object, advice: str) -> None:
    if not condition:
        raise InputError(f"config: {name} is {value}; {advice}")


def _require_each(
    group: Any, group_name: str, names: tuple[str, ...], is_valid: Callable[[float], bool], advice: str
) -> None:
    for name in names:
        value = getattr(group, name)
        _require(is_valid(value), f"{group_name}.{name}", value, advice)
