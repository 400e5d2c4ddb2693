"""PPO learns: values and choices of five probes in closed form, and a curve above stored bounds.

The probes are episodes of one or two actions whose rewards are a table of time, goal and action; all five are trained
in one compiled call.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.rollouts import CONFIG, ENV, ENVS, KNOWLEDGE, LEARNER, PARAMS

from jaxnav.env.objectnav import EnvParams, ObjectNav
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.methods import METHODS
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.training.config import PPOConfig
from jaxnav.training.ppo import Learner, Transition, collect_rollout

GOALS = len(tiny.CATEGORIES)
UPDATES = 80
GAMMA = 0.5
RIGHT = 3  # the action that pays where one does


class ProbeParams(EnvParams):
    """Hold what a probe pays, float32 [2, K, A] by time, goal and action, and the length of its episodes, int32 []."""

    pays: jax.Array
    length: jax.Array


class Probe(ObjectNav):
    """Stay in place, and pay by a table."""

    def advance(self, state, action, params):
        assert isinstance(params, ProbeParams)
        time = state.time + 1
        reward = params.pays[state.time, state.goal, action]
        return state.replace(time=time), reward, time >= params.length, jnp.bool_(False)


def table(pays) -> jax.Array:
    """The rewards of a function of time, goal and action."""
    return jnp.array(
        [[[pays(time, goal, action) for action in range(NUM_ACTIONS)] for goal in range(GOALS)] for time in range(2)],
        jnp.float32,
    )


class Case(NamedTuple):
    """Hold a probe, its value by time and goal, and the action that pays at a goal if one does."""

    pays: jax.Array
    length: int
    value: dict[tuple[int, int], float]
    right: tuple[int, ...] | None = None


def at_start(*values: float) -> dict[tuple[int, int], float]:
    return {(0, goal): value for goal, value in enumerate(values)}


CASES = {
    "constant": Case(table(lambda *_: 1.0), 1, at_start(1.0, 1.0, 1.0)),
    "observation": Case(table(lambda time, goal, action: goal - 1.0), 1, at_start(-1.0, 0.0, 1.0)),
    # 1 for the second action, so gamma before the first.
    "delayed": Case(
        table(lambda time, goal, action: float(time)),
        2,
        {(time, goal): GAMMA ** (1 - time) for time in range(2) for goal in range(GOALS)},
    ),
    "action": Case(
        table(lambda time, goal, action: float(action == RIGHT)), 1, at_start(1.0, 1.0, 1.0), (RIGHT,) * GOALS
    ),
    "both": Case(
        table(lambda time, goal, action: float(action == RIGHT - goal)),
        1,
        at_start(1.0, 1.0, 1.0),
        tuple(RIGHT - goal for goal in range(GOALS)),
    ),
}
PROBES = Learner(
    AgentLoop(Probe(ENV.task), PolicySpec(METHODS["rgb"], GOALS, tiny.SIZES)),
    PPOConfig(num_envs=ENVS, rollout=4, epochs=4, minibatches=2, learning_rate=1e-2, gamma=GAMMA),
    "none",
)


@functools.partial(jax.jit, static_argnums=1)
def trained(gamma: jax.Array, updates: int) -> Transition:
    """A rollout [5, T, B] of each probe's policy after its training."""
    probes = ProbeParams(
        **{name: getattr(PARAMS, name) for name in EnvParams.__dataclass_fields__},
        pays=jnp.stack([case.pays for case in CASES.values()]),
        length=jnp.array([case.length for case in CASES.values()]),
    )

    def one(probe: tuple[jax.Array, jax.Array]) -> Transition:
        params = probes.replace(pays=probe[0], length=probe[1])
        state = PROBES.init(jax.random.key(0), params, KNOWLEDGE)
        scalars = PROBES.config.scalars(UPDATES).replace(gamma=gamma)
        state, _ = PROBES.train(state, scalars, params, KNOWLEDGE, updates)
        policy = PROBES.agent_loop.bind(state.params)
        arguments = policy, state.agent, jax.random.key(1), params, KNOWLEDGE
        return collect_rollout(PROBES.agent_loop, *arguments, num_steps=4)[1].transitions

    return jax.lax.map(one, (probes.pays, probes.length))


@pytest.fixture(scope="module")
def rollouts() -> dict[str, Transition]:
    result = jax.device_get(trained(jnp.float32(GAMMA), UPDATES))
    return {name: tiny.leaves_at(result, number) for number, name in enumerate(CASES)}


def values(t: Transition) -> dict[tuple[int, int], np.ndarray]:
    """The values [N] that the policy saw at each time and goal."""
    keys = {(int(time), int(goal)) for time, goal in zip(t.episode_length.ravel() - 1, t.goal.ravel(), strict=True)}
    return {key: np.asarray(t.value[(t.episode_length - 1 == key[0]) & (t.goal == key[1])]) for key in keys}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_ppo_learns_value_and_choice_of_each_probe(rollouts, name):
    case = CASES[name]
    t = rollouts[name]
    result = values(t)
    assert result.keys() == case.value.keys()
    # A value depends on the recurrent state too, by how much on the rounding of the processor. A missing discount
    # or a missing value loss is off by 0.5.
    for key, expected in case.value.items():
        np.testing.assert_allclose(result[key].mean(), expected, atol=0.1, err_msg=f"time and goal {key}")
        np.testing.assert_allclose(result[key], expected, atol=0.25, err_msg=f"time and goal {key}")
    if case.right is not None:
        assert (t.choice == np.array(case.right)[t.goal]).mean() > 0.95


@pytest.mark.slow
def test_ppo_value_follows_the_discount(rollouts):
    """So the delayed reward is discounted, and once: nothing else about the probes changes."""
    result = tiny.leaves_at(jax.device_get(trained(jnp.float32(0.9), UPDATES)), list(CASES).index("delayed"))
    for goal in range(GOALS):
        np.testing.assert_allclose(values(result)[0, goal], 0.9, atol=0.1)
        assert (np.abs(values(result)[0, goal] - values(rollouts["delayed"])[0, goal]) > 0.2).all()


SEEDS = 8
#: Bounds of the median success over the seeds, in the updates from one number to the next.
BOUNDS = {(0, 20): (0.0, 0.5), (80, 100): (0.75, 1.0), (180, 200): (0.9, 1.0), (380, 400): (0.95, 1.0)}


@pytest.mark.exhaustive
def test_median_training_success_stays_within_stored_bounds():
    """A random policy soon says Done and is right by chance; a trained one finds the goals within 20 steps.

    The median is bounded, because one seed in eight or two settle near 0.8 for hundreds of updates: which of them
    depends on the rounding of the processor.
    """
    params = PARAMS.replace(step_limit=jnp.full(2, 20, jnp.int32))
    scalars = CONFIG.scalars(400)
    keys = jax.vmap(jax.random.key)(jnp.arange(SEEDS))
    states = jax.jit(jax.vmap(lambda key: LEARNER.init(key, params, KNOWLEDGE)))(keys)

    @jax.jit
    def train(states):
        return jax.vmap(lambda state: LEARNER.train(state, scalars, params, KNOWLEDGE, num_updates=20))(states)

    success = {}
    for first_update in range(0, 400, 20):
        states, metrics = train(states)
        success[first_update, first_update + 20] = np.asarray(metrics["success"])

    for updates, (lowest, highest) in BOUNDS.items():
        assert lowest <= np.median(success[updates]) <= highest, (updates, success)
