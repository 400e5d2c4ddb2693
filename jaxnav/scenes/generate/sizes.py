"""Typical sizes of objects, for files that leave them out."""

import functools
import pathlib

import yaml

from jaxnav.scenes.categories import ALIASES

#: Width, height, depth and height of the centre in metres of a type that nothing is known of.
UNKNOWN = (0.3, 0.3, 0.3, 0.8)


def typical_box(name: str) -> tuple[float, float, float, float]:
    """Width, height and depth of a type, and the height of its centre above the floor, in metres (`sizes.yaml`)."""
    sizes = _sizes()
    return sizes.get(name) or sizes.get(ALIASES.get(name, name), UNKNOWN)


@functools.cache
def _sizes() -> dict[str, tuple[float, float, float, float]]:
    table = yaml.safe_load(pathlib.Path(__file__).with_name("sizes.yaml").read_text())
    return {name: tuple(numbers) for name, numbers in table.items()}
