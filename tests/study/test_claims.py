"""Claims: their effects, signs and verdicts."""

import dataclasses

import pytest
from support import study_results

from jaxnav.study.claims import Claim, claims
from jaxnav.study.intervals import UNDEFINED, Interval


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (0.5, 3.0, "holds"),
        (0.5, 1.5, "holds, but is small"),  # less than would matter
        (-1.0, 1.5, "does not hold"),  # whatever there is is less than would matter
        (-4.0, -1.0, "does not hold"),
        (-1.0, 2.5, "cannot be told here"),
        (0.0, 2.5, "cannot be told here"),  # 0 is within the interval
        (-1.0, 2.0, "cannot be told here"),  # what would matter is, too
    ],
)
def test_verdicts(low, high, verdict):
    assert Claim("", "SR points", Interval((low + high) / 2, low, high), least=2.0).verdict == verdict


@pytest.fixture(scope="module")
def by_text():
    return {claim.text: claim for claim in claims(study_results.results())}


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
        ("The layout's weights help at shift 1", 1.0, 1.0, "cannot be told here"),
        ("sTDE (epsilon 0.5) gains on the weights at shift 1", 2.0, 1.0, "holds"),
        ("sTDE (paper's form, epsilon 0) gains on the weights at shift 1", 5.0, 1.0, "holds"),
        ("sTDE with the `evidence` gap (paper's form, epsilon 0) gains", 4.0, 1.0, "holds"),
        # 2 at shift 1 less 0 at shift 0; halves add in squares.
        ("The gain of sTDE (epsilon 0.5) grows with the shift", 2.0, 2**0.5, "holds"),
        # The effect is -6: losing is what is claimed.
        ("Hard TDE loses to the weights", 6.0, 1.0, "holds"),
        ("Success follows the layout's similarity", 0.3, 0.1, "holds"),
        # -2.5 points per 0.1 more similarity.
        ("Gains over the baseline are larger where similarity is low", 2.5, 0.25, "holds"),
        # 0.2 at step 20 is 0.3 below 0.5; frozen, 0.8 is 0.3 above.
        ("The gap is below 0.5 at step 20", 0.3, 0.01, "holds"),
        ("Without updates it is above 0.5 at step 20", 0.3, 0.01, "holds"),
        # AUC 0.5 is chance; 0.75 is 0.25 above.
        ("Eq. 5's gap tells shift 1 from none at step 0", 0.0, 0.01, "does not hold"),
        ("Eq. 5's gap tells shift 1 from none at step 20", 0.0, 0.01, "does not hold"),
        ("The `evidence` gap does at step 20", 0.25, 0.01, "holds"),
    ],
)
def test_effects_and_signs(by_text, text, mean, half, verdict):
    claim = claim_about(by_text, text)
    assert dataclasses.astuple(claim.effect)[:3] == pytest.approx((mean, mean - half, mean + half))
    assert claim.verdict == verdict


def test_every_claim_is_an_interval_around_its_mean(by_text):
    assert len(by_text) == 15
    for claim in by_text.values():
        assert claim.effect.low <= claim.effect.mean <= claim.effect.high
        assert claim.least > 0


def test_the_run_with_the_goal_alone_adds_two_claims_after_those_of_stde():
    texts = [claim.text for claim in claims(study_results.results(runs=(*study_results.RUNS, "goal")))]
    without = [claim.text for claim in claims(study_results.results())]
    added = [
        f"The same at shift {shift} where the direct pathway sees the goal's detection alone" for shift in ("0", "1")
    ]
    assert texts == without[:5] + added + without[5:]


def test_the_real_rooms_have_other_claims():
    results = study_results.results(("main", "real"))
    real_rooms = dataclasses.replace(results.worlds["real"], instrument=study_results.instrument(loss=-3.0))
    results = dataclasses.replace(results, worlds={**results.worlds, "real": real_rooms})
    (main, *rest), (real, *others) = (claims(results, world) for world in ("main", "real"))
    assert (main.effect.mean, real.effect.mean) == (9.0, -3.0)
    assert (main.verdict, real.verdict) == ("holds", "does not hold")
    assert rest == others


def test_what_is_undefined_has_no_verdict():
    world = study_results.world_results()
    first, last = world.conditions
    first = dataclasses.replace(first, similarity=dataclasses.replace(first.similarity, pearson=UNDEFINED))
    stde = dataclasses.replace(last.gains.stde, slope=UNDEFINED)
    last = dataclasses.replace(last, gains=dataclasses.replace(last.gains, stde=stde))
    world = dataclasses.replace(world, conditions=(first, last))
    results = dataclasses.replace(study_results.results(), worlds={"main": world})
    by_text = {claim.text: claim for claim in claims(results)}
    for text in ("Success follows", "Gains over the baseline"):
        claim = claim_about(by_text, text)
        assert not claim.effect.defined
        assert claim.verdict == "cannot be told here"


def test_a_short_course_is_read_at_its_last_step():
    world = study_results.world_results()
    course = dataclasses.replace(world.course, steps=world.course.steps[:11])
    results = dataclasses.replace(study_results.results(), worlds={"main": dataclasses.replace(world, course=course)})
    by_text = {claim.text: claim for claim in claims(results)}
    # Half way from 0.9 to 0.2.
    assert claim_about(by_text, "The gap is below 0.5 at step 10").effect.mean == pytest.approx(0.5 - 0.55)
    assert "The `evidence` gap does at step 10" in by_text
