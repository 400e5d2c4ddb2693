"""Spatial memory: maps of generated scenes against their plan, the moving window, and the policy's use of the map."""

import dataclasses
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, KNOWLEDGE, PARAMS
from support.tiers import params_by_tier
from support.walks import draw_walk_actions

import jaxnav
from jaxnav.causal import do
from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import ObjectNav
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.network import bind
from jaxnav.policies.spatial_memory import BLOCKED, FREE, UNKNOWN, VISITED, ExplorationMap, SpatialMemory
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat
from jaxnav.scenes.task import DONE, MOVE_AHEAD, Rules
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

NUM_STEPS = 60
NUM_WALKS = 8


class RandomWalks(NamedTuple):
    """Random walks in a generated scene.

    Attributes:
      scene: the scene.
      memory: mapper of the walks.
      env: environment of the scene.
      maps: maps after the last step, leaves [NUM_WALKS, ...].
      cells: [NUM_STEPS + 1, NUM_WALKS], index of the agent's cell at the start and after every step.
    """

    scene: Scene
    memory: SpatialMemory
    env: ObjectNav
    maps: ExplorationMap
    cells: np.ndarray


@pytest.fixture(scope="module", params=["rooms", "apartments"])
def random_walks(request):
    """Random walks with 8 headings (rooms) and 12 headings (apartments)."""
    task = WORLDS[request.param].task
    scene = make_generated_scenes(request.param, "train", 1)[0]
    env, params = build_environment(compile_bank([scene], task), {}, 10**6)
    memory = SpatialMemory(task.rules.headings, front_cell=task.rules.front_cell)
    spec = dataclasses.replace(tiny.SPEC, num_categories=len(task.categories), spatial_memory=memory)
    agent_loop = AgentLoop(env, spec)

    @jax.jit
    def walk(key):
        start = agent_loop.start(key, NUM_WALKS, None, None, params)

        def step(agent, key):
            agent, _ = agent_loop.step(agent, draw_walk_actions(key, NUM_WALKS), None, params)
            return agent, env.cell_of_pose(agent.state.pose)

        agent, cells = jax.lax.scan(step, start, jax.random.split(key, NUM_STEPS))
        start_cells = env.cell_of_pose(start.state.pose)
        return agent.perception.spatial_map, jnp.concatenate([start_cells[None], cells])

    maps, cells = jax.tree.map(np.asarray, walk(jax.random.key(0)))
    return RandomWalks(scene, memory, env, maps, cells)


def states_by_cell(map_cells, start_cell):
    """States of the known cells of a map, by cell (z, x) of the scene; the walk began at `start_cell`."""
    centre = map_cells.shape[-1] // 2
    states = {}
    for map_cell in np.argwhere(map_cells != UNKNOWN):
        states[tuple(map_cell - centre + start_cell)] = map_cells[tuple(map_cell)]
    return states


def cells_in_state(states, state):
    return {cell for cell, cell_state in states.items() if cell_state == state}


def test_map_agrees_with_the_room(random_walks):
    cell_positions = standable_cells(random_walks.scene.reach)
    room_cells = set(map(tuple, cell_positions))
    for walk in range(NUM_WALKS):
        walk_cells = random_walks.cells[:, walk]
        states = states_by_cell(random_walks.maps.cells[walk], cell_positions[walk_cells[0]])
        assert cells_in_state(states, VISITED) == {tuple(cell_positions[cell]) for cell in walk_cells}
        assert cells_in_state(states, FREE) <= room_cells
        assert not cells_in_state(states, BLOCKED) & room_cells
        assert len(states) > len(set(walk_cells))  # seen from afar


@pytest.mark.slow
def test_reading_is_the_map_turned_with_the_agent(random_walks):
    # Readings of all walks, with the agent's cell in the middle.
    memory = random_walks.memory
    side = 2 * memory.reach + 1
    readings = np.asarray(jax.vmap(memory.read)(random_walks.maps)).reshape(NUM_WALKS, side, side)
    assert (readings[:, memory.reach, memory.reach] == VISITED).all()
    assert memory.num_inputs == 3 * side * side

    # North is +z. Facing it, ahead is +z and right is +x; a quarter turn right faces +x.
    headings_per_quarter = random_walks.env.task.rules.headings // 4
    for walk in range(NUM_WALKS):
        num_quarters, remainder = divmod(int(random_walks.maps.heading[walk]), headings_per_quarter)
        if remainder:
            continue  # not along an axis of the lattice

        # Turn map and position until the agent faces north.
        turned_cells = np.rot90(random_walks.maps.cells[walk], -num_quarters)
        z, x = random_walks.maps.position[walk]
        for _ in range(num_quarters):
            z, x = x, len(turned_cells) - 1 - z
        offsets = memory.stride * np.arange(-memory.reach, memory.reach + 1)
        expected = turned_cells[np.ix_((z + offsets) % 64, (x + offsets) % 64)]
        np.testing.assert_array_equal(readings[walk], expected)


# The window that moves with the agent


WINDOW_ROWS = RowFormat(1)


def draw_walk(seed, num_steps, headings, turn_prob):
    """Headings, moves and views of a walk, drawn at random; views differ from step to step."""
    rng = np.random.default_rng(seed)
    turns = rng.choice([-1, 0, 1], num_steps, p=[turn_prob / 2, 1 - turn_prob, turn_prob / 2])
    is_move = rng.random(num_steps) < 0.8
    view_rows = rng.integers(0, 256, (num_steps, WINDOW_ROWS.num_bytes)).astype(np.uint8)
    return np.cumsum(turns) % headings, is_move & (turns == 0), view_rows


def record_readings(memory, walk):
    """Maps and readings after every step of a walk."""
    headings, is_move, view_rows = walk

    def step(explored, inputs):
        row, heading, moved = inputs
        explored = memory.update(explored, row, heading, moved, WINDOW_ROWS)
        return explored, (explored, memory.read(explored))

    inputs = jnp.asarray(view_rows), jnp.asarray(headings, jnp.int32), jnp.asarray(is_move)
    return jax.tree.map(np.asarray, jax.jit(lambda: jax.lax.scan(step, memory.init(), inputs)[1])())


def endless_readings(memory, walk):
    """Readings of a map without edges, whose cells are forgotten where they leave the window; by cell (z, x)."""
    headings, is_move, view_rows = walk
    rules = Rules(headings=memory.headings, front_cell=memory.front_cell)
    view_offsets = rules.view_offsets(WINDOW_ROWS.view).reshape(memory.headings, -1, 2)
    distances = memory.stride * np.arange(-memory.reach, memory.reach + 1)
    read_offsets = rules.offsets_by_heading(distances, distances).reshape(memory.headings, -1, 2)
    half_size = memory.size // 2

    def is_in_window(cell, position):
        return all(-half_size <= distance < half_size for distance in np.subtract(cell, position))

    cell_states = {}
    position = np.zeros(2, int)
    readings = []
    for heading, moved, row in zip(headings, is_move, view_rows, strict=True):
        # Follow the agent, and forget the cells that leave the window.
        if moved:
            position = position + rules.move_steps()[heading]
        cell_states = {cell: state for cell, state in cell_states.items() if is_in_window(cell, position)}

        # Draw the view, in which the larger state wins, and the agent's own cell.
        for view_cell, offset in zip(np.asarray(WINDOW_ROWS.view_cells(row)), view_offsets[heading], strict=True):
            cell = tuple(position + offset)
            view_state = {VIEW_FREE: FREE, VIEW_BLOCKED: BLOCKED}.get(int(view_cell), UNKNOWN)
            cell_states[cell] = max(cell_states.get(cell, UNKNOWN), view_state)
        cell_states[tuple(position)] = VISITED

        # Read the cells around the agent.
        readings.append([cell_states.get(tuple(position + offset), UNKNOWN) for offset in read_offsets[heading]])
    return np.array(readings)


@pytest.mark.parametrize("headings", params_by_tier([4, 8, 12], fast=[12], slow=[4, 8]))
@pytest.mark.parametrize(("turn_prob", "front_cell"), [(0.0, "nearest"), (0.1, "nearest"), (0.1, "move")])
def test_walk_longer_than_the_map_is_read_as_on_a_map_without_edges(headings, turn_prob, front_cell):
    memory = SpatialMemory(headings, size=32, front_cell=front_cell)
    walk = draw_walk(headings, 150, headings, turn_prob)
    _, readings = record_readings(memory, walk)
    np.testing.assert_array_equal(readings, endless_readings(memory, walk))


def test_cells_never_entered_are_never_read_as_visited():
    """100 cells straight on, on the map of 64 x 64 cells: visited cells lie behind."""
    memory = SpatialMemory(12)
    walk = np.zeros(100, int), np.ones(100, bool), np.zeros((100, WINDOW_ROWS.num_bytes), np.uint8)
    _, readings = record_readings(memory, walk)
    side = 2 * memory.reach + 1
    readings = readings.reshape(-1, side, side)
    assert (readings[:, memory.reach + 1 :] != VISITED).all()
    assert (readings[-1, : memory.reach + 1, memory.reach] == VISITED).all()


def test_nothing_within_the_window_is_forgotten(monkeypatch):
    """Policies decide by the map, which stays bit-identical to a map without forgetting."""
    memory = SpatialMemory(8)
    walk = draw_walk(0, 180, 8, 0.6)
    maps, readings = record_readings(memory, walk)
    assert np.ptp(maps.position, axis=0).max() in range(10, memory.size // 2 - WINDOW_ROWS.view)
    monkeypatch.setattr(SpatialMemory, "_forget_left_cells", lambda self, cells, *_: cells)
    chex.assert_trees_all_equal((maps, readings), record_readings(memory, walk))


def test_maps_smaller_than_the_cells_that_are_read_are_refused():
    # Five cells on each side at a stride of two span 2 * 5 * 2 + 1 = 21 cells.
    assert SpatialMemory(8, size=21).size == 21
    with pytest.raises(ValueError, match="size is 20: the cells that are read span 21"):
        SpatialMemory(8, size=20)


# Policies


def test_one_hot_inputs():
    cell_states = jnp.array([UNKNOWN, BLOCKED, FREE, VISITED], jnp.uint8)
    expected = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(SpatialMemory.encode_surroundings(cell_states), np.concatenate(expected))


@pytest.mark.slow
def test_surroundings_enter_only_by_the_scene_and_are_reset_with_an_episode():
    spec = dataclasses.replace(tiny.SPEC, spatial_memory=SpatialMemory(8))
    agent_loop = AgentLoop(ENV, spec, tiny.ESTIMATOR)
    params = tiny.random_params(0, spec)

    @jax.jit
    def decide_and_step(key):
        # Pathways of the true surroundings, and of surroundings that were all visited.
        policy = agent_loop.bind(params)
        agent = agent_loop.start(key, 4, policy.initial_memory((4,)), KNOWLEDGE, PARAMS)
        inputs = agent_loop.policy_inputs(agent, KNOWLEDGE, PARAMS)
        assert inputs.surroundings is not None
        visited_inputs = inputs._replace(surroundings=jnp.full_like(inputs.surroundings, VISITED))
        memory = policy.initial_memory((4,))
        pathways = policy.pathways(inputs, memory)
        visited_pathways = policy.pathways(visited_inputs, memory)

        # Factual and counterfactual logits of the two.
        factual_logits = []
        counterfactual_logits = []
        for input_pathways in (pathways, visited_pathways):
            factual_logits.append(policy.decide(input_pathways, memory).logits)
            counterfactual_logits.append(policy.decide(do(input_pathways, scene=0.0, goal=0.0), memory).logits)

        # Two of the four episodes end and are reset.
        decision = policy.decide(pathways, memory)
        action = jnp.array([DONE, DONE, MOVE_AHEAD, MOVE_AHEAD])
        reset_keys = jax.random.split(key, 4)
        next_agent, _ = agent_loop.step(
            agent, action, KNOWLEDGE, PARAMS, policy=policy, decision=decision, reset_keys=reset_keys
        )
        return pathways, visited_pathways, factual_logits, counterfactual_logits, next_agent.perception.spatial_map

    # Surroundings change the scene and the factual logits, and nothing else.
    outputs = decide_and_step(jax.random.key(0))
    pathways, visited_pathways, factual_logits, counterfactual_logits, next_map = outputs
    assert not np.allclose(pathways.scene, visited_pathways.scene)
    chex.assert_trees_all_equal(pathways._replace(scene=0), visited_pathways._replace(scene=0))
    assert not np.allclose(*factual_logits)
    chex.assert_trees_all_equal(*counterfactual_logits)

    # A new episode has visited one cell, the centre of the map.
    num_visited = (np.asarray(next_map.cells) == VISITED).sum(axis=(1, 2))
    assert (num_visited[:2] == 1).all()
    np.testing.assert_array_equal(np.asarray(next_map.position)[:2], 32)


@pytest.mark.slow
def test_policy_without_spatial_memory_has_no_part_of_it():
    policy = bind(tiny.SPEC, tiny.random_params(0))
    assert policy.view.kernel.shape[0] == 2 * policy.row_format.view**2
    assert AgentLoop(ENV, tiny.SPEC).start(jax.random.key(0), 1, None, None, PARAMS).perception.spatial_map is None
    assert jaxnav.RunConfig(spatial_memory=False).policy_spec(22).spatial_memory is None


@pytest.mark.parametrize(("world", "front_cell"), [("rooms", "nearest"), ("apartments", "move"), ("houses", "move")])
def test_spatial_memory_of_a_run_draws_the_views_of_its_world(world, front_cell):
    config = jaxnav.RunConfig(world=world)
    assert config.policy_spec(22).spatial_memory == SpatialMemory(config.task.rules.headings, front_cell=front_cell)
