"""Environments by name: scenes are generated or read, compiled to tables and moved to the device.

`make` is the entry point for users. `build_environment` starts from a compiled bank of scenes.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.choices import ShiftKind, Split
from jaxnav.env.objectnav import EnvParams, ObjectNav, SceneTables, prior_index
from jaxnav.env.render import SceneRenderers
from jaxnav.errors import InputError
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, SceneSource
from jaxnav.store.files import expand_home

_SUCCESS_REWARD = 5.0
_STEP_REWARD = -0.01


def make(
    world: str = "rooms",
    split: Split = "train",
    scenes: str | Path | None = None,
    task: Task | None = None,
    seed: int = 0,
    shift: float = 0.0,
    shift_by: ShiftKind = "size",
) -> tuple[ObjectNav, EnvParams]:
    """Make an environment and its parameters.

    Args:
      world: `rooms`, `apartments` or `houses`; sets the task, the step limits and, without `scenes`, the scenes.
      split: `train`, `val` or `test`; training episodes are shorter.
      scenes: path of a scene file; None generates the scenes.
      task: task that replaces the world's own.
      seed: seed of the generated scenes, and of the layout shift.
      shift: layout shift in [0, 1], the share of the categories that exchange their places.
      shift_by: categories that exchange their places. `size`: neighbours in size. `context`: those whose exchange
        misleads most, fitted to the training scenes of the world or file.

    Returns:
      The environment, and its parameters with the compiled scenes.

    Raises:
      InputError: unknown world or split, bad scene file, no scene with a reachable goal, or no exchange by context that
        misleads.
    """
    if world not in WORLDS:
        raise InputError(f"world {world!r}: choose one of {', '.join(WORLDS)}, or give a scene file as `scenes`")
    world_config = WORLDS[world]
    task = task or world_config.task

    # Scenes, shifted and compiled. An absolute path equals no name of a world, so a file called
    # `rooms` is read as a file.
    file = world if scenes is None else str(expand_home(scenes).absolute())
    shifted_scenes = SceneSource(file, split, seed, shift, shift_by).open(task)
    bank = compile_bank((shifted_scenes[scene_index] for scene_index in range(len(shifted_scenes))), task)

    # Training has its own step limit, and may shape rewards and starts.
    if split == "train":
        env, params = build_environment(bank, {}, world_config.train_step_limit, shaping=world_config.shaping)
        env = dataclasses.replace(env, near_starts=world_config.near_starts)
    else:
        env, params = build_environment(bank, {"living_room": world_config.large_step_limit}, world_config.step_limit)
    renderers = SceneRenderers(shifted_scenes, bank.names, task)
    return dataclasses.replace(env, bundled_params=params, renderers=renderers), params


def build_environment(
    bank: Bank,
    step_limits: dict[str, int],
    default_limit: int,
    num_cells: int = 0,
    num_scenes: int = 0,
    shaping: float = 0.0,
    with_expert: bool = False,
) -> tuple[ObjectNav, EnvParams]:
    """Build an environment and its parameters from a compiled bank.

    Args:
      bank: the scenes.
      step_limits: step limit by room type.
      default_limit: step limit of all other room types.
      num_cells: least number of cells; a smaller bank is padded with unreachable cells, so that banks of equal sizes
        share one compilation.
      num_scenes: least number of scenes; a smaller bank repeats its scenes from the first, but episodes start in the
        bank's own scenes alone.
      shaping: see `ObjectNav`.
      with_expert: includes the actions of shortest paths, for imitation and guidance.

    Returns:
      The environment, and its parameters with the scenes of the bank.
    """
    # Sizes of the padding, and the scenes with their repetitions, [S].
    poses_per_cell = bank.task.rules.poses_per_cell
    num_extra_cells = max(num_cells - len(bank.ahead), 0)
    scene_indices = np.arange(max(num_scenes, len(bank.names))) % len(bank.names)

    # Padding cells are zeros, and no scene's range of cells includes them.
    def pad_cells(table: np.ndarray, rows_per_cell: int = 1) -> jax.Array:
        if not num_extra_cells:
            return jnp.asarray(table)
        padded_table = np.zeros((len(table) + rows_per_cell * num_extra_cells, *table.shape[1:]), table.dtype)
        padded_table[: len(table)] = table
        return jnp.asarray(padded_table)

    # Tables by cell and pose are padded with cells, tables by scene repeat their scenes.
    success_bits = np.packbits(bank.best_length == 1, axis=1, bitorder="little")
    tables = SceneTables(
        ahead=pad_cells(bank.ahead),
        rows=pad_cells(bank.rows, poses_per_cell),
        success=pad_cells(success_bits, poses_per_cell),
        goal_distance=pad_cells(bank.goal_distance),
        first_cell=jnp.asarray(bank.first_cell[scene_indices]),
        num_cells=jnp.asarray(bank.num_cells[scene_indices]),
        goals=jnp.asarray(bank.goals[scene_indices]),
        num_goals=jnp.asarray(bank.num_goals[scene_indices]),
        expert=pad_cells(bank.expert, poses_per_cell) if with_expert else None,
        num_scenes=jnp.int32(len(bank.names)) if num_scenes else None,
    )

    # Layout prior and step limit follow from the room type, [S] each.
    room_priors = []
    room_limits = []
    for room_type in bank.room_types:
        room_priors.append(prior_index(room_type))
        room_limits.append(step_limits.get(room_type, default_limit))

    # Everything that may change without recompilation goes to the device.
    params = EnvParams(
        tables=tables,
        room=jnp.asarray(np.array(room_priors, np.int32)[scene_indices]),
        step_limit=jnp.asarray(np.array(room_limits, np.int32)[scene_indices]),
        success_reward=jnp.float32(_SUCCESS_REWARD),
        step_reward=jnp.float32(_STEP_REWARD),
    )
    return ObjectNav(bank.task, shaping), params
