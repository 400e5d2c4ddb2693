"""Layout-based causal inference for object navigation, in JAX.

Make an environment with `make`, train a method with `train`, score a run or any agent with `evaluate`, and act with an
exported policy from `load_policy`. `METHODS` and `Method` are the starting points for a method of your own, `Scene` and
`compile_bank` for scenes of your own, `layout` and `causal` hold the paper's equations. `__all__` lists the public
interface; import anything else from its own module.
"""

import importlib
import importlib.metadata
import sys
from typing import TYPE_CHECKING, Any

from jaxnav.renames import OldNames, refuse_old_name

if TYPE_CHECKING:
    from jaxnav import causal, layout
    from jaxnav.env.make import build_environment, make
    from jaxnav.env.objectnav import EnvParams, ObjectNav, Observation, State
    from jaxnav.env.testing import check_environment
    from jaxnav.errors import InputError
    from jaxnav.layout import EstimatorConfig, LayoutEstimator, prior_from_counts
    from jaxnav.numerics.product import Linear
    from jaxnav.policies.features import NUM_FEATURES, CategoryMaps, Features, unpack_features
    from jaxnav.policies.method import Adaptation, Control, Experience, Knowledge, Method, Percept, Stage, Tracker
    from jaxnav.policies.methods import METHODS, find_method
    from jaxnav.policies.pathways import Decision, Pathways, PolicyState
    from jaxnav.policies.spec import PolicySpec
    from jaxnav.policies.testing import check_method
    from jaxnav.registry import registered
    from jaxnav.runs.batch import train_batch
    from jaxnav.runs.config import RunConfig
    from jaxnav.runs.evaluate import evaluate
    from jaxnav.runs.loaded_policy import LoadedPolicy, PolicyOutput, load_policy
    from jaxnav.runs.policies import Policies
    from jaxnav.runs.results import Results
    from jaxnav.runs.run import Run
    from jaxnav.runs.sweep import Sweep, sweep
    from jaxnav.runs.train import train
    from jaxnav.scenes.lattice import standable_cells
    from jaxnav.scenes.scene import CELL_SIZE, Scene
    from jaxnav.scenes.tables.compile import compile_bank
    from jaxnav.scenes.tables.observation_row import AHEAD_SCALE, RIGHT_SCALE, RowFormat
    from jaxnav.scenes.tables.visibility import cell_centres
    from jaxnav.scenes.task import (
        ACTIONS,
        DONE,
        LOOK_DOWN,
        LOOK_UP,
        MOVE_AHEAD,
        NUM_ACTIONS,
        ROOMS,
        ROTATE_LEFT,
        ROTATE_RIGHT,
        Task,
    )
    from jaxnav.scenes.worlds import make_generated_scenes, shift_scenes
    from jaxnav.viz.animate import animate

try:
    __version__ = importlib.metadata.version("jaxnav")
except importlib.metadata.PackageNotFoundError:  # a source tree that is not installed
    __version__ = "0+source"

__all__ = [
    "ACTIONS",
    "AHEAD_SCALE",
    "CELL_SIZE",
    "DONE",
    "LOOK_DOWN",
    "LOOK_UP",
    "METHODS",
    "MOVE_AHEAD",
    "NUM_ACTIONS",
    "NUM_FEATURES",
    "RIGHT_SCALE",
    "ROOMS",
    "ROTATE_LEFT",
    "ROTATE_RIGHT",
    "Adaptation",
    "CategoryMaps",
    "Control",
    "Decision",
    "EnvParams",
    "EstimatorConfig",
    "Experience",
    "Features",
    "InputError",
    "Knowledge",
    "LayoutEstimator",
    "Linear",
    "LoadedPolicy",
    "Method",
    "ObjectNav",
    "Observation",
    "Pathways",
    "Percept",
    "Policies",
    "PolicyOutput",
    "PolicySpec",
    "PolicyState",
    "Results",
    "RowFormat",
    "Run",
    "RunConfig",
    "Scene",
    "Stage",
    "State",
    "Sweep",
    "Task",
    "Tracker",
    "__version__",
    "animate",
    "build_environment",
    "causal",
    "cell_centres",
    "check_environment",
    "check_method",
    "compile_bank",
    "evaluate",
    "find_method",
    "layout",
    "load_policy",
    "make",
    "make_generated_scenes",
    "prior_from_counts",
    "registered",
    "shift_scenes",
    "standable_cells",
    "sweep",
    "train",
    "train_batch",
    "unpack_features",
]

#: Public names by their module.
_NAMES_BY_MODULE = {
    "env.make": ("build_environment", "make"),
    "env.objectnav": ("EnvParams", "ObjectNav", "Observation", "State"),
    "env.testing": ("check_environment",),
    "errors": ("InputError",),
    "layout": ("EstimatorConfig", "LayoutEstimator", "prior_from_counts"),
    "numerics.product": ("Linear",),
    "policies.features": ("NUM_FEATURES", "CategoryMaps", "Features", "unpack_features"),
    "policies.method": ("Adaptation", "Control", "Experience", "Knowledge", "Method", "Percept", "Stage", "Tracker"),
    "policies.methods": ("METHODS", "find_method"),
    "policies.pathways": ("Decision", "Pathways", "PolicyState"),
    "policies.spec": ("PolicySpec",),
    "policies.testing": ("check_method",),
    "registry": ("registered",),
    "runs.batch": ("train_batch",),
    "runs.config": ("RunConfig",),
    "runs.evaluate": ("evaluate",),
    "runs.policies": ("Policies",),
    "runs.loaded_policy": ("LoadedPolicy", "PolicyOutput", "load_policy"),
    "runs.results": ("Results",),
    "runs.run": ("Run",),
    "runs.sweep": ("Sweep", "sweep"),
    "runs.train": ("train",),
    "scenes.lattice": ("standable_cells",),
    "scenes.scene": ("CELL_SIZE", "Scene"),
    "scenes.tables.compile": ("compile_bank",),
    "scenes.tables.observation_row": ("AHEAD_SCALE", "RIGHT_SCALE", "RowFormat"),
    "scenes.tables.visibility": ("cell_centres",),
    "scenes.task": (
        "ACTIONS",
        "DONE",
        "LOOK_DOWN",
        "LOOK_UP",
        "MOVE_AHEAD",
        "NUM_ACTIONS",
        "ROOMS",
        "ROTATE_LEFT",
        "ROTATE_RIGHT",
        "Task",
    ),
    "scenes.worlds": ("make_generated_scenes", "shift_scenes"),
    "viz.animate": ("animate",),
}

# Imports of 0.2 get an error with the new name.
sys.meta_path.insert(0, OldNames())


def __getattr__(name: str) -> Any:
    # Modules are imported on first use, so that reading an export or a scene file does not import JAX.
    if name in ("causal", "layout"):
        return importlib.import_module(f"jaxnav.{name}")
    for module, names in _NAMES_BY_MODULE.items():
        if name in names:
            return getattr(importlib.import_module(f"jaxnav.{module}"), name)
    refuse_old_name("jaxnav", name)
    raise AttributeError(f"module 'jaxnav' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
