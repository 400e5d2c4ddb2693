"""The picture of an episode shows every step, and the view cone ends at walls."""

import jax.numpy as jnp
import numpy as np
from PIL import Image
from PIL.GifImagePlugin import GifImageFile
from support import tiny_world as tiny

from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.inference import Inferred
from jaxnav.evaluation.playback import Trace
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.tables.visibility import cell_centres
from jaxnav.scenes.task import DONE, NUM_ACTIONS, Rules
from jaxnav.viz.episode import Episode, draw_episode
from jaxnav.viz.plan import view_cone


def test_a_picture_has_a_frame_per_step(tmp_path):
    episodes = episode_list(tiny.BANK, 12)
    pose, action = [int(episodes.pose[0])], [0, 1, 2, 1, 0, DONE]
    for chosen in action[:-1]:
        pose.append(int(tiny.BANK.successor[pose[-1], chosen]))
    gap, logits = np.linspace(0.9, 0.2, len(pose)), np.zeros((len(pose), NUM_ACTIONS))
    inferred = Inferred(*map(jnp.asarray, (np.ones((len(pose), 1)), gap, gap - 0.1, logits, logits, logits)))
    trace = Trace(np.array(pose), np.array(action), inferred, success=False)
    scene = (tiny.KITCHEN, tiny.BEDROOM)[episodes.scene[0]]
    cells = cell_centres(scene, standable_cells(scene.reach))
    episode = Episode(
        trace=trace,
        scene=scene,
        places=cells[trace.pose // tiny.POSES_PER_CELL - tiny.BANK.first_cell[episodes.scene[0]]],
        rows=tiny.BANK.rows[trace.pose],
        task=tiny.BANK.task,
        goal=int(episodes.goal[0]),
        best_length=int(episodes.best_length[0]),
        epsilon=0.1,
        title="test",
        policies=tiny.untrained(),
    )
    draw_episode(episode, tmp_path / "new" / "a.gif")
    draw_episode(episode, tmp_path / "a.png")
    with Image.open(tmp_path / "new" / "a.gif") as gif, Image.open(tmp_path / "a.png") as png:
        assert isinstance(gif, GifImageFile)
        assert gif.n_frames == len(trace.pose)
        assert gif.size == png.size == (960, 540)


def test_the_view_cone_ends_at_walls():
    # From (0, 0) along +z with a row of wall cells at z = 1 m (their near faces at 0.875 m): straight ahead the outline
    # ends within a 0.05 m step of that; without the walls it would end at 5 m.
    walls = [(4, ix) for ix in range(4)]
    scene = tiny.draw(["...."] * 4 + ["####"] * 2, ("Book", 0.25, 0.8, 0.5, *tiny.SMALL), walls=walls)
    outline = view_cone(scene, Rules(), np.zeros(2), 0.0)
    ahead = outline[np.argmin(np.abs(outline[1:, 0])) + 1]
    assert 0.875 <= ahead[1] <= 0.926
    assert outline[:, 1].max() > 3  # past the end of the row of walls, on the left
