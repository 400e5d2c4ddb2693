"""The spatial memory against the true plan of a room, and what a policy makes of it."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, KNOWLEDGE, PARAMS
from support.tiers import params_by_tier

import jaxnav
from jaxnav.causal import do
from jaxnav.env.make import build_environment
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.network import bind
from jaxnav.policies.spatial_memory import BLOCKED, FREE, UNKNOWN, VISITED, SpatialMemory
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat
from jaxnav.scenes.task import DONE, MOVE_AHEAD, NUM_ACTIONS, Rules
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

STEPS, WALKS = 60, 8


@pytest.fixture(scope="module", params=["rooms", "apartments"])
def walked(request):
    """Maps after random walks in a generated scene, and the cells that were visited; 8 and 12 headings."""
    task = WORLDS[request.param].task
    scene = make_generated_scenes(request.param, "train", 1)[0]
    env, params = build_environment(compile_bank([scene], task), {}, 10**6)
    memory = SpatialMemory(task.rules.headings, front_cell=task.rules.front_cell)
    acting = AgentLoop(env, dataclasses.replace(tiny.SPEC, num_categories=len(task.categories), spatial_memory=memory))

    @jax.jit
    def walk(key):
        start = acting.start(key, WALKS, None, None, params)

        def step(agent, key):
            draw = jax.random.randint(key, (WALKS,), 0, NUM_ACTIONS - 1)
            agent, _ = acting.step(agent, jnp.where(draw % 2 == 0, MOVE_AHEAD, draw), None, params)
            return agent, env.cell_of_pose(agent.state.pose)

        agent, cells = jax.lax.scan(step, start, jax.random.split(key, STEPS))
        return agent.perception.spatial_map, jnp.concatenate([env.cell_of_pose(start.state.pose)[None], cells])

    explored, cells = jax.tree.map(np.asarray, walk(jax.random.key(0)))
    return scene, memory, env, explored, cells


def expected_map(explored, walk, start):
    """What is known of each cell, by its offset (dz, dx) from the first one."""
    size = explored.cells.shape[-1]
    return {
        tuple(cell - size // 2 + start): explored.cells[walk][tuple(cell)]
        for cell in np.argwhere(explored.cells[walk] != UNKNOWN)
    }


def test_the_map_agrees_with_the_room(walked):
    scene, _, _, explored, cells = walked
    standable = standable_cells(scene.reach)
    inside = set(map(tuple, standable))
    for walk in range(WALKS):
        result = expected_map(explored, walk, standable[cells[0, walk]])
        assert {cell for cell, code in result.items() if code == VISITED} == {
            tuple(standable[c]) for c in cells[:, walk]
        }
        assert {cell for cell, code in result.items() if code == FREE} <= inside
        assert not {cell for cell, code in result.items() if code == BLOCKED} & inside
        assert len(result) > len(set(cells[:, walk]))  # seen from afar


@pytest.mark.slow
def test_what_is_read_is_the_map_turned_with_the_agent(walked):
    _, memory, env, explored, _ = walked
    side = 2 * memory.reach + 1
    read = np.asarray(jax.vmap(memory.read)(explored)).reshape(WALKS, side, side)
    assert (read[:, memory.reach, memory.reach] == VISITED).all()  # where it stands
    assert memory.num_inputs == 3 * side * side
    headings = env.task.rules.headings
    for walk in range(WALKS):
        quarter, rest = divmod(int(explored.heading[walk]), headings // 4)
        if rest:
            continue  # not along an axis of the lattice
        # North is +z. Facing it, ahead is +z and right is +x; a quarter turn right faces +x.
        turned = np.rot90(explored.cells[walk], -quarter)
        z, x = explored.position[walk]
        for _ in range(quarter):
            z, x = x, len(turned) - 1 - z
        along = memory.stride * np.arange(-memory.reach, memory.reach + 1)
        np.testing.assert_array_equal(read[walk], turned[np.ix_((z + along) % 64, (x + along) % 64)])


# The window that moves with the agent


WINDOW_ROWS = RowFormat(1)


def draw_walk(seed, num_steps, headings, turn_prob):
    """Headings, moves and views of a walk, drawn at random; views differ from step to step."""
    generator = np.random.default_rng(seed)
    turns = generator.choice([-1, 0, 1], num_steps, p=[turn_prob / 2, 1 - turn_prob, turn_prob / 2])
    is_move = generator.random(num_steps) < 0.8
    view_rows = generator.integers(0, 256, (num_steps, WINDOW_ROWS.num_bytes)).astype(np.uint8)
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
    half = memory.size // 2
    cell_states = {}
    position = np.zeros(2, int)
    readings = []
    for heading, moved, row in zip(headings, is_move, view_rows, strict=True):
        position = position + (rules.move_steps()[heading] if moved else 0)
        cell_states = {
            cell: state
            for cell, state in cell_states.items()
            if all(-half <= distance < half for distance in np.subtract(cell, position))
        }
        for view_cell, offset in zip(np.asarray(WINDOW_ROWS.view_cells(row)), view_offsets[heading], strict=True):
            cell = tuple(position + offset)
            view_state = {VIEW_FREE: FREE, VIEW_BLOCKED: BLOCKED}.get(int(view_cell), UNKNOWN)
            cell_states[cell] = max(cell_states.get(cell, UNKNOWN), view_state)
        cell_states[tuple(position)] = VISITED
        readings.append([cell_states.get(tuple(position + offset), UNKNOWN) for offset in read_offsets[heading]])
    return np.array(readings)


@pytest.mark.parametrize("headings", params_by_tier([4, 8, 12], fast=[12], slow=[4, 8]))
@pytest.mark.parametrize(("turn_prob", "front_cell"), [(0.0, "nearest"), (0.1, "nearest"), (0.1, "move")])
def test_a_walk_longer_than_the_map_is_read_as_on_a_map_without_edges(headings, turn_prob, front_cell):
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
    assert (readings.reshape(-1, side, side)[:, memory.reach + 1 :] != VISITED).all()
    assert (readings.reshape(-1, side, side)[-1, : memory.reach + 1, memory.reach] == VISITED).all()


def test_within_the_window_nothing_is_forgotten(monkeypatch):
    """Policies decide by the map, which stays bit-identical to that without forgetting."""
    memory = SpatialMemory(8)
    walk = draw_walk(0, 180, 8, 0.6)
    explored, readings = record_readings(memory, walk)
    assert np.ptp(explored.position, axis=0).max() in range(10, memory.size // 2 - WINDOW_ROWS.view)
    monkeypatch.setattr(SpatialMemory, "_forget_left_cells", lambda self, cells, *_: cells)
    chex.assert_trees_all_equal((explored, readings), record_readings(memory, walk))


def test_one_hot_inputs():
    codes = jnp.array([UNKNOWN, BLOCKED, FREE, VISITED], jnp.uint8)
    expected = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(SpatialMemory.encode_surroundings(codes), np.concatenate(expected))


@pytest.mark.slow
def test_the_surroundings_enter_by_the_scene_alone_and_start_anew_with_an_episode():
    spec = dataclasses.replace(tiny.SPEC, spatial_memory=SpatialMemory(8))
    acting, weights = AgentLoop(ENV, spec, tiny.ESTIMATOR), tiny.random_params(0, spec)

    @jax.jit
    def go(key):
        policy = acting.bind(weights)
        agent = acting.start(key, 4, policy.initial_memory((4,)), KNOWLEDGE, PARAMS)
        view = acting.policy_inputs(agent, KNOWLEDGE, PARAMS)
        assert view.surroundings is not None
        elsewhere = view._replace(surroundings=jnp.full_like(view.surroundings, VISITED))
        memory = policy.initial_memory((4,))
        embedded = policy.pathways(view, memory), policy.pathways(elsewhere, memory)
        direct = [policy.decide(pathways, memory).logits for pathways in embedded]
        alone = [policy.decide(do(pathways, scene=0.0, goal=0.0), memory).logits for pathways in embedded]
        decision = policy.decide(embedded[0], memory)
        done = jnp.array([DONE, DONE, MOVE_AHEAD, MOVE_AHEAD])
        keys = jax.random.split(key, 4)
        after, _ = acting.step(agent, done, KNOWLEDGE, PARAMS, policy=policy, decision=decision, reset_keys=keys)
        return embedded, direct, alone, after

    embedded, direct, alone, after = go(jax.random.key(0))
    assert not np.allclose(embedded[0].scene, embedded[1].scene)
    chex.assert_trees_all_equal(embedded[0]._replace(scene=0), embedded[1]._replace(scene=0))
    assert not np.allclose(*direct)
    chex.assert_trees_all_equal(*alone)
    # A new episode has visited one cell.
    visited = (np.asarray(after.perception.spatial_map.cells) == VISITED).sum(axis=(1, 2))
    assert (visited[:2] == 1).all()
    np.testing.assert_array_equal(np.asarray(after.perception.spatial_map.position)[:2], 32)


@pytest.mark.slow
def test_a_policy_without_it_has_no_part_of_it():
    policy = bind(tiny.SPEC, tiny.random_params(0))
    assert policy.view.kernel.shape[0] == 2 * policy.row_format.view**2
    assert AgentLoop(ENV, tiny.SPEC).start(jax.random.key(0), 1, None, None, PARAMS).perception.spatial_map is None
    assert jaxnav.RunConfig(spatial_memory=False).policy_spec(22).spatial_memory is None


@pytest.mark.parametrize(("world", "front_cell"), [("rooms", "nearest"), ("apartments", "move"), ("houses", "move")])
def test_the_memory_of_a_run_draws_the_views_of_its_world(world, front_cell):
    config = jaxnav.RunConfig(world=world)
    assert config.policy_spec(22).spatial_memory == SpatialMemory(config.task.rules.headings, front_cell=front_cell)
