"""Keys come one by one from a terminal, which is restored at the end; the screen fits 80 columns."""

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
from jaxnav.scenes.tables.observation_row import RowFormat

pty = pytest.importorskip("pty")
termios = pytest.importorskip("termios")

EPISODES = draw_episodes(tiny.BANK, 40)
BOOK_EPISODES = EPISODES.take(np.flatnonzero((EPISODES.goal == 0) & (EPISODES.scene == 0)))
POSE = 3  # heading 1 of 8, the lower horizon


@pytest.fixture
def pseudo_terminal():
    """A function that types bytes, and the stream of the terminal."""
    controller, terminal = pty.openpty()
    with os.fdopen(terminal, "r+b", buffering=0) as raw_stream, io.TextIOWrapper(raw_stream) as stream:
        yield lambda typed: os.write(controller, typed), stream
    os.close(controller)


def test_read_keys_names_keys_as_they_are_typed(pseudo_terminal):
    type_bytes, stream = pseudo_terminal
    with read_keys(stream) as keys:
        type_bytes(b"w\x1b[A\x1b[D\x1bOC\r\x1b[5~q")
        assert [next(keys) for _ in range(7)] == ["w", "up", "left", "right", "enter", "\x1b[5~", "q"]


def test_read_keys_turns_echo_off_and_restores_the_terminal(pseudo_terminal):
    _, stream = pseudo_terminal
    settings_before = termios.tcgetattr(stream.fileno())
    with read_keys(stream):
        local_modes = termios.tcgetattr(stream.fileno())[3]
        assert not local_modes & (termios.ECHO | termios.ICANON)
    assert termios.tcgetattr(stream.fileno()) == settings_before
    with pytest.raises(KeyboardInterrupt), read_keys(stream):
        raise KeyboardInterrupt
    assert termios.tcgetattr(stream.fileno()) == settings_before


def test_read_keys_refuses_a_stream_that_is_no_terminal(tmp_path):
    with (
        (tmp_path / "file").open("w+") as file,
        pytest.raises(InputError, match=r"play: .* terminal"),
        read_keys(file),
    ):
        pass


def start_book_game(detections):
    """A search for the nearest book, with the bytes [4] of each detected category at `POSE`."""
    # A row of free cells at the agent's feet, and one blocked cell ahead.
    row_format = RowFormat(len(tiny.CATEGORIES))
    view_cells = np.zeros((row_format.view, row_format.view), np.uint8)
    view_cells[0] = 1
    view_cells[3, 5] = 2

    detection_table = np.zeros((len(tiny.CATEGORIES), 4), np.uint8)
    for category, detection_bytes in detections.items():
        detection_table[tiny.CATEGORIES.index(category)] = detection_bytes

    rows = tiny.BANK.rows.copy()
    rows[POSE] = row_format.pack(jnp.asarray(detection_table), jnp.asarray(view_cells))
    world = tiny.compiled_world(tiny.BANK._replace(rows=rows))
    nearest_episode = BOOK_EPISODES.take(np.array([BOOK_EPISODES.best_length.argmin()]))
    return Game(world, nearest_episode, Knowledge(jnp.zeros(1)), ESTIMATORS["paper"])


#: Confidence, metres ahead in 1 / 51, to the right in 1 / 25.4 from 128, size.
GAME = start_book_game({"Book": (230, 26, 128, 9), "Fridge": (128, 51, 153, 9), "Chair": (128, 204, 26, 9)})
EMPTY_GAME = start_book_game({})


def printed_text(renderable, width=80):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(renderable)
    return console.export_text()


def view_at(pose=POSE, advice=None):
    """The third step of nine, with layout weights of three categories and a gap of 0.6."""
    return GameView(pose, 3, 9, np.array([1.0, 0.25, 0.5]), 0.6, advice)


def test_game_screen_shows_detections_belief_and_advice_in_80_columns():
    screen_text = printed_text(game_screen(GAME, view_at(advice=np.array([0.1, 0.6, 0.25, 0.05, 0.0, 0.0]))))
    assert max(map(len, screen_text.splitlines())) <= 80

    # The task and the state of the agent.
    assert "Looking for Book" in screen_text
    assert "step 3 of 9, heading 45°, camera 30° down" in screen_text

    # Detections: |(26 / 51, 0)| = 0.5, |(1, 25 / 25.4)| = 1.4, |(4, -102 / 25.4)| = 5.7 m.
    for line in ("a Book          0.5 m ↑ 0°", "b Fridge        1.4 m → 45°", "c Chair         5.7 m ← 45°"):
        assert line in screen_text

    # Belief and gap, then the three likeliest actions.
    assert "Fridge        ━━━━━ 0.50" in screen_text  # the widest bar
    assert "Chair         ━━    0.25" in screen_text  # half of five, to even
    assert "gap D         ━━━   0.60" in screen_text
    assert "RotateLeft 60 %, RotateRight 25 %, MoveAhead 10 %" in screen_text


def test_game_screen_draws_the_view_with_the_agent_at_the_bottom():
    """Book is two cells ahead, the fridge four ahead and four to the right; the chair is beyond the view."""
    screen_lines = printed_text(game_screen(GAME, view_at())).splitlines()
    view_lines = [line[1:23] for line in screen_lines if line.startswith("│")][:11]
    assert view_lines[10] == "· " * 5 + "▲ " + "· " * 5
    assert view_lines[8] == " " * 10 + "a " + " " * 10
    assert view_lines[7] == " " * 10 + "██" + " " * 10
    assert view_lines[6] == " " * 18 + "b   "
    assert not any("c" in line for line in view_lines)


def test_game_screen_omits_advice_and_level_camera_and_marks_an_empty_view():
    screen_text = printed_text(game_screen(EMPTY_GAME, view_at()))
    assert "nothing" in screen_text
    assert "the policy" not in screen_text
    assert "camera" not in printed_text(game_screen(EMPTY_GAME, view_at(pose=POSE - 1)))


@pytest.mark.parametrize(
    ("ending", "spl"), [("found in", 50), ("wrong Done after", 0), ("left after", 0), ("out of time after", 0)]
)
def test_result_screen_gives_ending_lengths_and_spl(ending, spl):
    """A walk that is twice as long as the shortest path has an SPL of 50 %, if it succeeds."""
    best_length = int(GAME.episode.best_length[0])
    poses = [int(GAME.episode.pose[0])] * (2 * best_length + 1)
    expected_text = f"Book: {ending} {2 * best_length} actions; a shortest path takes {best_length}. SPL {spl} %"
    assert expected_text in printed_text(result_screen(GAME, GameResult(poses, ending), 80))


def test_result_screen_maps_the_players_way_and_a_shortest_path():
    """The kitchen is 4 x 4 standable cells, furniture to the right and behind; z is up, so the last row comes first.

    From cell (0, 0) the player goes to (0, 1); the shortest path leads from (0, 2) to (1, 1). The books are at
    (x, z) = (0.25, 1.75), past the last row, and (1.5, 0), past the last column.
    """
    episode = GAME.episode._replace(pose=np.array([44]), best_length=np.array([3]))
    game = GAME._replace(episode=episode)
    result = GameResult([0, tiny.POSES_PER_CELL], "left after")
    wide_lines = printed_text(result_screen(game, result, 80)).splitlines()[:5]
    assert [line.rstrip() for line in wide_lines] == [
        "░ ░ ░ ░ ░ ░",
        "· · · · ░ ░",
        "· · · · ░ ░",
        "· ○ · · ░ ░",
        "S ● ○ · ░ ░",
    ]

    # Without spaces where the width is short.
    narrow_lines = printed_text(result_screen(game, result, 11)).splitlines()
    assert "S●○·░░" in narrow_lines
