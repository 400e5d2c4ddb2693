"""The picture of an episode, or of several side by side, moving or still."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxnav.viz.panel import Episode, Panel
from jaxnav.viz.plan import GOAL, PALE

MAX_FRAMES, STEP_MS, LAST_MS, NUM_COLOURS = 60, 220, 2500, 128
WIDTH, HEIGHT = 5.2, 6.8  # inches, of a panel


def draw_episode(episodes: Sequence[Episode], path: Path) -> None:
    """Write the picture of an episode.

    It has a panel for each layout shift, in step; a panel whose episode has ended keeps its end. Hollow stars show
    where the goal is in the first panel. A path that ends in .gif gets a frame per step, evenly spaced ones of an
    episode with more than 60 steps; another path gets the last frame.

    Args:
      episodes: at least one; the same room, goal and start at several layout shifts.
      path: of the picture.
    """
    first = episodes[0]
    figure = Figure(figsize=(WIDTH * len(episodes), HEIGHT), dpi=100)
    canvas = FigureCanvasAgg(figure)
    goal, margin = first.task.categories[first.goal], 0.02 / len(episodes)
    figure.text(margin, 0.955, f"Looking for {goal}", color=GOAL, fontsize=14, weight="bold")
    figure.text(1 - margin, 0.012, first.title, color=PALE, fontsize=8, ha="right")
    span = max(2, *(len(episode.trace.pose) for episode in episodes))
    width = 1 / len(episodes)
    panels = [Panel(figure, width * i, width, episode, span) for i, episode in enumerate(episodes)]
    for panel in panels[1:]:
        panel.draw_elsewhere(first)

    last = max(len(episode.trace.pose) for episode in episodes) - 1
    steps = range(0, last + 1, -(-(last + 1) // MAX_FRAMES)) if path.suffix == ".gif" else []
    images = []
    for step in [*(step for step in steps if step != last), last]:
        for panel in panels:
            panel.draw(step)
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
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
