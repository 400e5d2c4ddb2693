"""The semantic map: a walk against drawings by hand, random walks in homes, and false alarms that later views clear."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE

from jaxnav.policies.methods.map_tracker import (
    EXPLORED_BIT,
    FREE_BIT,
    VISITED_BIT,
    WALL_BIT,
    draw_view,
    learned_view_table,
    make_view_table,
    mark_collision,
)
from jaxnav.policies.methods.semexp import learn_search_setup
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR, VIEW_BLOCKED, VIEW_FREE, VIEW_UNKNOWN, RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_RIGHT, Rules, Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

EMPTY_MAP = jnp.zeros((32, 32), jnp.uint32)
ROW_FORMAT = RowFormat(len(CATEGORIES))
VIEW_TABLE = make_view_table(Rules(headings=8), ROW_FORMAT.view)
draw_view_compiled = jax.jit(functools.partial(draw_view, row_format=ROW_FORMAT, view_table=VIEW_TABLE))
#: Line and column of the cell from which walks start.
START = 16
#: Cells along each side of the maps of the generated homes.
HOME_MAP_SIZE = 96


def make_row(view_cells, detections):
    """Observation row of view cells (ahead, right, code) and detections (category, metres ahead, metres right)."""
    view = np.full((1, ROW_FORMAT.view, ROW_FORMAT.view), VIEW_UNKNOWN, np.uint8)
    for ahead, right, code in view_cells:
        view[0, ahead, ROW_FORMAT.view // 2 + right] = code
    detection_bytes = np.zeros((1, len(CATEGORIES), 4), np.uint8)
    for category, ahead, right in detections:
        detection_bytes[0, category] = 200, round(51 * ahead), round(128 + 25.4 * right), 60
    return jnp.asarray(ROW_FORMAT.pack(detection_bytes, view)[0])


def look(cells, position, heading, view_cells, detections=()):
    """The map after a view from a cell; arguments as in `make_row`."""
    row = make_row(view_cells, detections)
    return draw_view_compiled(cells, row, jnp.array(position, jnp.int32), jnp.int32(heading))


def assert_map_is_drawing(cells, drawing, z, x):
    """Compare the part of a map from cell (z, x) with a drawing, one letter a cell; the rest of the map is empty."""
    bits_by_letter = {
        "f": FREE_BIT,
        "F": FREE_BIT | EXPLORED_BIT,
        "w": WALL_BIT,
        "W": WALL_BIT | EXPLORED_BIT,
        "v": VISITED_BIT | FREE_BIT | EXPLORED_BIT,
        "b": WALL_BIT | 1 << BOOK,
        "C": FREE_BIT | EXPLORED_BIT | 1 << CHAIR,
        ".": 0,  # unknown
    }
    expected = np.zeros((len(drawing), len(drawing[0])), np.uint32)
    for line_index, line in enumerate(drawing):
        expected[line_index] = [bits_by_letter[letter] for letter in line]
    drawn_part = np.s_[z : z + len(drawing), x : x + len(drawing[0])]
    np.testing.assert_array_equal(np.asarray(cells)[drawn_part], expected)

    # Nothing lies outside the drawing.
    outside = np.asarray(cells).copy()
    outside[drawn_part] = 0
    assert not outside.any()


def test_known_walk_gives_the_map_drawn_by_hand():
    """Look north, where a book lies 7 cells (1.75 m) ahead on a blocked cell; turn east; step ahead.

    North is +z, lines further down. Cells up to 1.5 m away (6 cells) are explored.
    """
    north_view = [(1, 0, VIEW_FREE), (6, 0, VIEW_FREE), (7, 0, VIEW_BLOCKED), (7, 1, VIEW_FREE)]
    cells = look(EMPTY_MAP, (START, START), 0, north_view, [(BOOK, 1.75, 0.0)])
    assert_map_is_drawing(cells, ["v.", "F.", "..", "..", "..", "..", "F.", "bf"], START, START)

    # East is +x; its right is south. The chair is a cell ahead and a cell to the right.
    east_view = [(1, 0, VIEW_FREE), (1, 1, VIEW_FREE), (2, -1, VIEW_BLOCKED)]
    cells = look(cells, (START, START), 2, east_view, [(CHAIR, 0.25, 0.25)])
    drawing = [".C..", "vF..", "F.W.", "....", "....", "....", "....", "F...", "bf.."]
    assert_map_is_drawing(cells, drawing, START - 1, START)

    # After a step to the east the chair is to the right.
    cells = look(cells, (START, START + 1), 2, [], [(CHAIR, 0.0, 0.25)])
    drawing = [".C..", "vv..", "F.W.", "....", "....", "....", "....", "F...", "bf.."]
    assert_map_is_drawing(cells, drawing, START - 1, START)


def test_map_wraps_around_at_its_edges():
    cells = look(EMPTY_MAP, (31, 0), 0, [(1, -1, VIEW_FREE)], [(BOOK, 0.5, 0.0)])
    marked_cells = {tuple(map(int, cell)) for cell in np.argwhere(np.asarray(cells))}
    assert marked_cells == {(31, 0), (0, 31), (1, 0)}


def test_later_views_clear_only_false_alarms_nearby():
    free_view = [(3, 0, VIEW_FREE), (7, 0, VIEW_FREE)]
    detections = [(BOOK, 0.75, 0.0), (CHAIR, 1.75, 0.0), (FRIDGE, 0.0, 1.0)]
    cells_with_alarms = look(EMPTY_MAP, (START, START), 0, free_view, detections)

    # A view without detections clears the book. The chair is too far away to be sure, and the fridge not in view.
    cleared_cells = look(cells_with_alarms, (START, START), 0, free_view)
    marks = {}
    for category in (BOOK, CHAIR, FRIDGE):
        marks[category] = np.argwhere(np.asarray(cleared_cells) >> category & 1).tolist()
    assert marks == {BOOK: [], CHAIR: [[START + 7, START]], FRIDGE: [[START, START + 4]]}

    # A book that is detected again stays.
    confirmed_cells = look(cells_with_alarms, (START, START), 0, free_view, [(BOOK, 0.75, 0.0)])
    assert int(confirmed_cells[START + 3, START]) & 1 << BOOK


def test_cell_of_a_collision_is_marked_as_wall():
    mark_compiled = jax.jit(mark_collision)
    free_cells = look(EMPTY_MAP, (START, START), 0, [(1, 0, VIEW_FREE)])
    ahead = jnp.array([START + 1, START], jnp.int32)
    cells = mark_compiled(free_cells, ahead, jnp.int32(MOVE_AHEAD), jnp.bool_(False))
    assert int(cells[START + 1, START]) == WALL_BIT | EXPLORED_BIT

    # A successful move and a turn mark nothing.
    for action, moved in ((MOVE_AHEAD, True), (ROTATE_RIGHT, False)):
        cells = mark_compiled(free_cells, ahead, jnp.int32(action), jnp.bool_(moved))
        np.testing.assert_array_equal(cells, free_cells)


def test_view_table_follows_the_front_cell_of_the_training_homes():
    """Exports without the entry `front_cell_is_move` precede views that show the cell of MoveAhead."""
    nearest_rules = Rules(headings=12, front_cell="nearest")
    move_rules = Rules(headings=12, front_cell="move")
    steps = {"steps": np.zeros((12, 2), np.int32)}
    for setup, rules in [({}, nearest_rules), ({"front_cell_is_move": np.array(True)}, move_rules)]:
        table = learned_view_table(steps | setup, ROW_FORMAT.view)
        jax.tree.map(np.testing.assert_array_equal, table, make_view_table(rules, ROW_FORMAT.view))


def map_random_walk(bank, cell_positions, num_steps):
    """Draw the views of a random walk.

    Args:
      bank: bank of one scene, without detection errors.
      cell_positions: [cells, 2], (z, x) of the cells of the scene.
      num_steps: number of views.

    Returns:
      The map after the walk, uint32 [HOME_MAP_SIZE, HOME_MAP_SIZE], and the visited cells, a set of (z, x) on it.
    """
    rules = bank.task.rules
    row_format = RowFormat(len(bank.task.categories))
    view_table = learned_view_table(learn_search_setup([bank], np.zeros(0)), row_format.view)
    draw_compiled = jax.jit(functools.partial(draw_view, row_format=row_format, view_table=view_table))

    # Begin at the middle pose; half of the actions are moves ahead.
    rng = np.random.default_rng(0)
    pose = len(bank.rows) // 2
    cells = jnp.zeros((HOME_MAP_SIZE, HOME_MAP_SIZE), jnp.uint32)
    visited_cells = set()
    for _ in range(num_steps):
        cell, heading = divmod(pose // len(rules.horizons), rules.headings)
        visited_cells.add(tuple(cell_positions[cell] % HOME_MAP_SIZE))
        position = jnp.asarray(cell_positions[cell], jnp.int32)
        cells = draw_compiled(cells, jnp.asarray(bank.rows[pose]), position, jnp.int32(heading))
        pose = bank.successor[pose, rng.choice(5, p=[0.5, 0.15, 0.15, 0.1, 0.1])]
    return np.asarray(cells), visited_cells


@pytest.mark.slow
@pytest.mark.parametrize("world", ["rooms", "apartments", "houses"])
def test_maps_of_random_walks_agree_with_the_home(world):
    """With a detector without errors, an object of its category stands at every mark."""
    task = WORLDS[world].task
    scene = make_generated_scenes(world, "train", 1)[0]
    bank = compile_bank([scene], Task(task.categories, task.goals, task.rules, PERFECT_DETECTOR))
    cell_positions = standable_cells(scene.reach)
    cells, visited_cells = map_random_walk(bank, cell_positions, 400)

    # Visited cells are those of the walk, free cells can be stood on, and walls cannot.
    room_cells = set(map(tuple, cell_positions % HOME_MAP_SIZE))
    cells_by_bit = {}
    for bit in (FREE_BIT, WALL_BIT, VISITED_BIT):
        cells_by_bit[bit] = set(map(tuple, np.argwhere(cells & bit)))
    assert cells_by_bit[VISITED_BIT] == visited_cells
    assert cells_by_bit[FREE_BIT] <= room_cells
    assert not cells_by_bit[WALL_BIT] & room_cells
    assert len(cells_by_bit[FREE_BIT]) > len(visited_cells) > 5

    # Every mark of a category lies at most one cell from an object: half a cell of rounding, and bytes.
    object_centres = (scene.boxes[:, [2, 0]] - np.array(scene.origin)[::-1]) / CELL_SIZE
    object_categories = np.array(category_ids(scene.types, task.categories))
    half_size = HOME_MAP_SIZE // 2
    num_marks = 0
    for category in range(len(task.categories)):
        for mark in np.argwhere(cells >> category & 1):
            offsets = object_centres[object_categories == category] - mark
            distances = np.abs((offsets + half_size) % HOME_MAP_SIZE - half_size).max(axis=1)
            assert distances.min() <= 1.0
            num_marks += 1
    assert num_marks > 1
