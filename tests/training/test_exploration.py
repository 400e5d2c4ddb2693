"""The counts that the layout prior is made of, against a plain count over the poses that were walked through."""

import itertools

import jax
import numpy as np
from support import tiny_world as tiny

from jaxnav.env.objectnav import NUM_PRIORS, ObjectNav
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.task import DONE
from jaxnav.training.calibration import explore

ENV, PARAMS = tiny.world()
PRESENCE = np.asarray(ENV.row_format.presence(tiny.BANK.rows))
KITCHEN, BEDROOM = (ROOM_TYPES.index(name) for name in tiny.BANK.room_types)
KITCHEN_POSES, BEDROOM_POSES = (int(n) * tiny.POSES_PER_CELL for n in tiny.BANK.num_cells)
run = jax.jit(explore, static_argnums=(0, 3, 4))


def count(poses):
    """One for every pose at which two categories (or one with itself) are detected together."""
    counts = np.zeros((NUM_PRIORS, 3, 3))
    for pose in poses:
        room = KITCHEN if pose < KITCHEN_POSES else BEDROOM
        for i, j in itertools.product(np.flatnonzero(PRESENCE[pose]), repeat=2):
            counts[room, i, j] += 1
    return counts


def test_walks_that_see_everything_count_every_pose_once():
    result = run(ENV, PARAMS, jax.random.key(0), 128, 200)
    assert result.poses == len(PRESENCE)  # on average 70 visits of every pose
    assert result.steps == 128 * 200
    np.testing.assert_array_equal(result.counts, count(range(len(PRESENCE))))
    assert result.counts.max() > 10


def test_short_walks_count_what_they_pass():
    # The draws of the module, then the walks in NumPy.
    key, walks, steps = jax.random.key(0), 5, 4
    keys = jax.random.split(jax.random.fold_in(key, 0), walks)
    pose = np.asarray(jax.vmap(ENV.reset, (0, None))(keys, PARAMS)[1].pose)
    passed = set(pose.tolist())
    for actions in np.asarray(jax.random.randint(jax.random.fold_in(key, 1), (steps, walks), 0, DONE)):
        pose = tiny.BANK.successor[pose, actions]
        passed |= set(pose.tolist())
    result = run(ENV, PARAMS, key, walks, steps)
    assert walks < result.poses == len(passed) <= walks * (steps + 1)
    np.testing.assert_array_equal(result.counts, count(passed))


def test_rooms_without_scenes_have_no_counts():
    counts = np.asarray(run(ENV, PARAMS, jax.random.key(0), 128, 200).counts)
    assert counts.shape == (NUM_PRIORS, 3, 3)
    assert not counts[sorted(set(range(NUM_PRIORS)) - {KITCHEN, BEDROOM})].any()


def test_done_is_never_chosen():
    """Episodes start in the kitchen, and Done, nothing else, leads from everywhere to the bedroom."""
    only = {name: getattr(PARAMS.tables, name)[:1] for name in ("first_cell", "num_cells", "goals", "num_goals")}

    class Leaving(ObjectNav):
        def next_pose(self, pose, action, params):
            return jax.numpy.where(action == DONE, KITCHEN_POSES, super().next_pose(pose, action, params))

    params = PARAMS.replace(tables=PARAMS.tables.replace(**only), room=PARAMS.room[:1])
    assert run(Leaving(ENV.task), params, jax.random.key(0), 128, 200).poses == KITCHEN_POSES
