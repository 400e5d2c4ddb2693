"""Seconds to compile every public entry.

`python benchmarks/compile_time.py` prints for each entry its first call less its second, which includes tracing and
lowering; `calibrate` and `play` compile at every call and their work is short, so theirs is the first call. *Cold* is a
new process; *cached* is a new process with JAX's persistent cache (`jax_compilation_cache_dir`) that another process
has filled. Sizes are the defaults of `train.py` and `eval.py`; `train` is the main training step, the compiled chunk of
updates that `Trainer` runs, for each arm alone and for both, compiled one after the other. The chunk is of 2 updates
and one seed is trained, so that the calls are short; both change only the length of the program's loop.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import print_report, time_call
from _setup import make_training_call, set_up_training

from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator, start_states
from jaxnav.evaluation.playback import play_episodes
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.network import init_params
from jaxnav.runs.config import RunConfig
from jaxnav.runs.train import make_trainer
from jaxnav.training.calibration import calibrate, explore

NUM_EPISODES = 2048
CHUNK = 2
COMPILED_EVERY_TIME = ("calibrate", "play")


def main() -> None:
    cold = measure_in_new_process(cache_dir=None)
    with tempfile.TemporaryDirectory() as cache_dir:
        measure_in_new_process(cache_dir)  # fills the cache
        cached = measure_in_new_process(cache_dir)
    print_report(
        {
            "episodes": NUM_EPISODES,
            "compile_s": {name: {"cold": cold[name], "cached": cached[name]} for name in cold},
        }
    )


def measure_in_new_process(cache_dir: str | None) -> dict[str, float]:
    """Return the result of `measure` in a new process with this compilation cache."""
    environment = dict(os.environ)
    if cache_dir:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": cache_dir,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    command = [sys.executable, __file__, "--measure"]
    output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    return json.loads(output)


def measure() -> dict[str, float]:
    """Return the seconds that each entry takes to compile in this process."""
    compile_times = {}
    for name, call in make_calls():
        first_time = time_call(call)
        second_time = 0.0 if name in COMPILED_EVERY_TIME else time_call(call)
        compile_times[name] = round(first_time - second_time, 2)
        print(f"{name}: first {first_time:.2f} s, then {second_time:.2f} s", file=sys.stderr)
    return compile_times


def make_calls() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield name and call of every entry; each is prepared when its turn comes."""
    config = dataclasses.replace(RunConfig(), chunk=CHUNK, seeds=1)
    setup = set_up_training(config, explore=False)
    env = setup.compiled_world.env
    params = setup.params
    estimator_config = setup.estimator_config
    knowledge = setup.knowledge

    # The environment.
    key = jax.random.key(0)
    keys = jax.random.split(key, NUM_EPISODES)
    yield "env_reset", partial(jax.jit(jax.vmap(env.reset, (0, None))), keys, params)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    step = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
    yield "env_step", partial(step, keys, state, jnp.zeros(NUM_EPISODES, jnp.int32), params)

    # Before training.
    yield "explore", partial(jax.jit(explore, static_argnums=0), env, params, key)
    yield "calibrate", lambda: np.asarray(calibrate(env, params, setup.exploration.counts, estimator_config, key).early)

    # Training, each arm alone and both.
    trainer = setup.trainer
    yield "learner_init", partial(jax.jit(trainer.learners["layout"].init), key, params, knowledge)
    for arm in config.arms:
        arm_trainer = make_trainer(dataclasses.replace(config, arms=(arm,)), env, estimator_config, knowledge)
        yield f"train_{arm}", make_training_call(arm_trainer, arm_trainer.init(params), params)
    yield "train_both_arms", make_training_call(trainer, trainer.init(params), params)

    # Evaluation, of the whole grid and of one episode.
    spec = config.policy_spec(len(env.categories))
    agent_loop = AgentLoop(env, spec, estimator_config)
    weights = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), init_params(spec, key))
    rows = [table_row("layout", None, None, "sample"), table_row("stde", 0.5, "residual", "sample")]
    grid = inference_grid(rows, config.arms, 1)
    episodes = draw_episodes(setup.compiled_world.banks[0])
    yield "evaluate", partial(Evaluator(agent_loop), grid, weights, [(episodes, params)], knowledge, key)
    first_cell = jax.tree.map(lambda leaf: leaf[0], grid)
    first_weights = jax.tree.map(lambda leaf: leaf[0], weights)
    start = jax.tree.map(lambda leaf: leaf[:1], start_states(episodes))
    yield "play", lambda: play_episodes(first_cell, first_weights, start, agent_loop, params, knowledge)[0].action


if __name__ == "__main__":
    if sys.argv[1:] == ["--measure"]:
        print(json.dumps(measure()))
    else:
        main()
