"""The rows of the paper's tables as cells of an evaluation grid."""

import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.causal import FORMS, Form
from jaxnav.errors import InputError
from jaxnav.evaluation.inference import Branch, Inference, Source
from jaxnav.evaluation.report import Decoding, Variant


class Row(NamedTuple):
    """Name one row of the table.

    Attributes:
      variant: what is evaluated.
      epsilon: threshold of sTDE, else None.
      form: how counterfactual logits are combined, None where there are none.
      decoding: `argmax` or `sample`.
    """

    variant: Variant
    epsilon: float | None
    form: Form | None
    decoding: Decoding

    @property
    def arm(self) -> Literal["baseline", "layout"] | None:
        """Return the arm whose policies it takes; None for any."""
        if self.variant in ("random", "oracle"):
            return None
        return "baseline" if self.variant == "baseline" else "layout"


def table_row(variant: Variant, epsilon: float | None, form: Form | None, decoding: Decoding) -> Row:
    """Make one row of what its variant uses.

    Raises:
      InputError: an epsilon outside [0, inf), or NaN.
    """
    if variant == "tde":
        return Row(variant, None, "paper", decoding)  # equation 1
    if variant != "stde":
        return Row(variant, None, None, decoding)
    if epsilon is None or not 0.0 <= epsilon < float("inf"):
        raise InputError(f"--epsilon {epsilon}: give numbers from 0 to below infinity")
    return Row(variant, epsilon, form, decoding)


def table_rows(epsilons: Sequence[float], forms: Sequence[Form], arms: Sequence[str]) -> list[Row]:
    """Make the rows of an evaluation.

    Baseline, layout, hard TDE, and sTDE at every epsilon and in every form, argmax then sampled, and Random; without
    those of arms that were not trained.

    Raises:
      InputError: no epsilon, or one outside [0, inf), or NaN.
    """
    if not epsilons:
        raise InputError("--epsilon: give at least one number")
    rows: list[Row] = []
    for decoding in ("argmax", "sample"):
        rows += [table_row(variant, None, None, decoding) for variant in ("baseline", "layout", "tde")]
        rows += [table_row("stde", *setting, decoding) for setting in itertools.product(epsilons, forms)]
    rows = [row for row in rows if row.arm in arms]
    return [*rows, table_row("random", None, None, "sample")]


def inference_grid(rows: Sequence[Row], arms: Sequence[str], num_seeds: int) -> Inference:
    """Make the grid of rows and seeds, leaves [R S].

    Args:
      rows: the rows; their arms must be there.
      arms: names of the arms, in the order in which their parameters are stacked, S each.
      num_seeds: S.
    """
    cells = [_cell(row, arms, seed, num_seeds) for row in rows for seed in range(num_seeds)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cells)


def _cell(row: Row, arms: Sequence[str], seed: int, num_seeds: int) -> Inference:
    place = 0 if row.arm is None else arms.index(row.arm)
    return Inference(
        params=jnp.int32(seed + num_seeds * place),
        epsilon=jnp.float32(float("inf") if row.epsilon is None else row.epsilon),
        hard=jnp.bool_(row.variant == "tde"),
        form=jnp.int32(FORMS.index(row.form or "paper")),
        layout=jnp.bool_(row.arm == "layout"),
        greedy=jnp.bool_(row.decoding == "argmax"),
        uniform=jnp.bool_(row.variant == "random"),
        source=jnp.int32(Source.OWN),
        gap=jnp.float32(0.0),
        begin=jnp.int32(0),
        end=jnp.int32(0),
        intervention=jnp.float32(0.0),
        branch=jnp.int32(Branch.COUNTERFACTUAL),
    )
