"""Keys come one by one from a terminal, which is left as it was; the screen fits one of 80 columns."""

import io
import os

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support import tiny_world as tiny

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.game.session import Game, GameResult, GameView
from jaxnav.game.terminal import game_screen, read_keys, result_screen
from jaxnav.layout import ESTIMATORS
from jaxnav.policies.method import Knowledge
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.worlds import FileScenes

pty = pytest.importorskip("pty")
termios = pytest.importorskip("termios")

ENV, _ = tiny.world()
EPISODES = draw_episodes(tiny.BANK, 40)
BOOKS = EPISODES.take(np.flatnonzero((EPISODES.goal == 0) & (EPISODES.scene == 0)))
SCENES = FileScenes((tiny.KITCHEN, tiny.BEDROOM), "tiny")
POSE = 3  # heading 1 of 8, the lower horizon


def test_keys_have_names_and_the_terminal_is_restored():
    controller, terminal = pty.openpty()
    with os.fdopen(terminal, "r+b", buffering=0) as raw, io.TextIOWrapper(raw) as stream:
        before = termios.tcgetattr(terminal)
        with read_keys(stream) as keys:
            during = termios.tcgetattr(terminal)[3]
            assert not during & (termios.ECHO | termios.ICANON)
            os.write(controller, b"w\x1b[A\x1b[D\x1bOC\r\x1b[5~q")
            assert [next(keys) for _ in range(7)] == ["w", "up", "left", "right", "enter", "\x1b[5~", "q"]
        assert termios.tcgetattr(terminal) == before
        with pytest.raises(KeyboardInterrupt), read_keys(stream):
            raise KeyboardInterrupt
        assert termios.tcgetattr(terminal) == before
    os.close(controller)


def test_what_is_no_terminal_is_refused(tmp_path):
    with (
        (tmp_path / "file").open("w+") as file,
        pytest.raises(InputError, match="play: the input is no terminal"),
        read_keys(file),
    ):
        pass


def book_game(detections=None):
    """A search for the book nearest by, with given bytes of detections at `POSE`."""
    row_format = RowFormat(len(tiny.CATEGORIES))
    cells = np.zeros((row_format.view, row_format.view), np.uint8)
    cells[0] = 1
    cells[3, 5] = 2
    detection_table = np.zeros((len(tiny.CATEGORIES), 4), np.uint8)
    for category, detection in (detections or {}).items():
        detection_table[tiny.CATEGORIES.index(category)] = detection
    rows = tiny.BANK.rows.copy()
    rows[POSE] = row_format.pack(jnp.asarray(detection_table), jnp.asarray(cells))
    bank = tiny.BANK._replace(rows=rows)
    world = CompiledWorld(SCENES, ENV, (bank,), {}, 9, len(bank.ahead), 2, "tiny")
    nearest = BOOKS.take(np.array([BOOKS.best_length.argmin()]))
    return Game(world, nearest, Knowledge(jnp.zeros(1)), ESTIMATORS["paper"])


#: Confidence, metres ahead in 1 / 51, to the right in 1 / 25.4 from 128, size.
SEEN = {"Book": (230, 26, 128, 9), "Fridge": (128, 51, 153, 9), "Chair": (128, 204, 26, 9)}
GAME = book_game(SEEN)


def text(renderable, width=80):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(renderable)
    return console.export_text()


def look(pose=POSE, advice=None):
    return GameView(pose, 3, 9, np.array([1.0, 0.25, 0.5]), 0.6, advice)


def test_the_screen_says_what_is_perceived():
    shown = text(game_screen(GAME, look(advice=np.array([0.1, 0.6, 0.25, 0.05, 0.0, 0.0]))))
    assert max(map(len, shown.splitlines())) <= 80
    assert "Looking for Book" in shown
    assert "step 3 of 9, heading 45°, camera 30° down" in shown
    for line in ("a Book          0.5 m ↑ 0°", "b Fridge        1.4 m → 45°", "c Chair         5.7 m ← 45°"):
        assert line in shown
    assert "Fridge        ━━━━━ 0.50" in shown  # the widest bar
    assert "Chair         ━━    0.25" in shown  # half of five, to even
    assert "gap D         ━━━   0.60" in shown
    assert "the policy: RotateLeft 60 %, RotateRight 25 %, MoveAhead 10 %" in shown


def test_the_view_has_the_agent_at_the_bottom():
    """Book is two cells ahead, the fridge four ahead and four to the right; the chair is beyond the view."""
    lines = text(game_screen(GAME, look())).splitlines()
    rows = [line[1:23] for line in lines if line.startswith("│")][:11]
    assert rows[10] == "· " * 5 + "▲ " + "· " * 5
    assert rows[8] == " " * 10 + "a " + " " * 10
    assert rows[7] == " " * 10 + "██" + " " * 10
    assert rows[6] == " " * 18 + "b   "
    assert not any("c" in row for row in rows)


def test_nothing_detected_is_said():
    shown = text(game_screen(book_game(), look()))
    assert "nothing" in shown
    assert "the policy" not in shown
    assert "camera" not in text(game_screen(book_game(), look(pose=POSE - 1)))


@pytest.mark.parametrize("ending", ["found in", "wrong Done after", "left after", "out of time after"])
def test_the_end_says_how_it_went(ending):
    """A walk that is twice as long as the shortest path has an SPL of 50 %, if it succeeds."""
    best = int(GAME.episode.best_length[0])
    poses = [int(GAME.episode.pose[0])] * (2 * best + 1)
    spl = 50 if ending == "found in" else 0
    expected = f"Book: {ending} {2 * best} actions; a shortest path takes {best}. SPL {spl} %"
    assert expected in text(result_screen(GAME, GameResult(poses, ending), 80))


def test_the_map_shows_both_paths():
    """The kitchen is 4 x 4 standable cells, furniture to the right and behind; z is up, so the last row comes first.

    From cell (0, 0) the player goes to (0, 1); the shortest path leads from (0, 2) to (1, 1). The books are at
    (x, z) = (0.25, 1.75), past the last row, and (1.5, 0), past the last column.
    """
    episode = GAME.episode._replace(pose=np.array([44]), best_length=np.array([3]))
    game = GAME._replace(episode=episode)
    result = GameResult([0, tiny.POSES_PER_CELL], "left after")
    wide = text(result_screen(game, result, 80)).splitlines()[:5]
    assert [line.rstrip() for line in wide] == [
        "░ ░ ░ ░ ░ ░",
        "· · · · ░ ░",
        "· · · · ░ ░",
        "· ○ · · ░ ░",
        "S ● ○ · ░ ░",
    ]
    narrow = text(result_screen(game, result, 11)).splitlines()
    assert "S●○·░░" in narrow
