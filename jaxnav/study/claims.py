"""The paper's claims as effects with intervals and verdicts.

`study_claims` lists the claims about one world of a study, `experience_claims` those about the value of experience in a
mixed population. An effect above 0 supports its claim.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from jaxnav.evaluation.statistics import Interval, SharedDesign
from jaxnav.study.records import (
    PAPER_THRESHOLD,
    ZERO_THRESHOLD,
    Condition,
    FullCondition,
    GapCurves,
    MixtureReport,
    SceneEffects,
    Trial,
)
from jaxnav.study.results import StudyResults, WorldResults

LAYOUT_TRIAL = Trial("layout")
TDE_TRIAL = Trial("tde")
THRESHOLD_TRIAL = Trial("stde", "argmax", *PAPER_THRESHOLD)
ZERO_THRESHOLD_TRIAL = Trial("stde", "argmax", *ZERO_THRESHOLD)
#: Step at which the gap is compared; the last step of shorter curves.
LATE_STEP = 20


class Claim(NamedTuple):
    """One claim that is tested.

    Attributes:
      text: the claim, as an effect above 0.
      unit: of the effect.
      effect: size of the effect.
      min_effect: the least effect that would matter.
    """

    text: str
    unit: str
    effect: Interval
    min_effect: float

    @property
    def verdict(self) -> str:
        """Verdict on the claim.

        An interval below 0 refutes the claim; one below `min_effect` shows that the effect is too small to matter,
        whatever its sign; one above 0 confirms the claim; all others leave it open.
        """
        if self.effect.high < 0:
            return "refuted"
        if self.effect.high < self.min_effect:
            return "too small to matter"
        return "holds" if self.effect.low > 0 else "cannot be told"


def study_claims(results: StudyResults, world: str = "main") -> list[Claim]:
    """List the claims about one world, with best actions unless stated otherwise."""
    world_results = results.worlds[world]
    first_condition = world_results.conditions[0]
    last_condition = world_results.conditions[-1]
    # Other training runs and mixtures exist for generated rooms only.
    goal_conditions = results.runs.get("goal", ()) if world == "main" else ()
    mixtures = results.mixtures if world == "main" else ()

    claims = [
        *_weight_claims(world_results),
        *_stde_claims(first_condition, last_condition, goal_conditions),
        sr_claim(
            "Hard TDE loses to the weights where the layout is as trained", -first_condition.sr_difference(TDE_TRIAL)
        ),
        Claim("Success follows the layout's similarity (Fig. 4)", "r", first_condition.similarity.pearson, 0.1),
        Claim(
            "Gains over the baseline are larger where similarity is low (Fig. 5)",
            "points per -0.1",
            -last_condition.gains.stde.slope,
            1.0,
        ),
        *_gap_claims(world_results.gap_curves, first_condition.shift, last_condition.shift),
    ]
    for mixture in mixtures:
        claims += experience_claims(mixture)
    return claims


def experience_claims(mixture: MixtureReport) -> list[Claim]:
    """List the claims about experience and its removal; none unless actions are sampled."""
    if mixture.decoding != "sample":
        return []
    run = mixture.run
    first_shift, *_, last_shift = mixture.shifts

    # Experience has a value at the first shift and a cost at the last, where full removal should help.
    claims = [
        sr_claim(f"Experience pays at shift {first_shift:g} (`{run}`, sampled)", mixture.lead["sr"][0]),
        sr_claim(f"Experience costs at shift {last_shift:g} (`{run}`, sampled)", -mixture.lead["sr"][-1]),
        sr_claim(f"Hard TDE gains at shift {last_shift:g} (`{run}`, sampled)", mixture.removal("TDE").change["sr"][-1]),
    ]

    # Removals that are compared with controls; the population does not know which episodes are shifted.
    for removal in mixture.removals:
        if removal.compared:
            text = f"Removal gains over the mixture: {removal.name} (`{run}`, sampled)"
            claims.append(sr_claim(text, removal.mixture["sr"]))
    return claims


def sr_claim(text: str, effect: Interval) -> Claim:
    """Make a claim about an effect on SR, of which 2 points would matter."""
    return Claim(text, "SR points", effect, 2.0)


def _weight_claims(world_results: WorldResults) -> list[Claim]:
    """Claims about the loss by the shift, and about the layout's weights."""
    first_condition = world_results.conditions[0]
    last_condition = world_results.conditions[-1]
    shift = f"{last_condition.shift:g}"
    baseline_loss = world_results.instrument.discriminating[0].change  # best actions

    return [
        sr_claim(f"The baseline loses from shift {first_condition.shift:g} to {shift}", baseline_loss),
        sr_claim(
            "The layout's weights help where the layout is as trained", first_condition.sr_difference(LAYOUT_TRIAL)
        ),
        sr_claim(f"The layout's weights help at shift {shift}", last_condition.sr_difference(LAYOUT_TRIAL)),
    ]


def _stde_claims(first: FullCondition, last: FullCondition, goal_conditions: Sequence[Condition]) -> list[Claim]:
    """Claims about sTDE at the last shift.

    Args:
      first, last: full conditions at the first and the last shift.
      goal_conditions: conditions of the run `goal`, if there is one.
    """
    shift = f"at shift {last.shift:g}"
    claims = [
        sr_claim(f"sTDE (epsilon 0.5) gains on the weights {shift}", last.sr_difference(THRESHOLD_TRIAL)),
        sr_claim(
            f"sTDE (paper's form, epsilon 0) gains on the weights {shift}", last.sr_difference(ZERO_THRESHOLD_TRIAL)
        ),
    ]

    # The run whose direct pathway sees the goal alone, at both ends of the shift.
    for condition in (*goal_conditions[:1], *goal_conditions[-1:]):
        text = f"The same at shift {condition.shift:g} where the direct pathway sees the goal's detection alone"
        claims.append(sr_claim(text, condition.sr_difference(ZERO_THRESHOLD_TRIAL)))

    # Another gap, and the growth of the effect with the shift.
    claims.append(
        sr_claim(
            f"sTDE with the `evidence` gap (paper's form, epsilon 0) gains on the weights {shift}",
            last.sr_difference(ZERO_THRESHOLD_TRIAL, "evidence"),
        )
    )
    growth = _effect_growth(first.effects, last.effects)
    claims.append(sr_claim("The gain of sTDE (epsilon 0.5) grows with the shift", growth))
    return claims


def _gap_claims(gap_curves: GapCurves, first_shift: float, last_shift: float) -> list[Claim]:
    """Claims about the layout gap: its level, and the AUC by which it detects the shift."""
    late_step = min(LATE_STEP, len(gap_curves.steps) - 1)
    updated_gap = gap_curves.mean_gap("calibrated", first_shift, "updated").interval_at(late_step)
    frozen_gap = gap_curves.mean_gap("calibrated", first_shift, "frozen").interval_at(late_step)
    calibrated_auc = gap_curves.auc[-1].setting_curve("calibrated")
    evidence_auc = gap_curves.auc[-1].setting_curve("evidence")

    # Level of the gap without a shift (Fig. 6b).
    effects = [
        (f"The gap is below 0.5 at step {late_step} (Fig. 6b; it was calibrated to be)", "D", 0.5 - updated_gap),
        (f"Without updates it is above 0.5 at step {late_step} (Fig. 6b)", "D", frozen_gap - 0.5),
    ]

    # Detection of the shift at the first and at a late step.
    for step in (0, late_step):
        text = f"Eq. 5's gap tells shift {last_shift:g} from none at step {step}"
        effects.append((text, "AUC - 0.5", calibrated_auc.interval_at(step) - 0.5))
    evidence_effect = evidence_auc.interval_at(late_step) - 0.5
    effects.append((f"The `evidence` gap does at step {late_step}", "AUC - 0.5", evidence_effect))
    return [Claim(text, unit, effect, min_effect=0.05) for text, unit, effect in effects]


def _effect_growth(first: SceneEffects | None, last: SceneEffects | None) -> Interval:
    """Growth of an effect between two shifts, whose scenes and runs are shared; NaN if one is unknown."""
    if first is None or last is None:
        return Interval(math.nan)
    conditions = [(effects.scenes, effects.rooms) for effects in (first, last)]
    # Both effects share scenes and runs, so the jackknife leaves out a scene or run of both at once.
    design = SharedDesign.from_conditions(conditions, len(first.gain))
    first_means = design.jackknife_means(first.gain, first.episodes, first.scenes)
    last_means = design.jackknife_means(last.gain, last.episodes, last.scenes)
    return design.interval(last_means - first_means)
