"""The rows of the paper's tables as entries of an evaluation grid.

`table_rows` lists the rows of an evaluation; `inference_grid` turns rows and training seeds into the entries that
`jaxnav.evaluation.grid` evaluates in one compiled call.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.causal import FORMS
from jaxnav.choices import Form, Removal, RowDecoding, Variant
from jaxnav.errors import InputError, check_choice
from jaxnav.evaluation.episodes import MAX_EPISODES
from jaxnav.evaluation.removal import GapSource, InferenceConfig, RemovedLogits
from jaxnav.evaluation.replacements import ReplacedPart

#: Variants of each kind of removal: complete, and soft.
REMOVAL_VARIANTS: Mapping[Removal, tuple[Variant, Variant]] = {"tde": ("tde", "stde"), "cde": ("cde", "scde")}


def share_networks(variant: str, reference: str) -> bool:
    """True if two variants of one run act by the same networks; only the baseline was trained on its own."""
    return "baseline" not in (variant, reference)


class EvaluationRow(NamedTuple):
    """One row of an evaluation table.

    Attributes:
      variant: the evaluated variant.
      epsilon: threshold of soft removal; None for other variants.
      form: how counterfactual logits are combined; None for variants without counterfactual.
      decoding: `argmax`, `sample`, or `own` for an agent that is no policy of jaxnav.
    """

    variant: Variant
    epsilon: float | None
    form: Form | None
    decoding: RowDecoding

    @property
    def arm(self) -> Literal["baseline", "layout"] | None:
        """Training arm whose policies the row uses; None if it uses no policy."""
        if self.variant in ("random", "frontier", "oracle", "agent"):
            return None
        return "baseline" if self.variant == "baseline" else "layout"

    @property
    def uses_own_fallback(self) -> bool:
        """True if removal leaves the decision of the policy itself under do(Z = 0)."""
        return self.variant in REMOVAL_VARIANTS["cde"]


def table_rows(
    epsilons: Sequence[float],
    forms: Sequence[Form] | None,
    arms: Sequence[str],
    removals: Sequence[Removal] = ("tde",),
    default_form: Form = "residual",
) -> list[EvaluationRow]:
    """List the rows of an evaluation.

    The rows are baseline, layout, and for each kind of removal the complete one and the soft one for every epsilon and
    form, first with argmax and then with sampled actions; Random comes last. Rows of arms that were not trained are
    omitted.

    Args:
      epsilons: thresholds of soft removal.
      forms: forms of soft removal; None for `default_form` of sTDE, and `paper` of sCDE, a - s (a - a0).
      arms: names of the arms.
      removals: kinds of removal.
      default_form: form of sTDE if `forms` is None.

    Raises:
      InputError: no kind of removal or an unknown one, no form or an unknown one, no epsilon, or one outside [0, inf),
        or NaN.
    """
    if not epsilons:
        raise InputError("--epsilon: give at least one number")
    if forms is not None and not forms:
        raise InputError("--form: give at least one form")
    if not removals:
        raise InputError("--removal: give tde, cde or both")
    for removal in removals:
        check_choice("--removal", removal, get_args(Removal))
    default_forms: Mapping[Removal, Form] = {"tde": default_form, "cde": "paper"}

    # Best actions first, then sampled ones: the order of the printed table.
    all_rows: list[EvaluationRow] = []
    for decoding in ("argmax", "sample"):
        for variant in ("baseline", "layout"):
            all_rows.append(table_row(variant, None, None, decoding))
        for removal in dict.fromkeys(removals):
            complete_variant, soft_variant = REMOVAL_VARIANTS[removal]
            all_rows.append(table_row(complete_variant, None, None, decoding))
            soft_forms = (default_forms[removal],) if forms is None else forms
            for epsilon, form in itertools.product(epsilons, soft_forms):
                all_rows.append(table_row(soft_variant, epsilon, form, decoding))

    # Random needs no policy and is always included.
    trained_rows = [row for row in all_rows if row.arm in arms]
    return [*trained_rows, table_row("random", None, None, "sample")]


def table_row(variant: Variant, epsilon: float | None, form: Form | None, decoding: RowDecoding) -> EvaluationRow:
    """Make one row, dropping the settings that its variant does not use.

    Raises:
      InputError: an unknown form or decoding, or an epsilon outside [0, inf), or NaN.
    """
    check_choice("--form", form, FORMS)
    check_choice("--decoding", decoding, get_args(RowDecoding))
    if variant in ("tde", "cde"):
        return EvaluationRow(variant, None, "paper", decoding)  # equation 1
    if variant not in ("stde", "scde"):
        return EvaluationRow(variant, None, None, decoding)
    if epsilon is None or not 0.0 <= epsilon < float("inf"):
        raise InputError(f"--epsilon {epsilon}: give finite numbers of at least 0")
    return EvaluationRow(variant, epsilon, form, decoding)


def inference_grid(rows: Sequence[EvaluationRow], arms: Sequence[str], num_seeds: int) -> InferenceConfig:
    """Make the grid of rows and seeds, leaves [R S].

    Args:
      rows: R rows; their arms must be in `arms`.
      arms: names of the arms, in the order in which their parameters are stacked, S each.
      num_seeds: S.
    """
    # Row by row, with all seeds of a row next to each other.
    entries = []
    for row in rows:
        for seed in range(num_seeds):
            entries.append(_grid_entry(row, arms, seed, num_seeds))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *entries)


class Replacement(NamedTuple):
    """A row in which a part of every decision is replaced by that of another episode.

    Attributes:
      row: the row without the replacement.
      part: the replaced part.
    """

    row: EvaluationRow
    part: ReplacedPart


def replacement_grid(
    replacements: Sequence[Replacement], arms: Sequence[str], num_seeds: int, max_room_episodes: int
) -> InferenceConfig:
    """Make the grid of replacements and seeds, leaves [R S].

    Args:
      replacements: R replacements; the arms of their rows must be in `arms`.
      arms, num_seeds: as in `inference_grid`.
      max_room_episodes: number of episodes of each room type to run.
    """
    grid = inference_grid([replacement.row for replacement in replacements], arms, num_seeds)
    parts = jnp.asarray([replacement.part for replacement in replacements], jnp.int32)
    return grid.replace(
        replaced_part=jnp.repeat(parts, num_seeds),
        max_room_episodes=jnp.full_like(grid.max_room_episodes, max_room_episodes),
    )


def _grid_entry(row: EvaluationRow, arms: Sequence[str], seed: int, num_seeds: int) -> InferenceConfig:
    """Grid entry of one row and seed, leaves []; the controls of sTDE are off."""
    # Random gets the policies of the first arm, which it ignores. An infinite epsilon never removes anything.
    arm_index = 0 if row.arm is None else arms.index(row.arm)
    return InferenceConfig(
        policy_index=jnp.int32(seed + num_seeds * arm_index),
        epsilon=jnp.float32(float("inf") if row.epsilon is None else row.epsilon),
        remove_completely=jnp.bool_(row.variant in ("tde", "cde")),
        form=jnp.int32(FORMS.index(row.form or "paper")),
        use_layout=jnp.bool_(row.arm == "layout"),
        greedy=jnp.bool_(row.decoding == "argmax"),
        act_randomly=jnp.bool_(row.variant == "random"),
        gap_source=jnp.int32(GapSource.OWN),
        given_gap=jnp.float32(0.0),
        gap_begin=jnp.int32(0),
        gap_end=jnp.int32(0),
        direct_noise=jnp.float32(0.0),
        removed_source=jnp.int32(RemovedLogits.COUNTERFACTUAL),
        replaced_part=jnp.int32(ReplacedPart.NONE),
        replaces_factual=jnp.bool_(True),
        max_room_episodes=jnp.int32(MAX_EPISODES),
    )
