"""The sizes of a policy: all that is needed, beside its parameters, to build it again."""

import dataclasses
from typing import Literal

#: Which detections the direct pathway G -> A sees: of all categories, of the goal's alone, or none.
Direct = Literal["all", "goal", "none"]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Widths that all methods share.

    Attributes:
      hidden: H, width of the recurrent state and of the fused input.
      view_outputs: S, width of the scene embedding.
      appearance: d, width of a category's embedding.
      row_hidden: width of the perceptron that reads a category's row.
      row_outputs: m, its outputs per category.
      relation_layers: layers of ORG's relation matrix.
    """

    hidden: int = 128
    view_outputs: int = 64
    appearance: int = 16
    row_hidden: int = 32
    row_outputs: int = 8
    relation_layers: int = 4


@dataclasses.dataclass(frozen=True)
class PolicySpec:
    """What a policy is built from.

    Attributes:
      method: name of the method, a key of `METHODS`; how experience is made.
      num_categories: K.
      sizes: widths.
      direct: which detections the direct pathway sees; the number of parameters does not depend on it.
      done_gate: multiply the logit of Done by 0.58 times the confidence with which the goal is detected, 0 where it is
        not (released code of HOZ and L-sTDE). A logit of 0 is likely at first: this also changes how training starts.
    """

    method: str = "org"
    num_categories: int = 22
    sizes: Sizes = Sizes()
    direct: Direct = "all"
    done_gate: bool = False
