"""Ranks of weighted values."""

import numpy as np


def weight_below(values: np.ndarray, others: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum the weights of the others below each value.

    The weights of equal ones count half. With `others = values` these are ranks: midranks less a half where all weights
    are 1.

    Args:
      values: real [P].
      others: real [Q].
      weights: float [Q, R].

    Returns:
      [P, R], of the weights' dtype.
    """
    order = np.argsort(others)
    below = np.concatenate([np.zeros_like(weights[:1]), np.cumsum(weights[order], axis=0)])
    less, up_to = (np.searchsorted(others[order], values, side) for side in ("left", "right"))
    return (below[less] + below[up_to]) / 2
