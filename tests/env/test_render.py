"""Pictures of episodes as pixels, as text and in Gymnasium."""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny_world as tiny
from support.scenes import SMALL, draw

from jaxnav.env.objectnav import State
from jaxnav.env.render import AGENT_COLOR, GOAL_COLOR, SceneRenderer, SceneRenderers, goal_cells, parse_color
from jaxnav.errors import InputError
from jaxnav.scenes.scene import scene_extent
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import FileScenes

BARE_ENV, PARAMS = tiny.world()
SCENES = FileScenes((tiny.BEDROOM, tiny.KITCHEN, tiny.BEDROOM), "with one that the bank lacks")
RENDERERS = SceneRenderers(SCENES, tiny.BANK.names, tiny.BANK.task)
ENV = dataclasses.replace(BARE_ENV, renderers=RENDERERS)
BOOK = ENV.categories.index("Book")


def state_at(cell, heading=0, scene=0):
    """State of an agent in the kitchen that searches for a book."""
    pose = ENV.task.rules.join_pose(cell, heading, 0)
    return State(pose=jnp.int32(pose), scene=jnp.int32(scene), goal=jnp.int32(BOOK), time=jnp.int32(0))


def pixel_of(place, image):
    """Row and column of a place (x, z) in an image of the kitchen; +z is up."""
    low_corner, high_corner = scene_extent(tiny.KITCHEN)
    scale = max(image.shape[:2]) / (high_corner - low_corner).max()
    row = int((high_corner[1] - place[1]) * scale)
    column = int((place[0] - low_corner[0]) * scale)
    return row, column


def color_at(image, place):
    return image[pixel_of(place, image)].tolist()


def color_bytes(color):
    return np.rint(255 * parse_color(color)).astype(int).tolist()


def test_pixels_show_agent_and_goals_where_they_are():
    image = ENV.render(state_at(0), PARAMS, size=240)
    assert (image.dtype, max(image.shape[:2]), image.shape[2]) == (np.uint8, 240, 3)

    # Cell 0, the first standable one, is at the origin of the grid. Every book of the kitchen is a goal.
    origin = np.array(tiny.KITCHEN.origin)
    assert color_at(image, origin) == color_bytes(AGENT_COLOR)
    for name, box in zip(tiny.KITCHEN.types, tiny.KITCHEN.boxes, strict=True):
        if name == "Book":
            assert color_at(image, box[[0, 2]]) == color_bytes(GOAL_COLOR)


def test_pixels_change_with_the_pose_and_not_the_cached_plan():
    first_image = ENV.render(state_at(0), PARAMS)
    other_image = ENV.render(state_at(3, heading=2), PARAMS, path=[int(state_at(0).pose)])
    assert (first_image != other_image).any()
    np.testing.assert_array_equal(first_image, ENV.render(state_at(0), PARAMS))


def test_goals_are_found_by_their_alias():
    # The stool, which counts as a chair, stands in the cell (z, x) = (1, 2).
    room = draw(["...."] * 3, ("Stool", 0.5, 0.3, 0.25, *SMALL))
    task = Task(("Bed", "Chair"))
    assert goal_cells(room, task, 1).tolist() == [[1, 2]]
    assert goal_cells(room, task, 0).tolist() == []

    # Each text has a star in the line that explains it, and the text for Chair a second one for the stool.
    texts = [SceneRenderer(room, task).draw_text([0], 0, goal) for goal in (0, 1)]
    assert [text.count("★") for text in texts] == [1, 2]


def test_text_shows_agent_path_and_goals():
    heading_right = ENV.task.rules.headings // 4
    text = ENV.render(state_at(3, heading_right), PARAMS, mode="ansi", path=[int(state_at(0).pose)])
    lines = text.splitlines()

    # One line for the goal, and one for each row of cells, +z up.
    assert lines[0] == "looking for Book (★)"
    assert len(lines) == 1 + tiny.KITCHEN.walls.shape[0]
    assert sum(line.count("→") for line in lines) == 1
    assert sum(line.count("•") for line in lines) == 1
    assert lines[-1].startswith("•")  # cell 0 is the first of the lowest row


def test_scenes_are_found_by_name_where_the_bank_lacks_some():
    assert [RENDERERS[index].scene.name for index in range(2)] == [tiny.KITCHEN.name, tiny.BEDROOM.name]


@pytest.mark.parametrize(
    ("env", "state", "options", "message"),
    [
        (BARE_ENV, state_at(0), {}, "has no scenes to draw; use the environment of jaxnav.make"),
        (
            ENV,
            jax.tree.map(lambda leaf: leaf[None], state_at(0)),
            {},
            r"is a batch of shape \(1,\); give the state of one",
        ),
        (ENV, state_at(0), {"mode": "human"}, "mode 'human'; choose rgb_array or ansi"),
        (ENV, state_at(0), {"size": 3}, "size 3; give at least 16"),
        (ENV, state_at(0), {"path": [-5]}, "pose -5 is of another scene; give poses of the episode"),
        (ENV, state_at(0), {"path": [10**6]}, "pose 1000000 is of another scene"),
    ],
)
def test_render_refuses_bad_input(env, state, options, message):
    with pytest.raises(InputError, match=f"^render: .*{message}"):
        env.render(state, PARAMS, **options)


@pytest.fixture(scope="module")
def gym_env():
    gymnasium = pytest.importorskip("gymnasium")
    return gymnasium.make("jaxnav.env.gym:jaxnav/rooms-v0", split="val", render_mode="rgb_array")


@pytest.mark.slow
def test_gymnasium_renders_the_episode(gym_env):
    gym_env.reset(seed=0)
    first_frame = gym_env.render()
    gym_env.step(1)
    assert (first_frame != gym_env.render()).any()
    assert gym_env.metadata["render_modes"] == ["rgb_array", "ansi"]

    # The environment below draws the episode as text.
    wrapper = gym_env.unwrapped
    state = jax.tree.map(lambda leaf: leaf[0], wrapper._episodes.state)
    text = wrapper._env.render(state, wrapper._params, mode="ansi")
    assert text.startswith("looking for ")


def test_gymnasium_refuses_other_render_modes():
    pytest.importorskip("gymnasium")
    from jaxnav.env.gym import ObjectNavEnv

    with pytest.raises(InputError, match=r"^render_mode 'human': choose rgb_array, ansi or None"):
        ObjectNavEnv(render_mode="human")


@pytest.mark.skipif(importlib.util.find_spec("moviepy") is None, reason="RecordVideo needs moviepy")
def test_record_video_writes_an_episode(gym_env, tmp_path):
    from gymnasium.wrappers import RecordVideo

    video_folder = tmp_path / "videos"  # RecordVideo warns where the folder exists
    recorder = RecordVideo(gym_env, str(video_folder), episode_trigger=lambda episode: True)
    recorder.reset(seed=0)
    for action in (1, 1, 5):
        recorder.step(action)
    recorder.stop_recording()
    assert [path.suffix for path in video_folder.iterdir()] == [".mp4"]
