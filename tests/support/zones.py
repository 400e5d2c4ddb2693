"""Corridors whose zones can be counted by hand."""

import functools

import numpy as np

from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.policies.methods.zones import (
    learn_zones,
)
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE

K, TASK, ROOMS = len(CATEGORIES), Task(CATEGORIES), [prior_index(room) for room in ("kitchen", "bedroom")]
EAST, WEST, PER_CELL = 2, 6, TASK.rules.poses_per_cell
KITCHEN, BEDROOM = ROOMS
NOTHING = np.zeros((NUM_PRIORS, K, K))
EVERY = np.ones(K, bool)


def corridor(*shown, room_type="kitchen"):
    """Three cells to the east for every category shown, which is detected at all of their poses and alone."""
    cells = np.arange(3 * len(shown))
    ahead = np.repeat(cells[:, None], TASK.rules.headings, axis=1).astype(np.int32)
    ahead[:, EAST], ahead[:, WEST] = np.minimum(cells + 1, cells[-1]), np.maximum(cells - 1, 0)
    detections = np.zeros((len(cells) * PER_CELL, K, 4), np.uint8)
    detections[np.arange(len(detections)), np.repeat(shown, 3 * PER_CELL), 0] = 255
    row_format = RowFormat(K)
    rows = row_format.pack(detections, np.zeros((len(detections), row_format.view, row_format.view), np.uint8))
    distance, length = np.ones((len(cells), K), np.float32), np.ones((len(rows), K), np.uint16)
    one = np.array([0], np.int32), np.array([len(cells)], np.int32)
    goals = np.arange(K, dtype=np.int32)[None], np.array([K], np.int32)
    return Bank(TASK, ("corridor",), (room_type,), ahead, rows, length, distance, *one, *goals, ())


PATH = corridor(BOOK, CHAIR, FRIDGE)


@functools.cache
def learned(*banks_of, zones=3):
    """Zones of corridors, each told by its categories and its room type."""
    banks = [corridor(*shown, room_type=room) for shown, room in banks_of]
    return learn_zones(banks, NOTHING, zones)


KITCHENS = (((BOOK, CHAIR, FRIDGE), "kitchen"),)


def holding(zones, category, room=KITCHEN):
    """The zone at which a category is always detected."""
    (zone,) = np.flatnonzero(zones["nodes"][room, :, category] == 1.0)
    return int(zone)
