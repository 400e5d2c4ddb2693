"""Claims: their effects, signs and verdicts."""

import dataclasses
import math

import numpy as np
import pytest
from support import study_results
from support.intervals import around, bounds

from jaxnav.evaluation.statistics import Interval
from jaxnav.study.claims import Claim, study_claims
from jaxnav.study.records import FullCondition
from jaxnav.study.results import StudyResults


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.5, 3.0, "holds"),
        (2.5, 3.0, "holds"),
        (0.5, 1.5, "too small to matter"),  # whatever its sign
        (-1.0, 1.5, "too small to matter"),
        (-4.0, -1.0, "refuted"),
        (-4.0, 0.0, "too small to matter"),  # 0 is within the interval
        (-1.0, 2.5, "cannot be told"),
        (0.0, 2.5, "cannot be told"),
        (-1.0, 2.0, "cannot be told"),  # what would matter is within the interval, too
        (math.nan, math.nan, "cannot be told"),
    ],
)
def test_verdicts(low, high, verdict):
    assert Claim("", "SR points", Interval((low + high) / 2, low, high), min_effect=2.0).verdict == verdict


@pytest.fixture(scope="module")
def by_text():
    return {claim.text: claim for claim in study_claims(study_results.results())}


def claim_about(by_text, text) -> Claim:
    """Return the claim that contains a text."""
    (claim,) = [claim for name, claim in by_text.items() if text in name]
    return claim


@pytest.mark.parametrize(
    ("text", "mean", "half", "verdict"),
    [
        # The instrument: 9 points, best actions.
        ("The baseline loses from shift 0 to 1", 9.0, 1.0, "holds"),
        ("The layout's weights help where the layout is as trained", 3.0, 1.0, "holds"),
        # 1 +- 1 reaches 0, and 2.
        ("The layout's weights help at shift 1", 1.0, 1.0, "cannot be told"),
        ("sTDE (epsilon 0.5) gains on the weights at shift 1", 2.0, 1.0, "holds"),
        ("sTDE (paper's form, epsilon 0) gains on the weights at shift 1", 5.0, 1.0, "holds"),
        ("sTDE with the `evidence` gap (paper's form, epsilon 0) gains", 4.0, 1.0, "holds"),
        # By 1, 2, 2 and 3 points in four scenes, in all runs: variance (1 + 0 + 0 + 1) / 3 of one, / 4 of the mean.
        ("The gain of sTDE (epsilon 0.5) grows with the shift", 2.0, around(0, 1 / 6, 3)[2], "holds"),
        # The effect is -6: losing is what is claimed.
        ("Hard TDE loses to the weights", 6.0, 1.0, "holds"),
        ("Success follows the layout's similarity", 0.3, 0.1, "holds"),
        # -2.5 points per 0.1 more similarity.
        ("Gains over the baseline are larger where similarity is low", 2.5, 0.25, "holds"),
        # 0.2 at step 20 is 0.3 below 0.5; frozen, 0.8 is 0.3 above.
        ("The gap is below 0.5 at step 20", 0.3, 0.01, "holds"),
        ("Without updates it is above 0.5 at step 20", 0.3, 0.01, "holds"),
        # AUC 0.5 is chance; 0.75 is 0.25 above.
        ("Eq. 5's gap tells shift 1 from none at step 0", 0.0, 0.01, "too small to matter"),
        ("Eq. 5's gap tells shift 1 from none at step 20", 0.0, 0.01, "too small to matter"),
        ("The `evidence` gap does at step 20", 0.25, 0.01, "holds"),
    ],
)
def test_effects_and_signs(by_text, text, mean, half, verdict):
    claim = claim_about(by_text, text)
    assert bounds(claim.effect) == pytest.approx((mean, mean - half, mean + half))
    assert claim.verdict == verdict


def test_every_claim_is_an_interval_around_its_mean(by_text):
    assert len(by_text) == 15
    for claim in by_text.values():
        assert claim.effect.low <= claim.effect.mean <= claim.effect.high
        assert claim.min_effect > 0


def test_the_run_with_the_goal_alone_adds_two_claims_after_those_of_stde():
    texts = [claim.text for claim in study_claims(study_results.results(runs=(*study_results.RUNS, "goal")))]
    without = [claim.text for claim in study_claims(study_results.results())]
    added = [
        f"The same at shift {shift} where the direct pathway sees the goal's detection alone" for shift in ("0", "1")
    ]
    assert texts == without[:5] + added + without[5:]


def test_the_real_rooms_have_other_claims():
    results = study_results.results(("main", "real"))
    real_rooms = dataclasses.replace(results.worlds["real"], instrument=study_results.instrument(loss=-3.0))
    results = dataclasses.replace(results, worlds={**results.worlds, "real": real_rooms})
    (main, *rest), (real, *others) = (study_claims(results, world) for world in ("main", "real"))
    assert (main.effect.mean, real.effect.mean) == (9.0, -3.0)
    assert (main.verdict, real.verdict) == ("holds", "refuted")
    assert str(rest) == str(others)  # NaN is no NaN


def world_with(first: FullCondition, last: FullCondition) -> StudyResults:
    world = dataclasses.replace(study_results.world_results(), conditions=(first, last))
    return dataclasses.replace(study_results.results(), worlds={"main": world})


def test_what_is_undefined_has_no_verdict():
    undefined = Interval(math.nan)
    first, last = study_results.world_results().conditions
    first = dataclasses.replace(first, similarity=dataclasses.replace(first.similarity, pearson=undefined))
    stde = dataclasses.replace(last.gains.stde, slope=undefined)
    last = dataclasses.replace(last, gains=dataclasses.replace(last.gains, stde=stde))
    by_text = {claim.text: claim for claim in study_claims(world_with(first, last))}
    for text in ("Success follows", "Gains over the baseline"):
        claim = claim_about(by_text, text)
        assert not claim.effect.has_bounds
        assert claim.verdict == "cannot be told"


@pytest.mark.parametrize("without", [[0], [1], [0, 1]])
def test_growth_needs_the_effects_at_both_shifts(without):
    first, last = (
        dataclasses.replace(condition, effects=None) if i in without else condition
        for i, condition in enumerate(study_results.world_results().conditions)
    )
    by_text = {claim.text: claim for claim in study_claims(world_with(first, last))}
    growth = claim_about(by_text, "grows with the shift")
    assert math.isnan(growth.effect.mean)
    assert growth.verdict == "cannot be told"
    # All others are as they were.
    whole = {claim.text: claim for claim in study_claims(study_results.results())}
    assert {text for text, claim in by_text.items() if str(claim) != str(whole[text])} == {growth.text}


def test_growth_is_that_of_each_scene_and_run():
    # Scene by scene and run by run it is the effect at shift 1 that counts, less that at shift 0: with the same effects
    # at both there is none, however they differ between scenes and runs.
    gain = np.array([[5.0, -10, 20, 40], [0, 15, -25, 30], [50, 20, 0, -5]])
    conditions = [
        dataclasses.replace(condition, effects=dataclasses.replace(study_results.effects(1.0), gain=gain + more))
        for condition, more in zip(study_results.world_results().conditions, (0.0, 10.0), strict=True)
    ]
    by_text = {claim.text: claim for claim in study_claims(world_with(*conditions))}
    effect = claim_about(by_text, "grows with the shift").effect
    # Sums over five episodes are 10 points more.
    assert bounds(effect) == pytest.approx((2.0, 2.0, 2.0))


def test_a_short_course_is_read_at_its_last_step():
    world = study_results.world_results()
    course = dataclasses.replace(world.gap_curves, steps=world.gap_curves.steps[:11])
    results = dataclasses.replace(
        study_results.results(), worlds={"main": dataclasses.replace(world, gap_curves=course)}
    )
    by_text = {claim.text: claim for claim in study_claims(results)}
    # Half way from 0.9 to 0.2.
    assert claim_about(by_text, "The gap is below 0.5 at step 10").effect.mean == pytest.approx(0.5 - 0.55)
    assert "The `evidence` gap does at step 10" in by_text
