"""Learning curves of a run: success during training, and success of the exported policies within a budget."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.viz.style import TEXT_COLOR, default_style, freeze_axes_positions, make_panels, set_panel_title

#: Color of the curves of each arm.
ARM_COLORS = {"baseline": "#D55E00", "layout": "#0072B2"}

# Styles of the curves: of val episodes with best and with sampled actions, and of training scenes.
_LINE: dict[str, Any] = {"lw": 1.4, "ms": 3.5}
_BEST_STYLE: dict[str, Any] = _LINE | {"ls": "-", "marker": "o"}
_SAMPLED_STYLE: dict[str, Any] = _LINE | {"ls": "--", "marker": "s"}
_TRAINING_STYLE: dict[str, Any] = _LINE | {"ls": ":"}


@default_style
def learning_figure(
    rows: Sequence[Mapping[str, Any]], success_by_budget: Mapping[str, Any] | None, title: str
) -> Figure:
    """Draw success during training, and within numbers of actions.

    The left panel shows the mean over seeds against environment steps: of training episodes, and of val episodes with
    best and with sampled actions. The right panel shows the exported policies: in val scenes, and with best actions in
    training scenes.

    Args:
      rows: the training log.
      success_by_budget: success within each budget, see `Run.success_by_budget`; None for no right panel.
      title: title of the figure.
    """
    # The right panel has the budgets, if they were measured.
    figure, panels = make_panels(1, 1 if success_by_budget is None else 2, height=3.2, sharey=True)
    logged_arms = {row["arm"] for row in rows}
    arms = [arm for arm in ARM_COLORS if arm in logged_arms]

    # Curves of the training log.
    log_axes = panels[0, 0]
    for arm in arms:
        color = ARM_COLORS[arm]
        log_axes.plot(*_mean_curve(rows, arm, "success"), color=color, **_TRAINING_STYLE)
        log_axes.plot(*_mean_curve(rows, arm, "val_success"), color=color, **_BEST_STYLE)
        log_axes.plot(*_mean_curve(rows, arm, "val_success_sampled"), color=color, **_SAMPLED_STYLE)
    log_axes.set(xlabel="Environment steps of a policy (million)", ylabel="SR (%)", ylim=(0, 100))
    set_panel_title(log_axes, title, "while training")

    # Curves of the exported policies.
    if success_by_budget is not None:
        budget_axes = panels[0, 1]
        budgets = success_by_budget["budgets"]
        for arm in arms:
            color = ARM_COLORS[arm]
            val_success = success_by_budget["val"][arm]
            training_success = success_by_budget["train"][arm]
            budget_axes.plot(budgets, _percent(val_success["argmax"]), color=color, **_BEST_STYLE)
            budget_axes.plot(budgets, _percent(val_success["sample"]), color=color, **_SAMPLED_STYLE)
            budget_axes.plot(budgets, _percent(training_success["argmax"]), color=color, **_TRAINING_STYLE)
        budget_axes.set(xlabel="Actions")
        set_panel_title(budget_axes, "exported policies", "success within a number of actions")

    _add_legend(figure, arms)
    return freeze_axes_positions(figure)


def _mean_curve(rows: Sequence[Mapping[str, Any]], arm: str, metric_name: str) -> tuple[list[float], list[float]]:
    """Return millions of steps, and the mean over seeds in percent; NaN, a gap, where it is undefined in all seeds."""
    # The log has a row for each seed and step; a metric may be missing in some, and undefined (null) in some.
    values_by_step: dict[int, list[float]] = {}
    for row in rows:
        if row["arm"] == arm and metric_name in row:
            seed_values = values_by_step.setdefault(row["env_steps"], [])
            if row[metric_name] is not None:
                seed_values.append(row[metric_name])

    # One point for each step, in the order of the log.
    million_steps = []
    mean_values = []
    for num_steps, seed_values in values_by_step.items():
        million_steps.append(num_steps / 1e6)
        mean_values.append(float(np.mean(seed_values)) if seed_values else float("nan"))
    return million_steps, _percent(mean_values)


def _percent(shares: Sequence[float]) -> list[float]:
    return [100.0 * share for share in shares]


def _add_legend(figure: Figure, arms: Sequence[str]) -> None:
    styles = {
        "val, best actions": _BEST_STYLE,
        "val, sampled": _SAMPLED_STYLE,
        "training scenes": _TRAINING_STYLE,
    }
    # Colors stand for arms, line styles for the episodes.
    handles = []
    for arm in arms:
        handles.append(Line2D([], [], label=arm, color=ARM_COLORS[arm], lw=3))
    for style_label, line_style in styles.items():
        handles.append(Line2D([], [], label=style_label, color=TEXT_COLOR, **line_style))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
