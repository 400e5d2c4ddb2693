"""One ObjectNav episode as pure functions.

Reset, step and observe are integer arithmetic and gathers. Written for a single episode; batch with `jax.vmap`. The
rules are those of docs/environment.md.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxnav.env.spaces import Box, Dict, Discrete
from jaxnav.env.types import EnvParams, Observation, State, StepResult
from jaxnav.scenes.categories import ROOM_TYPES
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import DONE, LOOK_DOWN, LOOK_UP, MOVE_AHEAD, NUM_ACTIONS, ROTATE_LEFT, ROTATE_RIGHT, Task

#: Index of the layout prior that all room types outside `ROOM_TYPES` share, and the number of priors.
OTHER_ROOM = len(ROOM_TYPES)
NUM_PRIORS = OTHER_ROOM + 1
#: Cells of which an episode that starts near its goal takes the nearest.
CANDIDATES = 8


def prior_index(room_type: str) -> int:
    """Return the index of a room type's layout prior."""
    return ROOM_TYPES.index(room_type) if room_type in ROOM_TYPES else OTHER_ROOM


@dataclasses.dataclass(frozen=True)
class ObjectNav:
    """Hold an environment; hashable.

    The interface is that of gymnax 1.0.

    Attributes:
      task: what is asked of the agent.
      shaping: reward for every metre that the agent comes nearer to its goal than before in the episode (by
        `goal_distance`), in training.
      near_starts: probability that an episode starts in the nearest to its goal of several random cells, in training.
      made_with: parameters that `jaxnav.make` made with it.
    """

    task: Task
    shaping: float = 0.0
    near_starts: float = 0.0
    made_with: EnvParams | None = dataclasses.field(default=None, compare=False, repr=False)

    @property
    def name(self) -> str:
        """Return the name of the environment."""
        return "ObjectNav"

    @property
    def default_params(self) -> EnvParams:
        """Return the parameters that `jaxnav.make` made with it.

        Raises:
          ValueError: it was not made by `jaxnav.make`.
        """
        if self.made_with is None:
            raise ValueError("default_params: this environment was built by hand; jaxnav.make returns both")
        return self.made_with

    def observation_space(self, params: EnvParams) -> Dict:
        """Return the space of observations."""
        row = Box(0, 255, (self.row_format.num_bytes,), jnp.uint8)
        return Dict({"row": row, "goal": Discrete(len(self.categories))})

    def action_space(self, params: EnvParams | None = None) -> Discrete:
        """Return the space of actions."""
        return Discrete(self.num_actions)

    @property
    def categories(self) -> tuple[str, ...]:
        """Return the names of what can be detected, [K]."""
        return self.task.categories

    @property
    def row_format(self) -> RowFormat:
        """Return how an observation row is packed."""
        return RowFormat(len(self.categories))

    @property
    def num_actions(self) -> int:
        """Return the size of the action space."""
        return NUM_ACTIONS

    def reset(self, key: jax.Array, params: EnvParams) -> tuple[Observation, State]:
        """Start an episode.

        Scene, goal among its possible ones, cell and heading are each uniform; the horizon is 0. With
        `near_starts` some cells are the nearest to the goal of `CANDIDATES` uniform ones.

        Args:
          key: consumed.
          params: the bank and its limits.
        """
        tables = params.tables
        bits = _words(key, 4 + CANDIDATES * bool(self.near_starts))

        def below(i: int, count: jax.Array) -> jax.Array:
            # Modulo of 32 random bits: the bias is under count / 2**32.
            return (bits[i] % count.astype(jnp.uint32)).astype(jnp.int32)

        scene = below(0, jnp.asarray(tables.num_goals.shape[0], jnp.int32))
        goal = tables.goals[scene, below(1, tables.num_goals[scene])]
        rules = self.task.rules
        heading = below(3, jnp.asarray(rules.headings, jnp.int32))
        cell = tables.first_cell[scene] + below(2, tables.num_cells[scene])
        if self.near_starts:
            others = [below(4 + i, tables.num_cells[scene]) for i in range(CANDIDATES - 1)]
            candidates = jnp.stack([cell, *(tables.first_cell[scene] + other for other in others)])
            nearest = candidates[tables.goal_distance[candidates, goal].argmin()]
            near = (bits[-1] >> jnp.uint32(8)).astype(jnp.float32) < self.near_starts * 2.0**24
            cell = jnp.where(near, nearest, cell)
        pose = (cell * rules.headings + heading) * len(rules.horizons)
        nearest = tables.goal_distance[cell, goal] if self.shaping else None
        state = State(pose=pose, scene=scene, goal=goal, time=jnp.zeros_like(pose), nearest=nearest)
        return self.observe(state, params), state

    def observe(self, state: State, params: EnvParams) -> Observation:
        """Return what the agent perceives in a state."""
        return Observation(row=params.tables.rows[state.pose], goal=state.goal)

    def after(self, pose: jax.Array, action: jax.Array, params: EnvParams) -> jax.Array:
        """Return the pose that an action leads to.

        Both are int32 [].
        """
        headings, horizons = self.task.rules.headings, len(self.task.rules.horizons)
        cell, heading, horizon = self.task.rules.split(pose)

        def when(chosen: int) -> jax.Array:
            return (action == chosen).astype(jnp.int32)

        cell = jnp.where(action == MOVE_AHEAD, params.tables.ahead[cell, heading], cell)
        heading = (heading + when(ROTATE_RIGHT) + (headings - 1) * when(ROTATE_LEFT)) % headings
        horizon = jnp.clip(horizon + when(LOOK_DOWN) - when(LOOK_UP), 0, horizons - 1)
        return (cell * headings + heading) * horizons + horizon

    def cell(self, pose: jax.Array) -> jax.Array:
        """Return the global cell int32 [] of a pose."""
        return self.task.rules.split(pose)[0]

    def succeeds(self, state: State, params: EnvParams) -> jax.Array:
        """Return whether Done would succeed here, bool [].

        Rewards and metrics read it; agents cannot.
        """
        byte, bit = state.goal // 8, (state.goal % 8).astype(jnp.uint8)
        return (params.tables.success[state.pose, byte] >> bit) & jnp.uint8(1) > 0

    def advance(
        self, state: State, action: jax.Array | int, params: EnvParams
    ) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        """Take an action, without reset.

        Args:
          state: the state.
          action: int [], 0 to 5.
          params: the bank and its limits.

        Returns:
          The next state, reward float32 [], terminated bool [] (Done was chosen) and truncated bool [] (the step limit
          is reached without Done).
        """
        action = jnp.asarray(action)  # a number of Python's too
        done = action == DONE
        time = state.time + 1
        reward = jnp.where(done & self.succeeds(state, params), params.success_reward, params.step_reward)
        truncated = ~done & (time >= params.step_limit[state.scene])
        pose = self.after(state.pose, action, params)
        nearest = state.nearest
        if nearest is not None:
            before, nearest = nearest, jnp.minimum(nearest, params.tables.goal_distance[self.cell(pose), state.goal])
            reward += self.shaping * (before - nearest)
        return state.replace(pose=pose, time=time, nearest=nearest), reward, done, truncated

    def step(self, key: jax.Array, state: State, action: jax.Array | int, params: EnvParams) -> StepResult:
        """Take an action, with same-step auto-reset.

        An episode that ends is followed by a new one at once.

        Args:
          key: consumed; used only if the episode ends.
          state: the state.
          action: int [], 0 to 5.
          params: the bank and its limits.

        Returns:
          observation, state, reward, terminated, truncated, info. After an ending, observation and state are those of
          the new episode; `info` is about the episode that the action belongs to: `final_state` and
          `final_observation` after the action, `success` bool [] and `length` int32 [] (actions so far).
        """
        last, reward, terminated, truncated = self.advance(state, action, params)
        _, fresh = self.reset(key, params)
        ended = terminated | truncated
        state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, last)
        info = {
            "final_state": last,
            "final_observation": self.observe(last, params),
            "success": terminated & self.succeeds(last, params),
            "length": last.time,
        }
        return self.observe(state, params), state, reward, terminated, truncated, info


def _words(key: jax.Array, count: int) -> jax.Array:
    """Return random words uint32 [count] of a key.

    They are its words through Murmur3's finaliser (Appleby, 2011). A key that is split off is random already; a
    stronger generator would take most of the time of a step, and most steps have no use for it.
    """
    words = jax.random.key_data(key)
    mixed = jnp.uint32(0x9E3779B9) * jnp.arange(1, count + 1, dtype=jnp.uint32)
    for i in range(words.shape[-1]):
        mixed = mixed ^ words[i]
        for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
            mixed = (mixed ^ (mixed >> jnp.uint32(shift))) * jnp.uint32(factor)
        mixed = mixed ^ (mixed >> jnp.uint32(16))
    return mixed
