# pyright: reportMissingImports=false
"""rejax's PPO on this environment as a process.

Started as `python benchmarks/_rejax_worker.py CRITIC EPOCHS MINIBATCHES UPDATES`. rejax's actor and critic are two
networks without memory. The actor has the layers of jaxnav's policy, its recurrent cell run from a zero state. CRITIC
is `torso` (the same layers again, as rejax is meant to be used) or `linear` (one linear layer, so that rejax does no
more floating-point work per observation than jaxnav).
"""

import sys

import jax
from _trainer_worker import Adapter, Torso, make_action_head, pack_observation, serve, unpack_observation
from flax import linen as nn
from gymnax.environments import spaces
from rejax import PPO
from rejax.networks import DiscretePolicy

from jaxnav.env.make import make
from jaxnav.policies.methods import find_method
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.training.config import PPOConfig

SPEC = PolicySpec(find_method("org"))
ROW_FORMAT = RowFormat(SPEC.num_categories)


class GymnaxObjectNav(Adapter):
    def action_space(self, params) -> spaces.Discrete:
        return spaces.Discrete(NUM_ACTIONS)

    def observation_space(self, params) -> spaces.Box:
        return spaces.Box(0, 255, (ROW_FORMAT.num_bytes + 2,), "uint8")


class FeedForward(nn.Module):
    """The policy's layers without any memory."""

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        cell = nn.GRUCell(SPEC.sizes.hidden)
        fused = Torso(SPEC)(unpack_observation(obs, ROW_FORMAT))
        initial_hidden = cell.initialize_carry(jax.random.key(0), fused.shape)
        return cell(initial_hidden, fused)[0]


class Actor(DiscretePolicy):
    def setup(self) -> None:
        self.features = FeedForward()
        self.action_logits = make_action_head()


class TorsoCritic(nn.Module):
    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        return nn.Dense(1)(FeedForward()(obs)).squeeze(1)


class LinearCritic(nn.Module):
    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        return nn.Dense(1)(unpack_observation(obs, ROW_FORMAT)).squeeze(1)


CRITICS = {"torso": TorsoCritic, "linear": LinearCritic}


def main(critic: str, epochs: int, minibatches: int, num_updates: int) -> None:
    env, params = make("rooms")
    config = PPOConfig()
    trainer = PPO(
        env=GymnaxObjectNav(env, pack_observation),
        env_params=params,
        eval_callback=lambda *_: None,  # `train_iteration` never evaluates
        actor=Actor(NUM_ACTIONS, hidden_layer_sizes=(), activation=nn.relu),
        critic=CRITICS[critic](),
        num_envs=config.num_envs,
        num_steps=config.rollout,
        num_epochs=epochs,
        num_minibatches=minibatches,
        learning_rate=config.learning_rate,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_eps=config.clip,
        vf_coef=config.value,
        ent_coef=config.entropy,
        max_grad_norm=config.max_grad_norm,
    )

    def train(state):
        return jax.lax.fori_loop(0, num_updates, lambda _, state: trainer.train_iteration(state), state)

    serve(train, jax.jit(trainer.init_state)(jax.random.key(0)))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
