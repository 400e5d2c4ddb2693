"""Layout-based causal inference for object navigation, in JAX.

`make` builds an environment; `layout` and `causal` hold the equations. Everything else is imported from its own module.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxnav import causal, layout
    from jaxnav.env.make import make

__version__ = "0.1.0"

__all__ = ["__version__", "causal", "layout", "make"]


def __getattr__(name: str) -> Any:
    # On first use, so that reading an export or a scene file needs no JAX.
    if name in ("causal", "layout"):
        return importlib.import_module(f"jaxnav.{name}")
    if name == "make":
        return importlib.import_module("jaxnav.env.make").make
    raise AttributeError(f"module 'jaxnav' has no attribute {name!r}")
