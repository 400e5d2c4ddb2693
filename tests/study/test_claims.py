"""The claims: what is taken from the results, with which sign, and when a claim holds."""

import math

import pytest
from support import study_results as made_up

from jaxnav.study.claims import Claim, claims, pick


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
    assert Claim("", "SR points", (low + high) / 2, low, high, least=2.0).verdict == verdict


# The row of a claim


def test_a_row_is_picked_by_all_that_is_named_and_else_is_the_main_one():
    part = made_up.part(1.0)
    found = pick(part, variant="stde", epsilon=0.0, form="paper")
    assert found["difference"]["sr"]["mean"] == 5.0  # best actions: 100 more when sampled
    assert [found[name] for name in ("gap", "decoding", "control")] == ["novelty", "argmax", None]
    assert pick(part, variant="stde", epsilon=0.0, form="paper", gap="evidence")["difference"]["sr"]["mean"] == 4.0
    assert pick(part, variant="layout", decoding="sample")["difference"]["sr"]["mean"] == 101.0
    control = pick(part, variant="stde", epsilon=0.0, form="paper", control="noise")
    assert control["control"] == "noise"
    with pytest.raises(StopIteration):
        pick(made_up.part(1.0, "coin"), variant="baseline")


# Effects


@pytest.fixture(scope="module")
def found():
    return {claim.text: claim for claim in claims(made_up.results())}


def effect(found, text):
    """Mean, low, high of the claim that contains a text."""
    (claim,) = [claim for name, claim in found.items() if text in name]
    return (claim.mean, claim.low, claim.high), claim.verdict


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
def test_effects_and_signs(found, text, mean, half, verdict):
    assert effect(found, text) == (pytest.approx((mean, mean - half, mean + half)), verdict)


def test_every_claim_is_an_interval_around_its_mean(found):
    assert len(found) == 15
    for claim in found.values():
        assert claim.low <= claim.mean <= claim.high
        assert claim.least > 0


def test_the_real_rooms_have_claims_of_their_own():
    results = made_up.results(("main", "real"))
    results["instrument-real"] = results["instrument-real"] | {"discriminating": [made_up.interval(-3.0)]}
    (main, *rest), (real, *others) = (claims(results, world) for world in ("main", "real"))
    assert (main.mean, real.mean) == (9.0, -3.0)
    assert (main.verdict, real.verdict) == ("holds", "does not hold")
    assert rest == others


def test_what_is_undefined_is_told_by_no_verdict_of_its_own():
    results = made_up.results()
    undefined = {"mean": None, "ci95": [None, None]}
    results["main-shift0"]["similarity"]["pearson"] = undefined
    results["main-shift1"]["gains"]["stde"]["slope"] = undefined
    found = {claim.text: claim for claim in claims(results)}
    for text in ("Success follows", "Gains over the baseline"):
        (mean, low, high), verdict = effect(found, text)
        assert all(map(math.isnan, (mean, low, high)))
        assert verdict == "cannot be told here"


def test_a_short_course_is_read_at_its_last_step():
    results = made_up.results()
    course = results["gap-main"]
    course["steps"] = course["steps"][:11]
    found = {claim.text: claim for claim in claims(results)}
    # Half way from 0.9 to 0.2.
    assert effect(found, "The gap is below 0.5 at step 10")[0][0] == pytest.approx(0.5 - 0.55)
    assert "The `evidence` gap does at step 10" in found
