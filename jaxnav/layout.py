"""The layout estimator, equations 3 to 6.

It holds a Dirichlet belief about which categories are seen together. Row i of `alpha` [K, K] parametrises a Dirichlet
over the categories j != i seen together with category i. The belief starts at the prior alpha*, gains counts as the
episode shows categories (eqs. 3, 4), and yields the gap D (eq. 5, or `evidence_gap`) and the expected co-occurrence w
(eq. 6). Only the gaps `learned` and `overdue` know more than the prior (`Signs`). Functions take one episode; callers
`vmap`.
"""

import dataclasses
import difflib
import typing
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from jaxnav.gaps import Signs, evidence_gap, learned_gap, overdue_gap, seen_together
from jaxnav.numerics.dirichlet import MIN_CONCENTRATION, presence_kl

#: Over the rows' divergences in eq. 5: the mean over visible rows, the mean over all K, or the sum.
Reduction = Literal["mean_visible", "mean", "sum"]


@dataclasses.dataclass(frozen=True)
class Setting:
    """Say how the estimator reads equations 4 to 6.

    The defaults are `calibrated`. A value out of range raises a ValueError.

    Attributes:
      rows: rows that are updated: those of `visible` categories, or `all` (eq. 4 to the letter).
      reduction: over the rows' divergences in eq. 5: `mean_visible`, `mean` over all K, or `sum`.
      increment: whole number from 1 to 50 added to alpha per visible category.
      own_column: a row also counts its own category; its Dirichlet then has one more entry, of concentration 1.
      gate: update only if two or more categories are visible and the set differs from the last accepted one.
      gap: what D measures: `novelty`, how much the last view changed the belief (eq. 5), or `evidence`, how badly all
        that was seen so far fits the prior (`evidence_gap`; `reduction`, `decay` and `passes` then have no effect),
        `learned`, how surely what was seen together is not of the layout of training (`learned_gap`), `overdue`, how
        surely the goal would have been seen by now in that layout (`overdue_gap`), `clock`, 1 when the gate opens:
        what the sum over all rows in `released` comes to, for tanh is saturated there, or `none`: D stays 0, so that
        sTDE takes nothing out. Training has no use for D.
      hold: the gap never falls within an episode.
      decay: factor in [0, 1] on the gap per estimator call at which the gate is shut.
      passes: estimator calls per step, >= 1. All but the first find nothing new, so an accepted gap is already decayed.
      strength: sum of every prior row after rescaling, > 0; None keeps the sums of the counts.
      uniform: share of the uniform distribution mixed into every prior row, in [0, 1].
      form: how inference combines factual and counterfactual logits, see `jaxnav.causal.stde`.
    """

    rows: Literal["visible", "all"] = "visible"
    reduction: Reduction = "mean_visible"
    increment: int = 1
    own_column: bool = False
    gate: bool = True
    gap: Literal["novelty", "evidence", "learned", "overdue", "clock", "none"] = "novelty"
    hold: bool = False
    decay: float = 0.8
    passes: int = 1
    strength: float | None = 20.0
    uniform: float = 0.05
    form: Literal["paper", "residual", "switch"] = "residual"

    def __post_init__(self):
        for name, hint in typing.get_type_hints(type(self)).items():
            options = typing.get_args(hint)
            if typing.get_origin(hint) is Literal and getattr(self, name) not in options:
                raise ValueError(f"{name} is {getattr(self, name)!r}: choose one of {', '.join(options)}")
        for name, valid, mend in (
            ("increment", self.increment in range(1, 51), "a whole number from 1 to 50"),
            ("decay", 0 <= self.decay <= 1, "a number from 0 to 1"),
            ("passes", self.passes >= 1 and self.passes % 1 == 0, "a whole number of 1 or more"),
            ("strength", self.strength is None or 0 < self.strength < float("inf"), "a number above 0, or None"),
            ("uniform", 0 <= self.uniform <= 1, "a number from 0 to 1"),
        ):
            if not valid:
                raise ValueError(f"{name} is {getattr(self, name)!r}: give {mend}")


#: `paper`: equations 3 to 6, with presence for the counts n. `released`: what the authors' estimator computes.
#: `evidence`: `calibrated` with another gap; priors and weights w are the same.
SETTINGS = {
    "paper": Setting(rows="all", reduction="mean", gate=False, strength=None, uniform=0.0, form="paper"),
    "released": Setting(
        rows="all", reduction="sum", increment=5, own_column=True, passes=2, strength=None, uniform=0.0
    ),
    "calibrated": Setting(),
    "evidence": Setting(gap="evidence"),
}


def named_setting(setting: str | Setting) -> Setting:
    """Return the setting of a name; a `Setting` passes through.

    Raises:
      ValueError: unknown name; the message gives the nearest.
    """
    if isinstance(setting, Setting):
        return setting
    if setting not in SETTINGS:
        nearest = difflib.get_close_matches(setting, SETTINGS, n=1, cutoff=0.0)[0]
        raise ValueError(f"setting {setting!r} is unknown: did you mean {nearest!r}? Known: {', '.join(SETTINGS)}")
    return SETTINGS[setting]


def prior_from_counts(counts: jax.Array, setting: str | Setting = "calibrated") -> jax.Array:
    """Make the prior alpha* from co-occurrence counts of exploration.

    Args:
      counts: real [K, K], how often j was seen with i; the diagonal is ignored.
      setting: gives the share of uniform mixed in and the strength rows are rescaled to.

    Returns:
      float32 [K, K], >= 0.01 off the diagonal and 0 on it. A row without counts is all ones before rescaling.

    Raises:
      ValueError: K is less than 2.
    """
    if counts.shape[-1] < 2:
        raise ValueError(f"counts has shape {counts.shape}: co-occurrence takes two or more categories")
    setting = named_setting(setting)
    others = 1 - jnp.eye(counts.shape[-1], dtype=jnp.float32)
    counts = counts.astype(jnp.float32) * others
    counts = jnp.where(counts.sum(-1, keepdims=True) == 0, others, counts)
    total = counts.sum(-1, keepdims=True)
    alpha = counts + setting.uniform * (total / others.sum(-1, keepdims=True) - counts)
    if setting.strength is not None:
        alpha = alpha * (setting.strength / total)
    return jnp.maximum(alpha, MIN_CONCENTRATION) * others


class LayoutState(struct.PyTreeNode):
    """Hold the belief within one episode.

    Attributes:
      alpha: float32 [K, K], concentrations; 0 on the diagonal unless the setting counts a row's own category.
      last: bool [K], the visible set accepted last.
      gap: float32 [], layout gap D in [0, 1] (1 only by rounding).
      together: bool [K, K], what was seen together so far (`seen_together`), for the gaps `learned` and `overdue`; None
        for the others.
    """

    alpha: jax.Array
    last: jax.Array
    gap: jax.Array
    together: jax.Array | None = None


class LayoutEstimator(struct.PyTreeNode):
    """Estimate the layout of one episode (eqs. 3 to 6).

    Attributes:
      prior: float32 [K, K], alpha* as from `prior_from_counts`.
      setting: a name in `SETTINGS` or a `Setting`; static. An unknown name raises a ValueError.
      signs: what the gaps `learned` and `overdue` know, leaves [K, K]; None for the others.
    """

    prior: jax.Array
    setting: str | Setting = struct.field(pytree_node=False, default="calibrated")
    signs: Signs | None = None

    def __post_init__(self):
        named_setting(self.setting)

    def init(self) -> LayoutState:
        """Return the belief at an episode's start."""
        size = self.prior.shape[-1]
        recorded = named_setting(self.setting).gap in ("learned", "overdue")
        return LayoutState(
            alpha=self.prior,
            last=jnp.zeros(size, dtype=bool),
            gap=jnp.zeros((), dtype=jnp.float32),
            together=jnp.zeros((size, size), dtype=bool) if recorded else None,
        )

    def update(self, state: LayoutState, presence: jax.Array, goal: jax.Array | int | None = None) -> LayoutState:
        """Take in the categories visible at one step (eqs. 3-5).

        Args:
          state: the belief before the step.
          presence: bool or real [K], nonzero where a category is visible.
          goal: int [], what is sought; only the gap `overdue` needs it.

        Returns:
          The belief after the step. Its gap is the divergence of the one from the other, or as the setting says.

        Raises:
          ValueError: the gap needs signs or a goal, and there are none.
        """
        setting = named_setting(self.setting)
        seen = presence.astype(bool)
        visible = seen.astype(jnp.float32)
        diagonal = jnp.eye(seen.shape[0], dtype=jnp.float32)
        rows = visible if setting.rows == "visible" else jnp.ones_like(visible)
        counts = setting.increment * rows[:, None] * visible[None, :]
        alpha = state.alpha
        if setting.own_column:
            kl_prior = alpha + diagonal
        else:
            kl_prior, counts = alpha, counts * (1 - diagonal)
        accept = (seen.sum() >= 2) & (seen != state.last).any() if setting.gate else jnp.bool_(True)
        posterior = jnp.where(accept, alpha + counts, alpha)  # eq. 4
        last = jnp.where(accept, seen, state.last)
        after = LayoutState(alpha=posterior, last=last, gap=state.gap, together=state.together)
        match setting.gap:
            case "none":
                return after
            case "evidence":
                gap = evidence_gap(self.prior, posterior)
            case "learned" | "overdue":
                assert state.together is not None
                after = after.replace(together=state.together | seen_together(seen[None]))
                gap = self._gap_by_signs(after, goal)
            case "novelty" | "clock":
                kl = presence_kl(kl_prior, counts, setting.increment)  # [K]
                if setting.reduction == "mean_visible":
                    mean_kl = (kl * visible).sum() / jnp.maximum(visible.sum(), 1)
                else:
                    mean_kl = kl.mean() if setting.reduction == "mean" else kl.sum()
                fresh = jnp.float32(1.0) if setting.gap == "clock" else jnp.tanh(mean_kl)
                new_gap = fresh * setting.decay ** (setting.passes - 1)  # eq. 5
                gap = jnp.where(accept, new_gap, state.gap * setting.decay**setting.passes)
        return after.replace(gap=jnp.maximum(gap, state.gap) if setting.hold else gap)

    @staticmethod
    def expectation(state: LayoutState, goal: jax.Array | int | None = None) -> jax.Array:
        """Return the expected co-occurrence w (eq. 6).

        w_ij = p(j seen given i seen) and w_ii = 1. With `own_column` w_ii is 1 + the share of i in its own row, as in
        the released code.

        Args:
          state: the belief.
          goal: int [], for the column w[:, goal] alone; None for all of w.

        Returns:
          float32 [K, K], or [K] with a goal.
        """
        if goal is None:
            return jax.vmap(LayoutEstimator.expectation, (None, 0), 1)(state, jnp.arange(state.alpha.shape[-1]))
        share = state.alpha[:, goal] / state.alpha.sum(-1)
        return share.at[goal].add(1)

    @staticmethod
    def goal_weights(state: LayoutState, goal: jax.Array | int) -> jax.Array:
        """Return w x g of eq. 7, float32 [K]."""
        return LayoutEstimator.expectation(state, goal)

    def _gap_by_signs(self, state: LayoutState, goal: jax.Array | int | None) -> jax.Array:
        """Return the gap that learned signs tell."""
        setting = named_setting(self.setting)
        assert state.together is not None
        if self.signs is None:
            raise ValueError(f"gap={setting.gap!r}: needs `signs`, learned before training")
        if setting.gap == "learned":
            return learned_gap(state.together, self.signs.odds)
        if goal is None:
            raise ValueError("gap='overdue': needs the goal; give it to `update`")
        return overdue_gap(state.together, self.signs.chance, goal)
