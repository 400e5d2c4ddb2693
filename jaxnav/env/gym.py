"""The environment for Gymnasium, single and vectorised.

`gymnasium.make("jaxnav.env.gym:jaxnav/rooms-v0")` and `gymnasium.make_vec(..., num_envs=1024)`, also with `apartments`
and `houses`; options are those of `jaxnav.make`. Importing this module registers the ids.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jaxnav.env.make import make
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, State
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.scenes.worlds import WORLDS

Named = dict[str, Any]
_SCALE = np.array([255.0, AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE], np.float32)
_ORIGIN = np.array([0.0, 0.0, 128.0, 0.0], np.float32)


class Episode(NamedTuple):
    """Hold an episode and how its state was come to.

    Attributes:
      state: of the environment.
      moved: bool [], whether the last action changed the cell.
    """

    state: State
    moved: jax.Array


def observation_space(env: ObjectNav) -> spaces.Dict:
    """Return the space of named observations.

    `view` uint8 [V, V]: 0 unknown, 1 free, 2 blocked; row 0 is nearest, column 0 leftmost. `detections` float32 [K, 4]:
    for each category confidence, metres ahead, metres to the right and apparent size; zeros where it is not detected.
    `goal`: index of a category. `heading`: compass. `horizon`: the camera's. `moved`: whether the last action changed
    the cell.
    """
    rows, rules = env.row_format, env.task.rules
    low, high = ((np.array([byte, byte, byte, byte], np.float32) - _ORIGIN) / _SCALE for byte in (0.0, 255.0))
    shape = (rows.num_categories, 4)
    return spaces.Dict(
        {
            "view": spaces.Box(0, 2, (rows.view, rows.view), np.uint8),
            "detections": spaces.Box(np.broadcast_to(low, shape), np.broadcast_to(high, shape), dtype=np.float32),
            "goal": spaces.Discrete(rows.num_categories),
            "heading": spaces.Discrete(rules.headings),
            "horizon": spaces.Discrete(len(rules.horizons)),
            "moved": spaces.Discrete(2),
        }
    )


class Told(NamedTuple):
    """Hold what an action brought.

    Attributes:
      reward: float32 [].
      terminated, truncated: bool [], whether the episode ended by Done or for lack of steps.
      success: bool [], whether it was a Done that succeeds.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array


class _Functions:
    """Compile reset and step of a batch of episodes, with named observations."""

    def __init__(self, env: ObjectNav, params: EnvParams) -> None:
        self._env, self._params = env, params
        self.reset, self.advance, self.step = (
            jax.jit(jax.vmap(each)) for each in (self._reset, self._advance, self._step)
        )

    def _reset(self, key: jax.Array) -> tuple[Episode, Named]:
        episode = Episode(self._env.reset(key, self._params)[1], jnp.bool_(False))
        return episode, self._named(episode)

    def _advance(self, episode: Episode, action: jax.Array) -> tuple[Episode, Named, Told]:
        """Take an action; what ends stays where it ended."""
        state, reward, terminated, truncated = self._env.advance(episode.state, action, self._params)
        after = Episode(state, self._env.cell(state.pose) != self._env.cell(episode.state.pose))
        success = terminated & self._env.succeeds(state, self._params)
        return after, self._named(after), Told(reward, terminated, truncated, success)

    def _step(self, key: jax.Array, episode: Episode, action: jax.Array) -> tuple[Episode, Named, Named, Told]:
        """Take an action; what ends is followed by a new episode at once."""
        after, last, told = self._advance(episode, action)
        fresh, first = self._reset(key)
        ended = told.terminated | told.truncated
        episode, named = jax.tree.map(lambda new, old: jnp.where(ended, new, old), (fresh, first), (after, last))
        return episode, named, last, told

    def _named(self, episode: Episode) -> Named:
        env, state = self._env, episode.state
        row, view = env.observe(state, self._params).row, env.row_format.view
        _, heading, horizon = env.task.rules.split(state.pose)
        detections = env.row_format.detections(row)
        values = (detections.astype(jnp.float32) - _ORIGIN[None]) / _SCALE[None]
        return {
            "view": env.row_format.view_cells(row).reshape(view, view),
            "detections": jnp.where(detections[:, :1] > 0, values, 0.0),
            "goal": state.goal,
            "heading": heading,
            "horizon": horizon,
            "moved": episode.moved.astype(jnp.int32),
        }


class ObjectNavEnv(gymnasium.Env[Named, np.int64]):
    """Hold one episode at a time.

    Attributes:
      categories: names of what can be detected, by index.
    """

    def __init__(self, world: str = "rooms", **options: Any) -> None:
        """Make the scenes; the options are those of `jaxnav.make`.

        Raises:
          InputError: see `jaxnav.make`.
        """
        env, params = make(world, **options)
        self._functions, self._episodes = _Functions(env, params), None
        self.observation_space, self.action_space = observation_space(env), spaces.Discrete(env.num_actions)
        self.categories = env.categories

    def reset(self, *, seed: int | None = None, options: Named | None = None) -> tuple[Named, Named]:
        """Begin an episode."""
        super().reset(seed=seed)
        self._episodes, named = self._functions.reset(_keys(self.np_random, 1))
        return _at(_plain(named), 0), {}

    def step(self, action: Any) -> tuple[Named, float, bool, bool, Named]:
        """Take an action; `info` says whether it was a Done that succeeds."""
        actions = _checked(self.action_space, self._episodes, action)
        self._episodes, named, told = self._functions.advance(self._episodes, actions[None])
        reward, terminated, truncated, success = (leaf.item() for leaf in told)
        return _at(_plain(named), 0), reward, terminated, truncated, {"success": success}


class ObjectNavVectorEnv(VectorEnv[Named, np.ndarray, np.ndarray]):
    """Hold many episodes side by side; those that end begin anew at once.

    Attributes:
      categories: names of what can be detected, by index.
    """

    metadata: Named = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  (as Gymnasium declares it)

    def __init__(self, num_envs: int = 1, world: str = "rooms", **options: Any) -> None:
        """Make the scenes; the options are those of `jaxnav.make`.

        Raises:
          InputError: see `jaxnav.make`.
        """
        env, params = make(world, **options)
        self.num_envs, self._functions, self._episodes = num_envs, _Functions(env, params), None
        self.single_observation_space, self.single_action_space = (
            observation_space(env),
            spaces.Discrete(env.num_actions),
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.categories = env.categories

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Named | None = None
    ) -> tuple[Named, Named]:
        """Begin all episodes.

        Args:
          seed: of all of them; or one for each, of which each begins like the single environment.
          options: unused.

        Raises:
          ValueError: not as many seeds as episodes.
        """
        if not isinstance(seed, Sequence):
            super().reset(seed=seed)
            keys = _keys(self.np_random, self.num_envs)
        elif len(seed) != self.num_envs:
            raise ValueError(f"seed holds {len(seed)} seeds; give one for each of the {self.num_envs} environments")
        else:
            generators = [np_random(each)[0] for each in seed]
            keys = jnp.concatenate([_keys(each, 1) for each in generators])
            self.np_random = generators[0]
        self._episodes, named = self._functions.reset(keys)
        return _plain(named), {}

    def step(self, actions: np.ndarray) -> tuple[Named, np.ndarray, np.ndarray, np.ndarray, Named]:
        """Take an action in every episode.

        Where one ends, `final_obs` and `final_info`, which holds `success`, are of the episode that ended.
        """
        actions, keys = _checked(self.action_space, self._episodes, actions), _keys(self.np_random, self.num_envs)
        self._episodes, named, last, told = self._functions.step(keys, self._episodes, actions)
        told = jax.tree.map(np.array, told)
        ended, infos = told.terminated | told.truncated, {}
        if ended.any():
            final, last = np.full(self.num_envs, None, object), _plain(last)
            for number in np.flatnonzero(ended).tolist():
                final[number] = _at(last, number)
            infos = {"final_obs": final, "final_info": {"success": told.success, "_success": ended}}
            infos |= {"_final_obs": ended, "_final_info": ended}
        return _plain(named), told.reward, told.terminated, told.truncated, infos


def _checked(space: spaces.Space, episodes: Episode | None, action: Any) -> np.ndarray:
    """Return the actions int32 of a step.

    Raises:
      ResetNeeded: nothing was reset yet.
      InvalidAction: the action is not in the space.
    """
    if episodes is None:
        raise gymnasium.error.ResetNeeded("call reset() before step()")
    array = np.asarray(action)
    if array.shape != space.shape or array.dtype.kind not in "iu" or not ((array >= 0) & (array < NUM_ACTIONS)).all():
        raise gymnasium.error.InvalidAction(f"{action!r}: give whole numbers from 0 to {NUM_ACTIONS - 1} as in {space}")
    return array.astype(np.int32)


def _keys(generator: np.random.Generator, number: int) -> jax.Array:
    """Draw keys of episodes."""
    return jax.random.split(jax.random.key(int(generator.integers(2**32))), number)


def _plain(named: Named) -> Named:
    """Return observations in the dtypes of their space, in memory of their own."""
    wide = {np.dtype(np.int32): np.int64}
    return {name: np.array(each, wide.get(each.dtype, each.dtype)) for name, each in named.items()}


def _at(named: Named, number: int) -> Named:
    """Return one observation of a batch."""
    return {name: values[number] for name, values in named.items()}


for _world in WORLDS:
    gymnasium.register(
        f"jaxnav/{_world}-v0",
        entry_point=ObjectNavEnv,
        vector_entry_point=ObjectNavVectorEnv,
        kwargs={"world": _world},
    )
