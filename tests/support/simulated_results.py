"""Results of training runs in scenes, drawn from a model with a known success rate.

`python tests/support/simulated_results.py` prints the tables of docs/statistics.md.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import expit

from jaxnav.evaluation.statistics import Interval, leave_one_out, mean_interval
from jaxnav.experiments.pages import verdict

#: Numbers of scenes and training runs.
SIZES = ((80, 5), (20, 3), (20, 5), (10, 3), (5, 3))
NUM_EPISODES = 960
NUM_ROOM_TYPES = 4
# Standard deviations on the logit of success. Those of scenes and episodes give scene means that spread by 12 points,
# as in generated rooms.
SCENE_SD = 0.9
RUN_SD = 0.1
SCENE_RUN_SD = 0.25  # of a run in a scene
EPISODE_SD = 1.2
#: Logit of success by room type.
ROOM_TYPE_LOGITS = 1.6 + 0.4 * np.arange(NUM_ROOM_TYPES)

VERDICTS = ("holds", "inconclusive", "excluded", "refuted")

Rule = Callable[[np.ndarray, np.ndarray, np.random.Generator], Interval]


def truth() -> float:
    """Return the success rate over all scenes, runs and episodes."""
    total_sd = np.sqrt(SCENE_SD**2 + RUN_SD**2 + SCENE_RUN_SD**2 + EPISODE_SD**2)
    points, weights = np.polynomial.hermite_e.hermegauss(80)
    room_type_rates = []
    for logit in ROOM_TYPE_LOGITS:
        room_type_rates.append(expit(logit + total_sd * points) @ weights / weights.sum())
    return float(np.mean(room_type_rates))


def results(size: tuple[int, int], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw success bool [runs, E], and the scene of each episode [E]."""
    num_scenes, num_runs = size
    scene = np.arange(NUM_EPISODES) % num_scenes
    logit = (
        ROOM_TYPE_LOGITS[scene % NUM_ROOM_TYPES]
        + rng.normal(0, SCENE_SD, num_scenes)[scene]
        + rng.normal(0, RUN_SD, (num_runs, 1))
        + rng.normal(0, SCENE_RUN_SD, (num_runs, num_scenes))[:, scene]
        + rng.normal(0, EPISODE_SD, NUM_EPISODES)
    )
    return rng.random(logit.shape) < expit(logit), scene


def coverage(rule: Rule, size: tuple[int, int], draws: int, seed: int = 0) -> float:
    """Return how often the interval of a rule contains the truth."""
    rng = np.random.default_rng(seed)
    true_rate = truth()
    contains_truth = []
    for _ in range(draws):
        success, scene = results(size, rng)
        interval = rule(success, scene, rng)
        contains_truth.append(interval.low <= true_rate <= interval.high)
    return float(np.mean(contains_truth))


def jackknifed(values: np.ndarray, scene: np.ndarray, _: np.random.Generator) -> Interval:
    """Return the interval of the package."""
    has_two_scenes_per_type = scene.max() >= 2 * NUM_ROOM_TYPES - 1
    room_type = scene % NUM_ROOM_TYPES if has_two_scenes_per_type else None
    return mean_interval(values, leave_one_out(scene, room_type))


def episode_bootstrap(values: np.ndarray, scene: np.ndarray, rng: np.random.Generator) -> Interval:
    """Return a percentile bootstrap over runs and episodes, as in version 0.1."""
    return _bootstrap(values, scene % NUM_ROOM_TYPES, rng, np.arange(len(scene)))


def scene_bootstrap(values: np.ndarray, scene: np.ndarray, rng: np.random.Generator) -> Interval:
    """Return a percentile bootstrap over runs and scenes."""
    return _bootstrap(values, scene % NUM_ROOM_TYPES, rng, scene)


def _bootstrap(values: np.ndarray, room_type: np.ndarray, rng: np.random.Generator, unit: np.ndarray) -> Interval:
    """Return the interval of 400 resamples of runs, and of units within each room type.

    Args:
      values: success [runs, E].
      room_type: index of each episode's room type [E].
      rng: source of randomness.
      unit: index of each episode's scene, or of the episode itself [E].
    """
    # How often each episode is drawn, [resamples, E].
    episode_counts = np.zeros((400, len(unit)))
    for type_index in range(NUM_ROOM_TYPES):
        is_type = room_type == type_index
        units = np.unique(unit[is_type])
        unit_counts = rng.multinomial(len(units), np.full(len(units), 1 / len(units)), 400)
        episode_counts[:, is_type] = unit_counts[:, np.searchsorted(units, unit[is_type])]

    # Weights of the runs [resamples, runs], and the mean success of each resample.
    num_runs = len(values)
    run_weights = rng.multinomial(num_runs, np.full(num_runs, 1 / num_runs), 400) / num_runs
    run_means = episode_counts @ values.T / episode_counts.sum(axis=1, keepdims=True)
    means = np.einsum("rs,rs->r", run_weights, run_means)
    return Interval(float(values.mean()), *np.percentile(means, (2.5, 97.5)).tolist())


def verdict_shares(effect: float, error: float, min_effect: float = 2.0, draws: int = 20_000) -> dict[str, float]:
    """Return how often a claim gets each verdict.

    Args:
      effect: true effect, in points.
      error: standard error of its estimate, known.
      min_effect: smallest effect that would matter.
      draws: number of simulated estimates.
    """
    estimates = effect + error * np.random.default_rng(0).normal(size=draws)
    half_width = 1.96 * error
    verdicts = []
    for estimate in estimates.tolist():
        interval = Interval(estimate, estimate - half_width, estimate + half_width)
        verdicts.append(verdict(interval, min_effect))
    return {name: verdicts.count(name) / draws for name in VERDICTS}


def main() -> None:
    """Print the tables of docs/statistics.md."""
    rules: dict[str, Rule] = {
        "jackknife of scenes and runs": jackknifed,
        "bootstrap of scenes and runs": scene_bootstrap,
        "bootstrap of episodes and runs": episode_bootstrap,
    }

    # Coverage of the three rules.
    print(f"| scenes x runs | {' | '.join(rules)} |\n| --- |{' ---: |' * len(rules)}")
    for size in SIZES:
        shares = (f"{100 * coverage(rule, size, draws=1000):.1f} %" for rule in rules.values())
        print(f"| {size[0]} x {size[1]} | {' | '.join(shares)} |")

    # Verdicts about a claim.
    print(f"\n| true effect | standard error | {' | '.join(VERDICTS)} |\n| ---: | ---: |{' ---: |' * len(VERDICTS)}")
    for effect, error in ((-3, 1), (0, 0.4), (0, 1), (0, 2), (1, 0.4), (1, 1), (2, 1), (3, 1), (3, 2), (5, 1)):
        shares = (f"{100 * share:.0f} %" for share in verdict_shares(effect, error).values())
        print(f"| {effect:+g} | {error:g} | {' | '.join(shares)} |")


if __name__ == "__main__":
    main()
