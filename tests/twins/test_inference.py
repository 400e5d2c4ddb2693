"""Tests that every method infers as its plain-NumPy twin does, decision by decision.

A twin follows the episodes that the package plays. From the same bytes the twin computes features, belief, gap, layout
weights, both decisions and the removal by equations 1 and 2, and it has to choose the same action.

`JAXNAV_TWIN_EPISODES=1000` compares ten times as many episodes of every method and decision: the campaign of
docs/promises.md.
"""

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
from twins.policy import GEOMETRY_COLUMNS, IMAGE_PIXELS, TwinMethod, TwinPolicy, linear, relu

from jaxnav.env.make import build_environment
from jaxnav.env.objectnav import NUM_PRIORS, EnvParams, ObjectNav, prior_index
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.grid import start_states
from jaxnav.evaluation.playback import EpisodeTrace, play_episodes
from jaxnav.evaluation.removal import InferenceConfig
from jaxnav.evaluation.variants import EvaluationRow, inference_grid, table_row
from jaxnav.layout import ESTIMATORS, EstimatorConfig, prior_from_counts
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import METHODS
from jaxnav.policies.pathways import NO_ACTION
from jaxnav.policies.spatial_memory import SpatialMemory
from jaxnav.policies.spec import PolicySpec
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import Bank, compile_bank
from jaxnav.scenes.task import DONE, Task

STEP_LIMIT = 30
#: An estimator with weak prior rows: a view changes the belief much, the gaps are large, and removal changes actions.
WEAK_PRIOR_ESTIMATOR = dataclasses.replace(ESTIMATORS["calibrated"], strength=0.3)
METHOD_SIZES = {
    "vtnet": {"token_width": 8, "feedforward": 16, "tokens": 4, "encoder_layers": 1, "decoder_layers": 2},
    "tpn": {"tentative_width": 16},
}
#: Decision rules under which the episodes are played, a quarter of the episodes each.
EVALUATION_ROWS = (
    table_row("stde", 0.05, "residual", "argmax"),
    table_row("stde", 0.0, "paper", "sample"),
    table_row("tde", None, None, "argmax"),
    table_row("layout", None, None, "sample"),
)
#: Bound on the differences between the package (float32) and the twin (float64). Each of the two streams rounds its
#: logits to multiples of 2^-10, and a rounding error may send both to the other side: 2 x 2^-10 = 1.95e-3.
TOLERANCE = 2e-3
#: Largest share of the decisions at which package and twin may take different actions because the two best choices are
#: equal within the tolerance; one such tie is always allowed.
MAX_TIE_SHARE = 1 / 1000
#: Factors on the random parameters of a method. With a factor of 1, the attention scores of VTNet reach 400, and
#: rounding the attention weights alone would move logits by 2.6e-3.
PARAMETER_SCALES = {"vtnet": 0.5}
#: Factor for geometry in pixels. With a factor of 1, inputs of the recurrent gates reach 1,000.
PIXEL_PARAMETER_SCALE = 0.3
DECISIONS = ("fused", "streams")
#: Episodes of each method and decision; fewer where the twin computes thousands of derivatives per step.
NUM_EPISODES = int(os.environ.get("JAXNAV_TWIN_EPISODES", "100"))
NUM_EPISODES_BY_METHOD = {"savn": max(12, NUM_EPISODES // 10)}


class RoomsWorld(NamedTuple):
    """Four generated rooms.

    Attributes:
      bank: compiled rooms.
      env: environment of the rooms.
      env_params: parameters of the environment.
      counts: float32 [NUM_PRIORS, K, K], 1 more than the poses at which two categories are seen together.
    """

    bank: Bank
    env: ObjectNav
    env_params: EnvParams
    counts: np.ndarray


@functools.cache
def build_world(instance_counts: bool) -> RoomsWorld:
    """Compile the rooms; `instance_counts` adds the number of detected instances to their rows."""
    scenes = [generate_room("train", index, 0) for index in range(4)]
    bank = compile_bank(scenes, Task(instance_counts=instance_counts))
    env, env_params = build_environment(bank, {}, STEP_LIMIT)

    # Count the poses of each room type at which two categories are detected together.
    detected = env.row_format.presence(bank.rows).astype(np.float32)
    counts = np.ones((NUM_PRIORS, len(env.categories), len(env.categories)), np.float32)
    poses_per_cell = bank.task.rules.poses_per_cell
    first_poses = bank.first_cell * poses_per_cell
    end_poses = (bank.first_cell + bank.num_cells) * poses_per_cell
    for room_type, first_pose, end_pose in zip(bank.room_types, first_poses, end_poses, strict=True):
        room_rows = detected[first_pose:end_pose]
        counts[prior_index(room_type)] += room_rows.T @ room_rows
    return RoomsWorld(bank, env, env_params, counts)


def draw_room_episodes(num_episodes: int) -> EpisodeList:
    """Draw evaluation episodes in the rooms, which are equal with and without instance counts."""
    return draw_episodes(build_world(False).bank, num_episodes)


class Case(NamedTuple):
    """A policy with random parameters, and the world in which it plays."""

    world: RoomsWorld
    agent_loop: AgentLoop
    policy_params: Any
    knowledge: Knowledge

    def play(self, config: InferenceConfig, episodes: EpisodeList) -> list[EpisodeTrace]:
        """Play episodes with the package."""
        initial_states = start_states(episodes)
        env_params = self.world.env_params
        return play_episodes(config, self.policy_params, initial_states, self.agent_loop, env_params, self.knowledge)


@functools.cache
def build_case(
    method_name: str, decision: Any, estimator: EstimatorConfig = WEAK_PRIOR_ESTIMATOR, weight_kind: Any = "raw"
) -> Case:
    world = build_world(estimator.counts == "instances")
    method = METHODS[method_name]
    spec = PolicySpec(
        method,
        len(world.env.categories),
        tiny.SIZES,
        tuple(METHOD_SIZES.get(method_name, {}).items()),
        direct="goal" if decision == "streams" else "all",
        spatial_memory=SpatialMemory(world.bank.task.rules.headings),
        decision=decision,
        weight_kind=weight_kind,
    )

    # Statistics of the rooms: the layout prior, and the knowledge of the method.
    learned = {} if method.learn is None else method.learn([world.bank], world.counts)
    prior = jax.vmap(lambda room_counts: prior_from_counts(room_counts, estimator))(jnp.asarray(world.counts))
    knowledge = Knowledge(prior, jax.tree.map(jnp.asarray, learned))

    scale = PIXEL_PARAMETER_SCALE if weight_kind == "pixel" else PARAMETER_SCALES.get(method_name, 1.0)
    policy_params = jax.tree.map(lambda leaf: scale * leaf, tiny.random_params(3, spec))
    agent_loop = AgentLoop(world.env, spec, estimator if method.hosts_layout else None)
    return Case(world, agent_loop, policy_params, knowledge)


@dataclasses.dataclass
class Comparison:
    """Counts of compared decisions, and the differences between twin and package.

    Attributes:
      decisions: number of compared decisions.
      ties: number of episodes that the twin left because it chose another action.
      removals: number of decisions at which removal changes the best action.
      differences: choices and ends of episodes that differ by more than rounding.
      errors: largest absolute difference of each quantity at each decision, by name.
    """

    decisions: int = 0
    ties: int = 0
    removals: int = 0
    differences: list[str] = dataclasses.field(default_factory=list)
    errors: dict[str, list[float]] = dataclasses.field(default_factory=dict)

    def largest_errors(self) -> dict[str, float]:
        """Return the largest error of each quantity, by name."""
        return {name: max(errors) for name, errors in self.errors.items()}


def sampling_noise(episode: int, time: int, size: int) -> np.ndarray:
    """Return the Gumbel noise, by the episode's key, that sampling adds to logits."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), episode), time)
    return np.asarray(jax.random.gumbel(key, (size,)))


def compare(
    method: str,
    decision: str,
    row: EvaluationRow,
    episodes: EpisodeList,
    twin: type[TwinMethod],
    estimator: EstimatorConfig = WEAK_PRIOR_ESTIMATOR,
    weight_kind: str = "raw",
) -> Comparison:
    """Play episodes with the package and follow them with a twin."""
    case = build_case(method, decision, estimator, weight_kind)
    agent_loop = case.agent_loop
    assert agent_loop.spec is not None
    twin_params = jax.tree.map(lambda leaf: np.asarray(leaf, float), case.policy_params)
    policy = TwinPolicy(agent_loop.spec, twin_params, twin(case.knowledge))

    config = tiny.leaves_at(inference_grid([row], ("layout",), 1), 0)
    comparison = Comparison()
    for number, trace in enumerate(case.play(config, episodes)):
        # The twin begins with the belief of the room type.
        prior = None
        if agent_loop.estimator_config:
            room = case.world.env_params.room[int(episodes.scene[number])]
            prior = np.asarray(case.knowledge.priors[room])
        goal = int(episodes.goal[number])
        first_pose = int(episodes.pose[number])
        episode = TwinEpisode(policy, case.world.bank, prior, goal, first_pose)
        follow_episode(episode, trace, row, number, comparison)
    return comparison


def follow_episode(
    episode: TwinEpisode, trace: EpisodeTrace, row: EvaluationRow, number: int, comparison: Comparison
) -> None:
    """Infer with the twin at every step of an episode, and add the differences to the comparison.

    The twin leaves the episode where it chooses another action. Such a choice is a difference, unless the two best
    choices of the twin are equal within the tolerance.
    """
    action = NO_ACTION
    is_success = False
    for time, (expected_pose, action) in enumerate(zip(trace.pose.tolist(), trace.action.tolist(), strict=True)):
        # Compare the quantities behind the decision.
        inferred = episode.infer()
        action_logits, removal_weight = inferred.action_logits(row.variant, row.epsilon, row.form)
        values = {**inferred._asdict(), "action_logits": action_logits, "removal_weight": removal_weight}
        for name, value in values.items():
            expected_value = getattr(trace.inferred, name)[time]
            error = float(np.abs(expected_value - value).max())
            comparison.errors.setdefault(name, []).append(error)
        comparison.decisions += 1
        comparison.removals += int(action_logits.argmax() != inferred.factual_logits.argmax())

        # Compare the action.
        scores = action_logits
        if row.decoding == "sample":
            scores = scores + sampling_noise(number, time, len(action_logits))
        twin_action = episode.policy.method.act(int(scores.argmax()))
        if (episode.pose, twin_action) != (expected_pose, action):
            second_best, best = np.sort(scores)[-2:]
            if best - second_best > TOLERANCE:
                comparison.differences.append(f"episode {number}, step {time}")
            comparison.ties += 1
            return

        is_success = action == DONE and bool(episode.bank.best_length[episode.pose, episode.goal] == 1)
        episode.step(action)

    # An episode ends by Done or at the step limit.
    is_early_end = action != DONE and len(trace.pose) != STEP_LIMIT
    if is_success != trace.success or is_early_end:
        comparison.differences.append(f"end of episode {number}")


@pytest.mark.parametrize(
    ("method", "decision", "num_episodes"),
    [
        ("org", "fused", 12),
        # A method with a map and a local policy, and one with attention and two streams.
        pytest.param("semexp", "fused", 12, marks=pytest.mark.slow),
        pytest.param("vtnet", "streams", 12, marks=pytest.mark.exhaustive),
        *params_by_tier(
            (name, decision, NUM_EPISODES_BY_METHOD.get(name, NUM_EPISODES))
            for name, decision in itertools.product(TWINS, DECISIONS)
        ),
    ],
)
def test_every_decision_equals_that_of_the_twin(method, decision, num_episodes):
    episodes = draw_room_episodes(num_episodes)
    num_removals = 0
    for part, row in enumerate(EVALUATION_ROWS):
        part_episodes = episodes.take(np.arange(part, num_episodes, len(EVALUATION_ROWS)))
        comparison = compare(method, decision, row, part_episodes, TWINS[method])
        largest_errors = comparison.largest_errors()
        counts = dataclasses.replace(comparison, errors={})
        print(method, decision, row.variant, row.decoding, counts, largest_errors)

        assert comparison.differences == []
        assert comparison.ties <= 1 + MAX_TIE_SHARE * comparison.decisions
        assert max(largest_errors.values()) < TOLERANCE
        assert max(np.quantile(errors, 0.99) for errors in comparison.errors.values()) < TOLERANCE / 2
        num_removals += comparison.removals
    assert num_removals > 0


@pytest.mark.parametrize("method", params_by_tier(["org", "eotp", "semexp", "vtnet"], slow=["org"]))
def test_decisions_with_relative_weights_equal_those_of_the_twin(method):
    row = table_row("stde", 0.0, "paper", "argmax")
    episodes = draw_room_episodes(8)
    comparison = compare(method, "fused", row, episodes, TWINS[method], weight_kind="relative")
    assert comparison.differences == []
    assert comparison.ties <= 1 + MAX_TIE_SHARE * comparison.decisions
    assert max(comparison.largest_errors().values()) < TOLERANCE

    # A twin with raw weights has other logits.
    raw_twin = make_raw_weight_twin(method)
    raw_comparison = compare(method, "fused", row, episodes, raw_twin, weight_kind="relative")
    assert max(raw_comparison.errors["factual_logits"]) > 10 * TOLERANCE


@pytest.mark.slow
def test_decisions_with_geometry_in_pixels_equal_those_of_the_twin():
    row = table_row("stde", 0.0, "paper", "argmax")
    episodes = draw_room_episodes(8)
    comparison = compare("org", "fused", row, episodes, TWINS["org"], weight_kind="pixel")
    assert comparison.differences == []
    assert comparison.ties <= 1 + MAX_TIE_SHARE * comparison.decisions
    assert max(comparison.largest_errors().values()) < TOLERANCE

    # A twin whose experience reads unscaled geometry has other logits.
    unscaled_comparison = compare("org", "fused", row, episodes, UnscaledGeometryTwin, weight_kind="pixel")
    assert max(unscaled_comparison.errors["factual_logits"]) > 10 * TOLERANCE


class UnscaledGeometryTwin(TWINS["org"]):
    """A twin whose experience reads the geometry in the scale of the other pathways."""

    def encode(self, params, features, appearance, weights, reading, memory):
        table = features.table.copy()
        table[:, GEOMETRY_COLUMNS] /= IMAGE_PIXELS
        return super().encode(params, features._replace(table=table), appearance, weights, reading, memory)


def make_raw_weight_twin(method: str) -> type[TwinMethod]:
    """Make a twin whose layout weights off the goal add up to 1, as raw weights nearly do."""

    class RawWeightTwin(TWINS[method]):
        def encode(self, params, features, appearance, weights, reading, memory):
            is_goal = features.goal > 0
            raw_weights = np.where(is_goal, weights, weights / weights[~is_goal].sum())
            return super().encode(params, features, appearance, raw_weights, reading, memory)

    return RawWeightTwin


@pytest.mark.slow
@pytest.mark.parametrize("strength", [5.0, pytest.param(None, marks=pytest.mark.exhaustive)])
def test_decisions_of_the_paper_estimator_equal_those_of_the_twin(strength):
    """Equations 1 to 7 with instance counts, from a weak prior with large gaps and from the counts themselves."""
    estimator = dataclasses.replace(ESTIMATORS["paper"], strength=strength)
    episodes = draw_room_episodes(12)
    gap_errors = []
    weight_errors = []
    for row in (table_row("stde", 0.0, "paper", "argmax"), table_row("stde", 0.5, "paper", "sample")):
        comparison = compare("org", "fused", row, episodes, TWINS["org"], estimator)
        largest_errors = comparison.largest_errors()
        assert comparison.differences == []
        assert comparison.ties <= 1
        assert max(largest_errors.values()) < TOLERANCE
        gap_errors.append(largest_errors["gap"])
        weight_errors.append(largest_errors["layout_weights"])
    assert max(gap_errors) < 1e-4
    assert max(weight_errors) < 1e-6


@pytest.mark.slow
def test_twin_that_counts_presence_in_place_of_instances_is_noticed(monkeypatch):
    def unpack_presence(row: np.ndarray, num_categories: int) -> np.ndarray:
        return np.minimum(unpack_counts(row, num_categories), 1.0)

    monkeypatch.setattr(agent, "unpack_counts", unpack_presence)
    estimator = dataclasses.replace(ESTIMATORS["paper"], strength=5.0)
    row = table_row("stde", 0.0, "paper", "argmax")
    comparison = compare("org", "fused", row, draw_room_episodes(4), TWINS["org"], estimator)
    assert max(comparison.errors["gap"]) > 1e-2
    assert max(comparison.errors["layout_weights"]) > 1e-2


class UnweightedTwin(TwinRelations):
    """A twin that leaves the layout out."""

    def encode(self, params, features, appearance, weights, reading, memory):
        return super().encode(params, features, appearance, np.ones_like(weights), reading, memory)


def make_scaled_weight_twin(method: str) -> type[TwinMethod]:
    """Make a twin that multiplies the layout weights of a method by 0.9."""

    class ScaledWeightTwin(TWINS[method]):
        def encode(self, params, features, appearance, weights, reading, memory):
            return super().encode(params, features, appearance, 0.9 * weights, reading, memory)

    return ScaledWeightTwin


def make_wrong_goal_twin(method: str) -> type[TwinMethod]:
    """Make a twin that reads another category as the goal."""

    class WrongGoalTwin(TWINS[method]):
        def perceive(self, features):
            return features._replace(goal=np.roll(features.goal, 1))

    return WrongGoalTwin


def make_transposed_aggregation_twin(method: str) -> type[TwinMethod]:
    """Make a twin that aggregates appearances with R in place of its transpose."""

    class TransposedAggregationTwin(TWINS[method]):
        def aggregate(self, relations, appearance):
            return relations @ appearance

    return TransposedAggregationTwin


def make_untransposed_edges_twin(method: str) -> type[TwinMethod]:
    """Make a twin that mixes the edges without transposing them."""

    class UntransposedEdgesTwin(TWINS[method]):
        def relations(self, params, features):
            relations = relu(linear(params["edges"], features.table))
            for kernel in params["mix"]:
                relations = relu(relations @ kernel)
            return relations

    return UntransposedEdgesTwin


class EarlierStateTwin(TwinTentativeRelations):
    """A twin that remembers the state before an action in place of the state after it."""

    def trials(self, states, actions):
        keys, values = super().trials(states, actions)
        return keys, np.hstack([keys, values[:, len(keys[0]) :]])


class ScaledScoresTwin(TwinTentativeRelations):
    """A twin that divides the scores of trials by the square root of the width."""

    def scores(self, keys, state):
        return super().scores(keys, state) / np.sqrt(len(state))


class LaterStateTwin(TWINS["savn"]):
    """A twin that keeps the recurrent state after a decision in place of the state before it."""

    def adapt(self, params, inputs, memory, logits, hidden, reading):
        return super().adapt(params, inputs, memory._replace(hidden=[hidden]), logits, hidden, reading)


class DirectMemoryTwin(TWINS["eotp"]):
    """A twin whose attention reads the state of the direct stream in place of that of the experience stream."""

    def encode(self, params, features, appearance, weights, reading, memory):
        direct_memory = memory._replace(hidden=memory.hidden[:1])
        return super().encode(params, features, appearance, weights, reading, direct_memory)


class SwappedZonesTwin(TWINS["hoz"]):
    """A twin that reads the goal's zone before the next zone."""

    def read(self, goal):
        rooms, zones = super().read(goal)
        return rooms, zones[[0, 2, 1]]


#: Methods and decisions with planted mistakes: transpositions, wrong slots of memory, factors.
MISTAKES = {
    "org: w left out": ("org", "fused", UnweightedTwin),
    "org: another goal": ("org", "fused", make_wrong_goal_twin("org")),
    "org: aggregation transposed": ("org", "fused", make_transposed_aggregation_twin("org")),
    "org: edges not transposed": ("org", "fused", make_untransposed_edges_twin("org")),
    "org: w by a factor": ("org", "fused", make_scaled_weight_twin("org")),
}
EXHAUSTIVE_MISTAKES = {
    "hoz: aggregation transposed": ("hoz", "fused", make_transposed_aggregation_twin("hoz")),
    "tpn: aggregation transposed": ("tpn", "fused", make_transposed_aggregation_twin("tpn")),
    "tpn: state before the action": ("tpn", "fused", EarlierStateTwin),
    "savn: state after the decision": ("savn", "fused", LaterStateTwin),
    "eotp: memory of the direct stream": ("eotp", "streams", DirectMemoryTwin),
    "hoz: zones exchanged": ("hoz", "fused", SwappedZonesTwin),
    "tpn: scores over a root": ("tpn", "fused", ScaledScoresTwin),
}
for _method in ("eotp", "hoz", "semexp", "sp", "tpn", "vtnet"):
    EXHAUSTIVE_MISTAKES[f"{_method}: w by a factor"] = (_method, "fused", make_scaled_weight_twin(_method))


@pytest.mark.slow
@pytest.mark.parametrize(
    "mistake",
    [*MISTAKES, *(pytest.param(mistake, marks=pytest.mark.exhaustive) for mistake in EXHAUSTIVE_MISTAKES)],
)
def test_twin_with_a_planted_mistake_is_noticed(mistake):
    method, decision, twin = (MISTAKES | EXHAUSTIVE_MISTAKES)[mistake]
    comparison = compare(method, decision, EVALUATION_ROWS[0], draw_room_episodes(8), twin)
    largest_error = max(comparison.errors["factual_logits"])
    print(mistake, largest_error, len(comparison.differences))
    assert largest_error > 10 * TOLERANCE
