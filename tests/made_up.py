"""Made-up results of a study: all that the claims and the document read, with numbers that are easy to tell apart."""

import json

from jaxnav.evaluation.dial import BASELINES, MATCHED, MEASURES
from jaxnav.evaluation.trials import CONTROLS

SHIFTS, EPSILONS = (0.0, 1.0), (0.0, 0.5, 1.0)
STEPS = 30
BASE = {"seeds": 3, "total_steps": 1_000_000}


def interval(mean, half=1.0):
    return {"mean": mean, "ci95": [mean - half, mean + half]}


def metric(mean):
    return interval(mean) | {"std": 0.5, "seeds": [mean - 1, mean, mean + 1]}


def row(effect, *, training="main", gap="novelty", variant="stde", decoding="argmax", control=None, **use):
    """A row of the table; `effect` is its difference in SR, None for the baseline."""
    own = {"training": training, "gap": gap, "variant": variant, "decoding": decoding, "control": control}
    own |= {"epsilon": None, "form": None, "mean_weight": 0.25} | use
    own |= {"sr": metric(60.0 + (effect or 0.0)), "spl": metric(30.0), "dts": metric(1.5)}
    if effect is not None:
        own["difference"] = {"to": "baseline" if variant == "layout" else "layout", "sr": interval(effect)}
    return own


def rows(shift):
    """Every row of one shift. At shift 0 sTDE gains nothing; at shift 1 it gains 2 points, 3 of its effects differ."""
    uses = [{"epsilon": epsilon, "form": form} for form in ("residual", "paper") for epsilon in EPSILONS]
    references = [{"epsilon": 0.5, "form": "residual"}, {"epsilon": 0.0, "form": "paper"}]
    found = []
    for decoding in ("argmax", "sample"):
        off = 0.0 if decoding == "argmax" else 100.0  # to tell them apart

        def add(effect, decoding=decoding, off=off, **own):
            found.append(row(None if effect is None else effect + off, decoding=decoding, **own))

        for training in ("main", "coin", "goal"):
            if training != "coin":
                add(None, training=training, variant="baseline")
            add(3.0 - 2 * shift, training=training, variant="layout")
            add(-6.0 + shift, training=training, variant="tde")
            for use in uses:
                add((5.0 if use["form"] == "paper" else 2.0) * shift, training=training, **use)
        for use in uses:
            add(4.0 * shift, gap="evidence", **use)
            add(0.5 * shift, gap="clock", **use)
        for gap in ("novelty", "evidence"):
            for use in references:
                for control in CONTROLS:
                    add(0.25, gap=gap, control=control, **use)
    return found


def similarity(pearson):
    own = {"category": [0, 1], "scene": [0, 1], "episodes": [4, 6], "similarity": [0.4, 0.8], "success": [0.5, 0.75]}
    return own | {"left_out": 1, "pearson": interval(pearson, 0.1), "spearman": interval(pearson, 0.2)}


def gains(slope):
    own = {"category": [0, 1], "categories": ["Book", "Chair"], "episodes": [4, 6], "similarity": [0.4, 0.8]}
    own |= {"baseline": [50.0, 70.0], "gain": [6.0, 1.0], "left_out": 1}
    return own | {"slope": interval(slope, 0.25), "pearson": interval(-0.5, 0.1)}


def part(shift):
    found = {"shift": shift, "world": "rooms", "scenes": 80, "episodes": 1000, "rows": rows(shift)}
    own = {name: gains(-1.5 - shift) for name in ("layout", "stde")}
    return found | {"similarity": similarity(0.3 - 0.2 * shift), "gains": own}


def line(start, end, half=0.01):
    """A straight line from step 0 to step 20, and on."""
    mean = [start + (end - start) * step / 20 for step in range(STEPS)]
    return {"mean": mean, "low": [x - half for x in mean], "high": [x + half for x in mean]}


def course():
    """The gap falls from 0.9 to 0.2 at step 20, to 0.8 if frozen; `evidence` tells the shift, eq. 5 does not."""
    settings = ("paper", "released", "calibrated", "evidence")
    panels = [
        {
            "setting": setting,
            "lines": [
                {"shift": shift, "belief": belief, **line(0.9 - 0.1 * shift, end)}
                for shift in SHIFTS
                for belief, end in (("updated", 0.2), ("frozen", 0.8))
            ],
        }
        for setting in settings
    ]
    tells = {name: line(0.5, 0.75 if name == "evidence" else 0.5) for name in settings}
    auc = [{"shift": shift, "lines": [{"setting": n, **own} for n, own in tells.items()]} for shift in SHIFTS[1:]]
    running = [[1.0 - step / STEPS for step in range(STEPS)] for _ in SHIFTS]
    return {"steps": list(range(STEPS)), "running": running, "panels": panels, "auc": auc}


def instrument():
    """The baseline loses 9 points with its best actions and 12 with sampled ones."""
    table = [{"shift": shift} | {name: interval(10.0 + shift, 0.5) for name in MEASURES} for shift in SHIFTS]
    ends = {"from": SHIFTS[0], "to": SHIFTS[-1], "holds": True}
    matched = [{"measure": name, **ends, **interval(0.5, 0.25)} for name in MATCHED]
    losses = [{"measure": name, **ends, **interval(loss)} for name, loss in zip(BASELINES, (9.0, 12.0), strict=True)]
    return {"shifts": table, "matched": matched, "discriminating": losses}


def results(worlds=("main",)):
    """The parts by name."""
    about = {"study": {"shifts": list(SHIFTS), "episodes": 1000, "base": BASE}}
    found = {}
    for world in worlds:
        found |= {f"{world}-shift{shift:g}": about | part(shift) for shift in SHIFTS}
        found |= {f"instrument-{world}": about | instrument(), f"gap-{world}": about | course()}
    return found


def write(folder, worlds=("main",)):
    """The parts as files."""
    folder.mkdir(parents=True)
    for name, own in results(worlds).items():
        (folder / f"{name}.json").write_text(json.dumps(own))
