"""What an exported policy is, in words: its model card."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax

from jaxnav import __version__
from jaxnav.runs.directory import Run
from jaxnav.runs.policy import LoadedPolicy

#: The sentence by which a card is known.
SIGNATURE = "A policy for object navigation on a grid, exported by jaxnav."
_LAYOUT = {"baseline": "no layout weights", "layout": "layout weights (eq. 7); experience is removed by sTDE (eq. 2)"}


def model_card(run: Run, name: str, policy: LoadedPolicy, files: Mapping[str, str], use: Iterable[str]) -> str:
    """Write the model card of a policy of a run.

    Args:
      run: that trained it.
      name: of the policy in the run, such as `layout-0`.
      policy: the same.
      files: of the export, and what each is.
      use: lines of Markdown that say how it is used.

    Returns:
      Markdown.
    """
    config, (arm, _, seed) = run.config, name.rpartition("-")
    steps = ", ".join(f"{number:,} of {what}" for what, number in config.budget.items() if number)
    goals = config.task.goals or config.task.categories
    categories = len(config.task.categories)
    scenes = f"scenes of `{config.scenes.name}`" if config.scenes else "generated scenes"
    facts = {
        "Method": f"`{config.method}`, decision `{config.decision}`, {_LAYOUT[arm]}",
        "Trained in": f"{scenes}, rules of `{config.world}`, {categories} categories, training seed {seed}",
        "Environment steps": steps,
        "Success in val scenes": _success(run.reach(), arm),
        "Parameters": f"{sum(leaf.size for leaf in jax.tree.leaves(policy.params)):,}",
        "Looks for": ", ".join(goals),
        "Version": f"jaxnav {__version__}",
    }
    return "\n".join(
        [
            f"# {name} of {run.config.run_dir.name}",
            "",
            SIGNATURE,
            "",
            *(f"* **{what}**: {fact}" for what, fact in facts.items()),
            "",
            "## Files",
            "",
            *(f"* `{file}`: {what}" for file, what in files.items()),
            "",
            "## Use",
            "",
            *use,
            "",
            "## Limits",
            "",
            "It was trained on a grid with a simulated detector, never on images, and knows those categories alone.",
            "Success was measured in the scenes by which the run chose its policies; it is no result for a table.",
            "",
        ]
    )


def _success(reach: dict[str, Any] | None, arm: str) -> str:
    """Say how often policies of an arm succeed."""
    if reach is None:
        return "not measured"
    curves = reach["val"][arm]
    best, sampled = (100.0 * curves[decoding][-1] for decoding in ("argmax", "sample"))
    return f"{best:.1f} % with best actions, {sampled:.1f} % with sampled ones, the mean of all seeds of `{arm}`"
