"""Typical sizes of objects, for files without sizes."""

import functools
import pathlib

import yaml

from jaxnav.scenes.categories import ALIASES

#: Width, height, depth and height of the centre in metres of an unknown type.
UNKNOWN = (0.3, 0.3, 0.3, 0.8)


def typical_box(name: str) -> tuple[float, float, float, float]:
    """Return the typical size of a type, from `sizes.yaml`.

    Returns:
      Width, height and depth, and the height of the centre above the floor, metres.
    """
    sizes = _sizes()
    return sizes.get(name) or sizes.get(ALIASES.get(name, name), UNKNOWN)


def typical_types() -> tuple[str, ...]:
    """Return the types whose typical size is known."""
    return tuple(_sizes())


@functools.cache
def _sizes() -> dict[str, tuple[float, float, float, float]]:
    table = yaml.safe_load(pathlib.Path(__file__).with_name("sizes.yaml").read_text())
    return {name: tuple(numbers) for name, numbers in table.items()}
