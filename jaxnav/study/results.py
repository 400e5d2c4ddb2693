"""The study's results, its Table 1 and its figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxnav.study.claims import Results, pick, select
from jaxnav.study.figures import (
    auc_figure,
    effects_figure,
    epsilon_figure,
    gain_figure,
    gap_figure,
    save,
    similarity_figure,
)
from jaxnav.study.trials import USES

NAMED_USES = dict(zip(("sTDE (eps 0.5)", "sTDE (eps 0, paper's form)"), USES, strict=True))


def load(folder: Path) -> Results:
    """The parts of the study in a folder, by name; those of another study, left behind there, are not read."""
    parts = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}
    own = parts["gap-main"]["study"] if parts else None
    return {name: part for name, part in parts.items() if part["study"] == own}


def draw(folder: Path, images: Path) -> None:
    """Draw every figure of the results in a folder."""
    results = load(folder)
    images.mkdir(parents=True, exist_ok=True)
    for world in worlds(results):
        parts = conditions(results, world)
        ends = [parts[0], parts[-1]]
        points = ({"shift": p["shift"], **p["similarity"]} for p in parts)
        save(similarity_figure({"panels": list(points)}), images / f"{world}-fig4.png")
        gains = [{"shift": p["shift"], "variant": "+ w + sTDE", **p["gains"]["stde"]} for p in ends]
        save(gain_figure({"panels": gains}), images / f"{world}-fig5.png")
        save(epsilon_figure(_sweep(parts)), images / f"{world}-fig6a.png")
        course = results[f"gap-{world}"]
        save(gap_figure(_ends(course)), images / f"{world}-fig6b.png")
        save(auc_figure({"steps": course["steps"], **course["auc"][-1]}), images / f"{world}-auc.png")
        save(effects_figure(_effects(parts)), images / f"{world}-effects.png")


def worlds(results: Results) -> list[str]:
    """`main`, and `real` where it was studied."""
    return [world for world in ("main", "real") if f"gap-{world}" in results]


def conditions(results: Results, world: str) -> list[dict[str, Any]]:
    """The parts of a world in the order of their shifts."""
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
    lines, epsilons = [], []
    for part in parts:
        for form in ("residual", "paper"):
            own = sorted(select(part, variant="stde", form=form), key=lambda row: row["epsilon"])
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
        for name, row in table_1(part):
            if row["variant"] == "stde" and row["control"] is None:
                effect = row["difference"]["sr"]
                rows.append({"name": name.replace("`", ""), "mean": effect["mean"], "ci95": effect["ci95"]})
        groups.append({"title": f"shift {part['shift']:g}", "rows": rows})
    return {"groups": groups}


def table_1(part: Mapping[str, Any], decoding: str = "argmax") -> list[tuple[str, dict[str, Any]]]:
    """Table 1: names and rows."""
    rows = [
        ("baseline", {"variant": "baseline"}),
        ("+ w", {"variant": "layout"}),
        ("+ w + TDE", {"variant": "tde"}),
    ]
    for name, (epsilon, form) in NAMED_USES.items():
        own = {"variant": "stde", "epsilon": epsilon, "form": form}
        rows += [(f"+ w + {name}", own), (f"+ w + {name}, `evidence`", own | {"gap": "evidence"})]
        rows += [(f"+ w + {name}, random intervention", own | {"control": "random"})] if decoding == "argmax" else []
    if "chosen" in part and decoding == "argmax":
        own = {"variant": "stde", "epsilon": part["chosen"], "form": "residual"}
        rows.append((f"+ w + sTDE (eps {part['chosen']:g}, chosen)", own))
    return [(name, pick(part, decoding=decoding, **wanted)) for name, wanted in rows]
