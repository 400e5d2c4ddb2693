"""The counts behind the layout prior equal a plain count over the poses that random walks visit."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from support import tiny_world as tiny

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import NUM_PRIORS, ObjectNav
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import explore

ENV, PARAMS = tiny.world()
PRESENCE = np.asarray(ENV.row_format.presence(tiny.BANK.rows))
KITCHEN, BEDROOM = (ROOM_TYPES.index(name) for name in tiny.BANK.room_types)
KITCHEN_POSES, BEDROOM_POSES = (int(num_cells) * tiny.POSES_PER_CELL for num_cells in tiny.BANK.num_cells)
run_walks = jax.jit(explore, static_argnums=(0, 3, 4))


def count_pairs(poses):
    """For each two categories, the number of poses that show them together; the diagonal counts single categories."""
    counts = np.zeros((NUM_PRIORS, 3, 3))
    for pose in poses:
        room = KITCHEN if pose < KITCHEN_POSES else BEDROOM
        for i, j in itertools.product(np.flatnonzero(PRESENCE[pose]), repeat=2):
            counts[room, i, j] += 1
    return counts


@pytest.mark.slow
def test_walks_that_see_everything_count_every_pose_once():
    result = run_walks(ENV, PARAMS, jax.random.key(0), 128, 200)
    assert result.poses == len(PRESENCE)  # on average 70 visits of every pose
    assert result.steps == 128 * 200
    np.testing.assert_array_equal(result.counts, count_pairs(range(len(PRESENCE))))
    assert result.counts.max() > 10


@pytest.mark.slow
def test_short_walks_count_the_poses_that_they_visit():
    key = jax.random.key(0)
    num_walks = 5
    num_steps = 4

    # The draws of `explore`, then the walks in NumPy.
    keys = jax.random.split(jax.random.fold_in(key, 0), num_walks)
    pose = np.asarray(jax.vmap(ENV.reset, (0, None))(keys, PARAMS)[1].pose)
    visited_poses = set(pose.tolist())
    for actions in np.asarray(jax.random.randint(jax.random.fold_in(key, 1), (num_steps, num_walks), 0, DONE)):
        pose = tiny.BANK.successor[pose, actions]
        visited_poses |= set(pose.tolist())

    result = run_walks(ENV, PARAMS, key, num_walks, num_steps)
    assert num_walks < result.poses == len(visited_poses) <= num_walks * (num_steps + 1)
    np.testing.assert_array_equal(result.counts, count_pairs(visited_poses))


def test_prior_counts_of_estimators_with_a_gate_and_presence_are_those_of_poses():
    for name in ("calibrated", "released"):
        result = jax.jit(explore, static_argnums=(0, 3, 4, 5))(ENV, PARAMS, jax.random.key(0), 5, 4, name)
        np.testing.assert_array_equal(result.prior_counts, result.counts)


@pytest.mark.slow
def test_the_paper_counts_every_view_and_every_instance():
    """With the estimator "paper", each view adds its counts n_j to the rows of the categories that it shows."""
    # The rooms of the tiny world, with the number of instances in each row.
    task = dataclasses.replace(tiny.BANK.task, instance_counts=True)
    bank = compile_bank([tiny.KITCHEN, tiny.BEDROOM], task)
    env, params = build_environment(bank, {}, 10)
    key = jax.random.key(0)
    num_walks = 7
    num_steps = 30
    result = jax.jit(explore, static_argnums=(0, 3, 4, 5))(env, params, key, num_walks, num_steps, "paper")

    # The same walks in NumPy, view by view.
    keys = jax.random.split(jax.random.fold_in(key, 0), num_walks)
    pose = np.asarray(jax.vmap(env.reset, (0, None))(keys, params)[1].pose)
    view_poses = [*pose]
    for actions in np.asarray(jax.random.randint(jax.random.fold_in(key, 1), (num_steps, num_walks), 0, DONE)):
        pose = bank.successor[pose, actions]
        view_poses += [*pose]

    # The plain count. A row holds the numbers of instances after 4 bytes for each category and 31 bytes of the view.
    expected = np.zeros((NUM_PRIORS, 3, 3))
    counts = bank.rows[:, 4 * 3 + 31 : 4 * 3 + 31 + 3]
    for view_pose in view_poses:
        room = KITCHEN if view_pose < KITCHEN_POSES else BEDROOM
        for i in np.flatnonzero(counts[view_pose]):
            expected[room, i] += counts[view_pose]
    assert len(view_poses) == num_walks * (num_steps + 1) > len(set(view_poses))
    np.testing.assert_array_equal(result.prior_counts, expected)

    # The kitchen has two books, so instances exceed presence. The counts of poses are those of the default estimator.
    assert counts.max() == 2
    plain_result = run_walks(ENV, PARAMS, key, num_walks, num_steps)
    np.testing.assert_array_equal(result.counts, plain_result.counts)
    assert result.poses == plain_result.poses


def test_rooms_without_scenes_have_no_counts():
    counts = np.asarray(run_walks(ENV, PARAMS, jax.random.key(0), 128, 200).counts)
    assert counts.shape == (NUM_PRIORS, 3, 3)
    rooms_without_scenes = sorted(set(range(NUM_PRIORS)) - {KITCHEN, BEDROOM})
    assert not counts[rooms_without_scenes].any()


@pytest.mark.slow
def test_walks_never_choose_done():
    """Episodes start in the kitchen, and only Done leads from every pose to the bedroom."""
    kitchen_tables = {}
    for name in ("first_cell", "num_cells", "goals", "num_goals"):
        kitchen_tables[name] = getattr(PARAMS.tables, name)[:1]
    params = PARAMS.replace(tables=PARAMS.tables.replace(**kitchen_tables), room=PARAMS.room[:1])

    class DoneLeadsToBedroom(ObjectNav):
        def next_pose(self, pose, action, params):
            return jax.numpy.where(action == DONE, KITCHEN_POSES, super().next_pose(pose, action, params))

    result = run_walks(DoneLeadsToBedroom(ENV.task), params, jax.random.key(0), 128, 200)
    assert result.poses == KITCHEN_POSES
