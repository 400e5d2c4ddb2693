"""The study's figures and document, made from its results alone."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxnav.evaluation.claims import Results, claims, pick
from jaxnav.evaluation.dial import MEASURES, verdicts
from jaxnav.evaluation.figures import (
    auc_figure,
    effects_figure,
    epsilon_figure,
    gain_figure,
    gap_figure,
    save,
    similarity_figure,
)
from jaxnav.store.files import write_atomic

READING = "<!-- reading -->"
CONTROLS = {
    "constant": "weight constant, of equal mean",
    "shuffled": "weight of another episode",
    "zeros": "zeros taken out",
    "noise": "noise taken out",
    "random": "random intervention",
}
USES = {"sTDE (eps 0.5)": (0.5, "residual"), "sTDE (eps 0, paper's form)": (0.0, "paper")}


def load(folder: Path) -> Results:
    """The parts of the study in a folder, by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def draw(folder: Path, images: Path) -> None:
    """Draw every figure of the results in a folder."""
    results = load(folder)
    images.mkdir(parents=True, exist_ok=True)
    for world in _worlds(results):
        parts = _parts(results, world)
        ends = [parts[0], parts[-1]]
        points = ({"shift": p["shift"], **p["similarity"]} for p in parts)
        save(similarity_figure({"panels": list(points)}), images / f"{world}-fig4.png")
        gains = [
            {"shift": p["shift"], "variant": name, **p["gains"][key]}
            for p in ends
            for key, name in (("layout", "+ w"), ("stde", "+ w + sTDE"))
        ]
        save(gain_figure({"panels": gains[1::2]}), images / f"{world}-fig5.png")
        save(epsilon_figure(_sweep(parts)), images / f"{world}-fig6a.png")
        course = results[f"gap-{world}"]
        save(gap_figure(_ends(course)), images / f"{world}-fig6b.png")
        save(auc_figure({"steps": course["steps"], **course["auc"][-1]}), images / f"{world}-auc.png")
        save(effects_figure(_effects(parts)), images / f"{world}-effects.png")


def _worlds(results: Results) -> list[str]:
    return [world for world in ("main", "real") if f"gap-{world}" in results]


def _parts(results: Results, world: str) -> list[dict[str, Any]]:
    return [results[f"{world}-shift{shift:g}"] for shift in results[f"gap-{world}"]["study"]["shifts"]]


def _ends(course: Mapping[str, Any]) -> dict[str, Any]:
    """Fig. 6b at the first and the last shift."""
    shifts = [line["shift"] for line in course["panels"][0]["lines"]]
    panels = [
        {**panel, "lines": [line for line in panel["lines"] if line["shift"] in (shifts[0], shifts[-1])]}
        for panel in course["panels"]
    ]
    return {"steps": course["steps"], "panels": panels}


def _sweep(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Fig. 6a, best actions."""
    wanted = {"training": "main", "gap": "novelty", "variant": "stde", "decoding": "argmax", "control": None}
    lines, epsilons = [], []
    for part in parts:
        rows = [row for row in part["rows"] if all(row[key] == value for key, value in wanted.items())]
        for form in ("residual", "paper"):
            own = sorted((row for row in rows if row["form"] == form), key=lambda row: row["epsilon"])
            epsilons = [row["epsilon"] for row in own]
            lines.append({"shift": part["shift"], "form": form, **{m: _band(own, m) for m in ("sr", "spl", "dts")}})
    return {"epsilon": epsilons, "lines": lines}


def _band(rows: Sequence[Mapping[str, Any]], metric: str) -> dict[str, Any]:
    low, high = zip(*(row[metric]["ci95"] for row in rows), strict=True)
    seeds = zip(*(row[metric]["seeds"] for row in rows), strict=True)
    return {"mean": [row[metric]["mean"] for row in rows], "low": low, "high": high, "seeds": list(map(list, seeds))}


def _effects(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Differences of SR to the layout's weights, by shift."""
    groups = []
    for part in parts:
        rows = []
        for name, row in _table(part):
            if "difference" in row and name != "+ w + TDE":
                effect = row["difference"]["sr"]
                rows.append({"name": name, "mean": effect["mean"], "ci95": effect["ci95"]})
        groups.append({"title": f"shift {part['shift']:g}", "rows": rows})
    return {"groups": groups}


def _table(part: Mapping[str, Any], decoding: str = "argmax") -> list[tuple[str, dict[str, Any]]]:
    """Table 1: names and rows."""
    rows = [
        ("baseline", {"variant": "baseline"}),
        ("+ w", {"variant": "layout"}),
        ("+ w + TDE", {"variant": "tde"}),
    ]
    for name, (epsilon, form) in USES.items():
        own = {"variant": "stde", "epsilon": epsilon, "form": form}
        rows += [(f"+ w + {name}", own), (f"+ w + {name}, `evidence`", own | {"gap": "evidence"})]
        rows += [(f"+ w + {name}, {CONTROLS['random']}", own | {"control": "random"})] if decoding == "argmax" else []
    return [(name, pick(part, decoding=decoding, **wanted)) for name, wanted in rows]


def write_document(results: Path, document: Path) -> None:
    """Write the document from the results on `val` and, where it was touched, on `test`.

    What stands between the two lines `<!-- reading -->` of the document that is there is kept: it is written by hand.
    """
    found = load(results / "val")
    study = found["gap-main"]["study"]
    kept = document.read_text(encoding="utf-8").split(READING)[1] if document.exists() else "\n\n"
    base = study["base"]
    lines = [
        "# The study: the paper's claims put to the test",
        "",
        f"{base['seeds']} seeds, {base['total_steps']:,} steps a policy, {study['episodes']:,} episodes at each shift, "
        f"split `val`; intervals are of 95 % over seeds and episodes. Made by `python eval.py study`; every number "
        f"comes from `results/`, and everything but the reading is written by that command.",
        "",
        "## Reading",
        "",
        READING + kept + READING,
        "",
    ]
    for world in _worlds(found):
        parts = _parts(found, world)
        title = "Generated rooms" if world == "main" else "AI2-THOR rooms"
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
        if world == "main":
            lines += ["### How the parts are made: settings, counterfactual branch, one factor at a time", ""]
            lines += [*_trainings(parts), ""]
        lines += ["### Does the gap track the layout?", "", *_tracking(found[f"gap-{world}"]), ""]
        lines += ["### Figures", "", *_figures(world), ""]
    test = load(results / "test")
    if test:
        lines += ["## Test, touched once", "", "Epsilon and form were chosen on `val`.", ""]
        for world in _worlds(test):
            lines += [*_rows(_parts(test, world), "argmax"), ""]
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
        rows.append((claim.text, f"{effect} {claim.unit}", claim.verdict))
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
        for name, row in _table(part, decoding):
            sr, spl, dts = (
                f"{row[m]['mean']:.{d}f} ± {row[m]['std']:.{d}f}" for m, d in (("sr", 1), ("spl", 1), ("dts", 2))
            )
            difference = _effect(row["difference"]["sr"]) if "difference" in row else ""
            rows.append((name, sr, spl, dts, difference, f"{row['mean_weight']:.3f}"))
    return _grid(("", "SR", "SPL", "DTS", "to + w", "weight"), rows)


def _controls(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    rows = []
    for use, (epsilon, form) in USES.items():
        own = {"variant": "stde", "epsilon": epsilon, "form": form}
        for gap in ("novelty", "evidence"):
            cases = {"": None} | {f", {text}": name for name, text in CONTROLS.items()}
            for text, control in cases.items():
                found = [pick(part, **own, gap=gap, control=control) for part in parts]
                rows.append((f"{use}, gap `{gap}`{text}", *(_effect(row["difference"]["sr"]) for row in found)))
        if epsilon in (0.0, 0.5):
            found = [pick(part, **own, gap="clock") for part in parts]
            rows.append((f"{use}, the released code's novelty clock", *(_effect(r["difference"]["sr"]) for r in found)))
    header = ("SR to + w", *(f"shift {part['shift']:g}" for part in parts))
    return _grid(header, rows)


def _trainings(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    names = list(dict.fromkeys(row["training"] for row in parts[0]["rows"]))
    variants = {"baseline": {"variant": "baseline"}, "+ w": {"variant": "layout"}, "TDE": {"variant": "tde"}}
    variants |= {use: {"variant": "stde", "epsilon": e, "form": form} for use, (e, form) in USES.items()}
    rows = []
    for name in names:
        for title, wanted in variants.items():
            if title == "baseline" and not any(
                r["training"] == name and r["variant"] == title for r in parts[0]["rows"]
            ):
                continue
            found = [pick(part, training=name, **wanted) for part in parts]
            cells = [f"{row['sr']['mean']:.1f} ± {row['sr']['std']:.1f}" for row in found]
            rows.append((f"`{name}` {title}", *cells))
    return _grid(("SR", *(f"shift {part['shift']:g}" for part in parts)), rows)


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
