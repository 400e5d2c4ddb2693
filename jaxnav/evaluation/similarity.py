"""Fit of a scene's layout to a layout prior."""

import numpy as np

from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat

#: Share of the uniform distribution in both sides of the layout gap, so that it stays finite.
UNIFORM = 0.05


def seen_together(rows: np.ndarray, num_categories: int) -> np.ndarray:
    """Count poses at which two categories are detected together.

    Args:
      rows: uint8 [P, R], see `RowFormat`.
      num_categories: K.

    Returns:
      float64 [K, K], n_ij, symmetric, whole numbers, 0 on the diagonal.
    """
    presence = RowFormat(num_categories).presence(rows).astype(np.float64)
    together = presence.T @ presence
    np.fill_diagonal(together, 0.0)
    return together


def scene_counts(bank: Bank) -> np.ndarray:
    """Count the co-occurrence of each scene.

    Every pose counts once, as in `explore`, which visits a part of the poses.

    Returns:
      float64 [S, K, K], see `seen_together`.
    """
    parts = np.split(bank.rows, bank.first_cell[1:] * bank.task.rules.poses_per_cell)
    return np.stack([seen_together(rows, len(bank.task.categories)) for rows in parts])


def expected(counts: np.ndarray) -> np.ndarray:
    """Return the expected co-occurrence of counts.

    w_ij = n_ij / sum_k n_ik over j, k != i (equation 6 with counts for alpha).

    Args:
      counts: real [..., K, K], counts or concentrations, >= 0; the diagonal is ignored.

    Returns:
      float64 [..., K, K], 0 on the diagonal; rows add up to 1, but rows without counts are 0.
    """
    others = counts * (1.0 - np.eye(counts.shape[-1]))
    total = others.sum(axis=-1, keepdims=True)
    return others / np.where(total > 0, total, 1.0)


def layout_gap(counts: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the divergence of scenes from a prior.

    It is the mean over i of KL(p_i || q_i) = sum_{j != i} p_ij ln(p_ij / q_ij), where p_ij = 0.95 w_ij + 0.05 / (K - 1)
    with w = `expected(counts)`, and q follows from the prior in the same way. The mean is over the categories i that
    are seen together with others in the scene.

    Args:
      counts: real [S, K, K], see `scene_counts`.
      prior: real [K, K], or [S, K, K] for a prior of each scene: counts or concentrations.

    Returns:
      float64 [S], nats, >= 0; NaN for a scene in which nothing is seen together.
    """
    others = 1.0 - np.eye(counts.shape[-1])
    p, q = ((1.0 - UNIFORM) * expected(n) + UNIFORM * others / (len(others) - 1) for n in (counts, prior))
    divergence = (p * np.log(np.where(others, p, 1.0) / np.where(others, q, 1.0))).sum(axis=-1)
    present = _present(counts)
    return _ratio((divergence * present).sum(axis=-1), present.sum(axis=-1))


def layout_similarity(counts: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the cosine similarity of scenes and a prior.

    It is sum_ij w_ij v_ij / sqrt(sum_ij w_ij^2 sum_ij v_ij^2) with w = `expected(counts)` and v = `expected(prior)`.
    The sums are over j != i and over the categories i that are seen together with others in the scene.

    Args:
      counts: real [S, K, K], see `scene_counts`.
      prior: real [K, K], or [S, K, K] for a prior of each scene: counts or concentrations.

    Returns:
      float64 [S], in [0, 1]; NaN for a scene in which nothing is seen together.
    """
    w, v = expected(counts), expected(prior) * _present(counts)[..., None]
    return _ratio((w * v).sum(axis=(-2, -1)), np.sqrt((w**2).sum(axis=(-2, -1)) * (v**2).sum(axis=(-2, -1))))


def _present(counts: np.ndarray) -> np.ndarray:
    """Return the categories seen with others, bool [..., K]."""
    return expected(counts).sum(axis=-1) > 0


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Divide, with NaN where the denominator is 0."""
    return np.divide(numerator, denominator, out=np.full(numerator.shape, np.nan), where=denominator > 0)
