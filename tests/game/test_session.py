"""A game played by scripted keys follows the rules of the environment, and shows an agent's belief and advice."""

import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny

from jaxnav.baselines.shortest_path import oracle_actions
from jaxnav.env.objectnav import Observation
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.game.config import PlayConfig
from jaxnav.game.session import KEY_ACTIONS, Game, choose_episode, play_game, prepare_game
from jaxnav.layout import LayoutEstimator
from jaxnav.runs.loaded_policy import LoadedPolicy
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.scenes.task import NUM_ACTIONS
from jaxnav.scenes.worlds import make_generated_scenes

EARLIER_POLICY = Path(__file__).parents[2] / "results" / "claims" / "runs" / "houses-org" / "policies" / "layout-0"

EPSILON = 0.1
WORLD = tiny.compiled_world()
_, PARAMS = tiny.world()
EPISODES = draw_episodes(tiny.BANK, 40)
POLICY = LoadedPolicy(tiny.random_params(3), tiny.knowledge(), tiny.SPEC, tiny.ESTIMATOR, tiny.BANK.task)
KEY_OF_ACTION = {action: key for key, action in KEY_ACTIONS.items()}


def start_game(index, policy=None):
    """A game in one of `EPISODES`."""
    episode = EPISODES.take(np.array([index]))
    return Game(WORLD, episode, tiny.knowledge(), tiny.ESTIMATOR, policy, EPSILON)


def start_longest_game(policy=None):
    return start_game(int(EPISODES.best_length.argmax()), policy)


def play_keys(game, keys):
    """Result of a game, and the view before each action."""
    views = []
    result = play_game(game, keys, views.append)
    return result, views


def poses_along(game, keys):
    """Poses to which keys lead according to the tables of the scenes."""
    poses = [int(game.episode.pose[0])]
    for key in keys:
        poses.append(int(tiny.BANK.successor[poses[-1], KEY_ACTIONS[key]]))
    return poses


def shortest_keys(game):
    """Keys of a shortest path to the goal."""
    return [KEY_OF_ACTION[action] for action in oracle_actions(game.bank, game.episode)[:, 0]]


def test_play_game_finds_the_goal_by_the_keys_of_the_shortest_path():
    game = start_longest_game()
    best_length = int(game.episode.best_length[0])
    assert best_length > 2
    keys = shortest_keys(game)
    result, views = play_keys(game, keys)
    assert result.ending == "found in"
    assert result.poses == poses_along(game, keys)
    assert len(views) == best_length  # the view after the last action is not shown


def test_play_game_counts_detours_and_ignores_unknown_keys():
    # Choose the longest episode in which two more actions are within the step limit.
    has_time = EPISODES.best_length + 2 <= np.array(tiny.STEP_LIMITS)[EPISODES.scene]
    game = start_game(int(np.where(has_time, EPISODES.best_length, 0).argmax()))
    best_length = int(game.episode.best_length[0])
    assert best_length > 1

    # The keys `left` and `d` undo each other, `x` and `?` do nothing, and `up` comes after the end of the game.
    result, _ = play_keys(game, ["left", "x", "d", "?", *shortest_keys(game), "up"])
    assert result.ending == "found in"
    assert len(result.poses) == best_length + 3


@pytest.mark.parametrize(
    ("keys", "ending"),
    [
        (["enter"], "wrong Done after"),
        (["q"], "left after"),
        (["a", "q", "enter"], "left after"),
        ([], "left after"),
    ],
)
def test_wrong_done_quitting_and_no_more_keys_end_the_game(keys, ending):
    result, _ = play_keys(start_longest_game(), keys)
    assert result.ending == ending


def test_play_game_ends_at_the_step_limit():
    game = start_longest_game()
    step_limit = tiny.STEP_LIMITS[game.episode.scene[0]]
    result, views = play_keys(game, itertools.repeat("a"))
    assert result.ending == "out of time after"
    assert len(result.poses) == step_limit + 1
    assert [view.time for view in views] == list(range(step_limit))
    assert {view.step_limit for view in views} == {step_limit}


def test_game_views_show_the_pose_belief_and_gap_of_an_agent():
    """The tables give the pose of each view, and the layout estimator gives its belief and gap."""
    game = start_longest_game()
    keys = ["a", "w", "f", "d"]
    result, views = play_keys(game, keys)
    assert result.poses == poses_along(game, keys)
    assert result.poses == [view.pose for view in views]

    prior = tiny.knowledge().priors[PARAMS.room[game.episode.scene[0]]]
    belief = None
    for view in views:
        belief = tiny.believe(prior, belief, tiny.BANK.rows[view.pose])
        expected_weights = LayoutEstimator.goal_weights(belief, int(game.episode.goal[0]))
        np.testing.assert_allclose(view.layout_weights, expected_weights, 1e-6)
        assert view.layout_gap == pytest.approx(float(belief.gap), rel=1e-6)
        assert view.advice is None


@jax.jit
def logits_and_next_memories(observation, memory, **odometry):
    """The policy's logits, and its memory after each of the actions."""
    choice = POLICY.decide(observation, memory, EPSILON, **odometry)
    next_memories = []
    for action in range(NUM_ACTIONS):
        _, next_memory = POLICY.apply_choice(choice, jnp.int32(action), memory.room)
        next_memories.append(next_memory)
    return choice.logits, next_memories


@pytest.mark.slow
def test_game_advice_is_the_policys_choice_along_the_path_of_the_player():
    game = start_longest_game(POLICY)
    keys = ["w", "a", "f", "d", "w"]
    result, views = play_keys(game, keys)

    # Repeat the policy's decisions along the poses of the game.
    memory = POLICY.begin(PARAMS.room[game.episode.scene[0]])
    moved = False
    for time, (pose, view) in enumerate(zip(result.poses, views, strict=True)):
        observation = Observation(jnp.asarray(tiny.BANK.rows[pose]), jnp.asarray(game.episode.goal[0]))
        odometry = {"heading": pose // 2 % 8, "moved": moved, "horizon": pose % 2}
        logits, next_memories = logits_and_next_memories(observation, memory, **odometry)
        np.testing.assert_allclose(view.advice, jax.nn.softmax(logits), 1e-5)

        # The player's action, not the policy's choice, decides what comes next.
        if time < len(keys):
            memory = next_memories[KEY_ACTIONS[keys[time]]]
            moved = pose // tiny.POSES_PER_CELL != result.poses[time + 1] // tiny.POSES_PER_CELL
    assert not np.allclose(views[0].advice, views[-1].advice)


def test_choose_episode_draws_an_episode_for_the_goal():
    for seed in range(3):
        episode = choose_episode(tiny.BANK, "Chair", seed)
        assert tiny.CATEGORIES[episode.goal[0]] == "Chair"


def test_choose_episode_starts_at_different_poses_by_seed():
    start_poses = {int(choose_episode(tiny.BANK, None, seed).pose[0]) for seed in range(5)}
    assert len(start_poses) > 1


@pytest.mark.parametrize(
    ("goal", "seed", "problem"),
    [
        ("Sofa", 0, r"^--goal Sofa: choose one of Book, Chair"),
        (None, -1, "--seed -1: give a number of at least 0"),
    ],
)
def test_choose_episode_refuses_invalid_options(goal, seed, problem):
    with pytest.raises(InputError, match=problem):
        choose_episode(tiny.BANK, goal, seed)


def test_prepare_game_refuses_a_policy_of_another_world():
    with pytest.raises(InputError, match=r"--policy rooms-org: .*; play with --world rooms"):
        prepare_game(PlayConfig("houses", policy="rooms-org"), Console(quiet=True))


def test_a_game_has_the_views_that_its_policy_was_trained_with(tmp_path):
    """The claims' policies are of an earlier version, and houses of today have other views."""
    scenes = tmp_path / "scenes.jsonl.gz"
    write_scenes(scenes, [make_generated_scenes("houses", "val", 1)[0]])
    game = prepare_game(PlayConfig("houses", scenes=scenes, policy=str(EARLIER_POLICY)), Console(quiet=True))
    assert game.policy is not None
    assert game.compiled_world.env.task.rules == game.policy.task.rules
    assert game.compiled_world.env.task.rules.front_cell == "nearest"
