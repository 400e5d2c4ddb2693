"""What the layout shift changes, from measures scene by scene: who stands near whom, or also the difficulty."""

from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from rich.text import Text

from jaxnav.errors import InputError

#: Difficulty is matched where it changes by at most so many percent; the baseline must lose at least so many points.
TOLERANCE, LOSS = 5.0, 8.0
RESAMPLES = 2000

#: Rows of the table: name and decimals. The first three must not depend on the dial.
MEASURES = {
    "best_length": ("Shortest path L* (actions)", 2),
    "random_sr": ("Random SR (%)", 2),
    "frontier_sr": ("Frontier search SR (%)", 1),
    "frontier_steps": ("Frontier search, actions", 1),
    "layout_gap": ("Layout gap to the prior, KL (nats)", 3),
    "layout_similarity": ("Layout similarity to the prior, cosine", 3),
    "baseline_argmax_sr": ("Baseline SR, argmax (%)", 1),
    "baseline_sample_sr": ("Baseline SR, sampled (%)", 1),
}
MATCHED, BASELINES = tuple(MEASURES)[:3], tuple(MEASURES)[-2:]


class Totals(NamedTuple):
    """What was measured in the N scenes at one shift.

    Attributes:
      values: by name of the measure, float64 [S, N]: sums over the scene's episodes by seed (S = 1 without seeds).
      weights: by name of the measure, float64 [N]: over how many they are; a mean is sum of values / sum of weights.
      rooms: [N] room types.
      names: [N] of the scenes.
    """

    values: dict[str, np.ndarray]
    weights: dict[str, np.ndarray]
    rooms: tuple[str, ...]
    names: tuple[str, ...]


def compare(shifts: list[float], totals: list[Totals], seed: int) -> dict[str, Any]:
    """The table, and what it shows of the dial, with 95 % bootstrap intervals.

    A resample draws scenes within each room type and training seeds; a drawn scene is there at all shifts, with its
    twins, and so is a drawn seed.
    """
    names = sorted({name for own in totals for name in own.names})
    rooms = {name: room for own in totals for name, room in zip(own.names, own.rooms, strict=True)}
    seeds = len(totals[0].values[BASELINES[0]])
    generator = np.random.default_rng(seed)
    scene_draws = _draws(np.array([rooms[name] for name in names]), generator)
    seed_draws = _draws(np.zeros(seeds), generator) / seeds

    def means(measure: str, own: Totals) -> np.ndarray:
        """The mean [0] and its resamples [1:]."""
        place, values = np.searchsorted(names, own.names), own.values[measure]
        scenes = np.concatenate([np.ones((1, len(place))), scene_draws[:, place]])
        drawn = np.concatenate([np.full((1, seeds), 1 / seeds), seed_draws])
        sums = scenes @ values.T
        return (sums * (drawn if len(values) > 1 else 1.0)).sum(axis=1) / (scenes @ own.weights[measure])

    every = {measure: [means(measure, own) for own in totals] for measure in MEASURES}
    table = [
        {"shift": shift, "scenes": len(own.names), "episodes": int(own.weights["frontier_sr"].sum())}
        | {measure: _summary(every[measure][i]) for measure in MEASURES}
        for i, (shift, own) in enumerate(zip(shifts, totals, strict=True))
    ]
    matched = []
    for measure in MATCHED:
        first, *others = every[measure]
        for shift, own in zip(shifts[1:], others, strict=True):
            if not first[0]:
                raise InputError(
                    f"{measure} is 0 at shift {shifts[0]:g}: nothing to compare with; give more --episodes"
                )
            change = 100.0 * (own - first) / first[0]
            holds = bool(abs(change[0]) <= TOLERANCE)
            matched.append({"measure": measure, "from": shifts[0], "to": shift, **_summary(change), "holds": holds})
    discriminating = []
    for measure in BASELINES:
        loss = _summary(every[measure][0] - every[measure][-1])
        holds = loss["mean"] >= LOSS and loss["ci95"][0] > 0
        discriminating.append({"measure": measure, "from": shifts[0], "to": shifts[-1], **loss, "holds": holds})
    return {"shifts": table, "matched": matched, "discriminating": discriminating}


def _draws(strata: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """How often each item comes up in a resample: int [RESAMPLES, N]; strata keep their sizes."""
    counts = np.zeros((RESAMPLES, len(strata)))
    for stratum in np.unique(strata):
        members = np.flatnonzero(strata == stratum)
        counts[:, members] = generator.multinomial(len(members), np.full(len(members), 1 / len(members)), RESAMPLES)
    return counts


def _summary(means: np.ndarray) -> dict[str, Any]:
    return {"mean": float(means[0]), "ci95": np.percentile(means[1:], (2.5, 97.5)).tolist()}


def console_table(report: dict[str, Any]) -> Table:
    """A column per shift, `mean [95 % interval]`."""
    table = Table("Layout shift", *(f"{own['shift']:g}" for own in report["shifts"]))
    for name in ("scenes", "episodes"):
        table.add_row(name.capitalize(), *(str(own[name]) for own in report["shifts"]))
    for measure, (title, digits) in MEASURES.items():
        cells = [_cell(own[measure], f".{digits}f") for own in report["shifts"]]
        table.add_row(*map(Text, (title, *cells)))  # Text: brackets are not markup
    return table


def verdicts(report: dict[str, Any]) -> list[str]:
    """What the table shows, line by line."""

    def line(own: dict[str, Any], what: str) -> str:
        return f"  {'yes' if own['holds'] else 'NO':3}  {MEASURES[own['measure']][0]}, {what}"

    return [
        f"Difficulty matched (within {TOLERANCE:g} % of shift {report['shifts'][0]['shift']:g})?",
        *(line(own, f"shift {own['to']:g}: {_cell(own, '+.1f')} %") for own in report["matched"]),
        f"Discriminating (at least {LOSS:g} points lost, the interval clear of 0)?",
        *(
            line(own, f"shift {own['from']:g} to {own['to']:g}: {_cell(own, '.1f')} points lost")
            for own in report["discriminating"]
        ),
    ]


def _cell(own: dict[str, Any], form: str) -> str:
    low, high = own["ci95"]
    return f"{own['mean']:{form}} [{low:{form}}, {high:{form}}]"
