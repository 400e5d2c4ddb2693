"""Belief: a search that predicts where the goal is, and goes where detection is likeliest.

Idea: A. J. Zhai and S. Wang, *PEANUT: Predicting and Navigating to Unseen Targets*, ICCV 2023 (arXiv 2212.02497), which
predicts where the goal is from a semantic map; and Bayesian search, in which a look that does not detect the goal
lowers the probability of the places in view.

The map, the detections and the local policy are those of SemExp (`map_tracker`, `local_policy`). Every five actions, or
when the target is reached or refuted, the policy scores all squares of the map. With the belief P over squares and the
squares C(t) around a target t, its score is the log of the probability of detecting the goal there, per action:

    score(t) = log P(C(t)) - log(actions to t)         P(c) ~ exp(score of c) * P(looks so far miss a goal in c)

Scores are a sum, so eq. 1 is exact. *Direct* is `DirectScore`, which sees floor, walls and unexplored space and is
alike for all categories; looks in vain belong to it. *Experience* is what a `Predictor` adds by the categories seen so
far: the score under its belief less the direct score. Removing experience leaves the agent that knows places alone, bit
for bit.

Predictors:
  `LogLinear`: weights of the categories seen within 0.5, 1, 2 and 4 m of a square, and of the floor, for each goal.
  `Dirichlet`: the goal's column of w (eq. 6), spread over the squares around each detection.

Both are fitted by conditional likelihood to searches in training homes (`belief_fit`). A predictor of your own is a
subclass of `Predictor`, and `make_belief_method` makes a method of it.
"""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.causal import remove_from_sum
from jaxnav.errors import InputError
from jaxnav.layout import scale_weights
from jaxnav.numerics.rounding import round_to_grid
from jaxnav.numerics.trees import map_selected_rows
from jaxnav.policies.features import Features
from jaxnav.policies.method import Experience, Knowledge, Method, Percept
from jaxnav.policies.methods.belief_fit import fit_belief
from jaxnav.policies.methods.belief_map import (
    NO_TARGET_SCORE,
    NUM_FLOOR_FEATURES,
    RADII,
    MapSquares,
    floor_features,
    missed_looks,
    nearby_categories,
    read_squares,
    relation_scores,
    score_targets,
    travel_costs,
)
from jaxnav.policies.methods.local_policy import LocalPolicy
from jaxnav.policies.methods.map_tracker import (
    NUM_LOOK_DISTANCES,
    SQUARE_CELLS,
    MapTracker,
    SearchState,
    is_new_view,
    learned_view_table,
    nearest_looks,
    other_category_bits,
)
from jaxnav.policies.methods.semexp import learn_search_setup, required_map_sizes
from jaxnav.policies.network import Policy
from jaxnav.policies.pathways import NO_ACTION, Decision, EncodedPathways, Pathways, PolicyInputs, PolicyState
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.tables.observation_row import RowFormat

#: Cells along each side of the map, 24 m.
MAP_CELLS = 96
#: Squares along each side of the map.
MAP_SQUARES = MAP_CELLS // SQUARE_CELLS

#: Hidden units of the perceptron for the floor around a square.
_FLOOR_HIDDEN = 8
#: Smallest relative weight whose log `Dirichlet` spreads.
_MIN_RELATIVE_WEIGHT = 0.05
#: Initial log odds that an object is hidden from all looks: one in twenty.
_INITIAL_HIDDEN_LOGIT = -3.0
#: Largest number of looks at a square that is counted.
_MAX_LOOKS = 255


# Tracker and control


class BeliefReading(NamedTuple):
    """Inputs of the policy from the tracker.

    Attributes:
      cells: uint32 [..., N, N], the map.
      looks: uint8 [..., D, n, n], looks at each square.
      position: int32 [..., 2], (z, x) of the agent's cell.
      is_due: bool [...], True where the policy chooses a target now; elsewhere nothing is computed.
    """

    cells: jax.Array
    looks: jax.Array
    position: jax.Array
    is_due: jax.Array


@dataclasses.dataclass(frozen=True)
class BeliefTracker(MapTracker):
    """SemExp's tracker, which also counts the looks at each square."""

    def init(self, knowledge: Knowledge) -> SearchState:
        """Return an empty map with the agent at its centre."""
        looks_shape = (NUM_LOOK_DISTANCES, MAP_SQUARES, MAP_SQUARES)
        return super().init(knowledge)._replace(looks=jnp.zeros(looks_shape, jnp.uint8))

    def update(self, state: SearchState, knowledge: Knowledge, percept: Percept) -> SearchState:
        """Draw a view on the map and count the looks."""
        next_state = super().update(state, knowledge, percept)
        row_format = RowFormat(knowledge.priors.shape[-1])
        view_table = learned_view_table(knowledge.method, row_format.view)

        # Only a new view is new evidence.
        distance_bin = nearest_looks(
            percept.row, next_state.position, percept.heading, row_format, view_table, len(state.cells)
        )
        look_bins = np.arange(NUM_LOOK_DISTANCES, dtype=np.int32)[:, None, None]
        assert state.looks is not None
        is_look = is_new_view(percept) & (distance_bin[None] == look_bins) & (state.looks < _MAX_LOOKS)
        return next_state._replace(looks=state.looks + is_look.astype(jnp.uint8))

    def read(self, state: SearchState, knowledge: Knowledge, goal: jax.Array) -> BeliefReading:  # type: ignore[override]
        """Return the map and the looks; the policy computes the belief only where a target is due."""
        assert state.looks is not None
        return BeliefReading(state.cells, state.looks, state.position, TargetControl().is_decision_step(state))


@dataclasses.dataclass(frozen=True)
class TargetControl(LocalPolicy):
    """SemExp's local policy, which walks to a chosen square of the map."""

    interval: int = 5

    @property
    def num_choices(self) -> int:
        """Number of squares."""
        return MAP_SQUARES**2

    def block_size(self, size: int) -> int:
        """Return the number of cells along each side of a square."""
        return SQUARE_CELLS

    def _find_block(self, choice: jax.Array, state: SearchState) -> jax.Array:
        # Squares are numbered row by row from the corner of the map.
        return SQUARE_CELLS * jnp.stack([choice // MAP_SQUARES, choice % MAP_SQUARES]).astype(jnp.int32)


# Predictors


class FloorPerceptron(nnx.Module):
    """Perceptron from the floor around a square to scores; initially 0.

    Attributes:
      hidden_kernel, hidden_bias, output_kernel, linear_kernel: parameters; the linear part skips the hidden layer.
    """

    def __init__(self, num_outputs: int, rngs: nnx.Rngs) -> None:
        hidden_kernel = 0.5 * jax.random.normal(rngs.params(), (_FLOOR_HIDDEN, NUM_FLOOR_FEATURES))
        self.hidden_kernel = nnx.Param(hidden_kernel)
        self.hidden_bias = nnx.Param(jnp.zeros(_FLOOR_HIDDEN))
        self.output_kernel = nnx.Param(jnp.zeros((num_outputs, _FLOOR_HIDDEN)))
        self.linear_kernel = nnx.Param(jnp.zeros((num_outputs, NUM_FLOOR_FEATURES)))

    def __call__(self, features: jax.Array, output: jax.Array | int) -> jax.Array:
        """Score squares, float32 [n, n], by features float32 [F, n, n], with one of the outputs."""
        hidden = jnp.tensordot(self.hidden_kernel[...], features, 1) + self.hidden_bias[...][:, None, None]
        by_hidden = jnp.tensordot(self.output_kernel[...][output], nnx.relu(hidden), 1)
        return by_hidden + jnp.tensordot(self.linear_kernel[...][output], features, 1)


class DirectScore(nnx.Module):
    """Score of a square by floor, walls and unexplored space, alike for all categories.

    Attributes:
      floor: perceptron with a single output.
    """

    def __init__(self, rngs: nnx.Rngs) -> None:
        self.floor = FloorPerceptron(1, rngs)

    def __call__(self, squares: MapSquares) -> jax.Array:
        """Score squares, float32 [n, n]."""
        return self.floor(floor_features(squares.floor), 0)


class Predictor(Experience):
    """What the categories seen so far add to the score of each square.

    Subclasses take `(spec, rngs)` and implement `score_squares`; their parameters are `nnx.Param`, and a new predictor
    should score 0.
    """

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.width = MAP_SQUARES**2

    def score_squares(self, squares: MapSquares, goal: jax.Array, weights: jax.Array) -> jax.Array:
        """Score the squares of one episode's map.

        Args:
          squares: the map.
          goal: int32 [], the category that is sought.
          weights: float32 [K], the goal's column of w (eq. 7).

        Returns:
          float32 [n, n], log odds that are added to those of `DirectScore`.
        """
        raise NotImplementedError

    def replace_other_categories(
        self, features: Features, reading: BeliefReading, other_features: Features, other_reading: BeliefReading
    ) -> tuple[Features, BeliefReading]:
        """Replace the categories on the map; floor, walls and the goal stay."""
        mixed_features, _ = super().replace_other_categories(features, reading, other_features, other_reading)
        replaced_bits = other_category_bits(features.goal)[..., None, None]
        cells = (reading.cells & ~replaced_bits) | (other_reading.cells & replaced_bits)
        return mixed_features, reading._replace(cells=cells)


class LogLinear(Predictor):
    """Weights of the categories nearby and of the floor, for each goal.

    Attributes:
      relations: float32 [K, R, K], by goal, radius and category.
      floor: perceptron with an output for each goal.
    """

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        num_categories = spec.num_categories
        self.relations = nnx.Param(jnp.zeros((num_categories, len(RADII), num_categories)))
        self.floor = FloorPerceptron(num_categories, rngs)

    def score_squares(self, squares: MapSquares, goal: jax.Array, weights: jax.Array) -> jax.Array:
        """Score squares; the layout's weights are not read."""
        by_relations = relation_scores(nearby_categories(squares.categories), self.relations[...][goal])
        return by_relations + self.floor(floor_features(squares.floor), goal)


class Dirichlet(Predictor):
    """The goal's column of w around each detection: categories that are seen with the goal more often than others.

    Attributes:
      radius_weights: float32 [R], weight of the log of the relative weights within each radius.
    """

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.radius_weights = nnx.Param(jnp.zeros(len(RADII)))

    def score_squares(self, squares: MapSquares, goal: jax.Array, weights: jax.Array) -> jax.Array:
        """Score squares by the log of the weights over their mean; the goal itself does not count."""
        log_weights = jnp.log(jnp.maximum(scale_weights(weights, goal), _MIN_RELATIVE_WEIGHT))
        log_weights = log_weights.at[goal].set(0.0)
        relation_weights = self.radius_weights[...][:, None] * log_weights[None]
        return relation_scores(nearby_categories(squares.categories), relation_weights)


# Policy


class LogBeliefs(NamedTuple):
    """Log probabilities that the goal is in each square, up to a constant.

    Attributes:
      places: float32 [n, n], by places and looks in vain.
      layout: float32 [n, n], by the predictor too.
    """

    places: jax.Array
    layout: jax.Array


class TargetPolicy(Policy):
    """Scores of the squares of the map as targets: direct scores plus experience.

    The pathway `scene` holds the direct scores, looks in vain included, `experience` what the predictor adds, and
    `goal` is empty. Logits are sums of rounded scores, so that removing experience leaves the direct scores exactly.

    Attributes:
      method: the predictor.
      places: scores squares by floor and walls alone, without categories.
      detection_rates: float32 [K, D], probability that a look at a square detects an object of each category there.
      hidden_logit: float32 [], log odds that no look at its square shows an object, because something hides it.
    """

    has_additive_scores = True

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        self.row_format = RowFormat(spec.num_categories)
        self.adaptation = None
        predictor_class = spec.method.experience
        self.method = predictor_class(spec, rngs)
        self.places = DirectScore(rngs)
        self.detection_rates = nnx.Param(jnp.zeros((spec.num_categories, NUM_LOOK_DISTANCES)))
        self.hidden_logit = nnx.Param(jnp.float32(_INITIAL_HIDDEN_LOGIT))

    def log_beliefs(self, squares: MapSquares, goal: jax.Array, weights: jax.Array) -> LogBeliefs:
        """Belief over the squares of one episode's map.

        Args:
          squares: the map.
          goal: int32 [], the category that is sought.
          weights: float32 [K], the goal's column of w (eq. 7).
        """
        assert isinstance(self.experience, Predictor)
        missed = missed_looks(squares.looks, self.detection_rates[...][goal], self.hidden_logit[...])
        places = self.places(squares) + missed
        return LogBeliefs(places, places + self.experience.score_squares(squares, goal, weights))

    def goal_probabilities(
        self, squares: MapSquares, goal: jax.Array, weights: jax.Array, removal_weight: jax.Array | float = 0.0
    ) -> jax.Array:
        """Probability float32 [n, n] that the goal is in each square, after removal of a share of experience (eq. 2).

        Args:
          squares, goal, weights: as in `log_beliefs`.
          removal_weight: float32 [], the share s.
        """
        beliefs = self.log_beliefs(squares, goal, weights)
        # A removal weight is a gap without a threshold.
        gap = jnp.full(len(beliefs.places), removal_weight)
        remaining = remove_from_sum(beliefs.places, beliefs.layout - beliefs.places, gap, 0.0)
        return jax.nn.softmax(remaining, axis=(0, 1))

    def encode(self, inputs: PolicyInputs, partner_inputs: PolicyInputs | None = None) -> EncodedPathways:
        """Score the targets, which needs no memory; arguments as in `Policy.pathways`."""
        goal = inputs.observation.goal
        reading: Any = inputs.reading
        if partner_inputs is not None:
            features = self._unpack_goal(inputs)
            _, reading = self.experience.replace_other_categories(features, reading, features, partner_inputs.reading)

        # Only episodes in which a target is due are computed.
        rows: Any = (reading, goal, inputs.layout_weights)
        if goal.ndim == 0:
            rows = jax.tree.map(lambda leaf: leaf[None], rows)
        direct, experience = map_selected_rows(lambda row: self._score_row(*row), rows, rows[0].is_due)
        if goal.ndim == 0:
            direct, experience = direct[0], experience[0]
        ones = jnp.ones_like(direct[..., :1])
        return EncodedPathways(scene=direct, goal=direct[..., :0], experience=experience, gate=ones)

    def decide(self, pathways: Pathways, memory: PolicyState) -> Decision:
        """Add direct scores and experience."""
        logits = round_to_grid(pathways.scene) + round_to_grid(pathways.experience)
        return Decision(logits=logits, value=jnp.zeros(logits.shape[:-1]), hidden=memory.hidden, fast=memory.fast)

    def initial_memory(self, batch: tuple[int, ...] = ()) -> PolicyState:
        """Return the memory at the start of an episode, which holds only the previous action."""
        return PolicyState(hidden=jnp.zeros((*batch, 0)), action=jnp.full(batch, NO_ACTION, jnp.int32))

    def _score_row(self, reading: BeliefReading, goal: jax.Array, weights: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Direct scores and experience of one episode, float32 [n n] each."""
        squares = read_squares(reading.cells, reading.looks)
        beliefs = self.log_beliefs(squares, goal, weights)
        log_cost, has_target = travel_costs(reading.cells, reading.position)
        places_scores = score_targets(beliefs.places, log_cost)
        layout_scores = score_targets(beliefs.layout, log_cost)
        direct = jnp.where(has_target, places_scores, NO_TARGET_SCORE)
        experience = jnp.where(has_target, layout_scores - places_scores, 0.0)
        return direct.reshape(-1), experience.reshape(-1)

    def _unpack_goal(self, inputs: PolicyInputs) -> Features:
        """Features of which only the goal, one-hot, is read."""
        goal = jax.nn.one_hot(inputs.observation.goal, self.row_format.num_categories)
        return Features(view=goal, visible=goal, table=goal[..., None], goal=goal)


# The method


def learn_belief_setup(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return the setup of SemExp's search on the map of the belief.

    Args:
      banks: banks of training scenes, which share one task.
      counts: co-occurrence counts of exploration, unused.

    Raises:
      InputError: as `learn_search_setup`.
    """
    return learn_search_setup(banks, counts) | {"lines": np.arange(MAP_CELLS, dtype=np.int32)}


def check_belief_map(knowledge: Knowledge, bank: Bank) -> None:
    """Check that every scene of a bank fits on the map.

    Raises:
      InputError: a scene is too large.
    """
    for scene_name, required_size in required_map_sizes(bank).items():
        if required_size > MAP_CELLS:
            raise InputError(
                f"search on a map: scene {scene_name} needs a map of {required_size} x {required_size} cells, but the "
                f"map has {MAP_CELLS} x {MAP_CELLS}; leave the scene out"
            )


def make_belief_method(predictor: type[Predictor], name: str = "") -> Method:
    """Return the method that searches by the belief of a predictor."""
    return Method(
        predictor,
        tracker=BeliefTracker(),
        learn=learn_belief_setup,
        control=TargetControl(),
        check=check_belief_map,
        policy_class=TargetPolicy,
        fit=fit_belief,
        name=name,
    )


BELIEF = make_belief_method(LogLinear, "belief")
#: The paper's own estimator as the predictor.
DIRICHLET = make_belief_method(Dirichlet)
