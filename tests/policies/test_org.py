"""ORG: relations, aggregation and weights against the equations of the released code, written out in NumPy."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from support import tiny_world as tiny

from jaxnav.policies.features import NUM_FEATURES, Features
from jaxnav.policies.methods import METHODS
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.policies.network import bind

BATCH_SIZE = 64
NUM_CATEGORIES = tiny.SPEC.num_categories


def make_relations(num_layers: int):
    """The relations of ORG with random parameters, and these parameters in float64."""
    spec = dataclasses.replace(tiny.SPEC, method=METHODS["org"], method_sizes=(("relation_layers", num_layers),))
    params = tiny.random_params(5, spec)
    experience = bind(spec, params).method
    assert isinstance(experience, ObjectRelations)
    return experience, params["method"]


def draw_inputs(seed=0):
    """Features [BATCH_SIZE, K, ...] with a random part of the categories visible, appearances and layout weights."""
    rng = np.random.default_rng(seed)
    visible = (rng.random((BATCH_SIZE, NUM_CATEGORIES)) < 0.6).astype(np.float32)
    goal = np.eye(NUM_CATEGORIES, dtype=np.float32)[rng.integers(0, NUM_CATEGORIES, BATCH_SIZE)]
    detections = rng.normal(size=(BATCH_SIZE, NUM_CATEGORIES, NUM_FEATURES - 1)) * visible[..., None]
    table = np.concatenate([detections, goal[..., None]], axis=-1).astype(np.float32)
    appearance = rng.normal(size=(NUM_CATEGORIES, tiny.SIZES.appearance)).astype(np.float32)
    weights = rng.uniform(0, 1, (BATCH_SIZE, NUM_CATEGORIES)).astype(np.float32)
    no_view = jnp.zeros((BATCH_SIZE, 0))
    return Features(no_view, jnp.asarray(visible), jnp.asarray(table), jnp.asarray(goal)), appearance, weights


def released_experience(params, features, appearance, weights, *, is_transposed=True):
    """The released equations for one view, in float64.

    info = relu(L1([info | indicator]))^T; info = relu(L2(info)) for each layer; appear = (appear^T info)^T; w
    multiplies the rows [appear | info | indicator] before the perceptron. The mistake `is_transposed=False` omits the
    last transposition.
    """
    to_float64 = functools.partial(np.asarray, dtype=float)
    edges, maps = params["edges"], params["maps"]
    info = np.maximum(to_float64(features.table) @ to_float64(edges["kernel"]) + to_float64(edges["bias"]), 0).T
    for kernel in params["mix"]:
        info = np.maximum(info @ to_float64(kernel), 0)

    appear = features.visible[:, None] * to_float64(appearance)
    related = (appear.T @ info).T if is_transposed else info @ appear
    rows = weights[:, None] * np.hstack([related, features.table])
    for layer in (maps["inner"], maps["outer"]):
        rows = np.maximum(rows @ to_float64(layer["kernel"]) + to_float64(layer["bias"]), 0)
    return rows.ravel()


def package_and_reference(num_layers, **mistake):
    """Experience of the package, and that of the released equations, [BATCH_SIZE, K m] each."""
    experience, params = make_relations(num_layers)
    features, appearance, weights = draw_inputs()
    encoded = experience.encode(features, jnp.asarray(appearance), jnp.asarray(weights), None)
    expected = []
    for view in range(BATCH_SIZE):
        view_features = Features(*(leaf[view] for leaf in features))
        expected.append(released_experience(params, view_features, appearance, weights[view], **mistake))
    return np.asarray(encoded), np.array(expected)


@pytest.mark.slow
@pytest.mark.parametrize("num_layers", [1, 4])
def test_experience_equals_that_of_the_released_equations(num_layers):
    encoded, expected = package_and_reference(num_layers)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(encoded, expected, atol=1e-5 * scale)

    # Negative control: the transposed aggregation R X is far off.
    _, mistaken = package_and_reference(num_layers, is_transposed=False)
    assert np.abs(encoded - mistaken).max() > 0.05 * scale


def test_aggregation_follows_worked_arithmetic():
    """Category i collects the appearance of category j with the factor R_ji.

    Only the feature `ahead` enters the edges: unit j holds e_j times `ahead` of category i, with e = (1, 0, 2). `ahead`
    is (1, 2, 3), so R before the mixing is the outer product of e and (1, 2, 3), and mixing with diag(1, 1, 10) makes
    it e times (1, 2, 30). The appearances are (5, 7, 11), and Fridge is not visible: R^T X is (1, 2, 30) times
    1 * 5 + 0 * 7 = 5. (R X would be e times 1 * 5 + 2 * 7.) The layout weights (1, 0.5, 0.1) multiply the rows.
    """
    experience, params = make_relations(1)
    ahead_column = 2
    edges_kernel = np.zeros((NUM_FEATURES, NUM_CATEGORIES), np.float32)
    edges_kernel[ahead_column] = [1, 0, 2]

    # A perceptron that passes the first number of the appearance.
    first_input_only = {}
    for name in ("inner", "outer"):
        kernel = np.zeros_like(params["maps"][name]["kernel"])
        kernel[0, 0] = 1
        first_input_only[name] = {"kernel": kernel, "bias": np.zeros_like(params["maps"][name]["bias"])}
    hand_params = {
        "edges": {"kernel": edges_kernel, "bias": np.zeros(NUM_CATEGORIES, np.float32)},
        "mix": np.diag([1.0, 1.0, 10.0]).astype(np.float32)[None],
        "maps": first_input_only,
    }
    nnx.update(experience, hand_params)

    table = np.zeros((NUM_CATEGORIES, NUM_FEATURES), np.float32)
    table[:, ahead_column] = [1, 2, 3]
    visible = jnp.array([1.0, 1.0, 0.0])
    features = Features(jnp.zeros(0), visible, jnp.asarray(table), goal=jnp.array([1.0, 0.0, 0.0]))
    appearance = np.zeros((NUM_CATEGORIES, tiny.SIZES.appearance), np.float32)
    appearance[:, 0] = [5, 7, 11]
    encoded = experience.encode(features, jnp.asarray(appearance), jnp.array([1.0, 0.5, 0.1]), None)
    maps = np.asarray(encoded).reshape(NUM_CATEGORIES, -1)
    np.testing.assert_allclose(maps[:, 0], [5, 5, 15], rtol=1e-6)
    assert not maps[:, 1:].any()
