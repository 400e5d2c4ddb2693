"""Corridors whose zones can be counted by hand."""

import functools

import numpy as np

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.policies.methods.hoz import learn_zones
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE

NUM_CATEGORIES = len(CATEGORIES)
TASK = Task(CATEGORIES)
POSES_PER_CELL = TASK.rules.poses_per_cell
EAST, WEST = 2, 6  # headings
ROOMS = [prior_index(room) for room in ("kitchen", "bedroom")]
KITCHEN_PRIOR, BEDROOM_PRIOR = ROOMS
NO_COUNTS = np.zeros((NUM_PRIORS, NUM_CATEGORIES, NUM_CATEGORIES))


def corridor(*shown, room_type="kitchen"):
    """Three cells to the east for every category shown, which is detected at all of their poses and alone."""
    # Moves lead to the east and back.
    cells = np.arange(3 * len(shown))
    ahead = np.repeat(cells[:, None], TASK.rules.headings, axis=1).astype(np.int32)
    ahead[:, EAST] = np.minimum(cells + 1, cells[-1])
    ahead[:, WEST] = np.maximum(cells - 1, 0)

    # Rows hold one detection each, and a view in which nothing is known.
    num_poses = len(cells) * POSES_PER_CELL
    detections = np.zeros((num_poses, NUM_CATEGORIES, 4), np.uint8)
    detections[np.arange(num_poses), np.repeat(shown, 3 * POSES_PER_CELL), 0] = 255
    row_format = RowFormat(NUM_CATEGORIES)
    rows = row_format.pack(detections, np.zeros((num_poses, row_format.view, row_format.view), np.uint8))

    best_length = np.ones((num_poses, NUM_CATEGORIES), np.uint16)
    goal_distance = np.ones((len(cells), NUM_CATEGORIES), np.float32)
    first_cell = np.array([0], np.int32)
    num_cells = np.array([len(cells)], np.int32)
    goals = np.arange(NUM_CATEGORIES, dtype=np.int32)[None]
    num_goals = np.array([NUM_CATEGORIES], np.int32)
    return Bank(
        TASK,
        ("corridor",),
        (room_type,),
        ahead,
        rows,
        best_length,
        goal_distance,
        first_cell,
        num_cells,
        goals,
        num_goals,
        (),
    )


THREE_ZONE_CORRIDOR = corridor(BOOK, CHAIR, FRIDGE)


@functools.cache
def learn_corridor_zones(*corridors, zones=3):
    """Zones of corridors, each given by its categories and its room type."""
    banks = [corridor(*shown, room_type=room) for shown, room in corridors]
    return learn_zones(banks, NO_COUNTS, zones)


KITCHENS = (((BOOK, CHAIR, FRIDGE), "kitchen"),)


def indirect_share(zones, next_zone):
    """Share of the pairs of different zones with poses whose best path leads through another zone."""
    zone = np.arange(zones["nodes"].shape[-2])
    has_poses = zones["nodes"].max(axis=-1) >= 0
    pairs = has_poses[:, :, None] & has_poses[:, None, :] & (zone[:, None] != zone)
    return (pairs & (next_zone != zone)).sum() / pairs.sum()


def find_zone_of(zones, category, room=KITCHEN_PRIOR):
    """The zone at which a category is always detected."""
    (zone,) = np.flatnonzero(zones["nodes"][room, :, category] == 1.0)
    return int(zone)
