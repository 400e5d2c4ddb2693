"""`jaxnav.make` builds environments from the name of a world or from a scene file."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.scenes import APARTMENTS, HOUSES, ROOMS, SMALL, draw

from jaxnav.choices import Split
from jaxnav.env.make import make
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.env.testing import check_environment
from jaxnav.errors import InputError
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.layout_shift import exchange_places
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, fit_scene_exchange, make_generated_scenes

#: A book and a television, both of which are goals in every world.
GOALS_ROOM = draw(["."], ("Book", 0, 1.0, 0.5, *SMALL), ("Television", 0, 1.0, 0.5, *SMALL))


@pytest.mark.parametrize(
    ("world", "num_categories", "num_goals", "rules"),
    [("rooms", 22, 22, ROOMS), ("apartments", 22, 12, APARTMENTS), ("houses", 15, 6, HOUSES)],
)
def test_worlds_have_the_documented_tasks(world, num_categories, num_goals, rules):
    task = WORLDS[world].task
    assert (len(task.categories), task.is_goal().sum(), task.rules) == (num_categories, num_goals, rules)


@pytest.mark.parametrize(
    ("world", "room_types", "room_indices", "val_limits"),
    [
        ("rooms", ROOM_TYPES, [0, 1, 2, 3], [100, 200, 100, 100]),
        ("apartments", ("apartment",), [OTHER_ROOM], [500]),
        ("houses", ("apartment",), [OTHER_ROOM], [500]),
    ],
)
def test_make_sets_the_documented_step_limits(tmp_path, world, room_types, room_indices, val_limits):
    # One room of each type in each split.
    scenes = []
    for split in ("train", "val"):
        for room_type in room_types:
            scenes.append(
                dataclasses.replace(GOALS_ROOM, name=f"{split}-{room_type}", split=split, room_type=room_type)
            )
    path = tmp_path / "scenes.jsonl.gz"
    write_scenes(path, scenes)

    # Training episodes have 100 steps everywhere.
    limits: dict[Split, list[int]] = {"train": [100] * len(room_types), "val": val_limits}
    for split, expected_limits in limits.items():
        env, params = make(world, split, path)
        assert env.task == WORLDS[world].task
        assert params.step_limit.tolist() == expected_limits
        assert params.max_steps_in_episode == max(expected_limits)
        assert params.room.tolist() == room_indices


@pytest.mark.slow
def test_make_generates_the_scenes_of_a_world():
    env, params = make("houses", "val", seed=3)
    check_environment(env, params, num_envs=4, num_steps=16)
    scenes = make_generated_scenes("houses", "val", seed=3)
    bank = compile_bank([scenes[index] for index in range(len(scenes))], WORLDS["houses"].task)
    np.testing.assert_array_equal(params.tables.rows, bank.rows)


def test_make_takes_a_scene_file_and_a_task(tmp_path):
    scenes = [generate_room("val", index, 0) for index in range(4)]
    path = tmp_path / "rooms.jsonl.gz"
    write_scenes(path, scenes)
    assert tuple(scene.room_type for scene in scenes) == ROOM_TYPES

    task = Task(("Television", "Sink"), rules=HOUSES)
    env, params = make("rooms", "val", path, task)
    assert (env.task, env.categories, env.num_actions) == (task, ("Television", "Sink"), 6)
    assert params.tables.ahead.shape[1] == 12


def test_make_shifts_layouts_by_size_or_by_context(tmp_path):
    train_scenes = [generate_room("train", index, 0) for index in range(8)]
    val_scenes = [generate_room("val", index, 0) for index in range(4)]
    path = tmp_path / "rooms.jsonl.gz"
    write_scenes(path, [*train_scenes, *val_scenes])

    # The exchange by context is fitted to the training scenes.
    task = WORLDS["rooms"].task
    exchanges = {"size": None, "context": fit_scene_exchange(train_scenes, task)}
    rows_by_kind = {}
    for kind, exchange in exchanges.items():
        options: dict[str, Any] = {"shift": 1.0, "shift_by": kind}
        _, params = make("rooms", "val", path, **options)
        bank = compile_bank([exchange_places(scene, task, 1.0, 0, exchange) for scene in val_scenes], task)
        np.testing.assert_array_equal(params.tables.rows, bank.rows)
        rows_by_kind[kind] = bank.rows
    assert not np.array_equal(rows_by_kind["size"], rows_by_kind["context"])
    with pytest.raises(InputError, match=r"^--shift-by 'colour': choose one of size, context"):
        make("rooms", "val", path, shift=1.0, shift_by="colour")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("romms",), "world 'romms': choose one of rooms, apartments, houses"),
        (("rooms", "valid"), "split 'valid': choose one of train, val, test"),
        (("rooms", "test"), r"train\.jsonl\.gz: holds no scene of split 'test'; it holds train"),
        (("rooms", "train", Task(("Unicorn",))), "reachable goal"),
    ],
    ids=["world", "split", "empty split", "unreachable goal"],
)
def test_make_refuses_invalid_arguments(tmp_path, arguments, problem):
    path = tmp_path / "train.jsonl.gz"
    write_scenes(path, [generate_room("train", 0, 0)])
    # The scene file comes between split and task; the default split is the one of the file.
    world, *split_and_task = arguments
    split, *task = split_and_task or ["train"]
    with pytest.raises(InputError, match=problem):
        make(world, split, path, *task)
