"""What every generator of scenes is given."""

from jaxnav.errors import InputError
from jaxnav.scenes.scene import SPLITS


def check_scene_arguments(function: str, split: str, index: int, seed: int) -> None:
    """Check the arguments of a generator.

    Raises:
      InputError: unknown split, or a negative index or seed.
    """
    if split not in SPLITS:
        raise InputError(f"{function}: split is {split!r}; choose one of {', '.join(SPLITS)}")
    for name, number in {"index": index, "seed": seed}.items():
        if number < 0:
            raise InputError(f"{function}: {name} is {number}; give a number of at least 0")
