"""Speed, memory and compile time as the problem grows.

`python benchmarks/growth.py` varies each axis alone around the default configuration, every point in a process of its
own: random steps of the environment alone, the row consumed and not stored, and whole updates of the arm with the
layout. Peaks are of resident memory, with Python, JAX, its compiler and the scenes. Scenes beyond the default are
copies of the default bank's tables under indices of their own, which the host holds besides; categories beyond it are
names that nothing has. `chunks` trains on in one process, whose memory must not grow. Runs stop after three, or once
they have taken a few seconds: the largest points are timed once, without warm-up.
"""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
from _common import peak_resident_gb, report, seconds, spread
from _phases import Program, program, update
from _setup import set_up

from jaxnav.env.build import build
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.runs.config import RunConfig, WorldConfig
from jaxnav.scenes.categories import ITHOR_CATEGORIES
from jaxnav.scenes.tables.compile import Bank

ARM = "layout"
AXES = {
    "environments": (64, 512, 4096, 65536),
    "scenes": (80, 1000, 10000),
    "categories": (22, 66, 200),
    "hidden": (64, 128, 256, 1024),
    "chunks": (4, 40),
}
ENVIRONMENTS, STEPS = 2048, 2**20  # of the environment alone: episodes side by side, and steps of a call
RUNS, ENOUGH_S = 3, 4.0


def main() -> None:
    points = {}
    for axis, values in AXES.items():
        for value in values:
            print(f"{axis} {value}", file=sys.stderr, flush=True)
            done = subprocess.run([sys.executable, __file__, axis, str(value)], stdout=subprocess.PIPE, check=True)
            points.setdefault(axis, {})[str(value)] = json.loads(done.stdout)
    report({"arm": ARM, "episodes_of_the_environment_alone": ENVIRONMENTS, **points})


def point(axis: str, value: int) -> dict:
    """Return the figures of one point."""
    config = dataclasses.replace(RunConfig(), arms=(ARM,), seeds=1, chunk=1)
    categories = (*ITHOR_CATEGORIES, *(f"Unseen{i}" for i in range(len(ITHOR_CATEGORIES), 200)))
    match axis:
        case "environments":
            config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=value))
        case "categories":
            config = dataclasses.replace(config, worlds=WorldConfig(categories=categories[:value]))
        case "hidden":
            config = dataclasses.replace(config, sizes=dataclasses.replace(config.sizes, hidden=value))
    setup = set_up(config, explore=False)
    if axis == "scenes":
        bank = tiled(setup.world.banks[0], value)
        setup = setup._replace(params=build(bank, {}, config.train_step_limit)[1])
    if axis == "chunks":
        states = setup.trainer.init(setup.params)
        for _ in range(value):
            states, _ = setup.trainer.train(states, setup.params)
        return {"peak_resident_gb": peak_resident_gb()}

    env, params = setup.world.env, setup.params
    measured = {"tables_gb": round(sum(leaf.nbytes for leaf in jax.tree.leaves(params.tables)) / 2**30, 3)}
    if axis != "hidden":
        episodes = value if axis == "environments" else ENVIRONMENTS
        measured |= figures("environment", walking(env, params, episodes), STEPS)
    learning = update(setup, ARM)
    measured |= figures("training", learning, config.update_steps)
    return measured | {"gflop_per_update": round(learning.flops / 1e9, 1)}


def tiled(bank: Bank, scenes: int) -> Bank:
    """Repeat a bank's scenes, to so many.

    What the environment does not read is left as it is.
    """
    copies = scenes // len(bank.names)
    shift = (np.arange(copies, dtype=np.int32) * len(bank.ahead)).reshape(-1, 1, 1)
    names = ("rows", "goal_distance", "num_cells", "goals", "num_goals")
    return bank._replace(
        names=bank.names * copies,
        room_types=bank.room_types * copies,
        ahead=(bank.ahead + shift).reshape(-1, bank.ahead.shape[1]),
        first_cell=(bank.first_cell + shift[..., 0]).reshape(-1),
        **{name: np.concatenate([getattr(bank, name)] * copies) for name in names},
    )


def walking(env: ObjectNav, params: EnvParams, episodes: int) -> Program:
    """Compile random steps that keep a row until the next."""
    key = jax.random.key(0)
    actions = jax.random.randint(key, (STEPS // episodes, episodes), 0, env.num_actions)
    observation, state = jax.vmap(env.reset, (0, None))(jax.random.split(key, episodes), params)

    def walk(state, row, actions, params):
        def step(carry, inputs):
            time, action = inputs
            keys = jax.random.split(jax.random.fold_in(key, time), episodes)
            observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, carry[0], action, params)
            return (state, observation.row), None

        return jax.lax.scan(step, (state, row), (jnp.arange(len(actions)), actions))[0]

    return program(walk, state, observation.row, actions, params)


def figures(name: str, program: Program, steps: int) -> dict:
    """Return speed, compile time and memory of a program."""
    taken = [seconds(program.call)]
    while len(taken) <= RUNS and sum(taken) < ENOUGH_S:
        taken.append(seconds(program.call))
    timed = taken[1:] or taken
    device = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    return {
        f"{name}_steps_per_s": spread([steps / one for one in timed]),
        f"{name}_runs": len(timed),
        f"{name}_compile_s": program.compile_s,
        f"{name}_temp_gb": program.temp_gb,
        f"{name}_peak_resident_gb": peak_resident_gb(),
        **({f"{name}_peak_device_gb": round(device / 2**30, 3)} if device else {}),
    }


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(point(sys.argv[1], int(sys.argv[2]))))
    else:
        main()
