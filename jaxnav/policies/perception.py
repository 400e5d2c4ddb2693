"""What an agent makes of its views without parameters: belief, map and note of one episode."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.env.types import Observation
from jaxnav.layout import LayoutEstimator, LayoutState, Setting
from jaxnav.policies.methods import Knowledge, Percept, find_method
from jaxnav.policies.spatial_memory import Explored, SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat


class Perceived(NamedTuple):
    """Hold what the views of an episode have left.

    Attributes:
      layout: the belief about the layout; None where the policy does not use it.
      explored: the map of the spatial memory; None without one.
      note: of the method's tracker; None without one.
    """

    layout: LayoutState | None
    explored: Explored | None
    note: Any


class View(NamedTuple):
    """Hold what a policy gets at one step.

    Attributes:
      observation: row and goal.
      weights: float32 [K], the layout's weights for the goal (eq. 7); ones without the layout.
      reading: what the tracker read of its note; None without one.
      surroundings: uint8 [M], what is known of the cells around the agent; None without a spatial memory.
    """

    observation: Observation
    weights: jax.Array
    reading: Any
    surroundings: jax.Array | None


@dataclasses.dataclass(frozen=True)
class Perception:
    """Perceive one episode; hashable.

    Every view is taken in once, the first one included. All functions take one episode; callers `vmap`.

    Attributes:
      row_format: of the observations.
      spec: of the policy; None where actions are given.
      setting: of the layout estimator; None leaves the layout out.
    """

    row_format: RowFormat
    spec: PolicySpec | None = None
    setting: Setting | None = None

    def init(self, knowledge: Knowledge | None, room: jax.Array) -> Perceived:
        """Return what there is before anything is seen.

        Args:
          knowledge: what was learned before training; None where neither layout nor tracker is used.
          room: int32 [], index of the room type's layout prior.
        """
        estimator, spatial = self._estimator(knowledge, room), self._spatial_memory
        layout = None if estimator is None else estimator.init()
        explored = None if spatial is None else spatial.init()
        return Perceived(layout, explored, None if self.tracker is None else self.tracker.init(knowledge))

    def update(self, perceived: Perceived, percept: Percept, knowledge: Any, room: jax.Array) -> Perceived:
        """Take in one view.

        Args:
          perceived: before it.
          percept: the view, and how the agent came to it.
          knowledge, room: as in `init`.
        """
        layout, explored, note = perceived
        estimator, spatial = self._estimator(knowledge, room), self._spatial_memory
        if estimator is not None and layout is not None:
            layout = estimator.update(layout, self.row_format.presence(percept.row), percept.goal)
        if spatial is not None and explored is not None:
            explored = spatial.update(explored, percept.row, percept.heading, percept.moved, self.row_format)
        if self.tracker is not None:
            note = self.tracker.update(note, knowledge, percept)
        return Perceived(layout, explored, note)

    def view(self, perceived: Perceived, observation: Observation, knowledge: Any) -> View:
        """Return what the policy gets."""
        layout, explored, note = perceived
        weights = jnp.ones(self.row_format.num_categories)
        if layout is not None:
            weights = LayoutEstimator.goal_weights(layout, observation.goal)
        reading = None if self.tracker is None else self.tracker.read(note, knowledge, observation.goal)
        spatial = self._spatial_memory
        surroundings = None if spatial is None or explored is None else spatial.read(explored)
        return View(observation, weights, reading, surroundings)

    @property
    def uses_odometry(self) -> bool:
        """Return whether compass heading and motion are needed."""
        return self.tracker is not None or self._spatial_memory is not None

    @property
    def tracker(self) -> Any:
        """Return the tracker of the policy's method; None without one."""
        return None if self.spec is None else find_method(self.spec.method).tracker

    @property
    def _spatial_memory(self) -> SpatialMemory | None:
        return None if self.spec is None else self.spec.spatial_memory

    def _estimator(self, knowledge: Any, room: jax.Array) -> LayoutEstimator | None:
        if self.setting is None:
            return None
        signs = jax.tree.map(lambda leaf: leaf[room], knowledge.signs)
        return LayoutEstimator(knowledge.layout[room], self.setting, signs)
