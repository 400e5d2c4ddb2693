"""The ObjectNav environment as pure functions: parameters, state, reset and step.

An agent starts at a random pose of a random scene and must find an object of the goal category, then declare Done.
`ObjectNav` holds the static description of the task; the scenes are arrays in `EnvParams`, so that scenes of equal
shapes share one compilation. The interface is that of gymnax 1.0:

    env, params = jaxnav.make("rooms")
    observation, state = env.reset(key, params)
    observation, state, reward, terminated, truncated, info = env.step(key, state, action, params)

In gymnax's words `advance` is `step_env` (no auto-reset) and `observe` is `get_obs`. All functions handle a single
episode and look their results up in tables; batch them with `jax.vmap`. docs/environment.md states the rules.

A pose is one integer: cell, heading and camera horizon, with cells numbered over all scenes (`Rules.join_pose`).

Symbols in shapes: S scenes, C cells, H headings, P = C * H * horizons poses, K categories, R bytes of a row.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxnav.env.render import SceneRenderers
from jaxnav.env.spaces import Box, Dict, Discrete
from jaxnav.errors import InputError
from jaxnav.numerics.trees import tree_where
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_ORIGIN, RIGHT_SCALE, SIZE_SCALE, RowFormat
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT, Task

#: Index of the layout prior that all room types outside `ROOM_TYPES` share; read by agents, not by the environment.
OTHER_ROOM = len(ROOM_TYPES)
#: Number of layout priors.
NUM_PRIORS = OTHER_ROOM + 1
#: A detection is (byte - origin) / scale: confidence, metres ahead, metres to the right, apparent size.
DETECTION_SCALE = np.array([255.0, AHEAD_SCALE, RIGHT_SCALE, SIZE_SCALE], np.float32)
DETECTION_ORIGIN = np.array([0.0, 0.0, RIGHT_ORIGIN, 0.0], np.float32)
#: An episode that starts near its goal takes the nearest to the goal of this many random cells.
NUM_START_CANDIDATES = 8


class SceneTables(struct.PyTreeNode):
    """Tables of all scenes on the device; see `jaxnav.scenes.tables.compile.Bank`.

    Attributes:
      ahead: int32 [C, H], cell after MoveAhead; the same cell if the move is blocked.
      rows: uint8 [P, R], packed observation of each pose, see `RowFormat`.
      success: uint8 [P, ceil(K / 8)], one bit per pose and goal, set where Done succeeds. Stored apart from the rows,
        so that no observation contains the answer.
      goal_distance: float32 [C, K], metres to the nearest object of a category.
      first_cell: int32 [S], first cell of each scene, whose cells are consecutive.
      num_cells: int32 [S], number of cells of each scene.
      goals: int32 [S, K], possible goals of each scene; the first `num_goals` entries are valid.
      num_goals: int32 [S], number of possible goals of each scene.
      expert: uint8 [P, K], first action of a shortest path to each goal; None unless training imitates it or guides
        by it.
      num_scenes: int32 [], number of scenes before padding repeats them; None for S.
    """

    ahead: jax.Array
    rows: jax.Array
    success: jax.Array
    goal_distance: jax.Array
    first_cell: jax.Array
    num_cells: jax.Array
    goals: jax.Array
    num_goals: jax.Array
    expert: jax.Array | None = None
    num_scenes: jax.Array | None = None


class EnvParams(struct.PyTreeNode):
    """Environment parameters that may change without recompilation.

    Attributes:
      tables: the scenes.
      room: int32 [S], index of the layout prior of each scene's room type, see `prior_index`; read by the layout
        estimator of agents, not by the environment.
      step_limit: int32 [S], number of actions after which an episode in a scene is truncated.
      success_reward: float32 [], reward of a successful Done.
      step_reward: float32 [], reward of every other action.
    """

    tables: SceneTables
    room: jax.Array
    step_limit: jax.Array
    success_reward: jax.Array
    step_reward: jax.Array

    @property
    def max_steps_in_episode(self) -> jax.Array:
        """Largest step limit of all scenes, int32 []; trainers for gymnax evaluate with it."""
        return self.step_limit.max()


class State(struct.PyTreeNode):
    """State of one episode.

    Attributes:
      pose: int32 [], pose of the agent, numbered over all scenes.
      scene: int32 [], index of the scene.
      goal: int32 [], category to search for.
      time: int32 [], number of actions taken.
      min_goal_distance: float32 [], smallest distance to the goal so far, metres; None without reward shaping.
    """

    pose: jax.Array
    scene: jax.Array
    goal: jax.Array
    time: jax.Array
    min_goal_distance: jax.Array | None = None


class Observation(struct.PyTreeNode):
    """Observation of the agent.

    Attributes:
      row: uint8 [R], detections and ego-centric view of the pose, packed by `RowFormat`.
      goal: int32 [], category to search for.
    """

    row: jax.Array
    goal: jax.Array


@dataclasses.dataclass(frozen=True)
class ObjectNav:
    """ObjectNav task with static rules; immutable and hashable. The scenes are in `EnvParams`.

    Attributes:
      task: categories, goals and rules.
      shaping: reward per metre of new progress, by which the distance to the goal falls below its minimum so far in the
        episode.
      near_starts: probability that an episode starts near its goal, in the nearest of `NUM_START_CANDIDATES` random
        cells.
      bundled_params: parameters made together with the environment by `jaxnav.make`.
      renderers: renderers of the scenes of `jaxnav.make`; see `render`.
    """

    task: Task
    shaping: float = 0.0
    near_starts: float = 0.0
    bundled_params: EnvParams | None = dataclasses.field(default=None, compare=False, repr=False)
    renderers: SceneRenderers | None = dataclasses.field(default=None, compare=False, repr=False)

    def reset(self, key: jax.Array, params: EnvParams) -> tuple[Observation, State]:
        """Start an episode.

        The scene, the goal among those possible in the scene, the cell and the heading are drawn uniformly, but for a
        share `near_starts` of the episodes, which start in the nearest of several random cells. The camera looks
        straight ahead.

        Args:
          key: PRNG key, consumed.
          params: scenes, limits and rewards.

        Returns:
          The first observation, row uint8 [R] and goal int32 [], and the state.
        """
        tables = params.tables
        rules = self.task.rules

        # Random words: scene, goal, cell and heading; with near starts also the cells of the other candidates, then the
        # draw that decides whether the episode starts near its goal.
        num_words = 4
        if self.near_starts:
            num_words += (NUM_START_CANDIDATES - 1) + 1
        random_words = _random_words(key, num_words)

        # Scene, goal, cell and heading.
        num_scenes = tables.num_goals.shape[0] if tables.num_scenes is None else tables.num_scenes
        scene = _uniform_below(random_words[0], num_scenes)
        goal = tables.goals[scene, _uniform_below(random_words[1], tables.num_goals[scene])]
        cell = tables.first_cell[scene] + _uniform_below(random_words[2], tables.num_cells[scene])
        heading = _uniform_below(random_words[3], rules.headings)

        # A share `near_starts` of the episodes starts in the nearest of several random cells.
        if self.near_starts:
            candidate_words = random_words[4:-1]
            other_cells = tables.first_cell[scene] + _uniform_below(candidate_words, tables.num_cells[scene])
            candidate_cells = jnp.concatenate([cell[None], other_cells])
            nearest_cell = candidate_cells[tables.goal_distance[candidate_cells, goal].argmin()]
            # The upper 24 bits of a word are exact in float32.
            starts_near = (random_words[-1] >> jnp.uint32(8)).astype(jnp.float32) < self.near_starts * 2.0**24
            cell = jnp.where(starts_near, nearest_cell, cell)

        # Horizon index 0 is the first camera pitch, straight ahead; higher indices look further down.
        pose = rules.join_pose(cell, heading, 0)
        goal_distance = tables.goal_distance[cell, goal] if self.shaping else None
        state = State(pose=pose, scene=scene, goal=goal, time=jnp.zeros_like(pose), min_goal_distance=goal_distance)
        return self.observe(state, params), state

    def step(
        self, key: jax.Array, state: State, action: jax.Array | int, params: EnvParams
    ) -> tuple[Observation, State, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """Take an action, with same-step auto-reset: a new episode starts as soon as one ends.

        Args:
          key: PRNG key of the reset, consumed; without effect unless the episode ends.
          state: current state.
          action: int [], index into `jaxnav.ACTIONS`.
          params: scenes, limits and rewards.

        Returns:
          observation, state, reward, terminated, truncated, info. When the episode ends, observation and state belong
          to the new episode, everything else to the old one. `info` has `final_state` and `final_observation` (after
          the action, before a reset), `success` bool [] and `length` int32 [] (number of actions so far).
        """
        final_state, reward, terminated, truncated = self.advance(state, action, params)

        # Select the reset state where the episode has ended.
        _, reset_state = self.reset(key, params)
        has_ended = terminated | truncated
        next_state = tree_where(has_ended, reset_state, final_state)

        # The state before the reset, for bootstrapping and metrics.
        info = {
            "final_state": final_state,
            "final_observation": self.observe(final_state, params),
            "success": terminated & self.done_succeeds(final_state, params),
            "length": final_state.time,
        }
        return self.observe(next_state, params), next_state, reward, terminated, truncated, info

    def advance(
        self, state: State, action: jax.Array | int, params: EnvParams
    ) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        """Take an action, without auto-reset. A Done that fails ends the episode with `step_reward`.

        Args:
          state: current state.
          action: int [], index into `jaxnav.ACTIONS`.
          params: scenes, limits and rewards.

        Returns:
          Next state, reward float32 [], terminated bool [] (the action is Done) and truncated bool [] (the step limit
          is reached without Done).
        """
        # Move the agent; Done and blocked moves keep the pose.
        action = jnp.asarray(action)  # accept Python ints
        pose = self.next_pose(state.pose, action, params)
        next_time = state.time + 1

        # Done ends the episode, successfully or not. The step limit truncates all others.
        terminated = action == DONE
        truncated = ~terminated & (next_time >= params.step_limit[state.scene])
        success = terminated & self.done_succeeds(state, params)
        reward = jnp.where(success, params.success_reward, params.step_reward)

        # Reward shaping: pay for each metre by which the distance to the goal falls below its minimum so far.
        min_goal_distance = state.min_goal_distance
        if state.min_goal_distance is not None:
            goal_distance = params.tables.goal_distance[self.cell_of_pose(pose), state.goal]
            min_goal_distance = jnp.minimum(state.min_goal_distance, goal_distance)
            reward += self.shaping * (state.min_goal_distance - min_goal_distance)

        next_state = state.replace(pose=pose, time=next_time, min_goal_distance=min_goal_distance)
        return next_state, reward, terminated, truncated

    def observe(self, state: State, params: EnvParams) -> Observation:
        """Observation of a state: row uint8 [R] and goal int32 []."""
        return Observation(row=params.tables.rows[state.pose], goal=state.goal)

    def next_pose(self, pose: jax.Array, action: jax.Array, params: EnvParams) -> jax.Array:
        """Pose int32 [] after an action; pose and action are int32 []."""
        # The pose as three indices, int32 [] each.
        num_headings = self.task.rules.headings
        num_horizons = len(self.task.rules.horizons)
        cell, heading, horizon = self.task.rules.split_pose(pose)

        def is_action(candidate: int) -> jax.Array:
            return (action == candidate).astype(jnp.int32)

        # The table maps a blocked MoveAhead to its own cell; the horizon is clipped to its range.
        cell = jnp.where(action == MOVE_AHEAD, params.tables.ahead[cell, heading], cell)
        heading = (heading + is_action(ROTATE_RIGHT) + (num_headings - 1) * is_action(ROTATE_LEFT)) % num_headings
        horizon = jnp.clip(horizon + is_action(LOOK_DOWN) - is_action(LOOK_UP), 0, num_horizons - 1)
        return self.task.rules.join_pose(cell, heading, horizon)

    def cell_of_pose(self, pose: Any) -> Any:
        """Cell of a pose, int32 [], numbered over all scenes."""
        return self.task.rules.split_pose(pose)[0]

    def done_succeeds(self, state: State, params: EnvParams) -> jax.Array:
        """True where Done would succeed, bool [].

        Rewards and metrics use the answer; agents never observe it.
        """
        # The table packs eight goals in a byte, the lowest bit first.
        goal_byte = state.goal // 8
        goal_bit = (state.goal % 8).astype(jnp.uint8)
        return (params.tables.success[state.pose, goal_byte] >> goal_bit) & jnp.uint8(1) > 0

    def render(
        self,
        state: State,
        params: EnvParams,
        *,
        mode: Literal["rgb_array", "ansi"] = "rgb_array",
        size: int = 480,
        path: Sequence[int] = (),
    ) -> Any:
        """Draw the scene from above, with the goals, the agent and the floor in its view; on the host, with NumPy.

        Args:
          state: state of one episode, leaves [].
          params: parameters that `jaxnav.make` returned with this environment.
          mode: `rgb_array` for pixels, `ansi` for text.
          size: pixels along the longer side, at least 16.
          path: earlier poses of the episode, which are drawn as dots.

        Returns:
          uint8 [height, width, 3], +z is up; or the text.

        Raises:
          InputError: the environment was not made by `jaxnav.make`, the state is a batch, or an argument is impossible.
        """
        if self.renderers is None:
            raise InputError("render: this ObjectNav has no scenes to draw; use the environment of jaxnav.make")
        if np.ndim(state.pose):
            raise InputError(
                f"render: the state is a batch of shape {np.shape(state.pose)}; give the state of one episode, such as "
                "jax.tree.map(lambda leaf: leaf[0], state)"
            )
        if mode not in ("rgb_array", "ansi"):
            raise InputError(f"render: mode {mode!r}; choose rgb_array or ansi")
        if size < 16:
            raise InputError(f"render: size {size}; give at least 16 pixels")

        # Cells of the path, counted from the first cell of the scene.
        scene = int(state.scene)
        _, heading, _ = self.task.rules.split_pose(int(state.pose))
        poses = np.array([*path, int(state.pose)])
        cells = self.cell_of_pose(poses) - int(params.tables.first_cell[scene])
        renderer = self.renderers[scene]
        for pose, cell in zip(poses.tolist(), cells.tolist(), strict=True):
            if not 0 <= cell < renderer.num_cells:
                raise InputError(f"render: pose {pose} is of another scene; give poses of the episode of the state")
        if mode == "ansi":
            return renderer.draw_text(cells, heading, int(state.goal))
        return renderer.draw_pixels(cells, heading, int(state.goal), size)

    @property
    def name(self) -> str:
        """Name of the environment."""
        return "ObjectNav"

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories that the detector knows, [K]."""
        return self.task.categories

    @property
    def row_format(self) -> RowFormat:
        """Format of the observation rows."""
        return self.task.row_format

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        return NUM_ACTIONS

    def observation_space(self, params: EnvParams) -> Dict:
        """Return the space of observations: row uint8 [R] and goal below K."""
        row_space = Box(0, 255, (self.row_format.num_bytes,), jnp.uint8)
        return Dict({"row": row_space, "goal": Discrete(len(self.categories))})

    def action_space(self, params: EnvParams | None = None) -> Discrete:
        """Return the space of actions: whole numbers from 0 to 5."""
        return Discrete(self.num_actions)

    @property
    def default_params(self) -> EnvParams:
        """Parameters made together with the environment.

        Raises:
          ValueError: the environment was not made by `jaxnav.make`.
        """
        if self.bundled_params is None:
            raise ValueError("default_params: this ObjectNav has no bundled parameters; use those of jaxnav.make")
        return self.bundled_params


def unpack_detections(detections: jax.Array) -> jax.Array:
    """Convert bytes of detections [K, 4] to confidence, metres and apparent size, float32; zeros if not detected."""
    detection_values = (detections.astype(jnp.float32) - DETECTION_ORIGIN[None]) / DETECTION_SCALE[None]
    return jnp.where(detections[:, :1] > 0, detection_values, 0.0)


def prior_index(room_type: str) -> int:
    """Return the index of a room type's layout prior, below `NUM_PRIORS`."""
    return ROOM_TYPES.index(room_type) if room_type in ROOM_TYPES else OTHER_ROOM


def _uniform_below(random_word: jax.Array, count: jax.Array | int) -> jax.Array:
    """Map random uint32 words [...] to int32 [...] below a count; the bias of the modulo is under count / 2**32."""
    return (random_word % jnp.asarray(count, jnp.uint32)).astype(jnp.int32)


def _random_words(key: jax.Array, count: int) -> jax.Array:
    """Derive random words from a key by Murmur3's finaliser (Appleby, 2011), uint32 [count].

    Hashing replaces `jax.random` here, because same-step auto-reset draws at every step and threefry would dominate the
    time of a step. The keys themselves are random already.
    """
    # Counters, spread over all bits by the golden ratio, so that the words of one key differ.
    key_words = jax.random.key_data(key)
    mixed_words = jnp.uint32(0x9E3779B9) * jnp.arange(1, count + 1, dtype=jnp.uint32)

    # Mix in the words of the key one after the other, with one round of the finaliser each.
    for word_index in range(key_words.shape[-1]):
        mixed_words = mixed_words ^ key_words[word_index]
        for shift_bits, mix_factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
            mixed_words = (mixed_words ^ (mixed_words >> jnp.uint32(shift_bits))) * jnp.uint32(mix_factor)
        mixed_words = mixed_words ^ (mixed_words >> jnp.uint32(16))
    return mixed_words
