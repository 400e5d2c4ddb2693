"""ORG with a memory-augmented tentative policy network (Du et al., ECCV 2020)."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxnav.numerics.product import Linear
from jaxnav.policies.methods.attention import FeedForward
from jaxnav.policies.methods.base import Method, Stage
from jaxnav.policies.methods.imitation import expert_actions, imitation_loss
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.policies.methods.trail import PoseTracker, learn_motion
from jaxnav.policies.spec import PolicySpec
from jaxnav.policies.stream import Changes, with_one
from jaxnav.scenes.task import NUM_ACTIONS

if TYPE_CHECKING:
    from jaxnav.policies.pathways import Decision, Memory, Pathways
    from jaxnav.policies.policy import Policy

#: Share of all updates in which the tentative policy learns what shortest paths do where the agent was before.
IMITATION = 0.2
REMEMBERED, ATTENDED = 100, 10  # steps of an episode, and those of them that are attended to


class TentativePolicy(nnx.Module):
    """Tell from past trials what a shortest path would do.

    A trial is a state that the agent was in, as this network represents it, and what it did there.
    """

    def __init__(self, spec: PolicySpec, width: int, rngs: nnx.Rngs) -> None:
        state, trial = spec.sizes.hidden, spec.sizes.hidden + NUM_ACTIONS
        self.state, self.trial, self.both = (FeedForward(n, width, rngs) for n in (state, trial, state + trial))
        self.expert = Linear(state + trial, NUM_ACTIONS, rngs=rngs)

    def remember(self, trials: jax.Array, hidden: jax.Array, action: jax.Array) -> jax.Array:
        """Return trials float32 [..., N, H + A] and one more, fixed.

        Args:
          trials: float32 [..., N, H + A]; the first is forgotten.
          hidden: float32 [..., H], the policy's hidden state.
          action: int32 [...], that followed.
        """
        trial = jnp.concatenate([self.state(hidden), jax.nn.one_hot(action, NUM_ACTIONS, dtype=jnp.float32)], axis=-1)
        return jnp.concatenate([trials[..., 1:, :], jax.lax.stop_gradient(trial)[..., None, :]], axis=-2)

    def __call__(self, hidden: jax.Array, trials: jax.Array, count: jax.Array) -> jax.Array:
        """Return logits of a shortest path's action, float32 [..., A].

        Args:
          hidden: float32 [..., H], the policy's present hidden state.
          trials: float32 [..., N, H + A].
          count: int32 [...], trials so far, at least 1; the last ones are there.
        """
        state = self.state(hidden)
        answer = self.trial((self.attention(state, trials, count)[..., None, :] @ trials)[..., 0, :])
        return self.expert(self.both(jnp.concatenate([state, answer], axis=-1)))

    def attention(self, state: jax.Array, trials: jax.Array, count: jax.Array) -> jax.Array:
        """Return how much a state float32 [..., H] attends to trials.

        Those that are most alike share it.

        Returns:
          float32 [..., N], sums to 1.
        """
        ages = jnp.arange(trials.shape[-2], 0, -1).reshape((1,) * count.ndim + (-1,))
        scores = jnp.where(ages <= count[..., None], self.scores(state, trials), -jnp.inf)
        least = jax.lax.top_k(scores, ATTENDED)[0][..., -1:]
        return jax.nn.softmax(jnp.where(scores >= least, scores, -jnp.inf))

    def scores(self, state: jax.Array, trials: jax.Array) -> jax.Array:
        """Return how much alike they are, [..., N]."""
        width = state.shape[-1]
        return (trials[..., :width] @ state[..., None])[..., 0] / np.float32(np.sqrt(width))


class Indiscriminate(TentativePolicy):
    """Attend to all trials equally."""

    def scores(self, state: jax.Array, trials: jax.Array) -> jax.Array:
        """Return zeros, [..., N]."""
        return jnp.zeros(trials.shape[:-1])


class TentativeRelations(ObjectRelations):
    """Relate the detected categories and the goal.

    That is ORG; a tentative policy, which is no part of experience, stands by.
    """

    tentative_policy: ClassVar[type[TentativePolicy]] = TentativePolicy
    sizes: ClassVar[Mapping[str, int]] = {**ObjectRelations.sizes, "tentative_width": 64}

    def __init__(self, spec: PolicySpec, rngs: nnx.Rngs) -> None:
        super().__init__(spec, rngs)
        self.tentative = self.tentative_policy(spec, self.size(spec, "tentative_width"), rngs)


class IndiscriminateRelations(TentativeRelations):
    """Relate as ORG; all trials are attended to equally."""

    tentative_policy = Indiscriminate


class Trials(NamedTuple):
    """Hold the fast weights, and what they are learned from.

    Attributes:
      past: float32 [..., N, H + A], the last trials, the latest at the end.
      decisions: int32 [...], so far.
      change: float32 [..., H + 1, A], of the actor's kernel and bias.
      prediction: float32 [..., A], logits of a shortest path's action at the last decision.
    """

    past: jax.Array
    decisions: jax.Array
    change: jax.Array
    prediction: jax.Array


@dataclasses.dataclass(frozen=True)
class TentativeSteps:
    """Imitate the tentative policy where the agent was before.

    After a decision at a repeated pose the actor takes a step of gradient descent on the cross-entropy to the action
    that the tentative policy holds for best. With streams it is the actor of the direct stream.

    Attributes:
      rate: of the step.
      renewal: decisions after which the actor is again as it was trained.
    """

    rate: float = 0.1
    renewal: int = 50

    def init(self, policy: "Policy", batch: tuple[int, ...]) -> Trials:
        """Return no trial and no change."""
        hidden = policy.hidden
        return Trials(
            past=jnp.zeros((*batch, REMEMBERED, hidden + NUM_ACTIONS)),
            decisions=jnp.zeros(batch, jnp.int32),
            change=jnp.zeros((*batch, hidden + 1, NUM_ACTIONS)),
            prediction=jnp.zeros((*batch, NUM_ACTIONS)),
        )

    def decide(self, policy: "Policy", pathways: "Pathways", memory: "Memory") -> "Decision":
        """Decide with the changed actor, then learn from the pose."""
        assert isinstance(policy.method, TentativeRelations)
        tentative, (past, decisions, change, _) = policy.method.tentative, memory.fast
        change = jnp.where((decisions % self.renewal == 0)[..., None, None], 0.0, change)
        decision = policy.decide_plainly(pathways, memory, actor_changes(change))
        before, now = (jax.lax.stop_gradient(each.hidden[..., : policy.hidden]) for each in (memory, decision))
        past = tentative.remember(past, before, memory.action)
        prediction = tentative(now, past, decisions + 1)
        best = jax.nn.one_hot(prediction.argmax(axis=-1), NUM_ACTIONS, dtype=jnp.float32)
        descent = policy.gated(best - jax.nn.softmax(decision.logits), pathways)
        step = self.rate * with_one(now)[..., None] * descent[..., None, :]
        change = change + jnp.where(pathways.reading[..., None, None], step, 0.0)
        return decision._replace(fast=Trials(past, decisions + 1, change, prediction))


def actor_changes(change: jax.Array) -> Changes:
    """Change the actor's kernel and bias, [..., H + 1, A]."""
    return {"actor": lambda inputs: (inputs[..., None] * change).sum(axis=-2)}


def tentative_loss(replayed: Any, *_: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return how badly shortest paths are told at repeated poses.

    No gradient reaches the policy.
    """
    repeated = replayed.transitions.reading
    expert = jnp.where(repeated, expert_actions(replayed), NUM_ACTIONS)
    loss, parts = imitation_loss(replayed.decisions.fast.prediction, expert)
    return loss, parts | {"repeated": repeated.astype(jnp.float32).mean()}


TPN = Method(
    TentativeRelations,
    tracker=PoseTracker(REMEMBERED),
    learn=learn_motion,
    stages=(
        Stage(1.0 - IMITATION, adapts=False),
        Stage(IMITATION, tentative_loss, rates=lambda path: path[:2] == ("method", "tentative"), imitates=True),
    ),
    adaptation=TentativeSteps(),
)
#: The ablations that it must beat: without a step at test time, and without a choice among past trials.
UNTRIED = dataclasses.replace(TPN, adaptation=TentativeSteps(rate=0.0))
INDISCRIMINATE = dataclasses.replace(TPN, experience=IndiscriminateRelations)
