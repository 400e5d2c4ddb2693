"""The scenes of a run: compiled in memory, or as shards on disk where there are many."""

import dataclasses
import zlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from jaxnav.cli.config import RunConfig
from jaxnav.env.objectnav import ObjectNav, build
from jaxnav.env.types import EnvParams
from jaxnav.scenes.categories import unknown_types
from jaxnav.scenes.compile import Bank, compile_bank
from jaxnav.scenes.shards import compile_shards
from jaxnav.scenes.worlds import WORLDS, Scenes, from_file, generated


@dataclasses.dataclass(frozen=True)
class CompiledWorld:
    """The scenes of one split, compiled.

    Attributes:
      scenes: as read or generated.
      env: the environment.
      banks: their tables; one in memory, or several that stay on disk until they are used.
      step_limits: actions of an episode by room type.
      step_limit: the same in other rooms.
      num_cells, num_scenes: of the largest bank.
      fingerprint: text that differs wherever the banks differ.
    """

    scenes: Scenes
    env: ObjectNav
    banks: Sequence[Bank]
    step_limits: dict[str, int]
    step_limit: int
    num_cells: int
    num_scenes: int
    fingerprint: str

    def params(self, index: int) -> EnvParams:
        """The environment's parameters with one of the banks, all of equal shape."""
        return build(self.banks[index], self.step_limits, self.step_limit, self.num_cells, self.num_scenes)[1]


def training_world(config: RunConfig, console: Console) -> CompiledWorld:
    """The training scenes of a run."""
    scenes = _scenes(config, "train", config.scenes, config.worlds.shift, console)
    return _compiled(config, scenes, {}, config.train_step_limit, console)


def evaluation_world(
    config: RunConfig, split: str, scenes: Path | None, shift: float | None, console: Console
) -> CompiledWorld:
    """The scenes to evaluate a run in: one split of its own world or file, or of another file, or at another shift.

    Raises:
      InputError: bad scene file, no scene of the split, or a bad shift.
    """
    world, shift = WORLDS[config.world], config.worlds.shift if shift is None else shift
    limits = {"living_room": config.worlds.large_step_limit or world.large_step_limit}
    limit = config.worlds.step_limit or world.step_limit
    chosen = _scenes(config, split, scenes or config.scenes, shift, console)
    return _compiled(config, chosen, limits, limit, console)


def _scenes(config: RunConfig, split: str, path: Path | None, shift: float, console: Console) -> Scenes:
    if path is None:
        return generated(config.world, split, getattr(config.worlds, f"num_{split}"), config.worlds.seed, shift)
    scenes = from_file(path, split)
    if counts := unknown_types(scenes.scenes, config.task.categories):
        types = ", ".join(f"{name} x {count}" for name, count in counts.most_common(5))
        rest = f" and {len(counts) - 5} more" if len(counts) > 5 else ""
        console.print(f"{path}: types that are no category and only block the sight: {types}{rest}", soft_wrap=True)
    return scenes


def _compiled(
    config: RunConfig, scenes: Scenes, step_limits: dict[str, int], step_limit: int, console: Console
) -> CompiledWorld:
    task, shard_scenes = config.task, config.worlds.shard_scenes
    env = ObjectNav(task, WORLDS[config.world].shaping if config.worlds.shaping is None else config.worlds.shaping)
    if len(scenes) <= shard_scenes:
        bank = compile_bank((scenes[i] for i in range(len(scenes))), task)
        without = f" ({len(bank.skipped)} scenes without a goal left out)" if bank.skipped else ""
        console.print(f"{len(bank.names)} scenes, {len(bank.rows):,} poses{without}")
        about = len(bank.ahead), len(bank.names), f"{checksum(bank):08x}"
        return CompiledWorld(scenes, env, (bank,), step_limits, step_limit, *about)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task(f"compiling {len(scenes):,} scenes")

        def report(done: int, total: int) -> None:
            progress.update(bar, completed=done, total=total)

        shards = compile_shards(scenes, task, shard_scenes, config.cache.expanduser(), report)
    size = sum(file.stat().st_size for file in shards.folder.rglob("*.npy"))
    console.print(
        f"{sum(shards.counts):,} scenes in {len(shards)} shards, {size / 1e9:.2f} GB in {shards.folder}", soft_wrap=True
    )
    about = shards.num_cells, shards.num_scenes, shards.folder.name
    return CompiledWorld(scenes, env, shards, step_limits, step_limit, *about)


def checksum(bank: Bank) -> int:
    """CRC-32 of everything in a bank."""
    crc = 0
    for part in bank:
        crc = zlib.crc32(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode(), crc)
    return crc


class Stream:
    """Bank after bank on the device, the next one read while one is used.

    Every pass over the banks is in an order of its own, which the seed decides.
    """

    def __init__(self, world: CompiledWorld, seed: int) -> None:
        self._world = world
        self._seed = seed
        self._pool = ThreadPoolExecutor(1)
        self._loaded: dict[int, Future[EnvParams]] = {}

    def bank(self, turn: int) -> int:
        """Index of the bank of a turn (0, 1, ...)."""
        count = len(self._world.banks)
        return int(np.random.default_rng([self._seed, turn // count]).permutation(count)[turn % count])

    def params(self, turn: int) -> EnvParams:
        """The environment's parameters at a turn; those of the next one are fetched in the background."""
        wanted = {self.bank(turn), self.bank(turn + 1)}
        self._loaded = {index: future for index, future in self._loaded.items() if index in wanted}
        for index in (self.bank(turn), self.bank(turn + 1)):
            if index not in self._loaded:
                self._loaded[index] = self._pool.submit(self._world.params, index)
        return self._loaded[self.bank(turn)].result()
