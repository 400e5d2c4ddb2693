"""EOTP: attention by goal, previous action and memory, layout weights in the values, and the uniform ablation."""

import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import BOOK, CATEGORIES, CHAIR, FRIDGE

from jaxnav.policies.features import unpack_features
from jaxnav.policies.methods import find_method
from jaxnav.policies.methods.eotp import AttentionEntries, SpatialAttention, UniformAttention
from jaxnav.policies.network import bind, init_params
from jaxnav.policies.pathways import NO_ACTION, PolicyState
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import MOVE_AHEAD, ROTATE_LEFT

NUM_CATEGORIES = len(CATEGORIES)
HIDDEN_SIZE = tiny.SIZES.hidden
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("eotp"), method_sizes=())
PARAMS = tiny.random_params(0, SPEC)
EQUAL_WEIGHTS = jnp.ones(NUM_CATEGORIES)
MEMORY = PolicyState(jnp.sin(jnp.arange(HIDDEN_SIZE, dtype=jnp.float32)), jnp.int32(MOVE_AHEAD))
START_MEMORY = PolicyState(jnp.zeros(HIDDEN_SIZE), jnp.int32(NO_ACTION))


def bind_attention(params=PARAMS, spec=SPEC):
    return cast(SpatialAttention, bind(spec, params).method)


EOTP = bind_attention()
APPEARANCE = PARAMS["appearance"]["embedding"]


def make_view(*categories, goal=FRIDGE):
    """Features of a view that detects categories."""
    row = np.array(tiny.BANK.rows[0])
    row[: 4 * NUM_CATEGORIES] = 0
    for category in categories:
        row[4 * category : 4 * category + 4] = 200, 10 + 9 * category, 110 + 20 * category, 30
    return unpack_features(jnp.asarray(row), jnp.int32(goal), RowFormat(NUM_CATEGORIES))


def encode(view, layout_weights=EQUAL_WEIGHTS, method=EOTP) -> AttentionEntries:
    return method.encode(view, APPEARANCE, layout_weights, None)


def attention_shares(view, memory=MEMORY, method=EOTP):
    """Attention [K], which adds up to 1."""
    return np.asarray(method.attention_weights(encode(view, method=method), memory))


def params_with_parts(*parts):
    """The policy's parameters with fixed parts of goal, action and memory."""
    method_params = PARAMS["method"]
    kernel = jnp.zeros_like(method_params["parts"]["kernel"])
    fixed_parts = {"kernel": kernel, "bias": jnp.array(parts, jnp.float32)}
    return PARAMS | {"method": method_params | {"parts": fixed_parts}}


# Attention


@pytest.mark.slow
@pytest.mark.parametrize(
    ("detected", "goal", "is_attended"),
    [
        ((BOOK, CHAIR), FRIDGE, [True, True, True]),
        ((BOOK,), FRIDGE, [True, False, True]),
        ((FRIDGE,), FRIDGE, [False, False, True]),
        ((), FRIDGE, [False, False, True]),
        ((CHAIR,), CHAIR, [False, True, False]),
    ],
)
def test_attention_is_shared_by_detected_and_sought_categories(detected, goal, is_attended):
    shares = attention_shares(make_view(*detected, goal=goal))
    assert shares.sum() == pytest.approx(1.0)
    assert (shares > 0).tolist() == is_attended


def test_attended_experience_equals_numpy():
    """An independent reference in float64, with all of its parameters."""
    view = make_view(BOOK, CHAIR)
    layout_weights = np.array([0.3, 2.0, 1.0])
    params = jax.tree.map(lambda leaf: np.asarray(leaf, float), PARAMS["method"])
    appearance = np.asarray(APPEARANCE, float)
    visible = np.asarray(view.visible)[:, None]
    hidden = np.asarray(MEMORY.hidden, float)

    def normalize(vectors):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    # Keys and values of the categories, [K, W].
    inputs = np.concatenate([visible * appearance, np.asarray(view.table, float)], axis=-1)
    rows = inputs @ params["maps"]["inner"]["kernel"] + params["maps"]["inner"]["bias"]

    # Queries of goal, action and memory [3, W], and their parts [3].
    queries = np.stack(
        [
            appearance[FRIDGE] @ params["goal"]["kernel"],
            params["action"]["kernel"][MOVE_AHEAD],
            hidden @ params["memory"]["kernel"],
        ]
    )
    parts = hidden @ params["parts"]["kernel"] + params["parts"]["bias"]
    cosines = normalize(rows) @ normalize(queries).T
    scores = cosines @ parts
    shares = np.exp(scores) / np.exp(scores).sum()
    np.testing.assert_allclose(attention_shares(view), shares, rtol=1e-4)

    # The weighted values through the outer map.
    weighted_values = (layout_weights * shares)[:, None] * np.maximum(rows, 0)
    expected = np.maximum(weighted_values @ params["maps"]["outer"]["kernel"] + params["maps"]["outer"]["bias"], 0)
    experience = EOTP.attend(encode(view, jnp.asarray(layout_weights, jnp.float32)), MEMORY)
    np.testing.assert_allclose(experience, expected.reshape(-1), rtol=1e-4, atol=1e-6)
    assert np.ptp(shares) > 0.05
    assert (expected > 0).sum() > 3


#: Another goal and memory than the fridge and `MEMORY`, one change each.
CHANGED_QUERIES = {
    "goal": (BOOK, MEMORY),
    "action": (FRIDGE, MEMORY._replace(action=jnp.int32(ROTATE_LEFT))),
    "memory": (FRIDGE, MEMORY._replace(hidden=-MEMORY.hidden)),
}


@pytest.mark.parametrize(("part_index", "query_name"), list(enumerate(CHANGED_QUERIES)))
def test_each_query_changes_attention_only_by_its_part(part_index, query_name):
    """A query whose part is 4 changes the attention without the other two, and one whose part is 0 does not."""
    goal, memory = CHANGED_QUERIES[query_name]
    only_part = np.zeros(3)
    only_part[part_index] = 4.0
    other_parts = 4.0 - only_part

    def compute_shares(parts):
        """Attention for the fridge before and after the query changes; the goal's flag in the rows stays."""
        method = bind_attention(params_with_parts(*parts))
        entries = encode(make_view(BOOK, CHAIR, FRIDGE), method=method)
        changed_entries = entries._replace(goal=encode(make_view(goal=goal), method=method).goal)
        shares = np.asarray(method.attention_weights(entries, MEMORY))
        changed_shares = np.asarray(method.attention_weights(changed_entries, memory))
        return shares, changed_shares

    shares, changed_shares = compute_shares(only_part)
    assert np.abs(shares - changed_shares).max() > 0.02
    np.testing.assert_array_equal(*compute_shares(other_parts))

    # Without any part the attention is uniform.
    uniform_shares = np.full((2, NUM_CATEGORIES), 1 / NUM_CATEGORIES)
    np.testing.assert_allclose(compute_shares(np.zeros(3)), uniform_shares, rtol=1e-6)


def test_parts_are_computed_from_the_memory():
    np.testing.assert_array_equal(bind_attention(params_with_parts(1, 2, 0)).parts(MEMORY.hidden), [1, 2, 0])
    assert np.abs(EOTP.parts(MEMORY.hidden) - EOTP.parts(START_MEMORY.hidden)).max() > 0.1


def test_first_attention_of_an_episode_uses_only_the_goal():
    view = make_view(BOOK, CHAIR, FRIDGE)
    goal_part, _, _ = EOTP.parts(START_MEMORY.hidden)
    goal_only = bind_attention(params_with_parts(goal_part, 0, 0))
    shares = attention_shares(view, START_MEMORY)
    np.testing.assert_allclose(shares, attention_shares(view, START_MEMORY, goal_only), rtol=1e-5)


@pytest.mark.slow
def test_fresh_attention_depends_on_the_goal_from_the_start():
    params = init_params(SPEC, jax.random.key(0))
    method = bind_attention(params)
    memory = bind(SPEC, params).initial_memory()
    shares = attention_shares(make_view(BOOK, CHAIR, FRIDGE), memory, method)
    assert np.ptp(shares) > 0.01
    np.testing.assert_array_equal(method.parts(memory.hidden), [1, 1, 1])


# Lengths and layout weights


def test_attention_depends_only_on_the_directions_of_embeddings():
    """Embeddings three times as long get the same attention and have values three times as large."""
    maps = PARAMS["method"]["maps"]
    long_maps = maps | {"inner": jax.tree.map(lambda leaf: 3 * leaf, maps["inner"])}
    long_method = bind_attention(PARAMS | {"method": PARAMS["method"] | {"maps": long_maps}})
    view = make_view(BOOK, CHAIR)
    entries = encode(view)
    long_entries = encode(view, method=long_method)
    np.testing.assert_allclose(np.linalg.norm(entries.keys, axis=-1), np.ones(NUM_CATEGORIES), rtol=1e-5)
    np.testing.assert_allclose(entries.keys, long_entries.keys, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(attention_shares(view), attention_shares(view, method=long_method), rtol=1e-4)
    np.testing.assert_allclose(3 * entries.values, long_entries.values, rtol=1e-4)


def test_layout_weights_multiply_values_and_leave_attention():
    view = make_view(BOOK, CHAIR)
    layout_weights = jnp.array([0.0, 0.5, 2.0])
    entries = encode(view)
    weighted_entries = encode(view, layout_weights)
    np.testing.assert_array_equal(entries.keys, weighted_entries.keys)
    shares = EOTP.attention_weights(entries, MEMORY)
    np.testing.assert_array_equal(shares, EOTP.attention_weights(weighted_entries, MEMORY))
    np.testing.assert_allclose(weighted_entries.values, layout_weights[:, None] * entries.values, rtol=1e-6)

    # The experience changes in every category, also where all weights are the same factor.
    experience = EOTP.attend(entries, MEMORY)
    is_changed = np.asarray(EOTP.attend(weighted_entries, MEMORY) != experience).reshape(NUM_CATEGORIES, -1)
    assert is_changed.any(axis=-1).all()
    halved_experience = EOTP.attend(encode(view, 0.5 * EQUAL_WEIGHTS), MEMORY)
    assert np.abs(halved_experience - experience).max() > 1e-3


def test_category_of_weight_zero_has_the_same_experience_detected_or_not():
    layout_weights = jnp.array([0.0, 0.5, 2.0])

    def book_experience(view):
        return EOTP.attend(encode(view, layout_weights), MEMORY).reshape(NUM_CATEGORIES, -1)[BOOK]

    np.testing.assert_array_equal(book_experience(make_view(BOOK, CHAIR)), book_experience(make_view(CHAIR)))


# The uniform ablation

UNIFORM_SPEC = dataclasses.replace(SPEC, method=find_method("jaxnav.policies.methods.eotp:UNIFORM"))
UNIFORM = bind_attention(spec=UNIFORM_SPEC)


@pytest.mark.parametrize(
    ("detected", "goal", "memory"),
    [
        ((BOOK, FRIDGE), FRIDGE, MEMORY),
        *(((BOOK, CHAIR, FRIDGE), goal, memory) for goal, memory in CHANGED_QUERIES.values()),
    ],
)
def test_uniform_attention_ignores_every_query(detected, goal, memory):
    view = make_view(*detected, goal=goal)
    is_attended = np.asarray(view.visible + view.goal > 0)
    np.testing.assert_allclose(attention_shares(view, memory, UNIFORM), is_attended / is_attended.sum(), rtol=1e-6)


def test_uniform_attention_differs_from_eotp_only_by_attention():
    assert type(UNIFORM) is UniformAttention is UNIFORM_SPEC.method.experience
    assert jax.tree.structure(init_params(UNIFORM_SPEC, jax.random.key(0))) == jax.tree.structure(PARAMS)
    # A single category gets all attention.
    entries = encode(make_view(FRIDGE))
    np.testing.assert_array_equal(UNIFORM.attend(entries, MEMORY), EOTP.attend(entries, MEMORY))


def test_gradients_are_finite_at_the_start_of_an_episode():
    """Vectors of length 0 have no direction."""
    view = make_view(BOOK)

    @jax.jit
    @jax.grad
    def compute_gradient(params):
        method = bind_attention(params)
        entries = method.encode(view, params["appearance"]["embedding"], EQUAL_WEIGHTS, None)
        return method.attend(entries, START_MEMORY).sum()

    for params in (PARAMS, init_params(SPEC, jax.random.key(0))):
        for leaf in jax.tree.leaves(compute_gradient(params)["method"]):
            assert np.isfinite(leaf).all()
            assert np.abs(leaf).max() < 100
