"""Markdown tables of the study."""

import math
from collections.abc import Iterable, Mapping, Sequence

from jaxnav.evaluation.report import Decoding
from jaxnav.evaluation.statistics import Interval
from jaxnav.runs.policies import Gap
from jaxnav.study.claims import claims
from jaxnav.study.curves import GapCourse
from jaxnav.study.instrument_report import InstrumentReport, table_cells, verdicts
from jaxnav.study.records import Condition, TrialRow
from jaxnav.study.results import StudyResults
from jaxnav.study.trials import USES, Control, Trial

CONTROLS: Mapping[Control | None, str] = {
    None: "",
    "constant": ", weight constant, of equal mean",
    "shuffled": ", weight of the next episode",
    "noise": ", noise taken out",
    "random": ", random intervention",
    "zeros": ", zeros taken out, sampled actions",
}
#: Gaps of Table 1 and of the controls.
GAPS: Mapping[Gap, str] = {"novelty": "", "evidence": ", `evidence`"}
#: Steps of the table of the gap's AUC.
STEPS = (0, 1, 5, 10, 20, 40, 80)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table, numbers to the right."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] + ["---:"] * (len(header) - 1), *rows)]


def claims_table(results: StudyResults, world: str) -> list[str]:
    """Return each claim with its effect and verdict."""
    rows = []
    for claim in claims(results, world):
        digits = 1 if "points" in claim.unit else 2
        effect = f"{claim.effect:+.{digits}f}"
        rows.append((claim.text, effect, f"{claim.least:g} {claim.unit}", claim.verdict))
    return markdown(("claim", "effect", "least", "verdict"), rows)


def instrument_table(report: InstrumentReport) -> list[str]:
    """Return what is measured at each shift, and the verdicts."""
    header = ("shift", *(f"{column.shift:g}" for column in report.shifts))
    return [*markdown(header, table_cells(report)), "", "```", *verdicts(report), "```"]


def table_1(condition: Condition, decoding: Decoding = "argmax") -> list[tuple[str, TrialRow]]:
    """Return names and rows of Table 1 at one shift."""
    rows = [
        ("baseline", condition.row(Trial("baseline", decoding))),
        ("+ w", condition.row(Trial("layout", decoding))),
        ("+ w + TDE", condition.row(Trial("tde", decoding))),
    ]
    for name, use in USES.items():
        trial = Trial("stde", decoding, *use)
        rows += [(f"+ w + {name}{text}", condition.row(trial, gap)) for gap, text in GAPS.items()]
        if decoding == "argmax":
            random = condition.row(Trial("stde", decoding, *use, "random"))
            rows.append((f"+ w + {name}, random intervention", random))
    if condition.chosen is not None and decoding == "argmax":
        trial = Trial("stde", decoding, condition.chosen, "residual")
        rows.append((f"+ w + sTDE (eps {condition.chosen:g}, chosen)", condition.row(trial)))
    return rows


def metrics_table(conditions: Sequence[Condition], decoding: Decoding) -> list[str]:
    """Return Table 1 at all shifts."""
    rows = []
    for condition in conditions:
        rows.append((f"**shift {condition.shift:g}**", "", "", "", "", ""))
        for name, row in table_1(condition, decoding):
            metrics = _spread(row.sr), _spread(row.spl), _spread(row.dts, 2)
            difference = f"{row.difference.sr:+.1f}" if row.difference else ""
            rows.append((name, *metrics, difference, f"{row.mean_weight:.3f}"))
    return markdown(("", "SR", "SPL", "DTS", "to + w", "weight"), rows)


def controls_table(conditions: Sequence[Condition]) -> list[str]:
    """Return the effects of sTDE and of its controls."""

    def cells(trial: Trial, gap: Gap) -> list[str]:
        return [f"{each.effect(trial, gap):+.1f} ({each.row(trial, gap).mean_weight:.2f})" for each in conditions]

    rows = []
    for name, use in USES.items():
        for gap in GAPS:
            for control, text in CONTROLS.items():
                if control == "zeros" and use.form == "paper":
                    continue  # a - s 0 = a
                trial = Trial("stde", "sample" if control == "zeros" else "argmax", *use, control)
                rows.append((f"{name}, gap `{gap}`{text}", *cells(trial, gap)))
        clock = cells(Trial("stde", "argmax", *use), "clock")
        rows.append((f"{name}, the released code's novelty clock", *clock))
    return markdown(("SR to + w (mean weight)", *(f"shift {each.shift:g}" for each in conditions)), rows)


def runs_table(results: StudyResults) -> list[str]:
    """Return the effects in all runs on generated rooms."""
    trials = {"baseline": Trial("baseline"), "+ w": Trial("layout"), "TDE": Trial("tde")}
    trials |= {name: Trial("stde", "argmax", *use) for name, use in USES.items()}
    rows, parameters = [], {}
    for run, conditions in results.runs.items():
        if run == "real":
            continue
        parameters[run] = conditions[0].parameters
        for title, trial in trials.items():
            if title == "baseline" and not conditions[0].has(trial):
                continue  # a run of the layout arm alone
            rows.append((f"`{run}` {title}", *(_with_difference(each.row(trial)) for each in conditions)))
    sizes = set(parameters.values())
    same = f"All policies have {sizes.pop():,} parameters." if len(sizes) == 1 else f"Parameters: {parameters}."
    header = ("SR (to + w; + w: to the baseline)", *(f"shift {shift:g}" for shift in results.shifts))
    return [*markdown(header, rows), "", same]


def gap_tables(course: GapCourse) -> list[str]:
    """Return the AUC of the gap at some steps."""
    steps = [step for step in STEPS if step < len(course.steps)]
    lines = []
    for panel in course.auc:
        rows = [(f"`{line.setting}`", *(f"{line.curve.at(step):.2f}" for step in steps)) for line in panel.lines]
        lines += [f"AUC of the gap, shift {panel.shift:g} against none, by step:", ""]
        lines += [*markdown(("setting", *map(str, steps)), rows), ""]
    shares = ", ".join(f"{100 * course.running[0, step]:.0f}" for step in steps)
    return [*lines, f"Episodes that still run at these steps, shift 0: {shares} %."]


def _spread(metric: Interval, digits: int = 1) -> str:
    """Return mean and, of several seeds, their standard deviation."""
    mean = f"{metric.mean:.{digits}f}"
    return mean if math.isnan(metric.std) else f"{mean} ± {metric.std:.{digits}f}"


def _with_difference(row: TrialRow) -> str:
    return _spread(row.sr) + (f" ({row.difference.sr:+.1f})" if row.difference else "")
