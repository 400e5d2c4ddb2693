"""A game by scripted keys is the environment's episode, and shows what an agent perceives."""

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
from jaxnav.game.session import KEY_ACTIONS, Game, PlayConfig, choose_episode, play_game, prepare_game
from jaxnav.layout import LayoutEstimator
from jaxnav.runs.policy import LoadedPolicy
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.task import MOVE_AHEAD, NUM_ACTIONS
from jaxnav.scenes.worlds import FileScenes

ENV, _ = tiny.world()
SCENES = FileScenes((tiny.KITCHEN, tiny.BEDROOM), "tiny")
LIMITS = {"kitchen": tiny.LIMITS[0], "bedroom": tiny.LIMITS[1]}
WORLD = CompiledWorld(SCENES, ENV, (tiny.BANK,), LIMITS, 0, len(tiny.BANK.ahead), 2, "tiny")
EPISODES = draw_episodes(tiny.BANK, 40)
POLICY = LoadedPolicy(tiny.lively(3), tiny.knowledge(), tiny.SPEC, tiny.SETTING, tiny.BANK.task)
NAMES = {action: key for key, action in KEY_ACTIONS.items()}


def game(index, policy=None):
    return Game(WORLD, EPISODES.take(np.array([index])), tiny.knowledge(), tiny.SETTING, policy, 0.1)


def longest():
    return int(EPISODES.best_length.argmax())


def played(game, keys):
    frames = []
    return play_game(game, keys, frames.append), frames


def follow(start, actions):
    """The poses of actions, by the tables alone."""
    poses = [start]
    for action in actions:
        poses.append(int(tiny.BANK.successor[poses[-1], action]))
    return poses


def shortest_keys(it):
    return [NAMES[action] for action in oracle_actions(it.bank, it.episode)[:, 0]]


def test_the_shortest_path_is_found():
    it = game(longest())
    best = int(it.episode.best_length[0])
    assert best > 2
    keys = shortest_keys(it)
    result, frames = played(it, keys)
    assert result.ending == "found in"
    assert result.poses == follow(int(it.episode.pose[0]), [KEY_ACTIONS[key] for key in keys])
    assert len(frames) == best  # the view after the last action is not shown


def test_a_detour_is_counted_and_other_keys_do_nothing():
    fits = EPISODES.best_length + 2 <= np.array(tiny.LIMITS)[EPISODES.scene]
    it = game(int(np.where(fits, EPISODES.best_length, 0).argmax()))
    best = int(it.episode.best_length[0])
    assert best > 1
    result, _ = played(it, ["left", "x", "d", "?", *shortest_keys(it), "up"])
    assert result.ending == "found in"
    assert len(result.poses) == best + 3


@pytest.mark.parametrize(
    ("keys", "ending"),
    [
        (["enter"], "wrong Done after"),
        (["q"], "left after"),
        (["a", "q", "enter"], "left after"),
        ([], "left after"),
    ],
)
def test_wrong_done_and_quitting_end_the_game(keys, ending):
    assert played(game(longest()), keys)[0].ending == ending


def test_time_runs_out():
    it = game(longest())
    limit = tiny.LIMITS[it.episode.scene[0]]
    result, frames = played(it, iter(lambda: "a", None))
    assert result.ending == "out of time after"
    assert len(result.poses) == limit + 1
    assert [look.time for look in frames] == list(range(limit))
    assert {look.step_limit for look in frames} == {limit}


def test_a_look_is_what_an_agent_perceives():
    """The pose is that of the tables; belief and gap are those of the estimator, view by view."""
    it, keys = game(longest()), ["a", "w", "f", "d"]
    result, frames = played(it, keys)
    assert result.poses == follow(int(it.episode.pose[0]), [KEY_ACTIONS[key] for key in keys])
    assert result.poses == [look.pose for look in frames]
    prior = tiny.knowledge().layout[tiny.world()[1].room[it.episode.scene[0]]]
    belief = None
    for look in frames:
        belief = tiny.believe(prior, belief, tiny.BANK.rows[look.pose])
        expected_weights = LayoutEstimator.goal_weights(belief, int(it.episode.goal[0]))
        np.testing.assert_allclose(look.layout_weights, expected_weights, 1e-6)
        assert look.layout_gap == pytest.approx(float(belief.gap), rel=1e-6)
        assert look.advice is None


def _chosen(choice, memory):
    """Logits, and the memory after each action."""
    return choice.logits, [
        POLICY.apply_choice(choice, jnp.int32(action), memory.room)[1] for action in range(NUM_ACTIONS)
    ]


def test_the_advice_is_the_policys_whatever_is_done():
    it, keys = game(longest(), POLICY), ["w", "a", "f", "d", "w"]
    result, frames = played(it, keys)
    memory, moved = POLICY.begin(tiny.world()[1].room[it.episode.scene[0]]), False
    decide = jax.jit(lambda seen, memory, **odometry: _chosen(POLICY.decide(seen, memory, 0.1, **odometry), memory))
    for time, (pose, look) in enumerate(zip(result.poses, frames, strict=True)):
        observation = Observation(jnp.asarray(tiny.BANK.rows[pose]), jnp.asarray(it.episode.goal[0]))
        odometry = {"heading": pose // 2 % 8, "moved": moved, "horizon": pose % 2}
        logits, memories = decide(observation, memory, **odometry)
        np.testing.assert_allclose(look.advice, jax.nn.softmax(logits), 1e-5)
        if time < len(keys):
            memory = memories[KEY_ACTIONS[keys[time]]]
            moved = pose // tiny.POSES_PER_CELL != result.poses[time + 1] // tiny.POSES_PER_CELL
    assert not np.allclose(frames[0].advice, frames[-1].advice)
    assert any(KEY_ACTIONS[key] == MOVE_AHEAD for key in keys)


def test_an_episode_is_drawn_for_a_goal():
    for seed in range(3):
        episode = choose_episode(tiny.BANK, "Chair", seed)
        assert tiny.CATEGORIES[episode.goal[0]] == "Chair"
    starts = {int(choose_episode(tiny.BANK, None, seed).pose[0]) for seed in range(5)}
    assert len(starts) > 1
    with pytest.raises(InputError, match=r"^--goal Sofa: choose one of Book, Chair"):
        choose_episode(tiny.BANK, "Sofa", 0)
    with pytest.raises(InputError, match="--seed -1: give a number of at least 0"):
        choose_episode(tiny.BANK, None, -1)


def test_a_policy_of_another_world_is_refused():
    with pytest.raises(InputError, match="--policy rooms-org: was trained for rooms; play with --world rooms"):
        prepare_game(PlayConfig("houses", policy="rooms-org"), Console(quiet=True))
