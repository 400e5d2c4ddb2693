"""Methods learn: in the small world their success rate exceeds that of random actions by 30 points.

Methods that search with a planner succeed as often without training; `test_macro_steps` tests that they learn where to
search.
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

STEP_LIMIT = 20
CHUNK_SIZE = 20
NUM_CHUNKS = 20
#: Number of chunks, of `CHUNK_SIZE` updates each, of a method whose updates take ten times as long.
NUM_CHUNKS_BY_METHOD = {"savn": 5}
CONFIG = PPOConfig(num_envs=ENVS, rollout=10, epochs=4, minibatches=2, gamma=0.97)
#: Small layers of the methods that have sizes of their own.
METHOD_SIZES = {
    "vtnet": {"token_width": 8, "feedforward": 16, "tokens": 4, "encoder_layers": 1, "decoder_layers": 1, "queries": 3},
    "tpn": {"tentative_width": 16},
}


@functools.cache
def random_success():
    """The share of episodes in which uniformly random actions succeed.

    One step before the limit the chance of success is P(Done) = 1 / 6 where Done succeeds. With more steps to go, the
    chances after the five other actions are added, each with a weight of 1 / 6.
    """
    # The chance of success from every pose within the step limit, by dynamic programming [poses, categories].
    can_succeed = tiny.BANK.best_length == 1
    success = np.zeros(can_succeed.shape)
    other_actions = [action for action in range(NUM_ACTIONS) if action != DONE]
    for _ in range(STEP_LIMIT):
        success = (can_succeed + success[tiny.BANK.successor[:, other_actions]].sum(axis=1)) / NUM_ACTIONS

    # The mean over the poses where episodes start and the goals of each scene.
    success_by_scene = []
    first_cell = 0
    for scene, num_cells in enumerate(tiny.BANK.num_cells):
        goals = tiny.BANK.goals[scene][: tiny.BANK.num_goals[scene]]
        first_pose = first_cell * tiny.POSES_PER_CELL
        end_pose = (first_cell + num_cells) * tiny.POSES_PER_CELL
        start_poses = slice(first_pose, end_pose, 2)  # horizon 0
        success_by_scene.append(success[start_poses][:, goals].mean())
        first_cell += num_cells
    return np.mean(success_by_scene)


@functools.cache
def cooccurrence_counts():
    """Counts of categories that random walks see together; the walks do not see every pose."""
    explored = jax.jit(explore, static_argnums=(0, 3, 4))(ENV, PARAMS, jax.random.key(1), 64, 20)
    return np.asarray(explored.counts)


def test_random_actions_seldom_succeed():
    assert 0.05 < random_success() < 0.6


@pytest.mark.exhaustive
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.control == ActionControl()])
def test_a_method_learns(name):
    # The knowledge that the method learns from the scenes, and the actions of shortest paths for imitation.
    method = METHODS[name]
    method_knowledge = {} if method.learn is None else method.learn([tiny.BANK], cooccurrence_counts())
    knowledge = KNOWLEDGE._replace(method=jax.tree.map(jnp.asarray, method_knowledge))
    tables = PARAMS.tables.replace(expert=jnp.asarray(tiny.BANK.expert))
    params = PARAMS.replace(step_limit=jnp.full(2, STEP_LIMIT, jnp.int32), tables=tables)

    # Train the stages of the method one after the other, each for its share of the chunks.
    spec = PolicySpec(method, 3, tiny.SIZES, tuple(METHOD_SIZES.get(name, {}).items()))
    agent_loop = AgentLoop(ENV, spec, tiny.ESTIMATOR if method.hosts_layout else None)
    state = None
    first_update = 0
    metrics = {}
    for stage in method.stages:
        learner = Learner(agent_loop, CONFIG, "none", stage)
        num_chunks = max(1, round(stage.share * NUM_CHUNKS_BY_METHOD.get(name, NUM_CHUNKS)))
        scalars = CONFIG.scalars(num_chunks * CHUNK_SIZE, first_update)
        train = jax.jit(functools.partial(learner.train, num_updates=CHUNK_SIZE))
        if state is None:
            state = jax.jit(learner.init)(jax.random.key(0), params, knowledge)
        for _ in range(num_chunks):
            state, metrics = train(state, scalars, params, knowledge)
        first_update += num_chunks * CHUNK_SIZE

    assert state is not None
    assert float(metrics["success"]) > random_success() + 0.3, (metrics["success"], random_success())
