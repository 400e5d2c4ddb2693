"""The dial on scenes of a file: categories exchange their labels, and nothing moves."""

import dataclasses
import zlib

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import Scene


def relabel(scene: Scene, categories: tuple[str, ...], shift: float, seed: int) -> Scene:
    """Exchanges the labels of a share of the categories present: all objects of one become objects of another.

    Of C categories present the first n of a random order are exchanged, each becomes the next of them and the last the
    first; n is `shift` C, rounded, and at least 2. Boxes stay, and with them what hides what, how far an object is
    detected, and how far from any start there is something to find.

    Args:
      scene: any.
      categories: [K] the vocabulary; objects of other types keep them.
      shift: share of the categories present, from 0 to 1.
      seed: at least 0; with the scene's name it fixes the order.

    Returns:
      The relabelled scene; `scene` itself where `shift` is 0 or fewer than two categories are present.

    Raises:
      InputError: `shift` or `seed` is out of range.
    """
    if seed < 0 or not 0.0 <= shift <= 1.0:  # NaN is refused, too
        raise InputError(f"relabelling: seed {seed}, shift {shift}; give a seed of at least 0, a shift from 0 to 1")
    ids = category_ids(scene.types, categories)
    present = sorted(set(ids) - {-1})
    if shift == 0 or len(present) < 2:
        return scene
    order = np.random.default_rng([seed, zlib.crc32(scene.name.encode())]).permutation(present)
    cycle = order[: max(2, round(shift * len(present)))].tolist()
    becomes = dict(zip(cycle, cycle[1:] + cycle[:1], strict=True))
    types = (categories[becomes[k]] if k in becomes else name for name, k in zip(scene.types, ids, strict=True))
    return dataclasses.replace(scene, types=tuple(types))
