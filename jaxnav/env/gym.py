"""Gymnasium environments, single and vectorised, with named observations.

    gymnasium.make("jaxnav.env.gym:jaxnav/rooms-v0")
    gymnasium.make_vec("jaxnav.env.gym:jaxnav/rooms-v0", num_envs=1024)

The worlds `apartments` and `houses` are registered likewise; keyword arguments are the options of `jaxnav.make`.
Importing this module registers the ids.
"""

import functools
import os
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, cast

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jaxnav.env.make import make
from jaxnav.env.named_observation import name_observation, to_numpy
from jaxnav.env.objectnav import DETECTION_ORIGIN, DETECTION_SCALE, EnvParams, ObjectNav, State
from jaxnav.errors import InputError
from jaxnav.numerics.trees import tree_where
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.scenes.worlds import WORLDS

#: Observations or infos by name.
NamedValues = dict[str, Any]
#: Kinds of pictures, see `ObjectNav.render`.
RenderMode = Literal["rgb_array", "ansi"]

#: Processes that have imported this module: one that was forked later is another one.
_IMPORT_PROCESS_ID = os.getpid()


class ObjectNavEnv(gymnasium.Env[NamedValues, np.int64]):
    """One episode at a time.

    Attributes:
      categories: names of the detected categories, by index.
    """

    metadata: NamedValues = {"render_modes": ["rgb_array", "ansi"], "render_fps": 8}  # noqa: RUF012

    def __init__(self, world: str = "rooms", *, render_mode: str | None = None, **options: Any) -> None:
        """Make the scenes; the options are those of `jaxnav.make`.

        Args:
          world: name of the world.
          render_mode: `rgb_array` or `ansi`, see `ObjectNav.render`; None without pictures.
          options: further options of `jaxnav.make`.

        Raises:
          InputError: see `jaxnav.make`; an unknown render mode; and a process that was forked, in which JAX would wait
            forever.
        """
        if os.getpid() != _IMPORT_PROCESS_ID:
            raise InputError(
                "vectorization_mode='async': JAX hangs in forked processes; omit the mode, to step all environments in "
                "one compiled call, or give vector_kwargs={'context': 'spawn'}"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode {render_mode!r}: choose rgb_array, ansi or None")
        env, params = make(world, **options)
        self.render_mode = render_mode
        self._env = env
        self._params = params
        self._path: list[int] = []  # poses of the episode so far
        self._batched_env = _BatchedEnv(env, params)
        self._episodes: EpisodeState | None = None  # leaves [1]
        self.observation_space = observation_space(env)
        self.action_space = spaces.Discrete(env.num_actions)
        self.categories = env.categories

    def reset(self, *, seed: int | None = None, options: NamedValues | None = None) -> tuple[NamedValues, NamedValues]:
        """Start an episode."""
        super().reset(seed=seed)
        episodes, observations = self._batched_env.reset(_draw_keys(self.np_random, 1))
        self._episodes = episodes
        self._path = [int(episodes.state.pose[0])]
        return _select_env(to_numpy(observations), 0), {}

    def step(self, action: Any) -> tuple[NamedValues, float, bool, bool, NamedValues]:
        """Take an action; `info["success"]` is True for a successful Done."""
        actions = _validate_actions(self.action_space, self._episodes, action)
        episodes, observations, signals = self._batched_env.advance(self._episodes, actions[None])
        self._episodes = episodes
        self._path.append(int(episodes.state.pose[0]))

        # Gymnasium expects Python scalars; the single environment is a batch of one.
        observation = _select_env(to_numpy(observations), 0)
        step_info = {"success": signals.success.item()}
        return observation, signals.reward.item(), signals.terminated.item(), signals.truncated.item(), step_info

    def render(self) -> Any:
        """Draw the episode in the render mode: uint8 [height, width, 3], or text; None without a render mode.

        Raises:
          ResetNeeded: `reset` was not called before.
        """
        if self.render_mode is None:
            return None
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        state = jax.tree.map(lambda leaf: np.asarray(leaf[0]), self._episodes.state)
        return self._env.render(state, self._params, mode=cast(RenderMode, self.render_mode), path=self._path[:-1])


class ObjectNavVectorEnv(VectorEnv[NamedValues, np.ndarray, np.ndarray]):
    """Many parallel episodes in one compiled step, with same-step auto-reset.

    Attributes:
      categories: names of the detected categories, by index.
    """

    metadata: NamedValues = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (as Gymnasium declares it)

    def __init__(self, num_envs: int = 1, world: str = "rooms", **options: Any) -> None:
        """Make the scenes; the options are those of `jaxnav.make`.

        Raises:
          InputError: see `jaxnav.make`.
        """
        env, params = make(world, **options)
        self.num_envs = num_envs
        self._batched_env = _BatchedEnv(env, params)
        self._episodes: EpisodeState | None = None  # leaves [num_envs]
        self.single_observation_space = observation_space(env)
        self.single_action_space = spaces.Discrete(env.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.categories = env.categories

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: NamedValues | None = None
    ) -> tuple[NamedValues, NamedValues]:
        """Start all episodes.

        Args:
          seed: one seed for all environments, or a sequence with one seed for each; in the latter case every first
            episode equals that of the single environment.
          options: unused.

        Raises:
          ValueError: the number of seeds differs from the number of environments.
        """
        if not isinstance(seed, Sequence):
            # One generator serves all environments.
            super().reset(seed=seed)
            reset_keys = _draw_keys(self.np_random, self.num_envs)
        elif len(seed) != self.num_envs:
            raise ValueError(f"seed holds {len(seed)} seeds; give one for each of the {self.num_envs} environments")
        else:
            # One generator for each environment; the first one also serves all later episodes.
            env_generators = []
            env_keys = []
            for env_seed in seed:
                env_generator, _ = np_random(env_seed)
                env_generators.append(env_generator)
                env_keys.append(_draw_keys(env_generator, 1))
            reset_keys = jnp.concatenate(env_keys)
            self.np_random = env_generators[0]
        self._episodes, observations = self._batched_env.reset(reset_keys)
        return to_numpy(observations), {}

    def step(self, actions: np.ndarray) -> tuple[NamedValues, np.ndarray, np.ndarray, np.ndarray, NamedValues]:
        """Take an action in every episode.

        Where an episode ends, `final_obs` and `final_info` (with `success`) describe the episode that ended, and the
        observation is the first of the next episode.
        """
        # The keys are those of the next episodes, for environments whose episode ends with this step.
        actions = _validate_actions(self.action_space, self._episodes, actions)
        reset_keys = _draw_keys(self.np_random, self.num_envs)
        step_result = self._batched_env.step(reset_keys, self._episodes, actions)
        self._episodes, observations, final_observations, signals = step_result
        signals = jax.tree.map(np.array, signals)
        has_ended = signals.terminated | signals.truncated

        # Gymnasium's infos: one entry per environment, with a mask of the valid ones under the name with "_".
        env_infos = {}
        if has_ended.any():
            final_observations = to_numpy(final_observations)
            final_obs = np.full(self.num_envs, None, object)
            for env_index in np.flatnonzero(has_ended).tolist():
                final_obs[env_index] = _select_env(final_observations, env_index)
            env_infos = {
                "final_obs": final_obs,
                "final_info": {"success": signals.success, "_success": has_ended},
                "_final_obs": has_ended,
                "_final_info": has_ended,
            }
        return to_numpy(observations), signals.reward, signals.terminated, signals.truncated, env_infos


def observation_space(env: ObjectNav) -> spaces.Dict:
    """Return the space of named observations.

    `view` uint8 [V, V]: 0 unknown, 1 free, 2 blocked; row 0 is nearest to the agent, column 0 leftmost. `detections`
    float32 [K, 4]: confidence, metres ahead, metres to the right and apparent size of each category; zeros where the
    category is not detected. `goal`: index of the category to search for. `heading`: compass. `horizon`: camera pitch.
    `moved`: 1 if the last action changed the cell.
    """
    row_format = env.row_format
    task_rules = env.task.rules

    # A detection has four bytes, each from 0 to 255; the bounds are these bytes in units of the observation.
    detection_low = (np.zeros(4, np.float32) - DETECTION_ORIGIN) / DETECTION_SCALE
    detection_high = (np.full(4, 255.0, np.float32) - DETECTION_ORIGIN) / DETECTION_SCALE
    detections_shape = (row_format.num_categories, 4)
    return spaces.Dict(
        {
            "view": spaces.Box(0, 2, (row_format.view, row_format.view), np.uint8),
            "detections": spaces.Box(
                np.broadcast_to(detection_low, detections_shape),
                np.broadcast_to(detection_high, detections_shape),
                dtype=np.float32,
            ),
            "goal": spaces.Discrete(row_format.num_categories),
            "heading": spaces.Discrete(task_rules.headings),
            "horizon": spaces.Discrete(len(task_rules.horizons)),
            "moved": spaces.Discrete(2),
        }
    )


class EpisodeState(NamedTuple):
    """State of an episode, with the effect of the last action.

    Attributes:
      state: state of the environment.
      moved: bool [], True where the last action changed the cell.
    """

    state: State
    moved: jax.Array


class StepSignals(NamedTuple):
    """Reward and ending of one step.

    Attributes:
      reward: float32 [].
      terminated: bool [], True where the episode ended by Done.
      truncated: bool [], True where the episode reached its step limit.
      success: bool [], True for a successful Done.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array


class _BatchedEnv:
    """Compiled reset and steps of a batch of episodes, with named observations.

    Attributes:
      reset: (keys [B]) -> episodes, observations.
      advance: (episodes, actions [B]) -> episodes, observations, signals; without auto-reset.
      step: (keys [B], episodes, actions [B]) -> episodes, observations, final observations, signals; with auto-reset.
    """

    def __init__(self, env: ObjectNav, params: EnvParams) -> None:
        self._env = env
        # The tables are an argument of the compiled programs, or each would hold a copy of them.
        self.reset = functools.partial(jax.jit(jax.vmap(self._reset, (None, 0))), params)
        self.advance = functools.partial(jax.jit(jax.vmap(self._advance, (None, 0, 0))), params)
        self.step = functools.partial(jax.jit(jax.vmap(self._step, (None, 0, 0, 0))), params)

    def _reset(self, params: EnvParams, key: jax.Array) -> tuple[EpisodeState, NamedValues]:
        _, start_state = self._env.reset(key, params)
        episode = EpisodeState(start_state, jnp.bool_(False))
        return episode, self._observe(params, episode)

    def _advance(
        self, params: EnvParams, episode: EpisodeState, action: jax.Array
    ) -> tuple[EpisodeState, NamedValues, StepSignals]:
        next_state, reward, terminated, truncated = self._env.advance(episode.state, action, params)

        # A rotation or a blocked MoveAhead keeps the cell.
        moved = self._env.cell_of_pose(next_state.pose) != self._env.cell_of_pose(episode.state.pose)
        success = terminated & self._env.done_succeeds(next_state, params)
        next_episode = EpisodeState(next_state, moved)
        return next_episode, self._observe(params, next_episode), StepSignals(reward, terminated, truncated, success)

    def _step(
        self, params: EnvParams, key: jax.Array, episode: EpisodeState, action: jax.Array
    ) -> tuple[EpisodeState, NamedValues, NamedValues, StepSignals]:
        final_episode, final_observation, signals = self._advance(params, episode, action)

        # Replace an episode that has ended by a new one, which is drawn in any case.
        has_ended = signals.terminated | signals.truncated
        episode, observation = tree_where(has_ended, self._reset(params, key), (final_episode, final_observation))
        return episode, observation, final_observation, signals

    def _observe(self, params: EnvParams, episode: EpisodeState) -> NamedValues:
        return name_observation(self._env, params, episode.state, episode.moved)


def _validate_actions(space: spaces.Space, episodes: EpisodeState | None, action: Any) -> np.ndarray:
    """Return valid actions as int32.

    Raises:
      ResetNeeded: `reset` was not called before.
      InvalidAction: the action is not in the space.
    """
    if episodes is None:
        raise gymnasium.error.ResetNeeded("call reset() before step()")
    # Compiled code cannot raise, so actions are checked before.
    action_array = np.asarray(action)
    if (
        action_array.shape != space.shape
        or action_array.dtype.kind not in "iu"
        or not ((action_array >= 0) & (action_array < NUM_ACTIONS)).all()
    ):
        raise gymnasium.error.InvalidAction(f"{action!r}: give whole numbers from 0 to {NUM_ACTIONS - 1} as in {space}")
    return action_array.astype(np.int32)


def _draw_keys(generator: np.random.Generator, count: int) -> jax.Array:
    """Draw PRNG keys [count] from a NumPy generator."""
    seed = int(generator.integers(2**32))
    return jax.random.split(jax.random.key(seed), count)


def _select_env(observations: NamedValues, index: int) -> NamedValues:
    """Return the observation of one environment of a batch."""
    return {name: batch_values[index] for name, batch_values in observations.items()}


for _world in WORLDS:
    gymnasium.register(
        f"jaxnav/{_world}-v0",
        entry_point=ObjectNavEnv,
        vector_entry_point=ObjectNavVectorEnv,
        kwargs={"world": _world},
    )
