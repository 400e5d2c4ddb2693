"""The picture of one episode, moving or still."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxnav.evaluation.playback import Trace
from jaxnav.runs.policies import Policies
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import RowFormat, detected_places
from jaxnav.scenes.task import DONE, Task
from jaxnav.viz.plan import AGENT, GOAL, INK, PALE, SEEN, draw_agent, draw_room

REMOVED = "#E69F00"
ACTIONS = ("moves ahead", "turns left", "turns right", "looks up", "looks down", "says Done")
MAX_FRAMES, STEP_MS, LAST_MS, NUM_COLOURS = 60, 220, 2500, 128


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
      policies: of the run, one of which acted.
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


def draw_episode(episode: Episode, path: Path) -> None:
    """Write the picture of an episode.

    A path that ends in .gif gets a frame per step, evenly spaced ones of an episode with more than 60 steps; another
    path gets the last frame.
    """
    figure = Figure(figsize=(9.6, 5.4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    room = figure.add_axes((0.015, 0.03, 0.6, 0.85))
    detected = figure.add_axes((0.76, 0.49, 0.22, 0.35))
    gap = figure.add_axes((0.68, 0.1, 0.3, 0.26))
    figure.text(0.02, 0.945, episode.title, color=PALE, fontsize=9.5)
    goal = episode.task.categories[episode.goal]
    figure.text(0.02, 0.9, f"Looking for {goal}", color=GOAL, fontsize=14, weight="bold")
    told = figure.text(0.98, 0.935, "", color=INK, fontsize=10.5, ha="right")
    draw_room(room, episode.scene, episode.task.categories, episode.goal)

    last = len(episode.trace.pose) - 1
    steps = range(0, last + 1, -(-(last + 1) // MAX_FRAMES)) if path.suffix == ".gif" else []
    images = []
    for step in [*(step for step in steps if step != last), last]:
        told.set_text(status(episode, step))
        moving = _draw_agent(room, episode, step)
        _draw_detected(detected, episode, step)
        _draw_gap(gap, episode, step)
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
        for artist in moving:
            artist.remove()
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        _write_gif(images, path)
    else:
        images[-1].save(path, optimize=True)


def _write_gif(images: list[Image.Image], path: Path) -> None:
    """Write frames with one palette.

    Equal pixels stay equal from frame to frame, which keeps the file small.
    """
    richest = max(images, key=lambda image: len(image.getcolors(2**20) or ()))
    palette = richest.quantize(NUM_COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [STEP_MS] * (len(images) - 1) + [LAST_MS]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)


def status(episode: Episode, step: int) -> str:
    """Return what is done at a step, and what comes of the last."""
    trace = episode.trace
    action = trace.action[step]
    text = f"step {step + 1}: {ACTIONS[action]}"
    if step < len(trace.pose) - 1:
        return text
    if action != DONE:
        return f"{text}; out of time"
    return f"{text}; " + (f"found (best: {episode.best_length} steps)" if trace.success else "not found")


def _draw_agent(axes: Axes, episode: Episode, step: int) -> list[Artist]:
    """Draw the path, the agent and what is detected."""
    rules = episode.task.rules
    place, heading = episode.places[step], episode.trace.pose[step] // len(rules.horizons) % rules.headings
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


def _draw_gap(axes: Axes, episode: Episode, step: int) -> None:
    """Draw the layout gap so far.

    What exceeds the threshold, filled, is the weight with which experience is removed.
    """
    axes.clear()
    gap, epsilon = episode.trace.gap[: step + 1], episode.epsilon
    steps = np.arange(1, step + 2)
    if epsilon <= 1:
        axes.axhline(epsilon, color=PALE, lw=1, ls=(0, (4, 3)))
        axes.text(1.01, epsilon, "ε", color=PALE, va="center", transform=axes.get_yaxis_transform())
        axes.fill_between(steps, epsilon, np.maximum(gap, epsilon), color=REMOVED, alpha=0.6, lw=0, step="mid")
        axes.set_title("filled: experience taken out", loc="left", fontsize=8, color=PALE)
    axes.step(steps, gap, where="mid", color=AGENT, lw=1.6)
    axes.plot(steps[-1], gap[-1], "o", color=AGENT, markersize=4.5)
    axes.set(xlim=(0.5, max(len(episode.trace.gap), 2) + 0.5), ylim=(0, 1.02), yticks=(0, 0.5, 1))
    axes.set_title("Layout gap D", loc="right", fontsize=10, color=INK)
    axes.set_xlabel("step", fontsize=8.5, color=PALE)
    axes.locator_params(axis="x", integer=True, nbins=6)
    _draw_plain_axes(axes)


def _draw_plain_axes(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(PALE)
    axes.tick_params(labelcolor=INK, labelsize=8.5, color=PALE)
