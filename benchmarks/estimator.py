"""Cost of one step of the layout estimator.

`python benchmarks/estimator.py` times it for many episodes: every setting, and the default one without its gap, as in
training. Processor time counts all threads.
"""

import dataclasses
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from _common import in_turns, report, spread

from jaxnav.layout import SETTINGS, LayoutEstimator, prior_from_counts

EPISODES, CATEGORIES, VISIBLE, CALLS = 4096, 22, 0.15, 50


def main() -> None:
    rng = np.random.default_rng(0)
    counts = jnp.asarray(rng.integers(1, 500, (CATEGORIES, CATEGORIES)))
    presence = jnp.asarray(rng.random((EPISODES, CATEGORIES)) < VISIBLE)
    settings = SETTINGS | {"calibrated_without_gap": dataclasses.replace(SETTINGS["calibrated"], gap="none")}
    calls = {}
    for name, setting in settings.items():
        estimator = LayoutEstimator(prior_from_counts(counts, setting), setting)
        state = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (EPISODES, *leaf.shape)), estimator.init())
        calls[name] = partial(jax.jit(jax.vmap(estimator.update)), state, presence)
    wall, results = in_turns(calls, CALLS), {}
    for name, call in calls.items():
        began = time.process_time()
        for _ in range(CALLS):
            jax.block_until_ready(call())
        processor = (time.process_time() - began) / CALLS
        results[name] = {
            "wall_us_per_step": spread([1e6 * one / EPISODES for one in wall[name]]),
            "processor_us_per_step": round(1e6 * processor / EPISODES, 3),
        }
    report({"episodes": EPISODES, "categories": CATEGORIES, "visible_share": VISIBLE, "settings": results})


if __name__ == "__main__":
    main()
