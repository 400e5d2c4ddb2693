"""Agents of all kinds on the tiny world: equal outcomes, the observations that they receive, and refused agents."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny

from jaxnav.env.objectnav import Observation
from jaxnav.errors import InputError
from jaxnav.evaluation.agents import run_agent
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.scenes.task import DONE, MOVE_AHEAD, ROTATE_RIGHT

ENV, PARAMS = tiny.world()
EPISODES = draw_episodes(tiny.BANK, 12)
#: Number of categories, bytes of a row, and cells along each side of the view.
NUM_CATEGORIES = len(ENV.categories)
ROW_BYTES = tiny.BANK.rows.shape[-1]
VIEW_SIZE = ENV.row_format.view


def run(agent: Any):
    return run_agent(agent, "mine", ENV, [(EPISODES, PARAMS)], jax.random.key(0))


class Walker(NamedTuple):
    """Agent that moves ahead, and turns after a step without motion; a pytree with one array."""

    turn: jax.Array

    def init(self):
        return jnp.int32(0)

    def act(self, observation, memory, moved):
        action = jnp.where((memory > 0) & ~moved, self.turn, MOVE_AHEAD)
        return action, memory + 1


class CountingWalker:
    """The agent of `Walker` as a function; its call counter excludes the first step, before which nothing has moved."""

    def __init__(self):
        self.num_calls = 0

    def __call__(self, observations):
        is_blocked = (observations["moved"] == 0) & (self.num_calls > 0)
        self.num_calls += 1
        return np.where(is_blocked, ROTATE_RIGHT, MOVE_AHEAD)


class Predictor:
    """The agent of `Walker` with `predict`, which returns a state as recurrent policies do."""

    def predict(self, observations, state=None, episode_start=None, deterministic=False):
        assert deterministic
        assert episode_start is not None
        time = np.zeros(len(episode_start), int) if state is None else state
        is_blocked = (observations["moved"] == 0) & (time > 0)
        return np.where(is_blocked, ROTATE_RIGHT, MOVE_AHEAD), time + 1


@pytest.mark.slow
def test_all_kinds_of_agents_give_equal_outcomes():
    outcome = run(Walker(jnp.int32(ROTATE_RIGHT)))
    # The agent never chooses Done, so every episode ends at the limit of its scene: 6 in the kitchen, 8 in the bedroom.
    step_limits = np.array(tiny.STEP_LIMITS)[EPISODES.scene]
    np.testing.assert_array_equal(outcome.length, step_limits)
    assert not outcome.done.any()
    assert (outcome.moves > 0).all()

    for other_agent in (CountingWalker(), Predictor()):
        jax.tree.map(np.testing.assert_array_equal, outcome, run(other_agent))


def test_keys_split_from_the_key_of_init_differ_from_the_keys_of_act():
    """An agent may split the key of `init`, and `split(key, n)[i]` equals `fold_in(key, i)`."""

    class KeyKeeper:
        def init(self, key):
            return {"time": jnp.int32(0), "later_keys": jax.random.key_data(jax.random.split(key, 16))}

        def act(self, observation, memory, key):
            is_repeated = (jax.random.key_data(key)[None] == memory["later_keys"]).all(axis=-1).any()
            return jnp.where(is_repeated, DONE, MOVE_AHEAD), memory

    assert not run(KeyKeeper()).done.any()


def test_done_succeeds_if_the_shortest_path_has_length_one():
    outcome = run(lambda observations: np.full(len(observations["goal"]), DONE))
    np.testing.assert_array_equal(outcome.success, EPISODES.best_length == 1)
    assert (outcome.length == 1).all()


def test_agents_receive_only_observations():
    """An agent gets a row and a goal, a memory, a key and the odometry, but no pose, scene, table or distance."""
    inputs: dict[str, Any] = {}

    class Recorder:
        def init(self, key):
            return ()

        def act(self, observation, memory, key, heading, horizon, moved):
            inputs.update(observation=observation, key=key, heading=heading, horizon=horizon, moved=moved)
            return jnp.int32(DONE), memory

    run(Recorder())
    observation = inputs.pop("observation")
    assert set(vars(observation)) == {"row", "goal"}
    assert isinstance(observation, Observation)
    shapes = {name: leaf.shape for name, leaf in inputs.items()}
    assert shapes == {"key": (), "heading": (), "horizon": (), "moved": ()}
    assert observation.row.shape == (ROW_BYTES,)


def test_functions_receive_copies_of_named_observations():
    """Overwriting an observation changes neither the environment nor the next observation."""
    formats = []

    def overwrite(observations):
        formats.append({name: (values.shape, values.dtype.kind) for name, values in observations.items()})
        for values in observations.values():
            assert values.base is None
            values[...] = 0
        return np.full(len(observations["goal"]), MOVE_AHEAD)

    def move_ahead(observations):
        return np.full(len(observations["goal"]), MOVE_AHEAD)

    jax.tree.map(np.testing.assert_array_equal, run(overwrite), run(move_ahead))
    assert formats[0] == {
        "view": ((12, VIEW_SIZE, VIEW_SIZE), "u"),
        "detections": ((12, NUM_CATEGORIES, 4), "f"),
        **dict.fromkeys(("goal", "heading", "horizon", "moved"), ((12,), "i")),
    }


class FixedAgent:
    """Agent with a fixed first memory, action and next memory."""

    def __init__(self, memory, action, next_memory):
        self.memory = memory
        self.action = action
        self.next_memory = next_memory

    def init(self):
        return self.memory

    def act(self, observation, memory):
        return self.action, self.next_memory


ZERO = jnp.zeros(2)


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (FixedAgent((), jnp.zeros(6), ()), r"act returned an action float32 \[6\]; expected int32 \[\]"),
        (FixedAgent((), jnp.float32(np.nan), ()), r"act returned an action float32 \[\]; expected int32 \[\]"),
        (FixedAgent((), 6, ()), "act returned the action 6; give whole numbers from 0 to 5"),
        (FixedAgent((), -1, ()), "act returned the action -1; give"),
        (FixedAgent(ZERO, 0, jnp.zeros(3)), r"memory  ?float32 \[3\]; expected that of init, float32 \[2\]"),
        (FixedAgent(ZERO, 0, ()), "act returned a memory .*; expected that of init"),
        (FixedAgent(ZERO, 0, ZERO * np.nan), "act returned a memory that contains NaN"),
        (Walker(jnp.float32(np.nan)), "its array turn contains NaN"),
        (Walker, r"is a class; give an object of it, such as Walker\(\)"),
        (3, "int is no agent; give an object with init and act or with predict, a function"),
        (lambda _: np.zeros((12, 6)), r"it returned actions float64 \[12, 6\]; expected int \[12\]"),
        (lambda _: np.full(12, np.nan), r"float64 \[12\], which contain NaN; expected int \[12\]"),
        (lambda _: np.full(12, 7), "it returned the action 7; give whole numbers from 0 to 5"),
    ],
)
def test_agents_with_wrong_returns_are_refused_in_one_line(agent, message):
    with pytest.raises(InputError, match=f"^mine: .*{message}") as refusal:
        run(agent)
    assert "\n" not in str(refusal.value)


def test_an_observation_space_selects_parts_or_the_flat_form():
    """The flat form equals Gymnasium's flattening of the named observation."""
    pytest.importorskip("gymnasium")
    from gymnasium import spaces

    from jaxnav.env.gym import observation_space

    space = observation_space(ENV)
    recorded_observations = []

    class Policy:
        def __init__(self, space):
            self.observation_space = space

        def predict(self, observations):
            recorded_observations.append(observations)
            return np.full(12, DONE)

    # Policies that declare all observations, their flat form, and only the goal.
    run(Policy(space))
    run(Policy(spaces.flatten_space(space)))
    run(Policy(spaces.Dict({"goal": space["goal"]})))
    named_observations, flat_observations, goal_observations = recorded_observations
    first_episode = {name: values[0] for name, values in named_observations.items()}
    np.testing.assert_allclose(flat_observations[0], np.asarray(spaces.flatten(space, first_episode)))
    assert set(goal_observations) == {"goal"}

    # Another space is refused.
    with pytest.raises(InputError, match=r"observation_space is .*; expected that of the world, a dictionary with "):
        run(Policy(spaces.Box(0, 1, (3,))))
