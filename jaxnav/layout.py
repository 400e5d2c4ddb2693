"""The layout estimator: a Dirichlet belief about which categories are seen together, equations 3 to 6.

Row i of `alpha` [K, K] parametrises a Dirichlet over the categories j != i seen together with category i. The belief
starts at the prior alpha*, gains counts as the episode shows categories (eqs. 3, 4), and yields the gap D (eq. 5, or
`evidence_gap`) and the expected co-occurrence w (eq. 6). There are no learned parameters. Functions take one episode;
callers `vmap`.
"""

import dataclasses
import difflib
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

#: Smallest concentration of a category that can be seen; below it a first sighting has an unbounded divergence.
MIN_CONCENTRATION = 1e-2

#: Over the rows' divergences in eq. 5: the mean over visible rows, the mean over all K, or the sum.
Reduction = Literal["mean_visible", "mean", "sum"]


@dataclasses.dataclass(frozen=True)
class Setting:
    """How the estimator reads equations 4 to 6; the defaults are `calibrated`. Out of range raises a ValueError.

    Attributes:
      rows: rows that are updated: those of `visible` categories, or `all` (eq. 4 to the letter).
      reduction: over the rows' divergences in eq. 5: `mean_visible`, `mean` over all K, or `sum`.
      increment: whole number from 1 to 50 added to alpha per visible category.
      own_column: a row also counts its own category; its Dirichlet then has one more entry, of concentration 1.
      gate: update only if two or more categories are visible and the set differs from the last accepted one.
      gap: what D measures: `novelty`, how much the last view changed the belief (eq. 5), or `evidence`, how badly all
        that was seen so far fits the prior (`evidence_gap`; `reduction`, `decay` and `passes` then have no effect),
        `clock`, 1 when the gate opens: what the sum over all rows in `released` comes to, for tanh is saturated there,
        or `none`: D stays 0, so that sTDE takes nothing out. Training has no use for D.
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
    gap: Literal["novelty", "evidence", "clock", "none"] = "novelty"
    decay: float = 0.8
    passes: int = 1
    strength: float | None = 20.0
    uniform: float = 0.05
    form: Literal["paper", "residual"] = "residual"

    def __post_init__(self):
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
    """Looks a setting up by name; a `Setting` passes through.

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
    """Turns co-occurrence counts from exploration into the prior alpha*.

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


def _excess(t: jax.Array, log1p_t: jax.Array) -> jax.Array:
    """t - log(1 + t) >= 0 for t > -1, without cancellation: with s = t / (2 + t), log(1 + t) = 2 artanh(s)."""
    s = t / (2 + t)
    r = s * s
    return jnp.where(jnp.abs(t) < 0.3, s * t - 2 * s * r * (1 / 3 + r * (1 / 5 + r / 7)), t - log1p_t)


def _bregman_remainder(a: jax.Array, c: jax.Array, log_ratio: jax.Array) -> jax.Array:
    """What a `_excess`(c / a) leaves of the Bregman divergence of lnGamma; log_ratio = log((a + c) / a).

    One step of the recurrence moves a to a + 1, where Stirling's series holds; no term exceeds the order of the result.
    """
    b = a + c
    p, q = 1 / (a + 1), 1 / (b + 1)
    log_next = jnp.log1p(c * p)  # log((b + 1) / (a + 1))
    half_log = _excess(-c * q, -log_next) / 2
    t = c * q / a
    shift = t * c / b - (a + 1) * _excess(t, log_ratio - log_next)
    # Divergences of x^-1, x^-3 and x^-5; 1/1680 instead of 1/1260 makes the cut series best over x >= 1.
    cubic = p * p + 2 * p * q + 3 * q * q
    quintic = p**4 + 2 * p**3 * q + 3 * p**2 * q**2 + 4 * p * q**3 + 5 * q**4
    return half_log + shift + c * c * p * q * q * (1 / 12 - cubic / 360 + quintic / 1680)


def update_kl(prior: jax.Array, counts: jax.Array) -> jax.Array:
    """KL( Dir(prior + counts) || Dir(prior) ) in nats, accurate in float32 where lgamma differences are not.

    With g(a, c) = lnGamma(a) - lnGamma(a + c) + c psi(a + c), the Bregman divergence of lnGamma, the divergence is
    sum_j g(a_j, c_j) - g(a_0, N). The leading parts of both, a (u - log(1 + u)) with u = c / a, merge into
    sum_j a_j (v_j - log(1 + v_j)), 1 + v_j = posterior share / prior share: no term cancels.

    Args:
      prior: float32 [..., K], concentrations, 0.01 or more; 0 with count 0 leaves an entry out.
      counts: real [..., K], >= 0.

    Returns:
      float32 [...], relative error below 1e-3 (concentrations up to 2e4) wherever the divergence exceeds 1e-6.
    """
    counts = counts.astype(jnp.float32)
    a = jnp.where(prior > 0, prior, 1)
    a_0, n = prior.sum(-1, keepdims=True), counts.sum(-1, keepdims=True)
    log_a, log_0 = jnp.log1p(counts / a), jnp.log1p(n / a_0)
    v = (counts / a - n / a_0) / (1 + n / a_0)
    entries = prior * _excess(v, log_a - log_0) + _bregman_remainder(a, counts, log_a)
    return entries.sum(-1) - _bregman_remainder(a_0, n, log_0)[..., 0]


def presence_kl(prior: jax.Array, counts: jax.Array, increment: int) -> jax.Array:
    """`update_kl` where every count is 0 or `increment`: several times faster, for the estimator's inner loop.

    For whole counts g(a, n) = sum_{i < n} [psi(a + n) - log(a + i)]: with a rational form of exp(psi) each term is the
    log of 1 + a positive number, and an entry's terms are multiplied out before the logarithm is taken.

    Args:
      prior: float32 [..., K], concentrations, 0.01 or more; 0 with count 0 leaves an entry out.
      counts: float32 [..., K], 0 or `increment`.
      increment: whole number from 1 to 50; the product overflows at more.

    Returns:
      float32 [...], >= 0; the error is below 2e-5 of the sum of the g(a_j, c_j).
    """
    a = jnp.maximum(prior, MIN_CONCENTRATION)
    x = a + (increment - 1)
    growth = jnp.zeros_like(a)  # exp(g(a, increment)) - 1
    for k in range(increment):
        # exp(psi(x + 1)) = x + P(x) / Q(x): exact to x^-1, fitted to 1.2e-5 of g(a, 1) over a >= 0.01; here P + k Q.
        numerator = ((0.5 + k) * x + (0.87228 + 1.66123 * k)) * x + (0.44703 + 0.79623 * k)
        denominator = (x + 1.66123) * x + 0.79623
        factor = numerator / (denominator * (a + (increment - 1 - k)))
        growth = growth + factor + growth * factor
    seen = counts > 0
    a_0, n = prior.sum(-1), increment * seen.sum(-1).astype(jnp.float32)
    log_0 = jnp.log1p(n / a_0)
    g = jnp.log1p(jnp.where(seen, growth, 0)).sum(-1)
    return jnp.maximum(g - a_0 * _excess(n / a_0, log_0) - _bregman_remainder(a_0, n, log_0), 0)


def evidence_gap(prior: jax.Array, alpha: jax.Array) -> jax.Array:
    """Gap D by the evidence of an episode: how far what was seen together falls short of agreeing with the prior.

    With the expected shares p_i = alpha*_i / a_i before and q_i = alpha_i / (a_i + n_i) after n_i sightings, row i
    agrees by p_i . q_i, the probability that one draw of each is alike. For layouts drawn from the prior that has mean
    p_i . p_i and variance n_i v_i / ((a_i + n_i) (a_i + 1)), where v_i is the variance of p_ij, j drawn from p_i. So

      z = sum_i (p_i . p_i - p_i . q_i) / sum_i sqrt(n_i v_i / ((a_i + n_i) (a_i + 1))),

    the denominator being the standard deviation if rows are fully correlated, its upper bound, and D = erf(z / sqrt 2)
    or 0 where z < 0: 2 P - 1, P the probability (normal approximation) that the prior's own layouts agree better.

    Args:
      prior: float32 [K, K], alpha*, 0 on the diagonal.
      alpha: float32 [K, K], the belief, >= alpha*; the diagonal is ignored.

    Returns:
      float32 [], in [0, 1] (1 only by rounding); 0 where nothing was gained, below 0.01 where prior rows are uniform.
    """
    seen = (alpha - prior) * (1 - jnp.eye(len(prior), dtype=jnp.float32))
    a, n = prior.sum(-1), seen.sum(-1)
    p = prior / a[:, None]
    shortfall = (p * p).sum(-1, keepdims=True) - p
    excess = (seen * shortfall).sum(-1) / (a + n)
    deviation = jnp.sqrt(n * (p * shortfall**2).sum(-1) / ((a + n) * (a + 1)))
    # Where rows are uniform both are 0 up to rounding (1e-7), which the bound keeps out of the ratio.
    z = excess.sum() / jnp.maximum(deviation.sum(), 1e-5)
    return jnp.maximum(jax.lax.erf(z * 0.5**0.5), 0)


class LayoutState(struct.PyTreeNode):
    """The belief within one episode.

    Attributes:
      alpha: float32 [K, K], concentrations; 0 on the diagonal unless the setting counts a row's own category.
      last: bool [K], the visible set accepted last.
      gap: float32 [], layout gap D in [0, 1] (1 only by rounding).
    """

    alpha: jax.Array
    last: jax.Array
    gap: jax.Array


class LayoutEstimator(struct.PyTreeNode):
    """Equations 3 to 6 for one episode.

    Attributes:
      prior: float32 [K, K], alpha* as from `prior_from_counts`.
      setting: a name in `SETTINGS` or a `Setting`; static. An unknown name raises a ValueError.
    """

    prior: jax.Array
    setting: str | Setting = struct.field(pytree_node=False, default="calibrated")

    def __post_init__(self):
        named_setting(self.setting)

    def init(self) -> LayoutState:
        """Returns the belief at the start of an episode: alpha = alpha*, nothing accepted, D = 0."""
        return LayoutState(
            alpha=self.prior, last=jnp.zeros(self.prior.shape[-1], dtype=bool), gap=jnp.zeros((), dtype=jnp.float32)
        )

    def update(self, state: LayoutState, presence: jax.Array) -> LayoutState:
        """Takes in the categories visible at one step (eqs. 3-5).

        `state` is the belief before the step, `presence` bool or real [K], nonzero where a category is visible. Returns
        the belief after the step; its gap is the divergence of the one from the other, or of the belief from the prior.
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
        if setting.gap == "none":
            return LayoutState(alpha=posterior, last=last, gap=state.gap)
        if setting.gap == "evidence":
            return LayoutState(alpha=posterior, last=last, gap=evidence_gap(self.prior, posterior))

        kl = presence_kl(kl_prior, counts, setting.increment)  # [K]
        if setting.reduction == "mean_visible":
            mean_kl = (kl * visible).sum() / jnp.maximum(visible.sum(), 1)
        else:
            mean_kl = kl.mean() if setting.reduction == "mean" else kl.sum()
        fresh = jnp.float32(1.0) if setting.gap == "clock" else jnp.tanh(mean_kl)
        new_gap = fresh * setting.decay ** (setting.passes - 1)  # eq. 5
        gap = jnp.where(accept, new_gap, state.gap * setting.decay**setting.passes)
        return LayoutState(alpha=posterior, last=last, gap=gap)

    @staticmethod
    def expectation(state: LayoutState) -> jax.Array:
        """Expected co-occurrence w (eq. 6): float32 [K, K], w_ij = p(j seen given i seen), w_ii = 1.

        With `own_column` w_ii is 1 + the share of i in its own row, as in the released code.
        """
        share = state.alpha / state.alpha.sum(-1, keepdims=True)
        return share + jnp.eye(share.shape[0], dtype=share.dtype)

    @staticmethod
    def goal_weights(state: LayoutState, goal: jax.Array | int) -> jax.Array:
        """The column w[:, goal], w x g of eq. 7: float32 [K], how far each category speaks for `goal`, int []."""
        share = state.alpha[:, goal] / state.alpha.sum(-1)
        return share.at[goal].add(1)
