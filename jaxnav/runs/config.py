"""The settings of a run, from dataclass defaults, a YAML overlay and the command line, in this order."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxnav.errors import InputError
from jaxnav.layout import Reduction
from jaxnav.policies.methods import METHODS
from jaxnav.policies.spec import Direct, Sizes
from jaxnav.scenes.tables.detector import Detector
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS
from jaxnav.training.config import Counterfactual, PPOConfig
from jaxnav.training.devices import Devices

#: Policies without and with the layout estimator, in the order of the tables; they differ by its weights alone.
ARMS = ("baseline", "layout")


@dataclasses.dataclass(frozen=True)
class WorldConfig:
    """Which scenes there are and how long episodes may last; what is None is as usual in the world.

    Attributes:
      num_train, num_val, num_test: generated scenes of each split.
      seed: of the generator.
      shift: layout shift of the scenes, from 0 to 1; single rooms and files are relabelled.
      categories: what can be detected.
      goals: what of it can be looked for; None with categories of one's own: all of them.
      train_step_limit: actions of a training episode.
      step_limit: actions of an evaluation episode.
      large_step_limit: the same in living rooms.
      shaping: reward in training for every metre nearer to the goal.
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
    shard_scenes: int = 128


@dataclasses.dataclass(frozen=True)
class LayoutConfig:
    """How the layout is estimated.

    Attributes:
      setting: of the estimator.
      strength, reduction: of the prior's rows, and over rows in the gap; None: whatever makes the gap run as in the
        paper in the training scenes. Of no use to `paper` and `released`.
      walks, steps: random walks and their steps that collect the prior in the training scenes.
    """

    setting: Literal["paper", "released", "calibrated"] = "calibrated"
    strength: float | None = None
    reduction: Reduction | None = None
    walks: int = 2048
    steps: int = 100


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """A training run.

    Attributes:
      run_dir: where everything the run makes is kept; training goes on where it stopped.
      method: how experience is made.
      world: what is asked of the agent, and the generated scenes it lives in unless `scenes` is given.
      scenes: scene file to read instead; its splits are used.
      arms: kinds of policies that are trained.
      seeds: policies trained of each kind.
      total_steps: environment steps of each policy, rounded up to whole chunks. The layout's policies have seen the
        prior's random steps (`layout.walks x layout.steps`) besides.
      seed: of all randomness in training.
      counterfactual: how the branch that counterfactual decisions use is trained.
      direct: which detections the direct pathway of the goal sees.
      done_gate: multiply the logit of Done by 0.58 times the confidence that the goal is in sight.
      chunk: updates per compiled call; between calls the run logs, saves (every `save_every` calls) and, where scenes
        are streamed, goes on to the next shard with new episodes.
      save_every: calls between checkpoints.
      cache: folder for compiled scenes that are streamed from disk.
      devices: what to train on, which changes results by rounding only: so many devices of this process, `cluster` for
        all that Slurm, Open MPI, Kubernetes or a TPU pod has started this command on, or `HOST:PORT,INDEX,PROCESSES`
        for command number INDEX of several equal ones, which meet at that address of number 0 and share the file system
        of `run_dir`; None: one device, and seeds side by side on its cores.
    """

    run_dir: Path = Path("runs/rooms")
    method: str = "org"
    world: Literal["rooms", "apartments", "houses"] = "rooms"
    scenes: Path | None = None
    arms: tuple[Literal["baseline", "layout"], ...] = ARMS
    seeds: int = 3
    total_steps: int = 2_000_000
    seed: int = 0
    counterfactual: Counterfactual = "distil"
    direct: Direct = "all"
    done_gate: bool = False
    chunk: int = 8
    save_every: int = 4
    cache: Path = Path("~/.cache/jaxnav")
    devices: int | str | None = None
    worlds: WorldConfig = WorldConfig()
    detector: Detector = Detector()
    layout: LayoutConfig = LayoutConfig()
    sizes: Sizes = Sizes()
    ppo: PPOConfig = PPOConfig()

    @property
    def source(self) -> str | Path:
        """Where the scenes come from."""
        return self.scenes or self.world

    @property
    def task(self) -> Task:
        """What is asked of the agent."""
        own, worlds = WORLDS[self.world].task, self.worlds
        if worlds.categories is not None:
            own = dataclasses.replace(own, categories=worlds.categories, goals=())
        return dataclasses.replace(
            own, goals=own.goals if worlds.goals is None else worlds.goals, detector=self.detector
        )

    @property
    def train_step_limit(self) -> int:
        """Actions of a training episode."""
        return self.worlds.train_step_limit or WORLDS[self.world].train_step_limit

    @property
    def update_steps(self) -> int:
        """Environment steps of one policy between two updates."""
        return self.ppo.num_envs * self.ppo.rollout

    @property
    def total_updates(self) -> int:
        """Updates of each policy, rounded up to whole chunks."""
        return -(-self.ppo.num_updates(self.total_steps) // self.chunk) * self.chunk


def check(config: RunConfig) -> RunConfig:
    """The same config, or an `InputError` that names the first impossible setting."""

    def need(holds: bool, name: str, value: object, mend: str) -> None:
        if not holds:
            raise InputError(f"config: {name} is {value}; {mend}")

    need(config.method in METHODS, "method", repr(config.method), f"choose one of {', '.join(METHODS)}")
    for name in ("seeds", "total_steps", "chunk", "save_every"):
        need(getattr(config, name) >= 1, name, getattr(config, name), "give at least 1")
    if config.devices is not None:
        forms = "give a number, `cluster` or HOST:PORT,INDEX,PROCESSES with INDEX from 0"
        need(Devices.parse(str(config.devices)) is not None, "devices", repr(config.devices), forms)
    seeds = {"seed": config.seed, "worlds.seed": config.worlds.seed, "detector.seed": config.detector.seed}
    for name, seed in seeds.items():
        need(0 <= seed < 2**32, name, seed, "give a whole number from 0 to 2**32 - 1")
    for group in ("worlds", "layout", "sizes", "ppo"):
        for field in dataclasses.fields(getattr(config, group)):
            value = getattr(getattr(config, group), field.name)
            if isinstance(value, int) and field.name != "seed":
                need(value >= 1, f"{group}.{field.name}", value, "give at least 1")
    arms, strength = config.arms, config.layout.strength
    need(len(set(arms)) == len(arms) > 0, "arms", arms, f"give some of {', '.join(ARMS)}, each once")
    fixed = config.layout.setting != "calibrated" and (strength, config.layout.reduction) != (None, None)
    need(not fixed, "layout.setting", config.layout.setting, "only `calibrated` takes a strength and a reduction")
    need(strength is None or 0.0 < strength < float("inf"), "layout.strength", strength, "give a positive number")
    ppo, detector = config.ppo, config.detector
    for name in ("miss_near", "miss_far", "false_alarm"):
        value = getattr(detector, name)
        need(0.0 <= value <= 1.0, f"detector.{name}", value, "give a probability from 0 to 1")
    for name in ("gamma", "gae_lambda"):
        need(0.0 <= getattr(ppo, name) <= 1.0, f"ppo.{name}", getattr(ppo, name), "give a number from 0 to 1")
    for name in ("learning_rate", "clip", "max_grad_norm"):
        need(0.0 < getattr(ppo, name) < float("inf"), f"ppo.{name}", getattr(ppo, name), "give a positive number")
    for name in ("entropy", "value", "distil"):
        need(0.0 <= getattr(ppo, name) < float("inf"), f"ppo.{name}", getattr(ppo, name), "give 0 or more")
    need(
        ppo.num_envs % ppo.minibatches == 0,
        "ppo.num_envs",
        ppo.num_envs,
        f"give a multiple of ppo.minibatches ({ppo.minibatches})",
    )
    need(
        ppo.rollout <= config.train_step_limit,
        "ppo.rollout",
        ppo.rollout,
        f"give at most worlds.train_step_limit ({config.train_step_limit})",
    )
    task, shift = config.task, config.worlds.shift
    need(0.0 <= shift <= 1.0, "worlds.shift", shift, "give a number from 0 to 1")
    shaping = config.worlds.shaping
    need(shaping is None or 0.0 <= shaping < float("inf"), "worlds.shaping", shaping, "give 0 or more")
    need(len(task.categories) >= 2, "worlds.categories", task.categories, "give at least 2")
    need(len(set(task.categories)) == len(task.categories), "worlds.categories", task.categories, "give each once")
    unknown = [goal for goal in task.goals if goal not in task.categories]
    need(not unknown, "worlds.goals", unknown, f"give some of the categories {', '.join(task.categories)}")
    return config
