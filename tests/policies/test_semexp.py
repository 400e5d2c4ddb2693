"""SemExp: the walk to what was chosen, Done by the map, when choices count, and where the layout enters."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, FRIDGE, corridor_scene

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Percept
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import (
    BLOCKS_PER_SIDE,
    FREE_BIT,
    GOAL_CONFIRMED,
    TRIED_BIT,
    WALL_BIT,
    MapTracker,
    category_bit,
)
from jaxnav.policies.methods.semexp import (
    SEMEXP,
    cell_positions,
    check_map_size,
    learn_search_setup,
    required_map_sizes,
)
from jaxnav.policies.network import bind
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.tables.observation_row import PERFECT_DETECTOR
from jaxnav.scenes.task import DONE, LOOK_DOWN, MOVE_AHEAD, Rules, Task
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

SPEC = dataclasses.replace(tiny.SPEC, method=find_method("semexp"), method_sizes=())
#: A corridor along z, one cell wide, a book at its north end.
CORRIDOR = corridor_scene(24)
BANK = compile_bank([CORRIDOR], Task(CATEGORIES, detector=PERFECT_DETECTOR))
ENV, PARAMS = build_environment(BANK, {}, 100)
PER_CELL = tiny.POSES_PER_CELL


def knowledge_of(bank=BANK):
    return tiny.knowledge()._replace(method=jax.tree.map(jnp.asarray, learn_search_setup([bank], np.zeros(0))))


@functools.lru_cache
def acting(method="semexp", env=ENV):
    return AgentLoop(env, dataclasses.replace(SPEC, method=find_method(method), num_categories=len(env.categories)))


def walk(start, choices):
    """Agents and actions of an episode in the corridor, given one choice for every step, and what came of it."""
    agents, actions = [jax.jit(acting().start_from)(State(*start), None, knowledge_of(), PARAMS)], []
    step = jax.jit(acting().step)
    step_result = None
    for choice in choices:
        after, step_result = step(agents[-1], jnp.array([choice], jnp.int32), knowledge_of(), PARAMS)
        actions.append(int(acted(agents[-1], choice)[0]))
        agents.append(after)
        if bool(step_result.ended[0]):
            break
    assert step_result is not None
    return agents, actions, step_result


@jax.jit
def acted(agent, choice):
    note = jax.tree.map(lambda leaf: leaf[0], agent.perception.tracker_state)
    return SEMEXP.control.act(jnp.int32(choice), note, knowledge_of())


def state_at(cell, heading, goal=BOOK):
    return [jnp.array([number], jnp.int32) for number in ((cell * 8 + heading) * 2, 0, goal, 0)]


def block_ahead(dz):
    """The choice of the block with the cell dz lines north of the agent: lines -N / 2 to N / 2 - 1, N / 8 a block."""
    size = len(knowledge_of().method["lines"])
    return (size // 2 + dz) // (size // BLOCKS_PER_SIDE) * BLOCKS_PER_SIDE + BLOCKS_PER_SIDE // 2


def test_the_agent_looks_down_walks_north_and_says_done_once_the_book_is_near_and_was_seen_before():
    agents, actions, step_result = walk(state_at(10, 0), [block_ahead(10)] * 60)
    assert actions[0] == LOOK_DOWN
    assert actions[-1] == DONE
    assert bool(step_result.success[0])
    # From line 10 to the first within 1.45 m of the book in line 23, 5.75 m: 4.5 m is line 18. Eight steps.
    assert actions == [LOOK_DOWN] + 8 * [MOVE_AHEAD] + [DONE]
    assert int(agents[-2].perception.tracker_state.goal_sight[0]) == GOAL_CONFIRMED


def test_a_first_sight_nearby_is_not_enough():
    """At line 20 the book is 0.75 m away and in view at once; a second pose has to agree."""
    _, actions, step_result = walk(state_at(20, 0), [block_ahead(1)] * 60)
    assert actions[0] != DONE
    assert actions[-1] == DONE
    assert len(actions) <= 4
    assert bool(step_result.success[0])


def test_choices_count_only_when_they_are_due():
    due, goal = LocalPolicy().is_decision_step, FRIDGE  # which is not there, so that the episode goes on
    north = walk(state_at(2, 4, goal), [block_ahead(20)] * 40)
    counted = [bool(due(agent.perception.tracker_state)[0]) for agent in north[0]]
    second = counted.index(True, 1)
    assert counted[0]
    assert second <= LocalPolicy().interval
    others = walk(state_at(2, 4, goal), [block_ahead(20), *range(second - 1)])
    assert north[1][:second] == others[1]


def test_nothing_is_chosen_while_the_goal_is_on_the_map():
    """It is in the first view, so no choice counts; as soon as the mark is cleared one is due."""
    agents, actions, _ = walk(state_at(10, 0), [block_ahead(10)] * 60)
    notes = [jax.tree.map(lambda leaf: leaf[0], agent.perception.tracker_state) for agent in agents]
    assert not any(bool(LocalPolicy().is_decision_step(note)) for note in notes)
    assert walk(state_at(10, 0), range(60))[1] == actions
    forgotten = notes[0]._replace(cells=notes[0].cells & ~category_bit(notes[0].goal))
    assert bool(LocalPolicy().is_decision_step(forgotten))


def test_the_planner_goes_by_the_map_and_not_by_the_walls():
    """A wall in no view is walked into, and a wall that is only on the map is not."""
    agents, _, _ = walk(state_at(10, 0), [block_ahead(10)] * 4)
    note = jax.tree.map(lambda leaf: leaf[0], agents[-1].perception.tracker_state)
    act = jax.jit(lambda note: SEMEXP.control.act(jnp.int32(0), note, knowledge_of())[0])
    assert int(act(note)) == MOVE_AHEAD
    # The whole line ahead is blocked on the map: the way there is round the map's other edge, so it turns.
    imagined = note._replace(cells=note.cells.at[(note.position[0] + 1) % len(note.cells)].set(WALL_BIT))
    assert int(act(imagined)) != MOVE_AHEAD
    assert list(SEMEXP.control.act.__code__.co_varnames[1:4]) == ["choice", "state", "knowledge"]


def test_the_long_term_goal_is_kept_for_n_actions():
    """In a room without an end the block stays worth exploring: the choice counts every 25 actions."""
    note = MapTracker().init(knowledge_of())._replace(search_horizon=jnp.int32(0))
    act = jax.jit(lambda note: SEMEXP.control.act(jnp.int32(block_ahead(20)), note, knowledge_of())[1])
    due = []
    for _ in range(51):
        due.append(bool(SEMEXP.control.is_decision_step(note)))
        note = act(note)
        note = note._replace(actions_left=jnp.maximum(note.actions_left - 1, 0))  # as the tracker counts
    assert np.flatnonzero(due).tolist() == [0, 25, 50]


def test_where_the_goal_was_looked_at_in_vain_is_left():
    """Behind the agent's back nothing clears the mark, but standing there and facing it does, after three tries."""
    agents, _, _ = walk(state_at(4, 0), [block_ahead(3)] * 2)
    note = jax.tree.map(lambda leaf: leaf[0], agents[-1].perception.tracker_state)
    z, x = np.asarray(note.position)
    here = note._replace(cells=note.cells.at[z + 1, x].set(FREE_BIT | np.uint32(1 << BOOK)))
    act = jax.jit(lambda note: SEMEXP.control.act(jnp.int32(0), note, knowledge_of())[1])
    once = act(here)
    assert int(once.cells[z, x]) & int(TRIED_BIT)
    assert int(once.failed_views) == 1
    assert int(once.cells[z + 1, x]) & 1 << BOOK
    last = act(here._replace(failed_views=jnp.int32(2)))
    assert int(last.failed_views) == 0
    assert not int(last.cells[z + 1, x]) & 1 << BOOK


def test_a_mark_is_cleared_from_a_cell_once():
    """A mark that comes back, seen at another heading, stays after that, or the agent would turn to and fro."""
    agents, _, _ = walk(state_at(4, 0, FRIDGE), [block_ahead(3)] * 2)
    note = jax.tree.map(lambda leaf: leaf[0], agents[-1].perception.tracker_state)
    z, x = np.asarray(note.position)
    pose = jnp.int32(agents[-1].state.pose[0])
    percept = Percept(
        PARAMS.tables.rows[pose], note.heading, jnp.int32(LOOK_DOWN), jnp.bool_(False), note.horizon, note.goal
    )

    @jax.jit
    def looked(note):
        """Return the note after one more view of the floor ahead, marked with the fridge before."""
        marked = note.cells.at[z + 1, x].set(note.cells[z + 1, x] | np.uint32(1 << FRIDGE))
        return MapTracker().update(note._replace(cells=marked), knowledge_of(), percept)

    def has(note, dz, bit):
        return bool(note.cells[z + dz, x] & bit)

    assert not has(note, 0, TRIED_BIT)
    first = looked(note)
    assert has(first, 0, TRIED_BIT)
    assert not has(first, 1, np.uint32(1 << FRIDGE))
    second = looked(first)
    assert has(second, 0, TRIED_BIT)
    assert has(second, 1, np.uint32(1 << FRIDGE))


@pytest.mark.slow
def test_the_layout_enters_by_the_categories_on_the_map_alone():
    weights = tiny.random_params(0, SPEC)
    policy = bind(SPEC, weights)
    agents, _, _ = walk(state_at(10, 0), [block_ahead(10)] * 8)
    view = acting().policy_inputs(agents[-1], knowledge_of(), PARAMS)
    assert int(np.bitwise_or.reduce(np.asarray(view.reading.blocks[0]))) & 1 << BOOK
    plain = policy.pathways(view)
    louder = policy.pathways(view._replace(layout_weights=view.layout_weights.at[:, BOOK].set(3.0)))
    assert np.abs(plain.experience - louder.experience).max() > 1e-3
    np.testing.assert_array_equal(plain.scene, louder.scene)
    np.testing.assert_array_equal(plain.goal, louder.goal)
    # The categories on the map are no part of the direct pathway; floor and walls are no part of Z.
    bare = view._replace(reading=view.reading._replace(blocks=view.reading.blocks & ~np.uint32(7)))
    np.testing.assert_array_equal(plain.scene, policy.pathways(bare).scene)
    flat = view._replace(reading=view.reading._replace(blocks=view.reading.blocks & np.uint32(7)))
    np.testing.assert_array_equal(plain.experience, policy.pathways(flat).experience)
    assert np.abs(plain.scene - policy.pathways(flat).scene).max() > 1e-3


@pytest.mark.parametrize("world", ["rooms", "houses"])
def test_cells_lie_where_they_lie_in_the_scene(world):
    scene = make_generated_scenes(world, "train", 1)[0]
    bank, cells = compile_bank([scene], WORLDS[world].task), standable_cells(scene.reach)
    np.testing.assert_array_equal(cell_positions(bank.ahead, bank.task.rules.move_steps()), cells - cells[0])


def test_bad_input_is_refused_by_name():
    with pytest.raises(InputError, match="interval is 0; give 1 action or more"):
        LocalPolicy(interval=0)
    # 24 lines and the 11 of a view.
    assert required_map_sizes(BANK) == {"drawn": 35}
    small = knowledge_of()._replace(method={"lines": jnp.arange(32)})
    with pytest.raises(InputError, match="scene drawn needs a map of 35 cells, and that of the training homes has 32"):
        check_map_size(small, BANK)
    check_map_size(knowledge_of(), BANK)
    for headings in (4, 6):
        turned = BANK._replace(task=Task(CATEGORIES, rules=Rules(headings=headings)), ahead=BANK.ahead[:, :headings])
        with pytest.raises(InputError, match=f"has {headings} headings, .* eight neighbours; give 8 or 12"):
            learn_search_setup([turned], np.zeros(0))
    crowded = BANK._replace(task=Task(tuple(f"Thing{i}" for i in range(28))))
    with pytest.raises(InputError, match="28 categories, and a map holds 27; leave some out"):
        learn_search_setup([crowded], np.zeros(0))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["apartments", "houses"])
def test_homes_are_searched_without_learning(world):
    """The nearest frontier finds most goals; without looking down, or with Done too far away, few of them."""
    preset, count = WORLDS[world], 60
    scenes = make_generated_scenes(world, "val", 3)
    bank = compile_bank([scenes[i] for i in range(3)], preset.task)
    env, params = build_environment(bank, {}, preset.step_limit)
    knowledge = knowledge_of(bank)
    act = acting("jaxnav.policies.methods.semexp:NEAREST", env)
    prior = jnp.ones((6, len(env.categories), len(env.categories)))

    @jax.jit
    def success(start, method):
        knowledge_ = knowledge._replace(layout=prior, method=method)
        agent = act.start_from(start, None, knowledge_, params)

        def step(carry):
            agent, running, has_found = carry
            after, step_result = act.step(agent, jnp.zeros(count, jnp.int32), knowledge_, params)
            return (
                tree_where(running, after, agent),
                running & ~step_result.ended,
                has_found | (running & step_result.success),
            )

        running = jnp.ones(count, bool)
        return jax.lax.while_loop(lambda carry: carry[1].any(), step, (agent, running, ~running))[2].mean()

    start = start_states(draw_episodes(bank, count, seed=0))
    assert float(success(start, knowledge.method)) > 0.85
    far = knowledge.method | {"enough": jnp.float32(1.45)}
    assert float(success(start, far)) < 0.6
    if world == "apartments":
        level = knowledge.method | {"horizons": jnp.int32(1)}
        assert float(success(start, level)) < 0.2
