"""The picture of a search shows the agent's own map, and the way that it walks next while it sees nothing new."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, corridor_scene

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import State
from jaxnav.env.render import (
    GOAL_COLOR,
)
from jaxnav.errors import InputError
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.removal import InferenceTrace
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.belief import BELIEF, BeliefTracker, learn_belief_setup
from jaxnav.policies.methods.map_tracker import BLOCKS_PER_SIDE, VISITED_BIT
from jaxnav.policies.methods.semexp import SEMEXP, learn_search_setup
from jaxnav.policies.network import init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import Task
from jaxnav.viz.episode import PlayedEpisode
from jaxnav.viz.search import (
    BLOCK_COLOR,
    NEAR_COLOR,
    OBSTACLE_COLOR,
    MapProjection,
    SearchSnapshot,
    compute_beliefs,
    draw_search,
    take_snapshot,
)

CORRIDOR = corridor_scene(24)
BANK = compile_bank([CORRIDOR], Task(CATEGORIES, detector=PERFECT_DETECTOR))
KNOWLEDGE = tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_search_setup([BANK], np.zeros(0))))
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("semexp"), method_sizes=())
NUM_LINES = len(KNOWLEDGE.method["lines"])  # of the map, to each side
NUM_STEPS = 8
NORTH_BLOCK = BLOCKS_PER_SIDE * (BLOCKS_PER_SIDE - 1) + BLOCKS_PER_SIDE // 2  # at the map's north end
COLORS = {"near": NEAR_COLOR, "blocked": OBSTACLE_COLOR, "block": BLOCK_COLOR, "goal": GOAL_COLOR}


@pytest.fixture(scope="module")
def corridor_walk():
    """An episode that starts at line 6 and heads north, and the state of the agent's search after each step."""
    env, params = build_environment(BANK, {}, 100)
    agent_loop = AgentLoop(env, SPEC)
    start_step = (6 * tiny.POSES_PER_CELL, 0, BOOK, 0)  # pose, scene, goal and time
    start_state = State(*(jnp.array([value], jnp.int32) for value in start_step))
    agent = jax.jit(agent_loop.start_from)(start_state, None, KNOWLEDGE, params)
    take_step = jax.jit(agent_loop.step)
    control = jax.jit(lambda tracker_state: SEMEXP.control.act(jnp.int32(NORTH_BLOCK), tracker_state, KNOWLEDGE))

    # Walk: the policy chooses the northern block at every step.
    poses = []
    actions = []
    search_states = []
    for _ in range(NUM_STEPS):
        action, search_state = control(tiny.leaves_at(agent.perception.tracker_state, 0))
        poses.append(int(agent.state.pose[0]))
        actions.append(int(action))
        search_states.append(search_state)
        agent, _ = take_step(agent, jnp.array([NORTH_BLOCK], jnp.int32), KNOWLEDGE, params)

    # Package the walk as a played episode; all three policies are certain of the northern block.
    certain_choice = np.zeros((NUM_STEPS, BLOCKS_PER_SIDE**2), np.float32)
    certain_choice[:, NORTH_BLOCK] = 1
    zeros = jnp.zeros(NUM_STEPS)
    choices = [jnp.asarray(certain_choice)] * 3
    trace = EpisodeTrace(
        np.array(poses), np.array(actions), InferenceTrace(zeros[:, None], zeros, zeros, *choices), success=False
    )
    places = cell_centres(CORRIDOR, standable_cells(CORRIDOR.reach))
    episode = PlayedEpisode(
        trace=trace,
        scene=CORRIDOR,
        places=places[trace.pose // tiny.POSES_PER_CELL],
        rows=BANK.rows[trace.pose],
        task=BANK.task,
        goal=BOOK,
        best_length=1,
        epsilon=np.inf,
        title="test",
        policies=tiny.make_untrained_policies(SPEC, KNOWLEDGE, BANK.task),
    )
    return episode, search_states


@pytest.mark.slow
def test_snapshot_holds_the_search_state_of_the_agent(corridor_walk):
    episode, search_states = corridor_walk
    snapshot = take_snapshot(episode, NUM_STEPS - 1)
    for snapshot_leaf, agent_leaf in zip(snapshot.search_state, search_states[-1], strict=True):
        np.testing.assert_array_equal(snapshot_leaf, agent_leaf)


@pytest.mark.slow
def test_snapshot_predicts_the_walk_while_nothing_new_is_seen(corridor_walk):
    """The floor to the north is open, as the plan assumes: a cell a step, except for the first, which looks down."""
    episode, search_states = corridor_walk
    positions = np.array([search_state.position for search_state in search_states])
    np.testing.assert_array_equal(positions[:, 0] - positions[0, 0], [0, *range(NUM_STEPS - 1)])
    np.testing.assert_array_equal(take_snapshot(episode, 0).predicted_cells[: NUM_STEPS - 1], positions[1:])


@pytest.mark.slow
def test_projection_puts_visited_cells_at_the_places_of_the_agent(corridor_walk):
    episode, search_states = corridor_walk
    projection = MapProjection(episode, take_snapshot(episode, NUM_STEPS - 1))

    # By the positions on the map.
    positions = np.array([search_state.position for search_state in search_states])
    np.testing.assert_allclose(projection.to_world(positions), episode.places, atol=1e-9)

    # By the pixels of the map's image.
    visited_pixels = np.argwhere(projection.unroll(np.asarray(search_states[-1].cells)) & VISITED_BIT)
    west, _, south, north = projection.borders
    pixel_size = (north - south) / NUM_LINES
    pixel_centres = np.array([west, south]) + pixel_size * (visited_pixels[:, ::-1] + 0.5)
    np.testing.assert_allclose(pixel_centres, np.unique(episode.places, axis=0), atol=1e-9)


def test_projection_continues_paths_across_the_edge_of_the_map(corridor_walk):
    """From line N - 1 to line 1 are two lines, not N - 2."""
    episode, _ = corridor_walk
    projection = MapProjection(episode, take_snapshot(episode, NUM_STEPS - 1))
    path = projection.path_to_world(np.array([[NUM_LINES - 1, 3], [1, 3]]))
    np.testing.assert_allclose(np.diff(path, axis=0), [[0.0, 0.5]], atol=1e-9)


def count_pixels(path):
    """Number of pixels of each colour in the map's part of a picture, without the legend."""
    with Image.open(path) as image:
        assert image.size == (960, 540)
        pixels = np.asarray(image.convert("RGB"))[:, :670]
    num_pixels = {}
    for part, color in COLORS.items():
        num_pixels[part] = (pixels == np.rint(255 * np.array(to_rgb(color)))).all(axis=-1).sum()
    return num_pixels


@pytest.mark.slow
def test_draw_search_shows_the_goal_or_else_the_chosen_block(corridor_walk, tmp_path):
    """The goal is in the first view; a block is shown only while the goal's category was never seen."""
    episode, _ = corridor_walk
    first_snapshot = take_snapshot(episode, 0)
    last_snapshot = take_snapshot(episode, NUM_STEPS - 1)

    # Another goal, of a category without a mark on the map.
    cells = last_snapshot.search_state.cells
    category_seen = [bool((cells >> np.uint32(index) & np.uint32(1)).any()) for index in range(len(CATEGORIES))]
    unseen_goal = np.int32(category_seen.index(False))
    unseen_snapshot = last_snapshot._replace(search_state=last_snapshot.search_state._replace(goal=unseen_goal))

    pictures = {
        "first": (first_snapshot, 0),
        "last": (last_snapshot, NUM_STEPS - 1),
        "unseen": (unseen_snapshot, NUM_STEPS - 1),
    }
    num_pixels = {}
    for name, (snapshot, step) in pictures.items():
        path = tmp_path / "new" / f"{name}.png"
        draw_search([episode], [snapshot], step, path)
        num_pixels[name] = count_pixels(path)

    assert num_pixels["last"]["near"] > num_pixels["first"]["near"] > 0
    assert num_pixels["last"]["goal"] > 0
    assert num_pixels["unseen"]["block"] > 0
    assert num_pixels["first"]["block"] == num_pixels["last"]["block"] == 0


def test_snapshot_refuses_a_step_after_the_end(corridor_walk):
    episode, _ = corridor_walk
    with pytest.raises(InputError, match=f"--step {NUM_STEPS + 1}: give a number from 1 to {NUM_STEPS}"):
        take_snapshot(episode, NUM_STEPS)


def test_snapshot_refuses_a_method_without_a_map(corridor_walk):
    episode, _ = corridor_walk
    with pytest.raises(InputError, match=r"--map: method 'org' .*; give a run of method semexp"):
        take_snapshot(episode._replace(policies=tiny.make_untrained_policies()), 0)


# Belief


@pytest.mark.slow
def test_heat_maps_show_the_belief_before_and_after_removal(corridor_walk, tmp_path):
    """With a removal weight of 1 the belief is that by places, softmax(0) without a fit; a chair attracts the book."""
    episode, _ = corridor_walk
    spec = PolicySpec(BELIEF, len(CATEGORIES))
    params = init_params(spec, jax.random.key(0))
    params["method"]["relations"] = params["method"]["relations"].at[BOOK, 0, CHAIR].set(2.0)
    ones = np.ones(NUM_STEPS, np.float32)
    inferred = episode.trace.inferred._replace(
        removal_weight=ones, layout_weights=np.ones((NUM_STEPS, len(CATEGORIES)), np.float32)
    )
    episode = episode._replace(
        trace=episode.trace._replace(inferred=inferred),
        policies=episode.policies._replace(params=jax.tree.map(lambda leaf: leaf[None], params), spec=spec),
    )

    # A map with nothing but a chair in square (24, 26), next to the start.
    knowledge = KNOWLEDGE._replace(method=jax.tree.map(jnp.asarray, learn_belief_setup([BANK], np.zeros(0))))
    search_state = BeliefTracker().init(knowledge)
    search_state = search_state._replace(cells=search_state.cells.at[48, 52].set(1 << CHAIR))
    beliefs = compute_beliefs(episode, search_state, 3)
    assert list(beliefs) == ["belief with all experience", "after removal, s = 1.00"]
    before_removal, after_removal = beliefs.values()
    np.testing.assert_allclose(after_removal, 1 / 48**2, rtol=1e-5)
    # Nine squares within 0.5 m of the chair are e^2 times as likely as all the others.
    near_chair = np.exp(2) / (9 * np.exp(2) + 48**2 - 9)
    np.testing.assert_allclose(before_removal[23:26, 25:28], near_chair, rtol=1e-5)
    assert (before_removal > 0.99 * near_chair).sum() == 9

    # Both are drawn.
    positions = np.repeat(np.asarray(search_state.position)[None], 3, axis=0)
    snapshot = SearchSnapshot(jax.tree.map(np.asarray, search_state), positions, 2, beliefs)
    draw_search([episode], [snapshot], 3, tmp_path / "belief.png")
    with Image.open(tmp_path / "belief.png") as image:
        assert image.size == (960, 540)

    # Two episodes make two rows; one that is shorter shows its end.
    longer_step = NUM_STEPS + 5
    draw_search([episode, episode], [snapshot, snapshot], longer_step, tmp_path / "two.png")
    draw_search([episode], [snapshot], NUM_STEPS - 1, tmp_path / "end.png")
    with Image.open(tmp_path / "two.png") as image, Image.open(tmp_path / "end.png") as end_image:
        assert image.size == (960, 1080)
        two_pixels, end_pixels = (np.asarray(picture.convert("RGB"))[:, :650] for picture in (image, end_image))
        np.testing.assert_array_equal(two_pixels[:540], end_pixels)
        np.testing.assert_array_equal(two_pixels[540:], end_pixels)
