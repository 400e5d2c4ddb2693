"""The learning curves of a run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnav.viz.figure import fix_placement, grid, set_title
from jaxnav.viz.plan import INK

#: Colour of an arm's lines.
_ARMS = {"baseline": "#D55E00", "layout": "#0072B2"}
_LINE: dict[str, Any] = {"lw": 1.4, "ms": 3.5}
_BEST: dict[str, Any] = _LINE | {"ls": "-", "marker": "o"}
_SAMPLED: dict[str, Any] = _LINE | {"ls": "--", "marker": "s"}
_TRAINING: dict[str, Any] = _LINE | {"ls": ":"}


def learning_figure(rows: Sequence[Mapping[str, Any]], reach: Mapping[str, Any] | None, title: str) -> Figure:
    """Draw success while training, and within numbers of actions.

    Left, the mean over seeds against environment steps: of training episodes, and of val episodes with best and with
    sampled actions. Right, of the exported policies: in val scenes, and with best actions in training scenes.

    Args:
      rows: the training log.
      reach: success within budgets, see `Validator.reach`; None leaves the right panel out.
      title: of the figure.
    """
    figure, panels = grid(1, 1 if reach is None else 2, height=3.2, sharey=True)
    arms = [arm for arm in _ARMS if any(row["arm"] == arm for row in rows)]
    for arm in arms:
        color = {"color": _ARMS[arm]}
        panels[0, 0].plot(*_curve(rows, arm, "success"), **color, **_TRAINING)
        panels[0, 0].plot(*_curve(rows, arm, "val_success"), **color, **_BEST)
        panels[0, 0].plot(*_curve(rows, arm, "val_success_sampled"), **color, **_SAMPLED)
        if reach is not None:
            panels[0, 1].plot(reach["budgets"], _percent(reach["val"][arm]["argmax"]), **color, **_BEST)
            panels[0, 1].plot(reach["budgets"], _percent(reach["val"][arm]["sample"]), **color, **_SAMPLED)
            panels[0, 1].plot(reach["budgets"], _percent(reach["train"][arm]["argmax"]), **color, **_TRAINING)
    panels[0, 0].set(xlabel="Environment steps of a policy (million)", ylabel="SR (%)", ylim=(0, 100))
    set_title(panels[0, 0], title, "while training")
    if reach is not None:
        panels[0, 1].set(xlabel="Actions")
        set_title(panels[0, 1], "exported policies", "success within a number of actions")
    _legend(figure, arms)
    return fix_placement(figure)


def _curve(rows: Sequence[Mapping[str, Any]], arm: str, name: str) -> tuple[list[float], list[float]]:
    """Return millions of steps, and the mean over seeds in percent."""
    values: dict[int, list[float]] = {}
    for row in rows:
        if row["arm"] == arm and row.get(name) is not None:
            values.setdefault(row["env_steps"], []).append(row[name])
    return [steps / 1e6 for steps in values], _percent([float(np.mean(each)) for each in values.values()])


def _percent(shares: Sequence[float]) -> list[float]:
    return [100.0 * share for share in shares]


def _legend(figure: Figure, arms: Sequence[str]) -> None:
    styles: dict[str, dict[str, Any]] = {
        "val, best actions": _BEST,
        "val, sampled": _SAMPLED,
        "training scenes": _TRAINING,
    }
    keys = [Line2D([], [], label=arm, color=_ARMS[arm], lw=3) for arm in arms]
    keys += [Line2D([], [], label=name, color=INK, **style) for name, style in styles.items()]
    figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), fontsize=8, frameon=False)
