"""Draw your own kitchen, and let the packaged policy search for the Toaster in it.

The script prints the policy's path on the drawing, and the length of a shortest path.

python examples/drawn_room.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxnav
from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import State
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import ACTIONS, DONE, ROOMS

#: A mark is a quarter of a metre; # is wall, . is floor, @ the start, all the rest is furniture.
DRAWING = """
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

# Turn the drawing upside down: row 0 has the smallest z.
marks = np.array([list(line) for line in DRAWING.strip().splitlines()])[::-1]

# Place each object at the centre of its patch; a box is x, y, z of the centre, then width, height, depth.
boxes = []
for mark, (_, underside, width, height, depth) in OBJECTS.items():
    row, column = np.argwhere(marks == mark).mean(axis=0)
    boxes.append((CELL_SIZE * column, underside + height / 2, CELL_SIZE * row, width, height, depth))

scene = Scene(
    name="my-kitchen",
    world="drawn",
    room_type="kitchen",
    split="val",
    origin=(0.0, 0.0),
    reach=(marks == ".") | (marks == "@"),
    walls=marks == "#",
    types=tuple(name for name, *_ in OBJECTS.values()),
    boxes=np.array(boxes),
    yaws=np.zeros(len(boxes)),
    parents=np.full(len(boxes), -1),
)

# Compile the scene, and load the policy.
bank = compile_bank([scene], ROOMS)
env, params = build_environment(bank, {}, default_limit=100)
policy = jaxnav.load_policy("rooms-org")

# The start is the cell marked @, with the first of its poses: heading 0 looks up the page.
cells = standable_cells(scene.reach)
(start_mark,) = np.argwhere(marks == "@")
start_cell = np.flatnonzero((cells == start_mark).all(axis=1))[0]
start_pose = int(start_cell) * ROOMS.rules.poses_per_cell
goal = ROOMS.categories.index(GOAL)


@jax.jit
def act(state, memory, moved):
    """Take one step."""
    _, heading, horizon = ROOMS.rules.split_pose(state.pose)
    observation = env.observe(state, params)
    action, memory = policy.act(observation, memory, 0.5, heading=heading, moved=moved, horizon=horizon)
    next_state, _, terminated, truncated = env.advance(state, action, params)
    moved = env.cell_of_pose(next_state.pose) != env.cell_of_pose(state.pose)
    return action, next_state, memory, moved, env.done_succeeds(state, params), terminated | truncated


# Act until Done or the time limit, and mark every cell of the path.
state = State(pose=jnp.int32(start_pose), scene=jnp.int32(0), goal=jnp.int32(goal), time=jnp.int32(0))
memory = policy.init("kitchen")
moved = jnp.bool_(False)
success = False
ended = False
actions = []
while not ended:
    row, column = cells[int(env.cell_of_pose(state.pose))]
    if marks[row, column] == ".":
        marks[row, column] = "*"
    action, state, memory, moved, success, ended = act(state, memory, moved)
    actions.append(int(action))

outcome = "out of time"
if actions[-1] == DONE:
    outcome = "found" if success else "wrong Done"
action_counts = [f"{actions.count(index)} x {name}" for index, name in enumerate(ACTIONS) if index in actions]

print("\n".join("".join(row) for row in marks[::-1]))
print(f"{GOAL}: {outcome} after {len(actions)} actions; a shortest path takes {bank.best_length[start_pose, goal]}")
print(", ".join(action_counts))
