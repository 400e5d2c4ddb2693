"""Seeds in one run against the same seeds in turn.

`python benchmarks/seeds.py` trains N seeds of one arm as one run, as `train.py` does; apart, each of the same states is
trained by a run of one seed. Both do the same updates, compiled beforehand; the ratio of one seed to itself is the
noise of the measurement.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from _common import in_turns, rates, ratios, report
from _setup import set_up

from jaxnav.env.types import EnvParams
from jaxnav.runs.config import RunConfig
from jaxnav.runs.prepare import make_trainer
from jaxnav.training.trainer import Trainer

ARM, SEEDS, TURNS = "layout", (1, 2, 4, 8), 5
GOALS = {"8_seeds_together_over_apart": 0.95}


def main() -> None:
    config = dataclasses.replace(RunConfig(), arms=(ARM,), chunk=1)
    setup = set_up(config)
    world, params, given = setup.world, setup.params, (setup.setting, setup.knowledge)
    runs = {seeds: make_trainer(dataclasses.replace(config, seeds=seeds), world.env, *given) for seeds in SEEDS}
    calls = {f"together {seeds}": training(run, run.init(params), params) for seeds, run in runs.items()}
    for seed, state in enumerate(runs[SEEDS[-1]].init(params)[ARM]):
        calls[f"seed {seed}"] = training(runs[1], {ARM: [state]}, params)
    taken = in_turns(calls, TURNS)

    results = {}
    for seeds in SEEDS:
        together = taken[f"together {seeds}"]
        alone = [taken[f"seed {seed}"] for seed in range(seeds)]
        apart = [sum(turn) for turn in zip(*alone, strict=True)]
        results[str(seeds)] = {
            "together_steps_per_s": rates(together, seeds * config.update_steps),
            "apart_steps_per_s": rates(apart, seeds * config.update_steps),
            "together_over_apart": ratios(apart, together),
        }
    report({"arm": ARM, "updates_per_call": config.chunk, "goals": GOALS, "seeds": results})


def training(run: Trainer, states: Any, params: EnvParams) -> Callable[[], Any]:
    """Return a call that trains these states one more chunk."""
    kept = [states]

    def train() -> jax.Array:
        kept[0], _ = run.train(kept[0], params)
        return kept[0][ARM][0].update

    return train


if __name__ == "__main__":
    main()
