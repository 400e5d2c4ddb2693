"""SemExp: goal-oriented semantic exploration, a search with a map of the categories seen so far.

Source: D. S. Chaplot et al., *Object Goal Navigation using Goal-Oriented Semantic Exploration*, NeurIPS 2020, and its
released code; a host of L-sTDE in the paper (Table 3).

Kept: the agent maps free, blocked, visited and explored cells and the categories in them; the policy chooses a
long-term goal every 25 actions and is trained on these macro-steps; a planner without parameters walks to the long-term
goal, or to the goal category once the map shows it, and the map decides on Done. Changed: the long-term goal is one of
8 x 8 blocks around the agent, because equation 2 needs logits, and breadth-first search replaces fast marching.

`MappedCategories` is the network. The tracker is in `map_tracker`, the planner in `local_policy`; `learn_search_setup`
returns the parameters of the task for both, and `check_map_size` refuses scenes that do not fit on the map.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.errors import InputError
from jaxnav.numerics.product import Linear
from jaxnav.policies.features import Features
from jaxnav.policies.method import Experience, Knowledge, Method
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import (
    BLOCKS_PER_SIDE,
    EXPLORED_BIT,
    FREE_BIT,
    MAX_CATEGORIES,
    VISITED_BIT,
    WALL_BIT,
    MapReading,
    MapTracker,
    other_category_bits,
)
from jaxnav.policies.methods.tpn import learn_motion
from jaxnav.policies.spec import PolicySpec
from jaxnav.policies.wavefront import WORD_BITS
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NEIGHBOURS

#: Metres by which the goal must be nearer than required, because offsets are rounded.
DISTANCE_SLACK = 0.05

_SCENE_FLAGS = (EXPLORED_BIT, FREE_BIT, WALL_BIT, VISITED_BIT)


# Network


class MappedCategories(Experience):
    """Relations between the categories in each block of the map and the goal.

    Flags of floor and walls, and the compass, enter through the scene's direct pathway.
    """

    sizes: ClassVar[Mapping[str, int]] = {"block_outputs": 8}
    blocks: ClassVar[int] = BLOCKS_PER_SIDE**2
    num_scene_inputs: ClassVar[int] = len(_SCENE_FLAGS) * blocks + 2

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        block_outputs = self.size(spec, "block_outputs")
        self.relate = Linear(2 * spec.sizes.appearance, block_outputs, rngs=rngs)
        self.width = self.blocks * block_outputs

    @staticmethod
    def scene_inputs(reading: MapReading) -> jax.Array:
        """Return the flags of each block, and the compass."""
        block_flags = []
        for flag in _SCENE_FLAGS:
            block_flags.append((reading.blocks & flag > 0).astype(jnp.float32))
        return jnp.concatenate([*block_flags, reading.compass], axis=-1)

    def replace_other_categories(
        self, features: Features, reading: MapReading, other_features: Features, other_reading: MapReading
    ) -> tuple[Features, MapReading]:
        """Replace the categories in each block; floor, walls and the goal stay."""
        mixed_features, _ = super().replace_other_categories(features, reading, other_features, other_reading)

        replaced_bits = other_category_bits(features.goal)[..., None]
        blocks = (reading.blocks & ~replaced_bits) | (other_reading.blocks & replaced_bits)
        return mixed_features, reading._replace(blocks=blocks)

    def encode(self, features: Features, appearance: jax.Array, weights: jax.Array, reading: MapReading) -> jax.Array:
        """Return experience, each category weighted by the layout."""
        # Unpack the categories of each block, [..., M, K], and sum their weighted appearances, [..., M, d].
        num_categories = weights.shape[-1]
        shifts = np.arange(num_categories, dtype=np.uint32).reshape((1,) * reading.blocks.ndim + (-1,))
        category_bits = reading.blocks[..., None] >> shifts & np.uint32(1)
        block_appearance = (category_bits.astype(jnp.float32) * weights[..., None, :]) @ appearance

        # Join the goal to every block.
        goal_appearance = (features.goal @ appearance)[..., None, :]
        goal_appearance = jnp.broadcast_to(goal_appearance, block_appearance.shape)
        block_inputs = jnp.concatenate([block_appearance, goal_appearance], axis=-1)
        block_outputs = nnx.relu(self.relate(block_inputs))
        return block_outputs.reshape(*block_outputs.shape[:-2], self.width)


# Setup of the search before training


def learn_search_setup(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return the motion of the agent, the distance of success and the size of the map.

    Args:
      banks: banks of training scenes, which share one task.
      counts: co-occurrence counts of exploration, unused.

    Returns:
      The values of `learn_motion`, and by name `enough`, float32 [], metres within which Done succeeds; `edge`, float32
      [], the share of a goal's apparent size that is added to these metres; `lines`, int32 [N], of
      which only the length is read: the size of a map that holds the largest home, which must be static; and
      `front_cell_is_move`, bool [], present only if `Rules.front_cell` is `move`.

    Raises:
      InputError: the map has no bit for a category, or the agent cannot walk to all eight neighbours.
    """
    # Refuse tasks for which the map or the planner does not work.
    banks = list(banks)
    task = banks[0].task
    rules = task.rules
    if len(task.categories) > MAX_CATEGORIES:
        problem = f"the task has {len(task.categories)} categories, but a map holds at most {MAX_CATEGORIES}"
        raise InputError(f"search on a map: {problem}; give fewer categories")
    if len(np.unique(rules.move_steps(), axis=0)) < len(NEIGHBOURS):
        problem = f"the task has {rules.headings} headings, but paths lead to eight neighbours"
        raise InputError(f"search on a map: {problem}; give 8 or 12 headings")

    # The map holds the largest home; its size is rounded up to whole words.
    required_size = WORD_BITS
    for bank in banks:
        required_size = max(required_size, *required_map_sizes(bank).values())
    map_size = -(-required_size // WORD_BITS) * WORD_BITS

    # The success distance is measured to the goal's centre, or on foot to its edge.
    setup = {
        "enough": np.array(rules.success_distance - DISTANCE_SLACK, np.float32),
        "edge": np.array(0.25 if rules.success == "near" else 0.0, np.float32),
        "lines": np.arange(map_size, dtype=np.int32),
    }
    if rules.front_cell == "move":
        setup["front_cell_is_move"] = np.array(True)
    return learn_motion(banks, counts) | setup


def check_map_size(knowledge: Knowledge, bank: Bank) -> None:
    """Check that every scene of a bank fits on the map of a policy.

    Raises:
      InputError: a scene is too large.
    """
    map_size = len(knowledge.method["lines"])
    for scene_name, required_size in required_map_sizes(bank).items():
        if required_size > map_size:
            raise InputError(
                f"search on a map: scene {scene_name} needs a map of {required_size} x {required_size} cells, but the "
                f"map of the training homes has {map_size} x {map_size}; train in homes of that size"
            )


def required_map_sizes(bank: Bank) -> dict[str, int]:
    """Return the side in cells of the map that each scene needs, by name: the extent of the scene plus one view."""
    # Cells of a scene are consecutive.
    positions = cell_positions(bank.ahead, bank.task.rules.move_steps())
    view_size = RowFormat(0).view
    map_sizes: dict[str, int] = {}
    for scene_name, first_cell, num_cells in zip(bank.names, bank.first_cell, bank.num_cells, strict=True):
        scene_positions = positions[first_cell : first_cell + num_cells]
        extent = int(np.ptp(scene_positions, axis=0).max()) + 1
        map_sizes[scene_name] = extent + view_size
    return map_sizes


def cell_positions(ahead: np.ndarray, strides: np.ndarray) -> np.ndarray:
    """Return the positions of cells relative to the first cell of their scene.

    Args:
      ahead: int [C, H], cell after MoveAhead.
      strides: int [H, 2], the displacement (dz, dx) of a step ahead by heading.

    Returns:
      int [C, 2], (z, x).
    """
    num_headings = len(strides)
    positions = np.zeros((len(ahead), 2), int)
    is_reached = np.zeros(len(ahead), bool)

    # Breadth-first search from the first cell of every connected part.
    for first_cell in range(len(ahead)):
        if is_reached[first_cell]:
            continue

        # Step from the frontier in every heading; cells that are reached for the first time are the next frontier.
        is_reached[first_cell] = True
        frontier = np.array([first_cell])
        while len(frontier):
            cells = np.repeat(frontier, num_headings)
            headings = np.tile(np.arange(num_headings), len(frontier))
            next_cells = ahead[cells, headings]
            is_new = ~is_reached[next_cells]
            positions[next_cells[is_new]] = positions[cells[is_new]] + strides[headings[is_new]]
            is_reached[next_cells] = True
            frontier = np.unique(next_cells[is_new])
    return positions


SEMEXP = Method(
    MappedCategories,
    tracker=MapTracker(),
    learn=learn_search_setup,
    control=LocalPolicy(),
    check=check_map_size,
    name="semexp",
)
#: Ablation: the nearest frontier in place of the chosen blocks.
NEAREST = dataclasses.replace(SEMEXP, control=LocalPolicy(use_nearest_frontier=True))
