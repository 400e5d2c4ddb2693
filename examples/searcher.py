"""An agent without training: walk ahead, turn at obstacles and towards the goal, and say Done within 1.4 m of it.

jaxnav eval examples.searcher:searcher                     # from the root of the repository
jaxnav eval examples.searcher:searcher --benchmark v2
"""

import numpy as np

import jaxnav

rng = np.random.default_rng(0)


def searcher(observations: dict[str, np.ndarray]) -> np.ndarray:
    """Choose an action for each of B episodes, int [B]; docs/evaluate_your_agent.md describes the observations."""
    episodes = np.arange(len(observations["goal"]))
    confidence, ahead, right, _ = observations["detections"][episodes, observations["goal"]].T
    middle = observations["view"].shape[2] // 2
    is_free = observations["view"][:, 1, middle] == 1  # the cell ahead

    explore = np.where(is_free & (rng.random(len(episodes)) < 0.8), jaxnav.MOVE_AHEAD, jaxnav.ROTATE_RIGHT)
    bearing = np.arctan2(right, ahead)  # radians
    approach = np.select([bearing > 0.5, bearing < -0.5], [jaxnav.ROTATE_RIGHT, jaxnav.ROTATE_LEFT], explore)
    is_near = np.hypot(ahead, right) < 1.4
    return np.where(confidence < 0.5, explore, np.where(is_near, jaxnav.DONE, approach))
