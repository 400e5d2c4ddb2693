"""Typical sizes of objects, for scene files without sizes."""

import functools
import pathlib

import yaml

from jaxnav.scenes.categories import ALIASES

#: Width, height, depth and height of the centre in metres of an unknown type.
UNKNOWN_BOX = (0.3, 0.3, 0.3, 0.8)


def typical_box(name: str) -> tuple[float, float, float, float]:
    """Return the typical size of an object type, from `sizes.yaml`.

    Returns:
      Width, height and depth, and the height of the centre above the floor, metres.
    """
    boxes = typical_boxes()
    return boxes.get(name) or boxes.get(ALIASES.get(name, name), UNKNOWN_BOX)


@functools.cache
def typical_boxes() -> dict[str, tuple[float, float, float, float]]:
    """Read the typical sizes by type, see `typical_box`."""
    table = yaml.safe_load(pathlib.Path(__file__).with_name("sizes.yaml").read_text())
    return {name: tuple(numbers) for name, numbers in table.items()}
