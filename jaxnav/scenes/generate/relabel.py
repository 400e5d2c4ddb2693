"""The layout shift of single rooms and of scene files."""

import dataclasses
import zlib

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.scene import Scene


def relabel(scene: Scene, categories: tuple[str, ...], shift: float, seed: int) -> Scene:
    """Exchange the labels of categories of similar size.

    All objects of one category become objects of another. The categories present, ordered by the mean volume of their
    boxes, form pairs of neighbours; if their number is odd, the three largest form one group. In a random order of the
    groups, the first `shift` of them, rounded, and at least one, exchange: each category of a group becomes the next
    larger one, and the largest the smallest. Boxes stay, and with them occlusion, the ranges of detection, and the
    distances from any start to the nearest objects.

    Args:
      scene: the scene.
      categories: [K] the vocabulary; objects of other types keep their types.
      shift: share of the groups, from 0 to 1.
      seed: at least 0; with the scene's name it fixes the order of the groups.

    Returns:
      The relabelled scene; `scene` itself where `shift` is 0 or fewer than two categories are present.

    Raises:
      InputError: `shift` or `seed` is out of range.
    """
    if seed < 0 or not 0.0 <= shift <= 1.0:  # NaN is refused, too
        raise InputError(f"relabelling: seed {seed}, shift {shift}; give a seed of at least 0, a shift from 0 to 1")
    ids = category_ids(scene.types, categories)
    groups = _like_sized(np.array(ids), scene.boxes[:, 3:].prod(axis=1))
    if shift == 0 or not groups:
        return scene
    order = np.random.default_rng([seed, zlib.crc32(scene.name.encode())]).permutation(len(groups))
    exchanging = [groups[g] for g in order[: max(1, round(shift * len(groups)))]]
    becomes = {k: new for group in exchanging for k, new in zip(group, group[1:] + group[:1], strict=True)}
    types = (categories[becomes[k]] if k in becomes else name for name, k in zip(scene.types, ids, strict=True))
    return dataclasses.replace(scene, types=tuple(types))


def _like_sized(ids: np.ndarray, volumes: np.ndarray) -> list[list[int]]:
    """Group the categories present by size.

    Two by two from the smallest; the last three together if their number is odd.

    Args:
      ids: int [N], category of each object, -1 for none.
      volumes: float [N], of the objects' boxes.
    """
    present = sorted(set(ids.tolist()) - {-1})
    ordered = sorted(present, key=lambda k: volumes[ids == k].mean())  # ties in the order of the vocabulary
    groups = [ordered[i : i + 2] for i in range(0, len(ordered) - 1, 2)]
    if groups and len(ordered) % 2:
        groups[-1].append(ordered[-1])
    return groups
