"""Pictures of episodes: frames and panels of an animation, texts of a panel, and the view cone, which ends at walls."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from PIL.GifImagePlugin import GifImageFile
from support import tiny_world as tiny

from jaxnav.choices import PlayedVariant
from jaxnav.env.render import view_cone
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.removal import InferenceTrace
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import DONE, NUM_ACTIONS, Rules
from jaxnav.viz.episode import EpisodePanel, PlayedEpisode, draw_episode, select_frame_steps


def make_episode(actions, success=False, shift=0.0, variant: PlayedVariant = "stde"):
    """An episode of the tiny world with the given actions, a falling gap and logits of zero."""
    # The poses along the actions.
    episodes = draw_episodes(tiny.BANK, 12)
    poses = [int(episodes.pose[0])]
    for action in actions[:-1]:
        poses.append(int(tiny.BANK.successor[poses[-1], action]))

    # The trace of the episode.
    gap = np.linspace(0.9, 0.2, len(poses))
    logits = jnp.zeros((len(poses), NUM_ACTIONS))
    inferred = InferenceTrace(
        layout_weights=jnp.ones((len(poses), 1)),
        gap=jnp.asarray(gap),
        removal_weight=jnp.asarray(gap - 0.1),
        factual_logits=logits,
        removed_logits=logits,
        action_logits=logits,
    )
    trace = EpisodeTrace(np.array(poses), np.array(actions), inferred, success)

    # The scene, and the place of every pose.
    scene_index = episodes.scene[0]
    scene = (tiny.KITCHEN, tiny.BEDROOM)[scene_index]
    cells = cell_centres(scene, standable_cells(scene.reach))
    return PlayedEpisode(
        trace=trace,
        scene=scene,
        places=cells[trace.pose // tiny.POSES_PER_CELL - tiny.BANK.first_cell[scene_index]],
        rows=tiny.BANK.rows[trace.pose],
        task=tiny.BANK.task,
        goal=int(episodes.goal[0]),
        best_length=int(episodes.best_length[0]),
        epsilon=0.1,
        title="test",
        shift=shift,
        variant=variant,
        policies=tiny.make_untrained_policies(),
    )


@pytest.mark.parametrize("num_steps", [1, 2, 60, 61, 120, 300])
def test_animation_shows_at_most_sixty_steps_from_the_first_to_the_last(num_steps):
    steps = select_frame_steps(num_steps)
    assert len(steps) == min(num_steps, 60)
    assert (steps[0], steps[-1]) == (0, num_steps - 1)
    assert len(set(np.diff(steps))) <= 2  # evenly spaced, rounded


@pytest.mark.slow
def test_gif_has_a_frame_per_step(tmp_path):
    episode = make_episode([0, 1, 2, 1, 0, DONE])
    draw_episode([episode], tmp_path / "new" / "a.gif")
    draw_episode([episode], tmp_path / "a.png")
    with Image.open(tmp_path / "new" / "a.gif") as gif, Image.open(tmp_path / "a.png") as png:
        assert isinstance(gif, GifImageFile)
        assert gif.n_frames == 6
        assert gif.size == png.size == (520, 680)


def frame_changes(frames):
    """For each frame but the last, whether the next frame differs."""
    return [(frame != next_frame).any() for frame, next_frame in itertools.pairwise(frames)]


@pytest.mark.slow
def test_shorter_panel_stands_still_after_its_end(tmp_path):
    """The left panel does not change after its third frame, while the right panel continues to its sixth frame."""
    short_episode = make_episode([1, 1, DONE], success=True)
    long_episode = make_episode([1, 1, 2, 1, 1, 0], shift=1.0)
    draw_episode([short_episode, long_episode], tmp_path / "a.gif")

    # Read all frames with their durations.
    frames = []
    durations = []
    with Image.open(tmp_path / "a.gif") as gif:
        assert isinstance(gif, GifImageFile)
        assert (gif.n_frames, gif.size) == (6, (1040, 680))
        for frame_index in range(6):
            gif.seek(frame_index)
            frames.append(np.asarray(gif.convert("RGB")))
            durations.append(gif.info["duration"])

    left_half = [frame[:, :515] for frame in frames]
    right_half = [frame[:, 525:] for frame in frames]
    assert frame_changes(left_half) == [True, True, False, False, False]
    assert all(frame_changes(right_half))
    # The last frame is shown longer.
    assert durations[-1] >= 1000 > max(durations[:-1])


@pytest.mark.slow
def test_each_variant_has_a_row_of_panels(tmp_path):
    episodes = []
    variants: tuple[PlayedVariant, ...] = ("layout", "scde")
    for variant in variants:
        for shift in (0.0, 0.5, 1.0):
            episodes.append(make_episode([1, DONE], shift=shift, variant=variant))
    draw_episode(episodes, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as png:
        assert png.size == (3 * 520, 2 * 680)


@pytest.mark.parametrize(
    ("actions", "success", "outcome_text"),
    [
        ([1, DONE], True, "found"),
        ([1, DONE], False, "wrong Done"),
        ([1, 1], False, "out of time"),
    ],
)
def test_panel_shows_shift_action_and_outcome(actions, success, outcome_text):
    figure = Figure()
    panel = EpisodePanel(figure, make_episode(actions, success, shift=0.5), 2)
    panel.draw_step(0)
    texts = [text.get_text() for text in figure.texts]
    assert any("0.5" in text for text in texts)
    assert any("turns left" in text for text in texts)
    panel.draw_step(7)  # a step after the end of this episode, for panels of longer episodes
    assert any(text.get_text().startswith(outcome_text) for text in figure.texts)


def test_view_cone_ends_at_walls():
    # The view goes from (0, 0) along +z to a row of wall cells at z = 1 m, whose near faces are at 0.875 m. The outline
    # straight ahead ends within 0.05 m of these faces; without the walls the outline would end at 5 m.
    walls = [(4, ix) for ix in range(4)]
    scene = tiny.draw(["...."] * 4 + ["####"] * 2, ("Book", 0.25, 0.8, 0.5, *tiny.SMALL), walls=walls)
    outline = view_cone(scene, Rules(), np.zeros(2), 0.0)
    ahead = outline[np.argmin(np.abs(outline[1:, 0])) + 1]
    assert 0.875 <= ahead[1] <= 0.926
    assert outline[:, 1].max() > 3  # on the left, beyond the end of the row of walls
