"""Methods that use one part of the seam each, and some that break its contract; found as `support.methods:NAME`."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx

from jaxnav.numerics.product import Linear
from jaxnav.policies.features import NUM_FEATURES
from jaxnav.policies.method import Experience, Method, Stage
from jaxnav.policies.methods.org import ObjectRelations
from jaxnav.scenes.task import NUM_ACTIONS, ROTATE_RIGHT


class Attention(Experience):
    """Attend to the categories' rows with the memory."""

    reads_memory = True

    def __init__(self, spec, rngs):
        self.query = Linear(spec.sizes.hidden + NUM_ACTIONS, NUM_FEATURES, rngs=rngs)
        self.width = NUM_FEATURES

    def encode(self, features, appearance, weights, reading):
        return features.table * weights[..., None]

    def attend(self, encoded, memory):
        previous = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
        query = self.query(jnp.concatenate([memory.hidden, previous], axis=-1))
        score = jax.nn.softmax((encoded * query[..., None, :]).sum(axis=-1))
        return (score[..., None] * encoded).sum(axis=-2)


ATTENTIVE = Method(Attention)


class StepwiseRelations(ObjectRelations):
    """ORG, whose experience training computes step by step, though it does not attend."""

    reads_memory = True


STEPWISE = Method(StepwiseRelations)


@dataclasses.dataclass(frozen=True)
class Counter:
    """Numbers of views and moves, and sums of headings and actions."""

    def init(self, knowledge):
        return {"views": jnp.int32(0), "moves": jnp.int32(0), "headings": jnp.int32(0), "actions": jnp.int32(0)}

    def update(self, state, knowledge, percept):
        return {
            "views": state["views"] + 1,
            "moves": state["moves"] + percept.moved.astype(jnp.int32),
            "headings": state["headings"] + percept.heading,
            "actions": state["actions"] + percept.action,
        }

    def read(self, state, knowledge, goal):
        return jnp.stack([state["views"], state["moves"], goal]).astype(jnp.float32) / 10.0


class Reading(Experience):
    """Hand the tracker's reading on."""

    def __init__(self, spec, rngs):
        self.width = 3

    def encode(self, features, appearance, weights, reading):
        return reading


COUNTING = Method(Reading, tracker=Counter())

#: First the critic alone, then everything.
STAGED = Method(ObjectRelations, stages=(Stage(0.25, lr_scale_by_path=lambda path: path[0] == "critic"), Stage(0.75)))


def squared_values(replayed):
    penalty = jnp.square(replayed.factual.value).mean()
    return 3.0 * penalty, {"squared_values": penalty}


AUXILIARY = Method(ObjectRelations, auxiliary=squared_values)


@dataclasses.dataclass(frozen=True)
class Habit:
    """Make what was done likelier: fast weights are a bias per action."""

    rate: float = 0.5

    def init(self, policy, batch):
        return jnp.zeros((*batch, NUM_ACTIONS))

    def decide(self, policy, pathways, memory):
        done = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
        bias = memory.fast + self.rate * done
        decision = policy.decide_with_changes(pathways, memory)
        return decision._replace(logits=decision.logits + bias, fast=bias)


ADAPTIVE = Method(ObjectRelations, adaptation=Habit())


@dataclasses.dataclass(frozen=True)
class TwoChoices:
    """Choose between the actions with even and odd numbers, by the number of views."""

    num_choices: int = 2
    interval: int = 1

    def is_decision_step(self, state):
        return None

    def act(self, choice, state, knowledge):
        return 2 * (state["views"] % 3) + choice, state


CONTROLLED = Method(Reading, tracker=Counter(), control=TwoChoices())


@dataclasses.dataclass(frozen=True)
class EverySecond(TwoChoices):
    """Choose anew after every second action; what is chosen between does not count."""

    interval: int = 2

    def is_decision_step(self, state):
        return state["views"] % 2 == 1

    def act(self, choice, state, knowledge):
        return jnp.where(self.is_decision_step(state), choice, 1), state


PATIENT = Method(Reading, tracker=Counter(), control=EverySecond())


class Known(Experience):
    """Make no experience."""

    def __init__(self, spec, rngs):
        self.width = 2

    def encode(self, features, appearance, weights, reading):
        return reading


@dataclasses.dataclass(frozen=True)
class Reader:
    """Read what was learned before training."""

    def init(self, knowledge):
        return jnp.int32(0)

    def update(self, state, knowledge, percept):
        return state + 1

    def read(self, state, knowledge, goal):
        return knowledge.method["table"][goal, :2]


def table_of_counts(banks, counts):
    """Every pair's share of all counts, and the number of scenes."""
    together = counts.sum(axis=0)
    return {"table": together / max(together.sum(), 1.0), "scenes": {"count": sum(len(bank.names) for bank in banks)}}


LEARNED = Method(Known, tracker=Reader(), learn=table_of_counts)


# Methods that break the contract


class BatchMean(Experience):
    """Depend on the other members of a batch."""

    def __init__(self, spec, rngs):
        self.width = 1

    def encode(self, features, appearance, weights, reading):
        seen = features.visible.sum(axis=-1, keepdims=True)
        return jnp.full_like(seen, seen.mean())


class WrongWidth(Reading):
    """Announce another width than that of the experience."""

    def __init__(self, spec, rngs):
        self.width = 5

    def encode(self, features, appearance, weights, reading):
        return features.visible[..., :4]


class NotFinite(BatchMean):
    """Make experience that is no number."""

    def encode(self, features, appearance, weights, reading):
        return jnp.log(-1.0 - features.visible[..., :1])


@dataclasses.dataclass(frozen=True)
class Growing(Counter):
    """Return a state of another type than the first."""

    def update(self, state, knowledge, percept):
        return {**super().update(state, knowledge, percept), "views": state["views"].astype(jnp.float32) + 1.0}


@dataclasses.dataclass(frozen=True)
class TooMany(TwoChoices):
    """Turn a choice into an action that there is not."""

    def act(self, choice, state, knowledge):
        return NUM_ACTIONS + choice * ROTATE_RIGHT, state


BROKEN = {
    "batch": Method(BatchMean),
    "width": Method(WrongWidth),
    "finite": Method(NotFinite),
    "note": Method(Reading, tracker=Growing()),
    "action": Method(Reading, tracker=Counter(), control=TooMany()),
}
BATCH, WIDTH, FINITE, NOTE, ACTION = BROKEN.values()
NO_METHOD = nnx.Module
