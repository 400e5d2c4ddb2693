"""Tests of animations: a GIF in memory of an episode of a policy or of the frames of any agent."""

import base64
import io
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image, ImageSequence

import jaxnav


def read_gif(data):
    """Frames of a GIF, uint8 [T, height, width, 3], and the duration of each in milliseconds."""
    frames = []
    durations = []
    for frame in ImageSequence.Iterator(Image.open(io.BytesIO(data))):
        frames.append(np.array(frame.convert("RGB")))
        durations.append(frame.info["duration"])
    return np.stack(frames), durations


def test_frames_become_a_gif():
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    frames = [np.full((20, 30, 3), color, np.uint8) for color in colors]
    animation = jaxnav.animate(frames, fps=5)
    shown_frames, durations = read_gif(animation.data)

    # A palette of 128 colors rounds the frames.
    np.testing.assert_allclose(shown_frames.astype(int), np.array(frames, int), atol=8)

    # At five frames a second, a frame lasts 200 ms; the last one is shown for longer.
    assert durations[:-1] == [200, 200]
    assert durations[-1] > 1000


def test_animation_is_shown_in_notebooks_and_saved(tmp_path):
    animation = jaxnav.animate([np.zeros((4, 4, 3), np.uint8)])
    assert base64.b64decode(animation._repr_mimebundle_()["image/gif"]) == animation.data
    animation.save(tmp_path / "a.gif")
    assert (tmp_path / "a.gif").read_bytes() == animation.data


@pytest.mark.slow
def test_rendered_states_of_any_agent_are_animated():
    # Two frames: before and after a turn.
    env, params = jaxnav.make("rooms", split="val")
    _, state = env.reset(jax.random.key(0), params)
    frames = [env.render(state, params, size=64)]
    _, state, *_ = env.step(jax.random.key(1), state, jaxnav.ROTATE_LEFT, params)
    frames.append(env.render(state, params, size=64))

    shown_frames, _ = read_gif(jaxnav.animate(frames).data)
    assert shown_frames.shape == (2, *frames[0].shape)


@pytest.mark.slow
def test_episode_of_a_policy_is_animated():
    shown_frames, _ = read_gif(jaxnav.animate("rooms-org", index=3).data)
    assert 2 <= len(shown_frames) <= 60
    assert (shown_frames[0] != shown_frames[-1]).any()


@pytest.mark.parametrize(
    ("frames", "problem"),
    [
        ([], "empty"),
        ([np.zeros((4, 4, 3))], "frame 0 .*float64.*uint8"),
        ([np.zeros((4, 4, 4), np.uint8)], r"frame 0 .*\(4, 4, 4\)"),
        ([np.zeros((4, 4, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)], r"frame 1 .*\(5, 4, 3\)"),
    ],
)
def test_frames_that_are_no_pictures_are_refused(frames, problem):
    with pytest.raises(jaxnav.InputError, match=problem):
        jaxnav.animate(frames)


def test_impossible_rates_are_refused():
    with pytest.raises(jaxnav.InputError, match="fps 0"):
        jaxnav.animate([np.zeros((4, 4, 3), np.uint8)], fps=0)


def test_missing_runs_are_refused(tmp_path):
    with pytest.raises(jaxnav.InputError, match="nowhere"):
        jaxnav.animate(Path(tmp_path / "nowhere"))
