"""Made-up results of a study: all that the claims and the document read, with numbers that are easy to tell apart."""

import json

from jaxnav.study.dial import BASELINES, MATCHED, MEASURES
from jaxnav.study.trials import USES

RUNS = ("main", "coin", "gate")
SHIFTS, EPSILONS = (0.0, 1.0), (0.0, 0.5, 1.0)
STEPS = 30
BASE = {"seeds": 3, "total_steps": 1_000_000}


def interval(mean, half=1.0):
    return {"mean": mean, "ci95": [mean - half, mean + half]}


def metric(mean):
    return interval(mean) | {"std": 0.5, "seeds": [mean - 1, mean, mean + 1]}


def row(effect, *, gap="novelty", variant="stde", decoding="argmax", control=None, **use):
    """A row of the table; `effect` is its difference in SR, None for the baseline."""
    own = {"gap": gap, "variant": variant, "decoding": decoding, "control": control}
    own |= {"epsilon": None, "form": None, "mean_weight": 0.25} | use
    own |= {"sr": metric(60.0 + (effect or 0.0)), "spl": metric(30.0), "dts": metric(1.5)}
    if effect is not None:
        own["difference"] = {"to": "baseline" if variant == "layout" else "layout", "sr": interval(effect)}
    return own


def rows(shift, run="main"):
    """Every row of a run at one shift; `main` gains nothing by sTDE at shift 0, 2 points at shift 1, 5 in full.

    `coin` has the layout's arm alone. Sampled effects are 100 more, to tell them apart.
    """
    found = [] if run == "coin" else [row(None, variant="baseline")]
    found += [row(3.0 - 2 * shift, variant="layout"), row(-6.0 + shift, variant="tde")]
    if run != "main":
        return found + [row(2.0 * shift, epsilon=epsilon, form=form) for epsilon, form in USES]
    found += [row(None, variant="baseline", decoding="sample")]
    found += [row(effect + 100.0, variant=name, decoding="sample") for name, effect in (("layout", 1.0), ("tde", -5.0))]
    for form, effect in (("residual", 2.0 * shift), ("paper", 5.0 * shift)):
        found += [row(effect, epsilon=epsilon, form=form) for epsilon in EPSILONS]
    for epsilon, form in USES:
        use = {"epsilon": epsilon, "form": form}
        found += [row(100.0, **use, decoding="sample"), row(0.5 * shift, **use, gap="clock")]
        found += [
            row(4.0 * shift + off, **use, gap="evidence", decoding=d) for d, off in (("argmax", 0), ("sample", 100))
        ]
        for gap in ("novelty", "evidence"):
            found += [row(0.25, **use, gap=gap, control=name) for name in ("constant", "shuffled", "noise", "random")]
            found.append(row(100.25, **use, gap=gap, control="zeros", decoding="sample"))
    return found


def similarity(pearson):
    own = {"category": [0, 1], "scene": [0, 1], "episodes": [4, 6], "similarity": [0.4, 0.8], "success": [0.5, 0.75]}
    return own | {"left_out": 1, "pearson": interval(pearson, 0.1), "spearman": interval(pearson, 0.2)}


def gains(slope):
    own = {"category": [0, 1], "categories": ["Book", "Chair"], "episodes": [4, 6], "similarity": [0.4, 0.8]}
    own |= {"baseline": [50.0, 70.0], "gain": [6.0, 1.0], "left_out": 1}
    return own | {"slope": interval(slope, 0.25), "pearson": interval(-0.5, 0.1)}


def part(shift, run="main"):
    found = {"shift": shift, "world": "rooms", "scenes": 80, "episodes": 1000, "rows": rows(shift, run)}
    found["parameters"] = 12_345
    if run != "main":
        return found
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


def results(worlds=("main",), runs=RUNS):
    """The parts by name."""
    about = {"study": {"shifts": list(SHIFTS), "episodes": 1000, "base": BASE}}
    found = {f"{run}-shift{shift:g}": about | part(shift, run) for run in runs for shift in SHIFTS}
    for world in worlds:
        found |= {f"{world}-shift{shift:g}": about | part(shift) for shift in SHIFTS}
        found |= {f"instrument-{world}": about | instrument(), f"gap-{world}": about | course()}
    return found


def write(folder, worlds=("main",), runs=RUNS):
    """The parts as files."""
    folder.mkdir(parents=True)
    for name, own in results(worlds, runs).items():
        (folder / f"{name}.json").write_text(json.dumps(own))
