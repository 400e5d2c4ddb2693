"""The compiled environment against the plain-Python twin: not one difference."""

import collections
import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.real_scenes import ITHOR, ROBOTHOR, require
from support.scenes import APARTMENTS, HOUSES, ROOMS, coarse_scene, maze_scene
from support.twin import DONE
from support.twin_guide import Guide, row_differences, same_distance
from support.twin_scene import largest_component

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import EnvParams, ObjectNav, State
from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.files.scene_file import read_scenes
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.lattice import pose_successors, standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import Bank, compile_bank, compile_scene
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

NUM_ENVS, FEW, MANY = 20, 150, 5000  # 3,000 steps of a source and task, or 100,000
LIVING_ROOM, OTHERS = 60, 30  # step limits
SLOW = pytest.mark.slow
TASKS = {
    "rooms": Task(rules=ROOMS, detector=PERFECT_DETECTOR),
    "apartments": Task(rules=APARTMENTS, goals=ITHOR_CATEGORIES[::2], detector=PERFECT_DETECTOR),
    "houses": Task(rules=HOUSES, goals=ITHOR_CATEGORIES[1::2], detector=PERFECT_DETECTOR),
}


@functools.cache
def scenes_of(source: str) -> list[Scene]:
    """Return a scene of each room type, or six drawn."""
    if source == "coarse":
        return [coarse_scene(seed) for seed in range(6)]
    if source == "maze":
        return [maze_scene(seed) for seed in range(6)]
    if source == "rooms":
        return [generate_room("train", i, 0) for i in range(4)]
    scenes = [scene for scene in read_scenes(require(ITHOR)) if scene.split == "val"]
    return [next(scene for scene in scenes if scene.room_type == room) for room in ROOM_TYPES]


@functools.cache
def guides_of(source: str, task: Task) -> list[Guide]:
    return [Guide(scene, task) for scene in scenes_of(source)]


class Rollout(NamedTuple):
    """Hold steps of several environments; leaves [steps, NUM_ENVS, ...]."""

    before: State
    action: Any
    reward: Any
    terminated: Any
    truncated: Any
    info: dict[str, Any]

    def at(self, time: int, env: int) -> "Rollout":
        """Return one step."""
        return jax.tree.map(lambda leaf: leaf[time, env], self)


def roll_out(env: ObjectNav, params: EnvParams, seed: int, steps: int) -> Rollout:
    """Take random steps.

    Done is likelier where it succeeds or time is up.
    """

    def act(key, state):
        steer, choose, step = jax.random.split(key, 3)
        last = state.time + 1 == params.step_limit[state.scene]
        done = jax.random.bernoulli(steer, jnp.where(env.done_succeeds(state, params) | last, 0.2, 0.01))
        action = jnp.where(done, DONE, jax.random.randint(choose, (), 0, DONE))
        _, after, reward, terminated, truncated, info = env.step(step, state, action, params)
        return after, Rollout(state, action, reward, terminated, truncated, info)

    def one_step(state, key):
        return jax.vmap(act)(jax.random.split(key, NUM_ENVS), state)

    @jax.jit
    def run(key):
        first, rest = jax.random.split(key)
        _, state = jax.vmap(env.reset, (0, None))(jax.random.split(first, NUM_ENVS), params)
        return jax.lax.scan(one_step, state, jax.random.split(rest, steps))[1]

    return jax.device_get(run(jax.random.key(seed)))


def step_differences(
    step: Rollout, guide: Guide, expected: tuple[float, bool, bool], first_pose: int, bank: Bank
) -> Iterator[str]:
    """Yield names of what differs between step and twin."""
    twin, after = guide.twin, step.info["final_state"]
    cell = after.pose // bank.task.rules.poses_per_cell
    yield from row_differences(step.info["final_observation"].row, twin, len(bank.task.categories))
    checks = {
        "reward": step.reward == np.float32(expected[0]),
        "terminated": step.terminated == expected[1],
        "truncated": step.truncated == expected[2],
        "pose": after.pose - first_pose == guide.pose(),
        "length": step.info["length"] == twin.steps,
        "success": step.info["success"] == (expected[0] > 0),
        "goal distance": same_distance(float(bank.goal_distance[cell, after.goal]), twin.goal_distance()),
    }
    yield from (name for name, same in checks.items() if not same)


@pytest.mark.parametrize(
    ("source", "world", "steps"),
    [
        ("rooms", "rooms", FEW),
        ("ithor", "rooms", FEW),
        *(pytest.param("rooms", world, MANY, marks=SLOW) for world in TASKS),
    ],
)
def test_random_steps(source, world, steps):
    task, scenes = TASKS[world], scenes_of(source)
    bank, guides = compile_bank(scenes, task), guides_of(source, task)
    assert bank.names == tuple(scene.name for scene in scenes)
    assert [len(guide.cells) for guide in guides] == bank.num_cells.tolist()
    # Padded: there are unused cells, and the first scenes again.
    env, params = build_environment(bank, {"living_room": LIVING_ROOM}, OTHERS, len(bank.ahead) + 7, len(scenes) + 2)
    assert params.room.tolist() == [0, 1, 2, 3, 0, 1]
    rollout = roll_out(env, params, len(source), steps)

    differences, endings, drawn = collections.Counter(), collections.Counter(), set()
    for i, time in itertools.product(range(NUM_ENVS), range(steps)):
        step = rollout.at(time, i)
        drawn.add(int(step.before.scene))
        scene, goal = int(step.before.scene) % len(scenes), int(step.before.goal)
        first_pose = int(bank.first_cell[scene]) * task.rules.poses_per_cell
        guide, limit = guides[scene], LIVING_ROOM if scenes[scene].room_type == "living_room" else OTHERS
        if step.before.time == 0:  # after an ending, the twin refuses to go on
            twin = guide.place(int(step.before.pose) - first_pose, goal, limit)
            differences["start"] += twin.horizon or goal not in bank.goals[scene, : bank.num_goals[scene]]
        expected = guide.twin.step(int(step.action))
        differences.update(step_differences(step, guide, expected, first_pose, bank))
        endings[(*expected, guide.twin.steps == limit)] += 1
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


def differences_of(scene: Scene, guide: Guide, task: Task, stride: int = 1) -> collections.Counter[str]:
    """Count what differs from the twin at poses, by name."""
    table, differences = compile_scene(scene, task), collections.Counter()
    successor = pose_successors(table.ahead, task.rules)
    assert len(successor) == len(table.rows) == len(guide.cells) * task.rules.poses_per_cell
    for pose in range(0, len(successor), stride):
        differences.update(row_differences(table.rows[pose], guide.place(pose), len(task.categories)))
        goals = set(np.flatnonzero(task.is_goal()).tolist())
        differences["success"] += (
            set(np.flatnonzero(table.best_length[pose] == 1).tolist()) != goals & guide.place(pose).successes()
        )
        for action in range(DONE + 1):
            guide.place(pose).step(action)
            differences["successor"] += successor[pose, action] != guide.pose()
    for cell, goal in itertools.product(range(len(guide.cells)), np.flatnonzero(task.is_goal()).tolist()):
        expected = guide.place(cell * task.rules.poses_per_cell, goal).goal_distance()
        differences["goal distance"] += not same_distance(table.goal_distance[cell, goal], expected)
    return +differences


@pytest.mark.parametrize("world", TASKS)
@pytest.mark.parametrize(
    ("source", "stride"),
    [("coarse", 1), pytest.param("maze", 2, marks=SLOW), ("rooms", 3), pytest.param("ithor", 3, marks=SLOW)],
)
def test_every_pose(source, stride, world):
    task = TASKS[world]
    for scene, guide in list(zip(scenes_of(source), guides_of(source, task), strict=True))[::stride]:
        assert differences_of(scene, guide, task) == collections.Counter()


@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_generated_homes(world):
    task, scene = (
        dataclasses.replace(WORLDS[world].task, detector=PERFECT_DETECTOR),
        make_generated_scenes(world, "val")[0],
    )
    assert differences_of(scene, Guide(scene, task), task, stride=13) == collections.Counter()


@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_real_apartments(world):
    task, scene = dataclasses.replace(WORLDS[world].task, detector=PERFECT_DETECTOR), read_scenes(require(ROBOTHOR))[0]
    assert differences_of(scene, Guide(scene, task), task, stride=7) == collections.Counter()


@pytest.mark.parametrize("world", TASKS)
@pytest.mark.parametrize(("source", "stride"), [("coarse", 3), ("maze", 2), ("rooms", 3), ("ithor", 3)])
def test_best_lengths(source, stride, world):
    task, starts, differences, lengths = TASKS[world], np.random.default_rng(0), 0, set()
    for scene, guide in list(zip(scenes_of(source), guides_of(source, task), strict=True))[::stride]:
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
