"""The picture of an episode shows every step, and the view cone ends at walls."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from PIL.GifImagePlugin import GifImageFile
from support import tiny_world as tiny

from jaxnav.choices import PlayedVariant
from jaxnav.env.render import (
    view_cone,
)
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.removal import InferenceTrace
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import DONE, NUM_ACTIONS, Rules
from jaxnav.viz.episode import EpisodePanel, PlayedEpisode, draw_episode, select_frame_steps


def make_episode(action, success=False, shift=0.0, variant: PlayedVariant = "stde"):
    """An episode of the tiny world with the given actions."""
    episodes = draw_episodes(tiny.BANK, 12)
    pose = [int(episodes.pose[0])]
    for played_action in action[:-1]:
        pose.append(int(tiny.BANK.successor[pose[-1], played_action]))
    gap, logits = np.linspace(0.9, 0.2, len(pose)), np.zeros((len(pose), NUM_ACTIONS))
    inferred = InferenceTrace(*map(jnp.asarray, (np.ones((len(pose), 1)), gap, gap - 0.1, logits, logits, logits)))
    trace = EpisodeTrace(np.array(pose), np.array(action), inferred, success)
    scene = (tiny.KITCHEN, tiny.BEDROOM)[episodes.scene[0]]
    cells = cell_centres(scene, standable_cells(scene.reach))
    return PlayedEpisode(
        trace=trace,
        scene=scene,
        places=cells[trace.pose // tiny.POSES_PER_CELL - tiny.BANK.first_cell[episodes.scene[0]]],
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


@pytest.mark.slow
def test_shorter_panel_stands_still_after_its_end(tmp_path):
    """The left half stands still from its third frame on, while the right one goes on to its sixth."""
    short_episode, long_episode = make_episode([1, 1, DONE], success=True), make_episode([1, 1, 2, 1, 1, 0], shift=1.0)
    draw_episode([short_episode, long_episode], tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as gif:
        assert isinstance(gif, GifImageFile)
        assert (gif.n_frames, gif.size) == (6, (1040, 680))
        frames, durations = [], []
        for frame_index in range(6):
            gif.seek(frame_index)
            frames.append(np.asarray(gif.convert("RGB")))
            durations.append(gif.info["duration"])
    left_half, right_half = ([frame[:, half] for frame in frames] for half in (slice(0, 515), slice(525, None)))
    assert [(frame_before != frame_after).any() for frame_before, frame_after in itertools.pairwise(left_half)] == [
        True,
        True,
        False,
        False,
        False,
    ]
    assert all((frame_before != frame_after).any() for frame_before, frame_after in itertools.pairwise(right_half))
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
    ("actions", "success", "words"),
    [
        ([1, DONE], True, "found"),
        ([1, DONE], False, "wrong Done"),
        ([1, 1], False, "out of time"),
    ],
)
def test_panel_shows_shift_action_and_outcome(actions, success, words):
    figure = Figure()
    panel = EpisodePanel(figure, make_episode(actions, success, shift=0.5), 2)
    panel.draw_step(0)
    texts = [text.get_text() for text in figure.texts]
    assert any("0.5" in text for text in texts)
    assert any("turns left" in text for text in texts)
    panel.draw_step(7)  # others may last longer
    assert any(text.get_text().startswith(words) for text in figure.texts)


def test_view_cone_ends_at_walls():
    # From (0, 0) along +z with a row of wall cells at z = 1 m (their near faces at 0.875 m): straight ahead the outline
    # ends within a 0.05 m step of that; without the walls it would end at 5 m.
    walls = [(4, ix) for ix in range(4)]
    scene = tiny.draw(["...."] * 4 + ["####"] * 2, ("Book", 0.25, 0.8, 0.5, *tiny.SMALL), walls=walls)
    outline = view_cone(scene, Rules(), np.zeros(2), 0.0)
    ahead = outline[np.argmin(np.abs(outline[1:, 0])) + 1]
    assert 0.875 <= ahead[1] <= 0.926
    assert outline[:, 1].max() > 3  # past the end of the row of walls, on the left
