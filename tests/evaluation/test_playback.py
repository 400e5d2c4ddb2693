"""The picture of an episode shows every step, and the view cone ends at walls."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from PIL.GifImagePlugin import GifImageFile
from support import tiny_world as tiny

from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.playback import EpisodeTrace
from jaxnav.evaluation.removal import InferenceTrace
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import DONE, NUM_ACTIONS, Rules
from jaxnav.viz.episode import EpisodePanel, PlayedEpisode, draw_episode
from jaxnav.viz.scene import view_cone


def episode_of(action, success=False, shift=0.0):
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
        policies=tiny.untrained(),
    )


def test_a_picture_has_a_frame_per_step(tmp_path):
    episode = episode_of([0, 1, 2, 1, 0, DONE])
    draw_episode([episode], tmp_path / "new" / "a.gif")
    draw_episode([episode], tmp_path / "a.png")
    with Image.open(tmp_path / "new" / "a.gif") as gif, Image.open(tmp_path / "a.png") as png:
        assert isinstance(gif, GifImageFile)
        assert gif.n_frames == 6
        assert gif.size == png.size == (520, 680)


def test_panels_are_in_step_and_keep_their_ends(tmp_path):
    """The left half stands still from its third frame on, while the right one goes on to its sixth."""
    short, long = episode_of([1, 1, DONE], success=True), episode_of([1, 1, 2, 1, 1, 0], shift=1.0)
    draw_episode([short, long], tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as gif:
        assert isinstance(gif, GifImageFile)
        assert (gif.n_frames, gif.size) == (6, (1040, 680))
        frames, durations = [], []
        for number in range(6):
            gif.seek(number)
            frames.append(np.asarray(gif.convert("RGB")))
            durations.append(gif.info["duration"])
    left_half, right_half = ([frame[:, half] for frame in frames] for half in (slice(0, 515), slice(525, None)))
    assert [(a != b).any() for a, b in itertools.pairwise(left_half)] == [True, True, False, False, False]
    assert all((a != b).any() for a, b in itertools.pairwise(right_half))
    assert durations[-1] >= 1000 > max(durations[:-1])


@pytest.mark.parametrize(
    ("actions", "success", "words"),
    [
        ([1, DONE], True, "found in 2 steps (best: "),
        ([1, DONE], False, "wrong Done after 2 steps"),
        ([1, 1], False, "out of time after 2 steps"),
    ],
)
def test_a_panel_says_how_the_episode_ends(actions, success, words):
    figure = Figure()
    panel = EpisodePanel(figure, 0.0, 1.0, episode_of(actions, success, shift=0.5), 2)
    panel.draw_step(0)
    assert {"layout shifted by 0.5", "step 1: turns left"} <= {text.get_text() for text in figure.texts}
    panel.draw_step(7)  # others may last longer
    assert any(text.get_text().startswith(words) for text in figure.texts)


def test_the_view_cone_ends_at_walls():
    # From (0, 0) along +z with a row of wall cells at z = 1 m (their near faces at 0.875 m): straight ahead the outline
    # ends within a 0.05 m step of that; without the walls it would end at 5 m.
    walls = [(4, ix) for ix in range(4)]
    scene = tiny.draw(["...."] * 4 + ["####"] * 2, ("Book", 0.25, 0.8, 0.5, *tiny.SMALL), walls=walls)
    outline = view_cone(scene, Rules(), np.zeros(2), 0.0)
    ahead = outline[np.argmin(np.abs(outline[1:, 0])) + 1]
    assert 0.875 <= ahead[1] <= 0.926
    assert outline[:, 1].max() > 3  # past the end of the row of walls, on the left
