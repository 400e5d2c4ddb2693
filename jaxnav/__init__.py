"""Layout-based causal inference for object navigation, in JAX.

`make` builds an environment; `layout` and `causal` hold the equations. Everything else is imported from its own module.
"""

from jaxnav import causal, layout
from jaxnav.env.make import make

__version__ = "0.1.0"

__all__ = ["__version__", "causal", "layout", "make"]
