"""What a search with a map has to know of a home and its agent before training."""

from collections.abc import Iterable

import numpy as np

from jaxnav.errors import InputError
from jaxnav.policies.methods.base import Knowledge
from jaxnav.policies.methods.trail import learn_motion
from jaxnav.policies.semantic_map import MAX_CATEGORIES
from jaxnav.policies.wavefront import WORD
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NEIGHBOURS

SLACK = 0.05  # metres by which the goal must be nearer than required, since offsets are rounded


def learn_home(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return how the task's agent moves and succeeds, and the map it needs.

    Args:
      banks: of training scenes; the first one's task is that of all.
      counts: of exploration, unused.

    Returns:
      What `learn_motion` returns, and by name `enough`, float32 [], metres at which Done succeeds; `edge`, float32 [],
      the share of a goal's size by which it is reached earlier; `lines`, int32 [N], those of a map of the largest home.

    Raises:
      InputError: the map has no bit for a category, or the agent cannot walk to all eight neighbours.
    """
    banks = list(banks)
    task, size = banks[0].task, max(WORD, *(max(map_sizes(bank).values()) for bank in banks))
    if len(task.categories) > MAX_CATEGORIES:
        many = f"the task has {len(task.categories)} categories, and a map holds {MAX_CATEGORIES}"
        raise InputError(f"method semexp: {many}; leave some out")
    rules = task.rules
    if len(np.unique(rules.steps(), axis=0)) < len(NEIGHBOURS):
        few = f"the task has {rules.headings} headings, and its ways lead to eight neighbours"
        raise InputError(f"method semexp: {few}; give 8 or 12")
    learned = {
        "enough": np.array(rules.success_distance - SLACK, np.float32),
        "edge": np.array(0.25 if rules.success == "near" else 0.0, np.float32),
        "lines": np.arange(-(-size // WORD) * WORD, dtype=np.int32),
    }
    return learn_motion(banks, counts) | learned


def check_home(knowledge: Knowledge, bank: Bank) -> None:
    """Check that the map of a policy holds every scene of a bank.

    Raises:
      InputError: it does not.
    """
    size = len(knowledge.method["lines"])
    for name, needed in map_sizes(bank).items():
        if needed > size:
            short = f"scene {name} needs a map of {needed} cells, and that of the training homes has {size}"
            raise InputError(f"method semexp: {short}; train in homes as large")


def map_sizes(bank: Bank) -> dict[str, int]:
    """Return the lines that a map of each scene needs, with a view beyond."""
    places, view = cell_places(bank.ahead, bank.task.rules.steps()), RowFormat(0).view
    cells = zip(bank.first_cell, bank.first_cell + bank.num_cells, strict=True)
    extents = (int(np.ptp(places[first:end], axis=0).max()) + 1 + view for first, end in cells)
    return dict(zip(bank.names, extents, strict=True))


def cell_places(ahead: np.ndarray, strides: np.ndarray) -> np.ndarray:
    """Return where cells lie, int [C, 2], (z, x) from their scene's first.

    Args:
      ahead: int [C, H], cell after MoveAhead.
      strides: int [H, 2], the displacement of a step ahead by heading.
    """
    places, known = np.zeros((len(ahead), 2), int), np.zeros(len(ahead), bool)
    for cell in range(len(ahead)):
        if known[cell]:
            continue
        known[cell], front = True, [cell]
        while len(front):
            cells, headings = np.repeat(front, len(strides)), np.tile(np.arange(len(strides)), len(front))
            after = ahead[cells, headings]
            new = ~known[after]
            places[after[new]] = places[cells[new]] + strides[headings[new]]
            known[after] = True
            front = np.unique(after[new])
    return places
