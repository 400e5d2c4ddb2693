"""Evaluation episodes: the fixed list, the perfect scores of the oracle, and the metrics."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.episodes import episodes_in

from jaxnav.baselines.shortest_path import oracle_actions, replay_actions, run_oracle
from jaxnav.env.make import build_environment
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes, joint_clusters
from jaxnav.evaluation.grid import EpisodeOutcome, episode_metrics, start_states
from jaxnav.scenes.generate.rooms import generate_room
from jaxnav.scenes.tables.compile import compile_bank
from jaxnav.scenes.task import LOOK_DOWN, LOOK_UP, Rules, Task

EPISODES = draw_episodes(tiny.BANK, 24, seed=1)


def test_drawn_episodes_are_possible_and_have_their_best_length():
    for scene, goal, pose, best_length in zip(*EPISODES[:4], strict=True):
        assert goal in tiny.BANK.goals[scene, : tiny.BANK.num_goals[scene]]
        first_pose = tiny.BANK.first_cell[scene] * tiny.POSES_PER_CELL
        assert first_pose <= pose < first_pose + tiny.BANK.num_cells[scene] * tiny.POSES_PER_CELL
        assert best_length == tiny.BANK.best_length[pose, goal] >= 1
    assert len(set(EPISODES.pose.tolist())) > 12  # episodes start in all parts of the rooms


def test_drawn_episodes_are_balanced_over_room_types_and_scenes():
    # Two kitchens, two living rooms, one bedroom and one bathroom.
    bank = compile_bank([generate_room("val", i, 1) for i in range(6)], Task())
    assert len(bank.names) == 6
    episodes = draw_episodes(bank, 42)
    assert episodes.rooms == ("bathroom", "bedroom", "kitchen", "living_room")

    # 42 / 4 is rounded up to 11 episodes of each room type; two scenes of a type alternate and get 6 and 5 episodes.
    np.testing.assert_array_equal(np.bincount(episodes.room), [11] * 4)
    counts_by_room_type = {bank.room_types[scene]: [] for scene in range(6)}
    for scene, num_episodes in enumerate(np.bincount(episodes.scene)):
        counts_by_room_type[bank.room_types[scene]].append(num_episodes)
    assert counts_by_room_type == {"kitchen": [6, 5], "living_room": [6, 5], "bedroom": [11], "bathroom": [11]}
    for room, scene in zip(episodes.room, episodes.scene, strict=True):
        assert episodes.rooms[room] == bank.room_types[scene]
    assert (episodes.best_length >= 1).all()


def test_drawn_episodes_depend_only_on_bank_and_seed():
    chex.assert_trees_all_equal(draw_episodes(tiny.BANK, 24, seed=1)[:5], EPISODES[:5])
    assert not np.array_equal(draw_episodes(tiny.BANK, 24, seed=2).pose, EPISODES.pose)


def test_zero_episodes_are_refused():
    with pytest.raises(InputError, match="--episodes 0"):
        draw_episodes(tiny.BANK, 0)


# Floor plans


def test_scenes_of_a_floor_plan_are_left_out_together():
    names = ("FloorPlan_Train1_1", "FloorPlan_Train2_1", "FloorPlan_Train1_5")
    episodes = episodes_in([0, 1, 2, 1, 1], names=names)
    assert episodes.floor_plans.tolist() == [f"FloorPlan_Train{number}" for number in (1, 2, 1, 2, 2)]
    clusters = episodes.clusters()
    # Two of five episodes are on the first floor plan. Without this plan, each of the other three has the weight 5 / 3;
    # without the second floor plan, each of the two has the weight 5 / 2.
    np.testing.assert_allclose(clusters.weights.T, [[1] * 5, [0, 5 / 3, 0, 5 / 3, 5 / 3], [5 / 2, 0, 5 / 2, 0, 0]])
    assert (clusters.scale.tolist(), clusters.degrees_of_freedom) == ([1 / 2, 1 / 2], 1)


@pytest.mark.parametrize(
    ("room", "names", "degrees"),
    [
        ([0, 0, 1, 1, 1], None, 5 - 2),
        # A room type with a single scene shows no variance, and neither does one with two scenes of one floor plan.
        ([0, 1, 1, 1, 1], None, 5 - 1),
        ([0, 0, 1, 1, 1], ("a", "a-replaced-1", "b", "c", "d"), 4 - 1),
    ],
)
def test_room_types_with_two_floor_plans_each_are_strata(room, names, degrees):
    clusters = episodes_in(range(5), room=room, names=names).clusters()
    assert clusters.degrees_of_freedom == degrees
    # Each stratum keeps its weight: two strata in the first case, a single one in the other cases.
    stratum = np.array(room) if degrees == 3 and names is None else np.zeros(5, int)
    for number in set(stratum):
        np.testing.assert_allclose(clusters.weights[stratum == number].sum(axis=0), (stratum == number).sum())


def test_joint_clusters_leave_a_floor_plan_out_of_all_lists():
    plain_episodes = episodes_in([0, 1, 1, 2, 3], room=[0, 0, 1, 1], names=("a", "b", "c", "d"))
    replaced_episodes = episodes_in([0, 0, 1, 2], room=[1, 0, 1], names=("c", "a-replaced-1", "d"))
    plain_clusters, replaced_clusters = joint_clusters([plain_episodes, replaced_episodes])
    assert plain_clusters.degrees_of_freedom == replaced_clusters.degrees_of_freedom == 4 - 2
    np.testing.assert_array_equal(plain_clusters.scale, replaced_clusters.scale)

    # Weights of an episode on each floor plan, without floor plan a, b, c or d. Bedroom a has one episode in each list,
    # and bedroom b has two plain episodes: without one bedroom, the two episodes of the other bedroom count double.
    # Kitchen c has one plain and two replaced episodes, kitchen d has one of each: without c the weight of all five is
    # that of the two episodes of d, without d that of the three of c. The other room type keeps its weights.
    weights = {"a": [0, 2, 1, 1], "b": [2, 0, 1, 1], "c": [1, 1, 0, 5 / 3], "d": [1, 1, 5 / 2, 0]}
    np.testing.assert_allclose(plain_clusters.weights[:, 1:], [weights[plan] for plan in "abbcd"])
    np.testing.assert_allclose(replaced_clusters.weights[:, 1:], [weights[plan] for plan in "ccad"])

    # Negative control: the separate clusters of a list cover only the three scenes of this list.
    assert replaced_episodes.clusters().weights.shape == (4, 1 + 3)


# Shortest paths in generated rooms


@pytest.mark.parametrize("rules", [Rules(), Rules(headings=12, horizons=(0.0,), success="near", success_distance=1.0)])
def test_oracle_has_sr_and_spl_of_one(rules):
    """The oracle follows the table of best lengths, so SR and SPL are exactly 1."""
    bank = compile_bank([generate_room("val", i, 5) for i in range(4)], Task(rules=rules))
    env, params = build_environment(bank, {}, 100)
    episodes = draw_episodes(bank, 200)
    actions = oracle_actions(bank, episodes)
    outcome = run_oracle([bank], [episodes], [params], env)

    # The metrics of shortest episodes.
    np.testing.assert_array_equal(outcome.length, episodes.best_length)
    metrics = episode_metrics(outcome, episodes.best_length)
    np.testing.assert_array_equal(metrics["sr"], np.ones(200))
    np.testing.assert_array_equal(metrics["spl"], np.ones(200))
    # Success needs a distance of at most 1.5 m (1 m under the second rules), and DTS subtracts 1 m.
    assert metrics["dts"].max() <= rules.success_distance - 1.0 + 1e-6
    assert metrics["sae"].max() <= 1
    assert np.median(outcome.length) > 3

    # Negative controls: wrong actions fail, and a limit of 3 steps ends the longer episodes of the oracle.
    wrong_actions = np.where(actions == LOOK_DOWN, LOOK_UP, (actions + 1) % 3)
    wrong_outcome = replay_actions(wrong_actions, start_states(episodes), params, env)
    assert not wrong_outcome.success.any()
    _, limited_params = build_environment(bank, {}, 3)
    stopped_outcome = replay_actions(actions, start_states(episodes), limited_params, env)
    np.testing.assert_array_equal(stopped_outcome.success, episodes.best_length <= 3)


# Metrics


def test_episode_metrics_follow_worked_arithmetic():
    leaves = EpisodeOutcome(
        done=jnp.array([True, True, False, True]),
        success=jnp.array([True, True, False, True]),
        length=jnp.array([10, 1, 30, 2], jnp.int32),
        moves=jnp.array([6, 0, 20, 1], jnp.int32),
        distance=jnp.array([1.4, 0.3, 3.5, 1.0], jnp.float32),
        num_decisions=jnp.array([10, 1, 30, 2], jnp.int32),
        total_weight=jnp.zeros(4),
    )
    outcome = jax.tree.map(np.asarray, leaves)  # the evaluator returns NumPy arrays
    metrics = episode_metrics(outcome, np.array([5, 1, 6, 2]), budgets=(2, 9))
    np.testing.assert_array_equal(metrics["sr"], [1, 1, 0, 1])
    # Success x L* / length: 5 / 10, 1 / 1, no success, 2 / 2.
    np.testing.assert_array_equal(metrics["spl"], [0.5, 1, 0, 1])
    # Distance minus 1 m, at least 0.
    np.testing.assert_allclose(metrics["dts"], [0.4, 0, 2.5, 0], atol=1e-6)
    # MoveAheads / (length - 1): 6 / 9; 0 for an episode that consists of Done; 0 without success; 1 / 1.
    np.testing.assert_allclose(metrics["sae"], [2 / 3, 0, 0, 1])
    np.testing.assert_array_equal(metrics["timeout"], [0, 0, 1, 0])
    np.testing.assert_array_equal(metrics["wrong_done"], [0, 0, 0, 0])
    # Successes after 10, 1 and 2 actions; Done counts as one.
    np.testing.assert_array_equal(metrics["sr@2"], [0, 1, 0, 1])
    np.testing.assert_array_equal(metrics["sr@9"], [0, 1, 0, 1])


def test_failed_episodes_are_time_outs_or_wrong_dones():
    outcome = EpisodeOutcome(
        done=jnp.array([True, True, False]),
        success=jnp.array([True, False, False]),
        length=jnp.ones(3, jnp.int32),
        moves=jnp.zeros(3, jnp.int32),
        distance=jnp.zeros(3),
        num_decisions=jnp.ones(3, jnp.int32),
        total_weight=jnp.zeros(3),
    )
    metrics = episode_metrics(jax.tree.map(np.asarray, outcome), np.ones(3, np.int32))
    np.testing.assert_array_equal(metrics["wrong_done"], [0, 1, 0])
    np.testing.assert_array_equal(metrics["timeout"], [0, 0, 1])
