"""Markdown tables of removal in a mixed population."""

from collections.abc import Sequence

from jaxnav.study.mixture_report import Mixture
from jaxnav.study.tables import markdown

#: Controls by what is taken from a removal's result.
CONTROLS = {"shuffled": "the gap of another episode", "course": "the mean gap of all episodes at the time"}


def mixture_sections(mixtures: Sequence[Mixture]) -> list[str]:
    """Return what experience is worth, and what removals do.

    Args:
      mixtures: of one world, with the same agents without experience.
    """
    first = mixtures[0]
    lines = [
        "### What experience is worth",
        "",
        "Half of the episodes are in scenes as trained, half in shifted ones; nobody is told which. Value (or cost) is "
        "the lead over agents that cannot know any layout, in percentage points.",
        "",
        *accounting_table(mixtures),
        "",
    ]
    for mixture in mixtures:
        how = "best" if mixture.decoding == "argmax" else "sampled"
        heir = "" if mixture.heir is None else f", which hands over to `{mixture.heir}`"
        lines += [f"### Removal from `{mixture.run}`{heir}, {how} actions", ""]
        lines += ["Change against the same policies without removal:", "", *removal_table(mixture), ""]
        lines += ["What the gap knows, over the mixture:", "", *controls_table(mixture), ""]
        lines += ["The order of time:", "", *order_table(mixture), ""]
    lengths = ", ".join(f"{length:.0f}" for length in first.length)
    return [*lines, f"Half of the episodes of `{first.run}` last longer than {lengths} steps.", ""]


def accounting_table(mixtures: Sequence[Mixture]) -> list[str]:
    """Return what experience is worth to each run, and what it costs.

    Args:
      mixtures: of one world, with the same agents without experience.
    """
    first = mixtures[0]
    columns = [(i, name) for i in range(len(first.shifts)) for name in first.agent]
    header = ("", *(f"{_title(name)}, shift {first.shifts[i]:g}" for i, name in columns))
    rows = []
    for mixture in mixtures:
        how = "best actions" if mixture.decoding == "argmax" else "sampled"
        for name, values, style in (
            (f"without experience, {how}", mixture.without, ".1f"),
            (f"`{mixture.run}`, {how}", mixture.agent, ".1f"),
            ("its value (or cost)", mixture.lead, "+.1f"),
        ):
            rows.append((name, *(f"{values[metric][i]:{style}}" for i, metric in columns)))
    return markdown(header, dict.fromkeys(rows))


def removal_table(mixture: Mixture) -> list[str]:
    """Return what every removal changes, at each shift and over the mixture."""
    names = (tuple(mixture.agent)[-1], "sr", "spl")
    columns = [(i, name) for i in range(len(mixture.shifts)) for name in names]
    header = (
        "",
        "weight",
        *(f"{_title(name)}, shift {mixture.shifts[i]:g}" for i, name in columns),
        *(f"{_title(name)}, mixture" for name in names),
        *(f"value kept, {_title(name)} (%)" for name in names[:2]),
        *(f"cost recovered, {_title(name)} (%)" for name in names[:2]),
    )
    rows = [
        (
            removal.name,
            _weights(removal.weight),
            *(f"{removal.change[name][i]:+.1f}" for i, name in columns),
            *(f"{removal.mixture[name]:+.1f}" for name in names),
            *(f"{removal.left[name][0]:.0f}" for name in names[:2]),
            *(f"{100.0 - removal.left[name][-1]:.0f}" for name in names[:2]),
        )
        for removal in mixture.removals
    ]
    return markdown(header, rows)


def controls_table(mixture: Mixture) -> list[str]:
    """Return what each gap gains over its controls, over the mixture."""
    names = (tuple(mixture.agent)[-1], "spl", "sr")
    rows = [
        (
            f"{removal.name} ({_weights(removal.weight)})",
            f"{CONTROLS.get(control, f'`{control}`, the best clock')} ({_weights(compared.weight)})",
            *(f"{compared.gained[name]:+.1f}" for name in names),
        )
        for removal in mixture.removals
        for control, compared in (removal.compared or {}).items()
    ]
    return markdown(("gap (weights)", "less that of (weights)", *map(_title, names)), rows)


def order_table(mixture: Mixture) -> list[str]:
    """Return what is gained where experience leaves early or late."""
    rows = [
        (each.name, *(f"{each.change[name][i]:+.1f}" for i in range(len(mixture.shifts)) for name in mixture.agent))
        for each in mixture.removals
        if each.name.startswith(("until", "after", "novelty", "overdue"))
    ]
    header = ("", *(f"{_title(name)}, shift {shift:g}" for shift in mixture.shifts for name in mixture.agent))
    return markdown(header, rows)


def _weights(weight: tuple[float, ...]) -> str:
    return ", ".join(f"{each:.2f}" for each in weight)


def _title(metric: str) -> str:
    name, _, budget = metric.partition("@")
    return f"{name.upper()} within {budget}" if budget else name.upper()
