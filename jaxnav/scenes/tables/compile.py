"""Compilation of scenes to flat tables over every pose.

`compile_scene` computes everything an episode in a scene may need: moves, observation rows, shortest path lengths and
distances. `compile_bank` joins the tables of many scenes into one `Bank`, whose poses and cells are numbered globally.

Symbols in shapes: S scenes, C cells, H headings, T horizons, P = C H T poses, K categories, R bytes of a row.
"""

import itertools
import zlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnav.errors import InputError
from jaxnav.scenes.categories import category_ids
from jaxnav.scenes.lattice import (
    best_actions,
    best_lengths,
    cells_ahead,
    pose_successors,
    standable_cells,
    walking_distances,
)
from jaxnav.scenes.scene import Scene, box_footprints
from jaxnav.scenes.tables.observation_row import MAX_RANGE, detection_range, object_size
from jaxnav.scenes.tables.visibility import (
    TOLERANCE,
    Targets,
    cell_centres,
    clear_of_walls,
    detect_objects,
    ego_views,
    find_sightings,
)
from jaxnav.scenes.task import Task


class Bank(NamedTuple):
    """Tables of S scenes end to end; poses and cells are numbered over all scenes.

    In a single scene, pose = (cell * H + heading) * T + horizon.

    Attributes:
      task: the task for which the scenes are compiled.
      names: [S] scene names.
      room_types: [S] room type names.
      ahead: int32 [C, H], cell after MoveAhead.
      rows: uint8 [P, R], observation row of each pose, see `Task.row_format`.
      best_length: uint16 [P, K], length L* of a shortest path, Done included; 0 for an unreachable goal and for a
        category that is no goal.
      goal_distance: float32 [C, K], metres to the nearest object of a category, inf without an object. If success means
        seeing the object, this is the horizontal distance to its centre, else the length of the walk to its footprint.
      first_cell: int32 [S], first cell of each scene.
      num_cells: int32 [S].
      goals: int32 [S, K], possible goals of each scene, of which the first `num_goals` entries are valid.
      num_goals: int32 [S].
      skipped: names of the scenes without a possible goal, which are not in the bank.
    """

    task: Task
    names: tuple[str, ...]
    room_types: tuple[str, ...]
    ahead: np.ndarray
    rows: np.ndarray
    best_length: np.ndarray
    goal_distance: np.ndarray
    first_cell: np.ndarray
    num_cells: np.ndarray
    goals: np.ndarray
    num_goals: np.ndarray
    skipped: tuple[str, ...]

    @property
    def successor(self) -> np.ndarray:
        """Pose after every action, int32 [P, 6]."""
        return pose_successors(self.ahead, self.task.rules)

    @property
    def expert(self) -> np.ndarray:
        """First action of a shortest path to every goal, uint8 [P, K], see `best_actions`."""
        successor = self.successor
        poses = np.arange(len(self.rows))
        goal_actions = []
        for goal in range(self.best_length.shape[1]):
            goals = np.full_like(poses, goal)
            goal_actions.append(best_actions(successor, self.best_length, poses, goals).astype(np.uint8))
        return np.stack(goal_actions, axis=-1)


def compile_bank(scenes: Iterable[Scene], task: Task) -> Bank:
    """Compile scenes into one bank.

    Scenes without a reachable goal are skipped and named in `skipped`.

    Args:
      scenes: scenes in the order of the bank.
      task: task whose rules and detector apply.

    Raises:
      InputError: an impossible task, or no scene has a reachable goal.
    """
    return join_scenes([compile_scene(scene, task) for scene in scenes], task)


def compile_scene(scene: Scene, task: Task) -> Bank:
    """Compile one scene by the rules of docs/environment.md; the scene may be without a reachable goal."""
    task.check()

    # Standable cells, and the moves between them.
    rules = task.rules
    cells = standable_cells(scene.reach)  # [C, 2]
    centres = cell_centres(scene, cells)
    ahead = cells_ahead(cells, rules)
    num_poses = len(cells) * rules.poses_per_cell

    # Objects in view, up to the distance at which they can be detected or Done can succeed.
    targets = _find_targets(scene, task, centres)
    detection_ranges = detection_range(object_size(scene.boxes[targets.objects]))
    distance_limits = np.maximum(detection_ranges, rules.success_distance)
    sightings = find_sightings(scene, rules, centres, targets, distance_limits)

    # Poses at which Done succeeds, and distances to the goals.
    num_categories = len(task.categories)
    if rules.success == "seen":
        success = sightings.visible_within(rules.success_distance, (num_poses, num_categories))
        goal_distance = np.full((len(cells), num_categories), np.inf)
        np.minimum.at(goal_distance.T, targets.category, targets.distance.T)
    else:
        goal_distance = _walks_to_goals(scene, task, centres, ahead, targets)
        success = np.repeat(goal_distance <= rules.success_distance + TOLERANCE, rules.poses_per_cell, axis=0)
    success &= task.is_goal()

    # Observation rows and shortest paths.
    detections, counts = detect_objects(scene, task, sightings, num_poses)
    row_format = task.row_format
    views = ego_views(scene, rules, cells, row_format.view)
    best_length = best_lengths(pose_successors(ahead, rules), success)

    # A category is a possible goal if every pose has a path to it: with four headings, cells that are only diagonal
    # neighbours are not connected. Padded to K entries, so that scenes can be joined.
    is_possible_goal = best_length.all(axis=0) & (num_poses > 0)
    goals = np.flatnonzero(is_possible_goal).astype(np.int32)
    return Bank(
        task=task,
        names=(scene.name,),
        room_types=(scene.room_type,),
        ahead=ahead,
        rows=row_format.pack(detections, views, counts),
        best_length=best_length,
        goal_distance=goal_distance.astype(np.float32),
        first_cell=np.zeros(1, np.int32),
        num_cells=np.array([len(cells)], np.int32),
        goals=np.pad(goals, (0, num_categories - len(goals)))[None],
        num_goals=np.array([len(goals)], np.int32),
        skipped=(),
    )


def categories_in_view(scene: Scene, task: Task) -> np.ndarray:
    """Return True for the categories in view from every pose.

    A category is in view if a perfect detector with range `MAX_RANGE` for objects of all sizes would detect it.

    Returns:
      bool [P, K], poses in the order of `Bank.rows`.
    """
    # Sightings of all objects within the range.
    cells = standable_cells(scene.reach)
    centres = cell_centres(scene, cells)
    targets = _find_targets(scene, task, centres)
    distance_limits = np.full(len(targets.objects), MAX_RANGE)
    sightings = find_sightings(scene, task.rules, centres, targets, distance_limits)

    num_poses = len(cells) * task.rules.poses_per_cell
    return sightings.visible_within(MAX_RANGE, (num_poses, len(task.categories)))


def join_scenes(scene_banks: Sequence[Bank], task: Task) -> Bank:
    """Join banks of one scene each end to end; see `compile_bank`."""
    usable_banks = [bank for bank in scene_banks if bank.num_goals[0] > 0]
    if not usable_banks:
        raise no_goal_error(len(scene_banks), task)
    skipped = tuple(bank.names[0] for bank in scene_banks if bank.num_goals[0] == 0)
    return concatenate_banks(usable_banks)._replace(skipped=skipped)


def concatenate_banks(banks: Sequence[Bank]) -> Bank:
    """Concatenate banks of one task, and renumber their cells."""
    # Cells are numbered over all banks, so the cells of a bank begin after the cells of earlier banks.
    cell_offsets = np.cumsum([0] + [len(bank.ahead) for bank in banks[:-1]], dtype=np.int32)
    renumbered_banks = []
    for bank, cell_offset in zip(banks, cell_offsets, strict=True):
        renumbered_banks.append(bank._replace(ahead=bank.ahead + cell_offset, first_cell=bank.first_cell + cell_offset))

    # Concatenate the arrays and the tuples of names; all banks have one task.
    fields: dict[str, Any] = {}
    for field_name in Bank._fields[1:]:
        field_parts = [getattr(bank, field_name) for bank in renumbered_banks]
        is_array = isinstance(field_parts[0], np.ndarray)
        fields[field_name] = np.concatenate(field_parts) if is_array else tuple(itertools.chain(*field_parts))
    return Bank(task=banks[0].task, **fields)


def no_goal_error(num_scenes: int, task: Task) -> InputError:
    """Return the error for scenes without a reachable goal."""
    return InputError(
        f"none of the {num_scenes} scenes has a reachable goal: give scenes with objects of the categories "
        f"{', '.join(task.goals or task.categories)} near standable cells"
    )


def bank_checksum(bank: Bank) -> int:
    """Return the CRC-32 of all fields of a bank."""
    crc = 0
    for field_value in bank:
        content_bytes = field_value.tobytes() if isinstance(field_value, np.ndarray) else repr(field_value).encode()
        crc = zlib.crc32(content_bytes, crc)
    return crc


def _find_targets(scene: Scene, task: Task, centres: np.ndarray) -> Targets:
    """Return the objects whose type is one of the categories."""
    categories = np.asarray(category_ids(scene.types, task.categories), np.int64)
    objects = np.flatnonzero(categories >= 0)
    distance = np.linalg.norm(scene.boxes[objects][:, [0, 2]] - centres[:, None], axis=-1)
    return Targets(objects, categories[objects], distance)


def _walks_to_goals(scene: Scene, task: Task, centres: np.ndarray, ahead: np.ndarray, targets: Targets) -> np.ndarray:
    """Return the length of the walk from each cell to each goal category.

    A walk ends at the footprint of the nearest object. The last part of a walk is straight, crosses no wall and is no
    longer than the success distance.

    Returns:
      float64 [C, K], metres.
    """
    # Nearest point of each footprint, as seen from each cell.
    rules = task.rules
    is_goal = task.is_goal()
    boxes = scene.boxes[targets.objects]
    footprints = box_footprints(boxes)
    nearest_point = np.clip(centres[:, None], footprints[:, 0], footprints[:, 1])  # [C, N, 2]
    distance = np.linalg.norm(nearest_point - centres[:, None], axis=-1)

    # Straight last parts that cross no wall, [C, K].
    is_candidate = (distance <= rules.success_distance + TOLERANCE) & is_goal[targets.category]
    cell, target = np.nonzero(is_candidate)
    is_clear = clear_of_walls(scene, centres[cell], nearest_point[cell, target], boxes[target][:, [0, 2]])
    cell = cell[is_clear]
    target = target[is_clear]
    straight_lengths = np.full((len(centres), len(is_goal)), np.inf)
    np.minimum.at(straight_lengths, (cell, targets.category[target]), distance[cell, target])

    # Walk to a cell with a straight last part.
    walk_lengths = straight_lengths
    walk_lengths[:, is_goal] = walking_distances(ahead, rules, straight_lengths[:, is_goal])
    return walk_lengths
