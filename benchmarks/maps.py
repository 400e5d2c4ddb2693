"""What SemExp's map and planner cost, and what they find without learning.

`python benchmarks/maps.py [WORLD ...] [--scenes 8] [--episodes 300]` times a map update and a plan at 64 x 64, and
searches in generated val scenes (all three worlds without arguments) with the agent's own body and no learned policy:

  nearest     the nearest frontier
  random      a random block every 25 actions
  truth       the nearest frontier, on a map that holds floor, walls and objects from the start
  level       nearest, without ever looking down
  far         nearest, but Done up to 1.45 m from the object's centre

Rates are percent. The result goes to stdout as JSON.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import report, seconds, spread

from jaxnav.env.build import build
from jaxnav.evaluation.episodes import EpisodeList, episode_list
from jaxnav.evaluation.grid import first_states
from jaxnav.policies.acting import Acting, select
from jaxnav.policies.methods import Knowledge
from jaxnav.policies.methods.home import cell_places, learn_home
from jaxnav.policies.methods.semexp import SEMEXP
from jaxnav.policies.semantic_map import FREE, WALL, Look, SemanticMap
from jaxnav.policies.spec import PolicySpec
from jaxnav.policies.wavefront import find_way, pack
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.worlds import WORLDS, generated

REPEATS, TURNS, NEAREST = 1000, 7, "jaxnav.policies.methods.semexp:NEAREST"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=list(WORLDS))
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=300)
    options = parser.parse_args()
    found = {world: searched(world, options.scenes, options.episodes) for world in options.worlds}
    report({"microseconds": costs(), "found": found})


def costs(size: int = 64) -> dict[str, Any]:
    """Return microseconds of one update and one plan, on their own."""
    generator, row_format, around = np.random.default_rng(0), RowFormat(22), SemanticMap(size)
    row = jnp.asarray(generator.integers(0, 256, row_format.num_bytes, np.uint8))
    passable = pack(jnp.asarray(generator.random((size, size)) < 0.7))
    target = pack(jnp.zeros((size, size), bool).at[3, 3].set(True))

    def look(i: jax.Array, cells: jax.Array) -> jax.Array:
        return around.update(cells, Look(row, jnp.array([30, 30]) + i % 5, i % 12), row_format, 12)

    def plan(i: jax.Array, total: jax.Array) -> jax.Array:
        return total + find_way(target, passable, jnp.array([20, 20]) + i % 20).length

    loops = {
        "update": jax.jit(lambda: jax.lax.fori_loop(0, REPEATS, look, around.init())),
        "plan": jax.jit(lambda: jax.lax.fori_loop(0, REPEATS, plan, jnp.int32(0))),
    }
    steps = int(loops["plan"]()) / REPEATS
    jax.block_until_ready(loops["update"]())
    taken = {name: spread([1e6 * seconds(loop) / REPEATS for _ in range(TURNS)]) for name, loop in loops.items()}
    return taken | {"steps_of_a_plan": steps}


def searched(world: str, count: int, num_episodes: int) -> dict[str, dict[str, float]]:
    """Return what every search finds in val scenes of a world."""
    preset, all_scenes = WORLDS[world], generated(world, "val", count)
    scenes = [all_scenes[i] for i in range(count)]
    bank = compile_bank(scenes, preset.task)
    env, params = build(bank, {"living_room": preset.large_step_limit}, preset.step_limit)
    episodes, learned = episode_list(bank, num_episodes, seed=0), learn_home([bank], np.zeros(0))
    variants: dict[str, tuple[str, dict[str, Any]]] = {
        "nearest": (NEAREST, {}),
        "random": ("semexp", {}),
        "truth": (NEAREST, {}),
        "level": (NEAREST, {"horizons": np.int32(1)}),
        "far": (NEAREST, {"enough": np.float32(1.45)}),
    }
    found = {}
    for name, (method, change) in variants.items():
        acting = Acting(env, PolicySpec(method, len(env.categories)))
        prior = jnp.zeros((1, *2 * [len(env.categories)]))
        known = Knowledge(prior, jax.tree.map(jnp.asarray, learned | change))
        maps = true_maps(scenes, bank, episodes, len(learned["lines"])) if name == "truth" else None
        found[name] = run(acting, bank, episodes, known, params, maps)
    return found


def run(
    acting: Acting, bank: Bank, episodes: EpisodeList, known: Knowledge, params: Any, maps: Any
) -> dict[str, float]:
    """Act until all episodes have ended."""
    count, choices = len(episodes.pose), SEMEXP.control.num_choices

    @jax.jit
    def act() -> tuple[jax.Array, jax.Array]:
        agent = acting.begin(first_states(episodes), None, known, params)
        if maps is not None:
            note = agent.perceived.note._replace(cells=agent.perceived.note.cells | maps)
            agent = agent._replace(perceived=agent.perceived._replace(note=note))

        def step(state: tuple[Any, ...]) -> tuple[Any, ...]:
            agent, running, success, length = state
            choice = jax.random.randint(jax.random.fold_in(jax.random.key(0), length.max()), (count,), 0, choices)
            after, taken = acting.step(agent, choice, known, params)
            success, length = success | (running & taken.success), length + running.astype(jnp.int32)
            return select(running, after, agent), running & ~taken.ended, success, length

        state = agent, jnp.ones(count, bool), jnp.zeros(count, bool), jnp.zeros(count, jnp.int32)
        return jax.lax.while_loop(lambda state: state[1].any(), step, state)[2:]

    success, length = map(np.asarray, act())
    best = bank.best_length[episodes.pose, episodes.goal]
    spl = success * best / np.maximum(length, best)
    return {"sr": 100 * float(success.mean()), "spl": 100 * float(spl.mean()), "length": float(length.mean())}


def true_maps(scenes: list[Scene], bank: Bank, episodes: EpisodeList, size: int) -> jax.Array:
    """Return what there is around the start of every episode, uint32 [E, N, N]."""
    places, maps = cell_places(bank.ahead, bank.task.rules.steps()), {}
    for scene in scenes:
        if scene.name not in bank.names:
            continue
        first = standable_cells(scene.reach)[0]
        index = bank.names.index(scene.name)
        cells = places[bank.first_cell[index] : bank.first_cell[index] + bank.num_cells[index]] % size
        words = np.full((size, size), WALL, np.uint32)
        words[tuple(cells.T)] = FREE
        at = np.rint((scene.boxes[:, [2, 0]] - np.array(scene.origin)[::-1]) / CELL).astype(int) - first
        for category, (z, x) in zip(category_ids(scene.types, bank.task.categories), at % size, strict=True):
            words[z, x] |= np.uint32(1 << category) if category >= 0 else np.uint32(0)
        maps[index] = words
    starts = size // 2 - places[episodes.pose // bank.task.rules.poses_per_cell]
    turned = [np.roll(maps[s], start, (0, 1)) for s, start in zip(episodes.scene.tolist(), starts, strict=True)]
    return jnp.asarray(np.stack(turned))


if __name__ == "__main__":
    main()
