"""What is on the screen, and that it fits a terminal of 80 columns."""

import io

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny

from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.game.episode import Game, GameResult, GameView
from jaxnav.game.screen import game_screen, result_screen
from jaxnav.layout import ESTIMATORS
from jaxnav.policies.method import Knowledge
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.worlds import FileScenes

ENV, _ = tiny.world()
EPISODES = draw_episodes(tiny.BANK, 40)
BOOK = EPISODES.take(np.flatnonzero((EPISODES.goal == 0) & (EPISODES.scene == 0))[:1])
WORLD = CompiledWorld(
    FileScenes((tiny.KITCHEN, tiny.BEDROOM), "tiny"), ENV, (tiny.BANK,), {}, 9, len(tiny.BANK.ahead), 2, "tiny"
)
GAME = Game(WORLD, BOOK, Knowledge(jnp.zeros(1)), ESTIMATORS["paper"])


def text(renderable, width=80):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(renderable)
    return console.export_text()


def look(**changes):
    cells = np.zeros((11, 11), np.uint8)
    cells[0] = 1
    cells[3, 5] = 2
    seen = [("Book", 0.5, 0.0, 0.9), ("CoffeeMachine", 1.0, 1.0, 0.5), ("Chair", 4.0, -4.0, 0.5)]
    fields = {"time": 3, "step_limit": 9, "heading": 45.0, "horizon": 30.0, "view_cells": cells, "detections": seen}
    weights = np.array([1.0, 0.25, 0.5])
    return GameView(**fields | {"goal_weights": weights, "gap": 0.6, "advice": None} | changes)


def test_the_screen_says_what_is_perceived():
    shown = text(game_screen(GAME, look(advice=np.array([0.1, 0.6, 0.25, 0.05, 0.0, 0.0]))))
    assert max(map(len, shown.splitlines())) <= 80
    assert "Looking for Book" in shown
    assert "step 3 of 9, heading 45°, camera 30° down" in shown
    for line in ("a Book          0.5 m ↑ 0°", "b CoffeeMachine 1.4 m → 45°", "c Chair         5.7 m ← 45°"):
        assert line in shown
    assert "Fridge        ━━━━━ 0.50" in shown  # the widest bar
    assert "Chair         ━━    0.25" in shown  # half of five, to even
    assert "gap D         ━━━   0.60" in shown
    assert "the policy: RotateLeft 60 %, RotateRight 25 %, MoveAhead 10 %" in shown


def test_the_view_has_the_agent_at_the_bottom():
    """Book is two cells ahead, the machine four ahead and four to the right; the chair is beyond the view."""
    lines = text(game_screen(GAME, look())).splitlines()
    rows = [line[1:23] for line in lines if line.startswith("│")][:11]
    assert rows[10] == "· " * 5 + "▲ " + "· " * 5
    assert rows[8] == " " * 10 + "a " + " " * 10
    assert rows[7] == " " * 10 + "██" + " " * 10
    assert rows[6] == " " * 18 + "b   "
    assert not any("c" in row for row in rows)


def test_nothing_detected_is_said():
    shown = text(game_screen(GAME, look(detections=[], horizon=0.0)))
    assert "nothing" in shown
    assert "camera" not in shown
    assert "the policy" not in shown


@pytest.mark.parametrize(
    ("ending", "words"),
    [
        ({"success": True, "said_done": True}, "found in 2 actions; a shortest path takes 1. SPL 50 %"),
        ({"said_done": True}, "wrong Done after 2 actions; a shortest path takes 1. SPL 0 %"),
        ({"has_quit": True}, "left after 2 actions"),
        ({}, "out of time after 2 actions"),
    ],
)
def test_the_end_says_how_it_went(ending, words):
    pose = int(BOOK.pose[0])
    how = {"success": False, "said_done": False, "has_quit": False} | ending
    assert f"Book: {words}" in text(result_screen(GAME, GameResult([pose] * 3, [pose] * 2, **how), tiny.KITCHEN, 80))


def test_the_map_shows_both_paths():
    """The kitchen is 4 x 4 standable cells, furniture to the right and behind; z is up, so the last row comes first.

    From cell (0, 0) the player goes to (0, 1), the shortest path to (1, 0). The books are at (x, z) = (0.25, 1.75),
    past the last row, and (1.5, 0), past the last column.
    """
    per_cell = tiny.POSES_PER_CELL
    ending = GameResult([0, per_cell], [0, 4 * per_cell], False, False, True)
    wide = text(result_screen(GAME, ending, tiny.KITCHEN, 80)).splitlines()[:5]
    assert [line.rstrip() for line in wide] == [
        "░ ░ ░ ░ ░ ░",
        "· · · · ░ ░",
        "· · · · ░ ░",
        "○ · · · ░ ░",
        "S ● · · ░ ░",
    ]
    narrow = text(result_screen(GAME, ending, tiny.KITCHEN, 11)).splitlines()
    assert "S●··░░" in narrow
