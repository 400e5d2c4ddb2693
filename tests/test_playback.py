"""One episode played step by step agrees with the compiled grid, and its picture shows every step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from PIL import Image

from jaxnav.env.types import State
from jaxnav.evaluation.draw import Episode, draw_episode
from jaxnav.evaluation.episodes import episode_list
from jaxnav.evaluation.grid import evaluate_grid
from jaxnav.evaluation.plan import view_cone
from jaxnav.evaluation.playback import play
from jaxnav.evaluation.variants import Row, inference_grid
from jaxnav.policies.acting import Acting
from jaxnav.scenes.lattice import standable_cells
from jaxnav.scenes.sight import cell_centres
from jaxnav.scenes.task import DONE, Rules

ENV, PARAMS = tiny.world()
ACTING = Acting(ENV, tiny.SETTING)
EPISODES = episode_list(tiny.BANK, 12)
WEIGHTS = [tiny.lively(0), tiny.lively(1)]
ROWS = [
    Row("baseline", None, None, "argmax"),
    Row("layout", None, None, "argmax"),
    Row("stde", 0.1, "residual", "argmax"),
]


def play_row(row, index):
    start = State(pose=EPISODES.pose[index], scene=EPISODES.scene[index], goal=EPISODES.goal[index], time=jnp.int32(0))
    cell = jax.tree.map(lambda leaf: leaf[0], inference_grid([row], 1))
    return play(cell, WEIGHTS[int(cell.params)], start, ACTING, tiny.SPEC, PARAMS, tiny.priors())


@pytest.fixture(scope="module")
def outcome():
    weights = jax.tree.map(lambda *leaves: jnp.stack(leaves), *WEIGHTS)
    grid = inference_grid(ROWS, 1)
    key = jax.random.key(0)
    return evaluate_grid(grid, weights, [(EPISODES, PARAMS)], ACTING, tiny.SPEC, tiny.priors(), key)[0]


@pytest.mark.parametrize("variant", range(len(ROWS)))
def test_playing_agrees_with_the_grid(variant, outcome):
    for index in range(0, len(EPISODES.goal), 5):
        trace = play_row(ROWS[variant], index)
        assert len(trace.pose) == outcome.length[variant, index]
        assert trace.success == outcome.success[variant, index]
        assert trace.pose[0] == EPISODES.pose[index]
        assert not (trace.action[:-1] == DONE).any()
        if ROWS[variant].epsilon is not None:
            weight = np.maximum(trace.gap - ROWS[variant].epsilon, 0).mean()
            np.testing.assert_allclose(weight, outcome.weight[variant, index], atol=1e-6)


def test_a_picture_has_a_frame_per_step(tmp_path):
    trace = play_row(ROWS[2], 0)
    scene = (tiny.KITCHEN, tiny.BEDROOM)[EPISODES.scene[0]]
    cells = cell_centres(scene, standable_cells(scene.reach))
    episode = Episode(
        trace=trace,
        scene=scene,
        places=cells[trace.pose // tiny.POSES_PER_CELL - tiny.BANK.first_cell[EPISODES.scene[0]]],
        rows=tiny.BANK.rows[trace.pose],
        task=tiny.BANK.task,
        goal=int(EPISODES.goal[0]),
        best_length=int(EPISODES.best_length[0]),
        epsilon=0.1,
        title="test",
    )
    draw_episode(episode, tmp_path / "new" / "a.gif")
    draw_episode(episode, tmp_path / "a.png")
    with Image.open(tmp_path / "new" / "a.gif") as gif, Image.open(tmp_path / "a.png") as png:
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
