"""Equations 1 and 2: interventions and (soft) total direct effects."""

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
SOFT = FORMS[:2]
LOGITS = hnp.arrays(np.float32, (4, 6), elements=st.floats(-30, 30, width=32, allow_subnormal=False))
#: Without subnormal numbers, which XLA takes for 0.
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
    np.testing.assert_array_equal(result.scene, np.zeros((2, 3)))
    assert result.goal.dtype == jnp.bfloat16
    np.testing.assert_array_equal(result.goal.astype(jnp.float32), np.full((2, 4), 0.5))
    np.testing.assert_array_equal(pathways.scene, np.ones((2, 3)))


def test_do_names_an_unknown_pathway():
    with pytest.raises(ValueError, match=r"do\(sceen=.*scene, goal, experience"):
        do(Pathways(jnp.ones(1), jnp.ones(1), jnp.ones(1)), sceen=0)


def test_tde_and_stde_follow_worked_arithmetic():
    factual, counterfactual = jnp.array([2.0, 1.0]), jnp.array([4.0, -2.0])
    np.testing.assert_array_equal(tde(factual, counterfactual), [-2.0, 3.0])
    # s = 0.75 - 0.5 = 0.25. Paper: [2 - 1, 1 + 0.5]. Residual: [2.5 - 1, 1.25 + 0.5].
    gap = jnp.float32(0.75)
    np.testing.assert_array_equal(stde(factual, counterfactual, gap, 0.5, "paper"), [1.0, 1.5])
    np.testing.assert_array_equal(stde(factual, counterfactual, gap, 0.5, "residual"), [1.5, 1.75])
    # A weight of 1 is eq. 1 in the paper's form, and eq. 1 plus a in the other.
    np.testing.assert_array_equal(
        stde(factual, counterfactual, jnp.float32(1), 0.0, "paper"), tde(factual, counterfactual)
    )
    np.testing.assert_array_equal(
        stde(factual, counterfactual, jnp.float32(1), 0.0, "residual"), factual + tde(factual, counterfactual)
    )


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
    assert not np.array_equal(stde(factual, factual, jnp.ones(1), 0.9), stde(factual, 2 * factual, jnp.ones(1), 0.9))


@given(LOGITS, LOGITS, hnp.arrays(np.float32, 4, elements=UNIT), UNIT)
def test_switch_form_gives_tde_or_the_factual_logits(factual, counterfactual, gap, epsilon):
    factual, counterfactual = jnp.asarray(factual), jnp.asarray(counterfactual)
    result, weight = (
        stde(factual, counterfactual, jnp.asarray(gap), epsilon, "switch"),
        removal_weight(gap, epsilon, "switch"),
    )
    np.testing.assert_array_equal(weight, gap > np.float32(epsilon))
    np.testing.assert_array_equal(
        as_bits(result), as_bits(np.where(weight[:, None] == 1, tde(factual, counterfactual), factual))
    )


@pytest.mark.slow
@pytest.mark.parametrize("form", SOFT)
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
    # Small integers and s = 1/4: the arithmetic is exact, so ties stay ties.
    factual, counterfactual, gap = (
        jnp.array(factual, jnp.float32),
        jnp.array(counterfactual, jnp.float32),
        jnp.float32(0.75),
    )
    plain_logits = stde(factual, counterfactual, gap, 0.5, form)
    moved_logits = stde(factual + offset, counterfactual + counterfactual_offset, gap, 0.5, form)
    assert plain_logits.argmax() == moved_logits.argmax()


@given(LOGITS, LOGITS, UNIT)
def test_mixture_form_mixes_the_probabilities_of_two_decisions(factual, counterfactual, gap):
    # At epsilon 0 the weight is the gap itself.
    factual_policy = np.exp(factual - np.logaddexp.reduce(factual, axis=-1, keepdims=True))
    direct = factual - counterfactual
    direct_policy = np.exp(direct - np.logaddexp.reduce(direct, axis=-1, keepdims=True))
    expected = (1 - gap) * factual_policy + gap * direct_policy
    result = jax.nn.softmax(stde(jnp.asarray(factual), jnp.asarray(counterfactual), jnp.full(4, gap), 0.0, "mixture"))
    np.testing.assert_allclose(result, expected, atol=1e-4)


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
    def first_logit(epsilon):
        traces.append(1)
        return stde(jnp.ones((3, 6)), jnp.ones((3, 6)), jnp.ones(3), epsilon)

    results = [float(first_logit(jnp.float32(epsilon))[0, 0]) for epsilon in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose(results, 1.0)  # (1 + s) - s
    assert len(traces) == 1


def test_stde_keeps_the_dtype_of_logits():
    factual = jnp.ones((3, 6), jnp.bfloat16)
    assert stde(factual, factual, jnp.ones(3), 0.5).dtype == jnp.bfloat16


# Scores that are a sum


def test_removal_from_a_sum_follows_worked_arithmetic():
    direct, experience = jnp.array([2.0, -1.0]), jnp.array([4.0, 0.5])
    # s = 0.75 - 0.5 = 0.25: [2 + 0.75 x 4, -1 + 0.75 x 0.5]. The switch removes all experience.
    gap = jnp.float32(0.75)
    np.testing.assert_array_equal(remove_from_sum(direct, experience, gap, 0.5), [5.0, -0.625])
    np.testing.assert_array_equal(remove_from_sum(direct, experience, gap, 0.5, "switch"), direct)

    # The mixture of beliefs e^2 e^4 and e^2 with the weights 0.75 and 0.25: 2 + log(0.75 e^4 + 0.25).
    mixed = remove_from_sum(direct, experience, gap, 0.5, "mixture")
    np.testing.assert_allclose(mixed, [5.71840, -0.60355], atol=1e-5)


@given(direct=LOGITS, experience=LOGITS, gap=UNIT, epsilon=UNIT)
def test_removal_from_a_sum_is_equation_2_of_the_paper(direct, experience, gap, epsilon):
    gap = jnp.full(4, gap, jnp.float32)
    for form in ("paper", "switch"):
        expected = stde(direct + experience, jnp.asarray(experience), gap, epsilon, form)
        # Both sides round at the size of the scores, at most 60.
        np.testing.assert_allclose(
            remove_from_sum(jnp.asarray(direct), jnp.asarray(experience), gap, epsilon, form), expected, atol=1e-5
        )


@given(direct=LOGITS, experience=LOGITS, gap=UNIT)
def test_complete_removal_from_a_sum_leaves_the_direct_scores_and_epsilon_one_leaves_all(direct, experience, gap):
    gap = jnp.full(4, gap, jnp.float32)
    for form in ("paper", "switch", "mixture"):
        without_experience = remove_from_sum(jnp.asarray(direct), jnp.asarray(experience), jnp.ones(4), 0.0, form)
        np.testing.assert_array_equal(as_bits(without_experience), as_bits(direct))
        complete = remove_from_sum(jnp.asarray(direct), jnp.asarray(experience), gap, 1.0, form)
        np.testing.assert_array_equal(as_bits(complete), as_bits(direct + experience))


def test_removal_from_a_sum_refuses_the_residual_form():
    with pytest.raises(ValueError, match=r"residual.*paper, switch or mixture"):
        remove_from_sum(jnp.zeros(1), jnp.zeros(1), jnp.float32(0), 0.5, "residual")


@pytest.mark.parametrize("form", FORMS)
def test_removal_of_a_policy_is_exact_where_its_logits_are_a_sum(form):
    """With s = 1 the direct scores remain bit for bit; `residual` is no removal from a sum."""
    direct, experience = jax.random.normal(jax.random.key(5), (2, 7, 6))
    direct, experience = (jnp.round(scores * 2**12) / 2**12 for scores in (direct, experience))  # sums without rounding
    gap = jnp.ones(7)
    logits = direct + experience
    removed = remove_experience(logits, experience, gap, 0.0, form, has_additive_scores=True)
    if form == "residual":
        chex.assert_trees_all_equal(removed, stde(logits, experience, gap, 0.0, form))
    else:
        chex.assert_trees_all_equal(removed, direct)
    of_other_policy = remove_experience(logits, experience, gap, 0.5, form)
    chex.assert_trees_all_equal(of_other_policy, stde(logits, experience, gap, 0.5, form))
