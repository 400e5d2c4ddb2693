"""Seeds in one run against the same seeds one after the other: `python benchmarks/seeds.py`.

A run of N seeds of one arm trains them as `train.py` does; apart, each of the same states is trained by a run of one
seed. Both do the same updates, compiled beforehand; the ratio of one seed to itself is the noise of the measurement.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from _common import in_turns, rates, ratios, report

from jaxnav.env.make import make
from jaxnav.env.objectnav import NUM_PRIORS
from jaxnav.env.types import EnvParams
from jaxnav.layout import SETTINGS
from jaxnav.runs.config import RunConfig
from jaxnav.training.calibration import layout_priors
from jaxnav.training.trainer import Arms

ARM, SEEDS, TURNS = "layout", (1, 2, 4, 8), 5
GOALS = {"8_seeds_together_over_apart": 0.95}


def main() -> None:
    config = dataclasses.replace(RunConfig(), arms=(ARM,), chunk=1)
    env, params = make(config.world)
    setting, categories = SETTINGS[config.layout.setting], len(env.categories)
    priors = layout_priors(jnp.zeros((NUM_PRIORS, categories, categories)), setting)

    runs = {seeds: Arms(dataclasses.replace(config, seeds=seeds), env, setting, priors) for seeds in SEEDS}
    calls = {f"together {seeds}": training(run, run.init(params), params) for seeds, run in runs.items()}
    for seed, state in enumerate(runs[SEEDS[-1]].init(params)[ARM]):
        calls[f"seed {seed}"] = training(runs[1], {ARM: [state]}, params)
    taken = in_turns(calls, TURNS)

    found = {}
    for seeds in SEEDS:
        together = taken[f"together {seeds}"]
        alone = [taken[f"seed {seed}"] for seed in range(seeds)]
        apart = [sum(turn) for turn in zip(*alone, strict=True)]
        found[str(seeds)] = {
            "together_steps_per_s": rates(together, seeds * config.update_steps),
            "apart_steps_per_s": rates(apart, seeds * config.update_steps),
            "together_over_apart": ratios(apart, together),
        }
    report({"arm": ARM, "updates_per_call": config.chunk, "goals": GOALS, "seeds": found})


def training(run: Arms, states: Any, params: EnvParams) -> Callable[[], Any]:
    """A call that trains these states one chunk on each time."""
    kept = [states]

    def train() -> jax.Array:
        kept[0], _ = run.train(kept[0], params)
        return kept[0][ARM][0].update

    return train


if __name__ == "__main__":
    main()
