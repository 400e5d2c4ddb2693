"""Seconds to compile every public entry: `python benchmarks/compile_time.py`.

An entry's figure is its first call less its second, so it holds tracing and lowering too; `calibrate` and `play`
compile anew at every call and their own work is short, so it is their first call. *Cold* is a new process; *cached* is
a new process that finds JAX's persistent cache (`jax_compilation_cache_dir`) as another one left it. Sizes are the
defaults of `train.py` and `eval.py`; `train` is the main training step, the compiled chunk of updates that `Arms` runs,
for each arm alone and for both, compiled one after the other. The chunk is of 2 updates and one seed is trained, so
that the calls are short: neither changes the program but for the length of its loop.
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

from jaxnav.env.build import build
from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.grid import Evaluator, first_states
from jaxnav.evaluation.playback import play
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.layout import SETTINGS
from jaxnav.policies.acting import Acting
from jaxnav.policies.policy import init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.runs.config import RunConfig
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.worlds import WORLDS, generated
from jaxnav.training.calibration import calibrate, layout_priors
from jaxnav.training.exploration import explore
from jaxnav.training.trainer import Arms

EPISODES, CHUNK = 2048, 2
GOALS = {"train_both_arms_cold_s": 15.0}
COMPILED_EVERY_TIME = ("calibrate", "play")


def entries() -> Iterator[tuple[str, Callable[[], Any]]]:
    """A call of each entry, prepared when its turn comes."""
    config = dataclasses.replace(RunConfig(), chunk=CHUNK, seeds=1)
    world, setting = WORLDS[config.world], SETTINGS[config.layout.setting]
    scenes = generated(config.world, "train")
    bank = compile_bank((scenes[i] for i in range(len(scenes))), config.task)
    env, params = build(bank, {}, world.train_step_limit, shaping=world.shaping)
    counts = jnp.ones((NUM_PRIORS, len(env.categories), len(env.categories)))
    priors = layout_priors(counts, setting)

    key = jax.random.key(0)
    keys = jax.random.split(key, EPISODES)
    yield "env_reset", partial(jax.jit(jax.vmap(env.reset, (0, None))), keys, params)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    step = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
    yield "env_step", partial(step, keys, state, jnp.zeros(EPISODES, jnp.int32), params)
    yield "explore", partial(jax.jit(explore, static_argnums=0), env, params, key)
    yield "calibrate", lambda: np.asarray(calibrate(env, params, counts, setting, key).early)

    arms = Arms(config, env, setting, priors)
    yield "learner_init", partial(jax.jit(arms.learners["layout"].init), key, params, priors)
    for name in config.arms:
        yield f"train_{name}", training(Arms(dataclasses.replace(config, arms=(name,)), env, setting, priors), params)
    yield "train_both_arms", training(arms, params)

    spec, acting = PolicySpec(num_categories=len(env.categories)), Acting(env, setting)
    weights = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), init_params(spec, key))
    grid = inference_grid([table_row("layout", None, None, "sample"), table_row("stde", 0.5, "residual", "sample")], 1)
    episodes = episode_list(bank)
    yield "evaluate", partial(Evaluator(acting, spec), grid, weights, [(episodes, params)], priors, key)
    cell, own, start = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in (grid, weights, first_states(episodes)))
    yield "play", lambda: play(cell, own, start, acting, spec, params, priors).action


def training(arms: Arms, params: Any) -> Callable[[], Any]:
    """A call that trains one chunk on each time."""
    kept = [arms.init(params)]

    def train() -> list[jax.Array]:
        kept[0], _ = arms.train(kept[0], params)
        return [states[0].update for states in kept[0].values()]

    return train


def measured() -> dict[str, float]:
    """Seconds that each entry takes to compile in this process."""
    found = {}
    for name, call in entries():
        first = seconds(call)
        again = 0.0 if name in COMPILED_EVERY_TIME else seconds(call)
        found[name] = round(first - again, 2)
        print(f"{name}: first {first:.2f} s, then {again:.2f} s", file=sys.stderr)
    return found


def in_new_process(cache: str | None) -> dict[str, float]:
    """The same in a new process, with everything that is compiled kept in this folder."""
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
