"""A planner that searches where it believes the goal to be.

The planner knows the floor plan and how often a look detects an object of the goal's category. Its belief over the
sites of the goal is a prior times the probability that all looks so far were in vain. `search_for_goal` walks to the
pose that gains most detection probability per action. Once the goal is detected, it takes a shortest path to success.
"""

from typing import NamedTuple

import numpy as np

from jaxnav.baselines.layout_model import LayoutModel, PlannerSnapshot
from jaxnav.baselines.sites import NUM_RELATIONS, Sites
from jaxnav.scenes.task import DONE

REPLAN_INTERVAL = 4  # actions after which the planner replans


class PlannerScene(NamedTuple):
    """Knowledge of a scene before a search.

    Attributes:
      sites: sites of the scene.
      successor: int [P, 6], pose after every action.
      best_length: int [P, K], shortest path lengths L*, used only for a goal that has been detected.
    """

    sites: Sites
    successor: np.ndarray
    best_length: np.ndarray


class SearchResult(NamedTuple):
    """Result of a search.

    Attributes:
      length: number of actions, Done included; the limit if the search failed.
      success: True if Done succeeded within the limit.
      snapshots: the planner's knowledge after 0, 1, 3, 7, ... actions.
    """

    length: int
    success: bool
    snapshots: list[PlannerSnapshot]


def search_for_goal(
    scene: PlannerScene, rates: np.ndarray, model: LayoutModel, goal: int, pose: int, limit: int
) -> SearchResult:
    """Search for a goal.

    Args:
      scene: the scene.
      rates: float32 [K, L], see `estimate_detection_rates`.
      model: the prior.
      goal: index of the category.
      pose: start of the search.
      limit: greatest number of actions.
    """
    sites = scene.sites
    views = sites.views
    num_categories, num_sites = sites.object_sites.shape
    num_poses = len(scene.successor)
    view_rates = rates[goal, views.look]  # [M]

    # Knowledge: relations to detected objects, looks and visited poses.
    features = np.zeros((num_categories, NUM_RELATIONS, num_sites), bool)
    look_counts = np.zeros((rates.shape[1], num_sites), np.uint16)
    visited = np.zeros(num_poses, bool)
    detected = np.zeros(num_categories, bool)

    # Log belief of each site: score of the prior, and log probability of the looks in vain.
    scores = model.scores(goal, features, sites)
    log_miss = np.zeros(num_sites)
    snapshots = []
    path = []
    for time in range(limit):
        # A detected goal ends the search: the shortest path is known.
        detected_site = sites.detected_site[pose]
        if detected_site[goal] >= 0:
            length = time + int(scene.best_length[pose, goal])
            return SearchResult(min(length, limit), length <= limit, snapshots)

        # Take in the looks and the detections of a new pose. A new clue makes the path obsolete.
        if not visited[pose]:
            visited[pose] = True
            site, look = views.from_pose(pose)
            look_counts[look, site] += 1
            log_miss[site] += np.log1p(-rates[goal, look])
            for category in np.flatnonzero(detected_site >= 0):
                detected[category] = True
                if not features[category, 0, detected_site[category]]:  # else an object that was detected nearby
                    features[category] |= sites.relations[:, detected_site[category]]
                    scores = model.scores(goal, features, sites)
                    path = []
        if time & (time + 1) == 0:
            snapshots.append(PlannerSnapshot(sites, features.copy(), look_counts.copy(), detected.copy()))

        # Plan towards the pose with the best chance to detect the goal, unless a path is left to walk.
        if not path:
            site_gain = view_rates * _belief(scores + log_miss)[views.site]
            gain = np.bincount(views.pose, site_gain, num_poses)
            gain[visited] = 0.0
            path = _plan_path(scene.successor, gain, pose)
            if not path:  # no unvisited pose can show the goal
                break
        pose = path.pop(0)
    return SearchResult(limit, False, snapshots)


def _belief(scores: np.ndarray) -> np.ndarray:
    """Return the softmax of scores."""
    weights = np.exp(scores - scores.max())
    return weights / weights.sum()


def _plan_path(successor: np.ndarray, gain: np.ndarray, pose: int) -> list[int]:
    """Return the next poses towards the pose with the highest gain per action; empty if no pose gains anything.

    Args:
      successor: int [P, 6].
      gain: float64 [P], probability to detect the goal from each pose.
      pose: pose of the planner.
    """
    length, predecessor = shortest_paths(successor, pose)
    gain_per_action = np.where(length > 0, gain / np.maximum(length, 1), 0.0)
    if not gain_per_action.any():
        return []

    # Follow the path back from the target.
    path_pose = int(gain_per_action.argmax())
    path = []
    while path_pose != pose:
        path.append(path_pose)
        path_pose = int(predecessor[path_pose])
    return path[::-1][:REPLAN_INTERVAL]


def shortest_paths(successor: np.ndarray, pose: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths and predecessors of shortest paths from a pose, by breadth-first search.

    Args:
      successor: int [P, 6].
      pose: start of all paths.

    Returns:
      int32 [P] each: number of actions from `pose`, and the last pose but one; -1 without a path.
    """
    length = np.full(len(successor), -1, np.int32)
    predecessor = np.full(len(successor), -1, np.int32)
    length[pose] = 0
    frontier = np.array([pose])
    for distance in range(1, len(successor)):
        # Poses that are reached for the first time, with the poses that lead there.
        next_poses = successor[frontier, :DONE].ravel()
        sources = np.repeat(frontier, DONE)
        is_new = length[next_poses] < 0
        next_poses = next_poses[is_new]
        if not len(next_poses):
            break
        length[next_poses] = distance
        predecessor[next_poses] = sources[is_new]
        frontier = np.unique(next_poses)
    return length, predecessor
