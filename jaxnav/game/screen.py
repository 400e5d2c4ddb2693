"""What a player sees, as text for a terminal."""

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from jaxnav.game.episode import Ending, Game, Look
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import CELL, Scene
from jaxnav.scenes.tables.observation_row import VIEW_BLOCKED, VIEW_FREE
from jaxnav.scenes.task import ACTIONS

GOAL, AGENT, SEEN, PALE = "bold dark_orange3", "bold dodger_blue2", "green", "grey50"
HELP = "↑ w ahead   ← a, → d turn   r, f look up, down   Enter Done   q quit"
_LETTERS, _SHOWN, _BAR = "abcdefghijklmnopqrstuvwxyz", 8, 5


def look_screen(game: Game, look: Look) -> RenderableType:
    """Return what there is to see at one step, 80 columns wide."""
    head = Text.assemble("Looking for ", (game.goal, GOAL))
    camera = f", camera {look.horizon:g}° down" if look.horizon else ""
    where = Text(f"step {look.time} of {look.limit}, heading {look.heading:g}°{camera}", PALE)
    grid = Table.grid()
    grid.add_row(
        Panel(_view(game, look), title="view, 2.75 m", width=24, height=13, padding=0),
        Panel(_seen(game, look), title="detected", width=30, height=13, padding=0),
        Panel(_belief(game, look), title="belief w, gap D", width=26, height=13, padding=0),
    )
    lines = [head, where, grid]
    if look.advice is not None:
        order = np.argsort(-look.advice)[:3]
        lines.append(Text("the policy: " + ", ".join(f"{ACTIONS[i]} {100 * look.advice[i]:.0f} %" for i in order)))
    return Group(*lines, Text(HELP, PALE))


def end_screen(game: Game, ending: Ending, scene: Scene, columns: int) -> RenderableType:
    """Return the map with both paths, and the outcome.

    Args:
      game: as it was played.
      ending: of it.
      scene: where.
      columns: of the terminal.
    """
    length, best = len(ending.poses) - 1, len(ending.best) - 1
    outcome = (
        f"found in {length} actions"
        if ending.success
        else f"wrong Done after {length} actions"
        if ending.done
        else f"left after {length} actions"
        if ending.quit
        else f"out of time after {length} actions"
    )
    told = Text.assemble(
        (game.goal, GOAL), f": {outcome}; a shortest path takes {best}. ", (f"SPL {100 * ending.spl:.0f} %", "bold")
    )
    legend = Text.assemble(
        *(("● ", AGENT), "your way   ", ("○ ", SEEN), "a shortest path   ", ("★ ", GOAL), "goal   "),
        *(("S", "bold"), " start   ", ("█ ", PALE), "wall   ", ("░ ", PALE), "furniture"),
    )
    return Group(_floor(game, ending, scene, columns), legend, told)


def _view(game: Game, look: Look) -> Text:
    """Return the view from above, the agent at the bottom."""
    size = len(look.cells)
    marks = {VIEW_FREE: ("· ", PALE), VIEW_BLOCKED: ("██", PALE)}
    drawn = [[marks.get(int(cell), ("  ", "")) for cell in row] for row in look.cells]
    for letter, (name, ahead, right, _) in reversed(list(zip(_LETTERS, look.seen, strict=False))):
        row, column = round(ahead / CELL), round(right / CELL) + size // 2
        if 0 <= row < size and 0 <= column < size:
            drawn[row][column] = (f"{letter} ", GOAL if name == game.goal else SEEN)
    drawn[0][size // 2] = ("▲ ", AGENT)
    return Text("\n").join(Text.assemble(*row) for row in reversed(drawn))


def _seen(game: Game, look: Look) -> Text:
    lines = []
    for letter, (name, ahead, right, _) in zip(_LETTERS, look.seen[: _SHOWN + 2], strict=False):
        angle = round(np.rad2deg(np.arctan2(right, ahead)))
        side = f"{'←↑→'[1 + np.sign(angle)]} {abs(angle)}°"
        colour = GOAL if name == game.goal else SEEN
        lines.append(Text(f"{letter} {name[:13]:13} {np.hypot(ahead, right):3.1f} m {side}", colour))
    return Text("\n").join(lines) if lines else Text("nothing", PALE)


def _belief(game: Game, look: Look) -> Text:
    """Return the categories that are expected near the goal, and the gap."""
    names, goal = game.bank.task.categories, int(game.episode.goal[0])
    others = [k for k in np.argsort(-look.weights, kind="stable") if k != goal][:_SHOWN]
    highest = max(float(look.weights[others].max()), 1e-6)
    weights = look.weights.tolist()
    rows = [(names[k], weights[k], weights[k] / highest) for k in others] + [("gap D", look.gap, look.gap)]
    lines = [Text(f"{name[:13]:13} {'━' * round(_BAR * share):{_BAR}} {value:4.2f}") for name, value, share in rows]
    return Text("\n").join([*lines[:-1], Text(""), lines[-1]])


def _floor(game: Game, ending: Ending, scene: Scene, columns: int) -> Text:
    """Return the map; +z is up."""
    cells, first = standable_cells(scene.reach), game.bank.first_cell[int(game.episode.scene[0])]
    rows = np.where(scene.walls, "█", np.where(scene.reach, "·", "░")).tolist()
    styled = [[(mark, PALE) for mark in row] for row in rows]
    for name, (x, z) in zip(scene.types, scene.boxes[:, [0, 2]], strict=True):
        iz, ix = np.rint((np.array([z, x]) - np.array(scene.origin)[::-1]) / CELL).astype(int)
        if name == game.goal and 0 <= iz < len(styled) and 0 <= ix < len(styled[0]):
            styled[iz][ix] = ("★", GOAL)
    for poses, mark in ((ending.best, ("○", SEEN)), (ending.poses, ("●", AGENT)), (ending.poses[:1], ("S", "bold"))):
        for pose in poses:
            iz, ix = cells[pose // game.bank.task.rules.poses_per_cell - first]
            styled[iz][ix] = mark
    space = " " if 2 * len(styled[0]) <= columns else ""
    lines = [Text(space).join(Text(*cell) for cell in row) for row in reversed(styled)]
    return Text("\n").join(lines)
