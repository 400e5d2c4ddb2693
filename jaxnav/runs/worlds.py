"""The scenes of a run, compiled in memory or as shards on disk."""

import dataclasses
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from jaxnav.env.build import build
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.errors import InputError
from jaxnav.policies.methods import Knowledge, find_method
from jaxnav.runs.config import RunConfig
from jaxnav.scenes.categories import most_common, unknown_types
from jaxnav.scenes.scene import SPLITS
from jaxnav.scenes.tables.compile import Bank, checksum, compile_bank, concatenate
from jaxnav.scenes.tables.shards import Shards, compile_shards
from jaxnav.scenes.worlds import WORLDS, Scenes, from_file, generated, shifted


@dataclasses.dataclass(frozen=True)
class CompiledWorld:
    """Hold the compiled scenes of one split.

    Attributes:
      scenes: as read or generated.
      env: the environment.
      banks: their tables; one in memory, or several that stay on disk until they are used.
      step_limits: actions of an episode by room type.
      step_limit: the same in other rooms.
      num_cells, num_scenes: of the largest bank.
      fingerprint: text that differs wherever the banks differ.
      expert: whether a method imitates shortest paths in them.
    """

    scenes: Scenes
    env: ObjectNav
    banks: Sequence[Bank] | Shards
    step_limits: dict[str, int]
    step_limit: int
    num_cells: int
    num_scenes: int
    fingerprint: str
    expert: bool = False

    def params(self, index: int) -> EnvParams:
        """Return the environment's parameters with one of the banks.

        Those of all banks are of equal shape.
        """
        sizes = self.num_cells, self.num_scenes
        return build(self.banks[index], self.step_limits, self.step_limit, *sizes, expert=self.expert)[1]

    def check(self, method: str, knowledge: Knowledge) -> None:
        """Let a method refuse scenes that it cannot act in.

        Raises:
          InputError: it does.
        """
        refuse = find_method(method).check
        if refuse is not None:
            for bank in self.banks:
                refuse(knowledge, bank)

    def limits(self, bank: Bank) -> np.ndarray:
        """Return the actions of an episode in each scene, int [S]."""
        return np.array([self.step_limits.get(room, self.step_limit) for room in bank.room_types])


def training_world(config: RunConfig, console: Console) -> CompiledWorld:
    """Compile the training scenes of a run."""
    scenes = _scenes(config, config.world, "train", config.scenes, config.worlds.shift, console)
    world = _compiled(config, scenes, {}, config.train_step_limit, console)
    return dataclasses.replace(world, expert=any(stage.imitates for stage in config.stages))


def sample_bank(config: RunConfig, count: int = 4) -> Bank:
    """Compile the first few training scenes of a run."""
    scenes = _scenes(config, config.world, "train", config.scenes, config.worlds.shift, Console(quiet=True))
    return compile_bank((scenes[i] for i in range(min(count, len(scenes)))), config.task)


def evaluation_world(
    config: RunConfig,
    split: str,
    scenes: Path | None,
    shift: float | None,
    console: Console,
    world: str | None = None,
) -> CompiledWorld:
    """Compile the scenes to evaluate a run in.

    One split of its own world or file, of another file or of a generated world, or at another shift. Categories and
    rules are the run's.

    Raises:
      InputError: unknown split or world, bad scene file, no scene of the split, a bad shift, or both a file and a
        world.
    """
    for option, value, known in (("split", split, SPLITS), ("world", world or config.world, WORLDS)):
        if value not in known:
            raise InputError(f"--{option} {value}: choose one of {', '.join(known)}")
    if scenes and world:
        raise InputError(f"--scenes, --world: both are given ({scenes}, {world}); leave one out")
    name, path = world or config.world, scenes or (None if world else config.scenes)
    limits = {"living_room": config.worlds.large_step_limit or WORLDS[name].large_step_limit}
    limit = config.worlds.step_limit or WORLDS[name].step_limit
    chosen = _scenes(config, name, split, path, evaluation_shift(config, scenes or world, shift), console)
    return _compiled(config, chosen, limits, limit, console)


def one_world(worlds: Sequence[CompiledWorld]) -> CompiledWorld:
    """Put the scenes of compiled worlds with equal rules end to end.

    Raises:
      InputError: the scenes of one of them fill more than one shard.
    """
    if any(len(world.banks) > 1 for world in worlds):
        raise InputError("scenes fill more than one shard; give more --shard-scenes, or fewer scenes")
    bank = concatenate([world.banks[0] for world in worlds])
    about = len(bank.ahead), len(bank.names), "-".join(world.fingerprint for world in worlds)
    return CompiledWorld(worlds[0].scenes, worlds[0].env, (bank,), worlds[0].step_limits, worlds[0].step_limit, *about)


def evaluation_shift(config: RunConfig, other: Path | str | None, shift: float | None) -> float:
    """Return the shift that is asked for, else the run's.

    Another file or world is taken as it is.
    """
    if shift is not None:
        return shift
    return 0.0 if other else config.worlds.shift


def _scenes(config: RunConfig, world: str, split: str, path: Path | None, shift: float, console: Console) -> Scenes:
    task, seed = config.task, config.worlds.seed
    if path is None:
        return shifted(generated(world, split, getattr(config.worlds, f"num_{split}"), seed), task, shift, seed)
    scenes = from_file(path, split)
    if counts := unknown_types(scenes.scenes, task.categories):
        types = most_common(counts)
        console.print(f"{path}: types that are no category and only block the sight: {types}")
    return shifted(scenes, task, shift, seed)


def _compiled(
    config: RunConfig, scenes: Scenes, step_limits: dict[str, int], step_limit: int, console: Console
) -> CompiledWorld:
    task, shard_scenes = config.task, config.worlds.shard_scenes
    env = ObjectNav(task, WORLDS[config.world].shaping if config.worlds.shaping is None else config.worlds.shaping)
    if len(scenes) <= shard_scenes:
        bank = compile_bank((scenes[i] for i in range(len(scenes))), task)
        console.print(f"{len(bank.names)} scenes, {len(bank.rows):,} poses{_left_out(bank.skipped)}")
        about = len(bank.ahead), len(bank.names), f"{checksum(bank):08x}"
        return CompiledWorld(scenes, env, (bank,), step_limits, step_limit, *about)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task(f"compiling {len(scenes):,} scenes")

        def report(done: int, total: int) -> None:
            progress.update(bar, completed=done, total=total)

        try:
            shards = compile_shards(scenes, task, shard_scenes, config.cache.expanduser(), report)
        except OSError as error:
            raise InputError(f"--cache {config.cache}: {error.strerror}; give another folder, or make room") from error
    if config.chunk * config.ppo.rollout < config.train_step_limit:
        raise InputError(
            f"config: chunk is {config.chunk}; where scenes are streamed it must last for a whole episode: give at "
            f"least {-(-config.train_step_limit // config.ppo.rollout)}"
        )
    size = sum(file.stat().st_size for file in shards.folder.rglob("*.npy")) / 1e9
    console.print(
        f"{sum(shards.counts):,} scenes in {len(shards)} shards, {size:.2f} GB in {shards.folder}"
        f"{_left_out(shards.skipped)}",
    )
    about = shards.num_cells, shards.num_scenes, f"{shards.checksum:08x}"
    return CompiledWorld(scenes, env, shards, step_limits, step_limit, *about)


def _left_out(skipped: Sequence[str]) -> str:
    return f" ({len(skipped)} scenes without a goal left out)" if skipped else ""


def bank_order(world: CompiledWorld, seed: int, turns: int) -> list[int]:
    """Draw which bank is trained in at each turn.

    Pass after pass over all of them, each in an order of its own.
    """
    count = len(world.banks)
    passes = [np.random.default_rng([seed, i]).permutation(count).tolist() for i in range(-(-turns // count))]
    return [bank for order in passes for bank in order][:turns]


def read_ahead(world: CompiledWorld, order: Sequence[int]) -> Iterator[EnvParams]:
    """Yield the environment's parameters with one bank after another.

    The next one is read while one is used.
    """
    if not order:
        return
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(world.params, order[0])
        for i, bank in enumerate(order):
            params = coming.result()
            if i + 1 < len(order) and order[i + 1] != bank:
                coming = pool.submit(world.params, order[i + 1])
            yield params
