"""Speed, memory and compile time as the problem grows.

`python benchmarks/growth.py` varies each axis alone around the default configuration, every point in a process of its
own: random steps of the environment alone, the row consumed and not stored, and whole updates of the arm with the
layout. Peaks are of resident memory, with Python, JAX, its compiler and the scenes. Scenes beyond the default are
copies of the default bank's tables under indices of their own, which the host holds besides; categories beyond it are
names without objects. `chunks` trains on in one process, whose memory must not grow. Timing stops after three runs or a
few seconds: the largest points are timed once, without warm-up.
"""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
from _common import peak_resident_gb, print_report, summarize, time_call
from _setup import Program, TrainingSetup, compile_program, compile_update, make_training_call, set_up_training

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import EnvParams, ObjectNav
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
# Of the environment alone: parallel episodes, and steps of a call.
NUM_EPISODES = 2048
NUM_STEPS = 2**20
# Timing stops after so many runs or seconds.
MAX_RUNS = 3
MAX_SECONDS = 4.0


def main() -> None:
    points = {}
    for axis, values in AXES.items():
        for value in values:
            print(f"{axis} {value}", file=sys.stderr, flush=True)
            command = [sys.executable, __file__, axis, str(value)]
            completed = subprocess.run(command, stdout=subprocess.PIPE, check=True)
            points.setdefault(axis, {})[str(value)] = json.loads(completed.stdout)
    print_report({"arm": ARM, "episodes_of_the_environment_alone": NUM_EPISODES, **points})


def measure_point(axis: str, value: int) -> dict:
    """Return the figures of one point."""
    config = make_config(axis, value)
    setup = set_up_training(config, explore=False)
    if axis == "scenes":
        bank = repeat_scenes(setup.compiled_world.banks[0], value)
        _, env_params = build_environment(bank, {}, config.train_step_limit)
        setup = setup._replace(params=env_params)
    if axis == "chunks":
        train_chunks(setup, value)
        return {"peak_resident_gb": peak_resident_gb()}

    table_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(setup.params.tables))
    figures = {"tables_gb": round(table_bytes / 2**30, 3)}

    # The environment alone, which knows nothing of the hidden size, then whole updates.
    if axis != "hidden":
        num_episodes = value if axis == "environments" else NUM_EPISODES
        walk = compile_walk(setup.compiled_world.env, setup.params, num_episodes)
        figures |= measure_program("environment", walk, NUM_STEPS)
    update = compile_update(setup, ARM)
    figures |= measure_program("training", update, config.steps_per_update)
    return figures | {"gflop_per_update": round(update.flops / 1e9, 1)}


def make_config(axis: str, value: int) -> RunConfig:
    """Return the default run with one setting changed; `scenes` and `chunks` are no settings."""
    config = dataclasses.replace(RunConfig(), arms=(ARM,), seeds=1, chunk=1)
    match axis:
        case "environments":
            config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=value))
        case "categories":
            unseen_categories = [f"Unseen{index}" for index in range(len(ITHOR_CATEGORIES), 200)]
            categories = (*ITHOR_CATEGORIES, *unseen_categories)
            config = dataclasses.replace(config, worlds=WorldConfig(categories=categories[:value]))
        case "hidden":
            config = dataclasses.replace(config, sizes=dataclasses.replace(config.sizes, hidden=value))
    return config


def train_chunks(setup: TrainingSetup, num_chunks: int) -> None:
    """Train for some chunks of updates, one after the other."""
    train = make_training_call(setup.trainer, setup.trainer.init(setup.params), setup.params)
    for _ in range(num_chunks):
        train()


def repeat_scenes(bank: Bank, num_scenes: int) -> Bank:
    """Return a bank with copies of its scenes.

    Tables that the environment does not read stay as they are.
    """
    num_copies = num_scenes // len(bank.names)

    # The cells of each copy have indices of their own.
    index_shift = (np.arange(num_copies, dtype=np.int32) * len(bank.ahead)).reshape(-1, 1, 1)
    repeated = {}
    for name in ("rows", "goal_distance", "num_cells", "goals", "num_goals"):
        repeated[name] = np.concatenate([getattr(bank, name)] * num_copies)
    return bank._replace(
        names=bank.names * num_copies,
        room_types=bank.room_types * num_copies,
        ahead=(bank.ahead + index_shift).reshape(-1, bank.ahead.shape[1]),
        first_cell=(bank.first_cell + index_shift[..., 0]).reshape(-1),
        **repeated,
    )


def compile_walk(env: ObjectNav, params: EnvParams, num_episodes: int) -> Program:
    """Compile random steps that keep a row until the next."""
    key = jax.random.key(0)
    actions = jax.random.randint(key, (NUM_STEPS // num_episodes, num_episodes), 0, env.num_actions)
    observation, state = jax.vmap(env.reset, (0, None))(jax.random.split(key, num_episodes), params)

    def walk(state, row, actions, params):
        def step(carry, inputs):
            state, _ = carry
            time_index, action = inputs
            keys = jax.random.split(jax.random.fold_in(key, time_index), num_episodes)
            observation, state, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, state, action, params)
            return (state, observation.row), None

        return jax.lax.scan(step, (state, row), (jnp.arange(len(actions)), actions))[0]

    return compile_program(walk, state, observation.row, actions, params)


def measure_program(name: str, program: Program, num_steps: int) -> dict:
    """Return speed, compile time and memory of a program."""
    call_times = [time_call(program.call)]
    while len(call_times) <= MAX_RUNS and sum(call_times) < MAX_SECONDS:
        call_times.append(time_call(program.call))
    timed_runs = call_times[1:] or call_times  # the first warms up, if time allows another

    return {
        f"{name}_steps_per_s": summarize([num_steps / call_time for call_time in timed_runs]),
        f"{name}_runs": len(timed_runs),
        f"{name}_compile_s": program.compile_s,
        f"{name}_temp_gb": program.temp_gb,
        f"{name}_peak_resident_gb": peak_resident_gb(),
    }


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure_point(sys.argv[1], int(sys.argv[2]))))
    else:
        main()
