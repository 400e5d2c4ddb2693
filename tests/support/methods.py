"""Methods of the tests, which `find_method` finds as `support.methods:NAME`.

Each method uses one part of the interface of methods; the last ones break its contract.
"""

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
    """Experience that attends to the rows of the categories; the query comes from the memory."""

    reads_memory = True

    def __init__(self, spec, rngs):
        self.query = Linear(spec.sizes.hidden + NUM_ACTIONS, NUM_FEATURES, rngs=rngs)
        self.width = NUM_FEATURES

    def encode(self, features, appearance, weights, reading):
        return features.table * weights[..., None]

    def attend(self, encoded, memory):
        last_action = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
        query = self.query(jnp.concatenate([memory.hidden, last_action], axis=-1))
        attention_weights = jax.nn.softmax((encoded * query[..., None, :]).sum(axis=-1))
        return (attention_weights[..., None] * encoded).sum(axis=-2)


ATTENTIVE = Method(Attention)


class StepwiseRelations(ObjectRelations):
    """Experience of ORG that training computes step by step, although it does not read the memory."""

    reads_memory = True


STEPWISE = Method(StepwiseRelations)


@dataclasses.dataclass(frozen=True)
class CountingTracker:
    """Tracker of the numbers of views and moves, and of the sums of headings and actions."""

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
    """Experience that equals the tracker's reading."""

    def __init__(self, spec, rngs):
        self.width = 3

    def encode(self, features, appearance, weights, reading):
        return reading


COUNTING = Method(Reading, tracker=CountingTracker())

#: Two stages of training: first only the critic learns, then all parameters do.
STAGED = Method(ObjectRelations, stages=(Stage(0.25, lr_scale_by_path=lambda path: path[0] == "critic"), Stage(0.75)))


def squared_values(replayed):
    """Auxiliary loss of three times the mean squared value, and the metric of the mean squared value."""
    mean_square = jnp.square(replayed.factual.value).mean()
    return 3.0 * mean_square, {"squared_values": mean_square}


AUXILIARY = Method(ObjectRelations, auxiliary=squared_values)


@dataclasses.dataclass(frozen=True)
class HabitAdaptation:
    """Adaptation that makes past actions likelier: the fast weights are a bias per action."""

    rate: float = 0.5

    def init(self, policy, batch):
        return jnp.zeros((*batch, NUM_ACTIONS))

    def decide(self, policy, pathways, memory):
        last_action = jax.nn.one_hot(memory.action, NUM_ACTIONS, dtype=jnp.float32)
        bias = memory.fast + self.rate * last_action
        decision = policy.decide_with_changes(pathways, memory)
        return decision._replace(logits=decision.logits + bias, fast=bias)


ADAPTIVE = Method(ObjectRelations, adaptation=HabitAdaptation())


@dataclasses.dataclass(frozen=True)
class ParityControl:
    """Control with two choices, an even and an odd action; the number of views selects the pair."""

    num_choices: int = 2
    interval: int = 1

    def is_decision_step(self, state):
        return None

    def act(self, choice, state, knowledge):
        return 2 * (state["views"] % 3) + choice, state


CONTROLLED = Method(Reading, tracker=CountingTracker(), control=ParityControl())


@dataclasses.dataclass(frozen=True)
class EverySecondControl(ParityControl):
    """Control with a decision at every second action; the action in between is 1, and its choice is ignored."""

    interval: int = 2

    def is_decision_step(self, state):
        return state["views"] % 2 == 1

    def act(self, choice, state, knowledge):
        return jnp.where(self.is_decision_step(state), choice, 1), state


PATIENT = Method(Reading, tracker=CountingTracker(), control=EverySecondControl())


class TableRow(Experience):
    """Experience that equals the reading of `TableTracker`."""

    def __init__(self, spec, rngs):
        self.width = 2

    def encode(self, features, appearance, weights, reading):
        return reading


@dataclasses.dataclass(frozen=True)
class TableTracker:
    """Tracker that reads the table that was learned before training."""

    def init(self, knowledge):
        return jnp.int32(0)

    def update(self, state, knowledge, percept):
        return state + 1

    def read(self, state, knowledge, goal):
        return knowledge.method["table"][goal, :2]


def table_of_counts(banks, counts):
    """Learned knowledge: the share of every pair of categories in all counts, and the number of scenes."""
    pair_counts = counts.sum(axis=0)
    num_scenes = sum(len(bank.names) for bank in banks)
    return {"table": pair_counts / max(pair_counts.sum(), 1.0), "scenes": {"count": num_scenes}}


LEARNED = Method(TableRow, tracker=TableTracker(), learn=table_of_counts)


# Methods that break the contract


class BatchMean(Experience):
    """Experience that depends on all members of a batch."""

    def __init__(self, spec, rngs):
        self.width = 1

    def encode(self, features, appearance, weights, reading):
        num_visible = features.visible.sum(axis=-1, keepdims=True)
        return jnp.full_like(num_visible, num_visible.mean())


class WrongWidth(Reading):
    """Experience whose `width` is wrong: 5 instead of 4."""

    def __init__(self, spec, rngs):
        self.width = 5

    def encode(self, features, appearance, weights, reading):
        return features.visible[..., :4]


class NotFinite(BatchMean):
    """Experience that is NaN."""

    def encode(self, features, appearance, weights, reading):
        return jnp.log(-1.0 - features.visible[..., :1])


@dataclasses.dataclass(frozen=True)
class DtypeChangingTracker(CountingTracker):
    """Tracker whose update changes a count from an integer to a float."""

    def update(self, state, knowledge, percept):
        return {**super().update(state, knowledge, percept), "views": state["views"].astype(jnp.float32) + 1.0}


@dataclasses.dataclass(frozen=True)
class InvalidActionControl(ParityControl):
    """Control whose actions do not exist."""

    def act(self, choice, state, knowledge):
        return NUM_ACTIONS + choice * ROTATE_RIGHT, state


BATCH_DEPENDENT = Method(BatchMean)
WRONG_WIDTH = Method(WrongWidth)
NOT_FINITE = Method(NotFinite)
DTYPE_CHANGING = Method(Reading, tracker=DtypeChangingTracker())
INVALID_ACTION = Method(Reading, tracker=CountingTracker(), control=InvalidActionControl())
NO_METHOD = nnx.Module
