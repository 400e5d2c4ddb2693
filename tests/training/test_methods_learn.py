"""Methods learn: in the small world they find 30 points more of the goals than random actions do.

A search with a planner finds as many untrained; that it learns where to search is tested in `test_macro_steps`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import ENV, ENVS, KNOWLEDGE, PARAMS

from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import ActionControl
from jaxnav.policies.methods import METHODS
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import DONE, NUM_ACTIONS
from jaxnav.training.calibration import explore
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner

LIMIT, CHUNK, CHUNKS = 20, 20, 20
CONFIG = PPOConfig(num_envs=ENVS, rollout=10, epochs=4, minibatches=2, gamma=0.97)
SMALLER = {
    "vtnet": {"token_width": 8, "feedforward": 16, "tokens": 4, "encoder_layers": 1, "decoder_layers": 1, "queries": 3},
    "tpn": {"tentative_width": 16},
}
#: Updates in chunks of `CHUNK`, of a method that takes ten times as long as the others.
CHUNKS_OF = {"savn": 5}


@functools.cache
def random_success():
    """The share of episodes in which uniformly random actions succeed.

    One step before the limit this is P(Done) = 1 / 6 where Done succeeds; before that, 1 / 6 of it and the mean of
    what follows the five other actions.
    """
    right = tiny.BANK.best_length == 1  # [poses, categories]
    success = np.zeros(right.shape)
    others = [action for action in range(NUM_ACTIONS) if action != DONE]
    for _ in range(LIMIT):
        success = (right + success[tiny.BANK.successor[:, others]].sum(axis=1)) / NUM_ACTIONS
    chances, first = [], 0
    for scene, cells in enumerate(tiny.BANK.num_cells):
        goals = tiny.BANK.goals[scene][: tiny.BANK.num_goals[scene]]
        starts = slice(first * tiny.POSES_PER_CELL, (first + cells) * tiny.POSES_PER_CELL, 2)  # horizon 0
        chances.append(success[starts][:, goals].mean())
        first += cells
    return np.mean(chances)


@functools.cache
def counts():
    """What random walks see together; not all of it."""
    explored = jax.jit(explore, static_argnums=(0, 3, 4))(ENV, PARAMS, jax.random.key(1), 64, 20)
    return np.asarray(explored.counts)


def test_random_actions_seldom_succeed():
    assert 0.05 < random_success() < 0.6


@pytest.mark.exhaustive
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.control == ActionControl()])
def test_a_method_learns(name):
    method = METHODS[name]
    learned = {} if method.learn is None else method.learn([tiny.BANK], counts())
    knowledge = KNOWLEDGE._replace(method=jax.tree.map(jnp.asarray, learned))
    tables = PARAMS.tables.replace(expert=jnp.asarray(tiny.BANK.expert))
    params = PARAMS.replace(step_limit=jnp.full(2, LIMIT, jnp.int32), tables=tables)
    spec = PolicySpec(method, 3, tiny.SIZES, tuple(SMALLER.get(name, {}).items()))
    agent_loop = AgentLoop(ENV, spec, tiny.ESTIMATOR if method.hosts_layout else None)
    state, begin, metrics = None, 0, {}
    for stage in method.stages:
        learner = Learner(agent_loop, CONFIG, "none", stage)
        chunks = max(1, round(stage.share * CHUNKS_OF.get(name, CHUNKS)))
        scalars = CONFIG.scalars(chunks * CHUNK, begin)
        train = jax.jit(functools.partial(learner.train, num_updates=CHUNK))
        if state is None:
            state = jax.jit(learner.init)(jax.random.key(0), params, knowledge)
        for _ in range(chunks):
            state, metrics = train(state, scalars, params, knowledge)
        begin += chunks * CHUNK
    assert state is not None
    assert float(metrics["success"]) > random_success() + 0.3, (metrics["success"], random_success())
