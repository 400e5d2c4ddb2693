"""Interventions and causal effects on a policy's logits: equations 1 and 2.

The causal graph has three pathways into the action: scene, goal, and the experience that scene and goal produce.
A counterfactual keeps the factual experience and replaces the other two: `do(pathways, scene=0, goal=0)`.
"""

import typing
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp

#: How equation 2 combines logits, see `stde`.
Form = Literal["paper", "residual", "switch"]
FORMS: tuple[Form, ...] = typing.get_args(Form)
Pathways = TypeVar("Pathways", bound=Any)


def do(pathways: Pathways, **interventions: jax.Array | float) -> Pathways:
    """Set pathways to given values: the do-operator.

    The others keep their factual values.

    Args:
      pathways: a `NamedTuple` of arrays, such as (scene, goal, experience).
      **interventions: field name = value, a number or an array that is broadcast to the field.

    Returns:
      The same type with the named fields replaced, shapes and dtypes kept.

    Raises:
      ValueError: a name is not a field of `pathways`.
    """
    for name in interventions:
        if name not in pathways._fields:
            raise ValueError(f"do({name}=...): no such pathway; choose from {', '.join(pathways._fields)}")
    return pathways._replace(
        **{name: jnp.full_like(getattr(pathways, name), value) for name, value in interventions.items()}
    )


def tde(logits: jax.Array, counterfactual: jax.Array) -> jax.Array:
    """Return the total direct effect a - a_bar (eq. 1).

    Args:
      logits: float [..., A], factual logits a.
      counterfactual: float [..., A], logits a_bar under `do(scene, goal)` with the factual experience.

    Returns:
      float [..., A].
    """
    return logits - counterfactual


def removal_weight(gap: jax.Array, epsilon: jax.Array | float, form: Form = "residual") -> jax.Array:
    """Return the weight s of what is removed in eq. 2.

    Args:
      gap: float32 [...], layout gap D in [0, 1].
      epsilon: scalar or [...], threshold; may be traced. At 1 or more the weight is 0.
      form: `switch` weighs by 1 where D > epsilon and else by 0; the others by ReLU(D - epsilon).

    Returns:
      float32 [...], in [0, 1].

    Raises:
      ValueError: unknown form.
    """
    if form not in FORMS:
        raise ValueError(f"form={form!r}: choose one of {', '.join(FORMS)}")
    return (gap > epsilon).astype(jnp.float32) if form == "switch" else jax.nn.relu(gap - epsilon)


def stde(
    logits: jax.Array,
    counterfactual: jax.Array,
    gap: jax.Array,
    epsilon: jax.Array | float,
    form: Form = "residual",
) -> jax.Array:
    """Return the soft total direct effect (eq. 2).

    Args:
      logits: float [..., A], factual logits a.
      counterfactual: float [..., A], counterfactual logits a_bar.
      gap: float32 [...], layout gap D in [0, 1].
      epsilon: scalar or [...], threshold; may be traced. At 1 or more nothing is removed.
      form: with s = ReLU(D - epsilon), `paper`: a - s a_bar (`tde` at s = 1); `residual`: (1 + s) a - s a_bar, which
        keeps the temperature of a. The two rank actions alike when the paper's weight is s / (1 + s). `switch`: `tde`
        where D > epsilon, else a.

    Returns:
      float [..., A], bit-identical to `logits` where s is 0.

    Raises:
      ValueError: unknown form.
    """
    s = removal_weight(gap, epsilon, form)[..., None].astype(logits.dtype)
    combined = ((1 + s) * logits if form == "residual" else logits) - s * counterfactual
    return jnp.where(s == 0, logits, combined)  # 0 * a_bar may still flip the sign of a zero
