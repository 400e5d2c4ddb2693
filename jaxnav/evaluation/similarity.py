"""Co-occurrence of categories in a scene, and its fit to a layout prior.

`cooccurrence_counts` counts how often two categories are detected together. `scene_layout_gap` (a divergence) and
`scene_layout_similarity` (a cosine) compare these counts with a prior.
"""

import numpy as np

from jaxnav.evaluation.statistics import divide_or_nan
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat

#: Share of the uniform distribution in both sides of the layout gap, which keeps it finite.
UNIFORM_SHARE = 0.05


def cooccurrence_counts(bank: Bank) -> np.ndarray:
    """Count the co-occurrence of categories in each scene.

    Every pose counts once, unlike in `explore`, which visits only part of the poses.

    Returns:
      float64 [S, K, K], see `count_co_detections`.
    """
    # The rows of a bank follow each other scene by scene.
    first_pose = bank.first_cell[1:] * bank.task.rules.poses_per_cell
    num_categories = len(bank.task.categories)
    scene_counts = []
    for scene_rows in np.split(bank.rows, first_pose):
        scene_counts.append(count_co_detections(scene_rows, num_categories))
    return np.stack(scene_counts)


def count_co_detections(rows: np.ndarray, num_categories: int) -> np.ndarray:
    """Count the poses at which two categories are detected together.

    Args:
      rows: uint8 [P, R], see `RowFormat`.
      num_categories: K.

    Returns:
      float64 [K, K], n_ij, symmetric, whole numbers, 0 on the diagonal.
    """
    # A product of the presence matrix [P, K] with itself counts the poses that show both categories.
    presence = RowFormat(num_categories).presence(rows).astype(np.float64)
    co_detections = presence.T @ presence
    np.fill_diagonal(co_detections, 0.0)
    return co_detections


def expected_cooccurrence(counts: np.ndarray) -> np.ndarray:
    """Compute the expected co-occurrence from counts.

    w_ij = n_ij / sum_k n_ik over j, k != i (equation 6 with counts for alpha).

    Args:
      counts: real [..., K, K], counts or concentrations, >= 0; the diagonal is ignored.

    Returns:
      float64 [..., K, K], 0 on the diagonal; rows add up to 1, rows without counts to 0.
    """
    # Rows of categories without any other stay 0 instead of NaN.
    off_diagonal = counts * (1.0 - np.eye(counts.shape[-1]))
    row_sums = off_diagonal.sum(axis=-1, keepdims=True)
    return off_diagonal / np.where(row_sums > 0, row_sums, 1.0)


def scene_layout_gap(counts: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Compute the divergence of scenes from a prior.

    The gap is the mean over i of KL(p_i || q_i) = sum_{j != i} p_ij ln(p_ij / q_ij), with p_ij = 0.95 w_ij +
    0.05 / (K - 1) and w = `expected_cooccurrence(counts)`; q follows from the prior in the same way. The mean is over
    the categories i that are seen together with another one in the scene.

    Args:
      counts: real [S, K, K], see `cooccurrence_counts`.
      prior: real [K, K], or [S, K, K] for a prior of each scene: counts or concentrations.

    Returns:
      float64 [S], nats, >= 0; NaN for a scene without co-occurrence.
    """
    # A share of the uniform distribution keeps both sides above 0 off the diagonal.
    off_diagonal = 1.0 - np.eye(counts.shape[-1])
    p = _mix_with_uniform(expected_cooccurrence(counts), off_diagonal)
    q = _mix_with_uniform(expected_cooccurrence(prior), off_diagonal)

    # KL divergence of every row, [S, K]; the diagonal contributes 0.
    log_ratio = np.log(np.where(off_diagonal, p, 1.0) / np.where(off_diagonal, q, 1.0))
    row_divergence = (p * log_ratio).sum(axis=-1)

    # The mean is over the rows that the scene determines.
    has_others = _has_cooccurrence(counts)
    return divide_or_nan((row_divergence * has_others).sum(axis=-1), has_others.sum(axis=-1))


def scene_layout_similarity(counts: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Compute the cosine similarity of scenes and a prior.

    The similarity is sum_ij w_ij v_ij / sqrt(sum_ij w_ij^2 sum_ij v_ij^2) with w = `expected_cooccurrence(counts)` and
    v = `expected_cooccurrence(prior)`. The sums are over j != i and over the categories i that are seen together with
    another one in the scene.

    Args:
      counts: real [S, K, K], see `cooccurrence_counts`.
      prior: real [K, K], or [S, K, K] for a prior of each scene: counts or concentrations.

    Returns:
      float64 [S], in [0, 1]; NaN for a scene without co-occurrence.
    """
    # Rows that the scene does not determine are 0 on both sides.
    w = expected_cooccurrence(counts)
    v = expected_cooccurrence(prior) * _has_cooccurrence(counts)[..., None]

    # Cosine of both matrices, taken as vectors of K * K entries.
    dot_product = (w * v).sum(axis=(-2, -1))
    norms = np.sqrt((w**2).sum(axis=(-2, -1)) * (v**2).sum(axis=(-2, -1)))
    return divide_or_nan(dot_product, norms)


def _mix_with_uniform(cooccurrence: np.ndarray, off_diagonal: np.ndarray) -> np.ndarray:
    """Mix rows [..., K, K] with the uniform distribution over the other categories."""
    return (1.0 - UNIFORM_SHARE) * cooccurrence + UNIFORM_SHARE * off_diagonal / (len(off_diagonal) - 1)


def _has_cooccurrence(counts: np.ndarray) -> np.ndarray:
    """Mask of the categories that are seen together with another one, bool [..., K]."""
    return expected_cooccurrence(counts).sum(axis=-1) > 0
