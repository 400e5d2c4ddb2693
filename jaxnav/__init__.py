"""Layout-based causal inference for object navigation, in JAX.

The names below are the public interface; everything else is imported from its own module.
"""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxnav import causal, layout
    from jaxnav.env.make import make
    from jaxnav.env.testing import check_environment
    from jaxnav.errors import InputError
    from jaxnav.policies.features import features
    from jaxnav.policies.methods import METHODS, Experience, Knowledge, Method
    from jaxnav.policies.testing import check_method
    from jaxnav.runs.config import RunConfig
    from jaxnav.runs.directory import Run
    from jaxnav.runs.evaluate import Results, evaluate
    from jaxnav.runs.policies import Policies
    from jaxnav.runs.policy import LoadedPolicy, load_policy
    from jaxnav.runs.sweep import Sweep, sweep
    from jaxnav.runs.train import train

try:
    __version__ = importlib.metadata.version("jaxnav")
except importlib.metadata.PackageNotFoundError:  # read from a folder of sources
    __version__ = "0+source"

__all__ = [
    "METHODS",
    "Experience",
    "InputError",
    "Knowledge",
    "LoadedPolicy",
    "Method",
    "Policies",
    "Results",
    "Run",
    "RunConfig",
    "Sweep",
    "__version__",
    "causal",
    "check_environment",
    "check_method",
    "evaluate",
    "features",
    "layout",
    "load_policy",
    "make",
    "sweep",
    "train",
]

#: Where the public names are.
_HOMES = {
    "METHODS": "policies.methods",
    "Experience": "policies.methods",
    "InputError": "errors",
    "Knowledge": "policies.methods",
    "LoadedPolicy": "runs.policy",
    "Method": "policies.methods",
    "Policies": "runs.policies",
    "Results": "runs.evaluate",
    "Run": "runs.directory",
    "RunConfig": "runs.config",
    "Sweep": "runs.sweep",
    "check_environment": "env.testing",
    "check_method": "policies.testing",
    "evaluate": "runs.evaluate",
    "features": "policies.features",
    "load_policy": "runs.policy",
    "make": "env.make",
    "sweep": "runs.sweep",
    "train": "runs.train",
}


def __getattr__(name: str) -> Any:
    # On first use, so that reading an export or a scene file needs no JAX.
    if name in ("causal", "layout"):
        return importlib.import_module(f"jaxnav.{name}")
    if name in _HOMES:
        return getattr(importlib.import_module(f"jaxnav.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'jaxnav' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
