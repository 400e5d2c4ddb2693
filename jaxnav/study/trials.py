"""Trials: ways to use the policies at inference."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.causal import Form
from jaxnav.evaluation.inference import Branch, Inference, Source
from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.study.codec import OPTIONAL

#: Controls that know nothing of the episode: the mean gap of all episodes at the time, of equal `course`; a gap of 1
#: `after` a step or `until` it, else 0.
Schedule = Literal["course", "after", "until"]
#: What a control changes about sTDE. The gap: that of another episode (`shuffled`); `constant`, such that the weight is
#: its mean at every step; or a clock's. What is subtracted: `zeros` or `noise` instead of logits. The intervention:
#: `random` instead of zero.
Control = Literal["shuffled", "constant", "zeros", "noise", "random"]
Variant = Literal["baseline", "layout", "tde", "stde"]


class Use(NamedTuple):
    """Hold a threshold and a form of sTDE."""

    epsilon: float
    form: Form


#: A step that no episode reaches.
NEVER = 2**30
SWEPT: tuple[Form, ...] = ("residual", "paper")
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
      step: of `after` and `until`.
      weight: the weight of `constant`; trials that differ by it alone are equal.
    """

    variant: Variant
    decoding: Decoding = "argmax"
    epsilon: float | None = None
    form: Form | None = None
    control: Control | Schedule | None = None
    step: int | None = dataclasses.field(default=None, metadata=OPTIONAL)
    weight: float = dataclasses.field(default=0.0, compare=False)

    def cells(self, arms: Sequence[str], num_seeds: int) -> Inference:
        """Return the cells of the grid, leaves [S]; see `inference_grid`."""
        cells = inference_grid([table_row(self.variant, self.epsilon, self.form, self.decoding)], arms, num_seeds)
        match self.control:
            case "shuffled":
                changes = {"source": jnp.int32(Source.OTHER)}
            case "course":
                changes = {"source": jnp.int32(Source.MEAN)}
            case "constant":
                changes = _given(self.weight, 0, NEVER) | {"epsilon": jnp.float32(0.0)}
            case "after":
                changes = _given(1.0, self._step, NEVER)
            case "until":
                changes = _given(1.0, 0, self._step)
            case "zeros":
                changes = {"branch": jnp.int32(Branch.ZEROS)}
            case "noise":
                changes = {"branch": jnp.int32(Branch.NOISE)}
            case "random":
                changes = {"intervention": jnp.float32(1.0)}
            case None:
                changes = {}
        return cells.replace(**{name: jnp.broadcast_to(value, (num_seeds,)) for name, value in changes.items()})

    @property
    def _step(self) -> int:
        if self.step is None:
            raise ValueError(f"{self.control}: give its step")
        return self.step


def _given(gap: float, begin: int, end: int) -> dict[str, jax.Array]:
    """Return what makes the gap a number from one step to another."""
    return {
        "source": jnp.int32(Source.GIVEN),
        "gap": jnp.float32(gap),
        "begin": jnp.int32(begin),
        "end": jnp.int32(end),
    }


def trial_grid(trials: Sequence[Trial], arms: Sequence[str], num_seeds: int) -> Inference:
    """Return the cells of all trials, leaves [T S]."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(trial.cells(arms, num_seeds) for trial in trials))
