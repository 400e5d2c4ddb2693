"""The study's document, made from its results alone but for the reading, which is written by hand."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic
from jaxnav.study.claims import Results, claims, pick
from jaxnav.study.dial import MEASURES, verdicts
from jaxnav.study.results import NAMED_USES, conditions, load, table_1, worlds

READING = "<!-- reading -->"
CONTROLS = {
    None: "",
    "constant": ", weight constant, of equal mean",
    "shuffled": ", weight of the next episode",
    "noise": ", noise taken out",
    "random": ", random intervention",
    "zeros": ", zeros taken out, sampled actions",
}


def check_document(document: Path) -> None:
    """Refuses to write over a document that is none of the study's, with an `InputError`."""
    if document.exists() and document.read_text(encoding="utf-8").count(READING) != 2:
        raise InputError(f"{document}: is there, without two lines {READING}; give another --document")


def write_document(results: Path, document: Path) -> None:
    """Write the document from the results on `val` and, where it was touched, on `test`.

    What stands between the two lines `<!-- reading -->` of the document that is there is kept: it is written by hand.
    """
    found = load(results / "val")
    study = found["gap-main"]["study"]
    check_document(document)
    kept = document.read_text(encoding="utf-8").split(READING)[1] if document.exists() else "\n\n"
    base = study["base"]
    lines = [
        "# The study: the paper's claims put to the test",
        "",
        f"{base['seeds']} seeds, {base['total_steps']:,} steps a policy, {study['episodes']:,} episodes at each shift, "
        "split `val`. Intervals are of 95 %, over seeds and scenes, not corrected for their number. Made by "
        "`python eval.py study`: every number comes from the results; all but the reading is written by the command.",
        "",
        "## Reading",
        "",
        READING + kept + READING,
        "",
    ]
    for world in worlds(found):
        parts = conditions(found, world)
        title = "Generated rooms" if world == "main" else "Scenes of the file"
        lines += [f"## {title}: {parts[0]['scenes']} scenes", "", "### Claims", "", *_claims(found, world), ""]
        lines += ["### Is it an instrument?", "", *_instrument(found[f"instrument-{world}"]), ""]
        lines += [
            "### Table 1",
            "",
            "SR and SPL in percent, DTS in metres; ± is over seeds. `to +w` is the difference of",
        ]
        lines += [
            "SR to the layout's weights, paired (for `+ w`: to the baseline). Weight: mean of what is taken out.",
            "",
        ]
        for decoding in ("argmax", "sample"):
            lines += [f"{'Sampled' if decoding == 'sample' else 'Best'} actions:", "", *_rows(parts, decoding), ""]
        lines += ["### Controls", "", *_controls(parts), ""]
        if world == "main" and f"goal-shift{parts[0]['shift']:g}" in found:
            goal = [found[f"goal-shift{part['shift']:g}"] for part in parts]
            lines += ["### Controls where the direct pathway sees the goal's detection alone", "", *_controls(goal), ""]
        if world == "main":
            lines += ["### How the parts are made: settings, counterfactual branch, one factor at a time", ""]
            lines += [*_trainings(found), ""]
        lines += ["### Does the gap track the layout?", "", *_tracking(found[f"gap-{world}"]), ""]
        lines += ["### Figures", "", *_figures(world), ""]
    test = load(results / "test")
    if test:
        lines += [
            "## Test, touched once",
            "",
            "Epsilon (of the residual form) was chosen on `val`, at the first shift.",
            "",
        ]
        for world in worlds(test):
            lines += [*_rows(conditions(test, world), "argmax"), ""]
    write_atomic(document, ("\n".join(lines).rstrip() + "\n").encode())


def _grid(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] + ["---:"] * (len(header) - 1), *rows)]


def _effect(effect: Mapping[str, Any], digits: int = 1) -> str:
    if effect["mean"] is None:
        return ""
    low, high = effect["ci95"]
    return f"{effect['mean']:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"


def _claims(found: Results, world: str) -> list[str]:
    rows = []
    for claim in claims(found, world):
        digits = 1 if "points" in claim.unit else 2
        effect = _effect({"mean": claim.mean, "ci95": (claim.low, claim.high)}, digits)
        rows.append((claim.text, "undefined" if math.isnan(claim.mean) else f"{effect} {claim.unit}", claim.verdict))
    return _grid(("claim", "effect", "verdict"), rows)


def _instrument(report: dict[str, Any]) -> list[str]:
    def cell(own: dict[str, Any], digits: int) -> str:
        low, high = own["ci95"]
        return f"{own['mean']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"

    rows = [
        (title, *(cell(own[name], digits) for own in report["shifts"])) for name, (title, digits) in MEASURES.items()
    ]
    header = ("shift", *(f"{own['shift']:g}" for own in report["shifts"]))
    return [*_grid(header, rows), "", "```", *verdicts(report), "```"]


def _rows(parts: Sequence[Mapping[str, Any]], decoding: str) -> list[str]:
    rows = []
    for part in parts:
        rows.append((f"**shift {part['shift']:g}**", "", "", "", "", ""))
        for name, row in table_1(part, decoding):
            sr, spl, dts = (
                f"{row[m]['mean']:.{d}f} ± {row[m]['std']:.{d}f}" for m, d in (("sr", 1), ("spl", 1), ("dts", 2))
            )
            difference = _effect(row["difference"]["sr"]) if "difference" in row else ""
            rows.append((name, sr, spl, dts, difference, f"{row['mean_weight']:.3f}"))
    return _grid(("", "SR", "SPL", "DTS", "to + w", "weight"), rows)


def _controls(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    rows = []
    for use, (epsilon, form) in NAMED_USES.items():
        own = {"variant": "stde", "epsilon": epsilon, "form": form}
        for gap in ("novelty", "evidence"):
            for control, text in CONTROLS.items():
                if control == "zeros" and form == "paper":
                    continue  # a - s 0 = a
                decoding = "sample" if control == "zeros" else "argmax"
                found = [pick(part, **own, gap=gap, control=control, decoding=decoding) for part in parts]
                rows.append((f"{use}, gap `{gap}`{text}", *map(_control, found)))
        found = [pick(part, **own, gap="clock") for part in parts]
        rows.append((f"{use}, the released code's novelty clock", *map(_control, found)))
    header = ("SR to + w (mean weight)", *(f"shift {part['shift']:g}" for part in parts))
    return _grid(header, rows)


def _control(row: Mapping[str, Any]) -> str:
    return f"{_effect(row['difference']['sr'])} ({row['mean_weight']:.2f})"


def _trainings(found: Results) -> list[str]:
    shifts = [part["shift"] for part in conditions(found, "main")]
    names = [name.removesuffix(f"-shift{shifts[0]:g}") for name in found if name.endswith(f"-shift{shifts[0]:g}")]
    variants = {"baseline": {"variant": "baseline"}, "+ w": {"variant": "layout"}, "TDE": {"variant": "tde"}}
    variants |= {use: {"variant": "stde", "epsilon": e, "form": form} for use, (e, form) in NAMED_USES.items()}
    rows, parameters = [], {}
    for name in sorted(names, key=lambda name: name != "main"):
        if name == "real":
            continue
        parts = [found[f"{name}-shift{shift:g}"] for shift in shifts]
        parameters[name] = parts[0]["parameters"]
        for title, wanted in variants.items():
            if title == "baseline" and not any(row["variant"] == "baseline" for row in parts[0]["rows"]):
                continue  # a run of the layout's arm alone
            picked = [pick(part, **wanted) for part in parts]
            rows.append((f"`{name}` {title}", *map(_with_difference, picked)))
    sizes = set(parameters.values())
    same = f"All policies have {sizes.pop():,} parameters." if len(sizes) == 1 else f"Parameters: {parameters}."
    return [*_grid(("SR (to + w; + w: to the baseline)", *(f"shift {shift:g}" for shift in shifts)), rows), "", same]


def _with_difference(row: Mapping[str, Any]) -> str:
    difference = f" ({_effect(row['difference']['sr'])})" if "difference" in row else ""
    return f"{row['sr']['mean']:.1f} ± {row['sr']['std']:.1f}{difference}"


def _tracking(course: Mapping[str, Any]) -> list[str]:
    steps = [step for step in (0, 1, 5, 10, 20, 40) if step < len(course["steps"])]
    lines = []
    for auc in course["auc"]:
        rows = [
            (
                f"`{line['setting']}`",
                *(f"{line['mean'][s]:.2f} [{line['low'][s]:.2f}, {line['high'][s]:.2f}]" for s in steps),
            )
            for line in auc["lines"]
        ]
        lines += [f"AUC of the gap, shift {auc['shift']:g} against none, by step:", ""]
        lines += [*_grid(("setting", *map(str, steps)), rows), ""]
    shares = ", ".join(f"{100 * course['running'][0][s]:.0f}" for s in steps)
    return [*lines, f"Episodes that still run at these steps, shift 0: {shares} %."]


def _figures(world: str) -> list[str]:
    captions = {
        "fig4": "Fig. 4: success of the baseline against similarity of the layout, a point per category and scene",
        "fig5": "Fig. 5: gain of + w + sTDE (epsilon 0.5) over the baseline, per category",
        "fig6a": "Fig. 6a: SR, SPL and DTS over epsilon",
        "fig6b": "Fig. 6b: mean gap per step, updated and frozen",
        "auc": "AUC of the gap per step, last shift against the first",
        "effects": "Differences of SR to the layout's weights",
    }
    return [f"![{text}](images/study/{world}-{name}.png)\n\n*{text}*\n" for name, text in captions.items()]
