"""Terminal of a game: its keys, the screen at each step, and the map with the result."""

import contextlib
import os
import re
import string
from collections.abc import Iterator, Sequence
from typing import TextIO

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from jaxnav.baselines.shortest_path import oracle_actions
from jaxnav.env.render import GOAL_CHARACTER, goal_cells, plan_characters
from jaxnav.errors import InputError
from jaxnav.game.session import Game, GameResult, GameView
from jaxnav.runs.worlds import find_scenes
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE, RowFormat, relative_position
from jaxnav.scenes.task import ACTIONS

KEY_HELP = "↑ w ahead   ← a, → d turn   r, f look up, down   Enter Done   q quit"

# Styles of Rich.
GOAL_STYLE = "bold dark_orange3"
AGENT_STYLE = "bold dodger_blue2"
SEEN_STYLE = "green"
MUTED_STYLE = "grey50"

_KEY_NAMES = {b"\x1b[A": "up", b"\x1b[C": "right", b"\x1b[D": "left", b"\r": "enter", b"\n": "enter"}
_KEY_PATTERN = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-D]|.", re.DOTALL)
_MAX_CATEGORIES = 8  # in the panel of the belief
_BAR_WIDTH = 5

#: Letter, name of the category, metres ahead, metres to the right, and style.
_Detection = tuple[str, str, float, float, str]


@contextlib.contextmanager
def read_keys(stream: TextIO) -> Iterator[Iterator[str]]:
    """Yield an iterator over the keys as they are pressed, without echo.

    A key is its character, or `up`, `left`, `right` or `enter`. The terminal's settings are restored afterwards.

    Raises:
      InputError: the stream is no terminal, or the system has no Unix terminals.
    """
    # These modules are missing on other systems, where the package can still be imported.
    try:
        import termios
        import tty
    except ImportError as error:
        raise InputError("play: needs a Unix terminal, which this system does not have") from error
    if not stream.isatty():
        raise InputError("play: the input is not a terminal; start the command in a terminal, without piped input")

    # Without line buffering and echo, each key arrives as it is pressed.
    descriptor = stream.fileno()
    saved_settings = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield _key_names(descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, saved_settings)


def _key_names(descriptor: int) -> Iterator[str]:
    """Yield the names of keys until the end of the input."""
    while input_bytes := os.read(descriptor, 64):
        for key_bytes in _KEY_PATTERN.findall(input_bytes):
            # Terminals send arrows as ESC [ A or, in application mode, as ESC O A.
            key_name = _KEY_NAMES.get(key_bytes.replace(b"\x1bO", b"\x1b["))
            yield key_name or key_bytes.decode(errors="replace")


def game_screen(game: Game, view: GameView) -> RenderableType:
    """Return the screen of one step, 80 columns wide."""
    # Two lines of text: the task and the state of the agent.
    rules = game.bank.task.rules
    _, heading, horizon = rules.split_pose(view.pose)
    camera_degrees = rules.horizons[horizon]
    camera_text = f", camera {camera_degrees:g}° down" if camera_degrees else ""
    status_text = f"step {view.time} of {view.step_limit}, heading {360.0 / rules.headings * heading:g}°{camera_text}"
    header_text = Text.assemble("Looking for ", (game.goal, GOAL_STYLE))
    screen_lines: list[RenderableType] = [header_text, Text(status_text, MUTED_STYLE)]

    # Three panels side by side.
    detections = _nearest_detections(game, view.pose)
    panel_grid = Table.grid()
    panel_grid.add_row(
        Panel(_view_text(game, view.pose, detections), title="view, 2.75 m", width=24, height=13, padding=0),
        Panel(_detections_text(detections), title="detected", width=30, height=13, padding=0),
        Panel(_belief_text(game, view), title="belief w, gap D", width=26, height=13, padding=0),
    )
    screen_lines.append(panel_grid)

    # The three actions that the policy prefers.
    if view.advice is not None:
        action_texts = []
        for action in np.argsort(-view.advice)[:3]:
            action_texts.append(f"{ACTIONS[action]} {100 * view.advice[action]:.0f} %")
        screen_lines.append(Text(f"the policy: {', '.join(action_texts)}"))
    return Group(*screen_lines, Text(KEY_HELP, MUTED_STYLE))


def _nearest_detections(game: Game, pose: int) -> list[_Detection]:
    """Return the nearest detections from a pose, as many as there are letters, the nearest first."""
    categories = game.bank.task.categories
    detections = RowFormat(len(categories)).detections(game.bank.rows[pose])
    ahead, right = relative_position(detections)
    detected_categories = np.flatnonzero(detections[:, 0])
    nearest_first = sorted(detected_categories, key=lambda category: np.hypot(ahead[category], right[category]))

    detection_list = []
    for letter, category in zip(string.ascii_lowercase, nearest_first, strict=False):
        style = GOAL_STYLE if categories[category] == game.goal else SEEN_STYLE
        detection_list.append((letter, categories[category], ahead[category], right[category], style))
    return detection_list


def _view_text(game: Game, pose: int, detections: Sequence[_Detection]) -> Text:
    """Return the view from above, the agent at the bottom: the first row is the agent's."""
    # Draw the floor, two characters a cell.
    row_format = RowFormat(len(game.bank.task.categories))
    view_size = row_format.view
    view_cells = row_format.view_cells(game.bank.rows[pose]).reshape(view_size, view_size)
    cell_marks = {VIEW_FREE: ("· ", MUTED_STYLE), VIEW_BLOCKED: ("██", MUTED_STYLE)}
    mark_rows = []
    for cell_row in view_cells:
        mark_rows.append([cell_marks.get(int(cell), ("  ", "")) for cell in cell_row])

    # The letter of a detection covers those of detections farther away.
    for letter, _, ahead, right, style in reversed(detections):
        row_index = round(ahead / CELL_SIZE)
        column_index = round(right / CELL_SIZE) + view_size // 2
        if 0 <= row_index < view_size and 0 <= column_index < view_size:
            mark_rows[row_index][column_index] = (f"{letter} ", style)
    mark_rows[0][view_size // 2] = ("▲ ", AGENT_STYLE)

    return _join_marks(mark_rows)


def _join_marks(mark_rows: list[list[tuple[str, str]]]) -> Text:
    """Return rows of texts and their styles, the last row in the terminal's first line."""
    return Text("\n").join(Text.assemble(*mark_row) for mark_row in reversed(mark_rows))


def _detections_text(detections: Sequence[_Detection]) -> Text:
    """Return detections with their distances and directions, as many as the panel has room for."""
    panel_lines = []
    for letter, name, ahead, right, style in detections[: _MAX_CATEGORIES + 2]:
        angle_degrees = round(np.rad2deg(np.arctan2(right, ahead)))
        direction_text = f"{'←↑→'[1 + np.sign(angle_degrees)]} {abs(angle_degrees)}°"
        detection_text = f"{letter} {name[:13]:13} {np.hypot(ahead, right):3.1f} m {direction_text}"
        panel_lines.append(Text(detection_text, style))
    return Text("\n").join(panel_lines) if panel_lines else Text("nothing", MUTED_STYLE)


def _belief_text(game: Game, view: GameView) -> Text:
    """Return the categories that are expected near the goal, and the gap."""
    # The categories with the highest weights, without the goal itself.
    goal = int(game.episode.goal[0])
    by_weight = np.argsort(-view.layout_weights, kind="stable")
    nearby_categories = [category for category in by_weight if category != goal][:_MAX_CATEGORIES]
    highest_weight = max(float(view.layout_weights[nearby_categories].max()), 1e-6)

    # Weights are often small: the widest bar belongs to the highest of them.
    panel_lines = []
    for category in nearby_categories:
        weight = float(view.layout_weights[category])
        panel_lines.append(_bar_line(game.bank.task.categories[category], weight, weight / highest_weight))
    return Text("\n").join([*panel_lines, Text(""), _bar_line("gap D", view.layout_gap, view.layout_gap)])


def _bar_line(name: str, printed_value: float, bar_share: float) -> Text:
    """Return a name, a bar that fills a share of its width, and a value."""
    return Text(f"{name[:13]:13} {'━' * round(_BAR_WIDTH * bar_share):{_BAR_WIDTH}} {printed_value:4.2f}")


def result_screen(game: Game, result: GameResult, columns: int) -> RenderableType:
    """Return the map with the player's path and a shortest one, and the outcome, for a width in columns."""
    # The oracle lists the actions of a shortest path, [L*, 1]; the tables lead from pose to pose.
    shortest_poses = [int(game.episode.pose[0])]
    for action in oracle_actions(game.bank, game.episode)[:, 0]:
        shortest_poses.append(int(game.bank.successor[shortest_poses[-1], action]))

    # The outcome, measured against the shortest path; both lengths count actions.
    num_actions = len(result.poses) - 1
    shortest_length = len(shortest_poses) - 1
    spl = shortest_length / num_actions if result.ending == "found in" else 0.0
    outcome_text = Text.assemble(
        (game.goal, GOAL_STYLE),
        f": {result.ending} {num_actions} actions; a shortest path takes {shortest_length}. ",
        (f"SPL {100 * spl:.0f} %", "bold"),
    )

    # The marks of the map in their styles.
    mark_legend = Text.assemble(
        *(("● ", AGENT_STYLE), "your way   ", ("○ ", SEEN_STYLE), "a shortest path   ", ("★ ", GOAL_STYLE), "goal   "),
        *(("S", "bold"), " start   ", ("█ ", MUTED_STYLE), "wall   ", ("░ ", MUTED_STYLE), "furniture"),
    )
    return Group(_map_text(game, result.poses, shortest_poses, columns), mark_legend, outcome_text)


def _map_text(game: Game, poses: list[int], shortest_poses: list[int], columns: int) -> Text:
    """Return the map of the scene with both paths; +z is up."""
    scene_index = int(game.episode.scene[0])
    scene_name = game.bank.names[scene_index]
    scene = find_scenes(game.compiled_world, [scene_name])[scene_name]

    # Walls, standable cells and furniture, [nz, nx]. Characters are about twice as high as wide: spaces keep the
    # proportions where they fit.
    map_characters = plan_characters(scene)
    separator = " " if 2 * map_characters.shape[1] <= columns else ""
    mark_rows = []
    for character_row in map_characters.tolist():
        mark_rows.append([(cell_character + separator, MUTED_STYLE) for cell_character in character_row])

    # Mark the objects of the goal's category.
    for iz, ix in goal_cells(scene, game.compiled_world.env.task, int(game.episode.goal[0])).tolist():
        mark_rows[iz][ix] = (GOAL_CHARACTER + separator, GOAL_STYLE)

    # Mark the shortest path, the path of the player over it, and the start.
    cells = standable_cells(scene.reach)
    marked_paths = ((shortest_poses, "○", SEEN_STYLE), (poses, "●", AGENT_STYLE), (poses[:1], "S", "bold"))
    for marked_poses, character, style in marked_paths:
        for pose in marked_poses:
            cell, _, _ = game.bank.task.rules.split_pose(pose)
            iz, ix = cells[cell - game.bank.first_cell[scene_index]]
            mark_rows[iz][ix] = (character + separator, style)
    return _join_marks(mark_rows)
