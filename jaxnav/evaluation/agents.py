"""Agents of any kind on fixed episodes. They receive observations, and nothing else of the environment.

`run_agent` accepts three kinds of agents, and steps them with the loop of the evaluation grid:

* an object with `init` and `act`, for one episode, in JAX; the library vmaps and compiles it:
  `memory = init()` and `action, memory = act(observation, memory)`, where the observation is an `Observation`. Both may
  take a PRNG `key`; `act` may also take the `heading`, `horizon` and `moved` of named observations, all by name;
* an object with `predict(observations)`, as those of Stable-Baselines3, for a batch in NumPy;
* a function of a batch of named observations, which returns the actions, in NumPy or JAX.
"""

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.env.named_observation import name_observation, to_numpy
from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation, State
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import (
    EpisodeBatch,
    EpisodeOutcome,
    advance_batch,
    finish_outcome,
    run_to_end,
    start_states,
)
from jaxnav.numerics.trees import tree_where
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.scenes.task import NUM_ACTIONS

#: Named observations [B, ...] to actions [B].
BatchFunction = Callable[[dict[str, np.ndarray]], Any]
#: Names of the odometry that `act` may take.
_ODOMETRY = ("heading", "horizon", "moved")
# Constant folded into the key of an episode for `init`; the time steps folded into it for `act` are smaller.
_INIT_TAG = 2**30


class RandomAgent:
    """Agent that chooses every action with equal probability."""

    def init(self) -> tuple[()]:
        """Return the empty memory."""
        return ()

    def act(self, observation: Observation, memory: tuple[()], key: jax.Array) -> tuple[jax.Array, tuple[()]]:
        """Draw an action, int32 []."""
        return jax.random.randint(key, (), 0, NUM_ACTIONS), memory


def is_agent(subject: Any) -> bool:
    """True if an object is of one of the three kinds, as far as its attributes tell."""
    return not isinstance(subject, type) and (
        _has_methods(subject, "init", "act") or _has_methods(subject, "predict") or callable(subject)
    )


def run_agent(
    agent: Any, name: str, env: ObjectNav, banks: Iterable[tuple[EpisodeList, EnvParams]], key: jax.Array
) -> EpisodeOutcome:
    """Run an agent over every episode.

    Args:
      agent: an agent of one of the three kinds.
      name: name of the agent in error messages.
      env: the environment.
      banks: for every bank of scenes, its episodes and its environment parameters; E episodes in total.
      key: typed PRNG key []. Bank index, episode and time are folded in.

    Returns:
      The outcomes, leaves [E].

    Raises:
      InputError: the agent is of no such kind, or returns actions or memories of wrong shapes, dtypes or values.
    """
    if isinstance(agent, type):
        raise InputError(f"{name}: is a class; give an object of it, such as {agent.__name__}()")
    if not is_agent(agent):
        raise InputError(
            f"{name}: {type(agent).__name__} is no agent; give an object with init and act or with predict, a function "
            "of observations, a run or a policy"
        )
    loop = AgentLoop(env)
    if _has_methods(agent, "init", "act"):
        check_parameters(agent, name)
        run_bank = _compile_step_agent(agent, name, loop)
    else:
        run_bank = functools.partial(_run_batch_agent, agent, name, loop)

    outcomes = []
    for bank_index, (episodes, env_params) in enumerate(banks):
        outcome = run_bank(start_states(episodes), env_params, jax.random.fold_in(key, bank_index))
        outcomes.append(jax.tree.map(np.asarray, outcome))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *outcomes)


def _has_methods(subject: Any, *names: str) -> bool:
    return all(callable(getattr(subject, name, None)) for name in names)


# Agents with `init` and `act`, compiled


class AgentState(NamedTuple):
    """State of an agent with `init` and `act` during an episode.

    Attributes:
      memory: the agent's memory.
      moved: bool [], True where the last action changed the cell.
      is_invalid: bool [], True if an action was out of range or the memory contained NaN.
      invalid_action: int32 [], the first such action.
    """

    memory: Any
    moved: jax.Array
    is_invalid: jax.Array
    invalid_action: jax.Array


def check_parameters(agent: Any, name: str) -> None:
    """Refuse an agent whose arrays contain NaN.

    Raises:
      InputError: names the array.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(agent):
        is_float_array = isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.floating)
        if is_float_array and bool(jnp.isnan(leaf).any()):
            array_name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise InputError(
                f"{name}: its array {array_name or '(itself)'} contains NaN; train or load the agent again"
            )


def _compile_step_agent(
    agent: Any, name: str, loop: AgentLoop
) -> Callable[[State, EnvParams, jax.Array], EpisodeOutcome]:
    """Return the compiled function of start states [E], environment parameters and a key."""
    # Arrays of a pytree are arguments of the compiled function; other objects are constants of it.
    leaves = jax.tree.leaves(agent)
    is_pytree = all(isinstance(leaf, jax.Array | np.ndarray | int | float | bool) for leaf in leaves)

    @jax.jit
    def run(
        agent_leaves: Any, states: State, env_params: EnvParams, key: jax.Array
    ) -> tuple[EpisodeOutcome, tuple[jax.Array, jax.Array]]:
        acting_agent = agent_leaves if is_pytree else agent
        return _run_step_agent(acting_agent, states, env_params, key, loop)

    def run_bank(states: State, env_params: EnvParams, key: jax.Array) -> EpisodeOutcome:
        _check_step_agent(agent, name, loop.env, env_params)
        outcome, (is_invalid, invalid_action) = run(agent if is_pytree else (), states, env_params, key)
        if is_invalid.any():
            action = int(invalid_action[np.argmax(is_invalid)])
            if 0 <= action < NUM_ACTIONS:
                raise InputError(f"{name}: act returned a memory that contains NaN; give finite numbers")
            raise _action_error(name, "act", action)
        return outcome

    return run_bank


def _run_step_agent(
    agent: Any, states: State, env_params: EnvParams, key: jax.Array, loop: AgentLoop
) -> tuple[EpisodeOutcome, tuple[jax.Array, jax.Array]]:
    """Run an agent with `init` and `act` in E episodes.

    Returns:
      The outcomes, leaves [E]; and which agents were invalid, bool [E], with their first invalid action, int32 [E].
    """
    num_episodes = len(states.pose)
    episode_keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num_episodes))

    def step(batch: EpisodeBatch) -> EpisodeBatch:
        # Observation and odometry of every episode, and the agent's action.
        agent_state = _agent_state(batch)
        state = batch.agent.state
        observation = jax.vmap(loop.env.observe, (0, None))(state, env_params)
        _, heading, horizon = loop.env.task.rules.split_pose(state.pose)
        step_keys = jax.vmap(jax.random.fold_in)(batch.episode_keys, state.time)
        odometry = {"heading": heading, "horizon": horizon, "moved": agent_state.moved}
        action, memory = jax.vmap(functools.partial(_act, agent))(observation, agent_state.memory, step_keys, odometry)
        memory = jax.tree.map(lambda new, old: new.astype(old.dtype), memory, agent_state.memory)

        # An invalid agent is reported after the run; until then it moves ahead.
        is_in_range = (action >= 0) & (action < NUM_ACTIONS)
        is_invalid = ~is_in_range | _contains_nan(memory, action.shape)
        is_first = is_invalid & batch.running & ~agent_state.is_invalid
        action = action.astype(jnp.int32)
        next_state = AgentState(
            memory=memory,
            moved=agent_state.moved,
            is_invalid=agent_state.is_invalid | is_first,
            invalid_action=jnp.where(is_first, action, agent_state.invalid_action),
        )
        action = jnp.where(is_in_range, action, 0)

        next_agent, result = loop.step(batch.agent, action, None, env_params)
        next_agent = next_agent._replace(memory=next_state._replace(moved=result.moved))
        return advance_batch(batch, next_agent, action, result, jnp.zeros(action.shape))

    # Every agent starts with its own memory and a key of its own.
    init_keys = jax.vmap(jax.random.fold_in, (0, None))(episode_keys, _INIT_TAG)
    memory = jax.vmap(functools.partial(_init, agent))(init_keys)
    not_moved = jnp.zeros(num_episodes, bool)
    agent_state = AgentState(memory, not_moved, not_moved, jnp.zeros(num_episodes, jnp.int32))
    start = loop.start_from(states, None, None, env_params)
    batch = EpisodeBatch(
        agent=start._replace(memory=agent_state),
        running=jnp.ones(num_episodes, bool),
        outcome=EpisodeOutcome.zeros((num_episodes,)),
        episode_keys=episode_keys,
    )

    def select(batch: EpisodeBatch) -> tuple[State, jax.Array, jax.Array]:
        agent_state = _agent_state(batch)
        return batch.agent.state, agent_state.is_invalid, agent_state.invalid_action

    outcome, (final_state, is_invalid, invalid_action) = run_to_end(batch, step, select, divisors=())
    return finish_outcome(outcome, final_state, loop.env, env_params), (is_invalid, invalid_action)


def _agent_state(batch: EpisodeBatch) -> Any:
    """State of the agents, which takes the place of a policy's memory in the batch."""
    return batch.agent.memory


def _init(agent: Any, key: jax.Array) -> Any:
    """Initial memory of one agent, as arrays."""
    options = {"key": key} if "key" in _accepted_names(agent.init) else {}
    return jax.tree.map(jnp.asarray, agent.init(**options))


def _act(
    agent: Any, observation: Observation, memory: Any, key: jax.Array, odometry: dict[str, jax.Array]
) -> tuple[jax.Array, Any]:
    """Action and memory of one agent, as arrays, with those options that it takes."""
    accepted_names = _accepted_names(agent.act)
    options = {name: value for name, value in (odometry | {"key": key}).items() if name in accepted_names}
    action, next_memory = agent.act(observation, memory, **options)
    return jnp.asarray(action), jax.tree.map(jnp.asarray, next_memory)


def _accepted_names(function: Callable[..., Any]) -> set[str]:
    """Names of the options of `act` and `init` that a function takes."""
    parameters = inspect.signature(function).parameters
    return {"key", *_ODOMETRY} & set(parameters)


def _contains_nan(memory: Any, shape: tuple[int, ...]) -> jax.Array:
    """True where a memory contains NaN, bool [B]; leaves [B, ...]."""
    contains_nan = jnp.zeros(shape, bool)
    for leaf in jax.tree.leaves(memory):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            contains_nan |= jnp.isnan(leaf).reshape(*shape, -1).any(axis=-1)
    return contains_nan


def _check_step_agent(agent: Any, name: str, env: ObjectNav, env_params: EnvParams) -> None:
    """Trace one step of an agent, and check shapes and dtypes of what it returns.

    Raises:
      InputError: names what was returned, and what was expected.
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    num_bytes = env_params.tables.rows.shape[-1]
    row: Any = jax.ShapeDtypeStruct((num_bytes,), jnp.uint8)
    index: Any = jax.ShapeDtypeStruct((), jnp.int32)
    observation = Observation(row, index)
    odometry = {"heading": index, "horizon": index, "moved": jax.ShapeDtypeStruct((), jnp.bool_)}

    # Any exception may come from the code of the agent.
    try:
        memory = jax.eval_shape(functools.partial(_init, agent), key)
    except Exception as error:
        raise InputError(
            f"{name}: init() fails ({_first_line(error)}); give a function without arguments or of `key`"
        ) from error
    try:
        action, next_memory = jax.eval_shape(functools.partial(_act, agent), observation, memory, key, odometry)
    except Exception as error:
        raise InputError(
            f"{name}: act(observation, memory) fails for a row uint8 [{num_bytes}] and a goal int32 [] "
            f"({_first_line(error)}); return an action and the next memory"
        ) from error

    if action.shape or not jnp.issubdtype(action.dtype, jnp.integer):
        raise InputError(
            f"{name}: act returned an action {_describe(action)}; expected int32 [], an index into jaxnav.ACTIONS"
        )
    expected_structure = jax.tree.structure(memory)
    structure = jax.tree.structure(next_memory)
    if structure != expected_structure:
        raise InputError(f"{name}: act returned a memory {structure}; expected that of init, {expected_structure}")
    for (path, expected), leaf in zip(
        jax.tree_util.tree_leaves_with_path(memory), jax.tree.leaves(next_memory), strict=True
    ):
        if (leaf.shape, leaf.dtype) != (expected.shape, expected.dtype):
            leaf_name = jax.tree_util.keystr(path, simple=True, separator="/")
            expected_array = _describe(expected)
            raise InputError(
                f"{name}: act returned memory {leaf_name} {_describe(leaf)}; expected that of init, {expected_array}"
            )


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"


def _describe(array: Any) -> str:
    """Describe dtype and shape of an array, such as "float32 [64, 6]"."""
    return f"{array.dtype} [{', '.join(map(str, array.shape))}]"


def _action_error(name: str, source: str, action: int) -> InputError:
    return InputError(
        f"{name}: {source} returned the action {action}; give whole numbers from 0 to {NUM_ACTIONS - 1}, indices into "
        "jaxnav.ACTIONS"
    )


# Agents that act on batches, in NumPy


def _run_batch_agent(
    agent: Any, name: str, loop: AgentLoop, states: State, env_params: EnvParams, key: jax.Array
) -> EpisodeOutcome:
    """Run a function of observations, or an object with `predict`, in E episodes side by side."""
    num_episodes = len(states.pose)
    source = "predict" if _has_methods(agent, "predict") else "it"
    choose_actions = _as_batch_function(agent, name, loop.env)
    batch = EpisodeBatch(
        agent=loop.start_from(states, None, None, env_params)._replace(memory=jnp.zeros(num_episodes, bool)),
        running=jnp.ones(num_episodes, bool),
        outcome=EpisodeOutcome.zeros((num_episodes,)),
        episode_keys=jax.random.split(key, num_episodes),
    )

    # The batch keeps its size, since an agent may remember its episodes by their place in it.
    running = np.ones(num_episodes, bool)
    while running.any():
        observations = to_numpy(_observe_batch(batch, env_params, loop))
        actions = _check_actions(choose_actions(observations), name, source, running)
        batch = _step_batch(batch, jnp.asarray(actions), env_params, loop)
        running = np.asarray(batch.running)
    return finish_outcome(batch.outcome, batch.agent.state, loop.env, env_params)


@functools.partial(jax.jit, static_argnames="loop")
def _observe_batch(batch: EpisodeBatch, env_params: EnvParams, loop: AgentLoop) -> dict[str, jax.Array]:
    """Named observations [B, ...]; the memory of the batch is whether the last action changed the cell."""
    name_state = functools.partial(name_observation, loop.env, env_params)
    return jax.vmap(name_state)(batch.agent.state, _agent_state(batch))


@functools.partial(jax.jit, static_argnames="loop")
def _step_batch(batch: EpisodeBatch, actions: jax.Array, env_params: EnvParams, loop: AgentLoop) -> EpisodeBatch:
    """Take the actions int32 [B] in the running episodes; the others stay as they are."""
    next_agent, result = loop.step(batch.agent, actions, None, env_params)
    next_agent = next_agent._replace(memory=tree_where(batch.running, result.moved, batch.agent.memory))
    return advance_batch(batch, next_agent, actions, result, jnp.zeros(actions.shape))


def _check_actions(actions: Any, name: str, source: str, running: np.ndarray) -> np.ndarray:
    """Return valid actions as int32 [B]; those of ended episodes are ignored.

    Raises:
      InputError: wrong shape, dtype or values.
    """
    actions = np.asarray(actions)
    if actions.shape != running.shape or actions.dtype.kind not in "iu":
        contains_nan = actions.dtype.kind == "f" and bool(np.isnan(actions).any())
        values = ", which contain NaN" if contains_nan else ""
        raise InputError(
            f"{name}: {source} returned actions {_describe(actions)}{values}; expected int [{len(running)}], an index "
            "into jaxnav.ACTIONS for every observation"
        )
    is_invalid = running & ((actions < 0) | (actions >= NUM_ACTIONS))
    if is_invalid.any():
        raise _action_error(name, source, int(actions[np.argmax(is_invalid)]))
    return np.where(running, actions, 0).astype(np.int32)


def _as_batch_function(agent: Any, name: str, env: ObjectNav) -> BatchFunction:
    """Return an agent as a function of named observations [B, ...]."""
    if not _has_methods(agent, "predict"):
        return agent
    convert = _observation_converter(getattr(agent, "observation_space", None), name, env)
    parameters = inspect.signature(agent.predict).parameters
    is_recurrent = {"state", "episode_start"} <= set(parameters)
    state = None
    is_start = True

    def predict(observations: dict[str, np.ndarray]) -> Any:
        # Recurrent policies of Stable-Baselines3 receive their state, and where episodes start.
        nonlocal state, is_start
        options = {}
        if is_recurrent:
            options = {"state": state, "episode_start": np.full(len(observations["goal"]), is_start)}
        if "deterministic" in parameters:
            options["deterministic"] = True
        prediction = agent.predict(convert(observations), **options)
        is_start = False
        actions, state = prediction if isinstance(prediction, tuple) else (prediction, None)
        return actions

    return predict


def _observation_converter(space: Any, name: str, env: ObjectNav) -> Callable[[dict[str, np.ndarray]], Any]:
    """Return the function from named observations to those of an agent's own space, if it states one.

    Raises:
      InputError: the space is neither that of the environment, a part of it, nor its flat form.
    """
    if space is None:
        return lambda observations: observations
    from gymnasium import spaces

    from jaxnav.env.gym import observation_space

    env_spaces = observation_space(env).spaces
    if isinstance(space, spaces.Dict):
        if any(env_spaces.get(key) != part for key, part in space.spaces.items()):
            raise _space_error(name, space, env_spaces)
        return lambda observations: {key: observations[key] for key in space.spaces}

    # The flat form: the parts in the order of the space, discrete ones as indicators.
    flat_size = sum(spaces.flatdim(part) for part in env_spaces.values())
    if space.shape != (flat_size,):
        raise _space_error(name, space, env_spaces)

    def flatten(observations: dict[str, np.ndarray]) -> np.ndarray:
        parts = []
        for key, part in env_spaces.items():
            values = observations[key]
            if isinstance(part, spaces.Discrete):
                values = np.eye(part.n)[values]
            parts.append(values.reshape(len(values), -1))
        return np.concatenate(parts, axis=1).astype(space.dtype)

    return flatten


def _space_error(name: str, space: Any, env_spaces: Any) -> InputError:
    parts = ", ".join(f"{key} {_describe(part)}" for key, part in env_spaces.items())
    return InputError(
        f"{name}: its observation_space is {space}; expected that of the world, a dictionary with {parts}, or its flat "
        "form (gymnasium.wrappers.FlattenObservation)"
    )
