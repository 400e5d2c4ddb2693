"""Results of training runs in scenes, drawn from a model whose truth is known.

`python tests/support/simulated_results.py` prints the tables of docs/statistics.md.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import expit

from jaxnav.evaluation.statistics import Interval, leave_one_out, mean_interval
from jaxnav.experiments.pages import verdict

#: Numbers of scenes and training runs.
SIZES = ((80, 5), (20, 3), (20, 5), (10, 3), (5, 3))
EPISODES, ROOMS = 960, 4
#: Standard deviations on the logit of success: of scenes, runs, a run in a scene, an episode. Those of scenes and
#: episodes give scene means that spread by 12 points, as in generated rooms.
SCENE, RUN, BOTH, EPISODE = 0.9, 0.1, 0.25, 1.2
#: Logit of success by room type.
LEVELS = 1.6 + 0.4 * np.arange(ROOMS)

VERDICTS = ("holds", "inconclusive", "excluded", "refuted")

Rule = Callable[[np.ndarray, np.ndarray, np.random.Generator], Interval]


def truth() -> float:
    """Return the success rate over all scenes, runs and episodes."""
    spread = np.sqrt(SCENE**2 + RUN**2 + BOTH**2 + EPISODE**2)
    points, weights = np.polynomial.hermite_e.hermegauss(80)
    return float(np.mean([expit(level + spread * points) @ weights / weights.sum() for level in LEVELS]))


def results(size: tuple[int, int], draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw success [S, E] and the scene of each episode [E]."""
    scenes, runs = size
    scene = np.arange(EPISODES) % scenes
    logit = (
        LEVELS[scene % ROOMS]
        + draw.normal(0, SCENE, scenes)[scene]
        + draw.normal(0, RUN, (runs, 1))
        + draw.normal(0, BOTH, (runs, scenes))[:, scene]
        + draw.normal(0, EPISODE, EPISODES)
    )
    return draw.random(logit.shape) < expit(logit), scene


def coverage(rule: Rule, size: tuple[int, int], draws: int, seed: int = 0) -> float:
    """Return how often a rule's interval holds the truth."""
    draw, level = np.random.default_rng(seed), truth()
    intervals = [rule(*results(size, draw), draw) for _ in range(draws)]
    return float(np.mean([interval.low <= level <= interval.high for interval in intervals]))


def jackknifed(values: np.ndarray, scene: np.ndarray, _: np.random.Generator) -> Interval:
    """Return the interval of the package."""
    rooms = scene % ROOMS if scene.max() >= 2 * ROOMS - 1 else None
    return mean_interval(values, leave_one_out(scene, rooms))


def episode_bootstrap(values: np.ndarray, scene: np.ndarray, draw: np.random.Generator) -> Interval:
    """Return a percentile bootstrap over runs and episodes, as in version 0.1."""
    return _bootstrap(values, scene % ROOMS, draw, np.arange(len(scene)))


def scene_bootstrap(values: np.ndarray, scene: np.ndarray, draw: np.random.Generator) -> Interval:
    """Return a percentile bootstrap over runs and scenes."""
    return _bootstrap(values, scene % ROOMS, draw, scene)


def _bootstrap(values: np.ndarray, room: np.ndarray, draw: np.random.Generator, unit: np.ndarray) -> Interval:
    counts = np.zeros((400, len(unit)))
    for number in range(ROOMS):
        units = np.unique(unit[room == number])
        drawn = draw.multinomial(len(units), np.full(len(units), 1 / len(units)), 400)
        counts[:, room == number] = drawn[:, np.searchsorted(units, unit[room == number])]
    runs = draw.multinomial(len(values), np.full(len(values), 1 / len(values)), 400) / len(values)
    means = np.einsum("rs,rs->r", runs, counts @ values.T / counts.sum(axis=1, keepdims=True))
    return Interval(float(values.mean()), *np.percentile(means, (2.5, 97.5)).tolist())


def verdict_shares(effect: float, error: float, least: float = 2.0, draws: int = 20_000) -> dict[str, float]:
    """Return how often a claim gets each verdict.

    Args:
      effect: true effect, in points.
      error: standard error of its estimate, known.
      least: the least effect that would matter.
      draws: number of simulated estimates.
    """
    estimates = effect + error * np.random.default_rng(0).normal(size=draws)
    half = 1.96 * error
    verdicts = [verdict(Interval(estimate, estimate - half, estimate + half), least) for estimate in estimates.tolist()]
    return {name: verdicts.count(name) / draws for name in VERDICTS}


def main() -> None:
    """Print the tables of docs/statistics.md."""
    rules: dict[str, Rule] = {
        "jackknife of scenes and runs": jackknifed,
        "bootstrap of scenes and runs": scene_bootstrap,
        "bootstrap of episodes and runs": episode_bootstrap,
    }
    print(f"| scenes x runs | {' | '.join(rules)} |\n| --- |{' ---: |' * len(rules)}")
    for size in SIZES:
        shares = (f"{100 * coverage(rule, size, draws=1000):.1f} %" for rule in rules.values())
        print(f"| {size[0]} x {size[1]} | {' | '.join(shares)} |")
    print(f"\n| true effect | standard error | {' | '.join(VERDICTS)} |\n| ---: | ---: |{' ---: |' * len(VERDICTS)}")
    for effect, error in ((-3, 1), (0, 0.4), (0, 1), (0, 2), (1, 0.4), (1, 1), (2, 1), (3, 1), (3, 2), (5, 1)):
        shares = (f"{100 * share:.0f} %" for share in verdict_shares(effect, error).values())
        print(f"| {effect:+g} | {error:g} | {' | '.join(shares)} |")


if __name__ == "__main__":
    main()
