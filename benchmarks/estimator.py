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
from _common import print_report, summarize, time_in_turns

from jaxnav.layout import ESTIMATORS, LayoutEstimator, prior_from_counts

NUM_EPISODES = 4096
NUM_CATEGORIES = 22
VISIBLE_SHARE = 0.15
NUM_CALLS = 50


def main() -> None:
    rng = np.random.default_rng(0)
    counts = jnp.asarray(rng.integers(1, 500, (NUM_CATEGORIES, NUM_CATEGORIES)))
    presence = jnp.asarray(rng.random((NUM_EPISODES, NUM_CATEGORIES)) < VISIBLE_SHARE)

    # One jitted update of all episodes for each setting.
    settings = ESTIMATORS | {"calibrated_without_gap": dataclasses.replace(ESTIMATORS["calibrated"], gap="none")}
    calls = {}
    for name, setting in settings.items():
        estimator = LayoutEstimator(prior_from_counts(counts, setting), setting)
        state = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (NUM_EPISODES, *leaf.shape)), estimator.init())
        calls[name] = partial(jax.jit(jax.vmap(estimator.update)), state, presence)

    wall_times = time_in_turns(calls, NUM_CALLS)
    results = {}
    for name, call in calls.items():
        start_time = time.process_time()
        for _ in range(NUM_CALLS):
            jax.block_until_ready(call())
        processor_time = (time.process_time() - start_time) / NUM_CALLS
        results[name] = {
            "wall_us_per_step": summarize([1e6 * wall_time / NUM_EPISODES for wall_time in wall_times[name]]),
            "processor_us_per_step": round(1e6 * processor_time / NUM_EPISODES, 3),
        }
    print_report(
        {
            "episodes": NUM_EPISODES,
            "categories": NUM_CATEGORIES,
            "visible_share": VISIBLE_SHARE,
            "settings": results,
        }
    )


if __name__ == "__main__":
    main()
