"""Single bits of an observation, as predictors of success.

A bit, or its complement, predicts whether Done would succeed with a balanced accuracy: the mean of the rates at which
it is right where Done succeeds and where it does not. It may not do better than the detection of the goal itself.

The scenes are fixed, and the detector's errors are independent from pose to pose. So a rate p over n poses has a
variance of p (1 - p) / n at most, and a bit is called better only if the difference is beyond chance for all bits and
goals together.
"""

import functools
from statistics import NormalDist
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation, State
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE
from jaxnav.scenes.task import ROTATE_LEFT, ROTATE_RIGHT

#: Probability that chance alone makes any bit of any goal look better than the goal's detection.
SIGNIFICANCE = 0.01


class Rates(NamedTuple):
    """Describe how often predictors are positive.

    Attributes:
      hits, alarms: float [...], the two rates.
      num_successes, num_others: of which many.
    """

    hits: np.ndarray
    alarms: np.ndarray
    num_successes: int
    num_others: int

    @property
    def accuracy(self) -> np.ndarray:
        """Return the balanced accuracy of each predictor or its complement."""
        return 0.5 + np.abs(self.hits - self.alarms) / 2

    @property
    def variance(self) -> np.ndarray:
        """Return the greatest variance of the accuracies.

        Laplace's rule keeps that of a rate of 0 or 1 above 0.
        """
        total = np.zeros_like(self.hits)
        for rate, number in ((self.hits, self.num_successes), (self.alarms, self.num_others)):
            smooth = (rate * number + 1) / (number + 2)
            total += smooth * (1 - smooth) / number
        return total / 4

    def better(self, reference: "Rates", num_comparisons: int) -> np.ndarray:
        """Return which are more accurate than a reference, beyond chance."""
        quantile = NormalDist().inv_cdf(1 - SIGNIFICANCE / num_comparisons)
        return self.accuracy - reference.accuracy > quantile * np.sqrt(self.variance + reference.variance)


class Leaks(NamedTuple):
    """Describe what predicts success better than the goal's detection does.

    Attributes:
      bits: (goal, array, bit) of each.
      goals: those of which a bit that is always right would be among them.
      num_goals: of all.
    """

    bits: set[tuple[int, str, int]]
    goals: list[int]
    num_goals: int


def step_into(env: ObjectNav, state: State, params: EnvParams) -> dict[str, Observation]:
    """Return what a step into a state shows, by name.

    The step is a turn to the right, from the heading to the left.
    """
    before = state.replace(pose=env.next_pose(state.pose, jnp.int32(ROTATE_LEFT), params))
    observation, _, _, _, _, info = env.step(jax.random.key(0), before, jnp.int32(ROTATE_RIGHT), params)
    return {"observation": observation, "final_observation": info["final_observation"]}


def find_leaks(env: ObjectNav, params: EnvParams, bank: Bank) -> Leaks:
    """Return bits that predict success better than the goal's detection.

    Args:
      env, params: the environment, whose steps show the bits.
      bank: the scenes of `params`, all poses of which are visited.
    """
    show = jax.jit(jax.vmap(functools.partial(step_into, env), (0, None)))
    succeed = jax.jit(jax.vmap(env.done_succeeds, (0, None)))
    leaks = Leaks(set(), [], int(env.task.is_goal().sum()))
    for goal in np.flatnonzero(env.task.is_goal()).tolist():
        states, possible = _states(bank, goal)
        succeeds = np.asarray(succeed(states, params))[possible]
        arrays = _named(show(states, params))
        reference = _by_detection(env, arrays["observation.row"][possible], goal, succeeds)
        counts = int(succeeds.sum()), int((~succeeds).sum())
        comparisons = leaks.num_goals * 8 * sum(array.shape[1] for array in arrays.values())
        if Rates(np.ones(1), np.zeros(1), *counts).better(reference, comparisons):
            leaks.goals.append(goal)
        for name, array in arrays.items():
            bits = np.unpackbits(array[possible], axis=1, bitorder="little")
            rates = Rates(bits[succeeds].mean(axis=0), bits[~succeeds].mean(axis=0), *counts)
            better = rates.better(reference, comparisons)
            if name.endswith(".row"):
                better.reshape(-1, 8)[_detection_bytes(env)[goal]] = False
            leaks.bits.update((goal, name, bit) for bit in np.flatnonzero(better).tolist())
    return leaks


def _states(bank: Bank, goal: int) -> tuple[State, np.ndarray]:
    """Return all poses, and where a goal is possible."""
    counts = bank.num_cells * bank.task.rules.poses_per_cell
    scene = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    possible = np.array([goal in goals[:number] for goals, number in zip(bank.goals, bank.num_goals, strict=True)])
    pose = jnp.arange(len(scene), dtype=jnp.int32)
    return State(pose=pose, scene=jnp.asarray(scene), goal=jnp.full_like(pose, goal), time=0 * pose), possible[scene]


def _named(shown: dict[str, Observation]) -> dict[str, np.ndarray]:
    """Return the bytes uint8 [P, ...] of arrays, by name."""
    leaves = jax.tree_util.tree_leaves_with_path(shown)
    arrays = {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in leaves}
    return {name: np.ascontiguousarray(a).reshape(len(a), -1).view(np.uint8) for name, a in arrays.items()}


def _detection_bytes(env: ObjectNav) -> np.ndarray:
    """Return the bytes of each detection, int [K, 4]."""
    return env.row_format.detections(np.arange(env.row_format.num_bytes))


def _by_detection(env: ObjectNav, rows: np.ndarray, goal: int, succeeds: np.ndarray) -> Rates:
    """Return the best predictor by the goal's detection.

    Where success is to be near, whatever is seen, it is that of a full turn, one prediction a cell.
    """
    detection = env.row_format.detections(rows)[:, goal].astype(float)
    missing = detection[:, 0] == 0
    distance = np.hypot(detection[:, 1] / AHEAD_SCALE, (detection[:, 2] - 128) / RIGHT_SCALE)
    scores = np.where(missing, np.inf, [distance, -detection[:, 0]])
    if env.task.rules.success == "near":
        scores = scores.reshape(2, -1, env.task.rules.poses_per_cell).min(axis=-1)
        succeeds = succeeds[:: env.task.rules.poses_per_cell]
    return max((_best_threshold(score, succeeds) for score in scores), key=lambda rates: rates.accuracy)


def _best_threshold(score: np.ndarray, succeeds: np.ndarray) -> Rates:
    """Return the predictor `score <= threshold` of the best threshold."""
    thresholds = np.unique(score)[:, None]
    hits, alarms = ((score[group] <= thresholds).mean(axis=1) for group in (succeeds, ~succeeds))
    best = Rates(hits, alarms, 1, 1).accuracy.argmax()
    return Rates(hits[best], alarms[best], int(succeeds.sum()), int((~succeeds).sum()))
