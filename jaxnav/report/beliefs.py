"""Heat maps of a search by belief: where the agent expects the goal, at every choice of a target.

`BeliefTracer` repeats the map of a played episode and computes the belief after the removal of experience, if there is
any. Other methods have no belief over places.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.evaluation.playback import EpisodeTrace, make_percepts
from jaxnav.policies.methods.belief import TargetPolicy
from jaxnav.policies.methods.belief_map import read_squares
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import SQUARE_CELLS, SearchState
from jaxnav.policies.network import Params, bind
from jaxnav.runs.policies import Policies
from jaxnav.scenes.scene import CELL_SIZE, Scene, scene_extent
from jaxnav.scenes.tables.compile import Bank

#: Metres along each side of a square of the map.
SQUARE_SIZE = SQUARE_CELLS * CELL_SIZE
#: Episodes are padded to multiples of this number of steps, so that few lengths are compiled.
_PADDED_STEPS = 50


@dataclasses.dataclass(frozen=True)
class SquareGrid:
    """Squares of the map that cover a home.

    Attributes:
      low_corner: float64 [2], world (x, z) of the lowest corner of the first square.
      rows, columns: indices of the squares on the toroidal map, along z and x.
    """

    low_corner: np.ndarray
    rows: np.ndarray
    columns: np.ndarray


class BeliefTracer:
    """Computes the beliefs of the first policy of a run; one compilation serves episodes of similar lengths."""

    def __init__(self, policies: Policies) -> None:
        """Use the first seed with layout weights."""
        self._policies = policies
        self._params = jax.tree.map(lambda leaf: leaf[0], policies.arm_params("layout"))
        self._compute = jax.jit(self._compute_beliefs)

    @staticmethod
    def supports(policies: Policies) -> bool:
        """Return True for policies that search by belief."""
        return policies.spec.method.policy_class is TargetPolicy

    def compute(self, trace: EpisodeTrace, bank: Bank, goal: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the steps [U] at which a target was chosen, and the belief before each choice, float32 [U, n, n].

        Args:
          trace: episode of T steps as the policy played it.
          bank: tables of its scene.
          goal: index of the category to search for.
        """
        # The end of an episode is repeated, and forgotten afterwards.
        num_steps = len(trace.pose)
        padding = -num_steps % _PADDED_STEPS
        inferred = trace.inferred
        inputs = (
            make_percepts(trace, bank.rows[trace.pose], bank.task.rules, goal),
            jnp.asarray(inferred.action_logits.argmax(axis=-1)),
            jnp.asarray(inferred.removal_weight),
            jnp.asarray(inferred.layout_weights),
        )
        padded_inputs = jax.tree.map(
            lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], padding, axis=0)]), inputs
        )
        is_decision, beliefs = self._compute(self._params, padded_inputs, jnp.int32(goal))
        steps = np.flatnonzero(np.asarray(is_decision)[:num_steps])
        return steps, np.asarray(beliefs)[steps]

    def _compute_beliefs(self, params: Params, inputs: Any, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return where a target is chosen, bool [T], and the belief there, float32 [T, n, n]; 0 elsewhere."""
        knowledge = self._policies.knowledge
        method = self._policies.spec.method
        control = method.control
        tracker = method.tracker
        policy = bind(self._policies.spec, params)
        assert isinstance(control, LocalPolicy)
        assert isinstance(policy, TargetPolicy)
        assert tracker is not None

        def compute_belief(state: SearchState, removal_weight: jax.Array, layout_weights: jax.Array) -> jax.Array:
            assert state.looks is not None
            squares = read_squares(state.cells, state.looks)
            return policy.goal_probabilities(squares, goal, layout_weights, removal_weight)

        def follow_step(state: SearchState, step_inputs: Any) -> tuple[SearchState, tuple[jax.Array, jax.Array]]:
            percept, choice, removal_weight, layout_weights = step_inputs
            state = tracker.update(state, knowledge, percept)
            is_decision = control.is_decision_step(state)

            # The belief is as expensive as a choice, and computed only there.
            belief_shape = jax.eval_shape(compute_belief, state, removal_weight, layout_weights)
            belief = jax.lax.cond(
                is_decision,
                lambda: compute_belief(state, removal_weight, layout_weights),
                lambda: jnp.zeros(belief_shape.shape, belief_shape.dtype),
            )
            _, next_state = control.act(choice, state, knowledge)
            return next_state, (is_decision, belief)

        _, outputs = jax.lax.scan(follow_step, tracker.init(knowledge), inputs)
        return outputs


def find_squares(scene: Scene, start: np.ndarray, num_squares: int) -> SquareGrid:
    """Return the squares that cover a home, on a map whose middle is the start of the episode.

    Args:
      scene: the home.
      start: float64 [2], world (x, z) of the start.
      num_squares: squares along each side of the toroidal map.
    """
    # Lowest corner of the square with index 0; the start is the middle of cell N / 2.
    num_cells = num_squares * SQUARE_CELLS
    origin = start - CELL_SIZE * (num_cells // 2 + 0.5)
    low, high = scene_extent(scene)
    first_square = np.floor((low - origin) / SQUARE_SIZE).astype(int)
    last_square = np.ceil((high - origin) / SQUARE_SIZE).astype(int)

    # A home that is longer than the map would show squares twice.
    num_shown = np.minimum(last_square - first_square, num_squares)
    columns, rows = (first_square[axis] + np.arange(num_shown[axis]) for axis in range(2))
    return SquareGrid(origin + SQUARE_SIZE * first_square, rows % num_squares, columns % num_squares)
