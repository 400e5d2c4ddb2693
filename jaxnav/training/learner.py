"""The learner: collect, loss and apply as chunks of updates in one compiled call."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import PartitionSpec

from jaxnav.env.types import EnvParams
from jaxnav.policies.acting import Acting, Agent, carried
from jaxnav.policies.methods import Knowledge, Method, Stage
from jaxnav.policies.policy import Params, init_params
from jaxnav.training.apply import apply_gradient, make_optimizer, renewed
from jaxnav.training.collect import Rollout, Transition, collect, draw_coins
from jaxnav.training.config import Counterfactual, PPOConfig, PPOScalars
from jaxnav.training.loss import advantages, ppo_loss, replay
from jaxnav.training.shares import EPISODES, averaged

_INIT, _START, _UPDATES = range(3)  # purposes of a seed's keys
_ROLLOUT, _SHUFFLE, _RESTART = range(3)  # purposes of an update's keys
_EXPERIENCE = 2**31 - 1  # purpose of a start's key; the numbers below are its episodes'

Metrics = dict[str, jax.Array]


class Kept(struct.PyTreeNode):
    """Hold the best policy of a seed so far.

    Attributes:
      params: of the policy.
      score: float32 [], see `Learner.keep`; -1 before anything was measured.
      update: int32 [], updates done when it was measured.
    """

    params: Params
    score: jax.Array
    update: jax.Array


class LearnerState(struct.PyTreeNode):
    """Hold one seed of a run.

    Attributes:
      params: of the policy.
      kept: the policy to export where policies are measured while they are trained.
      optimizer: state of the optimizer.
      agent: the parallel episodes, [B].
      key: typed PRNG key []; update u uses `fold_in(key, u)`.
      update: int32 [], updates done.
    """

    params: Params
    kept: Kept
    optimizer: Any
    agent: Agent
    key: jax.Array
    update: jax.Array


@dataclasses.dataclass(frozen=True)
class Learner:
    """Hold what is compiled in during a run.

    Attributes:
      acting: how the episodes are acted.
      config: of PPO; its scalars are traced where updates are done, so only the sizes matter there.
      counterfactual: how the counterfactual branch is trained.
      stage: of training.
    """

    acting: Acting
    config: PPOConfig
    counterfactual: Counterfactual
    stage: Stage = Stage()

    def init(self, key: jax.Array, params: EnvParams, knowledge: Knowledge) -> LearnerState:
        """Start a seed; the key is consumed."""
        init_key, start_key, update_key = (jax.random.fold_in(key, purpose) for purpose in (_INIT, _START, _UPDATES))
        assert self.acting.spec is not None
        weights = init_params(self.acting.spec, init_key)
        agent = self._start(weights, start_key, params, knowledge)
        optimizer = make_optimizer(self.config).init(weights)
        kept = Kept(params=weights, score=jnp.float32(-1.0), update=jnp.int32(0))
        return LearnerState(weights, kept, optimizer, agent, update_key, jnp.int32(0))

    def restart(self, state: LearnerState, params: EnvParams, knowledge: Knowledge) -> LearnerState:
        """Give a seed new episodes, in scenes other than before."""
        key = jax.random.fold_in(jax.random.fold_in(state.key, state.update), _RESTART)
        return state.replace(agent=self._start(state.params, key, params, knowledge))

    def keep(self, state: LearnerState, score: jax.Array) -> LearnerState:
        """Keep the present policy if none scored higher; the score is float32 []."""
        present = Kept(state.params, score, state.update)
        better = score >= state.kept.score
        return state.replace(kept=jax.tree.map(lambda new, old: jnp.where(better, new, old), present, state.kept))

    def train(
        self, state: LearnerState, scalars: PPOScalars, params: EnvParams, knowledge: Knowledge, num_updates: int
    ) -> tuple[LearnerState, Metrics]:
        """Do some updates.

        Returns:
          The state after them and float32 [] metrics: the losses' means over the updates, `success`, `return`, `length`
          (without shaping) and `truncated` averaged over the `episodes` that ended, and the number of `skipped_steps`
          of the optimizer whose gradient was not finite.
        """

        def step(state: LearnerState, _: None) -> tuple[LearnerState, Metrics]:
            return self.update(state, scalars, params, knowledge)

        begins = state.update.astype(jnp.float32) == scalars.begin
        state = state.replace(optimizer=renewed(self.config, state.optimizer, state.params, begins))
        state, metrics = jax.lax.scan(step, state, None, length=num_updates)
        sums = {name: value.sum() for name, value in metrics.items()}
        episodes = sums.pop("episodes")
        ended = jnp.maximum(episodes, 1.0)
        per_episode = {name: sums.pop(name) / ended for name in ("success", "return", "length", "truncated")}
        counts = {"episodes": episodes, "skipped_steps": sums.pop("skipped_steps")}
        return state, per_episode | {name: value / num_updates for name, value in sums.items()} | counts

    def update(
        self, state: LearnerState, scalars: PPOScalars, params: EnvParams, knowledge: Knowledge
    ) -> tuple[LearnerState, Metrics]:
        """Collect once and learn from it for some epochs."""
        key = jax.random.fold_in(state.key, state.update)
        rollout_key, shuffle_key = (jax.random.fold_in(key, purpose) for purpose in (_ROLLOUT, _SHUFFLE))
        acting, coin = self._acting, self.counterfactual == "coin"
        share = 0.0 if self.stage.alone else scalars.experience
        agent, fast = state.agent, carried(state.agent).fast
        if not self.stage.adapts:  # fast weights, which may be large, wait for a stage that has a use for them
            agent = _with_fast(agent, None)
        every_step = self.config.experience_drawn == "step"
        arguments = agent, rollout_key, self.config.rollout, coin, params, knowledge, share, every_step
        agent, rollout = collect(acting, acting.bind(state.params), *arguments)
        if not self.stage.adapts:
            agent = _with_fast(agent, fast)
        (weights, optimizer), metrics = self._learn(state, rollout, shuffle_key, scalars, params)
        metrics = {name: value.mean() for name, value in metrics.items()} | _episode_sums(rollout.transitions, params)
        skipped = optimizer.total_notfinite - state.optimizer.total_notfinite
        metrics["skipped_steps"] = skipped.astype(jnp.float32)
        return state.replace(params=weights, optimizer=optimizer, agent=agent, update=state.update + 1), metrics

    def _learn(
        self, state: LearnerState, rollout: Rollout, key: jax.Array, scalars: PPOScalars, params: EnvParams
    ) -> tuple[tuple[Params, Any], Metrics]:
        """Take a gradient step for every minibatch of every epoch."""
        transitions, config = rollout.transitions, self.config
        returns = transitions.reward, transitions.value, rollout.next_value, transitions.ended
        advantage = advantages(*returns, scalars.gamma, scalars.gae_lambda, transitions.due)
        done = (state.update.astype(jnp.float32) - scalars.begin) / scalars.num_updates
        rate = scalars.learning_rate * (1.0 - done)
        scalars = scalars.replace(entropy=scalars.entropy + done * (scalars.final_entropy - scalars.entropy))

        whole, in_time = PartitionSpec(), PartitionSpec(None, EPISODES)
        places = whole, (in_time, PartitionSpec(EPISODES), in_time), whole, whole
        differentiate = averaged(jax.grad(self._loss, has_aux=True), *places)

        def learn(carry: tuple[Params, Any], part: tuple[Any, ...]) -> tuple[tuple[Params, Any], Metrics]:
            gradient, parts = differentiate(carry[0], part, params, scalars)
            carry = apply_gradient(config, *carry, gradient, rate, self.stage.rates)
            return carry, parts | {"gradient_norm": optax.tree.norm(gradient)}

        def epoch(carry: tuple[Params, Any], key: jax.Array) -> tuple[tuple[Params, Any], Metrics]:
            order = block_order(key, config.num_envs, config.minibatches)
            steps, signal = regroup((transitions, advantage), order, axis=1)
            return jax.lax.scan(learn, carry, (steps, regroup(rollout.memory, order, axis=0), signal))

        return jax.lax.scan(epoch, (state.params, state.optimizer), jax.random.split(key, config.epochs))

    def _loss(
        self, weights: Params, part: tuple[Any, ...], params: EnvParams, scalars: PPOScalars
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of a minibatch (transitions, memory, advantage)."""
        transitions, memory, advantage = part
        replayed = replay(self._acting.bind(weights), transitions, memory, params)
        loss = self.stage.loss or ppo_loss
        return loss(replayed, advantage, scalars, self.counterfactual == "distil", self._method)

    def _start(self, weights: Params, key: jax.Array, params: EnvParams, knowledge: Knowledge) -> Agent:
        share = 0.0 if self.stage.alone else self.config.experience
        memory = self.acting.bind(weights).initial_memory((self.config.num_envs,))
        memory = draw_coins(memory, True, jax.random.fold_in(key, _EXPERIENCE), share)
        return self.acting.start(key, self.config.num_envs, memory, knowledge, params)

    @property
    def _acting(self) -> Acting:
        """Return how the stage's episodes are acted."""
        return dataclasses.replace(self.acting, inner_steps=None if self.stage.adapts else 0)

    @property
    def _method(self) -> Method:
        assert self.acting.method is not None
        return self.acting.method


def block_order(key: jax.Array, episodes: int, minibatches: int) -> jax.Array:
    """Draw the minibatch of every episode, block by block.

    Every minibatch gets one episode of every block, so that no device needs the episodes of another.

    Returns:
      int32 [blocks, minibatches], blocks of `minibatches` neighbours.
    """
    rows = jnp.broadcast_to(jnp.arange(minibatches), (episodes // minibatches, minibatches))
    return jax.random.permutation(key, rows, axis=1, independent=True)


def regroup(tree: Any, order: jax.Array, axis: int) -> Any:
    """Divide leaves into minibatches.

    [..., B, ...] -> [M, ..., B / M, ...].

    `axis` is that of the episodes.
    """

    def divide(leaf: jax.Array) -> jax.Array:
        blocks = leaf.reshape(*leaf.shape[:axis], *order.shape, *leaf.shape[axis + 1 :])
        index = jnp.expand_dims(order, [*range(axis), *range(axis + 2, blocks.ndim)])
        return jnp.moveaxis(jnp.take_along_axis(blocks, index, axis + 1), axis + 1, 0)

    return jax.tree.map(divide, tree)


def _with_fast(agent: Agent, fast: Any) -> Agent:
    """Give agents other fast weights."""
    return agent._replace(memory=carried(agent)._replace(fast=fast))


def _episode_sums(transitions: Transition, params: EnvParams) -> dict[str, jax.Array]:
    """Return sums over the episodes that ended, float32 [] each."""
    ended = transitions.ended
    values = ended, transitions.success, transitions.length, transitions.truncated
    table = jnp.stack([value.astype(jnp.float32) for value in values])  # which devices add as one array
    episodes, success, length, truncated = jnp.where(ended, table, 0.0).sum(axis=(1, 2))
    return {
        "episodes": episodes,
        "success": success,
        "length": length,
        "truncated": truncated,
        # Every step but a successful Done costs the same, so the return (without shaping) follows from both.
        "return": params.success_reward * success + params.step_reward * (length - success),
    }
