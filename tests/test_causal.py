"""Tests of equations 1 and 2: interventions on pathways and (soft) total direct effects."""

from typing import NamedTuple

import chex
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from jaxnav.causal import do, removal_weight, remove_experience, remove_from_sum, stde, tde

FORMS = ("paper", "residual", "switch", "mixture")
SOFT_FORMS = FORMS[:2]
# Subnormal numbers are excluded because XLA flushes them to 0.
LOGITS = hnp.arrays(np.float32, (4, 6), elements=st.floats(-30, 30, width=32, allow_subnormal=False))
UNIT = st.floats(0, 1, width=32, allow_subnormal=False)


class Pathways(NamedTuple):
    scene: jax.Array
    goal: jax.Array
    experience: jax.Array


def as_bits(array) -> np.ndarray:
    return np.asarray(array, np.float32).view(np.uint32)


def test_do_replaces_only_the_named_pathways():
    pathways = Pathways(jnp.ones((2, 3)), jnp.ones((2, 4), jnp.bfloat16), jnp.full((2, 5), 7.0))
    result = do(pathways, scene=0, goal=0.5)
    assert isinstance(result, Pathways)
    assert result.experience is pathways.experience

    # Values are broadcast to the shape and the dtype of the pathway.
    np.testing.assert_array_equal(result.scene, np.zeros((2, 3)))
    assert result.goal.dtype == jnp.bfloat16
    np.testing.assert_array_equal(result.goal.astype(jnp.float32), np.full((2, 4), 0.5))

    # The original pathways stay unchanged.
    np.testing.assert_array_equal(pathways.scene, np.ones((2, 3)))


def test_do_refuses_an_unknown_pathway():
    with pytest.raises(ValueError, match=r"do\(sceen=.*scene, goal, experience"):
        do(Pathways(jnp.ones(1), jnp.ones(1), jnp.ones(1)), sceen=0)


def test_tde_and_stde_follow_worked_arithmetic():
    factual = jnp.array([2.0, 1.0])
    counterfactual = jnp.array([4.0, -2.0])
    effect = tde(factual, counterfactual)
    np.testing.assert_array_equal(effect, [-2.0, 3.0])

    # s = 0.75 - 0.5 = 0.25. Paper: [2 - 1, 1 + 0.5]. Residual: [2.5 - 1, 1.25 + 0.5].
    gap = jnp.float32(0.75)
    np.testing.assert_array_equal(stde(factual, counterfactual, gap, 0.5, "paper"), [1.0, 1.5])
    np.testing.assert_array_equal(stde(factual, counterfactual, gap, 0.5, "residual"), [1.5, 1.75])

    # With a weight of 1, the form `paper` is eq. 1, and the form `residual` is eq. 1 plus a.
    full_gap = jnp.float32(1)
    np.testing.assert_array_equal(stde(factual, counterfactual, full_gap, 0.0, "paper"), effect)
    np.testing.assert_array_equal(stde(factual, counterfactual, full_gap, 0.0, "residual"), factual + effect)


def test_stde_refuses_an_unknown_form():
    with pytest.raises(ValueError, match="'papr'"):
        stde(jnp.ones(2), jnp.ones(2), jnp.float32(1), 0.0, "papr")  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@given(LOGITS, LOGITS, hnp.arrays(np.float32, 4, elements=UNIT))
def test_stde_with_a_closed_gate_is_bit_identical(form, factual, counterfactual, gap):
    factual[0], counterfactual[0] = -0.0, -1.0  # -0 - 0 * (-1) would be +0
    factual[1], counterfactual[1] = 0.0, -0.0
    result = stde(jnp.asarray(factual), jnp.asarray(counterfactual), jnp.asarray(gap), 1.0, form)
    np.testing.assert_array_equal(as_bits(result), as_bits(factual))


def test_stde_with_an_open_gate_changes_logits():
    """Negative control for the test above: epsilon just below the gap is not the identity."""
    factual = jnp.ones((1, 6))
    result = stde(factual, factual, jnp.ones(1), 0.9)
    assert not np.array_equal(result, stde(factual, 2 * factual, jnp.ones(1), 0.9))


@given(LOGITS, LOGITS, hnp.arrays(np.float32, 4, elements=UNIT), UNIT)
def test_switch_form_gives_tde_or_the_factual_logits(factual, counterfactual, gap, epsilon):
    factual = jnp.asarray(factual)
    counterfactual = jnp.asarray(counterfactual)
    weight = removal_weight(gap, epsilon, "switch")
    np.testing.assert_array_equal(weight, gap > np.float32(epsilon))

    result = stde(factual, counterfactual, jnp.asarray(gap), epsilon, "switch")
    expected = np.where(weight[:, None] == 1, tde(factual, counterfactual), factual)
    np.testing.assert_array_equal(as_bits(result), as_bits(expected))


@pytest.mark.slow
@pytest.mark.parametrize("form", SOFT_FORMS)
@given(LOGITS, LOGITS, UNIT, st.floats(0, 0.9990234375, width=32, allow_subnormal=False))
def test_stde_is_continuous_in_epsilon(form, factual, counterfactual, gap, epsilon):
    # |d result / d epsilon| <= |a| + |a_bar| <= 60, so a step of 2^-10 moves a logit by at most 0.06 (and rounding).
    stde_at = jax.vmap(
        lambda epsilon_value: stde(
            jnp.asarray(factual), jnp.asarray(counterfactual), jnp.full(4, gap), epsilon_value, form
        )
    )
    low, high = stde_at(jnp.array([epsilon, epsilon + 2**-10], jnp.float32))
    assert np.abs(low - high).max() <= 60 * 2**-10 + 1e-4


@given(UNIT, UNIT)
def test_removal_weight_is_at_most_one_minus_epsilon(gap, epsilon):
    # With a = 0 and a_bar = -1 the paper's form returns the weight itself.
    weight = stde(jnp.zeros((1, 1)), -jnp.ones((1, 1)), jnp.full(1, gap), epsilon, "paper")
    np.testing.assert_allclose(weight, max(gap - epsilon, 0), atol=1e-6)
    assert 0 <= float(weight[0, 0]) <= 1 - epsilon + 1e-6
    np.testing.assert_array_equal(removal_weight(jnp.float32(gap), epsilon), weight[0, 0])


@pytest.mark.parametrize("form", FORMS)
@given(st.permutations(range(6)), st.permutations(range(6)), st.integers(-8, 8), st.integers(-8, 8))
def test_constant_offsets_do_not_change_the_choice_of_stde(
    form, factual, counterfactual, offset, counterfactual_offset
):
    # With small integers and s = 0.75 - 0.5 = 1/4 the arithmetic is exact, so ties stay ties.
    factual = jnp.array(factual, jnp.float32)
    counterfactual = jnp.array(counterfactual, jnp.float32)
    gap = jnp.float32(0.75)
    logits = stde(factual, counterfactual, gap, 0.5, form)
    offset_logits = stde(factual + offset, counterfactual + counterfactual_offset, gap, 0.5, form)
    assert logits.argmax() == offset_logits.argmax()


@given(LOGITS, LOGITS, UNIT)
def test_mixture_form_mixes_the_probabilities_of_two_decisions(factual, counterfactual, gap):
    # Probabilities of the factual decision and of the decision by the direct effect.
    factual_policy = np.exp(factual - np.logaddexp.reduce(factual, axis=-1, keepdims=True))
    direct_logits = factual - counterfactual
    direct_policy = np.exp(direct_logits - np.logaddexp.reduce(direct_logits, axis=-1, keepdims=True))

    # At epsilon 0 the weight is the gap itself.
    expected = (1 - gap) * factual_policy + gap * direct_policy
    logits = stde(jnp.asarray(factual), jnp.asarray(counterfactual), jnp.full(4, gap), 0.0, "mixture")
    np.testing.assert_allclose(jax.nn.softmax(logits), expected, atol=1e-4)


def test_stde_forms_agree_at_matching_weights():
    # (1 + s) a - s a_bar = (1 + s) (a - s / (1 + s) a_bar).
    factual, counterfactual = jax.random.normal(jax.random.key(0), (2, 50, 6))
    weights = jnp.linspace(0.01, 0.5, 50)
    residual = stde(factual, counterfactual, weights, 0.0, "residual")
    paper = stde(factual, counterfactual, weights / (1 + weights), 0.0, "paper")
    np.testing.assert_allclose(residual, (1 + weights)[:, None] * paper, rtol=1e-5, atol=1e-5)


def test_stde_traces_epsilon():
    traces = []

    @jax.jit
    def compute_logits(epsilon):
        traces.append(1)
        return stde(jnp.ones((3, 6)), jnp.ones((3, 6)), jnp.ones(3), epsilon)

    # All logits are 1, and (1 + s) - s = 1 for every epsilon.
    results = [float(compute_logits(jnp.float32(epsilon))[0, 0]) for epsilon in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(results, 1.0)
    assert len(traces) == 1


def test_stde_keeps_the_dtype_of_logits():
    factual = jnp.ones((3, 6), jnp.bfloat16)
    assert stde(factual, factual, jnp.ones(3), 0.5).dtype == jnp.bfloat16


# Scores that are a sum


def test_removal_from_a_sum_follows_worked_arithmetic():
    direct = jnp.array([2.0, -1.0])
    experience = jnp.array([4.0, 0.5])

    # s = 0.75 - 0.5 = 0.25: [2 + 0.75 x 4, -1 + 0.75 x 0.5]. The form `switch` removes all experience.
    gap = jnp.float32(0.75)
    np.testing.assert_array_equal(remove_from_sum(direct, experience, gap, 0.5), [5.0, -0.625])
    np.testing.assert_array_equal(remove_from_sum(direct, experience, gap, 0.5, "switch"), direct)

    # The mixture of beliefs e^2 e^4 and e^2 with the weights 0.75 and 0.25: 2 + log(0.75 e^4 + 0.25).
    mixture_scores = remove_from_sum(direct, experience, gap, 0.5, "mixture")
    np.testing.assert_allclose(mixture_scores, [5.71840, -0.60355], atol=1e-5)


@given(direct=LOGITS, experience=LOGITS, gap=UNIT, epsilon=UNIT)
def test_removal_from_a_sum_is_equation_2_of_the_paper(direct, experience, gap, epsilon):
    gap = jnp.full(4, gap, jnp.float32)
    for form in ("paper", "switch"):
        scores = remove_from_sum(jnp.asarray(direct), jnp.asarray(experience), gap, epsilon, form)
        expected = stde(direct + experience, jnp.asarray(experience), gap, epsilon, form)
        # Both sides round at the size of the scores, at most 60.
        np.testing.assert_allclose(scores, expected, atol=1e-5)


@given(direct=LOGITS, experience=LOGITS, gap=UNIT)
def test_removal_from_a_sum_is_complete_at_a_full_gap_and_absent_at_epsilon_one(direct, experience, gap):
    gap = jnp.full(4, gap, jnp.float32)
    for form in ("paper", "switch", "mixture"):
        # With a gap of 1 and epsilon 0 all experience is removed.
        direct_scores = remove_from_sum(jnp.asarray(direct), jnp.asarray(experience), jnp.ones(4), 0.0, form)
        np.testing.assert_array_equal(as_bits(direct_scores), as_bits(direct))

        # With epsilon 1 no experience is removed, whatever the gap.
        all_scores = remove_from_sum(jnp.asarray(direct), jnp.asarray(experience), gap, 1.0, form)
        np.testing.assert_array_equal(as_bits(all_scores), as_bits(direct + experience))


def test_removal_from_a_sum_refuses_the_residual_form():
    with pytest.raises(ValueError, match=r"residual.*paper, switch or mixture"):
        remove_from_sum(jnp.zeros(1), jnp.zeros(1), jnp.float32(0), 0.5, "residual")


@pytest.mark.parametrize("form", FORMS)
def test_removal_of_a_policy_is_exact_where_its_logits_are_a_sum(form):
    """With s = 1 the direct scores remain bit for bit; `residual` is no removal from a sum."""
    # Multiples of 2^-12 add up without rounding.
    direct, experience = jnp.round(jax.random.normal(jax.random.key(5), (2, 7, 6)) * 2**12) / 2**12
    logits = direct + experience
    gap = jnp.ones(7)

    # A policy with additive scores.
    result = remove_experience(logits, experience, gap, 0.0, form, has_additive_scores=True)
    if form == "residual":
        chex.assert_trees_all_equal(result, stde(logits, experience, gap, 0.0, form))
    else:
        chex.assert_trees_all_equal(result, direct)

    # Any other policy uses eq. 2.
    result = remove_experience(logits, experience, gap, 0.5, form)
    chex.assert_trees_all_equal(result, stde(logits, experience, gap, 0.5, form))
