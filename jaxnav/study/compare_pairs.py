"""The agents of a comparison, and what each is compared with."""

import itertools
from typing import NamedTuple

from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.base import Primitive
from jaxnav.policies.spec import Deciding
from jaxnav.study.compare_config import CompareConfig

#: Uses of a run's policies, and how they are printed.
VARIANTS = {"baseline": "", "layout": " + w", "stde": " + w + sTDE"}
#: Those and, of a method whose choices are no actions, random choices.
LABELS = {**VARIANTS, "random": ", random choices"}
#: The agents that cannot know any layout.
WITHOUT = "anonymous"
#: What is improved within a run: an agent and what it is compared with.
STEPS = (("layout", "baseline"), ("stde", "layout"), ("stde", "baseline"))


class TableRow(NamedTuple):
    """Name one row of a world's table.

    Attributes:
      method, decision: of its run.
      variant: a key of `LABELS`.
    """

    method: str
    decision: Deciding
    variant: str

    def __str__(self) -> str:
        return run_label(self.method, self.decision) + LABELS[self.variant]


def run_label(method: str, decision: Deciding) -> str:
    """Return the name of a run as printed."""
    return f"`{method.rpartition('.')[2]}`" + (f", {decision}" if decision != "fused" else "")


def chooses_actions(method: str) -> bool:
    """Return whether the policy's choices are the actions themselves."""
    return find_method(method).control == Primitive()


def comparisons(config: CompareConfig) -> list[tuple[TableRow, TableRow]]:
    """Return every agent with what it is compared with."""
    first, *others = config.decisions
    pairs = []
    for method in config.methods:
        if method != WITHOUT and WITHOUT in config.methods:  # what experience is worth
            pairs.append((TableRow(method, "fused", "baseline"), TableRow(WITHOUT, "fused", "baseline")))
        for decision, (variant, reference) in itertools.product(config.decisions, STEPS):
            pairs.append((TableRow(method, decision, variant), TableRow(method, decision, reference)))
        for decision, variant in itertools.product(others, VARIANTS):
            pairs.append((TableRow(method, decision, variant), TableRow(method, first, variant)))
        if not chooses_actions(method):
            for decision, variant in itertools.product(config.decisions, VARIANTS):
                pairs.append((TableRow(method, decision, variant), TableRow(method, decision, "random")))
        for ablation, decision, variant in itertools.product(
            config.ablations.get(method, ()), config.decisions, VARIANTS
        ):
            pairs.append((TableRow(method, decision, variant), TableRow(ablation, decision, variant)))
    return pairs
