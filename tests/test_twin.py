"""The compiled environment against the plain-Python twin: the same episodes in both, and not one difference.

The byte row is taken apart here by the words of docs/environment.md, without `RowLayout`.
"""

import collections
import functools
import itertools
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from twin import DONE, Twin, largest_component

from jaxnav.env.make import build_evaluation, build_training
from jaxnav.scenes.categories import ITHOR_CATEGORIES, ROOM_TYPES
from jaxnav.scenes.compile import compile_bank, compile_scene
from jaxnav.scenes.detector import PERFECT
from jaxnav.scenes.io import read_scenes
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.rooms import generate_rooms
from jaxnav.scenes.rows import RowLayout
from jaxnav.scenes.scene import Scene

REAL_FILE = Path(__file__).parents[2] / "shared" / "scenes" / "ithor_train_val.jsonl.gz"
NUM_CATEGORIES = len(ITHOR_CATEGORIES)
NUM_ENVS, NUM_STEPS = 20, 250  # 5,000 steps of each split


@functools.cache
def scenes_of(source, split):
    """Two scenes of each room type, or ten coarse ones."""
    if source == "coarse":
        return [coarse_scene(seed) for seed in range(10)]
    if source == "rooms":
        return [scene for scene in generate_rooms(8, 8, 0) if scene.split == split]
    if not REAL_FILE.exists():
        pytest.skip("the real rooms are not here")
    scenes = [scene for scene in read_scenes(REAL_FILE) if scene.split == split]
    return [scene for room in ROOM_TYPES for scene in [s for s in scenes if s.room_type == room][:2]]


def coarse_scene(seed):
    """Cells, walls and boxes at random, all on coarse steps, so that lengths often lie exactly on their limits."""
    draws = np.random.default_rng(seed)
    shape, count = (7, 8), 24
    boxes = np.concatenate(
        [
            draws.integers(-2, 18, (count, 3)) / 8,
            draws.choice([0.05, 0.09, 0.25, 0.3, 0.5], (count, 3)),
        ],
        axis=1,
    )
    tall = draws.random(count) < 0.4  # furniture on the floor, some of it just opaque
    boxes[tall, 4] = draws.choice([0.8, 0.85, 1.2, 1.8], tall.sum())
    boxes[tall, 1] = boxes[tall, 4] / 2 + draws.choice([0.0, 0.3, 0.35], tall.sum(), p=[0.8, 0.1, 0.1])
    return Scene(
        name=f"coarse-{seed}",
        world="drawn",
        room_type="kitchen",
        split="train",
        origin=(0.5, -0.25),
        reach=draws.random(shape) < 0.6,
        walls=draws.random(shape) < 0.1,  # some of them under standable cells
        types=tuple(draws.choice((*ITHOR_CATEGORIES[:12], "Stool", "Vase"), count).tolist()),
        boxes=boxes,
        yaws=np.zeros(count),
        parents=np.full(count, -1),
    )


def twin_of(scene):
    """The twin at some start, and its standable cells in row order."""
    rows, columns = scene.reach.shape
    for start in itertools.product(range(rows), range(columns)):
        try:
            twin = Twin(scene, ITHOR_CATEGORIES, 0, start, 0, 0, 1)
        except ValueError:  # not standable
            continue
        return twin, sorted(twin.standable())
    raise AssertionError("a scene without standable cells")


def place(twin, cells, pose, goal=0, step_limit=2):
    """Start an episode of the twin at a pose index within its scene."""
    twin.reset(goal, cells[pose // 16], pose // 2 % 8, pose % 2, step_limit)


def index_of(twin, cells):
    return (cells.index(twin.cell) * 8 + twin.heading) * 2 + twin.horizon


def agrees(entry, instance):
    """Whether the four bytes of a category are those of an instance, within half a quantum."""
    ahead, right, apparent = instance
    distance = math.hypot(ahead, right)
    reach = min(max(apparent * max(distance, 0.25) / 0.12, 1.5), 5.0)
    values = (255 * (1 - 0.5 * distance / reach), 51 * ahead, 128 + 25.4 * right, min(127.5 * apparent, 255))
    return all(abs(int(byte) - value) <= 0.5 + 1e-6 for byte, value in zip(entry, values, strict=True))


def row_differences(row, twin):
    """What of an observation row differs from the twin, by name."""
    entries = row[: 4 * NUM_CATEGORIES].reshape(NUM_CATEGORIES, 4)
    bits = np.unpackbits(row[4 * NUM_CATEGORIES :][:3], bitorder="little")[:NUM_CATEGORIES]
    if set(np.flatnonzero(bits).tolist()) != twin.found():
        yield "found"
    for entry, instances in zip(entries, twin.detections(), strict=True):
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
        done = jax.random.bernoulli(steer, jnp.where(env.found(state, params) | last, 0.2, 0.01))
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


@pytest.mark.parametrize("split", ["train", "val"])
@pytest.mark.parametrize("source", ["rooms", "ithor"])
def test_random_steps(source, split):
    scenes = scenes_of(source, split)
    bank = compile_bank(scenes, detector=PERFECT)
    assert bank.names == tuple(scene.name for scene in scenes)
    twins = [twin_of(scene) for scene in scenes]
    assert [len(cells) for _, cells in twins] == bank.num_cells.tolist()
    limits = [30 if split == "train" else 200 if scene.room_type == "living_room" else 100 for scene in scenes]
    before, action, reward, terminated, truncated, info = roll_out(
        *(build_training if split == "train" else build_evaluation)(bank), seed=len(source)
    )
    after, rows = info["final_state"], info["final_observation"].row

    differences, endings = collections.Counter(), collections.Counter()
    for env, time in itertools.product(range(NUM_ENVS), range(NUM_STEPS)):
        at = time, env
        scene, goal = int(before.scene[at]), int(before.goal[at])
        first_pose = int(bank.first_cell[scene]) * 16
        twin, cells = twins[scene]
        if before.time[at] == 0:  # after an ending, the twin refuses to go on
            place(twin, cells, int(before.pose[at]) - first_pose, goal, limits[scene])
            differences["start"] += twin.horizon or goal not in bank.goals[scene, : bank.num_goals[scene]]
        expected = twin.step(int(action[at]))
        nearest = float(bank.goal_distance[int(after.pose[at]) // 16, goal])
        differences.update(row_differences(rows[at], twin))
        differences.update(
            {
                "reward": reward[at] != np.float32(expected[0]),
                "terminated": terminated[at] != expected[1],
                "truncated": truncated[at] != expected[2],
                "pose": after.pose[at] - first_pose != index_of(twin, cells),
                "length": info["length"][at] != twin.steps,
                "success": info["success"][at] != (expected[0] > 0),
                "goal distance": abs(max(nearest - 1.0, 0.0) - twin.goal_distance()) > 1e-6,
            }
        )
        endings[(*expected, twin.steps == limits[scene])] += 1
    assert +differences == collections.Counter()
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


@pytest.mark.parametrize(("source", "every"), [("coarse", 1), ("rooms", 3), ("ithor", 3)])
def test_every_pose(source, every):
    differences, poses = collections.Counter(), 0
    for scene in scenes_of(source, "val")[::every]:
        table = compile_scene(scene, ITHOR_CATEGORIES, PERFECT, RowLayout(NUM_CATEGORIES))
        twin, cells = twin_of(scene)
        assert [tuple(cell) for cell in table.cells.tolist()] == cells
        index = {cell: i for i, cell in enumerate(cells)}
        for pose, (row, after) in enumerate(zip(table.rows, table.successor.tolist(), strict=True)):
            place(twin, cells, pose)
            differences.update(row_differences(row, twin))
            for action in range(DONE + 1):
                place(twin, cells, pose)
                twin.step(action)
                differences["successor"] += after[action] != (index[twin.cell] * 8 + twin.heading) * 2 + twin.horizon
            poses += 1
    assert +differences == collections.Counter()
    assert poses > 3000


@pytest.mark.parametrize(("source", "every"), [("coarse", 3), ("rooms", 3), ("ithor", 3)])
def test_best_lengths(source, every):
    starts, differences, lengths = np.random.default_rng(0), 0, set()
    for scene in scenes_of(source, "val")[::every]:
        table = compile_scene(scene, ITHOR_CATEGORIES, PERFECT, RowLayout(NUM_CATEGORIES))
        twin, cells = twin_of(scene)
        for pose in starts.choice(len(table.rows), 4, replace=False).tolist():
            for goal in range(NUM_CATEGORIES):
                place(twin, cells, pose, goal)
                length = twin.best_length() or 0
                differences += length != table.best_length[pose, goal]
                lengths.add(length)
    assert differences == 0
    assert {0, 1} < lengths
    assert max(lengths) > 10
