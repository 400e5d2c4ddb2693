"""Names that several functions and options accept, as types without any import.

The command line reads these types to show its help, so this module must not import JAX.
"""

from typing import Literal, get_args

#: Generated worlds, whose rules imported scenes follow.
WorldName = Literal["rooms", "apartments", "houses"]
#: Splits of the scenes of a world.
Split = Literal["train", "val", "test"]
#: Form in which equation 2 combines the logits, see `jaxnav.causal.stde`.
Form = Literal["paper", "residual", "switch", "mixture"]
#: Reduction over the rows' divergences in eq. 5: the mean over visible rows, the mean over all K, or the sum.
Reduction = Literal["mean_visible", "mean", "sum"]
#: Counts of a view in eq. 3: 1 for each visible category, or the number of its visible instances.
Counts = Literal["presence", "instances"]
#: Measures of the layout gap, see `jaxnav.layout.EstimatorConfig`.
GapName = Literal["novelty", "evidence", "learned", "surprise", "overdue", "clock"]
#: Layout estimators that an evaluation may use in place of the one from training.
EstimatorName = Literal["paper", "released", "evidence", "learned", "surprise", "overdue", "clock"]
#: Ways to use policies in an evaluation, agents of other kinds, and the references without training.
Variant = Literal["oracle", "frontier", "random", "agent", "baseline", "layout", "tde", "stde", "cde", "scde"]
#: Ways to use policies in the picture of an episode.
PlayedVariant = Literal["stde", "scde", "layout", "baseline"]
#: Parts of a decision whose cost an evaluation measures: other categories in Z, all parts, or none.
Costs = Literal["categories", "all", "none"]
DEFAULT_COSTS: Costs = "categories"
#: Causal quantity that a complete removal of experience leaves: the total direct effect (eq. 1), or the decision under
#: do(Z = 0) (controlled direct effect).
Removal = Literal["tde", "cde"]
DEFAULT_REMOVALS: tuple[Removal, ...] = ("tde",)
#: Thresholds of soft removal in an evaluation.
DEFAULT_EPSILONS = (0.5,)
#: Memory of the counterfactual branch: the factual one, or one of its own, to which both direct pathways are zero.
CounterfactualMemory = Literal["factual", "own"]
#: Categories that exchange their places under a layout shift: neighbours in size, drawn for each scene, or the ones
#: whose exchange misleads most, equal in all scenes.
ShiftKind = Literal["size", "context"]
#: Rule that turns logits into actions: the best action, or a sampled one.
Decoding = Literal["argmax", "sample"]
DECODINGS: tuple[Decoding, ...] = get_args(Decoding)
#: Decoding of a row: that of its policies, or the agent's own way to choose actions.
RowDecoding = Literal["argmax", "sample", "own"]
