"""All figures of a study, from its results."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.figures import (
    auc_figure,
    effects_figure,
    epsilon_figure,
    gain_figure,
    gap_figure,
    similarity_figure,
)
from jaxnav.study.records import Condition, TrialRow
from jaxnav.study.results import WorldResults, load_results
from jaxnav.study.tables import table_1
from jaxnav.study.trials import SWEPT
from jaxnav.viz.figure import save_figure


def draw_figures(folder: Path, images: Path) -> None:
    """Draw the figures of the results in a folder.

    Raises:
      InputError: there are no results.
    """
    results = load_results(folder)
    if results is None:
        raise InputError(f"{folder}: holds no results; run the study first")
    images.mkdir(parents=True, exist_ok=True)
    for world, in_world in results.worlds.items():
        for name, figure in _figures(in_world).items():
            save_figure(figure, images / f"{world}-{name}.png")


def _figures(results: WorldResults) -> dict[str, Figure]:
    conditions, course = results.conditions, results.course
    first, last = conditions[0], conditions[-1]
    return {
        "fig4": similarity_figure({each.shift: each.similarity for each in conditions}),
        "fig5": gain_figure({each.shift: each.gains.stde for each in (first, last)}, "+ w + sTDE"),
        "fig6a": epsilon_figure(_sweeps(conditions)),
        "fig6b": gap_figure(course.at_shifts(first.shift, last.shift)),
        "auc": auc_figure(course.steps, course.auc[-1]),
        "effects": effects_figure({f"shift {each.shift:g}": _effects(each) for each in conditions}),
    }


def _sweeps(conditions: Sequence[Condition]) -> dict[tuple[float, Form], dict[float, TrialRow]]:
    """Return the rows of sTDE with best actions, epsilon rising."""
    return {
        (condition.shift, form): dict(sorted(condition.sweep(form).items()))
        for condition in conditions
        for form in SWEPT
    }


def _effects(condition: Condition) -> dict[str, Interval]:
    """Return differences in SR of sTDE to the layout's weights."""
    return {
        name.replace("`", ""): row.difference.sr
        for name, row in table_1(condition)
        if row.trial.variant == "stde" and row.trial.control is None and row.difference is not None
    }
