"""Trials: ways to use the policies at inference."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.evaluation.inference import Branch, Inference
from jaxnav.evaluation.report import Decoding, Form
from jaxnav.evaluation.variants import inference_grid, table_row

#: What a control changes about sTDE: the weight is its mean at every step, or that of another episode; zeros or noise
#: are subtracted instead of logits; the intervention is random instead of zero.
Control = Literal["constant", "shuffled", "zeros", "noise", "random"]
Variant = Literal["baseline", "layout", "tde", "stde"]


class Use(NamedTuple):
    """Hold a threshold and a form of sTDE."""

    epsilon: float
    form: Form


FORMS: tuple[Form, ...] = ("residual", "paper")
#: Uses of sTDE with all gaps and controls: the paper's threshold, and no threshold in the paper's form.
THRESHOLD, NO_THRESHOLD = Use(0.5, "residual"), Use(0.0, "paper")
USES: Mapping[str, Use] = {"sTDE (eps 0.5)": THRESHOLD, "sTDE (eps 0, paper's form)": NO_THRESHOLD}


@dataclasses.dataclass(frozen=True)
class Trial:
    """Describe one way to use the policies of a run.

    Attributes:
      variant: `baseline`, `layout`, `tde` or `stde`.
      decoding: of actions.
      epsilon, form: of sTDE.
      control: what is changed about sTDE.
      weight: the weight of `constant`; trials that differ by it alone are equal.
    """

    variant: Variant
    decoding: Decoding = "argmax"
    epsilon: float | None = None
    form: Form | None = None
    control: Control | None = None
    weight: float = dataclasses.field(default=0.0, compare=False)

    def cells(self, arms: Sequence[str], num_seeds: int) -> Inference:
        """Return the cells of the grid, leaves [S]; see `inference_grid`."""
        cells = inference_grid([table_row(self.variant, self.epsilon, self.form, self.decoding)], arms, num_seeds)
        match self.control:
            case "constant":
                changes = {"gap": jnp.float32(self.weight), "epsilon": jnp.float32(0.0)}
            case "shuffled":
                changes = {"shuffled": jnp.bool_(True)}
            case "zeros":
                changes = {"branch": jnp.int32(Branch.ZEROS)}
            case "noise":
                changes = {"branch": jnp.int32(Branch.NOISE)}
            case "random":
                changes = {"intervention": jnp.float32(1.0)}
            case None:
                changes = {}
        return cells.replace(**{name: jnp.broadcast_to(value, (num_seeds,)) for name, value in changes.items()})


def trial_grid(trials: Sequence[Trial], arms: Sequence[str], num_seeds: int) -> Inference:
    """Return the cells of all trials, leaves [T S]."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(trial.cells(arms, num_seeds) for trial in trials))
