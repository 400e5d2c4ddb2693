"""The paper's metrics from the outcomes of episodes."""

from collections.abc import Sequence

import numpy as np

from jaxnav.evaluation.grid import Outcome

GOAL_RADIUS = 1.0  # metres that DTS takes off the distance to the goal


def episode_metrics(outcome: Outcome, best_length: np.ndarray, budgets: Sequence[int] = ()) -> dict[str, np.ndarray]:
    """Return the metrics of every episode.

    Args:
      outcome: leaves [..., E].
      best_length: int [E], L* in actions with Done.
      budgets: numbers of actions; `sr@N` is success within N.

    Returns:
      float64 [..., E] by name: `sr`, `spl`, `sae`, `timeout` (no Done before the step limit) and `wrong_done` (Done
      where it fails), each in [0, 1], and `dts` in metres. Every episode succeeds, times out or ends by a wrong Done.
    """
    success, done = np.asarray(outcome.success, np.float64), np.asarray(outcome.done, np.float64)
    length, moves = np.asarray(outcome.length), np.asarray(outcome.moves)
    return {
        "sr": success,
        "spl": success * best_length / length,
        "dts": np.maximum(np.asarray(outcome.distance, np.float64) - GOAL_RADIUS, 0.0),
        "sae": success * moves / np.maximum(length - 1, 1),
        "timeout": 1.0 - done,
        "wrong_done": done - success,
        **{f"sr@{budget}": success * (length <= budget) for budget in budgets},
    }
