"""One step of the optimizer follows worked arithmetic: Adam's first step is close to the sign of the gradient."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.policies.methods import find_method
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import apply_gradient, make_optimizer

CONFIG = PPOConfig()
SINGLE_RATE = "jaxnav.policies.methods.vtnet:SINGLE_RATE"
WEIGHTS = {"method": {"token": jnp.float32([1.0, 2.0])}, "actor": {"bias": jnp.float32([3.0])}}
GRADIENT = {"method": {"token": jnp.float32([0.2, -0.1])}, "actor": {"bias": jnp.float32([0.3])}}


def take_step(rates, gradient=GRADIENT):
    """All weights after one step of the optimizer, and the number of skipped steps."""
    state = make_optimizer(CONFIG).init(WEIGHTS)
    next_weights, state = apply_gradient(CONFIG, WEIGHTS, state, gradient, jnp.float32(0.01), rates)
    values = np.concatenate([next_weights["method"]["token"], next_weights["actor"]["bias"]])
    return values, int(state.total_notfinite)


# The norm of the gradient, sqrt(0.04 + 0.01 + 0.09) = 0.374, is below the clip of 0.5. The first moments over the roots
# of the second moments are g / (|g| + 1e-5), within 1e-4 of 1 or -1, and a step is 0.01 times this ratio.
@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        (None, [0.99, 2.01, 2.99]),
        (lambda path: 0.1 if path == ("method", "token") else 1.0, [0.999, 2.001, 2.99]),
        (lambda path: path[0] == "method", [0.99, 2.01, 3.0]),
    ],
)
def test_a_parameter_learns_at_its_rate(rates, expected):
    np.testing.assert_allclose(take_step(rates)[0], expected, atol=2e-6)


def test_a_gradient_of_fixed_parameters_has_no_effect():
    nan_gradient = GRADIENT | {"actor": {"bias": jnp.float32([jnp.nan])}}
    values, num_skipped = take_step(lambda path: path[0] == "method", nan_gradient)
    np.testing.assert_allclose(values, [0.99, 2.01, 3.0], atol=2e-6)
    assert num_skipped == 0
    # Negative control: if all parameters learn, the step is skipped.
    assert take_step(None, nan_gradient)[1] == 1


def test_vtnet_continues_at_a_tenth_of_the_rate_of_imitation():
    imitation_stage, reward_stage = find_method("vtnet").stages
    equal_stage, single_rate_stage = find_method(SINGLE_RATE).stages
    assert equal_stage == imitation_stage
    assert single_rate_stage == dataclasses.replace(reward_stage, lr_scale_by_path=None)

    # Imitation trains only the method; the second stage trains the method at a tenth of the rate of the rest.
    lr_scales = [imitation_stage.lr_scale_by_path, reward_stage.lr_scale_by_path]
    scale_functions = [lr_scale for lr_scale in lr_scales if lr_scale is not None]
    assert [lr_scale(("method", "maps", "bias")) for lr_scale in scale_functions] == [1, 0.1]
    assert [lr_scale(("actor", "bias")) for lr_scale in scale_functions] == [0, 1]


def test_the_former_name_of_the_default_has_equal_stages():
    assert find_method("jaxnav.policies.methods.vtnet:SLOWER").stages == find_method("vtnet").stages
