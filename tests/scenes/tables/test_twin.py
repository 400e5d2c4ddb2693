"""The compiled environment against the plain-Python twin: the same episodes in both, and not one difference.

The byte row is taken apart here by the words of docs/environment.md, without `RowFormat`.
"""

import collections
import dataclasses
import functools
import itertools
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.scenes import APARTMENTS, HOUSES, ROOMS, coarse_scene, maze_scene
from support.twin import DONE, Twin
from support.twin_scene import largest_component

from jaxnav.env.build import build
from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.generate.rooms import generate_rooms
from jaxnav.scenes.lattice import standable_cells, successors
from jaxnav.scenes.tables.compile import compile_bank, compile_scene
from jaxnav.scenes.tables.detector import PERFECT
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, generated

SHARED = Path(__file__).parents[4] / "shared" / "scenes"
REAL_FILE, APARTMENT_FILE = SHARED / "ithor_train_val.jsonl.gz", SHARED / "robothor_train.jsonl.gz"
NUM_ENVS, NUM_STEPS = 20, 150  # 3,000 steps of each source and task
LIVING_ROOM, OTHERS = 60, 30  # step limits
TASKS = {
    "rooms": Task(rules=ROOMS, detector=PERFECT),
    "apartments": Task(rules=APARTMENTS, goals=ITHOR_CATEGORIES[::2], detector=PERFECT),
    "houses": Task(rules=HOUSES, goals=ITHOR_CATEGORIES[1::2], detector=PERFECT),
}


@functools.cache
def scenes_of(source):
    """A scene of each room type, or six drawn ones."""
    if source == "coarse":
        return [coarse_scene(seed) for seed in range(6)]
    if source == "maze":
        return [maze_scene(seed) for seed in range(6)]
    if source == "rooms":
        return generate_rooms(4, 0, 0)
    if not REAL_FILE.exists():
        pytest.skip("the real rooms are not here")
    scenes = [scene for scene in read_scenes(REAL_FILE) if scene.split == "val"]
    return [next(scene for scene in scenes if scene.room_type == room) for room in ROOM_TYPES]


class Guide:
    """The twin of a scene, and its poses by number."""

    def __init__(self, scene, task):
        reach = largest_component({(iz, ix) for iz, ix in np.argwhere(scene.reach).tolist()})
        self.cells, self.rules = sorted(reach), task.rules
        self.index = {cell: i for i, cell in enumerate(self.cells)}
        self.twin = Twin(scene, task.categories, task.rules, 0, self.cells[0], 0, 0, 1)

    def place(self, pose, goal=0, step_limit=2):
        """Start an episode at a pose index within the scene."""
        cell, turn = divmod(pose, self.rules.headings * len(self.rules.horizons))
        self.twin.reset(goal, self.cells[cell], *divmod(turn, len(self.rules.horizons)), step_limit)
        return self.twin

    def pose(self):
        place, (headings, horizons) = self.twin, (self.rules.headings, len(self.rules.horizons))
        return (self.index[place.cell] * headings + place.heading) * horizons + place.horizon


@functools.cache
def guides_of(source, task):
    return [Guide(scene, task) for scene in scenes_of(source)]


def agrees(entry, instance):
    """Whether the four bytes of a category are those of an instance, within half a quantum."""
    ahead, right, apparent = instance
    distance = math.hypot(ahead, right)
    reach = min(max(apparent * max(distance, 0.25) / 0.12, 1.5), 5.0)
    values = (255 * (1 - 0.5 * distance / reach), 51 * ahead, 128 + 25.4 * right, min(127.5 * apparent, 255))
    return all(abs(int(byte) - value) <= 0.5 + 1e-6 for byte, value in zip(entry, values, strict=True))


def same_distance(metres, expected):
    """Whether a distance in metres is the twin's, which is less a metre."""
    distance = max(float(metres) - 1.0, 0.0)
    return distance == expected or abs(distance - expected) < 1e-6


def row_differences(row, twin, task):
    """What of an observation row differs from the twin, by name."""
    entries, view = np.split(row, [4 * len(task.categories)])
    if (view[:31, None] >> [0, 2, 4, 6] & 3).ravel()[:121].tolist() != twin.view():
        yield "view"
    for entry, instances in zip(entries.reshape(-1, 4), twin.detections(), strict=True):
        if bool(entry[0]) != bool(instances):
            yield "presence"
        elif instances and not any(agrees(entry, instance) for instance in instances):
            yield "bytes"
        elif not instances and entry.any():
            yield "bytes of nothing"


def roll_out(env, params, seed):
    """Random steps, with Done likelier where it succeeds or time is up; leaves [NUM_STEPS, NUM_ENVS, ...]."""

    def act(key, state):
        steer, choose, step = jax.random.split(key, 3)
        last = state.time + 1 == params.step_limit[state.scene]
        done = jax.random.bernoulli(steer, jnp.where(env.succeeds(state, params) | last, 0.2, 0.01))
        action = jnp.where(done, DONE, jax.random.randint(choose, (), 0, DONE))
        _, after, reward, terminated, truncated, info = env.step(step, state, action, params)
        return after, (state, action, reward, terminated, truncated, info)

    def one_step(state, key):
        return jax.vmap(act)(jax.random.split(key, NUM_ENVS), state)

    @jax.jit
    def run(key):
        first, rest = jax.random.split(key)
        _, state = jax.vmap(env.reset, (0, None))(jax.random.split(first, NUM_ENVS), params)
        return jax.lax.scan(one_step, state, jax.random.split(rest, NUM_STEPS))[1]

    return jax.device_get(run(jax.random.key(seed)))


@pytest.mark.parametrize(
    ("source", "world"), [("rooms", "rooms"), ("ithor", "rooms"), ("rooms", "apartments"), ("rooms", "houses")]
)
def test_random_steps(source, world):
    task, scenes = TASKS[world], scenes_of(source)
    bank, guides = compile_bank(scenes, task), guides_of(source, task)
    assert bank.names == tuple(scene.name for scene in scenes)
    assert [len(guide.cells) for guide in guides] == bank.num_cells.tolist()
    # Padded: there are unused cells, and the first scenes again.
    env, params = build(bank, {"living_room": LIVING_ROOM}, OTHERS, len(bank.ahead) + 7, len(scenes) + 2)
    assert params.room.tolist() == [0, 1, 2, 3, 0, 1]
    before, action, reward, terminated, truncated, info = roll_out(env, params, seed=len(source))
    after, rows = info["final_state"], info["final_observation"].row

    differences, endings, drawn = collections.Counter(), collections.Counter(), set()
    for env, time in itertools.product(range(NUM_ENVS), range(NUM_STEPS)):
        at = time, env
        drawn.add(int(before.scene[at]))
        scene, goal = int(before.scene[at]) % len(scenes), int(before.goal[at])
        first_pose = int(bank.first_cell[scene]) * task.rules.poses_per_cell
        guide, limit = guides[scene], LIVING_ROOM if scenes[scene].room_type == "living_room" else OTHERS
        if before.time[at] == 0:  # after an ending, the twin refuses to go on
            twin = guide.place(int(before.pose[at]) - first_pose, goal, limit)
            differences["start"] += twin.horizon or goal not in bank.goals[scene, : bank.num_goals[scene]]
        twin = guide.twin
        expected = twin.step(int(action[at]))
        nearest = bank.goal_distance[after.pose[at] // task.rules.poses_per_cell, goal]
        differences.update(row_differences(rows[at], twin, task))
        differences.update(
            {
                "reward": reward[at] != np.float32(expected[0]),
                "terminated": terminated[at] != expected[1],
                "truncated": truncated[at] != expected[2],
                "pose": after.pose[at] - first_pose != guide.pose(),
                "length": info["length"][at] != twin.steps,
                "success": info["success"][at] != (expected[0] > 0),
                "goal distance": not same_distance(nearest, twin.goal_distance()),
            }
        )
        endings[(*expected, twin.steps == limit)] += 1
    assert +differences == collections.Counter()
    assert drawn == set(range(len(scenes) + 2))
    # Every kind of step was taken, before the limit and at it (a success at the limit is rare).
    late, early = ({ending[:3] for ending in endings if ending[3] == last} for last in (True, False))
    assert early == {(-0.01, False, False), (-0.01, True, False), (5.0, True, False)}
    assert late >= {(-0.01, False, True), (-0.01, True, False)}


def test_standable_cells():
    draws = np.random.default_rng(0)
    for _ in range(300):  # so few cells that the largest part often is not the only one
        reach = draws.random((4, 6)) < 0.3
        expected = largest_component({(iz, ix) for iz, ix in np.argwhere(reach).tolist()})
        assert {(iz, ix) for iz, ix in standable_cells(reach).tolist()} == expected


def differences_of(scene, guide, task, every=1):
    """What of the poses of a scene (every so many of them) differs from the twin, by name."""
    table, differences = compile_scene(scene, task), collections.Counter()
    successor = successors(table.ahead, task.rules)
    assert len(successor) == len(table.rows) == len(guide.cells) * task.rules.poses_per_cell
    for pose in range(0, len(successor), every):
        differences.update(row_differences(table.rows[pose], guide.place(pose), task))
        goals = set(np.flatnonzero(task.is_goal()).tolist())
        differences["success"] += (
            set(np.flatnonzero(table.best_length[pose] == 1).tolist()) != goals & guide.place(pose).found()
        )
        for action in range(DONE + 1):
            guide.place(pose).step(action)
            differences["successor"] += successor[pose, action] != guide.pose()
    for cell, goal in itertools.product(range(len(guide.cells)), np.flatnonzero(task.is_goal()).tolist()):
        expected = guide.place(cell * task.rules.poses_per_cell, goal).goal_distance()
        differences["goal distance"] += not same_distance(table.goal_distance[cell, goal], expected)
    return +differences


@pytest.mark.parametrize("world", TASKS)
@pytest.mark.parametrize(("source", "every"), [("coarse", 1), ("maze", 2), ("rooms", 3), ("ithor", 3)])
def test_every_pose(source, every, world):
    task = TASKS[world]
    for scene, guide in list(zip(scenes_of(source), guides_of(source, task), strict=True))[::every]:
        assert differences_of(scene, guide, task) == collections.Counter()


@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_generated_homes(world):
    task, scene = dataclasses.replace(WORLDS[world].task, detector=PERFECT), generated(world, "val")[0]
    assert differences_of(scene, Guide(scene, task), task, every=13) == collections.Counter()


@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_real_apartments(world):
    if not APARTMENT_FILE.exists():
        pytest.skip("the real apartments are not here")
    task, scene = dataclasses.replace(WORLDS[world].task, detector=PERFECT), read_scenes(APARTMENT_FILE)[0]
    assert differences_of(scene, Guide(scene, task), task, every=7) == collections.Counter()


@pytest.mark.parametrize("world", TASKS)
@pytest.mark.parametrize(("source", "every"), [("coarse", 3), ("maze", 2), ("rooms", 3), ("ithor", 3)])
def test_best_lengths(source, every, world):
    task, starts, differences, lengths = TASKS[world], np.random.default_rng(0), 0, set()
    for scene, guide in list(zip(scenes_of(source), guides_of(source, task), strict=True))[::every]:
        best_length = compile_scene(scene, task).best_length
        assert not best_length[:, ~task.is_goal()].any()
        for pose in starts.choice(len(best_length), 4, replace=False).tolist():
            for goal in np.flatnonzero(task.is_goal()).tolist():
                length = guide.place(pose, goal).best_length() or 0
                differences += length != best_length[pose, goal]
                lengths.add(length)
    assert differences == 0
    assert {0, 1} < lengths
    assert max(lengths) > 10
