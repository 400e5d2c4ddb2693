"""Importer from an installed AI2-THOR simulator."""

import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from jaxnav.errors import InputError
from jaxnav.scenes.files.importers.ai2thor import scene_of_metadata, world_and_room_type
from jaxnav.scenes.scene import CELL, Scene


def read_controller(
    scenes: Sequence[str], split: str, controller_factory: Callable[..., Any] | None = None
) -> Iterator[Scene | InputError]:
    """Read the metadata of scenes from a simulator.

    Args:
      scenes: names such as `FloorPlan1` or `FloorPlan_Train1_1`.
      split: split of the scenes.
      controller_factory: makes the controller; None for `ai2thor.controller.Controller`.

    Yields:
      A scene per name, or why it cannot be used. Failures of the simulator itself are not caught.

    Raises:
      InputError: the package `ai2thor` is not installed.
    """
    controller = (controller_factory or _controller_class())(gridSize=CELL, renderDepthImage=False)
    try:
        for name in scenes:
            yield _scene_or_error(controller, name, split)
    finally:
        controller.stop()


def _controller_class() -> Callable[..., Any]:
    try:
        return importlib.import_module("ai2thor.controller").Controller
    except ImportError as error:
        raise InputError(f"--from-controller: {error}; install the simulator with `pip install ai2thor`") from error


def _scene_or_error(controller: Any, name: str, split: str) -> Scene | InputError:
    where = f"controller, {name!r}"
    # The apartments are made for another robot than the rooms; the controller warns of a wrong one.
    robot = "locobot" if world_and_room_type(name)[0] == "robothor" else "default"
    try:
        controller.reset(scene=name, agentMode=robot)
        metadata = controller.step(action="GetReachablePositions").metadata
    except ValueError as error:  # there is no such scene; the lines after the first list those that there are
        problem = str(error).strip().partition("\n")[0]
        return InputError(f"{where}: {problem} Give the name of a scene of the simulator")
    if not metadata["lastActionSuccess"]:
        return InputError(f"{where}: GetReachablePositions failed ({metadata['errorMessage']}); leave the scene out")
    try:
        return scene_of_metadata(where, metadata, split)
    except InputError as error:
        return error
