"""Interventions and causal effects on a policy's logits: equations 1 and 2.

In the causal graph three pathways lead to the action: the scene S, the goal G, and the mediator Z that both produce,
the paper's *experience*: features of what tends to stand near what, learned in training.

    S ---------> A
    G ---------> A
    S, G -> Z -> A

Let a be the logits of the factual decision, a_bar the logits under do(S = 0, G = 0) with the factual experience Z and
the memory of the counterfactual branch (by default the factual one: hidden state and previous action), D the layout
gap, and epsilon its threshold:

    counterfactual = policy.decide(do(pathways, scene=0.0, goal=0.0), memory.counterfactual_state()).logits
    tde(logits, counterfactual)                    # eq. 1: a - a_bar
    stde(logits, counterfactual, gap, epsilon)     # eq. 2: subtracts a_bar, weighted by how far D exceeds epsilon

Some hosts score their choices by a sum, a = direct + experience. There a_bar is the experience itself, eq. 1 leaves the
direct scores, and eq. 2 in the paper's form scales the experience: see `remove_from_sum`.
"""

import typing
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from jaxnav.choices import Form

#: Forms in which equation 2 combines the logits, see `stde`.
FORMS: tuple[Form, ...] = typing.get_args(Form)
PathwaysT = TypeVar("PathwaysT", bound=Any)


def do(pathways: PathwaysT, **interventions: jax.Array | float) -> PathwaysT:
    """Set pathways to given values (the do-operator); fields that are not named keep their factual values.

    Args:
      pathways: a `NamedTuple` of arrays, such as (scene, goal, experience).
      **interventions: field name = value, a number or an array that is broadcast to the field.

    Returns:
      The same type with the named fields replaced, shapes and dtypes kept.

    Raises:
      ValueError: a name is not a field of `pathways`.
    """
    replaced = {}
    for name, value in interventions.items():
        if name not in pathways._fields:
            raise ValueError(f"do({name}=...): unknown pathway; choose one of {', '.join(pathways._fields)}")
        replaced[name] = jnp.full_like(getattr(pathways, name), value)
    return pathways._replace(**replaced)


def tde(logits: jax.Array, counterfactual: jax.Array) -> jax.Array:
    """Total direct effect a - a_bar (eq. 1).

    Args:
      logits: float [..., A], factual logits a.
      counterfactual: float [..., A], logits a_bar under do(scene = 0, goal = 0) with the factual experience.

    Returns:
      float [..., A].
    """
    return logits - counterfactual


def removal_weight(gap: jax.Array, epsilon: jax.Array | float, form: Form = "residual") -> jax.Array:
    """Removal weight s of eq. 2.

    In most forms s is the weight of the removed logits; in the form `mixture` it is that of the decision without
    experience.

    Args:
      gap: float32 [...], layout gap D in [0, 1].
      epsilon: scalar or [...], threshold, at least 0; may be traced. At 1 or more the weight is 0.
      form: `paper`, `residual` and `mixture` weigh by ReLU(D - epsilon), `switch` by 1 where D > epsilon and by 0
        elsewhere.

    Returns:
      float32 [...], in [0, 1].

    Raises:
      ValueError: unknown form.
    """
    if form not in FORMS:
        raise ValueError(f"form={form!r}: choose one of {', '.join(FORMS)}")
    if form == "switch":
        return (gap > epsilon).astype(jnp.float32)
    return jax.nn.relu(gap - epsilon)


def stde(
    logits: jax.Array,
    counterfactual: jax.Array,
    gap: jax.Array,
    epsilon: jax.Array | float,
    form: Form = "residual",
) -> jax.Array:
    """Soft total direct effect (eq. 2).

    `form="paper"` is eq. 2 as printed. The default `residual` keeps the scale of the logits.

    Args:
      logits: float [..., A], factual logits a.
      counterfactual: float [..., A], counterfactual logits a_bar.
      gap: float32 [...], layout gap D in [0, 1].
      epsilon: scalar or [...], threshold, at least 0; may be traced. At 1 or more nothing is removed.
      form: with s = `removal_weight`,
        `paper` and `switch`: a - s a_bar, which is `tde` at s = 1;
        `residual`: (1 + s) a - s a_bar, whose coefficients add up to 1, so that logits keep their scale. It ranks
        actions as the paper's form does with the weight s / (1 + s);
        `mixture`: log[(1 - s) softmax(a) + s softmax(a - a_bar)], the policy that follows `tde` with probability s.

    Returns:
      float [..., A], bit-identical to `logits` where s is 0.

    Raises:
      ValueError: unknown form.
    """
    s = removal_weight(gap, epsilon, form)[..., None].astype(logits.dtype)
    if form == "mixture":
        effect = _log_mixture(jax.nn.log_softmax(logits), jax.nn.log_softmax(tde(logits, counterfactual)), s)
    else:
        factual = (1 + s) * logits if form == "residual" else logits
        effect = factual - s * counterfactual
    # Subtracting 0 * a_bar could still turn -0.0 into 0.0, so the factual logits are copied.
    return jnp.where(s == 0, logits, effect)


def remove_from_sum(
    direct: jax.Array, experience: jax.Array, gap: jax.Array, epsilon: jax.Array | float, form: Form = "paper"
) -> jax.Array:
    """Equation 2 for scores that are a sum: direct + (1 - s) experience.

    With the logits a = direct + experience and the counterfactual logits a_bar = experience, the forms `paper` and
    `switch` equal `stde` in the same form up to rounding, a - s a_bar; with s = 1 they are `tde`.

    The form `mixture` is log[(1 - s) exp(direct + experience) + s exp(direct)]. Unlike in `stde` the scores are not
    normalized over the choices: they are log probabilities of detection per action, which both beliefs share.

    Args:
      direct: float [..., A], scores without experience.
      experience: float [..., A], what experience adds to the scores; finite.
      gap: float32 [...], layout gap D in [0, 1].
      epsilon: scalar or [...], threshold, at least 0; may be traced. At 1 or more nothing is removed.
      form: `paper` and `mixture`, s = ReLU(D - epsilon), or `switch`, s = 1 where D > epsilon.

    Returns:
      float [..., A], bit-identical to `direct` where s is 1, and to `direct + experience` where s is 0.

    Raises:
      ValueError: another form; `residual` rescales the direct scores, so it is no removal from a sum.
    """
    if form == "residual":
        raise ValueError("form='residual': a sum keeps its direct scores as they are; choose paper, switch or mixture")
    s = removal_weight(gap, epsilon, form)[..., None].astype(direct.dtype)
    remaining = _log_mixture(experience, jnp.zeros_like(experience), s) if form == "mixture" else (1 - s) * experience
    scores = jnp.where(s == 0, direct + experience, direct + remaining)
    # Adding 0 * experience could still turn -0.0 into 0.0, so the direct scores are copied.
    return jnp.where(s == 1, direct, scores)


def remove_experience(
    logits: jax.Array,
    counterfactual: jax.Array,
    gap: jax.Array,
    epsilon: jax.Array | float,
    form: Form,
    *,
    has_additive_scores: bool = False,
) -> jax.Array:
    """Equation 2 for any policy: `stde`, or `remove_from_sum` where the logits are a sum.

    Args:
      logits, counterfactual, gap, epsilon, form: as in `stde`.
      has_additive_scores: whether the logits are log probabilities of detection, direct scores plus the counterfactual
        ones, and their sum is exact. The form `mixture` then mixes without normalizing each decision, and complete
        removal restores the direct scores to the bit. The form `residual` is that of `stde` for sums, too.

    Returns:
      float [..., A].
    """
    if has_additive_scores and form != "residual":
        return remove_from_sum(tde(logits, counterfactual), counterfactual, gap, epsilon, form)
    return stde(logits, counterfactual, gap, epsilon, form)


def _log_mixture(log_a: jax.Array, log_b: jax.Array, weight_b: jax.Array) -> jax.Array:
    """log[(1 - weight_b) a + weight_b b] from the logarithms of a and b, with weight_b in [0, 1]."""
    return jnp.logaddexp(jnp.log1p(-weight_b) + log_a, jnp.log(weight_b) + log_b)
