"""Episodes without experience (eq. 1) are those of the direct stream."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, KNOWLEDGE, PARAMS

from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import Evaluator
from jaxnav.evaluation.variants import inference_grid, table_row
from jaxnav.policies.agent_loop import AgentLoop

NUM_EPISODES = 64


@pytest.mark.slow
def test_tde_episodes_equal_those_of_the_direct_stream():
    """Sampled, in the whole grid: the same as those of a policy whose experience says nothing."""
    weights = tiny.random_params(1, tiny.STREAMS)
    stream = weights["experience_stream"]
    mute_weights = weights | {"experience_stream": stream | {"actor": jax.tree.map(jnp.zeros_like, stream["actor"])}}
    rows = [table_row(variant, None, None, "sample") for variant in ("layout", "tde")]
    grid, evaluator = inference_grid(rows, ("layout",), 1), Evaluator(AgentLoop(ENV, tiny.STREAMS, tiny.ESTIMATOR))
    parts = [(draw_episodes(tiny.BANK, NUM_EPISODES, seed=1), PARAMS)]
    full_outcome, mute_outcome = (
        evaluator(grid, jax.tree.map(lambda leaf: leaf[None], policy_weights), parts, KNOWLEDGE, jax.random.key(0))
        for policy_weights in (weights, mute_weights)
    )
    for name in ("done", "success", "length", "moves", "distance"):
        result, expected = getattr(full_outcome, name), getattr(mute_outcome, name)
        np.testing.assert_array_equal(result[1], expected[0])
    # Experience matters to the policy that has it.
    assert (full_outcome.length[0] != full_outcome.length[1]).mean() > 0.2
