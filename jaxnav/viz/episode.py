"""Pictures of evaluation episodes, still or moving, at one or several layout shifts.

`play_episode` plays an episode of a run or of an exported policy and returns one `PlayedEpisode` for each variant and
layout shift. `draw_episode` writes their picture, a GIF or a PNG with an `EpisodePanel` for each: the scene from above,
the detections and the layout gap. `draw_frames` and `encode_gif` are its two steps.
"""

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, FigureBase
from PIL import Image
from rich.console import Console

from jaxnav.choices import EstimatorName, Form, PlayedVariant, ShiftKind
from jaxnav.env.render import (
    AGENT_COLOR,
    GOAL_COLOR,
    SEEN_COLOR,
)
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, draw_episodes
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.variants import EvaluationRow, table_row
from jaxnav.plain_console import PlainConsole, to_plain_console
from jaxnav.policies.methods import method_label
from jaxnav.progress import show_activity
from jaxnav.runs.config import RunConfig
from jaxnav.runs.evaluate import replay_episodes
from jaxnav.runs.policies import Policies, is_policy, load_policies, load_policy_as_run
from jaxnav.runs.run import load_run_config
from jaxnav.runs.worlds import CompiledWorld, compile_evaluation_world, evaluation_shift, find_scenes
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.observation_row import RowFormat, detected_positions
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import DONE, Task
from jaxnav.store.files import expand_home, write_atomic
from jaxnav.viz.scene import (
    draw_agent,
    draw_plan,
)
from jaxnav.viz.style import (
    MUTED_COLOR,
    TEXT_COLOR,
    default_style,
    style_axes,
)

REMOVAL_COLOR = "#E69F00"
ACTION_PHRASES = ("moves ahead", "turns left", "turns right", "looks up", "looks down", "says Done")
SHIFT_CAPTIONS = {0.0: "layout as trained", 1.0: "layout shifted"}
VARIANT_CAPTIONS = {
    "baseline": "no layout weights",
    "layout": "experience kept",
    "stde": "removed by sTDE",
    "scde": "removed by sCDE",
}

# Size of a panel, inches.
PANEL_WIDTH = 5.2
PANEL_HEIGHT = 6.8

# Frames of a GIF.
MAX_FRAMES = 60
STEP_MILLISECONDS = 220
LAST_MILLISECONDS = 2500
NUM_COLORS = 128
_NUM_PALETTE_FRAMES = 8

_MAX_DETECTIONS = 8  # bars in a panel


class PlayedEpisode(NamedTuple):
    """Episode of T steps with the data for its picture; observation rows have R bytes.

    Attributes:
      trace: poses, actions and inference of the agent.
      scene: scene of the episode.
      places: float64 [T, 2], world (x, z) of the agent at each step.
      rows: uint8 [T, R], observation rows.
      task: categories and rules.
      goal: index of the category to search for.
      best_length: length L* of a shortest path.
      epsilon: threshold of the removal; infinite where experience is kept.
      title: name of the agent and the scene.
      policies: policies of the run, one of which acted.
      shift: layout shift of the scene, from 0 to 1.
      variant: use of the experience.
    """

    trace: EpisodeTrace
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
    variant: PlayedVariant = "stde"


# Playing an episode


class ShiftedEpisodes(NamedTuple):
    """Episodes of an evaluation in scenes with one layout shift.

    Attributes:
      compiled_world: compiled scenes.
      episodes: E episodes with the lengths of shortest paths in these scenes.
      shift: layout shift of the scenes, from 0 to 1.
    """

    compiled_world: CompiledWorld
    episodes: EpisodeList
    shift: float


def play_episode(
    source: str | Path,
    split: str = "val",
    index: int = 0,
    variants: Sequence[PlayedVariant] = ("stde",),
    epsilon: float = 0.5,
    estimator: EstimatorName | None = None,
    scenes: Path | None = None,
    shifts: Sequence[float | None] = (None,),
    shift_by: ShiftKind = "size",
    console: Console | None = None,
) -> list[PlayedEpisode]:
    """Play one episode of an evaluation with every variant at every layout shift.

    Room, goal and start are equal everywhere. The first seed acts, with the best action at every step. With several
    variants or shifts all episodes of the list are played, and the console reports the number of successes of each.

    Args:
      source: directory of a finished run, folder of an exported policy, or name of a policy of the package.
      split: scenes to play in.
      index: index of the episode in the default list of an evaluation (of the first shard, where scenes are streamed).
      variants: uses of the experience. `stde` and `scde` remove it where the gap exceeds epsilon, by the counterfactual
        logits and towards the decision without experience; `layout` keeps it, `baseline` has no layout weights.
      epsilon: threshold of the removal, at least 0.
      estimator: layout estimator to use instead of the run's; see `Policies.with_estimator`.
      scenes: scene file to read instead of the run's world or file.
      shifts: layout shifts of the scenes, from 0 to 1; None for the run's.
      shift_by: categories that exchange their places, see `jaxnav.evaluate`.
      console: receives messages; None for silence.

    Returns:
      The episodes, variant by variant, with one for each shift.

    Raises:
      InputError: no finished run and no policy, no such episode, a goal that cannot be reached at some shift, an
        impossible epsilon, or the variant `scde` of a policy that cannot act without experience.
    """
    console = to_plain_console(console)

    # The arm without layout weights acts in the variant `baseline`.
    arms = []
    for variant in variants:
        arm = "baseline" if variant == "baseline" else "layout"
        if arm not in arms:
            arms.append(arm)
    config, policies = _load_source(source, tuple(arms))
    policies = policies.with_estimator(estimator)

    # Play the episode alone or, to compare, all episodes whose goal can be reached at every shift.
    episodes_by_shift = _draw_shifted_episodes(config, split, scenes, shifts, shift_by, console)
    is_reachable = _check_index(index, episodes_by_shift)
    is_comparison = len(shifts) * len(variants) > 1
    played_indices = np.flatnonzero(is_reachable) if is_comparison else np.array([index])
    trace_index = int(np.searchsorted(played_indices, index))

    # Replay the episodes with best actions.
    agent_name = _describe_agent(policies, variants, epsilon)
    requested_episodes = []
    success_by_name = {}
    for variant, shift_episodes in itertools.product(variants, episodes_by_shift):
        row = _variant_row(policies, variant, epsilon)
        compared_episodes = shift_episodes.episodes.take(played_indices)
        plural = "" if len(played_indices) == 1 else "s"
        with show_activity(
            console, f"playing {len(played_indices):,} episode{plural} at shift {shift_episodes.shift:g}"
        ):
            traces = replay_episodes(policies, shift_episodes.compiled_world, compared_episodes, row)

        suffix = f", {VARIANT_CAPTIONS[variant]}" if len(variants) > 1 else ""
        success_by_name[f"shift {shift_episodes.shift:g}{suffix}"] = [trace.success for trace in traces]
        requested_episode = _make_played_episode(
            trace=traces[trace_index],
            shifted=shift_episodes,
            index=index,
            epsilon=np.inf if row.epsilon is None else epsilon,
            agent_name=agent_name,
            policies=policies,
            variant=variant,
        )
        requested_episodes.append(requested_episode)
    if is_comparison:
        _report_success(success_by_name, console)
    return requested_episodes


def _variant_row(policies: Policies, variant: PlayedVariant, epsilon: float) -> EvaluationRow:
    """Row of an evaluation with best actions, in the default form of its removal."""
    form: Form | None = None if policies.estimator_config is None else policies.estimator_config.form
    if variant == "scde":
        form = "paper"  # interpolates towards the decision without experience
    return table_row(variant, epsilon if variant in ("stde", "scde") else None, form, "argmax")


def _load_source(source: str | Path, arms: tuple[str, ...]) -> tuple[RunConfig, Policies]:
    """Load a run or an exported policy."""
    if not is_policy(source):
        config = load_run_config(expand_home(source))
        missing_arms = sorted(set(arms) - set(config.arms))
        if missing_arms:
            raise InputError(f"{source}: was trained without the arm {missing_arms[0]!r}; choose another --variant")
        return config, load_policies(config, config.arms)
    config, policies = load_policy_as_run(source)
    if not set(arms) <= set(config.arms):
        raise InputError(f"{source}: is a policy of the arm {config.arms[0]!r}; choose another --variant")
    return config, policies


def _draw_shifted_episodes(
    config: RunConfig,
    split: str,
    scenes: Path | None,
    shifts: Sequence[float | None],
    shift_by: ShiftKind,
    console: PlainConsole,
) -> list[ShiftedEpisodes]:
    """Compile the scenes at every shift, and draw the episodes of the first shift for all of them."""
    worlds = []
    for shift in shifts:
        worlds.append(compile_evaluation_world(config, split, scenes, shift, console, shift_by=shift_by))
    episodes = draw_episodes(worlds[0].banks[0])

    # Objects lie at other places at other shifts, so the shortest paths differ.
    episodes_by_shift = []
    for world, shift in zip(worlds, shifts, strict=True):
        best_length = world.banks[0].best_length[episodes.pose, episodes.goal]
        applied_shift = evaluation_shift(config, scenes, shift)
        episodes_by_shift.append(ShiftedEpisodes(world, episodes._replace(best_length=best_length), applied_shift))
    return episodes_by_shift


def _check_index(index: int, episodes_by_shift: Sequence[ShiftedEpisodes]) -> np.ndarray:
    """Check that an episode exists, and that its goal can be reached at every shift.

    Returns:
      bool [E], True for episodes whose goal can be reached at every shift.

    Raises:
      InputError: no such episode, or an unreachable goal.
    """
    num_episodes = len(episodes_by_shift[0].episodes.goal)
    if not 0 <= index < num_episodes:
        raise InputError(f"--index {index}: give a number from 0 to {num_episodes - 1}")

    best_lengths = np.stack([shifted.episodes.best_length for shifted in episodes_by_shift])  # [shifts, E]
    is_reachable = best_lengths.min(axis=0) > 0
    if not is_reachable[index]:
        raise InputError(f"--index {index}: the goal cannot be reached at every --shift; give another --index")
    return is_reachable


def _report_success(success_by_name: Mapping[str, Sequence[bool]], console: PlainConsole) -> None:
    """Print the number of successful episodes of each comparison partner, and the number that no other finds."""
    success = np.array(list(success_by_name.values()))  # [partners, E]
    for i, name in enumerate(success_by_name):
        success_elsewhere = np.delete(success, i, axis=0).any(axis=0)
        only_here = success[i] & ~success_elsewhere
        console.print(
            f"{name}: goal found in {success[i].sum()} of {success.shape[1]} episodes, "
            f"{only_here.sum()} of them found by no other"
        )


def _describe_agent(policies: Policies, variants: Sequence[PlayedVariant], epsilon: float) -> str:
    """Return method and variants of the agent, for a title."""
    variant_names = {
        "stde": f"layout and sTDE, epsilon {epsilon:g}",
        "scde": f"layout and sCDE, epsilon {epsilon:g}",
        "layout": "layout",
        "baseline": "no layout weights",
    }
    names = [variant_names[variant] for variant in variants]
    return f"{method_label(policies.spec.method.name)} with {' or '.join(names)}"


def _make_played_episode(
    *,
    trace: EpisodeTrace,
    shifted: ShiftedEpisodes,
    index: int,
    epsilon: float,
    agent_name: str,
    policies: Policies,
    variant: PlayedVariant,
) -> PlayedEpisode:
    """Combine a trace with the scene and the tables of its episode."""
    # The cell of each pose, counted from the first cell of the scene, [T].
    bank = shifted.compiled_world.banks[0]
    episodes = shifted.episodes
    scene_index = episodes.scene[index]
    scene_name = bank.names[scene_index]
    scene = find_scenes(shifted.compiled_world, [scene_name])[scene_name]
    visited_cells = trace.pose // bank.task.rules.poses_per_cell - bank.first_cell[scene_index]
    return PlayedEpisode(
        trace=trace,
        scene=scene,
        places=cell_centres(scene, standable_cells(scene.reach))[visited_cells],
        rows=bank.rows[trace.pose],
        task=bank.task,
        goal=int(episodes.goal[index]),
        best_length=int(episodes.best_length[index]),
        epsilon=epsilon,
        title=f"{agent_name}  ·  {scene.name}",
        policies=policies,
        shift=shifted.shift,
        variant=variant,
    )


# The picture


def draw_episode(episodes: Sequence[PlayedEpisode], path: Path) -> None:
    """Write the picture of an episode: a GIF, or a PNG of its end; see `draw_frames`.

    Args:
      episodes: one or more episodes with equal room, goal and start, as `play_episode` returns them.
      path: file to write; a name that ends in .gif becomes a GIF.
    """
    if path.suffix == ".gif":
        picture = encode_gif(draw_frames(episodes), STEP_MILLISECONDS)
    else:
        png = io.BytesIO()
        draw_frames(episodes, last_only=True)[-1].save(png, format="PNG", optimize=True)
        picture = png.getvalue()

    # An interruption leaves no half-written picture.
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, picture)


@default_style
def draw_frames(episodes: Sequence[PlayedEpisode], *, last_only: bool = False) -> list[Image.Image]:
    """Draw an episode: a row of panels for each variant, a column for each layout shift.

    All panels show one step at a time; a panel whose episode has ended keeps its last step. Hollow stars mark the goals
    of the first panel in all others.

    Args:
      episodes: one or more episodes with equal room, goal and start, as `play_episode` returns them.
      last_only: True for the last frame alone.

    Returns:
      A frame for each step, or evenly spaced frames of an episode with more than 60 steps.
    """
    first_episode = episodes[0]
    num_rows = len({episode.variant for episode in episodes})
    num_columns = len(episodes) // num_rows
    figure = Figure(figsize=(PANEL_WIDTH * num_columns, PANEL_HEIGHT * num_rows), dpi=100)
    canvas = FigureCanvasAgg(figure)

    # A panel for each episode.
    max_steps = max(len(episode.trace.pose) for episode in episodes)
    panels = []
    for episode, part in zip(episodes, figure.subfigures(num_rows, num_columns, squeeze=False).flat, strict=True):
        panels.append(EpisodePanel(part, episode, gap_steps=max(2, max_steps), show_variant=num_rows > 1))
    for panel in panels[1:]:
        panel.mark_goal(first_episode)

    # Texts above and below the panels.
    goal_name = first_episode.task.categories[first_episode.goal]
    margin = 0.02 / num_columns
    top, bottom = 1 - 0.045 / num_rows, 0.012 / num_rows
    figure.text(margin, top, f"Looking for {goal_name}", color=GOAL_COLOR, fontsize=14, weight="bold")
    figure.text(1 - margin, bottom, first_episode.title, color=MUTED_COLOR, fontsize=8, ha="right")

    frames = []
    for step in [max_steps - 1] if last_only else select_frame_steps(max_steps):
        for panel in panels:
            panel.draw_step(step)
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    return frames


def select_frame_steps(num_steps: int) -> list[int]:
    """Select the steps that an animation shows: all, or `MAX_FRAMES` evenly spaced ones with the first and the last."""
    return np.linspace(0, num_steps - 1, min(num_steps, MAX_FRAMES)).round().astype(int).tolist()


def encode_gif(frames: Sequence[Image.Image], step_milliseconds: int) -> bytes:
    """Encode frames with one palette as a GIF, whose last frame stays longer.

    Equal pixels stay equal from frame to frame, which keeps the file small.
    """
    # The palette of some frames, evenly spaced, serves all frames.
    palette_stride = -(-len(frames) // _NUM_PALETTE_FRAMES)
    sampled_pixels = np.concatenate([np.asarray(frame) for frame in frames[::palette_stride]])
    palette = Image.fromarray(sampled_pixels).quantize(
        NUM_COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
    )
    palette_frames = []
    for frame in frames:
        palette_frames.append(frame.quantize(palette=palette, dither=Image.Dither.NONE))

    # The end stays longer, before the GIF starts again.
    frame_durations = [step_milliseconds] * (len(frames) - 1) + [LAST_MILLISECONDS]
    first_frame, *next_frames = palette_frames
    gif = io.BytesIO()
    first_frame.save(
        gif, format="GIF", save_all=True, append_images=next_frames, duration=frame_durations, loop=0, optimize=True
    )
    return gif.getvalue()


class EpisodePanel:
    """Panel of a figure that shows one episode, step by step."""

    def __init__(
        self, figure: FigureBase, episode: PlayedEpisode, gap_steps: int, *, show_variant: bool = False
    ) -> None:
        """Draw the parts that do not change: the plan of the scene and the caption.

        Args:
          figure: figure, or part of one, that the panel fills.
          episode: episode to draw.
          gap_steps: number of steps on the axis of the layout gap.
          show_variant: whether the caption states the use of the experience.
        """
        # The plan fills the width; below it stand the detections and the gap.
        self._episode = episode
        self._gap_steps = gap_steps
        self._moving_artists: list[Artist] = []
        self._plan_axes = figure.add_axes((0.02, 0.31, 0.96, 0.565))
        self._detections_axes = figure.add_axes((0.2, 0.075, 0.28, 0.185))
        self._gap_axes = figure.add_axes((0.6, 0.1, 0.35, 0.16))

        # Captions: the shift on the left, the state of the episode on the right.
        caption_text = SHIFT_CAPTIONS.get(episode.shift, f"layout shifted by {episode.shift:g}")
        if show_variant:
            caption_text = f"{caption_text}, {VARIANT_CAPTIONS[episode.variant]}"
        figure.text(0.02, 0.9, caption_text, color=TEXT_COLOR, fontsize=9.5 if show_variant else 12, weight="bold")
        self._status = figure.text(0.98, 0.9, "", fontsize=9 if show_variant else 10.5, ha="right")
        draw_plan(self._plan_axes, episode.scene, episode.task.categories, episode.goal)

    def mark_goal(self, other_episode: PlayedEpisode) -> None:
        """Mark the places of the goal in the scene of another episode by hollow stars."""
        # A star for each object of the goal's category.
        scene = other_episode.scene
        object_categories = np.array(category_ids(scene.types, other_episode.task.categories))
        places = scene.boxes[object_categories == other_episode.goal][:, [0, 2]]
        self._plan_axes.plot(*places.T, "*", color="none", markeredgecolor=GOAL_COLOR, markersize=13, zorder=5)

    def draw_step(self, step: int) -> None:
        """Draw a step, or the last step if the episode has ended before."""
        last_step = len(self._episode.trace.pose) - 1
        step = min(step, last_step)
        text, color = describe_step(self._episode, step)
        self._status.set(text=text, color=color, weight="bold" if step == last_step else "normal")

        # Only the agent and its path move; the plan stays.
        for artist in self._moving_artists:
            artist.remove()
        self._moving_artists = _draw_agent_and_path(self._plan_axes, self._episode, step)
        _draw_detections(self._detections_axes, self._episode, step)
        _draw_gap(self._gap_axes, self._episode, step, self._gap_steps)


def describe_step(episode: PlayedEpisode, step: int) -> tuple[str, str]:
    """Return a phrase for the action of a step or for the end of the episode, and its color."""
    trace = episode.trace
    if step < len(trace.pose) - 1:
        return f"step {step + 1}: {ACTION_PHRASES[trace.action[step]]}", TEXT_COLOR
    if trace.action[step] != DONE:
        return f"out of time after {step + 1} steps", GOAL_COLOR
    if not trace.success:
        return f"wrong Done after {step + 1} steps", GOAL_COLOR
    return f"found in {step + 1} steps (best: {episode.best_length})", SEEN_COLOR


def _draw_agent_and_path(axes: Axes, episode: PlayedEpisode, step: int) -> list[Artist]:
    """Draw the path so far, the agent, and rings around the detections."""
    # The agent at the end of its path, over a ring at the start.
    rules = episode.task.rules
    place = episode.places[step]
    _, heading, _ = rules.split_pose(episode.trace.pose[step])
    agent = draw_agent(axes, episode.scene, rules, place, 360.0 / rules.headings * heading)
    path = axes.plot(*episode.places[: step + 1].T, color=AGENT_COLOR, lw=2, solid_joinstyle="round", zorder=4)
    start_style = {"color": "white", "markeredgecolor": AGENT_COLOR, "markersize": 6, "zorder": 4}
    start_ring = axes.plot(*episode.places[0], "o", **start_style)

    # Rings mark the positions that the detector reports, which may differ from the objects' positions.
    detections = _read_detections(episode, step)
    detected_categories = np.flatnonzero(detections[:, 0])
    forward = rules.heading_directions()[heading]
    reported_points = detected_positions(detections[detected_categories], place, forward)
    colors = [_category_color(int(category), episode) for category in detected_categories]
    rings = axes.scatter(*reported_points.T, s=110, facecolor="none", edgecolor=colors, lw=1.6, zorder=6)
    return [*agent, *path, *start_ring, rings]


def _draw_detections(axes: Axes, episode: PlayedEpisode, step: int) -> None:
    """Draw bars of confidence, the greatest on top."""
    # The detected categories with the highest confidence.
    axes.clear()
    confidence = _read_detections(episode, step)[:, 0] / 255.0
    by_confidence = np.argsort(-confidence)[:_MAX_DETECTIONS]
    most_confident = by_confidence[confidence[by_confidence] > 0]
    bar_labels = []
    bar_colors = []
    for category in most_confident:
        bar_labels.append(episode.task.categories[category])
        bar_colors.append(_category_color(int(category), episode))

    # The axis has room for as many bars at every step.
    axes.barh(range(len(most_confident)), confidence[most_confident], 0.6, color=bar_colors)
    axes.set_yticks(range(len(most_confident)), bar_labels)
    axes.set(xlim=(0, 1), ylim=(_MAX_DETECTIONS - 0.4, -0.6), xticks=(0, 0.5, 1))
    axes.set_title("Detected now, confidence", loc="right", fontsize=10, color=TEXT_COLOR)
    style_axes(axes, label_size=8.5)


def _read_detections(episode: PlayedEpisode, step: int) -> np.ndarray:
    return RowFormat(len(episode.task.categories)).detections(episode.rows[step])


def _category_color(category: int, episode: PlayedEpisode) -> str:
    return GOAL_COLOR if category == episode.goal else SEEN_COLOR


def _draw_gap(axes: Axes, episode: PlayedEpisode, step: int, gap_steps: int) -> None:
    """Draw the layout gap so far, on an axis of `gap_steps` steps.

    In the forms `paper` and `residual`, the filled part above the threshold is the weight with which experience is
    removed; in the form `switch`, all experience is removed where there is a filled part.
    """
    # The gap, and its excess over the threshold.
    axes.clear()
    gap = episode.trace.gap[: step + 1]
    epsilon = episode.epsilon
    step_numbers = np.arange(1, step + 2)
    if epsilon <= 1:
        axes.axhline(epsilon, color=MUTED_COLOR, lw=1, ls=(0, (4, 3)))
        axes.text(1.01, epsilon, "ε", color=MUTED_COLOR, va="center", transform=axes.get_yaxis_transform())
        axes.fill_between(
            step_numbers, epsilon, np.maximum(gap, epsilon), color=REMOVAL_COLOR, alpha=0.6, lw=0, step="mid"
        )
    axes.step(step_numbers, gap, where="mid", color=AGENT_COLOR, lw=1.6)
    axes.plot(step_numbers[-1], gap[-1], "o", color=AGENT_COLOR, markersize=4.5)

    # Equal axes at every step.
    axes.set(xlim=(0.5, gap_steps + 0.5), ylim=(0, 1.02), yticks=(0, 0.5, 1))
    axes.set_title("Layout gap D", loc="right", fontsize=10, color=TEXT_COLOR)
    axis_label = "step" if epsilon > 1 else "step; filled: experience removed"
    axes.set_xlabel(axis_label, fontsize=8.5, color=MUTED_COLOR)
    axes.locator_params(axis="x", integer=True, nbins=6)
    style_axes(axes, label_size=8.5)
