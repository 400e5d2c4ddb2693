"""Seconds to compile every public entry.

`python benchmarks/compile_time.py` prints for each entry its first call less its second, so tracing and lowering are in
it; `calibrate` and `play` compile anew at every call and their work is short, so theirs is the first call. *Cold* is a
new process; *cached* is a new process that has JAX's persistent cache (`jax_compilation_cache_dir`) as another one left
it. Sizes are the defaults of `train.py` and `eval.py`; `train` is the main training step, the compiled chunk of updates
that `Trainer` runs, for each arm alone and for both, compiled one after the other. The chunk is of 2 updates and one
seed is trained, so that the calls are short: neither changes the program but for the length of its loop.
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
from _common import report, seconds
from _setup import set_up

from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.grid import Evaluator, first_states
from jaxnav.evaluation.playback import play
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.acting import Acting
from jaxnav.policies.policy import init_params
from jaxnav.runs.config import RunConfig
from jaxnav.runs.prepare import make_trainer
from jaxnav.training.calibration import calibrate
from jaxnav.training.exploration import explore
from jaxnav.training.trainer import Trainer

EPISODES, CHUNK = 2048, 2
GOALS = {"train_both_arms_cold_s": 15.0}
COMPILED_EVERY_TIME = ("calibrate", "play")


def entries() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield calls of the entries, prepared when their turn comes."""
    config = dataclasses.replace(RunConfig(), chunk=CHUNK, seeds=1)
    setup = set_up(config, explore=False)
    env, params, setting, knowledge = setup.world.env, setup.params, setup.setting, setup.knowledge

    key = jax.random.key(0)
    keys = jax.random.split(key, EPISODES)
    yield "env_reset", partial(jax.jit(jax.vmap(env.reset, (0, None))), keys, params)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    step = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
    yield "env_step", partial(step, keys, state, jnp.zeros(EPISODES, jnp.int32), params)
    yield "explore", partial(jax.jit(explore, static_argnums=0), env, params, key)
    yield "calibrate", lambda: np.asarray(calibrate(env, params, setup.explored.counts, setting, key).early)

    trainer = setup.trainer
    yield (
        "learner_init",
        partial(jax.jit(trainer.learners["layout"].init), key, params, knowledge),
    )
    for name in config.arms:
        alone = make_trainer(dataclasses.replace(config, arms=(name,)), env, setting, knowledge)
        yield f"train_{name}", training(alone, params)
    yield "train_both_arms", training(trainer, params)

    spec = config.policy_spec(len(env.categories))
    acting = Acting(env, spec, setting)
    weights = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), init_params(spec, key))
    rows = [table_row("layout", None, None, "sample"), table_row("stde", 0.5, "residual", "sample")]
    grid, episodes = inference_grid(rows, config.arms, 1), episode_list(setup.world.banks[0])
    yield "evaluate", partial(Evaluator(acting), grid, weights, [(episodes, params)], knowledge, key)
    cell, one = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in (grid, weights))
    start = jax.tree.map(lambda leaf: leaf[:1], first_states(episodes))
    yield "play", lambda: play(cell, one, start, acting, params, knowledge)[0].action


def training(trainer: Trainer, params: Any) -> Callable[[], Any]:
    """Return a call that trains one more chunk."""
    kept = [trainer.init(params)]

    def train() -> list[jax.Array]:
        kept[0], _ = trainer.train(kept[0], params)
        return [states[0].update for states in kept[0].values()]

    return train


def measured() -> dict[str, float]:
    """Return seconds that each entry takes to compile here."""
    compiling = {}
    for name, call in entries():
        first = seconds(call)
        again = 0.0 if name in COMPILED_EVERY_TIME else seconds(call)
        compiling[name] = round(first - again, 2)
        print(f"{name}: first {first:.2f} s, then {again:.2f} s", file=sys.stderr)
    return compiling


def in_new_process(cache: str | None) -> dict[str, float]:
    """Measure in a new process that has this compilation cache."""
    kept = {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    command = [sys.executable, __file__, "--measure"]
    environment = os.environ | (kept if cache else {})
    return json.loads(subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout)


def main() -> None:
    cold = in_new_process(None)
    with tempfile.TemporaryDirectory() as cache:
        in_new_process(cache)
        cached = in_new_process(cache)
    report(
        {
            "episodes": EPISODES,
            "goals": GOALS,
            "compile_s": {name: {"cold": cold[name], "cached": cached[name]} for name in cold},
        }
    )


if __name__ == "__main__":
    if sys.argv[1:] == ["--measure"]:
        print(json.dumps(measured()))
    else:
        main()
