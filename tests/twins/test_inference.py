"""The whole inference step of every method against its plain-NumPy twin, decision by decision.

The twin goes along the episodes that the package plays: from the same bytes it makes features, belief, gap and weights,
both decisions and what is left of them by equations 1 and 2, and has to choose the same action.

`JAXNAV_TWIN_EPISODES=1000` takes ten times as many episodes of every method and decision, the whole campaign of
docs/promises.md.
"""

import collections
import dataclasses
import functools
import itertools
import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.tiers import params_by_tier
from twins import agent
from twins.agent import TwinEpisode
from twins.methods import TWINS, TwinRelations, TwinTentativeRelations
from twins.perception import unpack_counts
from twins.policy import TwinMethod, TwinPolicy, linear, relu

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import NUM_PRIORS, prior_index
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.evaluation.playback import EpisodeTrace, play_episodes
from jaxnav.evaluation.variants import EvaluationRow, inference_grid, table_row
from jaxnav.layout import ESTIMATORS, EstimatorConfig, prior_from_counts
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import METHODS
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import DONE, Task

LIMIT = 30
#: Weak prior rows: a view changes the belief much, the gaps are large, and what is removed changes actions.
SETTING = dataclasses.replace(ESTIMATORS["calibrated"], strength=0.3)
SIZES = {
    "vtnet": {"token_width": 8, "feedforward": 16, "tokens": 4, "encoder_layers": 1, "decoder_layers": 2},
    "tpn": {"tentative_width": 16},
}
#: How the episodes are inferred, a quarter each.
ROWS = (
    table_row("stde", 0.05, "residual", "argmax"),
    table_row("stde", 0.0, "paper", "sample"),
    table_row("tde", None, None, "argmax"),
    table_row("layout", None, None, "sample"),
)
TOLERANCE = 2e-3
#: Factors on drawn weights that are too lively: with whole ones, scores of VTNet's attention reach 400, and rounding
#: its weights alone would move logits by 2.6e-3.
CALMER = {"vtnet": 0.5}
DECISIONS = ("fused", "streams")
#: Episodes of each method and decision; fewer where the twin takes thousands of derivatives a step.
NUM_EPISODES = int(os.environ.get("JAXNAV_TWIN_EPISODES", "100"))
FEWER_EPISODES = {"savn": max(12, NUM_EPISODES // 10)}


@functools.cache
def world(instance_counts: bool = False) -> tuple[Any, Any, Any, Any]:
    """Return a bank of four rooms, their environment, and poses at which categories are seen together [R, K, K]."""
    bank = compile_bank([generate_room("train", i, 0) for i in range(4)], Task(instance_counts=instance_counts))
    env, params = build_environment(bank, {}, LIMIT)
    seen = env.row_format.presence(bank.rows).astype(np.float32)
    counts = np.ones((NUM_PRIORS, len(env.categories), len(env.categories)), np.float32)
    ends = (bank.first_cell + bank.num_cells) * bank.task.rules.poses_per_cell
    for room, begin, end in zip(bank.room_types, bank.first_cell * bank.task.rules.poses_per_cell, ends, strict=True):
        counts[prior_index(room)] += seen[begin:end].T @ seen[begin:end]
    return bank, env, params, counts


class Case(NamedTuple):
    """Hold a policy of a method, and what the package plays with it."""

    acting: AgentLoop
    weights: Any
    knowledge: Knowledge

    @property
    def world(self) -> tuple[Any, Any, Any, Any]:
        return world(self.acting.env.task.instance_counts)

    def played(self, cell: Any, episodes: EpisodeList) -> list[EpisodeTrace]:
        return play_episodes(cell, self.weights, start_states(episodes), self.acting, self.world[2], self.knowledge)


@functools.cache
def case(name: str, decision: Any, setting: EstimatorConfig = SETTING, weight_kind: Any = "raw") -> Case:
    bank, env, _, counts = world(setting.counts == "instances")
    method = METHODS[name]
    learned = {} if method.learn is None else method.learn([bank], counts)
    prior = jax.vmap(lambda one: prior_from_counts(one, setting))(jnp.asarray(counts))
    spec = PolicySpec(
        method,
        len(env.categories),
        tiny.SIZES,
        tuple(SIZES.get(name, {}).items()),
        direct="goal" if decision == "streams" else "all",
        spatial_memory=SpatialMemory(bank.task.rules.headings),
        decision=decision,
        weight_kind=weight_kind,
    )
    knowledge = Knowledge(prior, jax.tree.map(jnp.asarray, learned))
    weights = jax.tree.map(lambda leaf: CALMER.get(name, 1.0) * leaf, tiny.random_params(3, spec))
    return Case(AgentLoop(env, spec, setting if method.hosts_layout else None), weights, knowledge)


class Compared(NamedTuple):
    """Count what was compared, and hold by name how far the twin's numbers are from the package's, each time."""

    decisions: int
    ties: int
    removals: int
    differences: list[str]
    errors: dict[str, list[float]]


def noise(episode: int, time: int, size: int) -> np.ndarray:
    """Return what a sampled choice adds to its logits: Gumbel noise by the episode's key."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), episode), time)
    return np.asarray(jax.random.gumbel(key, (size,)))


def compare(
    method: str,
    decision: str,
    row: EvaluationRow,
    episodes: EpisodeList,
    twin: type[TwinMethod],
    setting: EstimatorConfig = SETTING,
    weight_kind: str = "raw",
) -> Compared:
    """Go along the episodes that the package plays.

    Where the best two choices are equal within its tolerance and the twin takes the other one, it leaves the episode.
    """
    played = case(method, decision, setting, weight_kind)
    bank, _, params, _ = played.world
    (acting, weights, knowledge), cell = played, tiny.leaves_at(inference_grid([row], ("layout",), 1), 0)
    assert acting.spec is not None
    policy = TwinPolicy(acting.spec, jax.tree.map(lambda leaf: np.asarray(leaf, float), weights), twin(knowledge))
    decisions, ties, removals, differences = 0, 0, 0, []
    errors: dict[str, list[float]] = collections.defaultdict(list)
    for number, trace in enumerate(played.played(cell, episodes)):
        goal, scene, pose = (int(getattr(episodes, name)[number]) for name in ("goal", "scene", "pose"))
        prior = np.asarray(knowledge.layout[params.room[scene]]) if acting.estimator_config else None
        episode, action, success = TwinEpisode(policy, bank, prior, goal, pose), NO_ACTION, False
        for time, (expected_pose, action) in enumerate(zip(trace.pose.tolist(), trace.action.tolist(), strict=True)):
            inferred = episode.infer()
            corrected, weight = inferred.action_logits(row.variant, row.epsilon, row.form)
            for name, value in {**inferred._asdict(), "action_logits": corrected, "removal_weight": weight}.items():
                expected = getattr(trace.inferred, name)[time]
                errors[name].append(float(np.abs(expected - value).max()))
            scores = corrected + (noise(number, time, len(corrected)) if row.decoding == "sample" else 0.0)
            decisions, removals = decisions + 1, removals + int(corrected.argmax() != inferred.factual_logits.argmax())
            if (episode.pose, policy.method.act(int(scores.argmax()))) != (expected_pose, action):
                if np.subtract(*np.sort(scores)[:-3:-1]) > TOLERANCE:
                    differences.append(f"episode {number}, step {time}")
                ties += 1
                break
            success = action == DONE and bank.best_length[episode.pose, goal] == 1
            episode.step(action)
        else:
            if success != trace.success or (action != DONE and len(trace.pose) != LIMIT):
                differences.append(f"end of episode {number}")
    return Compared(decisions, ties, removals, differences, dict(errors))


@pytest.mark.parametrize(
    ("method", "decision", "count"),
    [
        ("org", "fused", 12),
        # A method with a map and a local policy, and one with attention and two streams.
        pytest.param("semexp", "fused", 12, marks=pytest.mark.slow),
        pytest.param("vtnet", "streams", 12, marks=pytest.mark.exhaustive),
        *params_by_tier(
            (name, decision, FEWER_EPISODES.get(name, NUM_EPISODES))
            for name, decision in itertools.product(METHODS, DECISIONS)
        ),
    ],
)
def test_every_decision_is_the_twins(method, decision, count):
    whole, removals = draw_episodes(world()[0], count), 0
    for part, row in enumerate(ROWS):
        result = compare(method, decision, row, whole.take(np.arange(part, count, len(ROWS))), TWINS[method])
        worst = {name: max(errors) for name, errors in result.errors.items()}
        print(method, decision, row.variant, row.decoding, result._replace(errors={}), worst)
        assert result.differences == []
        assert result.ties <= 1 + result.decisions / 1000
        assert max(worst.values()) < TOLERANCE
        assert max(np.quantile(errors, 0.99) for errors in result.errors.values()) < TOLERANCE / 2
        removals += result.removals
    assert removals > 0


@pytest.mark.parametrize(
    ("method", "weight_kind"),
    params_by_tier([(name, "relative") for name in ("org", "eotp", "semexp", "vtnet")], slow=[("org", "relative")]),
)
def test_decisions_with_scaled_weights_are_the_twins(method, weight_kind):
    row = table_row("stde", 0.0, "paper", "argmax")
    episodes = draw_episodes(world()[0], 8)
    result = compare(method, "fused", row, episodes, TWINS[method], weight_kind=weight_kind)
    assert result.differences == []
    assert result.ties <= 1 + result.decisions / 1000
    assert max(max(errors) for errors in result.errors.values()) < TOLERANCE

    # A twin with raw weights has other logits.
    mistaken = compare(method, "fused", row, episodes, weights_of_sum_one(method), weight_kind=weight_kind)
    assert max(mistaken.errors["factual_logits"]) > 10 * TOLERANCE


def weights_of_sum_one(method: str) -> type[TwinMethod]:
    """Make a twin whose layout weights off the goal add up to 1, as raw weights nearly do."""

    class Raw(TWINS[method]):
        def encode(self, params, features, appearance, weights, reading, memory):
            is_goal = features.goal > 0
            raw_weights = np.where(is_goal, weights, weights / weights[~is_goal].sum())
            return super().encode(params, features, appearance, raw_weights, reading, memory)

    return Raw


@pytest.mark.slow
@pytest.mark.parametrize("strength", [5.0, pytest.param(None, marks=pytest.mark.exhaustive)])
def test_decisions_of_the_setting_paper_are_the_twins(strength):
    """Equations 1 to 7 with instance counts, from a weak prior with large gaps and from the counts themselves."""
    setting = dataclasses.replace(ESTIMATORS["paper"], strength=strength)
    removal_row, threshold_row = table_row("stde", 0.0, "paper", "argmax"), table_row("stde", 0.5, "paper", "sample")
    episodes = draw_episodes(world()[0], 12)
    gaps, weights = [], []
    for row in (removal_row, threshold_row):
        result = compare("org", "fused", row, episodes, TWINS["org"], setting)
        worst = {name: max(errors) for name, errors in result.errors.items()}
        assert result.differences == []
        assert result.ties <= 1
        assert max(worst.values()) < TOLERANCE
        gaps.append(worst["gap"])
        weights.append(worst["layout_weights"])
    assert max(gaps) < 1e-4
    assert max(weights) < 1e-6


@pytest.mark.slow
def test_a_twin_that_counts_presence_is_noticed(monkeypatch):
    monkeypatch.setattr(agent, "unpack_counts", lambda row, size: np.minimum(unpack_counts(row, size), 1.0))
    setting = dataclasses.replace(ESTIMATORS["paper"], strength=5.0)
    row = table_row("stde", 0.0, "paper", "argmax")
    result = compare("org", "fused", row, draw_episodes(world()[0], 4), TWINS["org"], setting)
    assert max(result.errors["gap"]) > 1e-2
    assert max(result.errors["layout_weights"]) > 1e-2


class Unweighted(TwinRelations):
    """Leave the layout out."""

    def encode(self, params, features, appearance, weights, reading, memory):
        return super().encode(params, features, appearance, np.ones_like(weights), reading, memory)


def weights_times(factor: float, method: str) -> type[TwinMethod]:
    """Make a twin that multiplies the layout weights of a method by a factor."""

    class Scaled(TWINS[method]):
        def encode(self, params, features, appearance, weights, reading, memory):
            return super().encode(params, features, appearance, factor * weights, reading, memory)

    return Scaled


def goal_mistaken(method: str) -> type[TwinMethod]:
    """Make a twin that takes another category for the goal."""

    class Mistaken(TWINS[method]):
        def perceive(self, features):
            return features._replace(goal=np.roll(features.goal, 1))

    return Mistaken


def aggregation_transposed(method: str) -> type[TwinMethod]:
    """Make a twin that aggregates appearances with R in place of its transpose."""

    class Transposed(TWINS[method]):
        def aggregate(self, relations, appearance):
            return relations @ appearance

    return Transposed


def edges_transposed(method: str) -> type[TwinMethod]:
    """Make a twin that mixes the edges before they are transposed."""

    class Transposed(TWINS[method]):
        def relations(self, params, features):
            relations = relu(linear(params["edges"], features.table))
            for kernel in params["mix"]:
                relations = relu(relations @ kernel)
            return relations

    return Transposed


class StateBeforeAction(TwinTentativeRelations):
    """Remember the state before an action in place of the one that it led to."""

    def trials(self, states, actions):
        keys, values = super().trials(states, actions)
        return keys, np.hstack([keys, values[:, len(keys[0]) :]])


class ScoresOverRoot(TwinTentativeRelations):
    """Divide the scores of trials by the square root of the width."""

    def scores(self, keys, state):
        return super().scores(keys, state) / np.sqrt(len(state))


class StateAfterDecision(TWINS["savn"]):
    """Keep the recurrent state after a decision in place of the one before it."""

    def adapt(self, params, inputs, memory, logits, hidden, reading):
        return super().adapt(params, inputs, memory._replace(hidden=[hidden]), logits, hidden, reading)


class MemoryOfDirectStream(TWINS["eotp"]):
    """Attend with the state of the direct stream in place of that of the experience stream."""

    def encode(self, params, features, appearance, weights, reading, memory):
        return super().encode(params, features, appearance, weights, reading, memory._replace(hidden=memory.hidden[:1]))


class ZonesExchanged(TWINS["hoz"]):
    """Read the goal's zone before the next zone."""

    def read(self, goal):
        rooms, zones = super().read(goal)
        return rooms, zones[[0, 2, 1]]


#: Methods and decisions with planted mistakes: transpositions, wrong slots of memory, factors.
MISTAKES = {
    "org: w left out": ("org", "fused", Unweighted),
    "org: another goal": ("org", "fused", goal_mistaken("org")),
    "org: aggregation transposed": ("org", "fused", aggregation_transposed("org")),
    "org: edges not transposed": ("org", "fused", edges_transposed("org")),
    "org: w by a factor": ("org", "fused", weights_times(0.9, "org")),
}
SLOW_MISTAKES = {
    "hoz: aggregation transposed": ("hoz", "fused", aggregation_transposed("hoz")),
    "tpn: aggregation transposed": ("tpn", "fused", aggregation_transposed("tpn")),
    "tpn: state before the action": ("tpn", "fused", StateBeforeAction),
    "savn: state after the decision": ("savn", "fused", StateAfterDecision),
    "eotp: memory of the direct stream": ("eotp", "streams", MemoryOfDirectStream),
    "hoz: zones exchanged": ("hoz", "fused", ZonesExchanged),
    "tpn: scores over a root": ("tpn", "fused", ScoresOverRoot),
}
for _method in ("eotp", "hoz", "semexp", "sp", "tpn", "vtnet"):
    SLOW_MISTAKES[f"{_method}: w by a factor"] = (_method, "fused", weights_times(0.9, _method))


@pytest.mark.slow
@pytest.mark.parametrize(
    "mistake", [*MISTAKES, *(pytest.param(mistake, marks=pytest.mark.exhaustive) for mistake in SLOW_MISTAKES)]
)
def test_a_twin_that_is_wrong_is_noticed(mistake):
    method, decision, twin = (MISTAKES | SLOW_MISTAKES)[mistake]
    result = compare(method, decision, ROWS[0], draw_episodes(world()[0], 8), twin)
    worst = max(result.errors["factual_logits"])
    print(mistake, worst, len(result.differences))
    assert worst > 10 * TOLERANCE
