"""Pictures of scenes, episodes and results."""

import importlib

from jaxnav.errors import InputError


def require_plotting_packages() -> None:
    """Check that the packages for drawing are installed.

    Raises:
      InputError: matplotlib or pillow is missing; the message says how to install them.
    """
    try:
        for module in ("matplotlib.figure", "PIL.Image"):
            importlib.import_module(module)
    except ImportError as error:
        raise InputError("pictures need matplotlib and pillow; install them with: pip install 'jaxnav[viz]'") from error
