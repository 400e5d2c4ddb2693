"""Cost of one layout-estimator step with gap for many episodes: `python benchmarks/estimator.py`."""

import jax
import jax.numpy as jnp
import numpy as np
from _common import report, timings

from jaxnav.layout import SETTINGS, LayoutEstimator, prior_from_counts

EPISODES, CATEGORIES, VISIBLE = 4096, 22, 0.15


def main() -> None:
    rng = np.random.default_rng(0)
    counts = rng.integers(1, 500, (CATEGORIES, CATEGORIES))
    presence = jnp.asarray(rng.random((EPISODES, CATEGORIES)) < VISIBLE)
    results = {}
    for name in SETTINGS:
        estimator = LayoutEstimator(prior_from_counts(jnp.asarray(counts), name), name)
        state = jax.vmap(lambda _, estimator=estimator: estimator.init())(jnp.arange(EPISODES))
        result = timings(jax.jit(jax.vmap(estimator.update)), state, presence)
        result["cpu_us_per_episode_step"] = 1e3 * result["cpu_mean_ms"] / EPISODES
        results[name] = result
    report({"episodes": EPISODES, "categories": CATEGORIES, "visible_share": VISIBLE, "settings": results})


if __name__ == "__main__":
    main()
