"""The Dirichlet layout estimator, equations 3 to 6.

The estimator holds a belief about which categories are seen together: row i of `alpha` [K, K] parametrises a Dirichlet
distribution over the categories j != i that are visible together with category i. `LayoutEstimator.init` starts at the
prior alpha*, `LayoutEstimator.update` adds counts for the categories visible at a step (eqs. 3, 4) and measures the
layout gap D (eq. 5, or a gap of `jaxnav.gaps`), and `LayoutEstimator.expectation` is the expected co-occurrence w (eq.
6):

    estimator = LayoutEstimator(prior_from_counts(counts))
    state = estimator.init()
    state = estimator.update(state, presence)
    weights = LayoutEstimator.goal_weights(state, goal)

The estimator handles one episode; use `jax.vmap` for batches.

`ESTIMATORS` holds the configurations that have a name:
  `calibrated`: the default, with a rescaled prior and updates only where a gate is open.
  `paper`: equations 3 to 6 of the paper as printed, with instance counts.
  `released`: the layout estimator of the authors' released code.
  `evidence`: `calibrated`, with a layout gap that grows when the things seen together do not fit the training scenes.
"""

import dataclasses
import difflib
import typing
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.choices import Counts, Form, GapName, Reduction
from jaxnav.gaps import (
    CooccurrenceEvidence,
    PairSightings,
    evidence_gap,
    learned_gap,
    overdue_gap,
    seen_together,
    surprise_gap,
)
from jaxnav.numerics.dirichlet import MIN_CONCENTRATION, counts_kl, presence_kl


@dataclasses.dataclass(frozen=True)
class EstimatorConfig:
    """Configuration of the layout estimator (eqs. 3 to 6).

    The defaults equal `ESTIMATORS["calibrated"]`.

    Attributes:
      rows: rows that gain counts (eq. 3). `visible`: rows of the visible categories; `all`: every row, as eq. 3 is
        printed.
      reduction: over the rows' divergences in eq. 5: `mean_visible`, `mean` over all K, or `sum`.
      counts: n in eq. 3. `presence`: 1 for each visible category. `instances`: the number of its visible instances.
      increment: whole number from 1 to 50, added to alpha per count.
      own_column: a row also counts its own category, as in the released code; in the divergence of eq. 5 this entry
        has a concentration of 1 more.
      gate: update only where two or more categories are visible and the set differs from the last accepted one.
      gap: measure of the layout gap D, used only in evaluation. `reduction` acts on `novelty` alone, `decay` and
        `passes` on `novelty` and `clock`.
        `novelty`: how much the last view changed the belief (eq. 5).
        `evidence`: misfit between the counts of the episode and the prior (`evidence_gap`).
        `learned`: layout gap, the probability that the layout differs from training, from the pairs seen together. See
          `learned_gap`.
        `surprise`: layout gap, the probability that the layout differs from training, from the distances of pairs.
          They need not be in one view. See `surprise_gap`.
        `overdue`: layout gap, the probability that the goal would have been seen by now in the training layout. See
          `overdue_gap`.
        `clock`: layout gap that ignores the layout, as a control: 1 at each new set of visible categories, then decays.
          `novelty` behaves like this under `released`, because its sum over all rows saturates tanh.
        `none`: D stays 0, so that sTDE removes nothing.
      hold: the gap never falls within an episode.
      decay: the gap is multiplied by this factor in [0, 1] in each pass with the gate shut.
      passes: passes over one view that a single `update` reproduces, >= 1. The released code makes two per step; the
        second sees the same set and finds the gate shut, so that a new gap is already decayed once. 1 without the gate.
      strength: sum of every prior row after rescaling, > 0; None keeps the sums of the counts.
      uniform: share of the uniform distribution mixed into every prior row, in [0, 1].
      form: form of eq. 2 that evaluations use by default, see `jaxnav.causal.stde`; no effect on the estimator.

    Raises:
      ValueError: a value is out of its range.
    """

    rows: Literal["visible", "all"] = "visible"
    reduction: Reduction = "mean_visible"
    counts: Counts = "presence"
    increment: int = 1
    own_column: bool = False
    gate: bool = True
    gap: Literal[GapName, "none"] = "novelty"
    hold: bool = False
    decay: float = 0.8
    passes: int = 1
    strength: float | None = 20.0
    uniform: float = 0.05
    form: Form = "residual"

    def __post_init__(self):
        # Words must be among the options of the field.
        for name, hint in typing.get_type_hints(type(self)).items():
            options = typing.get_args(hint)
            if typing.get_origin(hint) is Literal and getattr(self, name) not in options:
                raise ValueError(f"{name} is {getattr(self, name)!r}: choose one of {', '.join(options)}")

        # Numbers must lie in the ranges that the docstring gives.
        for name, is_valid, requirement in (
            ("increment", isinstance(self.increment, int) and 1 <= self.increment <= 50, "a whole number from 1 to 50"),
            ("decay", 0 <= self.decay <= 1, "a number from 0 to 1"),
            ("passes", self.passes >= 1 and self.passes % 1 == 0, "a whole number of 1 or more"),
            ("passes", self.gate or self.passes == 1, "1, because later passes are reproduced for the gate alone"),
            ("strength", self.strength is None or 0 < self.strength < float("inf"), "a number above 0, or None"),
            ("uniform", 0 <= self.uniform <= 1, "a number from 0 to 1"),
        ):
            if not is_valid:
                raise ValueError(f"{name} is {getattr(self, name)!r}: give {requirement}")


#: Largest relative weight, see `scale_weights`. Without a bound, a rare goal's only companion would get up to K - 1.
MAX_RELATIVE_WEIGHT = 4.0
_MIN_MEAN_WEIGHT = 1e-6  # against division by zero

#: Configurations by name, see the docstring of the module. `evidence` leaves priors and weights w as in `calibrated`.
ESTIMATORS = {
    "paper": EstimatorConfig(
        rows="all", reduction="mean", counts="instances", gate=False, strength=None, uniform=0.0, form="paper"
    ),
    "released": EstimatorConfig(
        rows="all", reduction="sum", increment=5, own_column=True, passes=2, strength=None, uniform=0.0
    ),
    "calibrated": EstimatorConfig(),
    "evidence": EstimatorConfig(gap="evidence"),
}


def resolve_estimator(config: str | EstimatorConfig) -> EstimatorConfig:
    """Return the configuration of a name; an `EstimatorConfig` passes through.

    Raises:
      ValueError: unknown name; the message gives the nearest.
    """
    if isinstance(config, EstimatorConfig):
        return config
    if config not in ESTIMATORS:
        if config in typing.get_args(GapName):
            raise ValueError(f"estimator {config!r} is the name of a gap: give EstimatorConfig(gap={config!r})")
        nearest_name = difflib.get_close_matches(config, ESTIMATORS, n=1, cutoff=0.0)[0]
        raise ValueError(
            f"estimator {config!r} is unknown: did you mean {nearest_name!r}? Known: {', '.join(ESTIMATORS)}"
        )
    return ESTIMATORS[config]


def prior_from_counts(counts: jax.Array, config: str | EstimatorConfig = "calibrated") -> jax.Array:
    """Make the prior alpha* from co-occurrence counts of exploration.

    Args:
      counts: real [K, K], how often j was seen with i; the diagonal is ignored.
      config: configuration of the estimator, or its name; `uniform` and `strength` are read.

    Returns:
      float32 [K, K], >= 0.01 off the diagonal and 0 on it. A row without counts is all ones before rescaling.

    Raises:
      ValueError: K is less than 2.
    """
    if counts.shape[-1] < 2:
        raise ValueError(f"counts has shape {counts.shape}: give counts of at least two categories")
    config = resolve_estimator(config)

    # Off-diagonal counts; a category that was never seen with any other has a uniform row.
    off_diagonal = 1 - jnp.eye(counts.shape[-1], dtype=jnp.float32)
    counts = counts.astype(jnp.float32) * off_diagonal
    counts = jnp.where(counts.sum(-1, keepdims=True) == 0, off_diagonal, counts)

    # Mix in the uniform distribution, then rescale the rows.
    row_total = counts.sum(-1, keepdims=True)
    alpha = counts + config.uniform * (row_total / off_diagonal.sum(-1, keepdims=True) - counts)
    if config.strength is not None:
        alpha = alpha * (config.strength / row_total)
    return jnp.maximum(alpha, MIN_CONCENTRATION) * off_diagonal


class LayoutState(struct.PyTreeNode):
    """The layout belief within one episode.

    Attributes:
      alpha: float32 [K, K], concentrations; 0 on the diagonal unless a row counts its own category.
      last_visible: bool [K], the visible set accepted last.
      gap: float32 [], layout gap D in [0, 1].
      co_seen: bool [K, K], pairs that were visible together so far (`seen_together`), for the gaps `learned` and
        `overdue`; None for the rest.
      sightings: where the categories were seen so far, for the gap `surprise`; None for the rest.
    """

    alpha: jax.Array
    last_visible: jax.Array
    gap: jax.Array
    co_seen: jax.Array | None = None
    sightings: PairSightings | None = None


class ViewGeometry(NamedTuple):
    """Where one view shows the categories, by compass and odometry.

    Attributes:
      offsets: float32 [K, 2], metres from the agent to each detected category, along the axes of the compass.
      motion: float32 [2], metres that the agent has moved since the last view, along the same axes.
    """

    offsets: jax.Array
    motion: jax.Array


class LayoutEstimator(struct.PyTreeNode):
    """Estimator of the layout of one episode (eqs. 3 to 6).

    Attributes:
      prior: float32 [K, K], alpha* as from `prior_from_counts`.
      config: a name in `ESTIMATORS` or an `EstimatorConfig`; static. An unknown name raises a ValueError.
      cooccurrence: evidence for the gaps `learned`, `surprise` and `overdue`, leaves [..., K, K]; None for the rest.
    """

    prior: jax.Array
    config: str | EstimatorConfig = struct.field(pytree_node=False, default="calibrated")
    cooccurrence: CooccurrenceEvidence | None = None

    def __post_init__(self):
        resolve_estimator(self.config)  # raises on an unknown name

    @property
    def resolved_config(self) -> EstimatorConfig:
        """The configuration, also where `config` is a name."""
        return resolve_estimator(self.config)

    def init(self) -> LayoutState:
        """Belief at the start of an episode."""
        num_categories = self.prior.shape[-1]
        gap_name = self.resolved_config.gap
        records_pairs = gap_name in ("learned", "overdue")
        return LayoutState(
            alpha=self.prior,
            last_visible=jnp.zeros(num_categories, dtype=bool),
            gap=jnp.zeros((), dtype=jnp.float32),
            co_seen=jnp.zeros((num_categories, num_categories), dtype=bool) if records_pairs else None,
            sightings=PairSightings.init(num_categories) if gap_name == "surprise" else None,
        )

    def update(
        self,
        state: LayoutState,
        presence: jax.Array,
        goal: jax.Array | int | None = None,
        geometry: ViewGeometry | None = None,
    ) -> LayoutState:
        """Update belief and gap with the categories visible at one step (eqs. 3-5).

        Args:
          state: the belief before the step.
          presence: bool or real [K], nonzero where a category is visible. Estimators with `counts="instances"` read it
            as the number of visible instances, a whole number; all others count 1 for any number above 0.
          goal: int [], index of the goal category; only the gap `overdue` needs it.
          geometry: where the view shows the categories; only the gap `surprise` needs it.

        Returns:
          The belief after the step, including the layout gap.

        Raises:
          ValueError: the gap needs `cooccurrence`, a goal or the geometry of the view, and there is none.
        """
        config = self.resolved_config
        is_visible = presence.astype(bool)
        visible = is_visible.astype(jnp.float32)
        diagonal = jnp.eye(len(is_visible), dtype=jnp.float32)

        # Eq. 3: counts of this view, n_ij > 0 where j is visible (and i too, with `visible` rows).
        updated_rows = visible if config.rows == "visible" else jnp.ones_like(visible)
        view_counts = presence.astype(jnp.float32) if config.counts == "instances" else visible
        counts = config.increment * updated_rows[:, None] * view_counts[None, :]
        if not config.own_column:
            counts = counts * (1 - diagonal)

        # Eq. 4: the posterior adds them, where the gate is open. The gap `clock` follows the gate of every estimator.
        is_new_set = (is_visible.sum() >= 2) & (is_visible != state.last_visible).any()
        is_accepted = is_new_set if config.gate else jnp.bool_(True)
        is_gap_new = is_new_set if config.gap == "clock" else is_accepted
        next_state = LayoutState(
            alpha=jnp.where(is_accepted, state.alpha + counts, state.alpha),
            last_visible=jnp.where(is_gap_new, is_visible, state.last_visible),
            gap=state.gap,
            co_seen=state.co_seen,
            sightings=state.sightings,
        )

        # Eq. 5, or another measure of the gap.
        match config.gap:
            case "none":
                return next_state
            case "evidence":
                gap = evidence_gap(self.prior, next_state.alpha)
            case "learned" | "overdue":
                assert state.co_seen is not None
                next_state = next_state.replace(co_seen=state.co_seen | seen_together(is_visible[None]))
                gap = self._cooccurrence_gap(next_state, goal)
            case "surprise":
                next_state = next_state.replace(sightings=self._add_sightings(state, is_visible, geometry))
                gap = self._surprise_gap(next_state)
            case "novelty" | "clock":
                # The released code adds 1 to a row's own category before the divergence.
                row_alpha = state.alpha + diagonal if config.own_column else state.alpha
                # A new gap has already decayed in the later passes over this view.
                new_gap = self._novelty(row_alpha, counts, visible) * config.decay ** (config.passes - 1)
                gap = jnp.where(is_gap_new, new_gap, state.gap * config.decay**config.passes)
        return next_state.replace(gap=jnp.maximum(gap, state.gap) if config.hold else gap)

    @staticmethod
    def expectation(state: LayoutState) -> jax.Array:
        """Expected co-occurrence w (eq. 6).

        w_ij = alpha_ij / sum_k alpha_ik, the mean of row i: the probability that a category seen with i is j. The
        diagonal w_ii is 1; with `own_column` it is 1 + the share of i in its own row, as in the released code.

        Args:
          state: the belief.

        Returns:
          float32 [K, K].
        """
        row_means = state.alpha / state.alpha.sum(-1, keepdims=True)
        return row_means + jnp.eye(state.alpha.shape[-1], dtype=row_means.dtype)

    @staticmethod
    def goal_weights(state: LayoutState, goal: jax.Array | int) -> jax.Array:
        """The goal's column of w (`expectation`), float32 [K]: w times g in eq. 7, because g is one-hot.

        A method multiplies what Z holds of category i by the entry w_ig, see `Experience.encode`.
        """
        # The other columns of `expectation` would cost K times as much.
        goal_share = state.alpha[:, goal] / state.alpha.sum(-1)
        return goal_share.at[goal].add(1)

    def _novelty(self, alpha: jax.Array, counts: jax.Array, visible: jax.Array) -> jax.Array:
        """Tanh of the reduced row divergences KL(posterior || belief) (eq. 5), float32 []; 1 for the gap `clock`.

        Args:
          alpha: float32 [K, K], belief before the step; with `own_column`, with 1 more on the diagonal.
          counts: float32 [K, K], counts of the step.
          visible: float32 [K], 1 where a category is visible.
        """
        config = self.resolved_config
        if config.gap == "clock":
            return jnp.float32(1.0)
        if config.counts == "instances":
            row_kl = counts_kl(alpha, counts)  # [K]
        else:
            row_kl = presence_kl(alpha, counts, config.increment)
        match config.reduction:
            case "mean_visible":
                reduced_kl = (row_kl * visible).sum() / jnp.maximum(visible.sum(), 1)
            case "mean":
                reduced_kl = row_kl.mean()
            case "sum":
                reduced_kl = row_kl.sum()
        return jnp.tanh(reduced_kl)

    @staticmethod
    def _add_sightings(state: LayoutState, is_visible: jax.Array, geometry: ViewGeometry | None) -> PairSightings:
        """Return the sightings after a view."""
        if geometry is None:
            raise ValueError("gap='surprise': needs the geometry of the view; pass it to `update`")
        assert state.sightings is not None
        return state.sightings.update(is_visible, geometry.offsets, geometry.motion)

    def _surprise_gap(self, state: LayoutState) -> jax.Array:
        """Return the gap `surprise`, from the sightings so far."""
        assert state.sightings is not None
        if self.cooccurrence is None or self.cooccurrence.near_log_odds is None:
            raise ValueError("gap='surprise': needs `cooccurrence` with `near_log_odds`, learned before training")
        return surprise_gap(state.sightings.counts, self.cooccurrence.near_log_odds)

    def _cooccurrence_gap(self, state: LayoutState, goal: jax.Array | int | None) -> jax.Array:
        """Return the gap `learned` or `overdue`, from the pairs seen so far."""
        config = self.resolved_config
        assert state.co_seen is not None
        if self.cooccurrence is None:
            raise ValueError(f"gap={config.gap!r}: needs `cooccurrence`, the evidence that is learned before training")
        if config.gap == "learned":
            return learned_gap(state.co_seen, self.cooccurrence.log_odds)
        if goal is None:
            raise ValueError("gap='overdue': needs the goal; pass it to `update`")
        return overdue_gap(state.co_seen, self.cooccurrence.co_visibility, goal)


def scale_weights(weights: jax.Array, goal: jax.Array) -> jax.Array:
    """Scale the goal's column of w so that the weights off the goal have mean 1 (the kind `relative`).

    The mean is 1 before weights are clipped at `MAX_RELATIVE_WEIGHT`. Each row of w adds up to 1 over K - 1 categories,
    so a raw weight w_ig is about 1 / (K - 1) and shrinks the features of category i about K-fold. Relative weights keep
    what the belief says, which category is likelier than others near the goal, and drop the common factor. Weights of
    ones, which disable the layout, stay ones.

    Args:
      weights: float32 [..., K], as from `LayoutEstimator.goal_weights`.
      goal: int [...], index of the goal category.

    Returns:
      float32 [..., K], at most `MAX_RELATIVE_WEIGHT` off the goal; the goal keeps its weight.
    """
    num_categories = weights.shape[-1]
    is_goal = jax.nn.one_hot(goal, num_categories, dtype=bool)
    mean_weight = jnp.where(is_goal, 0.0, weights).sum(axis=-1, keepdims=True) / (num_categories - 1)
    relative_weights = jnp.minimum(weights / jnp.maximum(mean_weight, _MIN_MEAN_WEIGHT), MAX_RELATIVE_WEIGHT)
    return jnp.where(is_goal, weights, relative_weights)
