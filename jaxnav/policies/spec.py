"""The specification of a policy: everything but its parameters."""

import dataclasses
from typing import TYPE_CHECKING, Any, Literal, get_args

from jaxnav.choices import CounterfactualMemory

if TYPE_CHECKING:
    from jaxnav.policies.method import Method
    from jaxnav.policies.spatial_memory import SpatialMemory

#: Detections that the direct pathway G -> A sees: of all categories, of the goal alone, or none.
Direct = Literal["all", "goal", "none"]
#: Scale at which the layout weights enter experience: as in eq. 7, over their mean (`jaxnav.layout.scale_weights`), or
#: as in eq. 7 with boxes in pixels (`jaxnav.policies.features.scale_geometry`).
WeightKind = Literal["raw", "relative", "pixel"]
#: Network from pathways to logits: fused before one recurrent core (the paper), or two streams that are added.
DecisionKind = Literal["fused", "streams"]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Widths of the layers that all methods have, each at least 1.

    Attributes:
      hidden: width of the memory (recurrent state) and of the layer that joins all inputs before it.
      view_outputs: width of the features of the scene (free and blocked cells, without objects).
      appearance: width of the learned embedding of an object category.
      row_hidden: width of the hidden layer of the perceptron that reads the detection of each category.
      row_outputs: number of features per category that the perceptron for detections makes.
    """

    # Letters of the sizes in shapes and equations.
    hidden: int = 64  # H
    view_outputs: int = 64  # S
    appearance: int = 16  # d
    row_hidden: int = 32  # h
    row_outputs: int = 8  # m


#: Fields that policies of earlier versions lack, with the values that they were trained with.
_EARLIER_FIELDS: dict[str, Any] = {
    "weight_kind": "raw",
    "experience_dropout": False,
    "counterfactual_memory": "factual",
}


@dataclasses.dataclass(frozen=True)
class PolicySpec:
    """Specification of a policy; hashable.

    Attributes:
      method: method of the policy, see `jaxnav.policies.methods.find_method`.
      num_categories: K.
      sizes: widths that all methods share.
      method_sizes: (name, value) of the method's own sizes, where they differ from the defaults.
      direct: detections that the direct pathway sees; the number of parameters does not depend on it.
      spatial_memory: map that the scene's direct pathway reads in addition to the view; None in the paper.
      done_gate: multiply the logit of Done by 0.58 times the confidence with which the goal is detected, 0 where it is
        not (released code of HOZ and L-sTDE). A logit of 0 is likely at first: this also changes how training starts.
      decision: network from pathways to logits.
      goal_row: whether the direct pathway holds the goal's detection once more, in a row of its own; not in the paper.
      weight_kind: how the layout weights enter experience (eq. 7).
      experience_dropout: whether a fused network was trained in some episodes without experience (Z = 0); two streams
        always are.
      counterfactual_memory: recurrent state from which the counterfactual branch decides.

    Raises:
      ValueError: a word is not among the options of its field, or two streams get a counterfactual memory of their own.
    """

    method: "Method"
    num_categories: int = 22
    sizes: Sizes = Sizes()
    method_sizes: tuple[tuple[str, int], ...] = ()
    direct: Direct = "all"
    done_gate: bool = False
    spatial_memory: "SpatialMemory | None" = None
    decision: DecisionKind = "fused"
    goal_row: bool = True
    weight_kind: WeightKind = "raw"
    experience_dropout: bool = False
    counterfactual_memory: CounterfactualMemory = "factual"

    def __post_init__(self) -> None:
        for name, options in (
            ("direct", get_args(Direct)),
            ("decision", get_args(DecisionKind)),
            ("weight_kind", get_args(WeightKind)),
            ("counterfactual_memory", get_args(CounterfactualMemory)),
        ):
            value = getattr(self, name)
            if value not in options:
                raise ValueError(f"{name} is {value!r}; choose one of {', '.join(options)}")
        if self.counterfactual_memory == "own" and self.decision != "fused":
            raise ValueError("counterfactual_memory is 'own', but two streams have separate memories; give 'factual'")

    @property
    def can_drop_experience(self) -> bool:
        """True if training included episodes without experience, so that Z = 0 leaves a trained policy."""
        return self.experience_dropout or self.decision == "streams"

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values: the method by its name, without the number of categories."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del fields["num_categories"]
        memory = self.spatial_memory
        return fields | {
            "method": self.method.name,
            "sizes": dataclasses.asdict(self.sizes),
            "method_sizes": dict(self.method_sizes),
            "spatial_memory": None if memory is None else dataclasses.asdict(memory),
        }

    @classmethod
    def from_json(cls, fields: dict[str, Any], method: "Method", num_categories: int) -> "PolicySpec":
        """Return the spec of which `to_json` returned `fields`; other keys are ignored.

        Args:
          fields: fields of the spec as read from JSON.
          method: found by the name `fields["method"]`.
          num_categories: K.

        Raises:
          KeyError, TypeError, ValueError: a field is missing or has no such value.
        """
        from jaxnav.policies.spatial_memory import SpatialMemory

        fields = _EARLIER_FIELDS | fields
        values = {field.name: fields[field.name] for field in dataclasses.fields(cls) if field.name != "num_categories"}
        memory = values["spatial_memory"]
        values |= {
            "method": method,
            "num_categories": num_categories,
            "sizes": Sizes(**values["sizes"]),
            "method_sizes": tuple(sorted(values["method_sizes"].items())),
            "spatial_memory": None if memory is None else SpatialMemory(**memory),
        }
        return cls(**values)
