"""What scenes hold, in numbers: sizes, objects, what is seen together, path lengths, and the gap to a run's prior."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text

from jaxnav.env.objectnav import OTHER_ROOM
from jaxnav.errors import InputError
from jaxnav.evaluation.similarity import layout_gap, layout_similarity, seen_together
from jaxnav.runs.directory import load_run
from jaxnav.runs.policies import load_policies
from jaxnav.scenes.categories import ROOM_TYPES, category_ids, unknown_types
from jaxnav.scenes.scene import SPLITS, Scene
from jaxnav.scenes.tables.compile import compile_scene
from jaxnav.scenes.tables.observation_row import RowFormat
from jaxnav.scenes.task import Task
from jaxnav.scenes.worlds import WORLDS, Scenes, from_file, generated
from jaxnav.viz.plan import scene_size

_PAIRS = 15


@dataclasses.dataclass(frozen=True)
class Source:
    """Scenes of a file, or of a generated world.

    Attributes:
      file: scene file, or the name of a generated world: `rooms`, `apartments` or `houses`.
      split: of the scenes; default: all of a file, `val` of a generated world.
      seed: of a generated world, and of the shift.
      shift: from 0 to 1: layout shift of a generated world, in a file the share of the categories that exchange labels.
      world: world whose categories and rules count; default: the generated one, and `rooms` for a file.
    """

    file: Annotated[str, tyro.conf.Positional]
    split: Literal["train", "val", "test"] | None = None
    seed: int = 0
    shift: float = 0.0
    world: Literal["rooms", "apartments", "houses"] | None = None

    @property
    def task(self) -> Task:
        """Categories and rules."""
        return WORLDS[self.world or (self.file if self.file in WORLDS else "rooms")].task

    def scenes(self, task: Task, count: int | None = None) -> Scenes:
        """The scenes.

        Args:
          task: whose categories a shift exchanges in a file.
          count: how many of a generated world; None for as many as usual.

        Raises:
          InputError: no readable scene file, no scene of the split, or an impossible number.
        """
        if self.file in WORLDS:
            return generated(self.file, self.split or "val", count, self.seed, self.shift)
        return from_file(self.file, self.split, self.shift, self.seed, task.categories)


@dataclasses.dataclass(frozen=True)
class StatsConfig(Source):
    """Statistics of scenes.

    Attributes:
      run: a finished run; its categories and rules count, and the scenes are compared with its layout priors.
    """

    run: Path | None = None


class Numbers(NamedTuple):
    """Of one scene.

    Attributes:
      scene: it.
      cells: standable.
      size: float64 [2], see `scene_size`.
      objects: int [K], by category.
      detected: int [K], poses at which a category is detected; of `poses`.
      together: float64 [K, K], see `seen_together`.
      lengths: int [K, ...], starts (level poses) by category and L*; 0 where there is no way.
    """

    scene: Scene
    cells: int
    size: np.ndarray
    objects: np.ndarray
    detected: np.ndarray
    poses: int
    together: np.ndarray
    lengths: np.ndarray


def tell_statistics(config: StatsConfig, console: Console) -> None:
    """Print the statistics.

    Raises:
      InputError: the scenes or the run cannot be read, or both a world and a run are given.
    """
    if config.run and config.world:
        raise InputError("--world, --run: both are given, but the run has a world; leave --world out")
    run = load_run(config.run) if config.run else None
    task, policies = (run.task, load_policies(run)) if run else (config.task, None)
    scenes = config.scenes(task)
    every = (scenes[i] for i in range(len(scenes)))
    progress = Console(stderr=True)
    bar = track(every, "compiling", len(scenes), console=progress, transient=True, disable=not progress.is_terminal)
    numbers = [scene_numbers(scene, task) for scene in bar]

    tables = {
        "Scenes: standable cells (least, quartiles, most), and medians": _scene_table(numbers),
        "Categories: mean number, median height of the centre, actions from start to success": (
            _category_table(numbers, task)
        ),
        "Detected together: i, the rarer one, and j; the strongest correlations phi over poses": (
            _pair_table(numbers, task)
        ),
    }
    if policies:
        priors = np.asarray(policies.priors, np.float64)
        tables["Layouts against the run's priors: KL in nats and cosine similarity"] = _fit_table(numbers, priors)
    for title, table in tables.items():
        console.print(title, style="bold")
        console.print(table, "")
    present = np.any([n.objects for n in numbers], axis=0)
    absent = [name for name, there in zip(task.categories, present, strict=True) if not there]
    unknown = unknown_types((n.scene for n in numbers), task.categories).most_common()
    for what, names in (
        ("Categories in no scene", absent),
        ("Unknown types, which only block the sight", [f"{name} x {count}" for name, count in unknown]),
        ("Scenes without a goal", [n.scene.name for n in numbers if not n.lengths[:, 1:].any()]),
    ):
        console.print(f"{what}: {', '.join(names) or 'none'}", markup=False)


def scene_numbers(scene: Scene, task: Task) -> Numbers:
    """Compile a scene and count."""
    table, num_categories = compile_scene(scene, task), len(task.categories)
    ids = [category for category in category_ids(scene.types, task.categories) if category >= 0]
    starts = table.best_length[:: len(task.rules.horizons)]
    return Numbers(
        scene=scene,
        cells=len(table.ahead),
        size=scene_size(scene),
        objects=np.bincount(ids, minlength=num_categories),
        detected=RowFormat(num_categories).presence(table.rows).sum(axis=0),
        poses=len(table.rows),
        together=seen_together(table.rows, num_categories),
        lengths=np.stack([np.bincount(own, minlength=starts.max() + 1) for own in starts.T]),
    )


def _by_room_type(numbers: Sequence[Numbers]) -> Iterable[tuple[str, list[Numbers]]]:
    """The scenes of every room type, and of all if there are several types."""
    types = sorted({n.scene.room_type for n in numbers})
    yield from ((name, [n for n in numbers if n.scene.room_type == name]) for name in types)
    if len(types) > 1:
        yield "all", list(numbers)


def _scene_table(numbers: Sequence[Numbers]) -> Table:
    columns = ("room type", *SPLITS, "standable cells", "width x depth", "objects", "of categories")
    table = _table(columns)
    for name, own in _by_room_type(numbers):
        splits = [n.scene.split for n in own]
        width, depth = np.median([n.size for n in own], axis=0)
        objects, known = np.median([(len(n.scene.types), n.objects.sum()) for n in own], axis=0)
        quartiles = " ".join(f"{q:.0f}" for q in np.quantile([n.cells for n in own], np.linspace(0, 1, 5)))
        row = quartiles, f"{width:.1f} x {depth:.1f} m", f"{objects:g}", f"{known:g}"
        _add(table, name, *(str(splits.count(split)) for split in SPLITS), *row)
    return table


def _category_table(numbers: Sequence[Numbers], task: Task) -> Table:
    """Of each category that there is; every start of every scene counts once in the path lengths."""
    columns = ("category", "in scenes", "number there", "height", "L* median", "L* p95")
    table = _table(columns)
    counts = np.stack([n.objects for n in numbers])
    ids = [np.array(category_ids(n.scene.types, task.categories), int) for n in numbers]
    lengths = np.zeros((len(task.categories), max(2, *(n.lengths.shape[1] for n in numbers))), int)
    for n in numbers:
        lengths[:, : n.lengths.shape[1]] += n.lengths
    for k in np.flatnonzero(counts.any(axis=0)):
        own = counts[:, k][counts[:, k] > 0]
        heights = np.concatenate([n.scene.boxes[i == k, 1] for n, i in zip(numbers, ids, strict=True)])
        up_to = np.cumsum(lengths[k, 1:])
        paths = 1 + np.searchsorted(up_to, np.array([0.5, 0.95]) * up_to[-1]) if up_to[-1] else ("-", "-")
        row = f"{len(own) / len(numbers):.0%}", f"{own.mean():.2f}", f"{np.median(heights):.2f} m", *map(str, paths)
        _add(table, task.categories[k], *row)
    return table


def _pair_table(numbers: Sequence[Numbers], task: Task) -> Table:
    """The pairs of categories whose detections at a pose correlate most.

    With P over all poses of all scenes, phi = (P(i, j) - P(i) P(j)) / sqrt(P(i) (1 - P(i)) P(j) (1 - P(j))).
    """
    poses = sum(n.poses for n in numbers)
    own = np.sum([n.detected for n in numbers], axis=0) / poses
    both = np.sum([n.together for n in numbers], axis=0) / poses
    spread = np.sqrt(np.outer(own * (1 - own), own * (1 - own)))
    phi = np.divide(both - np.outer(own, own), spread, out=np.zeros_like(both), where=spread > 0)
    rows, columns = np.triu_indices(len(own), 1)
    order = [pair for pair in np.argsort(-phi[rows, columns], kind="stable")[:_PAIRS] if phi[rows, columns][pair] > 0]
    table = _table(("i", "j", "P(j | i)", "P(j)", "phi"))
    for pair in order:
        i, j = sorted((rows[pair], columns[pair]), key=lambda k: own[k])
        names = task.categories[i], task.categories[j]
        _add(table, *names, f"{both[i, j] / own[i]:.2f}", f"{own[j]:.2f}", f"{phi[i, j]:.2f}")
    return table


def _fit_table(numbers: Sequence[Numbers], priors: np.ndarray) -> Table:
    """Gap and similarity of the scenes to the priors float64 [rooms, K, K] of their room types."""
    columns = ("room type", "scenes", "KL mean", "KL quartiles", "cosine mean", "cosine quartiles")
    table = _table(columns)
    for name, every in _by_room_type(numbers):
        own = [n for n in every if n.together.any()]
        row = []
        for measure in (layout_gap, layout_similarity) if own else ():
            rooms = [n.scene.room_type for n in own]
            prior = priors[[ROOM_TYPES.index(room) if room in ROOM_TYPES else OTHER_ROOM for room in rooms]]
            values = measure(np.stack([n.together for n in own]), prior)
            row += [f"{values.mean():.2f}", " ".join(f"{q:.2f}" for q in np.quantile(values, [0.25, 0.5, 0.75]))]
        _add(table, name, str(len(own)), *row)
    return table


def _table(columns: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for column in columns:
        table.add_column(column, justify="left" if column in ("room type", "category", "i", "j") else "right")
    return table


def _add(table: Table, *cells: str) -> None:
    table.add_row(*(Text(cell) for cell in cells))
