"""Environments by the name of a world or file."""

import dataclasses

import numpy as np
import pytest
from support.scenes import APARTMENTS, HOUSES, ROOMS, SMALL, draw

from jaxnav.env.make import make
from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.env.testing import check_environment
from jaxnav.errors import InputError
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes


@pytest.mark.parametrize(
    ("world", "categories", "goals", "rules", "limits"),
    [
        ("rooms", 22, 22, ROOMS, (100, [100, 200, 100, 100])),
        ("apartments", 22, 12, APARTMENTS, (100, [500])),
        ("houses", 15, 6, HOUSES, (100, [500])),
    ],
)
def test_the_worlds_are_those_of_the_page(tmp_path, world, categories, goals, rules, limits):
    task = WORLDS[world].task
    assert (len(task.categories), task.is_goal().sum(), task.rules) == (categories, goals, rules)
    # A book and a television, both of which every world knows, in each room type and in a home.
    room = draw(["."], ("Book", 0, 1.0, 0.5, *SMALL), ("Television", 0, 1.0, 0.5, *SMALL))
    types = ROOM_TYPES if world == "rooms" else ("apartment",)
    path = tmp_path / "scenes.jsonl.gz"
    write_scenes(path, [named_room(room, split, kind) for split in ("train", "val") for kind in types])
    for split, expected in zip(("train", "val"), ([limits[0]] * len(types), limits[1]), strict=True):
        env, params = make(world, split, path)
        assert env.task == task
        assert params.step_limit.tolist() == expected
        assert params.room.tolist() == ([0, 1, 2, 3] if world == "rooms" else [OTHER_ROOM])


def named_room(room, split, room_type):
    return dataclasses.replace(room, name=f"{split}-{room_type}", split=split, room_type=room_type)


@pytest.mark.slow
def test_make_generates_a_world():
    env, params = make("houses", "val", seed=3)
    check_environment(env, params, num_envs=4, num_steps=16)
    scenes = make_generated_scenes("houses", "val", seed=3)
    bank = compile_bank([scenes[i] for i in range(len(scenes))], WORLDS["houses"].task)
    np.testing.assert_array_equal(params.tables.rows, bank.rows)


def test_make_from_a_scene_file_with_another_task(tmp_path):
    path = tmp_path / "rooms.jsonl.gz"
    scenes = [generate_room(split, i, 0) for split in ("train", "val") for i in range(4)]
    write_scenes(path, scenes)
    assert tuple(scene.room_type for scene in scenes[4:]) == ROOM_TYPES
    task = Task(("Television", "Sink"), rules=HOUSES)
    env, params = make("rooms", "val", path, task)
    assert (env.task, env.categories, env.num_actions) == (task, ("Television", "Sink"), 6)
    assert params.tables.ahead.shape[1] == 12


def test_make_refuses_what_it_does_not_know(tmp_path):
    with pytest.raises(InputError, match=r"world 'romms': choose one of rooms, apartments, houses"):
        make("romms")
    path = tmp_path / "train.jsonl.gz"
    write_scenes(path, [generate_room("train", 0, 0)])
    with pytest.raises(InputError, match=r"split 'valid': choose one of train, val, test"):
        make("rooms", "valid", path)
    with pytest.raises(InputError, match=r"train\.jsonl\.gz: holds no scene of split 'test'; it holds train"):
        make("rooms", "test", path)
    with pytest.raises(InputError, match="reachable goal"):
        make("rooms", "train", path, Task(("Unicorn",)))
