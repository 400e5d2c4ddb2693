"""The picture of a search shows the agent's own map, and the way that it walks next where nothing new is seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, SMALL, draw

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import State
from jaxnav.errors import InputError
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.removal import InferenceTrace
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.map_tracker import BLOCKS_PER_SIDE, VISITED_BIT
from jaxnav.policies.methods.semexp import SEMEXP, learn_search_setup
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Task
from jaxnav.viz.episode import PlayedEpisode
from jaxnav.viz.search import BLOCK_COLOR, NEAR_COLOR, OBSTACLE_COLOR, MapProjection, draw_search, take_snapshot
from jaxnav.viz.style import GOAL_COLOR

#: A corridor along z, one cell wide, a book at its north end.
CORRIDOR = draw([["."]] * 24, ("Book", 0.0, 0.8, 5.75, *SMALL))
BANK = compile_bank([CORRIDOR], Task(CATEGORIES, detector=PERFECT_DETECTOR))
KNOWN = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_search_setup([BANK], np.zeros(0))))
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("semexp"), method_sizes=())
SIZE = len(KNOWN.method["lines"])
STEPS, NORTH = 8, BLOCKS_PER_SIDE * (BLOCKS_PER_SIDE - 1) + BLOCKS_PER_SIDE // 2  # the block at the map's north end


@pytest.fixture(scope="module")
def walked():
    """An episode from line 6 on, and the agent's notes at each step."""
    env, params = build_environment(BANK, {}, 100)
    acting = AgentLoop(env, SPEC)
    start = State(*(jnp.array([number], jnp.int32) for number in (6 * tiny.POSES_PER_CELL, 0, BOOK, 0)))
    agent, step = jax.jit(acting.start_from)(start, None, KNOWN, params), jax.jit(acting.step)
    poses, actions, notes = [], [], []
    act = jax.jit(lambda note: SEMEXP.control.act(jnp.int32(NORTH), note, KNOWN))
    for _ in range(STEPS):
        action, note = act(tiny.leaves_at(agent.perception.tracker_state, 0))
        poses.append(int(agent.state.pose[0]))
        actions.append(int(action))
        notes.append(note)
        agent, _ = step(agent, jnp.array([NORTH], jnp.int32), KNOWN, params)
    choices = np.repeat(np.eye(BLOCKS_PER_SIDE**2, dtype=np.float32)[NORTH][None], STEPS, axis=0)
    inferred = InferenceTrace(
        *map(jnp.asarray, (np.zeros((STEPS, 1)), np.zeros(STEPS), np.zeros(STEPS), *3 * [choices]))
    )
    trace = EpisodeTrace(np.array(poses), np.array(actions), inferred, success=False)
    episode = PlayedEpisode(
        trace=trace,
        scene=CORRIDOR,
        places=cell_centres(CORRIDOR, standable_cells(CORRIDOR.reach))[trace.pose // tiny.POSES_PER_CELL],
        rows=BANK.rows[trace.pose],
        task=BANK.task,
        goal=BOOK,
        best_length=1,
        epsilon=np.inf,
        title="test",
        policies=tiny.untrained(SPEC, KNOWN, BANK.task),
    )
    return episode, notes


def test_the_map_is_that_of_the_agent(walked):
    episode, notes = walked
    for shown, expected in zip(take_snapshot(episode, STEPS - 1).search_state, notes[-1], strict=True):
        np.testing.assert_array_equal(shown, expected)


def test_the_way_planned_is_walked_where_nothing_new_is_seen(walked):
    """The floor to the north is open, as the plan takes it to be: a cell a step, but the first, which looks down."""
    episode, notes = walked
    places = np.array([note.position for note in notes])
    np.testing.assert_array_equal(places[:, 0] - places[0, 0], [0, *range(STEPS - 1)])
    np.testing.assert_array_equal(take_snapshot(episode, 0).predicted_cells[: STEPS - 1], places[1:])


def test_the_map_lies_over_the_home(walked):
    """Where the map says visited, there the agent was; by its cells, and by the pixels of its image."""
    episode, notes = walked
    projection = MapProjection(episode, take_snapshot(episode, STEPS - 1))
    np.testing.assert_allclose(
        projection.to_world(np.array([note.position for note in notes])), episode.places, atol=1e-9
    )
    visited = np.argwhere(projection.unroll(np.asarray(notes[-1].cells)) & VISITED_BIT)
    left_border, _, bottom, top = projection.borders
    centres = np.array([left_border, bottom]) + (top - bottom) / SIZE * (visited[:, ::-1] + 0.5)
    np.testing.assert_allclose(centres, np.unique(episode.places, axis=0), atol=1e-9)
    # Beyond an edge it goes on: from line N - 1 to line 1 are two lines, not N - 2.
    ways = np.diff(projection.path_to_world(np.array([[SIZE - 1, 3], [1, 3]])), axis=0)
    np.testing.assert_allclose(ways, [[0.0, 0.5]], atol=1e-9)


def test_the_picture_shows_what_is_known_and_chosen(walked, tmp_path):
    """The goal is in the first view; where another is sought that was never seen, a block is shown."""
    episode, _ = walked
    shares, first, last = {}, take_snapshot(episode, 0), take_snapshot(episode, STEPS - 1)
    cells = last.search_state.cells
    unseen = next(k for k in range(len(episode.task.categories)) if not (cells >> np.uint32(k) & np.uint32(1)).any())
    other = last._replace(search_state=last.search_state._replace(goal=np.int32(unseen)))
    for name, search, step in (("first", first, 0), ("last", last, STEPS - 1), ("other", other, STEPS - 1)):
        path = tmp_path / "new" / f"{name}.png"
        draw_search(episode, search, step, path)
        with Image.open(path) as image:
            assert image.size == (960, 540)
            pixels = np.asarray(image.convert("RGB"))[:, :670]  # without the legend
        for part, colour in {
            "near": NEAR_COLOR,
            "blocked": OBSTACLE_COLOR,
            "block": BLOCK_COLOR,
            "goal": GOAL_COLOR,
        }.items():
            shares[part, name] = (pixels == np.rint(255 * np.array(to_rgb(colour)))).all(axis=-1).sum()
    assert shares["near", "last"] > shares["near", "first"] > 0
    assert min(shares["block", "other"], shares["goal", "last"]) > 0
    assert shares["block", "first"] == shares["block", "last"] == 0


def test_what_has_no_map_or_no_such_step_is_refused(walked):
    episode, _ = walked
    with pytest.raises(InputError, match=f"--step {STEPS + 1}: give a number from 1 to {STEPS}"):
        take_snapshot(episode, STEPS)
    with pytest.raises(InputError, match="--map: method 'org' keeps no map to plan on; give a run of semexp"):
        take_snapshot(episode._replace(policies=tiny.untrained()), 0)
