"""One episode as a panel of a picture: the room from above, what is detected, the layout gap."""

from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.evaluation.playback import Trace
from jaxnav.runs.policies import Policies
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import RowFormat, detected_places
from jaxnav.scenes.task import DONE, Task
from jaxnav.viz.plan import AGENT, GOAL, INK, PALE, SEEN, draw_agent, draw_room

REMOVED = "#E69F00"
ACTIONS = ("moves ahead", "turns left", "turns right", "looks up", "looks down", "says Done")
CAPTIONS = {0.0: "layout as trained", 1.0: "layout shifted"}


class Episode(NamedTuple):
    """Hold one episode and everything its picture shows.

    There are T steps; a row has R bytes.

    Attributes:
      trace: what was done.
      scene: where.
      places: float64 [T, 2], world (x, z) of the agent at each step.
      rows: uint8 [T, R], what was perceived.
      task: categories and rules.
      goal: index of the category to search for.
      best_length: L*.
      epsilon: threshold of sTDE; infinite where experience is kept.
      title: names the agent and the scene.
      policies: one of which acted.
      shift: of the layout, from 0 to 1.
    """

    trace: Trace
    scene: Scene
    places: np.ndarray
    rows: np.ndarray
    task: Task
    goal: int
    best_length: int
    epsilon: float
    title: str
    policies: Policies
    shift: float = 0.0


class Panel:
    """Draw one episode into a part of a figure."""

    def __init__(self, figure: Figure, left: float, width: float, episode: Episode, span: int) -> None:
        """Draw what does not change.

        `left` and `width` are shares of the figure, `span` is the number of steps on the axis of the gap.
        """

        def axes(x: float, y: float, w: float, h: float) -> Axes:
            return figure.add_axes((left + x * width, y, w * width, h))

        self._episode, self._span, self._moving = episode, span, []
        self._room, self._detected, self._gap = (
            axes(0.02, 0.31, 0.96, 0.565),
            axes(0.2, 0.075, 0.28, 0.185),
            axes(0.6, 0.1, 0.35, 0.16),
        )
        caption = CAPTIONS.get(episode.shift, f"layout shifted by {episode.shift:g}")
        figure.text(left + 0.02 * width, 0.9, caption, color=INK, fontsize=12, weight="bold")
        self._status = figure.text(left + 0.98 * width, 0.9, "", fontsize=10.5, ha="right")
        draw_room(self._room, episode.scene, episode.task.categories, episode.goal)

    def draw_elsewhere(self, other: Episode) -> None:
        """Mark where the goal is in another episode's scene."""
        ids = np.array(category_ids(other.scene.types, other.task.categories))
        places = other.scene.boxes[ids == other.goal][:, [0, 2]]
        self._room.plot(*places.T, "*", color="none", markeredgecolor=GOAL, markersize=13, zorder=5)

    def draw(self, step: int) -> None:
        """Draw a step, or the last one after the end."""
        episode, last = self._episode, len(self._episode.trace.pose) - 1
        step = min(step, last)
        for artist in self._moving:
            artist.remove()
        text, colour = status(episode, step)
        self._status.set(text=text, color=colour, weight="bold" if step == last else "normal")
        self._moving = _draw_agent(self._room, episode, step)
        _draw_detected(self._detected, episode, step)
        _draw_gap(self._gap, episode, step, self._span)


def status(episode: Episode, step: int) -> tuple[str, str]:
    """Return what happens at a step, and the colour to write it in."""
    trace = episode.trace
    if step < len(trace.pose) - 1:
        return f"step {step + 1}: {ACTIONS[trace.action[step]]}", INK
    if trace.action[step] != DONE:
        return f"out of time after {step + 1} steps", GOAL
    if not trace.success:
        return f"wrong Done after {step + 1} steps", GOAL
    return f"found in {step + 1} steps (best: {episode.best_length})", SEEN


def _draw_agent(axes: Axes, episode: Episode, step: int) -> list[Artist]:
    """Draw the path, the agent and what is detected."""
    rules = episode.task.rules
    place, (_, heading, _) = episode.places[step], rules.split(episode.trace.pose[step])
    agent = draw_agent(axes, episode.scene, rules, place, 360.0 / rules.headings * heading)
    path = axes.plot(*episode.places[: step + 1].T, color=AGENT, lw=2, solid_joinstyle="round", zorder=4)
    start = axes.plot(*episode.places[0], "o", color="white", markeredgecolor=AGENT, markersize=6, zorder=4)
    detections = _detections(episode, step)
    seen = np.flatnonzero(detections[:, 0])
    points = detected_places(detections[seen], place, rules.directions()[heading])
    colours = [GOAL if category == episode.goal else SEEN for category in seen]
    rings = axes.scatter(*points.T, s=110, facecolor="none", edgecolor=colours, lw=1.6, zorder=6)
    return [*agent, *path, *start, rings]


def _detections(episode: Episode, step: int) -> np.ndarray:
    return RowFormat(len(episode.task.categories)).detections(episode.rows[step])


def _draw_detected(axes: Axes, episode: Episode, step: int) -> None:
    """Draw bars of confidence, the greatest on top."""
    axes.clear()
    confidence = _detections(episode, step)[:, 0] / 255.0
    seen = [i for i in np.argsort(-confidence)[:8] if confidence[i] > 0]
    axes.barh(range(len(seen)), confidence[seen], 0.6, color=[GOAL if i == episode.goal else SEEN for i in seen])
    axes.set_yticks(range(len(seen)), [episode.task.categories[i] for i in seen])
    axes.set(xlim=(0, 1), ylim=(7.6, -0.6), xticks=(0, 0.5, 1))
    axes.set_title("Detected now, confidence", loc="right", fontsize=10, color=INK)
    _draw_plain_axes(axes)


def _draw_gap(axes: Axes, episode: Episode, step: int, span: int) -> None:
    """Draw the layout gap so far, of `span` steps.

    What exceeds the threshold, filled, is the weight with which experience is removed.
    """
    axes.clear()
    gap, epsilon = episode.trace.gap[: step + 1], episode.epsilon
    steps = np.arange(1, step + 2)
    if epsilon <= 1:
        axes.axhline(epsilon, color=PALE, lw=1, ls=(0, (4, 3)))
        axes.text(1.01, epsilon, "ε", color=PALE, va="center", transform=axes.get_yaxis_transform())
        axes.fill_between(steps, epsilon, np.maximum(gap, epsilon), color=REMOVED, alpha=0.6, lw=0, step="mid")
    axes.step(steps, gap, where="mid", color=AGENT, lw=1.6)
    axes.plot(steps[-1], gap[-1], "o", color=AGENT, markersize=4.5)
    axes.set(xlim=(0.5, span + 0.5), ylim=(0, 1.02), yticks=(0, 0.5, 1))
    axes.set_title("Layout gap D", loc="right", fontsize=10, color=INK)
    axes.set_xlabel("step" if epsilon > 1 else "step; filled: experience taken out", fontsize=8.5, color=PALE)
    axes.locator_params(axis="x", integer=True, nbins=6)
    _draw_plain_axes(axes)


def _draw_plain_axes(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(PALE)
    axes.tick_params(labelcolor=INK, labelsize=8.5, color=PALE)
