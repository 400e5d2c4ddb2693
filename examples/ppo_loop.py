"""PPO in one file: a perceptron without memory learns to search in generated rooms, and is evaluated.

python examples/ppo_loop.py                     # two million steps, a minute or two on two cores
python examples/ppo_loop.py --steps 100000      # a first try
python examples/ppo_loop.py --benchmark         # also the rooms of the benchmark v2
"""

import argparse
import functools
import itertools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

import jaxnav
from jaxnav.runs.benchmark import run_benchmark

NUM_ENVS, ROLLOUT, EPOCHS, MINIBATCHES = 512, 32, 3, 8
GAMMA, GAE_LAMBDA, CLIP, ENTROPY, VALUE_COST = 0.99, 0.95, 0.2, 0.01, 0.5
HIDDEN = 128

env, env_params = jaxnav.make("rooms", split="train")
optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))


class Transition(NamedTuple):
    """One step of B environments; leaves [B, ...], in a rollout [T, B, ...]."""

    features: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    is_last: jax.Array
    success: jax.Array


def encode(observation: Any) -> jax.Array:
    """Features of an observation, float32 [F]: the detections, the view around the agent, and the goal."""
    detections = env.row_format.detections(observation.row).astype(jnp.float32) / 128.0  # [K, 4]
    goal = jax.nn.one_hot(observation.goal, len(env.categories))
    view = env.row_format.view_cells(observation.row).astype(jnp.float32)
    return jnp.concatenate([detections.reshape(-1), goal @ detections, goal, view.reshape(-1)])


def init_network(key: jax.Array, sizes: list[int]) -> list[dict[str, jax.Array]]:
    """Layers of a perceptron; the last one starts near 0."""
    layers = []
    for index, (num_inputs, num_outputs) in enumerate(itertools.pairwise(sizes)):
        scale = 0.01 if index == len(sizes) - 2 else (2.0 / num_inputs) ** 0.5
        kernel = scale * jax.random.normal(jax.random.fold_in(key, index), (num_inputs, num_outputs))
        layers.append({"kernel": kernel, "bias": jnp.zeros(num_outputs)})
    return layers


def apply_network(layers: list[dict[str, jax.Array]], features: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Logits [..., A] and value [...]."""
    hidden = features
    for layer in layers[:-1]:
        hidden = jax.nn.relu(hidden @ layer["kernel"] + layer["bias"])
    outputs = hidden @ layers[-1]["kernel"] + layers[-1]["bias"]
    return outputs[..., :-1], outputs[..., -1]


def collect(carry: Any, key: jax.Array, network: Any) -> tuple[Any, Transition]:
    """Take a step in all environments."""
    observation, state = carry
    action_key, reset_key = jax.random.split(key)
    features = jax.vmap(encode)(observation)
    logits, value = apply_network(network, features)
    action = jax.random.categorical(action_key, logits)
    log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=1)[:, 0]

    step = jax.vmap(env.step, (0, 0, 0, None))
    reset_keys = jax.random.split(reset_key, NUM_ENVS)
    observation, state, reward, terminated, truncated, info = step(reset_keys, state, action, env_params)
    is_last = terminated | truncated
    transition = Transition(features, action, log_prob, value, reward, is_last, info["success"])
    return (observation, state), transition


def estimate_advantages(rollout: Transition, last_value: jax.Array) -> jax.Array:
    """Generalised advantage estimates, float32 [T, B]; time-outs count as ends."""

    def step_back(carry: Any, transition: Transition) -> tuple[Any, jax.Array]:
        next_advantage, next_value = carry
        discount = GAMMA * (1.0 - transition.is_last)
        td_error = transition.reward + discount * next_value - transition.value
        advantage = td_error + discount * GAE_LAMBDA * next_advantage
        return (advantage, transition.value), advantage

    _, advantages = jax.lax.scan(step_back, (jnp.zeros_like(last_value), last_value), rollout, reverse=True)
    return advantages


def ppo_loss(network: Any, batch: tuple[Transition, jax.Array, jax.Array]) -> jax.Array:
    """Clipped policy loss, value loss and entropy bonus of one minibatch."""
    transition, advantages, returns = batch
    logits, value = apply_network(network, transition.features)
    log_probs = jax.nn.log_softmax(logits)
    log_prob = jnp.take_along_axis(log_probs, transition.action[:, None], axis=1)[:, 0]
    ratio = jnp.exp(log_prob - transition.log_prob)

    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clipped_ratio = jnp.clip(ratio, 1.0 - CLIP, 1.0 + CLIP)
    policy_loss = -jnp.minimum(ratio * advantages, clipped_ratio * advantages).mean()
    value_loss = 0.5 * jnp.square(value - returns).mean()
    entropy = -(jnp.exp(log_probs) * log_probs).sum(axis=-1).mean()
    return policy_loss + VALUE_COST * value_loss - ENTROPY * entropy


@jax.jit
def update(train_state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
    """Collect a rollout and learn from it; returns the share of its episodes that succeeded."""
    network, opt_state, carry = train_state
    rollout_key, shuffle_key = jax.random.split(key)
    rollout_keys = jax.random.split(rollout_key, ROLLOUT)
    carry, rollout = jax.lax.scan(functools.partial(collect, network=network), carry, rollout_keys)
    _, last_value = apply_network(network, jax.vmap(encode)(carry[0]))
    advantages = estimate_advantages(rollout, last_value)

    returns = advantages + rollout.value
    transitions = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (rollout, advantages, returns))

    def train_minibatch(carry: Any, indices: jax.Array) -> tuple[Any, None]:
        network, opt_state = carry
        batch = jax.tree.map(lambda leaf: leaf[indices], transitions)
        gradient = jax.grad(ppo_loss)(network, batch)
        changes, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(network, changes), opt_state), None

    # Every epoch visits all transitions in a new order.
    shuffle_keys = jax.random.split(shuffle_key, EPOCHS)
    orders = jax.vmap(lambda epoch_key: jax.random.permutation(epoch_key, ROLLOUT * NUM_ENVS))(shuffle_keys)
    minibatches = orders.reshape(EPOCHS * MINIBATCHES, -1)
    (network, opt_state), _ = jax.lax.scan(train_minibatch, (network, opt_state), minibatches)
    success_rate = rollout.success.sum() / jnp.maximum(rollout.is_last.sum(), 1)
    return (network, opt_state, carry), success_rate


class PpoAgent(struct.PyTreeNode):
    """The trained network as an agent for `jaxnav.evaluate`; actions are sampled."""

    network: Any

    def init(self) -> tuple[()]:
        """No memory."""
        return ()

    def act(self, observation: Any, memory: tuple[()], key: jax.Array) -> tuple[jax.Array, tuple[()]]:
        """Sample an action."""
        logits, _ = apply_network(self.network, encode(observation))
        return jax.random.categorical(key, logits), memory


def train(num_steps: int, seed: int = 0) -> PpoAgent:
    """Train for a number of environment steps."""
    init_key, reset_key, train_key = jax.random.split(jax.random.key(seed), 3)
    observation, state = jax.vmap(env.reset, (0, None))(jax.random.split(reset_key, NUM_ENVS), env_params)
    num_features = encode(jax.tree.map(lambda leaf: leaf[0], observation)).size
    network = init_network(init_key, [num_features, HIDDEN, HIDDEN, env.num_actions + 1])
    train_state = (network, optimizer.init(network), (observation, state))

    num_updates = max(1, num_steps // (NUM_ENVS * ROLLOUT))
    for index in range(num_updates):
        train_state, success_rate = update(train_state, jax.random.fold_in(train_key, index))
        if index % 20 == 0 or index == num_updates - 1:
            print(f"update {index + 1} of {num_updates}: {100 * success_rate:.0f} % of the episodes succeed")
    return PpoAgent(train_state[0])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--benchmark", action="store_true")
    options = parser.parse_args()

    agent = train(options.steps)
    print(jaxnav.evaluate(agent, world="rooms", split="val"))
    if options.benchmark:
        score_file = Path("ppo_loop.json")
        run_benchmark(agent, tracks=["rooms"]).write(score_file)
        print(f"scores of the benchmark written to {score_file}")
