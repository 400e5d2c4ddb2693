"""Draw a kitchen of your own, and let the packaged policy look for the Toaster in it, beside a shortest path.

python examples/drawn_room.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxnav
from jaxnav.env.build import build
from jaxnav.env.types import State
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import ACTIONS, DONE, ROOMS

#: A mark is a quarter of a metre; # is wall, . is floor, @ the start, the rest is furniture.
DRAWN = """
####################
#FF.............CC.#
#FF.............CC.#
#..................#
#......@...........#
#..................#
#........TTTT......#
#........TTTT......#
#..................#
#..................#
#..................#
#..................#
#==M===P===o===.GG.#
####################
"""
#: Type, height of the underside, width, height and depth in metres; one object for each patch of a mark.
OBJECTS = {
    "F": ("Fridge", 0.0, 0.5, 1.8, 0.5),
    "C": ("Chair", 0.0, 0.5, 0.9, 0.5),
    "T": ("DiningTable", 0.0, 1.0, 0.7, 0.5),
    "G": ("GarbageCan", 0.0, 0.4, 0.6, 0.4),
    "=": ("CounterTop", 0.0, 3.5, 0.9, 0.25),
    "M": ("Microwave", 0.9, 0.25, 0.3, 0.25),
    "P": ("Pan", 0.9, 0.25, 0.1, 0.25),
    "o": ("Toaster", 0.9, 0.25, 0.2, 0.25),
}
GOAL = "Toaster"

marks = np.array([list(line) for line in DRAWN.strip().splitlines()])[::-1]  # row 0 has the smallest z
boxes = {mark: np.argwhere(marks == mark).mean(axis=0) for mark in OBJECTS}  # centre (iz, ix) of each patch
scene = Scene(
    name="my-kitchen",
    world="drawn",
    room_type="kitchen",
    split="val",
    origin=(0.0, 0.0),
    reach=(marks == ".") | (marks == "@"),
    walls=marks == "#",
    types=tuple(OBJECTS[mark][0] for mark in boxes),
    boxes=np.array(
        [
            (CELL * ix, low + height / 2, CELL * iz, width, height, depth)
            for (iz, ix), (_, low, width, height, depth) in zip(boxes.values(), OBJECTS.values(), strict=True)
        ]
    ),
    yaws=np.zeros(len(boxes)),
    parents=np.full(len(boxes), -1),
)
bank = compile_bank([scene], ROOMS)
env, params = build(bank, {}, default_limit=100)
policy = jaxnav.load_policy("rooms-org")
cells = standable_cells(scene.reach)
start = int(np.flatnonzero((cells == np.argwhere(marks == "@")[0]).all(axis=1))[0]) * ROOMS.rules.poses_per_cell
goal = ROOMS.categories.index(GOAL)


@jax.jit
def act(state, memory, moved):
    """Take one step; heading 0 looks up the page."""
    rules = ROOMS.rules
    heading, horizon = state.pose // len(rules.horizons) % rules.headings, state.pose % len(rules.horizons)
    told = {"heading": heading, "moved": moved, "horizon": horizon}
    action, memory = policy.act(env.observe(state, params), memory, 0.5, **told)
    after, _, _, ended = env.advance(state, action, params)
    moved = env.cell(after.pose) != env.cell(state.pose)
    return action, after, memory, moved, env.succeeds(state, params), ended


state = State(pose=jnp.int32(start), scene=jnp.int32(0), goal=jnp.int32(goal), time=jnp.int32(0))
memory, moved, actions, action, ended = policy.init("kitchen"), jnp.bool_(False), [], None, False
while action != DONE and not ended:
    row, column = cells[int(env.cell(state.pose))]
    marks[row, column] = "*" if marks[row, column] == "." else marks[row, column]
    action, state, memory, moved, near, ended = act(state, memory, moved)
    actions.append(int(action))

print("\n".join("".join(row) for row in marks[::-1]))
outcome = "found" if action == DONE and near else "wrong Done" if action == DONE else "out of time"
print(f"{GOAL}: {outcome} after {len(actions)} actions; a shortest path takes {bank.best_length[start, goal]}")
print(", ".join(f"{actions.count(i)} x {name}" for i, name in enumerate(ACTIONS) if i in actions))
