"""The compiled environment equals the plain-Python twin, without one difference."""

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
from twins.environment import DONE
from twins.guide import Guide, row_differences, same_distance
from twins.scene import largest_component

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

NUM_ENVS = 20
FEW_STEPS = 150  # of each environment: 3,000 steps of a source and task
MANY_STEPS = 5000  # 100,000 steps
LIVING_ROOM_LIMIT = 60
OTHER_LIMIT = 30
TASKS = {
    "rooms": Task(rules=ROOMS, detector=PERFECT_DETECTOR),
    "apartments": Task(rules=APARTMENTS, goals=ITHOR_CATEGORIES[::2], detector=PERFECT_DETECTOR, instance_counts=True),
    "houses": Task(rules=HOUSES, goals=ITHOR_CATEGORIES[1::2], detector=PERFECT_DETECTOR),
}


@functools.cache
def load_scenes(source: str) -> list[Scene]:
    """Return a scene of each room type, or six scenes drawn at random."""
    if source == "coarse":
        return [coarse_scene(seed) for seed in range(6)]
    if source == "maze":
        return [maze_scene(seed) for seed in range(6)]
    if source == "rooms":
        return [generate_room("train", index, 0) for index in range(4)]

    # The first validation scene of each room type of iTHOR.
    first_scenes: dict[str, Scene] = {}
    for scene in read_scenes(require(ITHOR)):
        if scene.split == "val":
            first_scenes.setdefault(scene.room_type, scene)
    return [first_scenes[room_type] for room_type in ROOM_TYPES]


@functools.cache
def make_guides(source: str, task: Task) -> list[Guide]:
    return [Guide(scene, task) for scene in load_scenes(source)]


def scenes_and_guides(source: str, task: Task, scene_stride: int) -> list[tuple[Scene, Guide]]:
    """Return every `scene_stride`-th scene of a source with its twin."""
    return list(zip(load_scenes(source), make_guides(source, task), strict=True))[::scene_stride]


def goals_of(task: Task) -> list[int]:
    return np.flatnonzero(task.is_goal()).tolist()


class Rollout(NamedTuple):
    """Steps of several environments; leaves [T, NUM_ENVS, ...]."""

    before: State
    action: Any
    reward: Any
    terminated: Any
    truncated: Any
    info: dict[str, Any]

    def select_step(self, time: int, env_index: int) -> "Rollout":
        """Return one step of one environment."""
        return jax.tree.map(lambda leaf: leaf[time, env_index], self)


def roll_out(env: ObjectNav, params: EnvParams, seed: int, num_steps: int) -> Rollout:
    """Take random steps; Done is likelier where it succeeds or time is up."""

    def act(key, state):
        done_key, action_key, step_key = jax.random.split(key, 3)
        is_last_step = state.time + 1 == params.step_limit[state.scene]
        done_probability = jnp.where(env.done_succeeds(state, params) | is_last_step, 0.2, 0.01)
        is_done = jax.random.bernoulli(done_key, done_probability)
        action = jnp.where(is_done, DONE, jax.random.randint(action_key, (), 0, DONE))
        _, next_state, reward, terminated, truncated, info = env.step(step_key, state, action, params)
        return next_state, Rollout(state, action, reward, terminated, truncated, info)

    def act_everywhere(states, key):
        return jax.vmap(act)(jax.random.split(key, NUM_ENVS), states)

    @jax.jit
    def run(key):
        reset_key, steps_key = jax.random.split(key)
        _, states = jax.vmap(env.reset, (0, None))(jax.random.split(reset_key, NUM_ENVS), params)
        _, rollout = jax.lax.scan(act_everywhere, states, jax.random.split(steps_key, num_steps))
        return rollout

    return jax.device_get(run(jax.random.key(seed)))


def step_differences(
    step: Rollout, guide: Guide, expected: tuple[float, bool, bool], first_pose: int, bank: Bank
) -> Iterator[str]:
    """Yield names of the values that differ between a step and the twin."""
    twin = guide.twin
    final_state = step.info["final_state"]
    cell = final_state.pose // bank.task.rules.poses_per_cell
    goal_distance = float(bank.goal_distance[cell, final_state.goal])
    expected_reward, expected_terminated, expected_truncated = expected

    yield from row_differences(step.info["final_observation"].row, twin, len(bank.task.categories))
    is_equal = {
        "reward": step.reward == np.float32(expected_reward),
        "terminated": step.terminated == expected_terminated,
        "truncated": step.truncated == expected_truncated,
        "pose": final_state.pose - first_pose == guide.pose(),
        "length": step.info["length"] == twin.steps,
        "success": step.info["success"] == (expected_reward > 0),
        "goal distance": same_distance(goal_distance, twin.goal_distance()),
    }
    for name, equal in is_equal.items():
        if not equal:
            yield name


@pytest.mark.parametrize(
    ("source", "world", "num_steps"),
    [
        ("rooms", "rooms", FEW_STEPS),
        ("ithor", "rooms", FEW_STEPS),
        *(pytest.param("rooms", world, MANY_STEPS, marks=pytest.mark.exhaustive) for world in TASKS),
    ],
)
def test_environment_equals_the_twin_at_random_steps(source, world, num_steps):
    # Tables and twins of the same scenes.
    task = TASKS[world]
    scenes = load_scenes(source)
    guides = make_guides(source, task)
    bank = compile_bank(scenes, task)
    assert bank.names == tuple(scene.name for scene in scenes)
    assert [len(guide.cells) for guide in guides] == bank.num_cells.tolist()

    # Padded: there are unused cells, and the first scenes again, in which no episode begins.
    step_limits = {"living_room": LIVING_ROOM_LIMIT}
    env, params = build_environment(bank, step_limits, OTHER_LIMIT, len(bank.ahead) + 7, len(scenes) + 2)
    assert params.room.tolist() == [0, 1, 2, 3, 0, 1]
    rollout = roll_out(env, params, len(source), num_steps)

    # Follow each environment with the twin.
    differences = collections.Counter()
    early_endings = set()
    late_endings = set()
    visited_scenes = set()
    for env_index, time in itertools.product(range(NUM_ENVS), range(num_steps)):
        step = rollout.select_step(time, env_index)
        scene_index = int(step.before.scene)
        visited_scenes.add(scene_index)
        goal = int(step.before.goal)
        guide = guides[scene_index]
        first_pose = int(bank.first_cell[scene_index]) * task.rules.poses_per_cell
        step_limit = LIVING_ROOM_LIMIT if scenes[scene_index].room_type == "living_room" else OTHER_LIMIT

        # After an ending the twin refuses to go on: a new episode must have begun, level and with a goal of the scene.
        if step.before.time == 0:
            twin = guide.place(int(step.before.pose) - first_pose, goal, step_limit)
            scene_goals = bank.goals[scene_index, : bank.num_goals[scene_index]]
            differences["start"] += twin.horizon or goal not in scene_goals

        expected = guide.twin.step(int(step.action))
        differences.update(step_differences(step, guide, expected, first_pose, bank))
        endings = late_endings if guide.twin.steps == step_limit else early_endings
        endings.add(expected)
    assert +differences == collections.Counter()
    assert visited_scenes == set(range(len(scenes)))

    # Every kind of step was taken, before the limit and at it (a success at the limit is rare).
    assert early_endings == {(-0.01, False, False), (-0.01, True, False), (5.0, True, False)}
    assert late_endings >= {(-0.01, False, True), (-0.01, True, False)}


def test_standable_cells_equal_the_largest_component_of_the_twin():
    rng = np.random.default_rng(0)
    for _ in range(300):  # so few cells that the largest part often is not the only one
        free_cells = rng.random((4, 6)) < 0.3
        expected_cells = largest_component({(iz, ix) for iz, ix in np.argwhere(free_cells).tolist()})
        assert {(iz, ix) for iz, ix in standable_cells(free_cells).tolist()} == expected_cells


def count_table_differences(scene: Scene, guide: Guide, task: Task, pose_stride: int = 1) -> collections.Counter[str]:
    """Count the differences of a scene's tables from the twin at every `pose_stride`-th pose, by name."""
    table = compile_scene(scene, task)
    successor = pose_successors(table.ahead, task.rules)
    assert len(successor) == len(table.rows) == len(guide.cells) * task.rules.poses_per_cell

    # Rows, success of Done, and the poses after each action.
    differences = collections.Counter()
    for pose in range(0, len(successor), pose_stride):
        row_twin = guide.place(pose)
        num_categories = len(task.categories)
        differences.update(row_differences(table.rows[pose], row_twin, num_categories, task.instance_counts))
        done_goals = set(np.flatnonzero(table.best_length[pose] == 1).tolist())
        differences["success"] += done_goals != set(goals_of(task)) & guide.place(pose).successes()
        for action in range(DONE + 1):
            guide.place(pose).step(action)
            differences["successor"] += successor[pose, action] != guide.pose()

    # Distances to the goals.
    for cell, goal in itertools.product(range(len(guide.cells)), goals_of(task)):
        expected_distance = guide.place(cell * task.rules.poses_per_cell, goal).goal_distance()
        differences["goal distance"] += not same_distance(table.goal_distance[cell, goal], expected_distance)
    return +differences


@pytest.mark.slow
@pytest.mark.parametrize("world", TASKS)
@pytest.mark.parametrize(("source", "scene_stride"), [("coarse", 1), ("maze", 2), ("rooms", 3), ("ithor", 3)])
def test_tables_equal_the_twin_at_every_pose(source, scene_stride, world):
    task = TASKS[world]
    for scene, guide in scenes_and_guides(source, task, scene_stride):
        assert count_table_differences(scene, guide, task) == collections.Counter()


@pytest.mark.slow
@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_tables_of_a_generated_home_equal_the_twin(world):
    task = dataclasses.replace(WORLDS[world].task, detector=PERFECT_DETECTOR)
    scene = make_generated_scenes(world, "val")[0]
    assert count_table_differences(scene, Guide(scene, task), task, pose_stride=13) == collections.Counter()


@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_tables_of_a_real_apartment_equal_the_twin(world):
    task = dataclasses.replace(WORLDS[world].task, detector=PERFECT_DETECTOR)
    scene = read_scenes(require(ROBOTHOR))[0]
    assert count_table_differences(scene, Guide(scene, task), task, pose_stride=7) == collections.Counter()


@pytest.mark.slow
@pytest.mark.parametrize("world", TASKS)
@pytest.mark.parametrize(("source", "scene_stride"), [("coarse", 3), ("maze", 2), ("rooms", 3), ("ithor", 3)])
def test_best_lengths_equal_the_search_of_the_twin(source, scene_stride, world):
    task = TASKS[world]
    rng = np.random.default_rng(0)
    num_differences = 0
    lengths = set()
    for scene, guide in scenes_and_guides(source, task, scene_stride):
        best_length = compile_scene(scene, task).best_length
        assert not best_length[:, ~task.is_goal()].any()
        for pose in rng.choice(len(best_length), 4, replace=False).tolist():
            for goal in goals_of(task):
                expected_length = guide.place(pose, goal).best_length() or 0
                num_differences += expected_length != best_length[pose, goal]
                lengths.add(expected_length)
    assert num_differences == 0
    assert {0, 1} < lengths
    assert max(lengths) > 10
