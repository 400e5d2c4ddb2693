"""The two arms of a run: the method alone, and the method with the layout estimator."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.cli.config import RunConfig
from jaxnav.env.objectnav import ObjectNav
from jaxnav.env.types import EnvParams
from jaxnav.policies.acting import Acting
from jaxnav.policies.spec import PolicySpec
from jaxnav.training.learner import Learner, LearnerState

#: The arms in the order of the tables. The first has no layout weights and no counterfactual branch.
ARMS = ("baseline", "layout")


def policy_spec(config: RunConfig, env: ObjectNav) -> PolicySpec:
    """Sizes of a run's policies."""
    return PolicySpec(method=config.method, num_categories=len(env.categories), sizes=config.sizes)


class Arm:
    """N seeds of one arm, trained in one compiled call per chunk."""

    def __init__(self, name: str, config: RunConfig, env: ObjectNav, params: EnvParams, priors: jax.Array) -> None:
        layout = name == "layout"
        self.learner = Learner(
            acting=Acting(env, config.layout.setting if layout else None),
            spec=policy_spec(config, env),
            config=config.ppo,
            counterfactual=config.counterfactual if layout else "none",
        )
        self._scalars = config.ppo.scalars(config.total_updates * config.ppo.num_envs * config.ppo.rollout)
        self._keys = jax.vmap(functools.partial(jax.random.fold_in, jax.random.key(config.seed)))(
            jnp.arange(config.seeds)
        )
        self._data = (params, priors)
        self._chunk = config.chunk
        self._train = jax.jit(self._train_seeds, donate_argnums=0)
        self._init = jax.jit(self._init_seeds)

    def init(self) -> LearnerState:
        """All seeds before their first update, leaves [N, ...]."""
        return self._init(self._keys, *self._data)

    def train(self, states: LearnerState) -> tuple[LearnerState, dict[str, jax.Array]]:
        """One chunk of updates of every seed; metrics float32 [N] each. The states are donated."""
        return self._train(states, self._scalars, *self._data)

    def _init_seeds(self, keys: jax.Array, params: EnvParams, priors: jax.Array) -> LearnerState:
        return jax.lax.map(lambda key: self.learner.init(key, params, priors), keys)

    def _train_seeds(self, states: LearnerState, scalars: Any, params: EnvParams, priors: jax.Array) -> Any:
        return jax.lax.map(lambda state: self.learner.train(state, scalars, params, priors, self._chunk), states)
