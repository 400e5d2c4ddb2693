"""A planner that searches where it believes the goal to be.

It knows the floor plan and how often a look detects an object of the goal's category, and holds a belief over the sites
of the goal: a prior, times the probability that all looks so far were in vain. It walks to the pose that gains most
detection probability for every action, and, once the goal has been detected, the shortest way to success.
"""

from typing import NamedTuple

import numpy as np

from jaxnav.baselines.layout_model import Glimpse, LayoutModel
from jaxnav.baselines.sites import NUM_RELATIONS, Sites
from jaxnav.scenes.task import DONE

REPLAN = 4  # actions after which the planner thinks again


class Home(NamedTuple):
    """Hold what is known of a scene before a search.

    Attributes:
      sites: of the scene.
      successor: int [P, 6], pose after every action.
      best_length: int [P, K], L*, read only for a goal that has been detected.
    """

    sites: Sites
    successor: np.ndarray
    best_length: np.ndarray


class Search(NamedTuple):
    """Hold how a search went.

    Attributes:
      length: actions, Done included; the limit where it ran out.
      success: whether Done succeeded within the limit.
      glimpses: what the planner knew after 0, 1, 3, 7, ... actions.
    """

    length: int
    success: bool
    glimpses: list[Glimpse]


def search(home: Home, rates: np.ndarray, model: LayoutModel, goal: int, pose: int, limit: int) -> Search:
    """Search for a goal.

    Args:
      home: the scene.
      rates: float32 [K, L], see `detection_rates`.
      model: the prior.
      goal: index of the category.
      pose: start of the search.
      limit: actions at most.
    """
    sites, glimpses = home.sites, []
    categories, num_sites = sites.objects.shape
    views, chance = sites.views, rates[goal, sites.views.look]
    features = np.zeros((categories, NUM_RELATIONS, num_sites), bool)
    looks = np.zeros((rates.shape[1], num_sites), np.uint16)
    visited, detected = np.zeros(len(home.successor), bool), np.zeros(categories, bool)
    scores, missed, path = model.scores(goal, features, sites), np.zeros(num_sites), []
    for time in range(limit):
        seen = sites.seen[pose]
        if seen[goal] >= 0:
            length = time + int(home.best_length[pose, goal])
            return Search(min(length, limit), length <= limit, glimpses)
        if not visited[pose]:
            visited[pose] = True
            at, how = views.at(pose)
            looks[how, at] += 1
            missed[at] += np.log1p(-rates[goal, how])
            for category in np.flatnonzero(seen >= 0):
                detected[category] = True
                if not features[category, 0, seen[category]]:  # else it is one that was detected nearby
                    features[category] |= sites.relations[:, seen[category]]
                    scores, path = model.scores(goal, features, sites), []
        if time & (time + 1) == 0:
            glimpses.append(Glimpse(sites, features.copy(), looks.copy(), detected.copy()))
        if not path:
            found = np.bincount(views.pose, chance * _belief(scores + missed)[views.site], len(visited))
            found[visited] = 0.0
            path = _plan(home.successor, found, pose)
            if not path:  # the goal is in view from nowhere
                break
        pose = path.pop(0)
    return Search(limit, False, glimpses)


def _belief(scores: np.ndarray) -> np.ndarray:
    weights = np.exp(scores - scores.max())
    return weights / weights.sum()


def _plan(successor: np.ndarray, gain: np.ndarray, pose: int) -> list[int]:
    """Return the next poses towards the best viewpoint, if any.

    Args:
      successor: int [P, 6].
      gain: float64 [P], probability to detect the goal from each pose.
      pose: of the planner.
    """
    length, before = shortest_ways(successor, pose)
    rate = np.where(length > 0, gain / np.maximum(length, 1), 0.0)
    if not rate.any():
        return []
    target, path = int(rate.argmax()), []
    while target != pose:
        path.append(target)
        target = int(before[target])
    return path[::-1][:REPLAN]


def shortest_ways(successor: np.ndarray, pose: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths of shortest ways, and the poses before.

    Args:
      successor: int [P, 6].
      pose: where all ways start.

    Returns:
      int32 [P] each: actions from `pose`, -1 where there is no way; the last pose but one.
    """
    length, before = np.full((2, len(successor)), -1, np.int32)
    length[pose], frontier = 0, np.array([pose])
    for away in range(1, len(successor)):
        after, source = successor[frontier, :DONE].ravel(), np.repeat(frontier, DONE)
        new = length[after] < 0
        after, source = after[new], source[new]
        if not len(after):
            break
        length[after], before[after] = away, source
        frontier = np.unique(after)
    return length, before
