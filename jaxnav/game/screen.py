"""Screens of a game as text for a terminal: the view at each step, and the map with the result."""

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from jaxnav.game.episode import Game, GameResult, GameView
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL_SIZE, Scene
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE
from jaxnav.scenes.task import ACTIONS

# Styles of Rich.
GOAL_STYLE = "bold dark_orange3"
AGENT_STYLE = "bold dodger_blue2"
SEEN_STYLE = "green"
MUTED_STYLE = "grey50"

KEY_HELP = "↑ w ahead   ← a, → d turn   r, f look up, down   Enter Done   q quit"

_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_MAX_CATEGORIES = 8  # in the panel of the belief
_BAR_WIDTH = 5

#: A mark on the map and its style.
_Mark = tuple[str, str]


def game_screen(game: Game, view: GameView) -> RenderableType:
    """Return the screen of one step, 80 columns wide."""
    # Two lines of text: the task and the state of the agent.
    header_text = Text.assemble("Looking for ", (game.goal, GOAL_STYLE))
    camera_text = f", camera {view.horizon:g}° down" if view.horizon else ""
    status_text = Text(f"step {view.time} of {view.step_limit}, heading {view.heading:g}°{camera_text}", MUTED_STYLE)

    # Three panels side by side.
    panel_grid = Table.grid()
    panel_grid.add_row(
        Panel(_view_text(game, view), title="view, 2.75 m", width=24, height=13, padding=0),
        Panel(_detections_text(game, view), title="detected", width=30, height=13, padding=0),
        Panel(_belief_text(game, view), title="belief w, gap D", width=26, height=13, padding=0),
    )

    # The three actions that the policy prefers.
    screen_lines = [header_text, status_text, panel_grid]
    if view.advice is not None:
        action_texts = []
        for action in np.argsort(-view.advice)[:3]:
            action_texts.append(f"{ACTIONS[action]} {100 * view.advice[action]:.0f} %")
        screen_lines.append(Text(f"the policy: {', '.join(action_texts)}"))
    return Group(*screen_lines, Text(KEY_HELP, MUTED_STYLE))


def result_screen(game: Game, result: GameResult, scene: Scene, columns: int) -> RenderableType:
    """Return the map with both paths, and the outcome.

    Args:
      game: the game.
      result: its result.
      scene: scene of the episode.
      columns: width of the terminal.
    """
    # The outcome, measured against a shortest path.
    shortest_length = len(result.shortest_poses) - 1
    outcome_text = Text.assemble(
        (game.goal, GOAL_STYLE),
        f": {_describe_outcome(result)}; a shortest path takes {shortest_length}. ",
        (f"SPL {100 * result.spl:.0f} %", "bold"),
    )

    # The marks of the map in their styles.
    mark_legend = Text.assemble(
        *(("● ", AGENT_STYLE), "your way   ", ("○ ", SEEN_STYLE), "a shortest path   ", ("★ ", GOAL_STYLE), "goal   "),
        *(("S", "bold"), " start   ", ("█ ", MUTED_STYLE), "wall   ", ("░ ", MUTED_STYLE), "furniture"),
    )
    return Group(_map_text(game, result, scene, columns), mark_legend, outcome_text)


def _describe_outcome(result: GameResult) -> str:
    path_length = len(result.poses) - 1
    if result.success:
        return f"found in {path_length} actions"
    if result.said_done:
        return f"wrong Done after {path_length} actions"
    if result.has_quit:
        return f"left after {path_length} actions"
    return f"out of time after {path_length} actions"


def _view_text(game: Game, view: GameView) -> Text:
    """Return the view from above, the agent at the bottom."""
    # Draw the floor, two characters a cell; row 0 is the agent's.
    view_size = len(view.view_cells)
    cell_marks = {VIEW_FREE: ("· ", MUTED_STYLE), VIEW_BLOCKED: ("██", MUTED_STYLE)}
    mark_rows: list[list[_Mark]] = []
    for cell_row in view.view_cells:
        mark_rows.append([cell_marks.get(int(cell), ("  ", "")) for cell in cell_row])

    # The letter of a detection covers those of detections farther away.
    lettered_detections = list(zip(_LETTERS, view.detections, strict=False))
    for letter, (name, ahead, right, _) in reversed(lettered_detections):
        row_index = round(ahead / CELL_SIZE)
        column_index = round(right / CELL_SIZE) + view_size // 2
        if 0 <= row_index < view_size and 0 <= column_index < view_size:
            mark_rows[row_index][column_index] = (f"{letter} ", _style_of(name, game))
    mark_rows[0][view_size // 2] = ("▲ ", AGENT_STYLE)

    # The terminal's first line is farthest from the agent.
    text_lines = [Text.assemble(*mark_row) for mark_row in reversed(mark_rows)]
    return Text("\n").join(text_lines)


def _detections_text(game: Game, view: GameView) -> Text:
    """Return the nearest detections with their letters, distances and directions."""
    # The letters are those of the view; the rest of the panel has no room for more lines.
    panel_lines = []
    for letter, (name, ahead, right, _) in zip(_LETTERS, view.detections[: _MAX_CATEGORIES + 2], strict=False):
        angle_degrees = round(np.rad2deg(np.arctan2(right, ahead)))
        direction_text = f"{'←↑→'[1 + np.sign(angle_degrees)]} {abs(angle_degrees)}°"
        distance_metres = np.hypot(ahead, right)
        panel_lines.append(
            Text(f"{letter} {name[:13]:13} {distance_metres:3.1f} m {direction_text}", _style_of(name, game))
        )
    return Text("\n").join(panel_lines) if panel_lines else Text("nothing", MUTED_STYLE)


def _style_of(name: str, game: Game) -> str:
    return GOAL_STYLE if name == game.goal else SEEN_STYLE


def _belief_text(game: Game, view: GameView) -> Text:
    """Return the categories that are expected near the goal, and the gap."""
    goal = int(game.episode.goal[0])
    # The categories with the highest weights, without the goal itself.
    by_weight = np.argsort(-view.goal_weights, kind="stable")
    nearby_categories = [category for category in by_weight if category != goal][:_MAX_CATEGORIES]
    highest_weight = max(float(view.goal_weights[nearby_categories].max()), 1e-6)

    # Weights are often small: the widest bar belongs to the highest of them.
    panel_lines = []
    for category in nearby_categories:
        goal_weight = float(view.goal_weights[category])
        panel_lines.append(_bar_line(game.bank.task.categories[category], goal_weight, goal_weight / highest_weight))
    return Text("\n").join([*panel_lines, Text(""), _bar_line("gap D", view.gap, view.gap)])


def _bar_line(name: str, printed_value: float, bar_share: float) -> Text:
    """Return a name, a bar that fills a share of its width, and a value."""
    return Text(f"{name[:13]:13} {'━' * round(_BAR_WIDTH * bar_share):{_BAR_WIDTH}} {printed_value:4.2f}")


def _map_text(game: Game, result: GameResult, scene: Scene, columns: int) -> Text:
    """Return the map of the scene with both paths; +z is up."""
    # Walls, standable cells and furniture, [nz, nx].
    map_characters = np.where(scene.walls, "█", np.where(scene.reach, "·", "░")).tolist()
    mark_rows: list[list[_Mark]] = []
    for character_row in map_characters:
        mark_rows.append([(cell_character, MUTED_STYLE) for cell_character in character_row])

    # Mark the objects of the goal's category.
    for name, (x, z) in zip(scene.types, scene.boxes[:, [0, 2]], strict=True):
        iz, ix = np.rint((np.array([z, x]) - np.array(scene.origin)[::-1]) / CELL_SIZE).astype(int)
        if name == game.goal and 0 <= iz < len(mark_rows) and 0 <= ix < len(mark_rows[0]):
            mark_rows[iz][ix] = ("★", GOAL_STYLE)

    # Mark the shortest path, the path of the player over it, and the start.
    map_cells = standable_cells(scene.reach)
    first_cell = game.bank.first_cell[int(game.episode.scene[0])]

    def mark_poses(poses: Sequence[int], mark: _Mark) -> None:
        for pose in poses:
            iz, ix = map_cells[pose // game.bank.task.rules.poses_per_cell - first_cell]
            mark_rows[iz][ix] = mark

    mark_poses(result.shortest_poses, ("○", SEEN_STYLE))
    mark_poses(result.poses, ("●", AGENT_STYLE))
    mark_poses(result.poses[:1], ("S", "bold"))

    # Characters are about twice as high as wide: spaces keep the proportions where they fit.
    cell_separator = Text(" " if 2 * len(mark_rows[0]) <= columns else "")
    text_lines = []
    for mark_row in reversed(mark_rows):
        text_lines.append(cell_separator.join(Text(*mark) for mark in mark_row))
    return Text("\n").join(text_lines)
