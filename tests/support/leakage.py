"""Single bits of an observation as predictors of success.

A bit, or its complement, predicts whether Done would succeed. Its balanced accuracy is the mean of two rates: that of
right predictions where Done succeeds, and that of right predictions where Done fails. No bit may be more accurate than
the detection of the goal.

The scenes are fixed, and the detector's errors are independent from pose to pose. A rate p over n poses therefore has a
variance of at most p (1 - p) / n. A bit counts as more accurate only if the difference is beyond chance for all bits
and goals together.
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


class PredictorRates(NamedTuple):
    """How often predictors are positive.

    Attributes:
      hit_rates: float [...], share of positive predictions where Done succeeds.
      false_alarm_rates: float [...], share of positive predictions where Done fails.
      num_successes: number of predictions where Done succeeds.
      num_failures: number of predictions where Done fails.
    """

    hit_rates: np.ndarray
    false_alarm_rates: np.ndarray
    num_successes: int
    num_failures: int

    @property
    def accuracy(self) -> np.ndarray:
        """Balanced accuracy of each predictor or of its complement, whichever is more accurate."""
        return 0.5 + np.abs(self.hit_rates - self.false_alarm_rates) / 2

    @property
    def variance(self) -> np.ndarray:
        """Upper bound of the variance of the accuracies.

        Laplace's rule keeps the variance of a rate of 0 or 1 above 0.
        """
        hit_variance = _rate_variance(self.hit_rates, self.num_successes)
        return (hit_variance + _rate_variance(self.false_alarm_rates, self.num_failures)) / 4

    def exceed(self, reference: "PredictorRates", num_comparisons: int) -> np.ndarray:
        """True for predictors that are more accurate than a reference, beyond chance in all comparisons together."""
        quantile = NormalDist().inv_cdf(1 - SIGNIFICANCE / num_comparisons)
        return self.accuracy - reference.accuracy > quantile * np.sqrt(self.variance + reference.variance)


def _rate_variance(rates: np.ndarray, num_predictions: int) -> np.ndarray:
    """Variance of rates over a number of independent predictions, with Laplace's rule."""
    smooth_rates = (rates * num_predictions + 1) / (num_predictions + 2)
    return smooth_rates * (1 - smooth_rates) / num_predictions


class Leaks(NamedTuple):
    """Bits that predict success better than the goal's detection does.

    Attributes:
      bits: (goal, array, bit) of each bit.
      goals: goals for which a perfect predictor would be found.
      num_goals: number of all goals.
    """

    bits: set[tuple[int, str, int]]
    goals: list[int]
    num_goals: int


def step_into(env: ObjectNav, state: State, params: EnvParams) -> dict[str, Observation]:
    """Return the observations of a step into a state, by name.

    The step is a turn to the right, from the heading on the left.
    """
    left_state = state.replace(pose=env.next_pose(state.pose, jnp.int32(ROTATE_LEFT), params))
    observation, _, _, _, _, info = env.step(jax.random.key(0), left_state, jnp.int32(ROTATE_RIGHT), params)
    return {"observation": observation, "final_observation": info["final_observation"]}


def find_leaks(env: ObjectNav, params: EnvParams, bank: Bank) -> Leaks:
    """Return the bits that predict success better than the goal's detection.

    Args:
      env: the environment; its steps show the bits.
      params: parameters of the environment.
      bank: the scenes of `params`, all poses of which are visited.
    """
    observe = jax.jit(jax.vmap(functools.partial(step_into, env), (0, None)))
    done_succeeds = jax.jit(jax.vmap(env.done_succeeds, (0, None)))
    is_goal = env.task.is_goal()
    leaks = Leaks(set(), [], int(is_goal.sum()))
    for goal in np.flatnonzero(is_goal).tolist():
        # The predictor by the goal's detection, in the scenes in which the goal is possible.
        states, is_possible = _all_states(bank, goal)
        succeeds = np.asarray(done_succeeds(states, params))[is_possible]
        arrays = _arrays_by_name(observe(states, params))
        reference = _detection_rates(env, arrays["observation.row"][is_possible], goal, succeeds)

        # Whether a bit that is always right would be found.
        num_bits = 8 * sum(array.shape[1] for array in arrays.values())
        num_comparisons = leaks.num_goals * num_bits
        num_poses = (int(succeeds.sum()), int((~succeeds).sum()))
        if PredictorRates(np.ones(1), np.zeros(1), *num_poses).exceed(reference, num_comparisons):
            leaks.goals.append(goal)

        # All bits of all arrays, except for the goal's detection itself.
        for name, array in arrays.items():
            bits = np.unpackbits(array[is_possible], axis=1, bitorder="little")
            rates = PredictorRates(bits[succeeds].mean(axis=0), bits[~succeeds].mean(axis=0), *num_poses)
            is_leak = rates.exceed(reference, num_comparisons)
            if name.endswith(".row"):
                is_leak.reshape(-1, 8)[_detection_bytes(env)[goal]] = False
            leaks.bits.update((goal, name, bit) for bit in np.flatnonzero(is_leak).tolist())
    return leaks


def _all_states(bank: Bank, goal: int) -> tuple[State, np.ndarray]:
    """Return the states of all poses [P] with this goal, and bool [P], True in scenes in which the goal is possible."""
    num_poses = bank.num_cells * bank.task.rules.poses_per_cell
    scene = np.repeat(np.arange(len(num_poses), dtype=np.int32), num_poses)
    has_goal = np.array([goal in goals[:number] for goals, number in zip(bank.goals, bank.num_goals, strict=True)])
    pose = jnp.arange(len(scene), dtype=jnp.int32)
    states = State(pose=pose, scene=jnp.asarray(scene), goal=jnp.full_like(pose, goal), time=0 * pose)
    return states, has_goal[scene]


def _arrays_by_name(observations: dict[str, Observation]) -> dict[str, np.ndarray]:
    """Return the bytes uint8 [P, ...] of all arrays of observations, by name."""
    arrays = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(observations):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        array = np.ascontiguousarray(np.asarray(leaf))
        arrays[name] = array.reshape(len(array), -1).view(np.uint8)
    return arrays


def _detection_bytes(env: ObjectNav) -> np.ndarray:
    """Return the indices of the bytes of each detection, int [K, 4]."""
    return env.row_format.detections(np.arange(env.row_format.num_bytes))


def _detection_rates(env: ObjectNav, rows: np.ndarray, goal: int, succeeds: np.ndarray) -> PredictorRates:
    """Return the rates of the best predictor by the goal's detection.

    If an agent succeeds near the goal without seeing it, the detection is the best one of a full turn, with one
    prediction per cell.
    """
    # Scores that are low where success is likely: the distance to the goal, and the negative confidence.
    detection = env.row_format.detections(rows)[:, goal].astype(float)
    confidence = detection[:, 0]
    distance = np.hypot(detection[:, 1] / AHEAD_SCALE, (detection[:, 2] - 128) / RIGHT_SCALE)
    scores = np.where(confidence == 0, np.inf, [distance, -confidence])

    if env.task.rules.success == "near":
        poses_per_cell = env.task.rules.poses_per_cell
        scores = scores.reshape(2, -1, poses_per_cell).min(axis=-1)
        succeeds = succeeds[::poses_per_cell]
    return max((_best_threshold_rates(score, succeeds) for score in scores), key=lambda rates: rates.accuracy)


def _best_threshold_rates(score: np.ndarray, succeeds: np.ndarray) -> PredictorRates:
    """Return the rates of the predictor `score <= threshold` with the best threshold."""
    thresholds = np.unique(score)[:, None]
    hit_rates = (score[succeeds] <= thresholds).mean(axis=1)
    false_alarm_rates = (score[~succeeds] <= thresholds).mean(axis=1)
    best_index = PredictorRates(hit_rates, false_alarm_rates, 1, 1).accuracy.argmax()
    return PredictorRates(
        hit_rates[best_index], false_alarm_rates[best_index], int(succeeds.sum()), int((~succeeds).sum())
    )
