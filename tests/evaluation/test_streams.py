"""Episodes under TDE (eq. 1) equal those of the direct stream."""

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
    """With sampled actions, TDE equals a policy whose experience stream has an actor of zeros."""
    weights = tiny.random_params(1, tiny.STREAMS)
    stream = weights["experience_stream"]
    zero_actor = jax.tree.map(jnp.zeros_like, stream["actor"])
    direct_weights = weights | {"experience_stream": stream | {"actor": zero_actor}}

    # Both policies run the rows "layout" and "tde".
    rows = [table_row(variant, None, None, "sample") for variant in ("layout", "tde")]
    grid = inference_grid(rows, ("layout",), 1)
    evaluator = Evaluator(AgentLoop(ENV, tiny.STREAMS, tiny.ESTIMATOR))
    parts = [(draw_episodes(tiny.BANK, NUM_EPISODES, seed=1), PARAMS)]

    def evaluate(policy_weights):
        stacked_weights = jax.tree.map(lambda leaf: leaf[None], policy_weights)
        return evaluator(grid, stacked_weights, parts, KNOWLEDGE, jax.random.key(0))

    full_outcome = evaluate(weights)
    direct_outcome = evaluate(direct_weights)
    for name in ("done", "success", "length", "moves", "distance"):
        result = getattr(full_outcome, name)
        expected = getattr(direct_outcome, name)
        np.testing.assert_array_equal(result[1], expected[0])
    # Negative control: the experience stream changes the episodes of the policy.
    assert (full_outcome.length[0] != full_outcome.length[1]).mean() > 0.2
