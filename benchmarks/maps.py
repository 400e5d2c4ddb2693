"""Cost of SemExp's map and planner, and their success without learning.

`python benchmarks/maps.py [WORLD ...]` times a map update and a plan at 64 x 64, and searches in generated val scenes
(all three worlds without arguments) with the agent's own body and no learned policy:

  nearest     the nearest frontier
  random      a random block every 25 actions
  truth       the nearest frontier, on a map with floor, walls and objects from the start
  level       nearest, without ever looking down
  far         nearest, but Done up to 1.45 m from the object's centre

Rates are percent. The result goes to stdout as JSON.
"""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report, summarize, time_call

from jaxnav.env.make import build_environment
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.map_tracker import FREE_BIT, WALL_BIT, draw_view, make_view_table
from jaxnav.policies.methods.semexp import SEMEXP, cell_positions, learn_search_setup
from jaxnav.policies.spec import PolicySpec
from jaxnav.policies.wavefront import find_path, pack_board
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import HOUSES
from jaxnav.scenes.worlds import WORLDS, make_generated_scenes

#: Updates or plans in a timed call.
REPEATS = 1000
TURNS = 7
NUM_SCENES = 8
NUM_EPISODES = 300
NEAREST = "jaxnav.policies.methods.semexp:NEAREST"


def main(world_names: list[str]) -> None:
    results = {name: run_searches(name) for name in world_names or WORLDS}
    print_report({"microseconds": measure_costs(), "found": results})


def measure_costs(size: int = 64) -> dict[str, Any]:
    """Return the microseconds of one map update and of one plan."""
    # Random observations and a random map.
    rng = np.random.default_rng(0)
    row_format = RowFormat(22)
    view_table = make_view_table(HOUSES.rules, row_format.view)
    row = jnp.asarray(rng.integers(0, 256, row_format.num_bytes, np.uint8))
    passable = pack_board(jnp.asarray(rng.random((size, size)) < 0.7))
    target = pack_board(jnp.zeros((size, size), bool).at[3, 3].set(True))

    # Positions change from call to call, so that the loop cannot be simplified.
    def update_map(i: jax.Array, cells: jax.Array) -> jax.Array:
        return draw_view(cells, row, jnp.array([30, 30]) + i % 5, i % 12, row_format, view_table)

    def plan(i: jax.Array, total_length: jax.Array) -> jax.Array:
        return total_length + find_path(target, passable, jnp.array([20, 20]) + i % 20).length

    loops = {
        "update": jax.jit(lambda: jax.lax.fori_loop(0, REPEATS, update_map, jnp.zeros((size, size), jnp.uint32))),
        "plan": jax.jit(lambda: jax.lax.fori_loop(0, REPEATS, plan, jnp.int32(0))),
    }
    mean_length = int(loops["plan"]()) / REPEATS
    jax.block_until_ready(loops["update"]())
    costs: dict[str, Any] = {}
    for name, loop in loops.items():
        costs[name] = summarize([1e6 * time_call(loop) / REPEATS for _ in range(TURNS)])
    return costs | {"steps_of_a_plan": mean_length}


def run_searches(world_name: str) -> dict[str, dict[str, float]]:
    """Return the results of every search in val scenes of a world."""
    world = WORLDS[world_name]
    split = make_generated_scenes(world_name, "val", NUM_SCENES)
    scenes = [split[index] for index in range(NUM_SCENES)]
    bank = compile_bank(scenes, world.task)
    env, params = build_environment(bank, {"living_room": world.large_step_limit}, world.step_limit)
    episodes = draw_episodes(bank, NUM_EPISODES, seed=0)
    search_setup = learn_search_setup([bank], np.zeros(0))

    # Method of each search, and its changes to the search setup.
    num_categories = len(env.categories)
    variants: dict[str, tuple[str, dict[str, Any]]] = {
        "nearest": (NEAREST, {}),
        "random": ("semexp", {}),
        "truth": (NEAREST, {}),
        "level": (NEAREST, {"horizons": np.int32(1)}),
        "far": (NEAREST, {"enough": np.float32(1.45)}),
    }
    results = {}
    for name, (method_name, changes) in variants.items():
        agent_loop = AgentLoop(env, PolicySpec(find_method(method_name), num_categories))
        prior = jnp.zeros((1, num_categories, num_categories))
        knowledge = Knowledge(prior, jax.tree.map(jnp.asarray, search_setup | changes))
        map_size = len(search_setup["lines"])
        maps = draw_true_maps(scenes, bank, episodes, map_size) if name == "truth" else None
        results[name] = run_episodes(agent_loop, bank, episodes, knowledge, params, maps)
    return results


def run_episodes(
    agent_loop: AgentLoop, bank: Bank, episodes: EpisodeList, knowledge: Knowledge, params: Any, maps: Any
) -> dict[str, float]:
    """Act until all episodes have ended.

    Args:
      agent_loop: how to act; choices are drawn at random.
      bank: tables of the scenes.
      episodes: the E episodes.
      knowledge: setup of the search.
      params: of the environment.
      maps: known from the start, uint32 [E, N, N]; None for empty ones.

    Returns:
      Success and SPL in percent, and the mean number of actions.
    """
    num_episodes = len(episodes.pose)
    num_choices = SEMEXP.control.num_choices

    @jax.jit
    def act() -> tuple[jax.Array, jax.Array]:
        # Start all episodes, with complete maps where given.
        agent = agent_loop.start_from(start_states(episodes), None, knowledge, params)
        if maps is not None:
            tracker_state = agent.perception.tracker_state
            tracker_state = tracker_state._replace(cells=tracker_state.cells | maps)
            agent = agent._replace(perception=agent.perception._replace(tracker_state=tracker_state))

        def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            agent, running, success, length = carry
            choice_key = jax.random.fold_in(jax.random.key(0), length.max())
            choice = jax.random.randint(choice_key, (num_episodes,), 0, num_choices)

            # Episodes that have ended keep their agent.
            next_agent, result = agent_loop.step(agent, choice, knowledge, params)
            success = success | (running & result.success)
            length = length + running.astype(jnp.int32)
            return tree_where(running, next_agent, agent), running & ~result.ended, success, length

        running = jnp.ones(num_episodes, bool)
        success = jnp.zeros(num_episodes, bool)
        length = jnp.zeros(num_episodes, jnp.int32)
        start = (agent, running, success, length)
        _, _, success, length = jax.lax.while_loop(lambda carry: carry[1].any(), step, start)
        return success, length

    success, length = map(np.asarray, act())
    best_length = bank.best_length[episodes.pose, episodes.goal]
    spl = success * best_length / np.maximum(length, best_length)
    return {"sr": 100 * float(success.mean()), "spl": 100 * float(spl.mean()), "length": float(length.mean())}


def draw_true_maps(scenes: list[Scene], bank: Bank, episodes: EpisodeList, map_size: int) -> jax.Array:
    """Return the complete map around the start of every episode, uint32 [E, N, N]."""
    # Maps of the scenes, by index in the bank; the first standable cell is the origin of the cell positions.
    positions = cell_positions(bank.ahead, bank.task.rules.move_steps())
    maps = {}
    for scene in scenes:
        if scene.name not in bank.names:
            continue
        scene_index = bank.names.index(scene.name)
        first_cell = bank.first_cell[scene_index]
        free_cells = positions[first_cell : first_cell + bank.num_cells[scene_index]] % map_size
        scene_map = np.full((map_size, map_size), WALL_BIT, np.uint32)
        scene_map[tuple(free_cells.T)] = FREE_BIT

        # Each object marks the cell of its centre.
        origin_cell = standable_cells(scene.reach)[0]
        centres = scene.boxes[:, [2, 0]] - np.array(scene.origin)[::-1]
        object_cells = (np.rint(centres / CELL_SIZE).astype(int) - origin_cell) % map_size
        categories = category_ids(scene.types, bank.task.categories)
        for category, (z, x) in zip(categories, object_cells, strict=True):
            if category >= 0:
                scene_map[z, x] |= np.uint32(1 << category)
        maps[scene_index] = scene_map

    # The agent's map is toroidal, with the start in its middle.
    offsets = map_size // 2 - positions[episodes.pose // bank.task.rules.poses_per_cell]
    episode_maps = []
    for scene_index, offset in zip(episodes.scene.tolist(), offsets, strict=True):
        episode_maps.append(np.roll(maps[scene_index], offset, (0, 1)))
    return jnp.asarray(np.stack(episode_maps))


if __name__ == "__main__":
    main(sys.argv[1:])
