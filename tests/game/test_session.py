"""A game by scripted keys is the environment's episode, and shows what an agent perceives."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny

from jaxnav.env.objectnav import Observation
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.game.episode import Game, choose_episode
from jaxnav.game.prepare import prepare_game
from jaxnav.game.session import KEY_ACTIONS, play_game
from jaxnav.layout import LayoutEstimator
from jaxnav.runs.policy import LoadedPolicy
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.task import DONE, MOVE_AHEAD, NUM_ACTIONS
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


def actions_of(poses):
    """Actions that lead from pose to pose, Done at the last."""
    steps = itertools.pairwise(poses[:-1])
    moves = [next(a for a in range(NUM_ACTIONS) if tiny.BANK.successor[pose, a] == after) for pose, after in steps]
    return [*moves, DONE]


def test_the_shortest_path_is_found_with_spl_1():
    it = game(longest())
    best = int(it.episode.best_length[0])
    assert best > 2
    quit_game, _ = played(it, "q")
    actions = actions_of(quit_game.shortest_poses)
    ending, frames = played(it, [NAMES[action] for action in actions])
    assert (ending.success, ending.said_done, ending.has_quit, ending.spl) == (True, True, False, 1.0)
    assert ending.poses == follow(int(it.episode.pose[0]), actions)
    assert len(frames) == best  # the view after the last action is not shown


def test_a_detour_costs_spl_and_other_keys_do_nothing():
    """Two turns there and back before a path of L* actions: L* / (L* + 2)."""
    fits = EPISODES.best_length + 2 <= np.array(tiny.LIMITS)[EPISODES.scene]
    it = game(int(np.where(fits, EPISODES.best_length, 0).argmax()))
    best = int(it.episode.best_length[0])
    assert best > 1
    quit_game, _ = played(it, "q")
    keys = ["left", "x", "d", "?", *(NAMES[action] for action in actions_of(quit_game.shortest_poses)), "up"]
    ending, _ = played(it, keys)
    assert ending.success
    assert ending.spl == pytest.approx(best / (best + 2))


@pytest.mark.parametrize(
    ("keys", "ends"),
    [(["enter"], (True, False)), (["q"], (False, True)), (["a", "q", "enter"], (False, True)), ([], (False, True))],
)
def test_wrong_done_and_quitting_fail(keys, ends):
    ending, _ = played(game(longest()), keys)
    assert (ending.said_done, ending.has_quit) == ends
    assert (ending.success, ending.spl) == (False, 0.0)


def test_time_runs_out():
    it = game(longest())
    limit = tiny.LIMITS[it.episode.scene[0]]
    ending, frames = played(it, iter(lambda: "a", None))
    assert (ending.success, ending.said_done, ending.has_quit) == (False, False, False)
    assert len(ending.poses) == limit + 1
    assert [look.time for look in frames] == list(range(limit))
    assert {look.step_limit for look in frames} == {limit}


def test_a_look_is_what_an_agent_perceives():
    """View and detections are those of the row; belief and gap those of the estimator, view by view."""
    it, keys = game(longest()), ["a", "w", "f", "d"]
    ending, frames = played(it, keys)
    assert ending.poses == follow(int(it.episode.pose[0]), [KEY_ACTIONS[key] for key in keys])
    prior = tiny.knowledge().layout[tiny.world()[1].room[it.episode.scene[0]]]
    belief = None
    for pose, look in zip(ending.poses, frames, strict=True):
        row = tiny.BANK.rows[pose]
        belief = tiny.believe(prior, belief, row)
        np.testing.assert_allclose(
            look.goal_weights, LayoutEstimator.goal_weights(belief, int(it.episode.goal[0])), 1e-6
        )
        assert look.gap == pytest.approx(float(belief.gap), rel=1e-6)
        np.testing.assert_array_equal(look.view_cells.ravel(), ENV.row_format.view_cells(row))
        detections = ENV.row_format.detections(row)
        assert {name for name, *_ in look.detections} == {
            tiny.CATEGORIES[k] for k in np.flatnonzero(ENV.row_format.presence(row))
        }
        for (
            name,
            ahead,
            right,
            confidence,
        ) in look.detections:  # bytes of 1 / 51 m ahead, 1 / 25.4 m right of 128, 1 / 255
            expected = detections[tiny.CATEGORIES.index(name)]
            np.testing.assert_allclose([51 * ahead, 128 + 25.4 * right, 255 * confidence], expected[:3])
        distances = [np.hypot(ahead, right) for _, ahead, right, _ in look.detections]
        assert distances == sorted(distances)
        heading, horizon = pose // 2 % 8, pose % 2
        assert (look.heading, look.horizon) == (45 * heading, 30 * horizon)
        assert look.advice is None


def _chosen(choice, memory):
    """Logits, and the memory after each action."""
    return choice.logits, [
        POLICY.apply_choice(choice, jnp.int32(action), memory.room)[1] for action in range(NUM_ACTIONS)
    ]


def test_the_advice_is_the_policys_whatever_is_done():
    it, keys = game(longest(), POLICY), ["w", "a", "f", "d", "w"]
    ending, frames = played(it, keys)
    memory, moved = POLICY.begin(tiny.world()[1].room[it.episode.scene[0]]), False
    decide = jax.jit(lambda seen, memory, **odometry: _chosen(POLICY.decide(seen, memory, 0.1, **odometry), memory))
    for time, (pose, look) in enumerate(zip(ending.poses, frames, strict=True)):
        observation = Observation(jnp.asarray(tiny.BANK.rows[pose]), jnp.asarray(it.episode.goal[0]))
        odometry = {"heading": pose // 2 % 8, "moved": moved, "horizon": pose % 2}
        logits, memories = decide(observation, memory, **odometry)
        np.testing.assert_allclose(look.advice, jax.nn.softmax(logits), 1e-5)
        if time < len(keys):
            memory = memories[KEY_ACTIONS[keys[time]]]
            moved = pose // tiny.POSES_PER_CELL != ending.poses[time + 1] // tiny.POSES_PER_CELL
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
        prepare_game("houses", policy="rooms-org")
