"""What a policy is built from, beside its parameters."""

import dataclasses
from typing import Literal, get_args

from jaxnav.policies.spatial_memory import SpatialMemory

#: Which detections the direct pathway G -> A sees: of all categories, of the goal's alone, or none.
Direct = Literal["all", "goal", "none"]
#: How pathways become logits: fused before one recurrent core (the paper), or in two streams that are added up.
Deciding = Literal["fused", "streams"]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Hold the widths that all methods share.

    Attributes:
      hidden: H, width of the recurrent state and of the fused input.
      view_outputs: S, width of the scene embedding.
      appearance: d, width of a category's embedding.
      row_hidden: width of the perceptron that reads a category's row.
      row_outputs: m, its outputs per category.
    """

    hidden: int = 64
    view_outputs: int = 64
    appearance: int = 16
    row_hidden: int = 32
    row_outputs: int = 8


@dataclasses.dataclass(frozen=True)
class PolicySpec:
    """Hold what a policy is built from; hashable.

    Attributes:
      method: name of the method, see `jaxnav.policies.methods.find_method`.
      num_categories: K.
      sizes: widths that all methods share.
      method_sizes: (name, value) of the method's own sizes that are not the usual ones.
      direct: which detections the direct pathway sees; the number of parameters does not depend on it.
      spatial_memory: what the scene's direct pathway remembers beside the view; None in the paper.
      done_gate: multiply the logit of Done by 0.58 times the confidence with which the goal is detected, 0 where it is
        not (released code of HOZ and L-sTDE). A logit of 0 is likely at first: this also changes how training starts.
      decision: how pathways become logits.
      goal_row: whether the direct pathway holds the goal's detection once more, in a row of its own; not in the paper.
    """

    method: str = "org"
    num_categories: int = 22
    sizes: Sizes = Sizes()
    method_sizes: tuple[tuple[str, int], ...] = ()
    direct: Direct = "all"
    done_gate: bool = False
    spatial_memory: SpatialMemory | None = None
    decision: Deciding = "fused"
    goal_row: bool = True

    def __post_init__(self) -> None:
        if self.decision not in get_args(Deciding):
            raise ValueError(f"decision is {self.decision!r}; choose one of {', '.join(get_args(Deciding))}")
