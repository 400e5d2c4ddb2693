"""One step of the optimizer, by hand: Adam's first step is the sign of the gradient, nearly."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.policies.methods import find_method
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import apply_gradient, make_optimizer

CONFIG, SINGLE_RATE = PPOConfig(), "jaxnav.policies.methods.vtnet:SINGLE_RATE"
WEIGHTS = {"method": {"token": jnp.float32([1.0, 2.0])}, "actor": {"bias": jnp.float32([3.0])}}
GRADIENT = {"method": {"token": jnp.float32([0.2, -0.1])}, "actor": {"bias": jnp.float32([0.3])}}


def step(rates, gradient=GRADIENT):
    state = make_optimizer(CONFIG).init(WEIGHTS)
    after, state = apply_gradient(CONFIG, WEIGHTS, state, gradient, jnp.float32(0.01), rates)
    return np.concatenate([after["method"]["token"], after["actor"]["bias"]]), int(state.total_notfinite)


# Its norm sqrt(0.04 + 0.01 + 0.09) = 0.374 is below the clip of 0.5. The first moments over the roots of the second
# are g / (|g| + 1e-5), within 1e-4 of 1 or -1, and the steps 0.01 times that.
@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        (None, [0.99, 2.01, 2.99]),
        (lambda path: 0.1 if path == ("method", "token") else 1.0, [0.999, 2.001, 2.99]),
        (lambda path: path[0] == "method", [0.99, 2.01, 3.0]),
    ],
)
def test_a_parameter_learns_at_its_rate(rates, expected):
    np.testing.assert_allclose(step(rates)[0], expected, atol=2e-6)


def test_a_gradient_of_what_does_not_move_is_no_matter():
    broken = GRADIENT | {"actor": {"bias": jnp.float32([jnp.nan])}}
    after, skipped = step(lambda path: path[0] == "method", broken)
    np.testing.assert_allclose(after, [0.99, 2.01, 3.0], atol=2e-6)
    assert skipped == 0
    assert step(None, broken)[1] == 1


def test_vtnet_goes_on_at_a_tenth_of_the_rate_of_imitation():
    (imitate, reinforce), (same, single_rate) = find_method("vtnet").stages, find_method(SINGLE_RATE).stages
    assert same == imitate
    assert single_rate == dataclasses.replace(reinforce, lr_scale_by_path=None)
    rates = [stage.lr_scale_by_path for stage in (imitate, reinforce) if stage.lr_scale_by_path is not None]
    assert [rate(("method", "maps", "bias")) for rate in rates] == [1, 0.1]
    assert [rate(("actor", "bias")) for rate in rates] == [0, 1]


def test_runs_of_the_former_name_are_those_of_the_default():
    assert find_method("jaxnav.policies.methods.vtnet:SLOWER").stages == find_method("vtnet").stages
