"""Recurrent PPO in purejaxrl's style as a process.

Started as `python benchmarks/_purejaxrl_worker.py EPOCHS MINIBATCHES UPDATES`. The code follows purejaxrl: everything
in one jitted function, a flax.linen cell scanned over time with resets, observations stored in the trajectory as
float32 vectors, minibatches of whole sequences. The network is jaxnav's.
"""

import functools
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from _trainer_worker import Adapter, EpisodeSlot, Torso, make_action_head, serve, to_vector
from flax import linen as nn
from flax.training.train_state import TrainState

from jaxnav.env.make import make
from jaxnav.policies.methods import find_method
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.training.config import PPOConfig

SPEC = PolicySpec(find_method("org"))


class ScannedGRU(nn.Module):
    """Recurrent cell over time, reset at the start of each episode."""

    @functools.partial(nn.scan, variable_broadcast="params", split_rngs={"params": False})
    @nn.compact
    def __call__(self, hidden: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        features, starts = inputs
        hidden = jnp.where(starts[:, None], 0.0, hidden)
        return nn.GRUCell(SPEC.sizes.hidden)(hidden, features)


class ActorCritic(nn.Module):
    @nn.compact
    def __call__(self, hidden: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
        """Return hidden state [B, H], logits [T, B, A] and values [T, B].

        Args:
          hidden: state before the first step, [B, H].
          inputs: observations [T, B, N], and where episodes start, bool [T, B].
        """
        obs, starts = inputs
        hidden, outputs = ScannedGRU()(hidden, (Torso(SPEC)(obs), starts))
        return hidden, make_action_head()(outputs), nn.Dense(1)(outputs)[..., 0]


class Transition(NamedTuple):
    obs: jax.Array
    start: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    done: jax.Array


class Runner(NamedTuple):
    train: TrainState
    slots: EpisodeSlot
    obs: jax.Array
    start: jax.Array
    hidden: jax.Array
    key: jax.Array


def log_prob_of(logits: jax.Array, action: jax.Array) -> jax.Array:
    return jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], axis=-1)[..., 0]


def make_train(config: PPOConfig, env: Adapter, params: Any, network: Any, num_updates: int):
    """Return a function that trains for some updates."""

    def env_step(runner: Runner, _: None) -> tuple[Runner, Transition]:
        key, action_key, step_key = jax.random.split(runner.key, 3)
        hidden, logits, value = network.apply(
            runner.train.params, runner.hidden, (runner.obs[None], runner.start[None])
        )
        action = jax.random.categorical(action_key, logits[0])
        keys = jax.random.split(step_key, config.num_envs)
        obs, slots, reward, done = jax.vmap(env.step, (0, 0, 0, None))(keys, runner.slots, action, params)[:4]
        log_prob = log_prob_of(logits[0], action)
        transition = Transition(runner.obs, runner.start, action, log_prob, value[0], reward, done)
        return Runner(runner.train, slots, obs, done, hidden, key), transition

    def estimate_advantages(trajectory: Transition, last_value: jax.Array) -> jax.Array:
        def step_back(carry, step: Transition):
            advantage, next_value = carry
            continues = 1.0 - step.done
            delta = step.reward + config.gamma * next_value * continues - step.value
            advantage = delta + config.gamma * config.gae_lambda * continues * advantage
            return (advantage, step.value), advantage

        start = (jnp.zeros_like(last_value), last_value)
        return jax.lax.scan(step_back, start, trajectory, reverse=True)[1]

    def loss(weights, hidden, trajectory: Transition, advantage: jax.Array) -> jax.Array:
        _, logits, value = network.apply(weights, hidden, (trajectory.obs, trajectory.start))
        log_probs = jax.nn.log_softmax(logits)
        ratio = jnp.exp(log_prob_of(logits, trajectory.action) - trajectory.log_prob)
        normalized = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        clipped_ratio = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -jnp.minimum(ratio * normalized, clipped_ratio * normalized).mean()
        value_loss = 0.5 * jnp.square(value - (advantage + trajectory.value)).mean()
        entropy = -(jnp.exp(log_probs) * log_probs).sum(axis=-1).mean()
        return policy_loss + config.value * value_loss - config.entropy * entropy

    def update_minibatch(train: TrainState, batch) -> tuple[TrainState, None]:
        return train.apply_gradients(grads=jax.grad(loss)(train.params, *batch)), None

    def update(runner: Runner, _: None) -> tuple[Runner, None]:
        # Collect a rollout, leaves [T, B, ...], and estimate advantages.
        initial_hidden = runner.hidden
        runner, trajectory = jax.lax.scan(env_step, runner, None, config.rollout)
        _, _, last_value = network.apply(runner.train.params, runner.hidden, (runner.obs[None], runner.start[None]))
        advantage = estimate_advantages(trajectory, last_value[0])

        def epoch(carry: tuple[TrainState, jax.Array], _: None) -> tuple[tuple[TrainState, jax.Array], None]:
            train, key = carry
            key, shuffle_key = jax.random.split(key)
            order = jax.random.permutation(shuffle_key, config.num_envs)

            # Shuffle the sequences and divide them, [T, B, ...] -> [minibatches, T, B / minibatches, ...].
            def split(leaf: jax.Array) -> jax.Array:
                shuffled = jnp.take(leaf, order, axis=1)
                parts = shuffled.reshape(leaf.shape[0], config.minibatches, -1, *leaf.shape[2:])
                return jnp.swapaxes(parts, 0, 1)

            hidden, *batches = jax.tree.map(split, (initial_hidden[None], trajectory, advantage))
            train, _ = jax.lax.scan(update_minibatch, train, (hidden[:, 0], *batches))
            return (train, key), None

        (train, key), _ = jax.lax.scan(epoch, (runner.train, runner.key), None, config.epochs)
        return runner._replace(train=train, key=key), None

    def train(runner: Runner) -> Runner:
        return jax.lax.scan(update, runner, None, num_updates)[0]

    return train


def main(epochs: int, minibatches: int, num_updates: int) -> None:
    env, params = make("rooms")
    config = PPOConfig(epochs=epochs, minibatches=minibatches)
    row_format = RowFormat(SPEC.num_categories)
    adapter = Adapter(env, lambda observation, action: to_vector(observation, action, row_format))
    network: Any = ActorCritic()
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.learning_rate, eps=1e-5))

    # Start the episodes, all of them in one batch, and initialize the network.
    reset_key, init_key, key = jax.random.split(jax.random.key(0), 3)
    obs, slots = jax.jit(jax.vmap(adapter.reset, (0, None)))(jax.random.split(reset_key, config.num_envs), params)
    hidden = jnp.zeros((config.num_envs, SPEC.sizes.hidden))
    start = jnp.ones(config.num_envs, bool)
    weights = jax.jit(network.init)(init_key, hidden, (obs[None], start[None]))
    train = TrainState.create(apply_fn=network.apply, params=weights, tx=optimizer)
    runner = Runner(train, slots, obs, start, hidden, key)

    serve(make_train(config, adapter, params, network, num_updates), runner)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
