"""Compiled scenes of a run, in memory or as shards on disk.

`compile_training_world` and `compile_evaluation_world` read or generate the scenes of one split and compile their
tables. A world with many scenes is streamed from disk: `draw_bank_order` draws which shard comes next, and
`prefetch_env_params` reads it while the previous one is in use.
"""

import dataclasses
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console
from rich.progress import Progress

from jaxnav.choices import ShiftKind
from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import EnvParams, ObjectNav
from jaxnav.errors import InputError, check_choice
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.plain_console import PlainConsole, to_plain_console
from jaxnav.policies.method import Knowledge, Method
from jaxnav.progress import show_activity
from jaxnav.runs.config import RunConfig
from jaxnav.scenes.categories import count_unknown_types, format_most_common
from jaxnav.scenes.context_exchange import ContextExchange
from jaxnav.scenes.scene import SPLITS, Scene
from jaxnav.scenes.tables.compile import Bank, bank_checksum, compile_bank, concatenate_banks
from jaxnav.scenes.tables.shards import Shards, compile_shards
from jaxnav.scenes.worlds import (
    WORLDS,
    Scenes,
    fit_scene_exchange,
    load_scenes,
    make_generated_scenes,
    shift_scenes,
)
from jaxnav.store.files import expand_home

#: Scenes in which a method of another package is checked.
_NUM_SAMPLE_SCENES = 4


@dataclasses.dataclass(frozen=True)
class CompiledWorld:
    """Compiled scenes of one split.

    Attributes:
      scenes: the scenes, as read or generated.
      env: the environment.
      banks: tables of the scenes; one bank in memory, or several shards that stay on disk until they are used.
      step_limits: maximum number of actions in an episode, by room type.
      step_limit: maximum number of actions in other rooms.
      num_cells, num_scenes: sizes of the largest bank.
      fingerprint: text that differs wherever the banks differ.
      has_expert: True where the tables hold the actions of shortest paths, for methods that imitate them.
    """

    scenes: Scenes
    env: ObjectNav
    banks: Sequence[Bank] | Shards
    step_limits: dict[str, int]
    step_limit: int
    num_cells: int
    num_scenes: int
    fingerprint: str
    has_expert: bool = False

    def make_env_params(self, index: int) -> EnvParams:
        """Parameters of the environment with one bank; those of all banks have the same shapes."""
        _, params = build_environment(
            self.banks[index],
            self.step_limits,
            self.step_limit,
            self.num_cells,
            self.num_scenes,
            with_expert=self.has_expert,
        )
        return params

    def check_method(self, method: Method, knowledge: Knowledge) -> None:
        """Check that a method can act in these scenes.

        Raises:
          InputError: the method refuses a bank.
        """
        if method.check is not None:
            for bank in self.banks:
                method.check(knowledge, bank)

    def scene_step_limits(self, bank: Bank) -> np.ndarray:
        """Maximum number of actions in an episode of each scene of a bank, int [S]."""
        return np.array([self.step_limits.get(room, self.step_limit) for room in bank.room_types])


def compile_training_world(config: RunConfig, console: Console) -> CompiledWorld:
    """Compile the training scenes of a run."""
    console = to_plain_console(console)
    scenes = _load_scenes(config, config.world, "train", config.scenes, config.worlds.shift, console)
    compiled_world = _compile_world(config, scenes, {}, config.train_step_limit, console)
    has_expert = config.ppo.has_guidance or any(stage.uses_expert for stage in config.stages)
    return dataclasses.replace(compiled_world, has_expert=has_expert)


def compile_sample_bank(config: RunConfig) -> Bank:
    """Compile the first few training scenes of a run."""
    scenes = _load_scenes(config, config.world, "train", config.scenes, config.worlds.shift, PlainConsole(quiet=True))
    # A scene file may hold fewer scenes.
    num_scenes = min(_NUM_SAMPLE_SCENES, len(scenes))
    return compile_bank((scenes[index] for index in range(num_scenes)), config.task)


def compile_evaluation_world(
    config: RunConfig,
    split: str,
    scenes: Path | None,
    shift: float | None,
    console: Console,
    world: str | None = None,
    shift_by: ShiftKind = "size",
) -> CompiledWorld:
    """Compile the scenes in which a run is evaluated.

    Categories and rules are always those of the run.

    Args:
      config: configuration of the run.
      split: split of the scenes.
      scenes: scene file to read in place of the run's scenes.
      shift: layout shift; see `evaluation_shift`.
      console: console for progress.
      world: generated world to use in place of the run's scenes.
      shift_by: categories that exchange their places; `context` is fitted to the training scenes of the run.

    Raises:
      InputError: unknown split, world or kind of shift, bad scene file, no scene of the split, a bad shift, no exchange
        by context that misleads, or both a file and a world.
    """
    console = to_plain_console(console)
    world_name = world or config.world
    check_choice("--split", split, SPLITS)
    check_choice("--world", world_name, WORLDS)
    if scenes and world:
        raise InputError(f"--scenes, --world: both are given ({scenes}, {world}); give only one")

    # Another file or world replaces the scenes of the run.
    path = scenes
    if not (scenes or world):
        path = config.scenes
    evaluation_scenes = _load_scenes(
        config, world_name, split, path, evaluation_shift(config, scenes or world, shift), console, shift_by
    )

    # Episodes in living rooms may be longer.
    step_limits = {"living_room": config.worlds.large_step_limit or WORLDS[world_name].large_step_limit}
    step_limit = config.worlds.step_limit or WORLDS[world_name].step_limit
    return _compile_world(config, evaluation_scenes, step_limits, step_limit, console)


def evaluation_shift(config: RunConfig, other_source: Path | str | None, shift: float | None) -> float:
    """Layout shift of an evaluation: `shift` where given, else the run's, and 0 with another file or world."""
    if shift is not None:
        return shift
    return 0.0 if other_source else config.worlds.shift


def _load_scenes(
    config: RunConfig,
    world: str,
    split: str,
    path: Path | None,
    shift: float,
    console: PlainConsole,
    shift_by: ShiftKind = "size",
) -> Scenes:
    """Read or generate the scenes of a split, and shift their layout."""
    check_choice("--shift-by", shift_by, get_args(ShiftKind))
    context_exchange = fit_run_exchange(config) if shift and shift_by == "context" else None
    # The seed of the generator also decides which categories exchange their places.
    seed = config.worlds.seed
    if path is None:
        num_scenes = getattr(config.worlds, f"num_{split}")
        scenes = make_generated_scenes(world, split, num_scenes, seed)
        return shift_scenes(scenes, config.task, shift, seed, context_exchange)

    # Objects of a file need not be categories of the task.
    scenes = load_scenes(path, split)
    unknown_types = count_unknown_types(scenes.scenes, config.task.categories)
    if unknown_types:
        type_names = format_most_common(unknown_types)
        console.print(f"{path}: these object types are not categories and only block the view: {type_names}")
    return shift_scenes(scenes, config.task, shift, seed, context_exchange)


def fit_run_exchange(config: RunConfig) -> ContextExchange:
    """Fit the exchange of categories that misleads most to the training scenes of a run, without their shift.

    Raises:
      InputError: the scene file has no training scenes, or no exchange misleads.
    """
    if config.scenes is None:
        scenes: Scenes = make_generated_scenes(config.world, "train", config.worlds.num_train, config.worlds.seed)
    else:
        scenes = load_scenes(config.scenes, "train")
    return fit_scene_exchange(scenes, config.task)


def _compile_world(
    config: RunConfig, scenes: Scenes, step_limits: dict[str, int], step_limit: int, console: PlainConsole
) -> CompiledWorld:
    """Compile scenes in memory, or to shards where there are more than `worlds.shard_scenes`."""
    shaping = WORLDS[config.world].shaping if config.worlds.shaping is None else config.worlds.shaping
    env = ObjectNav(config.task, shaping)

    # Few scenes stay in memory as one bank.
    if len(scenes) <= config.worlds.shard_scenes:
        with show_activity(console, f"compiling {len(scenes):,} scenes"):
            bank = compile_bank((scenes[index] for index in range(len(scenes))), config.task)
        console.print(f"{len(bank.names)} scenes, {len(bank.rows):,} poses{_skipped_note(bank.skipped)}")
        return CompiledWorld(
            scenes,
            env,
            (bank,),
            step_limits,
            step_limit,
            num_cells=len(bank.ahead),
            num_scenes=len(bank.names),
            fingerprint=f"{bank_checksum(bank):08x}",
        )

    # Many scenes are streamed from disk.
    shards = _compile_to_cache(config, scenes, console)
    return CompiledWorld(
        scenes,
        env,
        shards,
        step_limits,
        step_limit,
        num_cells=shards.num_cells,
        num_scenes=shards.num_scenes,
        fingerprint=f"{shards.checksum:08x}",
    )


def _compile_to_cache(config: RunConfig, scenes: Scenes, console: PlainConsole) -> Shards:
    """Compile scenes to shards in the cache folder, unless they are there."""
    with Progress(console=console, disable=not console.is_terminal) as progress:
        progress_bar = progress.add_task(f"compiling {len(scenes):,} scenes")

        def report_progress(completed: int, total: int) -> None:
            progress.update(progress_bar, completed=completed, total=total)

        try:
            cache = expand_home(config.cache)
            shards = compile_shards(scenes, config.task, config.worlds.shard_scenes, cache, report_progress)
        except OSError as error:
            remedy = "give another folder or free disk space"
            raise InputError(f"--cache {config.cache}: {error.strerror}; {remedy}") from error

    # Every shard begins with new episodes, so a chunk in one shard must last for a whole episode.
    if config.chunk * config.ppo.rollout < config.train_step_limit:
        min_chunk = -(-config.train_step_limit // config.ppo.rollout)  # rounded up
        raise InputError(
            f"config: chunk is {config.chunk}; with streamed scenes a chunk must be at least as long as an episode: "
            f"give at least {min_chunk}"
        )

    # Say how much of the disk the shards fill.
    size_gb = sum(array_file.stat().st_size for array_file in shards.folder.rglob("*.npy")) / 1e9
    console.print(
        f"{sum(shards.counts):,} scenes in {len(shards)} shards, {size_gb:.2f} GB in {shards.folder}"
        f"{_skipped_note(shards.skipped)}",
    )
    return shards


def _skipped_note(skipped: Sequence[str]) -> str:
    plural = "" if len(skipped) == 1 else "s"
    return f" ({len(skipped)} scene{plural} without a goal skipped)" if skipped else ""


def concatenate_worlds(worlds: Sequence[CompiledWorld]) -> CompiledWorld:
    """Join compiled worlds with equal rules into one.

    Raises:
      InputError: the scenes of a world fill more than one shard.
    """
    if any(len(world.banks) > 1 for world in worlds):
        raise InputError("the scenes fill more than one shard; give a larger --shard-scenes or fewer scenes")
    # Banks in memory are joined; settings are those of the first world.
    bank = concatenate_banks([world.banks[0] for world in worlds])
    return dataclasses.replace(
        worlds[0],
        banks=(bank,),
        num_cells=len(bank.ahead),
        num_scenes=len(bank.names),
        fingerprint="-".join(world.fingerprint for world in worlds),
    )


def draw_episode_lists(compiled_world: CompiledWorld, num_episodes: int, seed: int) -> list[EpisodeList]:
    """Draw fixed episodes, equally many in every bank of scenes."""
    episodes_per_bank = -(-num_episodes // len(compiled_world.banks))  # rounded up
    return [draw_episodes(bank, episodes_per_bank, seed, index) for index, bank in enumerate(compiled_world.banks)]


def draw_bank_order(compiled_world: CompiledWorld, seed: int, num_turns: int) -> list[int]:
    """Draw the index of the bank for every turn of training.

    Passes over all banks follow one another, each in an order of its own.
    """
    num_banks = len(compiled_world.banks)
    num_passes = -(-num_turns // num_banks)  # rounded up
    order: list[int] = []
    for pass_index in range(num_passes):
        order += np.random.default_rng([seed, pass_index]).permutation(num_banks).tolist()
    return order[:num_turns]


def prefetch_env_params(compiled_world: CompiledWorld, order: Sequence[int]) -> Iterator[EnvParams]:
    """Yield the environment's parameters with one bank after another, and read the next bank meanwhile."""
    if not order:
        return
    with ThreadPoolExecutor(1) as thread_pool:
        # One thread reads the next bank while the caller uses this one.
        pending_params = thread_pool.submit(compiled_world.make_env_params, order[0])
        for turn_index, bank_index in enumerate(order):
            params = pending_params.result()

            # A bank that comes again in the next turn stays.
            if turn_index + 1 < len(order) and order[turn_index + 1] != bank_index:
                pending_params = thread_pool.submit(compiled_world.make_env_params, order[turn_index + 1])
            yield params


def find_scenes(compiled_world: CompiledWorld, names: Collection[str]) -> dict[str, Scene]:
    """Find scenes of a world by their names.

    The scenes are read once, in order, because generated ones are generated anew at each access.

    Raises:
      LookupError: the world has no scene of a name.
    """
    missing_names = set(names)
    scene_by_name: dict[str, Scene] = {}
    for index in range(len(compiled_world.scenes)):
        if not missing_names:
            break
        scene = compiled_world.scenes[index]
        if scene.name in missing_names:
            scene_by_name[scene.name] = scene
            missing_names.remove(scene.name)
    if missing_names:
        raise LookupError(f"the world has no scene {min(missing_names)!r}")
    return scene_by_name
