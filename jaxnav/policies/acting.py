"""Acting in parallel episodes: the policy, its memory and the belief about the layout, step by step."""

import dataclasses
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams, Observation, State
from jaxnav.layout import LayoutEstimator, LayoutState, Setting
from jaxnav.policies.pathways import Memory
from jaxnav.policies.policy import Policy

Tree = TypeVar("Tree")


class Agent(NamedTuple):
    """B parallel episodes.

    Attributes:
      state: the episodes, leaves [B].
      layout: the beliefs about their layouts, leaves [B, ...]; None where the policy does not use them.
      memory: the recurrent memories, leaves [B, ...].
    """

    state: State
    layout: LayoutState | None
    memory: Memory


@dataclasses.dataclass(frozen=True)
class Acting:
    """How episodes are acted: the environment, and whether and how the layout is estimated.

    Attributes:
      env: the environment.
      setting: the layout estimator's setting; None leaves the layout out (its weights are then ones).
    """

    env: ObjectNav
    setting: str | Setting | None

    def observe(self, agent: Agent, params: EnvParams) -> tuple[Observation, jax.Array]:
        """What the episodes perceive, and the layout's weights float32 [B, K] for their goals."""
        observation = jax.vmap(self.env.observe, (0, None))(agent.state, params)
        if agent.layout is None:
            return observation, jnp.ones((*agent.state.goal.shape, len(self.env.categories)))
        return observation, jax.vmap(LayoutEstimator.goal_weights)(agent.layout, agent.state.goal)

    def gap(self, agent: Agent) -> jax.Array:
        """The layout gaps D float32 [B]; 0 where the layout is left out."""
        return jnp.zeros(agent.state.goal.shape) if agent.layout is None else agent.layout.gap

    def believe(
        self, layout: LayoutState | None, state: State, params: EnvParams, priors: jax.Array
    ) -> LayoutState | None:
        """Update the beliefs with what is detected in the current states; priors float32 [rooms, K, K]."""
        setting = self.setting
        if setting is None or layout is None:
            return None

        def one(layout: LayoutState, state: State) -> LayoutState:
            presence = self.env.row_format.presence(params.tables.rows[state.pose])
            return LayoutEstimator(priors[params.room[state.scene]], setting).update(layout, presence)

        return jax.vmap(one)(layout, state)

    def first_belief(self, state: State, params: EnvParams, priors: jax.Array) -> LayoutState | None:
        """Beliefs before anything is seen."""
        setting = self.setting
        if setting is None:
            return None
        return jax.vmap(lambda s: LayoutEstimator(priors[params.room[s.scene]], setting).init())(state)

    def start(self, key: jax.Array, num_envs: int, policy: Policy, params: EnvParams, priors: jax.Array) -> Agent:
        """Start B episodes at random; the key is consumed."""
        _, state = jax.vmap(self.env.reset, (0, None))(jax.random.split(key, num_envs), params)
        return self.begin(state, policy, params, priors)

    def begin(self, state: State, policy: Policy, params: EnvParams, priors: jax.Array) -> Agent:
        """Start B episodes in these states, leaves [B], with the first view taken in."""
        layout = self.believe(self.first_belief(state, params, priors), state, params, priors)
        return Agent(state=state, layout=layout, memory=policy.initial_memory(state.pose.shape))


def select(condition: jax.Array, yes: Tree, no: Tree) -> Tree:
    """Per episode, the leaves [B, ...] of one tree or of the other."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(condition.reshape(condition.shape + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, yes, no)
