"""The paper's metrics from the outcomes of episodes."""

import numpy as np

from jaxnav.evaluation.grid import Outcome

GOAL_RADIUS = 1.0  # metres that DTS takes off the distance to the goal


def episode_metrics(outcome: Outcome, best_length: np.ndarray) -> dict[str, np.ndarray]:
    """Return SR, SPL, SAE and DTS of every episode.

    Args:
      outcome: leaves [..., E].
      best_length: int [E], L* in actions with Done.

    Returns:
      float64 [..., E] by the names `sr`, `spl`, `sae` (each in [0, 1]) and `dts` (metres).
    """
    success = np.asarray(outcome.success, np.float64)
    length, moves = np.asarray(outcome.length), np.asarray(outcome.moves)
    return {
        "sr": success,
        "spl": success * best_length / length,
        "dts": np.maximum(np.asarray(outcome.distance, np.float64) - GOAL_RADIUS, 0.0),
        "sae": success * moves / np.maximum(length - 1, 1),
    }
