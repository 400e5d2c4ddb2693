"""PPO learns the values and choices of five probes in closed form, and a success curve within stored bounds.

The probes are episodes of one or two actions whose rewards are a table of time, goal and action; all five are trained
in one compiled call.
"""

import functools
from collections.abc import Callable
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

NUM_GOALS = len(tiny.CATEGORIES)
NUM_TIMES = 2  # length of the longest probe
NUM_UPDATES = 80
GAMMA = 0.5
#: Action with a reward in the probes whose rewards depend on the action.
PAID_ACTION = 3


class ProbeParams(EnvParams):
    """Parameters of a probe.

    Attributes:
      rewards: float32 [2, K, A], the reward by time, goal and action.
      episode_length: int32 [], the number of actions in an episode.
    """

    rewards: jax.Array
    episode_length: jax.Array


class Probe(ObjectNav):
    """Environment in which nothing moves, and rewards come from a table."""

    def advance(self, state, action, params):
        assert isinstance(params, ProbeParams)
        time = state.time + 1
        reward = params.rewards[state.time, state.goal, action]
        return state.replace(time=time), reward, time >= params.episode_length, jnp.bool_(False)


def build_reward_table(compute_reward: Callable[[int, int, int], float]) -> jax.Array:
    """Rewards float32 [2, K, A] of a function of time, goal and action."""
    rewards = np.zeros((NUM_TIMES, NUM_GOALS, NUM_ACTIONS), np.float32)
    for time, goal, action in np.ndindex(rewards.shape):
        rewards[time, goal, action] = compute_reward(time, goal, action)
    return jnp.array(rewards)


class ProbeCase(NamedTuple):
    """A probe and what its policy has to learn.

    Attributes:
      rewards: float32 [2, K, A], the reward by time, goal and action.
      episode_length: the number of actions in an episode.
      expected_values: the value by time and goal.
      paid_actions: the action with a reward at each goal; None if rewards do not depend on the action.
    """

    rewards: jax.Array
    episode_length: int
    expected_values: dict[tuple[int, int], float]
    paid_actions: tuple[int, ...] | None = None


def make_start_values(*values: float) -> dict[tuple[int, int], float]:
    """Values by time and goal of a probe with one action, whose only time is 0."""
    return {(0, goal): value for goal, value in enumerate(values)}


def make_delayed_values() -> dict[tuple[int, int], float]:
    """Values by time and goal of a reward of 1 for the second action: 1 before it, so gamma before the first action."""
    values = {}
    for time in range(NUM_TIMES):
        for goal in range(NUM_GOALS):
            values[time, goal] = GAMMA ** (1 - time)
    return values


CASES = {
    "constant": ProbeCase(build_reward_table(lambda *_: 1.0), 1, make_start_values(1.0, 1.0, 1.0)),
    "observation": ProbeCase(
        build_reward_table(lambda time, goal, action: goal - 1.0), 1, make_start_values(-1.0, 0.0, 1.0)
    ),
    "delayed": ProbeCase(build_reward_table(lambda time, goal, action: float(time)), NUM_TIMES, make_delayed_values()),
    "action": ProbeCase(
        build_reward_table(lambda time, goal, action: float(action == PAID_ACTION)),
        1,
        make_start_values(1.0, 1.0, 1.0),
        (PAID_ACTION,) * NUM_GOALS,
    ),
    "both": ProbeCase(
        build_reward_table(lambda time, goal, action: float(action == PAID_ACTION - goal)),
        1,
        make_start_values(1.0, 1.0, 1.0),
        tuple(PAID_ACTION - goal for goal in range(NUM_GOALS)),
    ),
}
PROBE_LEARNER = Learner(
    AgentLoop(Probe(ENV.task), PolicySpec(METHODS["rgb"], NUM_GOALS, tiny.SIZES)),
    PPOConfig(num_envs=ENVS, rollout=4, epochs=4, minibatches=2, learning_rate=1e-2, gamma=GAMMA),
    "none",
)


@functools.partial(jax.jit, static_argnums=1)
def train_probes(gamma: jax.Array, num_updates: int) -> Transition:
    """Train a policy on each probe, and return a rollout [5, T, B] of each."""
    all_params = ProbeParams(
        **{name: getattr(PARAMS, name) for name in EnvParams.__dataclass_fields__},
        rewards=jnp.stack([case.rewards for case in CASES.values()]),
        episode_length=jnp.array([case.episode_length for case in CASES.values()]),
    )

    def train_probe(probe: tuple[jax.Array, jax.Array]) -> Transition:
        rewards, episode_length = probe
        params = all_params.replace(rewards=rewards, episode_length=episode_length)

        # Train on this probe only.
        state = PROBE_LEARNER.init(jax.random.key(0), params, KNOWLEDGE)
        scalars = PROBE_LEARNER.config.scalars(NUM_UPDATES).replace(gamma=gamma)
        state, _ = PROBE_LEARNER.train(state, scalars, params, KNOWLEDGE, num_updates)

        # A rollout of the trained policy.
        agent_loop = PROBE_LEARNER.agent_loop
        policy = agent_loop.bind(state.params)
        rollout_key = jax.random.key(1)
        _, rollout = collect_rollout(agent_loop, policy, state.agent, rollout_key, params, KNOWLEDGE, num_steps=4)
        return rollout.transitions

    return jax.lax.map(train_probe, (all_params.rewards, all_params.episode_length))


@pytest.fixture(scope="module")
def rollouts() -> dict[str, Transition]:
    """A rollout of each probe's trained policy, by name of the case."""
    stacked_rollouts = jax.device_get(train_probes(jnp.float32(GAMMA), NUM_UPDATES))
    return {name: tiny.leaves_at(stacked_rollouts, index) for index, name in enumerate(CASES)}


def group_values(transitions: Transition) -> dict[tuple[int, int], np.ndarray]:
    """Values [N] of the policy by time and goal."""
    times = np.asarray(transitions.episode_length) - 1
    goals = np.asarray(transitions.goal)
    values = {}
    for time, goal in set(zip(times.ravel().tolist(), goals.ravel().tolist(), strict=True)):
        values[time, goal] = np.asarray(transitions.value[(times == time) & (goals == goal)])
    return values


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_ppo_learns_value_and_choice_of_each_probe(rollouts, name):
    case = CASES[name]
    transitions = rollouts[name]
    values = group_values(transitions)
    assert values.keys() == case.expected_values.keys()

    # A value depends on the recurrent state too, by how much on the rounding of the processor. A missing discount
    # or a missing value loss is off by 0.5.
    for key, expected_value in case.expected_values.items():
        np.testing.assert_allclose(values[key].mean(), expected_value, atol=0.1, err_msg=f"time and goal {key}")
        np.testing.assert_allclose(values[key], expected_value, atol=0.25, err_msg=f"time and goal {key}")

    # Nearly all choices are those with a reward.
    if case.paid_actions is not None:
        assert (transitions.choice == np.array(case.paid_actions)[transitions.goal]).mean() > 0.95


@pytest.mark.slow
def test_ppo_value_follows_the_discount(rollouts):
    """The delayed reward is discounted exactly once: nothing but gamma changes in the probes, and the value follows."""
    all_transitions = jax.device_get(train_probes(jnp.float32(0.9), NUM_UPDATES))
    new_values = group_values(tiny.leaves_at(all_transitions, list(CASES).index("delayed")))
    old_values = group_values(rollouts["delayed"])
    for goal in range(NUM_GOALS):
        # Single values depend on the rounding of the processor. A value that ignores gamma stays where it was.
        np.testing.assert_allclose(new_values[0, goal].mean(), 0.9, atol=0.1)
        np.testing.assert_allclose(new_values[0, goal], 0.9, atol=0.25)
        assert (np.abs(new_values[0, goal] - old_values[0, goal]) > 0.2).all()


NUM_SEEDS = 8
#: Bounds of the median success over the seeds, by first and last update.
SUCCESS_BOUNDS = {(0, 20): (0.0, 0.5), (80, 100): (0.75, 1.0), (180, 200): (0.9, 1.0), (380, 400): (0.95, 1.0)}


@pytest.mark.exhaustive
def test_median_training_success_stays_within_stored_bounds():
    """A random policy soon says Done and is right by chance; a trained one finds the goals within 20 steps.

    The bounds are for the median because one or two of the eight seeds settle near 0.8 for hundreds of updates. The
    rounding of the processor decides which seeds do.
    """
    params = PARAMS.replace(step_limit=jnp.full(2, 20, jnp.int32))
    scalars = CONFIG.scalars(400)
    keys = jax.vmap(jax.random.key)(jnp.arange(NUM_SEEDS))
    states = jax.jit(jax.vmap(lambda key: LEARNER.init(key, params, KNOWLEDGE)))(keys)

    @jax.jit
    def train(states):
        return jax.vmap(lambda state: LEARNER.train(state, scalars, params, KNOWLEDGE, num_updates=20))(states)

    # Success [seeds] of every 20 updates.
    success = {}
    for first_update in range(0, 400, 20):
        states, metrics = train(states)
        success[first_update, first_update + 20] = np.asarray(metrics["success"])

    for updates, (lowest, highest) in SUCCESS_BOUNDS.items():
        assert lowest <= np.median(success[updates]) <= highest, (updates, success)
