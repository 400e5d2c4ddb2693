"""Attention by goal, previous action and memory, and where the layout's weights enter."""

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

K, HIDDEN = len(CATEGORIES), tiny.SIZES.hidden
SPEC = dataclasses.replace(tiny.SPEC, method=find_method("eotp"), method_sizes=())
WEIGHTS = tiny.random_params(0, SPEC)
ONES = jnp.ones(K)
MEMORY = PolicyState(jnp.sin(jnp.arange(HIDDEN, dtype=jnp.float32)), jnp.int32(MOVE_AHEAD))


def module(weights=WEIGHTS, spec=SPEC):
    return cast(SpatialAttention, bind(spec, weights).method)


EOTP = module()
APPEARANCE = WEIGHTS["appearance"]["embedding"]


def seen(*categories, goal=FRIDGE):
    """Features of a view that detects categories."""
    row = np.array(tiny.BANK.rows[0])
    row[: 4 * K] = 0
    for category in categories:
        row[4 * category : 4 * category + 4] = 200, 10 + 9 * category, 110 + 20 * category, 30
    return unpack_features(jnp.asarray(row), jnp.int32(goal), RowFormat(K))


def encoded(view, weights=ONES, method=EOTP) -> AttentionEntries:
    return method.encode(view, APPEARANCE, weights, None)


def attention(view, memory=MEMORY, method=EOTP):
    return np.asarray(method.attention_weights(encoded(view, method=method), memory))


def with_parts(*parts):
    """The policy's parameters, the parts of goal, action and memory fixed."""
    method = WEIGHTS["method"]
    kernel = jnp.zeros_like(method["parts"]["kernel"])
    return WEIGHTS | {"method": method | {"parts": {"kernel": kernel, "bias": jnp.array(parts, jnp.float32)}}}


# Attention


def test_attention_is_over_what_is_detected_or_sought_and_adds_up_to_1():
    for view, shown in (
        (seen(BOOK, CHAIR), [1, 1, 1]),
        (seen(BOOK), [1, 0, 1]),
        (seen(FRIDGE), [0, 0, 1]),
        (seen(), [0, 0, 1]),
        (seen(CHAIR, goal=CHAIR), [0, 1, 0]),
    ):
        share = attention(view)
        assert share.sum() == pytest.approx(1.0)
        assert ((share > 0) == np.array(shown, bool)).all()


def test_the_experience_is_that_of_numpy():
    """An independent reference in float64, with all of its parameters."""
    view, layout = seen(BOOK, CHAIR), np.array([0.3, 2.0, 1.0])
    p = jax.tree.map(lambda leaf: np.asarray(leaf, float), WEIGHTS["method"])

    def unit(vector):
        return vector / np.linalg.norm(vector)

    visible, hidden = np.asarray(view.visible)[:, None], np.asarray(MEMORY.hidden, float)
    inputs = np.concatenate([visible * np.asarray(APPEARANCE, float), np.asarray(view.table, float)], axis=-1)
    rows = inputs @ p["maps"]["inner"]["kernel"] + p["maps"]["inner"]["bias"]
    asking = [
        unit(np.asarray(APPEARANCE, float)[FRIDGE] @ p["goal"]["kernel"]),
        unit(p["action"]["kernel"][MOVE_AHEAD]),
        unit(hidden @ p["memory"]["kernel"]),
    ]
    parts = hidden @ p["parts"]["kernel"] + p["parts"]["bias"]
    score = [sum(part * unit(row) @ query for part, query in zip(parts, asking, strict=True)) for row in rows]
    share = np.exp(score) / np.exp(score).sum()
    np.testing.assert_allclose(attention(view), share, rtol=1e-4)
    read = (layout * share)[:, None] * np.maximum(rows, 0)
    expected = np.maximum(read @ p["maps"]["outer"]["kernel"] + p["maps"]["outer"]["bias"], 0)
    result = EOTP.attend(encoded(view, jnp.asarray(layout, jnp.float32)), MEMORY)
    np.testing.assert_allclose(result, expected.reshape(-1), rtol=1e-4, atol=1e-6)
    assert np.ptp(share) > 0.05
    assert (expected > 0).sum() > 3


#: What each of the three asks for, beside `MEMORY` and the fridge: the goal, and the memory.
OTHER = {
    "goal": (BOOK, MEMORY),
    "action": (FRIDGE, MEMORY._replace(action=jnp.int32(ROTATE_LEFT))),
    "memory": (FRIDGE, MEMORY._replace(hidden=-MEMORY.hidden)),
}


@pytest.mark.parametrize(("part", "name"), list(enumerate(OTHER)))
def test_attention_moves_with_goal_action_and_memory(part, name):
    """By each alone where its part is 4, and not where it is 0."""
    alone, without = np.zeros(3), np.full(3, 4.0)
    alone[part], without[part] = 4.0, 0.0
    goal, memory = OTHER[name]

    def both(parts):
        """The attention for the fridge, and as something else asks; the goal's flag in the rows stays."""
        method = module(with_parts(*parts))
        rows = encoded(seen(BOOK, CHAIR, FRIDGE), method=method)
        asked = rows._replace(goal=encoded(seen(goal=goal), method=method).goal)
        return np.asarray(method.attention_weights(rows, MEMORY)), np.asarray(method.attention_weights(asked, memory))

    one, other = both(alone)
    assert np.abs(one - other).max() > 0.02
    np.testing.assert_array_equal(*both(without))
    np.testing.assert_allclose(both(np.zeros(3)), np.full((2, K), 1 / K), rtol=1e-6)


def test_the_memory_says_in_which_parts():
    view = seen(BOOK, CHAIR, FRIDGE)
    method = module(with_parts(1, 2, 0)).parts
    np.testing.assert_array_equal(method(MEMORY.hidden), [1, 2, 0])
    quiet = EOTP.parts(jnp.zeros(HIDDEN))
    assert np.abs(EOTP.parts(MEMORY.hidden) - quiet).max() > 0.1
    # Before anything is remembered or done, only the goal asks.
    start = PolicyState(jnp.zeros(HIDDEN), jnp.int32(NO_ACTION))
    np.testing.assert_allclose(
        attention(view, start), attention(view, start, module(with_parts(quiet[0], 0, 0))), rtol=1e-5
    )


def test_the_first_attention_of_a_fresh_policy_goes_by_the_goal():
    weights = init_params(SPEC, jax.random.key(0))
    method, start = module(weights), bind(SPEC, weights).initial_memory()
    share = attention(seen(BOOK, CHAIR, FRIDGE), start, method)
    assert np.ptp(share) > 0.01
    np.testing.assert_array_equal(method.parts(start.hidden), [1, 1, 1])


# Lengths, and the layout's weights


def test_cosines_know_directions_alone():
    """Embeddings three times as long get the same attention; what is read of them is three times as much."""
    maps = WEIGHTS["method"]["maps"]
    louder = jax.tree.map(lambda leaf: 3 * leaf, maps["inner"])
    long = module(WEIGHTS | {"method": WEIGHTS["method"] | {"maps": maps | {"inner": louder}}})
    view = seen(BOOK, CHAIR)
    short_window, long_window = encoded(view), encoded(view, method=long)
    np.testing.assert_allclose(np.linalg.norm(short_window.keys, axis=-1), np.ones(K), rtol=1e-5)
    np.testing.assert_allclose(short_window.keys, long_window.keys, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(attention(view), attention(view, method=long), rtol=1e-4)
    np.testing.assert_allclose(3 * short_window.values, long_window.values, rtol=1e-4)


def test_layout_weights_multiply_after_the_norm():
    """They leave attention as it is, and multiply what is read, also where all are the same factor."""
    view, layout = seen(BOOK, CHAIR), jnp.array([0.0, 0.5, 2.0])
    plain, weighted = encoded(view), encoded(view, layout)
    np.testing.assert_array_equal(plain.keys, weighted.keys)
    np.testing.assert_array_equal(EOTP.attention_weights(plain, MEMORY), EOTP.attention_weights(weighted, MEMORY))
    np.testing.assert_allclose(weighted.values, layout[:, None] * plain.values, rtol=1e-6)
    changed = np.asarray(EOTP.attend(weighted, MEMORY) != EOTP.attend(plain, MEMORY)).reshape(K, -1)
    assert changed.any(axis=-1).all()
    halved = EOTP.attend(encoded(view, 0.5 * ONES), MEMORY)
    assert np.abs(halved - EOTP.attend(plain, MEMORY)).max() > 1e-3
    # A category of weight 0 says the same whatever is detected of it.
    read = [EOTP.attend(encoded(v, layout), MEMORY).reshape(K, -1)[BOOK] for v in (view, seen(CHAIR))]
    np.testing.assert_array_equal(read[0], read[1])


# The ablation


def test_uniform_attention_is_deaf_to_what_asks():
    spec = dataclasses.replace(SPEC, method=find_method("jaxnav.policies.methods.eotp:UNIFORM"))
    uniform = module(spec=spec)
    assert type(uniform) is UniformAttention is spec.method.experience
    views = seen(BOOK, FRIDGE), *(seen(BOOK, CHAIR, FRIDGE, goal=goal) for goal, _ in OTHER.values())
    for view, memory in zip(views, (MEMORY, *(memory for _, memory in OTHER.values())), strict=True):
        shown = np.asarray(view.visible + view.goal > 0)
        np.testing.assert_allclose(attention(view, memory, uniform), shown / shown.sum(), rtol=1e-6)
    # The same parameters, and but for attention the same experience.
    assert jax.tree.structure(init_params(spec, jax.random.key(0))) == jax.tree.structure(WEIGHTS)
    alone = encoded(seen(FRIDGE))
    np.testing.assert_array_equal(uniform.attend(alone, MEMORY), EOTP.attend(alone, MEMORY))


def test_gradients_are_finite_before_anything_is_remembered():
    """Vectors of length 0 have no direction."""
    start, view = PolicyState(jnp.zeros(HIDDEN), jnp.int32(NO_ACTION)), seen(BOOK)

    @jax.jit
    @jax.grad
    def gradient(weights):
        method = module(weights)
        return method.attend(method.encode(view, weights["appearance"]["embedding"], ONES, None), start).sum()

    for weights in (WEIGHTS, init_params(SPEC, jax.random.key(0))):
        result = gradient(weights)["method"]
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
        assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(result)) < 100
