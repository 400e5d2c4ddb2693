"""The learner: everything that changes between two updates, and chunks of updates as one compiled call."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxnav.env.types import EnvParams
from jaxnav.policies.acting import Acting, Agent
from jaxnav.policies.policy import Params, bind, init_params
from jaxnav.policies.spec import PolicySpec
from jaxnav.training.collect import Transition, rollout
from jaxnav.training.config import Counterfactual, PPOConfig, PPOScalars
from jaxnav.training.loss import advantages, ppo_loss

_INIT, _START, _UPDATES = range(3)  # purposes of a seed's keys
_ROLLOUT, _SHUFFLE, _RESTART = range(3)  # purposes of an update's keys


class LearnerState(struct.PyTreeNode):
    """One seed of a run.

    Attributes:
      params: of the policy.
      optimizer: state of the optimizer.
      agent: the parallel episodes, [B].
      key: typed PRNG key []; update u uses `fold_in(key, u)`.
      update: int32 [], updates done.
    """

    params: Params
    optimizer: Any
    agent: Agent
    key: jax.Array
    update: jax.Array


@dataclasses.dataclass(frozen=True)
class Learner:
    """What stays the same during a run and is compiled in.

    Attributes:
      acting: how the episodes are acted.
      spec: sizes of the policy.
      config: of PPO; its scalars are traced, so only the sizes matter here.
      counterfactual: how the counterfactual branch is trained.
    """

    acting: Acting
    spec: PolicySpec
    config: PPOConfig
    counterfactual: Counterfactual

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        # An update whose gradient is not finite is skipped and counted.
        chain = optax.chain(optax.clip_by_global_norm(self.config.max_grad_norm), optax.scale_by_adam(eps=1e-5))
        return optax.apply_if_finite(chain, max_consecutive_errors=2**30)

    def init(self, key: jax.Array, params: EnvParams, priors: jax.Array) -> LearnerState:
        """A seed before its first update; the key is consumed."""
        init_key, start_key, update_key = (jax.random.fold_in(key, purpose) for purpose in (_INIT, _START, _UPDATES))
        weights = init_params(self.spec, init_key)
        agent = self.acting.start(start_key, self.config.num_envs, bind(self.spec, weights), params, priors)
        return LearnerState(
            params=weights,
            optimizer=self._optimizer.init(weights),
            agent=agent,
            key=update_key,
            update=jnp.int32(0),
        )

    def restart(self, state: LearnerState, params: EnvParams, priors: jax.Array) -> LearnerState:
        """The same seed with new episodes, for scenes other than before."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, state.update), _RESTART)
        policy = bind(self.spec, state.params)
        return state.replace(agent=self.acting.start(key, self.config.num_envs, policy, params, priors))

    def train(
        self, state: LearnerState, scalars: PPOScalars, params: EnvParams, priors: jax.Array, num_updates: int
    ) -> tuple[LearnerState, dict[str, jax.Array]]:
        """Do some updates.

        Returns:
          The state after them and float32 [] metrics: the losses' means over the updates, `success`, `return`, `length`
          (without shaping) and `truncated` averaged over the `episodes` that ended, and the number of `skipped_steps`
          of the optimizer whose gradient was not finite.
        """

        def step(state: LearnerState, _: None) -> tuple[LearnerState, dict[str, jax.Array]]:
            return self.update(state, scalars, params, priors)

        state, metrics = jax.lax.scan(step, state, None, length=num_updates)
        sums = {name: value.sum() for name, value in metrics.items()}
        episodes = sums.pop("episodes")
        ended = jnp.maximum(episodes, 1.0)
        per_episode = {name: sums.pop(name) / ended for name in ("success", "return", "length", "truncated")}
        counts = {"episodes": episodes, "skipped_steps": sums.pop("skipped_steps")}
        return state, per_episode | {name: value / num_updates for name, value in sums.items()} | counts

    def update(
        self, state: LearnerState, scalars: PPOScalars, params: EnvParams, priors: jax.Array
    ) -> tuple[LearnerState, dict[str, jax.Array]]:
        """Roll out once and learn from it for some epochs."""
        key = jax.random.fold_in(state.key, state.update)
        rollout_key, shuffle_key = (jax.random.fold_in(key, purpose) for purpose in (_ROLLOUT, _SHUFFLE))
        config, memory = self.config, state.agent.memory
        policy = bind(self.spec, state.params)
        agent, transitions, following = rollout(
            self.acting, policy, state.agent, rollout_key, config.rollout, self.counterfactual == "coin", params, priors
        )
        ended = transitions.terminated | transitions.truncated
        advantage = advantages(
            transitions.reward, transitions.value, following, ended, scalars.gamma, scalars.gae_lambda
        )
        rate = scalars.learning_rate * (1.0 - state.update.astype(jnp.float32) / scalars.num_updates)

        def loss(weights: Params, part: tuple[Any, ...]) -> tuple[jax.Array, dict[str, jax.Array]]:
            transitions, memory, advantage = part
            policy = bind(self.spec, weights)
            distil = self.counterfactual == "distil"
            return ppo_loss(policy, transitions, memory, advantage, params, scalars, distil)

        def learn(carry: tuple[Params, Any], part: tuple[Any, ...]) -> tuple[tuple[Params, Any], dict[str, jax.Array]]:
            weights, optimizer = carry
            gradient, parts = jax.grad(loss, has_aux=True)(weights, part)
            with jax.numpy_dtype_promotion("standard"):  # optax counts in int32 beside float32
                step, optimizer = self._optimizer.update(gradient, optimizer, weights)
            weights = jax.tree.map(lambda w, s: w - rate * s, weights, step)
            return (weights, optimizer), parts | {"gradient_norm": optax.tree.norm(gradient)}

        def epoch(carry: tuple[Params, Any], key: jax.Array) -> tuple[tuple[Params, Any], dict[str, jax.Array]]:
            order = block_order(key, config.num_envs, config.minibatches)
            in_time = regroup((transitions, advantage), order, axis=1)
            return jax.lax.scan(learn, carry, (in_time[0], regroup(memory, order, axis=0), in_time[1]))

        keys = jax.random.split(shuffle_key, config.epochs)
        (weights, optimizer), metrics = jax.lax.scan(epoch, (state.params, state.optimizer), keys)
        metrics = {name: value.mean() for name, value in metrics.items()} | _episode_sums(transitions, ended, params)
        skipped = optimizer.total_notfinite - state.optimizer.total_notfinite
        metrics["skipped_steps"] = skipped.astype(jnp.float32)
        state = state.replace(params=weights, optimizer=optimizer, agent=agent, update=state.update + 1)
        return state, metrics


def block_order(key: jax.Array, episodes: int, minibatches: int) -> jax.Array:
    """Which episode each block of `minibatches` neighbours gives to which minibatch: int32 [blocks, minibatches].

    Every minibatch gets one episode of every block, so that no device needs the episodes of another.
    """
    rows = jnp.broadcast_to(jnp.arange(minibatches), (episodes // minibatches, minibatches))
    return jax.random.permutation(key, rows, axis=1, independent=True)


def regroup(tree: Any, order: jax.Array, axis: int) -> Any:
    """Leaves whose `axis` holds the episodes, cut into minibatches: [..., B, ...] -> [M, ..., B / M, ...]."""

    def cut(leaf: jax.Array) -> jax.Array:
        blocks = leaf.reshape(*leaf.shape[:axis], *order.shape, *leaf.shape[axis + 1 :])
        index = jnp.expand_dims(order, [*range(axis), *range(axis + 2, blocks.ndim)])
        return jnp.moveaxis(jnp.take_along_axis(blocks, index, axis + 1), axis + 1, 0)

    return jax.tree.map(cut, tree)


def _episode_sums(transitions: Transition, ended: jax.Array, params: EnvParams) -> dict[str, jax.Array]:
    """Sums over the episodes that ended in a rollout, float32 [] each."""

    def total(values: jax.Array) -> jax.Array:
        return jnp.where(ended, values.astype(jnp.float32), 0.0).sum()

    success, length = total(transitions.success), total(transitions.length)
    return {
        "episodes": total(ended),
        "success": success,
        "length": length,
        "truncated": total(transitions.truncated),
        # Every step but a successful Done costs the same, so the return (without shaping) follows from both.
        "return": params.success_reward * success + params.step_reward * (length - success),
    }
