"""The paper's claims as effects with intervals."""

import math
from typing import NamedTuple

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.curves import GapCourse
from jaxnav.study.design import Design
from jaxnav.study.mixture_report import Mixture
from jaxnav.study.records import SceneEffects
from jaxnav.study.results import StudyResults
from jaxnav.study.trials import NO_THRESHOLD, THRESHOLD, Trial

LAYOUT, TDE = Trial("layout"), Trial("tde")
STDE, FULL_STDE = (Trial("stde", "argmax", *use) for use in (THRESHOLD, NO_THRESHOLD))


class Claim(NamedTuple):
    """Hold one claim put to the test.

    Attributes:
      text: the claim, as an effect above 0.
      unit: of the effect.
      effect: its size.
      least: the least effect that would matter.
    """

    text: str
    unit: str
    effect: Interval
    least: float

    @property
    def verdict(self) -> str:
        """Return whether the claim holds.

        An interval below 0 refutes it; one below `least` shows that the effect is too small to matter, whatever its
        sign; one above 0 confirms it; anything else leaves it open.
        """
        if self.effect.high < 0:
            return "refuted"
        if self.effect.high < self.least:
            return "too small to matter"
        return "holds" if self.effect.low > 0 else "cannot be told"


def claims(results: StudyResults, world: str = "main") -> list[Claim]:
    """Return what is claimed of one world, best actions unless told."""
    in_world = results.worlds[world]
    first, last = in_world.conditions[0], in_world.conditions[-1]
    slope = last.gains.stde.slope
    return [
        *_effects_of_weights(results, world),
        *_effects_of_stde(results, world),
        _points("Hard TDE loses to the weights where the layout is as trained", -first.effect(TDE)),
        Claim("Success follows the layout's similarity (Fig. 4)", "r", first.similarity.pearson, 0.1),
        Claim("Gains over the baseline are larger where similarity is low (Fig. 5)", "points per -0.1", -slope, 1.0),
        *_gap_claims(in_world.course, first.shift, last.shift),
        *(claim for mixture in results.mixtures if world == "main" for claim in claims_of_experience(mixture)),
    ]


def claims_of_experience(mixture: Mixture) -> list[Claim]:
    """Return what is claimed of experience and of its removal, sampled actions."""
    if mixture.decoding != "sample":
        return []
    run, (first, *_, last) = mixture.run, mixture.shifts
    return [
        _points(f"Experience pays at shift {first:g} (`{run}`, sampled)", mixture.lead["sr"][0]),
        _points(f"Experience costs at shift {last:g} (`{run}`, sampled)", -mixture.lead["sr"][-1]),
        _points(f"Hard TDE gains at shift {last:g} (`{run}`, sampled)", mixture.removal("TDE").change["sr"][-1]),
        *(
            _points(
                f"Removal gains over the mixture: {removal.name} (`{run}`, sampled)",
                removal.mixture["sr"],
            )
            for removal in mixture.removals
            if removal.compared
        ),
    ]


def _effects_of_weights(results: StudyResults, world: str) -> list[Claim]:
    in_world = results.worlds[world]
    first, last = in_world.conditions[0], in_world.conditions[-1]
    loss = in_world.instrument.discriminating[0].change  # best actions
    return [
        _points(f"The baseline loses from shift {first.shift:g} to {last.shift:g}", loss),
        _points("The layout's weights help where the layout is as trained", first.effect(LAYOUT)),
        _points(f"The layout's weights help at shift {last.shift:g}", last.effect(LAYOUT)),
    ]


def _effects_of_stde(results: StudyResults, world: str) -> list[Claim]:
    conditions = results.worlds[world].conditions
    first, last = conditions[0], conditions[-1]
    at = f"at shift {last.shift:g}"
    goal = results.runs.get("goal", ()) if world == "main" else ()
    return [
        _points(f"sTDE (epsilon 0.5) gains on the weights {at}", last.effect(STDE)),
        _points(f"sTDE (paper's form, epsilon 0) gains on the weights {at}", last.effect(FULL_STDE)),
        *(
            _points(
                f"The same at shift {condition.shift:g} where the direct pathway sees the goal's detection alone",
                condition.effect(FULL_STDE),
            )
            for condition in (*goal[:1], *goal[-1:])
        ),
        _points(
            f"sTDE with the `evidence` gap (paper's form, epsilon 0) gains on the weights {at}",
            last.effect(FULL_STDE, "evidence"),
        ),
        _points(
            "The gain of sTDE (epsilon 0.5) grows with the shift",
            _growth(first.effects, last.effects),
        ),
    ]


def _gap_claims(course: GapCourse, first_shift: float, last_shift: float) -> list[Claim]:
    late = min(20, len(course.steps) - 1)
    updated, frozen = (course.gap("calibrated", first_shift, belief).at(late) for belief in ("updated", "frozen"))
    calibrated, evidence = (course.auc[-1].curve(setting) for setting in ("calibrated", "evidence"))
    rows = [
        (f"The gap is below 0.5 at step {late} (Fig. 6b; it was calibrated to be)", "D", 0.5 - updated),
        (f"Without updates it is above 0.5 at step {late} (Fig. 6b)", "D", frozen - 0.5),
        *(
            (
                f"Eq. 5's gap tells shift {last_shift:g} from none at step {step}",
                "AUC - 0.5",
                calibrated.at(step) - 0.5,
            )
            for step in (0, late)
        ),
        (f"The `evidence` gap does at step {late}", "AUC - 0.5", evidence.at(late) - 0.5),
    ]
    return [Claim(*row, least=0.05) for row in rows]


def _points(text: str, effect: Interval) -> Claim:
    return Claim(text, "SR points", effect, 2.0)


def _growth(first: SceneEffects | None, last: SceneEffects | None) -> Interval:
    """Return how much an effect grows, scenes and runs shared."""
    if first is None or last is None:
        return Interval(math.nan)
    design = Design.of([(each.scenes, each.rooms) for each in (first, last)], len(first.gain))
    start, end = (design.means(each.gain, each.episodes, each.scenes) for each in (first, last))
    return design.interval(end - start)
