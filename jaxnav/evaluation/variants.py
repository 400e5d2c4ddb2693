"""The rows of the paper's tables as cells of an evaluation grid."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.errors import InputError
from jaxnav.evaluation.grid import Inference
from jaxnav.evaluation.report import Decoding, Form, Variant


class Row(NamedTuple):
    """One row of the table, S cells of the grid.

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


def table_rows(epsilons: Sequence[float], forms: Sequence[Form]) -> list[Row]:
    """Baseline, layout, hard TDE and sTDE at every epsilon and in every form, argmax then sampled, and Random.

    Raises:
      InputError: an epsilon outside [0, inf), or NaN.
    """
    for epsilon in epsilons:
        if not 0.0 <= epsilon < float("inf"):
            raise InputError(f"--epsilon {epsilon}: give numbers from 0 to below infinity")
    rows: list[Row] = []
    for decoding in ("argmax", "sample"):
        rows += [Row("baseline", None, None, decoding), Row("layout", None, None, decoding)]
        rows += [Row("tde", None, form, decoding) for form in forms]
        rows += [Row("stde", epsilon, form, decoding) for epsilon, form in itertools.product(epsilons, forms)]
    return [*rows, Row("random", None, None, "sample")]


def inference_grid(rows: Sequence[Row], num_seeds: int) -> Inference:
    """The grid of R rows and S seeds, leaves [R S]; parameters are stacked baseline seeds first, then layout seeds."""
    cells = [_cell(row, seed, num_seeds) for row in rows for seed in range(num_seeds)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cells)


def _cell(row: Row, seed: int, num_seeds: int) -> Inference:
    layout = row.variant not in ("random", "baseline")
    return Inference(
        params=jnp.int32(seed + num_seeds * layout),
        epsilon=jnp.float32(float("inf") if row.epsilon is None else row.epsilon),
        always=jnp.float32(row.variant == "tde"),
        residual=jnp.bool_(row.form == "residual"),
        layout=jnp.bool_(layout),
        greedy=jnp.bool_(row.decoding == "argmax"),
        uniform=jnp.bool_(row.variant == "random"),
    )
