"""The settings of a run."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxnav.layout import Reduction
from jaxnav.policies.methods import Stage, find_method
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import Deciding, Direct, PolicySpec, Sizes
from jaxnav.scenes.tables.detector import Detector
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS
from jaxnav.training.config import Counterfactual, PPOConfig, PPOScalars, stage_at

Arm = Literal["baseline", "layout"]
#: Policies without and with the layout estimator; they differ by its weights alone.
ARMS: tuple[Arm, ...] = ("baseline", "layout")


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Choose scenes and lengths of episodes.

    What is None is as usual in the world.

    Attributes:
      num_train, num_val, num_test: generated scenes of each split.
      seed: of the generator.
      shift: layout shift of the scenes, from 0 to 1: the share of the categories that exchange their places.
      categories: what can be detected.
      goals: what of it can be looked for; None with categories of one's own: all of them.
      train_step_limit: actions of a training episode.
      step_limit: actions of an evaluation episode.
      large_step_limit: the same in living rooms.
      shaping: reward in training for every metre nearer to the goal than before in the episode.
      near_starts: probability that a training episode starts near its goal: in the nearest to it of eight random cells.
      shard_scenes: more scenes than this are compiled to disk, in shards of so many, and streamed from there.
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
    """Choose how the layout is estimated.

    Attributes:
      setting: of the estimator.
      strength, reduction: of the prior's rows, and over rows in the gap; None: whatever makes the gap run as in the
        paper in the training scenes. Of no use to `paper` and `released`.
      prior: one for each `room` type, which tells the policy the type of the room; or all rooms `pooled` into one.
      walks, steps: random walks and their steps that collect the prior in the training scenes; the gap `learned` takes
        four times as many walks.
    """

    setting: Literal["paper", "released", "calibrated"] = "calibrated"
    strength: float | None = None
    reduction: Reduction | None = None
    prior: Literal["room", "pooled"] = "room"
    walks: int = 2048
    steps: int = 100


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Configure a training run.

    Attributes:
      run_dir: where everything the run makes is kept; training goes on where it stopped.
      method: how experience is made: a name of this package, an entry point of the group `jaxnav.methods`, or
        `package.module:NAME`.
      world: what is asked of the agent, and the generated scenes it lives in unless `scenes` is given.
      scenes: scene file to read instead; its splits are used.
      arms: kinds of policies that are trained; a method that cannot host the layout has the baseline alone.
      seeds: policies trained of each kind.
      total_steps: environment steps of each policy, those of imitation included, rounded up to whole chunks;
        None: as usual in the world. The layout's policies have seen the prior's random steps (`layout.walks x
        layout.steps`) besides.
      imitation: share of them in which the method imitates shortest paths, in whole chunks; None: as usual for the
        method.
      seed: of all randomness in training.
      counterfactual: how the branch that counterfactual decisions use is trained.
      decision: how pathways become logits: `fused` before one recurrent core, as in the paper, or as the sum of two
        `streams`, of which that of experience is off at first and in some training episodes (see `ppo.alone` and
        `ppo.experience`); with streams `direct` is goal and `counterfactual` none.
      direct: which detections the direct pathway of the goal sees.
      spatial_memory: whether policies remember, on the direct pathway of the scene, which cells they have seen and
        visited; the paper's do not.
      goal_row: give the direct pathway the goal's detection in a row of its own too, whatever the goal is; the paper's
        has it in that of its category alone.
      done_gate: multiply the logit of Done by 0.58 times the confidence that the goal is in sight.
      chunk: updates per compiled call; between calls the run logs, saves (every `save_every` calls) and, where scenes
        are streamed, goes on to the next shard with new episodes.
      save_every: calls between checkpoints.
      validations: times that policies are measured in val scenes while they are trained, evenly spaced; of each seed
        the one that succeeds most often, with its best actions, is exported. 0: none, and the last is exported.
      val_episodes: episodes of such a measurement.
      cache: folder for compiled scenes that are streamed from disk.
      method_sizes: whole-number sizes that only the method has, where they are not the usual ones.
      devices: what to train on, which changes results by rounding only: so many devices of this process, `cluster` for
        all that Slurm, Open MPI, Kubernetes or a TPU pod has started this command on, or `HOST:PORT,INDEX,PROCESSES`
        for command number INDEX of several equal ones, which meet at that address of number 0 and share the file system
        of `run_dir`; None: one device, and seeds side by side on its cores.
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
    counterfactual: Counterfactual = "distil"
    decision: Deciding = "fused"
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
    def source(self) -> str | Path:
        """Return where the scenes come from."""
        return self.scenes or self.world

    @property
    def task(self) -> Task:
        """Return what is asked of the agent."""
        task, worlds = WORLDS[self.world].task, self.worlds
        if worlds.categories is not None:
            task = dataclasses.replace(task, categories=worlds.categories, goals=())
        goals = task.goals if worlds.goals is None else worlds.goals
        return dataclasses.replace(task, goals=goals, detector=self.detector)

    def policy_spec(self, num_categories: int) -> PolicySpec:
        """Return what its policies are built from."""
        sizes = tuple(sorted(self.method_sizes.items()))
        memory = SpatialMemory(self.task.rules.headings) if self.spatial_memory else None
        options = self.direct, self.done_gate, memory, self.decision, self.goal_row
        return PolicySpec(self.method, num_categories, self.sizes, sizes, *options)

    @property
    def train_step_limit(self) -> int:
        """Return the actions of a training episode."""
        return self.worlds.train_step_limit or WORLDS[self.world].train_step_limit

    @property
    def near_starts(self) -> float:
        """Return the share of training episodes that start near their goals."""
        usual = WORLDS[self.world].near_starts
        return usual if self.worlds.near_starts is None else self.worlds.near_starts

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Return the stages of training.

        Those of the method, as `imitation` shares them; with streams the last that does not imitate is two, the direct
        stream alone first.
        """
        stages = list(find_method(self.method).stages)
        if self.imitation is not None:
            wanted = {True: self.imitation, False: 1.0 - self.imitation}
            usual = {kind: sum(stage.share for stage in stages if stage.imitates == kind) for kind in wanted}
            shares = [stage.share * wanted[stage.imitates] / usual[stage.imitates] for stage in stages]
            stages = [dataclasses.replace(stage, share=share) for stage, share in zip(stages, shares, strict=True)]
        learning = [number for number, stage in enumerate(stages) if not stage.imitates]
        if self.decision == "streams" and self.ppo.alone and learning:
            whole, alone = stages[learning[-1]], self.ppo.alone
            first = dataclasses.replace(whole, share=alone * whole.share, alone=True)
            rate = whole.rate * self.ppo.experience_rate
            both = dataclasses.replace(whole, share=(1.0 - alone) * whole.share, rate=rate)
            stages[learning[-1] : learning[-1] + 1] = [first, both]
        return tuple(stages)

    @property
    def schedule(self) -> list[int]:
        """Return the number of the stage of every chunk, in order."""
        chunks = self.total_updates // self.chunk
        return [stage_at(self.stages, chunk / chunks) for chunk in range(chunks)]

    @property
    def scalars(self) -> list[PPOScalars]:
        """Return the traced settings of PPO in every stage."""
        schedule, numbers = self.schedule, range(len(self.stages))
        begins, lengths = ([self.chunk * how(number) for number in numbers] for how in (schedule.index, schedule.count))
        parts = zip(self.stages, lengths, begins, strict=True)
        return [self.ppo.scalars(length, begin, stage.rate) for stage, length, begin in parts]

    @property
    def budget(self) -> dict[str, int]:
        """Return the environment steps behind a policy, by what they are for."""
        chunk_steps = self.chunk * self.update_steps
        imitating = sum(self.stages[number].imitates for number in self.schedule)
        return {
            "exploration": self.layout.walks * self.layout.steps,
            "imitation": chunk_steps * imitating,
            "learning": chunk_steps * (len(self.schedule) - imitating),
        }

    @property
    def update_steps(self) -> int:
        """Return the environment steps of a policy between two updates."""
        return self.ppo.num_envs * self.ppo.rollout

    @property
    def validated(self) -> frozenset[int]:
        """Return the updates after which policies are measured."""
        chunks = self.total_updates // self.chunk
        times = min(self.validations, chunks)
        return frozenset(-(-chunks * (i + 1) // times) * self.chunk for i in range(times))

    @property
    def total_updates(self) -> int:
        """Return the updates of each policy, in whole chunks."""
        steps = self.total_steps or WORLDS[self.world].total_steps
        return -(-self.ppo.num_updates(steps) // self.chunk) * self.chunk
