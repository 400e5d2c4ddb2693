"""Pictures of scenes, episodes and results."""

import importlib

from jaxnav.errors import InputError


def require_pictures() -> None:
    """Refuse to draw where what draws is not installed.

    Raises:
      InputError: matplotlib or pillow is missing; says how to install them.
    """
    try:
        for module in ("matplotlib.figure", "PIL.Image"):
            importlib.import_module(module)
    except ImportError as error:
        raise InputError("pictures need matplotlib and pillow; install them by: pip install 'jaxnav[viz]'") from error
