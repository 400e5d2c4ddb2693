"""ORG+TPN: ORG with a tentative policy network, which learns within the episode from past trials.

Source: H. Du, X. Yu and L. Zheng, *Learning Object Relation Graph and Tentative Policy for Visual Navigation*, ECCV
2020, and its released code.

Kept: ORG is trained first. The tentative policy then learns to imitate shortest paths at repeated poses, from the
hidden state and the ten most similar trials of the episode, while the trained policy is fixed and acts. A trial is a
transition: its key is a state, its value the next state with the action that led there, so that similar states retrieve
what actions led to. Scores are dot products without a scale. In an episode the policy takes a step of gradient descent
towards the tentative policy's best action at every repeated pose, and is reset every 50 decisions. Changed: only the
actor adapts, which has a closed form; the last 100 trials are remembered, not all; a trial holds the one-hot action, in
place of an embedding of the probabilities of all actions; and compass, odometry and horizon recognise a repeated pose.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.numerics.product import Linear
from jaxnav.policies.method import Knowledge, Method, Percept, Stage
from jaxnav.policies.methods.attention import FeedForward
from jaxnav.policies.methods.imitation import expert_actions, imitation_loss
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.policies.network import LayerChanges, append_one
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.tables.compile import Bank
from jaxnav.scenes.task import NUM_ACTIONS

if TYPE_CHECKING:
    from jaxnav.policies.network import Policy
    from jaxnav.policies.pathways import Decision, Pathways, PolicyState

#: Number of trials of an episode that are remembered.
NUM_TRIALS = 100
#: Number of remembered trials that a decision attends to.
NUM_ATTENDED = 10

#: Share of all updates in which the tentative policy learns to imitate.
_IMITATION_SHARE = 0.2
_CELLS_PER_LINE = 2**13  # with 12 headings and 2 horizons, pose numbers fit in 31 bits
_NO_POSE = np.iinfo(np.int32).min
_NO_SCORE = np.finfo(np.float32).min


# Tracker: which poses are repeated


class PoseHistory(NamedTuple):
    """Past poses of one episode.

    Attributes:
      poses: int32 [N], numbers of the last poses, the present one at the end.
      position: int32 [2], (dz, dx) in cells from the start of the episode.
      is_repeated: bool [], True where the present pose repeats an earlier pose.
    """

    poses: jax.Array
    position: jax.Array
    is_repeated: jax.Array


@dataclasses.dataclass(frozen=True)
class PoseTracker:
    """Tracker that recognises repeated poses by compass, odometry and horizon.

    A pose is cell, heading and horizon. `learn_motion` provides the method's knowledge.

    Attributes:
      length: N, number of poses that are remembered.
    """

    length: int = NUM_TRIALS

    def init(self, knowledge: Knowledge) -> PoseHistory:
        """Return a history without poses."""
        no_poses = jnp.full(self.length, _NO_POSE, jnp.int32)
        return PoseHistory(no_poses, jnp.zeros(2, jnp.int32), jnp.bool_(False))

    def update(self, state: PoseHistory, knowledge: Knowledge, percept: Percept) -> PoseHistory:
        """Append the present pose."""
        # Follow the agent by odometry.
        strides = knowledge.method["steps"]
        num_horizons = knowledge.method["horizons"]
        position = state.position + jnp.where(percept.moved, strides[percept.heading], 0)

        # One number per pose: mixed radix of row, column, heading and horizon.
        cell = position[0] * _CELLS_PER_LINE + position[1]
        pose = (cell * len(strides) + percept.heading) * num_horizons + percept.horizon
        poses = jnp.concatenate([state.poses[1:], pose[None]])
        return PoseHistory(poses, position, is_repeated=(state.poses == pose).any())

    def read(self, state: PoseHistory, knowledge: Knowledge, goal: jax.Array) -> jax.Array:
        """Return True where the present pose is repeated, bool []."""
        return state.is_repeated


def learn_motion(banks: Iterable[Bank], counts: np.ndarray) -> dict[str, np.ndarray]:
    """Return the displacements and the number of horizons of the task.

    Args:
      banks: banks of training scenes, which share one task.
      counts: co-occurrence counts of exploration, unused.

    Returns:
      By name `steps`, int32 [H, 2], the displacement (dz, dx) of a step ahead by heading, and `horizons`, int32 [], the
      number of horizons.
    """
    rules = next(iter(banks)).task.rules
    return {"steps": rules.move_steps().astype(np.int32), "horizons": np.array(len(rules.horizons), np.int32)}


# Network: the tentative policy


class TentativePolicy(nnx.Module):
    """Network that predicts the action of a shortest path from past trials.

    A trial i of an episode is a transition between two states of the agent, as this network represents them. With the
    states s_0, ..., s_t and the actions a_0, ..., a_{t-1} so far,

        key_i = s_i        value_i = [s_{i+1}, a_i]        i = 0, ..., t - 1
        answer = sum_i softmax_i(s_t . key_i) value_i      over the `NUM_ATTENDED` largest scores

    The key of a trial is the state part of the value before it, so only values are remembered.
    """

    def __init__(self, spec: PolicySpec, width: int, rngs: nnx.Rngs) -> None:
        state_width = spec.sizes.hidden
        trial_width = spec.sizes.hidden + NUM_ACTIONS
        self.state = FeedForward(state_width, width, rngs)
        self.trial = FeedForward(trial_width, width, rngs)
        self.both = FeedForward(state_width + trial_width, width, rngs)
        self.expert = Linear(state_width + trial_width, NUM_ACTIONS, rngs=rngs)

    def __call__(
        self, hidden: jax.Array, action: jax.Array, trials: jax.Array, count: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return logits of the action of a shortest path, and the trials with the latest one.

        Args:
          hidden: float32 [..., H], the policy's present hidden state.
          action: int32 [...], the action that led to the present state; no action at an episode's start.
          trials: float32 [..., N, H + A], values of the trials before the latest one, the latest of them at the end.
            The first value of an episode holds its first state, which no action led to; slots before it are 0.
          count: int32 [...], number of trials so far, 0 at an episode's start.

        Returns:
          float32 [..., A], the logits, and float32 [..., N, H + A], the values that the next decision needs.
        """
        # Keys [..., N, H] and values [..., N, H + A] of the trials, the latest of which led to the present state.
        state = self.state(hidden)
        known_values = self.append_value(trials, state, action)
        keys = known_values[..., :-1, : state.shape[-1]]
        values = known_values[..., 1:, :]

        # Read what the trials from similar states led to, and predict the action from the state and the answer.
        attention = self.attention(state, keys, count)
        answer = (attention[..., None, :] @ values)[..., 0, :]
        read_trial = self.trial(answer)
        return self.expert(self.both(jnp.concatenate([state, read_trial], axis=-1))), values

    def append_value(self, trials: jax.Array, state: jax.Array, action: jax.Array) -> jax.Array:
        """Append the value of the latest trial, through which no gradient passes, [..., N + 1, H + A]."""
        action_one_hot = jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)
        value = jax.lax.stop_gradient(jnp.concatenate([state, action_one_hot], axis=-1))
        return jnp.concatenate([trials, value[..., None, :]], axis=-2)

    def attention(self, state: jax.Array, keys: jax.Array, count: jax.Array) -> jax.Array:
        """Return the attention of a state float32 [..., H] to trials with keys float32 [..., N, H].

        Returns:
          float32 [..., N], with sum 1 over the `NUM_ATTENDED` most similar trials; 0 without trials.
        """
        # Mask the slots that hold no trial yet.
        ages = jnp.arange(keys.shape[-2], 0, -1).reshape((1,) * count.ndim + (-1,))
        is_trial = ages <= count[..., None]
        scores = jnp.where(is_trial, self.scores(state, keys), _NO_SCORE)

        # Keep the NUM_ATTENDED highest scores and their ties: equal scores attend to all trials, as the ablation needs.
        lowest_attended = jax.lax.top_k(scores, NUM_ATTENDED)[0][..., -1:]
        attention = jax.nn.softmax(jnp.where(scores >= lowest_attended, scores, _NO_SCORE))

        # Without any trial the finite scores are equal: attend to none.
        return jnp.where(is_trial, attention, 0.0)

    def scores(self, state: jax.Array, keys: jax.Array) -> jax.Array:
        """Return the dot products of the state with the keys, [..., N]."""
        return (keys @ state[..., None])[..., 0]


class UniformTentativePolicy(TentativePolicy):
    """Tentative policy with equal attention to all trials, for an ablation."""

    def scores(self, state: jax.Array, keys: jax.Array) -> jax.Array:
        """Return zeros, [..., N]."""
        return jnp.zeros(keys.shape[:-1])


class TentativeRelations(ObjectRelations):
    """Experience of ORG; the tentative policy is attached to it but no part of Z."""

    tentative_class: ClassVar[type[TentativePolicy]] = TentativePolicy
    sizes: ClassVar[Mapping[str, int]] = {**ObjectRelations.sizes, "tentative_width": 64}

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.tentative = self.tentative_class(spec, self.size(spec, "tentative_width"), rngs)


class UniformTentativeRelations(TentativeRelations):
    """Experience of ORG, with equal attention to all trials."""

    tentative_class = UniformTentativePolicy


# Adaptation: steps towards the tentative policy


class TentativeState(NamedTuple):
    """Fast weights of the actor, and the trials that they are learned from.

    Attributes:
      trials: float32 [..., N, H + A], the last states, each with the action that led to it, the latest at the end: the
        values of the last trials (see `TentativePolicy`). 0 where the episode is shorter.
      num_decisions: int32 [...], decisions so far.
      actor_change: float32 [..., H + 1, A], change of the actor's kernel and bias.
      predicted_logits: float32 [..., A], logits of a shortest path's action at the last decision.
    """

    trials: jax.Array
    num_decisions: jax.Array
    actor_change: jax.Array
    predicted_logits: jax.Array


@dataclasses.dataclass(frozen=True)
class TentativeAdaptation:
    """Gradient descent towards the tentative policy at repeated poses.

    After a decision at a repeated pose, the actor takes a step on the cross-entropy to the action that the tentative
    policy considers best. With streams, the actor of the direct stream adapts.

    Attributes:
      learning_rate: learning rate of the step.
      reset_interval: number of decisions after which the actor is reset to its trained state.
    """

    learning_rate: float = 0.1
    reset_interval: int = 50

    def init(self, policy: "Policy", batch: tuple[int, ...]) -> TentativeState:
        """Return a state without trials and without a change."""
        hidden_width = policy.hidden_width
        return TentativeState(
            trials=jnp.zeros((*batch, NUM_TRIALS, hidden_width + NUM_ACTIONS)),
            num_decisions=jnp.zeros(batch, jnp.int32),
            actor_change=jnp.zeros((*batch, hidden_width + 1, NUM_ACTIONS)),
            predicted_logits=jnp.zeros((*batch, NUM_ACTIONS)),
        )

    def decide(self, policy: "Policy", pathways: "Pathways", memory: "PolicyState") -> "Decision":
        """Decide with the changed actor, then adapt it where the pose is repeated."""
        assert isinstance(policy.experience, TentativeRelations)
        tentative = policy.experience.tentative
        trials, num_decisions, actor_change, _ = memory.fast

        # Decide, with a reset actor every `reset_interval` decisions.
        is_reset = num_decisions % self.reset_interval == 0
        actor_change = jnp.where(is_reset[..., None, None], 0.0, actor_change)
        output = policy.decide_with_changes(pathways, memory, make_layer_changes(actor_change))

        # Predict a shortest path's action from the present state and the trials; with streams the state is that of the
        # direct stream. No gradient of the tentative policy passes the state.
        hidden_now = jax.lax.stop_gradient(output.hidden[..., : policy.hidden_width])
        predicted_logits, trials = tentative(hidden_now, memory.action, trials, num_decisions)
        best_one_hot = jax.nn.one_hot(predicted_logits.argmax(axis=-1), NUM_ACTIONS, dtype=jnp.float32)

        # Negative gradient of the cross-entropy by the actor's kernel and bias: the outer product of [h, 1] and
        # one_hot - softmax(logits).
        logits_descent = policy.gate_done(best_one_hot - jax.nn.softmax(output.logits), pathways.gate)
        step = self.learning_rate * append_one(hidden_now)[..., None] * logits_descent[..., None, :]
        is_repeated = pathways.reading[..., None, None]
        actor_change = actor_change + jnp.where(is_repeated, step, 0.0)
        return output._replace(fast=TentativeState(trials, num_decisions + 1, actor_change, predicted_logits))


def make_layer_changes(actor_change: jax.Array) -> LayerChanges:
    """Make the layer changes for a change of the actor's kernel and bias, [..., H + 1, A]."""
    return {"actor": lambda inputs: (inputs[..., None] * actor_change).sum(axis=-2)}


def tentative_loss(replay: Any, *_: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the imitation loss of the tentative policy at repeated poses.

    No gradient reaches the policy itself.

    Args:
      replay: a `jaxnav.training.ppo.Replay`.
    """
    # Steps at other poses get the label NUM_ACTIONS, which adds nothing to the loss.
    is_repeated = replay.transitions.reading
    expert = jnp.where(is_repeated, expert_actions(replay), NUM_ACTIONS)
    loss, metrics = imitation_loss(replay.factual.fast.predicted_logits, expert)
    return loss, metrics | {"repeated": is_repeated.astype(jnp.float32).mean()}


TPN = Method(
    TentativeRelations,
    tracker=PoseTracker(NUM_TRIALS),
    learn=learn_motion,
    stages=(
        Stage(1.0 - _IMITATION_SHARE, adapts_online=False),
        Stage(
            _IMITATION_SHARE,
            tentative_loss,
            lr_scale_by_path=lambda path: 1.0 if path[:2] == ("method", "tentative") else 0.0,
            uses_expert=True,
        ),
    ),
    adaptation=TentativeAdaptation(),
    name="tpn",
)
#: Ablation without steps at test time.
UNTRIED = dataclasses.replace(TPN, adaptation=TentativeAdaptation(learning_rate=0.0))
#: Ablation with equal attention to all past trials.
INDISCRIMINATE = dataclasses.replace(TPN, experience=UniformTentativeRelations)
