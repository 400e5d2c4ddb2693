"""Moving pictures in notebooks and files, in one call: `jaxnav.animate`."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from jaxnav.choices import EstimatorName, PlayedVariant, ShiftKind
from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic
from jaxnav.viz import require_plotting_packages


class Animation:
    """A GIF in memory. The last line of a notebook cell shows it.

    Attributes:
      data: the bytes of the GIF.
    """

    def __init__(self, data: bytes) -> None:
        """Hold the bytes of a GIF."""
        self.data = data

    def save(self, path: str | Path) -> None:
        """Write the GIF to a file, replacing it atomically.

        Raises:
          OSError: the file cannot be written.
        """
        write_atomic(Path(path), self.data)

    def _repr_mimebundle_(self, **_: Any) -> dict[str, str]:
        """Show the GIF in a notebook."""
        return {"image/gif": base64.b64encode(self.data).decode(), "text/plain": repr(self)}

    def __repr__(self) -> str:
        return f"Animation({len(self.data):,} bytes)"


def animate(
    source: Any,
    *,
    split: str = "val",
    index: int = 0,
    shift: float | Sequence[float] | None = None,
    shift_by: ShiftKind = "size",
    variant: PlayedVariant | Sequence[PlayedVariant] = "stde",
    epsilon: float = 0.5,
    setting: EstimatorName | None = None,
    scenes: Path | None = None,
    fps: float = 8.0,
    console: Console | None = None,
) -> Animation:
    """Animate an episode of a run or policy, or the frames that an environment rendered.

        jaxnav.animate("rooms-org", index=505, shift=(0, 1))              # a packaged policy, in two layouts
        jaxnav.animate([env.render(state, params) for state in states])   # any agent

    Args:
      source: run directory, folder of an exported policy, name of a packaged policy; or a list of frames, uint8
        [height, width, 3], as `ObjectNav.render` returns them, for which only `fps` has an effect.
      split: scenes to play in.
      index: index of the episode in the list of 1,000 episodes of `jaxnav.evaluate`.
      shift: layout shift, or several that are shown side by side; None for that of the run.
      shift_by: categories that exchange their places, see `jaxnav.evaluate`.
      variant: use of the experience, or several that are shown below each other: `stde`, `scde`, `layout` or
        `baseline`, as in `jaxnav episode`.
      epsilon: threshold of the removal, at least 0.
      setting: layout estimator to use instead of that of the run.
      scenes: scene file to use instead of the scenes of the run.
      fps: frames per second of a list of frames.
      console: receives messages; None for silence.

    Returns:
      The GIF, with at most 60 frames of an episode. Episodes of a run show the detections and the layout gap, too.

    Raises:
      InputError: matplotlib or pillow is missing, the frames are no pictures of one size, or the episode does not
        exist; see `jaxnav.viz.episode.play_episode`.
    """
    require_plotting_packages()
    from jaxnav.viz.episode import STEP_MILLISECONDS, draw_frames, encode_gif, play_episode

    # Frames of any environment or agent.
    if not isinstance(source, str | Path):
        if not 0.0 < fps < float("inf"):
            raise InputError(f"fps {fps}: give a number above 0")
        return Animation(encode_gif(_read_frames(source), step_milliseconds=round(1000.0 / fps)))

    # An episode of a run or policy.
    shifts = shift if isinstance(shift, Sequence) else (shift,)
    variants = (variant,) if isinstance(variant, str) else variant
    episodes = play_episode(
        source,
        split=split,
        index=index,
        variants=variants,
        epsilon=epsilon,
        estimator=setting,
        scenes=scenes,
        shifts=shifts,
        shift_by=shift_by,
        console=console,
    )
    return Animation(encode_gif(draw_frames(episodes), step_milliseconds=STEP_MILLISECONDS))


def _read_frames(source: Any) -> list[Any]:
    """Convert frames to images.

    Raises:
      InputError: the frames are no pictures of one size.
    """
    from PIL import Image

    frames = [np.asarray(frame) for frame in source]
    if not frames:
        raise InputError("animate: the list of frames is empty; give one frame or more")
    for number, frame in enumerate(frames):
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or frame.shape != frames[0].shape:
            raise InputError(
                f"animate: frame {number} has shape {frame.shape} and dtype {frame.dtype}; give uint8 "
                "[height, width, 3] of equal size, such as those of env.render"
            )
    return [Image.fromarray(frame) for frame in frames]
