"""Means, spreads and confidence intervals of paired per-episode results.

Results are arrays [S, E]: S training seeds, each evaluated on the same E episodes. Seeds and episodes are crossed, so
an interval resamples both: "would another training run, on other episodes of these room types, agree?"
"""

from typing import NamedTuple

import numpy as np

from jaxnav.errors import InputError

#: Percentiles that bound a two-sided 95 % interval.
_BOUNDS = (2.5, 97.5)


class Summary(NamedTuple):
    """Hold a mean with its spread, in the values' unit.

    Attributes:
      mean: mean over seeds and episodes.
      std: sample standard deviation (ddof = 1) over the S seed means, the "±" of published tables; 0 for one seed.
      ci95: (low, high) of the 95 % percentile bootstrap interval of the mean.
    """

    mean: float
    std: float
    ci95: tuple[float, float]


def summary(values: np.ndarray, strata: np.ndarray, generator: np.random.Generator, resamples: int = 2000) -> Summary:
    """Summarise per-episode results, with a bootstrap interval.

    The bootstrap is stratified and crossed.

    A resample draws S seeds with replacement and, within each stratum, as many episodes with replacement as it holds;
    all seeds share the episode draw (the pigeonhole bootstrap, Owen 2007, with strata). The interval thus includes
    the variation between training runs, between episodes of a room type, and between single outcomes; it leaves out
    the mix of room types, which is fixed.

    Two limits. S seeds show only (S - 1) / S of the between-seed variance (none for one seed), so with few seeds that
    differ widely the interval is too narrow; and outcome noise enters through both draws, so with seeds that hardly
    differ it is a little too wide.

    Args:
      values: bool, int or float [S, E], finite.
      strata: int [E], stratum (room type) of each episode.
      generator: source of the resamples.
      resamples: number of bootstrap resamples, at least 1.

    Raises:
      InputError: wrong or empty shapes, NaN or infinite values, or no resample.
    """
    values, strata = _checked("values", values, strata, resamples)
    return Bootstrap(_episode_weights(strata, generator, resamples), len(values), generator).summary(values)


def paired_difference(
    a: np.ndarray,
    b: np.ndarray,
    strata: np.ndarray,
    generator: np.random.Generator,
    resamples: int = 2000,
    same_seeds: bool = False,
) -> Summary:
    """Summarise `b - a` on the same episodes.

    Both arms share every episode draw, so that the difficulty of episodes cancels.

    Arms trained apart have nothing in common at equal seed indexes: by default their seeds are drawn independently and
    `std` is sqrt(std_a^2 + std_b^2). With `same_seeds`, row s of both arms comes from the same network (sTDE against
    no de-biasing): one draw of seeds serves both and `std` is that of the S differences of seed means.

    Args:
      a: bool, int or float [S, E], finite; the reference arm.
      b: the same shape; the arm compared with it.
      strata: int [E], stratum (room type) of each episode.
      generator: source of the resamples.
      resamples: number of bootstrap resamples, at least 1.
      same_seeds: whether equal seed indexes mean the same network.

    Raises:
      InputError: as `summary`, or shapes of `a` and `b` that differ.
    """
    a, strata = _checked("a", a, strata, resamples)
    b, _ = _checked("b", b, strata, resamples)
    if a.shape != b.shape:
        raise InputError(
            f"a {a.shape} and b {b.shape} differ in shape; evaluate both arms on the same seeds and episodes"
        )
    return Bootstrap(_episode_weights(strata, generator, resamples), len(a), generator).difference(a, b, same_seeds)


class Bootstrap:
    """Hold resamples that many results share.

    Equal results get equal intervals. For finite float64 values [S, E].
    """

    def __init__(self, episodes: np.ndarray, num_seeds: int, generator: np.random.Generator) -> None:
        """Draw the seeds.

        `episodes` [resamples, E] says how much each episode counts, rows adding up to 1.
        """
        self._episodes = episodes
        self._seeds, self._others = (_seed_weights(num_seeds, generator, len(episodes)) for _ in range(2))

    def summary(self, values: np.ndarray) -> Summary:
        """Summarise results; see `summary`."""
        return _summarise(values.mean(), _std(values), _resampled_means(values, self._episodes, self._seeds))

    def difference(self, a: np.ndarray, b: np.ndarray, same_seeds: bool) -> Summary:
        """Summarise a difference; see `paired_difference`."""
        if same_seeds:
            return self.summary(b - a)
        means_a = _resampled_means(a, self._episodes, self._seeds)
        means_b = _resampled_means(b, self._episodes, self._others)
        return _summarise(b.mean() - a.mean(), np.hypot(_std(a), _std(b)), means_b - means_a)


def _checked(name: str, values: np.ndarray, strata: np.ndarray, resamples: int) -> tuple[np.ndarray, np.ndarray]:
    values, strata = np.asarray(values, np.float64), np.asarray(strata)
    if values.ndim != 2 or values.size == 0:
        raise InputError(f"{name} has shape {values.shape}; give [seeds, episodes] with at least one of each")
    if strata.shape != values.shape[1:]:
        raise InputError(f"strata has shape {strata.shape}; give one stratum for each of {values.shape[1]} episodes")
    if not np.isfinite(values).all():
        raise InputError(f"{name} holds NaN or infinite results; give every episode a finite value")
    if resamples < 1:
        raise InputError(f"resamples is {resamples}; give at least 1")
    return values, strata


def _episode_weights(strata: np.ndarray, generator: np.random.Generator, resamples: int) -> np.ndarray:
    """Draw episodes, strata keeping their sizes.

    Returns weights [resamples, E], each row the share of draws that fell on each episode.
    """
    counts = np.zeros((resamples, len(strata)))
    for stratum in np.unique(strata):
        members = np.flatnonzero(strata == stratum)
        counts[:, members] = _draw_counts(len(members), generator, resamples)
    return counts / len(strata)


def _seed_weights(seeds: int, generator: np.random.Generator, resamples: int) -> np.ndarray:
    return _draw_counts(seeds, generator, resamples) / seeds


def _draw_counts(size: int, generator: np.random.Generator, resamples: int) -> np.ndarray:
    """Count how often items come up in draws.

    `size` draws with replacement of `size` items; int [resamples, size].
    """
    draws = generator.integers(size, size=(resamples, size))
    draws += np.arange(resamples)[:, None] * size  # one block of bins for each resample
    return np.bincount(draws.ravel(), minlength=resamples * size).reshape(resamples, size)


def _resampled_means(values: np.ndarray, episodes: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    return np.einsum("rs,rs->r", seeds, episodes @ values.T)


def _std(values: np.ndarray) -> float:
    return float(values.mean(axis=1).std(ddof=1)) if len(values) > 1 else 0.0


def _summarise(mean: float, std: float, resampled: np.ndarray) -> Summary:
    low, high = np.percentile(resampled, _BOUNDS)
    return Summary(float(mean), float(std), (float(low), float(high)))
