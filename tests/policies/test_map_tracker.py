"""The semantic map: a known walk as drawn by hand, random walks in homes, and false alarms that later looks clear."""

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

EMPTY, ROWS = jnp.zeros((32, 32), jnp.uint32), RowFormat(len(CATEGORIES))
VIEW_TABLE = make_view_table(Rules(headings=8), ROWS.view)
update = jax.jit(functools.partial(draw_view, row_format=ROWS, view_table=VIEW_TABLE))
START = 16


def row(view, detections=()):
    """A row: a view as (ahead, right, code), detections as (category, metres ahead, metres right)."""
    cells = np.full((1, ROWS.view, ROWS.view), VIEW_UNKNOWN, np.uint8)
    for ahead, right, code in view:
        cells[0, ahead, ROWS.view // 2 + right] = code
    detection_bytes = np.zeros((1, len(CATEGORIES), 4), np.uint8)
    for category, ahead, right in detections:
        detection_bytes[0, category] = 200, round(51 * ahead), round(128 + 25.4 * right), 60
    return jnp.asarray(ROWS.pack(detection_bytes, cells)[0])


def look(cells, place, heading, *what):
    return update(cells, row(*what), jnp.array(place, jnp.int32), jnp.int32(heading))


def drawn(cells, rows, z, x):
    """Compare part of a map with a drawing: one letter a cell, `.` for unknown."""
    words = {
        "f": FREE_BIT,
        "F": FREE_BIT | EXPLORED_BIT,
        "w": WALL_BIT,
        "W": WALL_BIT | EXPLORED_BIT,
        "v": VISITED_BIT | FREE_BIT | EXPLORED_BIT,
        ".": 0,
    }
    words |= {"b": WALL_BIT | 1 << BOOK, "C": FREE_BIT | EXPLORED_BIT | 1 << CHAIR}
    expected = np.array([[words[letter] for letter in line] for line in rows], np.uint32)
    np.testing.assert_array_equal(np.asarray(cells)[z : z + len(rows), x : x + len(rows[0])], expected)
    outside = np.asarray(cells).copy()
    outside[z : z + len(rows), x : x + len(rows[0])] = 0
    assert not outside.any()


def test_a_known_walk_is_the_map_that_was_drawn_by_hand():
    """Look north, where a book lies 7 cells (1.75 m) ahead on a blocked cell; turn east; step ahead.

    North is +z, lines further down. Cells up to 1.5 m away (6 cells) are explored.
    """
    north = [(1, 0, VIEW_FREE), (6, 0, VIEW_FREE), (7, 0, VIEW_BLOCKED), (7, 1, VIEW_FREE)]
    cells = look(EMPTY, (START, START), 0, north, [(BOOK, 1.75, 0.0)])
    drawn(cells, ["v.", "F.", "..", "..", "..", "..", "F.", "bf"], START, START)
    # East is +x; its right is south. The chair is a cell ahead and a cell to the right.
    east = [(1, 0, VIEW_FREE), (1, 1, VIEW_FREE), (2, -1, VIEW_BLOCKED)]
    cells = look(cells, (START, START), 2, east, [(CHAIR, 0.25, 0.25)])
    drawn(cells, [".C..", "vF..", "F.W.", "....", "....", "....", "....", "F...", "bf.."], START - 1, START)
    cells = look(cells, (START, START + 1), 2, [], [(CHAIR, 0.0, 0.25)])
    drawn(cells, [".C..", "vv..", "F.W.", "....", "....", "....", "....", "F...", "bf.."], START - 1, START)


def test_the_map_goes_on_at_the_opposite_edge():
    cells = look(EMPTY, (31, 0), 0, [(1, -1, VIEW_FREE)], [(BOOK, 0.5, 0.0)])
    detections = {tuple(map(int, cell)) for cell in np.argwhere(np.asarray(cells))}
    assert detections == {(31, 0), (0, 31), (1, 0)}


def test_later_looks_clear_false_alarms_nearby_and_nothing_else():
    ahead = [(3, 0, VIEW_FREE), (7, 0, VIEW_FREE)]
    alarmed = look(EMPTY, (START, START), 0, ahead, [(BOOK, 0.75, 0.0), (CHAIR, 1.75, 0.0), (FRIDGE, 0.0, 1.0)])
    cleared = look(alarmed, (START, START), 0, ahead)
    marks = {category: np.argwhere(np.asarray(cleared) >> category & 1).tolist() for category in (BOOK, CHAIR, FRIDGE)}
    # Too far to be sure, and not in view.
    assert marks == {BOOK: [], CHAIR: [[START + 7, START]], FRIDGE: [[START, START + 4]]}
    again = look(alarmed, (START, START), 0, ahead, [(BOOK, 0.75, 0.0)])
    assert int(again[START + 3, START]) & 1 << BOOK


def test_what_the_agent_runs_into_is_a_wall():
    bump = jax.jit(mark_collision)
    free = look(EMPTY, (START, START), 0, [(1, 0, VIEW_FREE)])
    ahead = jnp.array([START + 1, START], jnp.int32)
    cells = bump(free, ahead, jnp.int32(MOVE_AHEAD), jnp.bool_(False))
    assert int(cells[START + 1, START]) == WALL_BIT | EXPLORED_BIT
    for action, moved in ((MOVE_AHEAD, True), (ROTATE_RIGHT, False)):
        np.testing.assert_array_equal(bump(free, ahead, jnp.int32(action), jnp.bool_(moved)), free)


def test_the_cells_of_a_view_are_those_of_the_training_homes():
    """Exports without the entry come from before views showed the cell of MoveAhead."""
    nearest, move = (Rules(headings=12, front_cell=front_cell) for front_cell in ("nearest", "move"))
    steps = {"steps": np.zeros((12, 2), np.int32)}
    for setup, rules in [({}, nearest), ({"front_cell_is_move": np.array(True)}, move)]:
        table = learned_view_table(steps | setup, ROWS.view)
        jax.tree.map(np.testing.assert_array_equal, table, make_view_table(rules, ROWS.view))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["rooms", "apartments", "houses"])
def test_maps_of_random_walks_agree_with_the_home(world):
    """With a detector without errors every mark is where an object of its category stands."""
    task = WORLDS[world].task
    scene = make_generated_scenes(world, "train", 1)[0]
    bank = compile_bank([scene], Task(task.categories, task.goals, task.rules, PERFECT_DETECTOR))
    rules, rows = task.rules, RowFormat(len(task.categories))
    view_table = learned_view_table(learn_search_setup([bank], np.zeros(0)), rows.view)
    take_in = jax.jit(functools.partial(draw_view, row_format=rows, view_table=view_table))
    places, generator = standable_cells(scene.reach), np.random.default_rng(0)
    pose, cells, been = len(bank.rows) // 2, jnp.zeros((96, 96), jnp.uint32), set()
    for _ in range(400):
        cell, heading = divmod(pose // len(rules.horizons), rules.headings)
        been.add(tuple(places[cell] % 96))
        place = jnp.asarray(places[cell], jnp.int32)
        cells = take_in(cells, jnp.asarray(bank.rows[pose]), place, jnp.int32(heading))
        pose = bank.successor[pose, generator.choice(5, p=[0.5, 0.15, 0.15, 0.1, 0.1])]
    cells, inside = np.asarray(cells), set(map(tuple, places % 96))
    kinds = {flag: set(map(tuple, np.argwhere(cells & flag))) for flag in (FREE_BIT, WALL_BIT, VISITED_BIT)}
    assert kinds[VISITED_BIT] == been
    assert kinds[FREE_BIT] <= inside
    assert not kinds[WALL_BIT] & inside
    assert len(kinds[FREE_BIT]) > len(been) > 5
    centres = (scene.boxes[:, [2, 0]] - np.array(scene.origin)[::-1]) / CELL_SIZE
    object_categories = np.array(category_ids(scene.types, task.categories))
    marks = [
        (category, mark) for category in range(len(task.categories)) for mark in np.argwhere(cells >> category & 1)
    ]
    for category, mark in marks:
        away = np.abs((centres[object_categories == category] - mark + 48) % 96 - 48).max(axis=1)
        assert away.min() <= 1.0  # half a cell of rounding, and bytes
    assert len(marks) > 1
