"""The paper's claims as effects with intervals, and whether they hold: from the study's results alone."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

#: Results by the name of their part, see `jaxnav.cli.study`.
Results = Mapping[str, dict[str, Any]]


class Claim(NamedTuple):
    """One claim put to the test.

    Attributes:
      text: the claim, as an effect above 0.
      unit: of the effect.
      mean, low, high: the effect and its 95 % interval.
      least: the least effect that would matter.
    """

    text: str
    unit: str
    mean: float
    low: float
    high: float
    least: float

    @property
    def verdict(self) -> str:
        """`holds` if the interval lies above 0; if not, `does not hold` if it lies below what would matter."""
        if self.low > 0:
            return "holds" if self.high >= self.least else "holds, but is small"
        return "does not hold" if self.high < self.least else "cannot be told here"


def select(part: Mapping[str, Any], **wanted: Any) -> list[dict[str, Any]]:
    """The rows of a part's table with these entries; best actions, no control, the run's own gap unless named."""
    wanted = {"gap": "novelty", "decoding": "argmax", "control": None, **wanted}
    return [row for row in part["rows"] if all(row[key] == value for key, value in wanted.items())]


def pick(part: Mapping[str, Any], **wanted: Any) -> dict[str, Any]:
    """The first of `select`."""
    return next(iter(select(part, **wanted)))


def claims(results: Results, world: str = "main") -> list[Claim]:
    """What the paper claims of one world, `main` or `real`, best actions."""
    parts = [results[f"{world}-shift{shift:g}"] for shift in _shifts(results)]
    first, last = parts[0], parts[-1]
    at = f"at shift {last['shift']:g}"
    paper = {"variant": "stde", "epsilon": 0.5, "form": "residual"}
    full = {"variant": "stde", "epsilon": 0.0, "form": "paper"}
    mismatch = full | {"gap": "evidence"}

    def gain(name: str, part: Mapping[str, Any], **wanted: Any) -> Claim:
        return _claim(name, "SR points", pick(part, **wanted)["difference"]["sr"], least=2.0)

    loss = results[f"instrument-{world}"]["discriminating"][0]  # best actions
    course = results[f"gap-{world}"]
    late = min(20, len(course["steps"]) - 1)
    lines = {line["setting"]: line for line in course["auc"][-1]["lines"]}
    own = next(panel for panel in course["panels"] if panel["setting"] == "calibrated")["lines"]
    updated, frozen = (
        next(line for line in own if line["shift"] == first["shift"] and line["belief"] == belief)
        for belief in ("updated", "frozen")
    )
    hard = pick(first, variant="tde")["difference"]["sr"]
    rows = [
        _claim(f"The baseline loses from shift {first['shift']:g} to {last['shift']:g}", "SR points", loss, least=2.0),
        gain("The layout's weights help where the layout is as trained", first, variant="layout"),
        gain(f"The layout's weights help {at}", last, variant="layout"),
        gain(f"sTDE (epsilon 0.5) gains on the weights {at}", last, **paper),
        gain(f"sTDE (paper's form, epsilon 0) gains on the weights {at}", last, **full),
        gain(f"sTDE with the `evidence` gap (paper's form, epsilon 0) gains on the weights {at}", last, **mismatch),
        _difference("The gain of sTDE (epsilon 0.5) grows with the shift", *(_gain(p, paper) for p in (last, first))),
        _claim("Hard TDE loses to the weights where the layout is as trained", "SR points", _negated(hard), least=2.0),
        _claim("Success follows the layout's similarity (Fig. 4)", "r", first["similarity"]["pearson"], least=0.1),
        _claim(
            "Gains over the baseline are larger where similarity is low (Fig. 5)",
            "points per -0.1",
            _negated(last["gains"]["stde"]["slope"]),
            least=1.0,
        ),
        _line(
            f"The gap is below 0.5 at step {late} (Fig. 6b; it was calibrated to be)",
            updated,
            late,
            lambda gap: 0.5 - gap,
        ),
        _line(f"Without updates it is above 0.5 at step {late} (Fig. 6b)", frozen, late, lambda gap: gap - 0.5),
    ]
    for part in (results.get(f"goal-shift{part['shift']:g}") for part in (last, first) if world == "main"):
        if part:
            what = f"The same at shift {part['shift']:g} where the direct pathway sees the goal's detection alone"
            rows.insert(5, gain(what, part, **full))
    rows += [
        _line(f"Eq. 5's gap tells shift {last['shift']:g} from none at step {step}", lines["calibrated"], step, _above)
        for step in (0, late)
    ]
    return [*rows, _line(f"The `evidence` gap does at step {late}", lines["evidence"], late, _above)]


def _shifts(results: Results) -> list[float]:
    return next(iter(results.values()))["study"]["shifts"]


def _gain(part: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    return pick(part, **wanted)["difference"]["sr"]


def _claim(text: str, unit: str, effect: Mapping[str, Any], least: float) -> Claim:
    if effect["mean"] is None:  # what is compared does not vary
        return Claim(text, unit, math.nan, math.nan, math.nan, least)
    return Claim(text, unit, effect["mean"], effect["ci95"][0], effect["ci95"][1], least)


def _negated(effect: Mapping[str, Any]) -> Mapping[str, Any]:
    low, high = effect["ci95"]
    return effect if effect["mean"] is None else {"mean": -effect["mean"], "ci95": [-high, -low]}


def _difference(text: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> Claim:
    """a - b, their intervals taken for those of independent normal variables, which they are only nearly."""
    half = math.hypot(*((effect["ci95"][1] - effect["ci95"][0]) / 2 for effect in (a, b)))
    mean = a["mean"] - b["mean"]
    return Claim(text, "SR points", mean, mean - half, mean + half, 2.0)


def _above(auc: float) -> float:
    return auc - 0.5


def _line(text: str, line: Mapping[str, Sequence[float]], step: int, effect: Callable[[float], float]) -> Claim:
    low, high = sorted(effect(line[name][step]) for name in ("low", "high"))
    return Claim(text, "AUC - 0.5" if effect is _above else "D", effect(line["mean"][step]), low, high, 0.05)
