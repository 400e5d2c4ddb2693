"""Statistics of scenes as console tables."""

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from jaxnav.evaluation.scene_statistics import (
    SceneStatistics,
    category_summaries,
    pair_summaries,
    prior_fits,
    room_summaries,
)
from jaxnav.scenes.categories import unknown_types
from jaxnav.scenes.scene import SPLITS
from jaxnav.scenes.task import Task

_PAIRS = 15


def scene_tables(
    statistics: Sequence[SceneStatistics], task: Task, priors: np.ndarray | None = None
) -> dict[str, Table]:
    """Build the tables of scenes by title.

    Args:
      statistics: of the scenes, at least one.
      task: categories and rules that they were counted by.
      priors: layout priors to compare the scenes with, see `prior_fits`.
    """
    tables = {
        "Scenes: standable cells (least, quartiles, most), and medians": _room_table(statistics),
        "Categories: mean number, median height of the centre, actions from start to success": (
            _category_table(statistics, task)
        ),
        "Detected together: i, the rarer one, and j; the strongest correlations phi over poses": (
            _pair_table(statistics, task)
        ),
    }
    if priors is not None:
        tables["Layouts against the run's priors: KL in nats and cosine similarity"] = _fit_table(statistics, priors)
    return tables


def scene_remarks(statistics: Sequence[SceneStatistics], task: Task) -> list[str]:
    """List absent categories, unknown types and scenes without a goal."""
    present = np.any([s.objects for s in statistics], axis=0)
    unknown = unknown_types((s.scene for s in statistics), task.categories).most_common()
    remarks = {
        "Categories in no scene": [name for name, there in zip(task.categories, present, strict=True) if not there],
        "Unknown types, which only block the sight": [f"{name} x {count}" for name, count in unknown],
        "Scenes without a goal": [s.scene.name for s in statistics if not s.has_goal],
    }
    return [f"{what}: {', '.join(names) or 'none'}" for what, names in remarks.items()]


def _room_table(statistics: Sequence[SceneStatistics]) -> Table:
    table = _table("room type", *SPLITS, "standable cells", "width x depth", "objects", "of categories")
    for room in room_summaries(statistics):
        cells, (width, depth) = " ".join(f"{q:.0f}" for q in room.cells), room.size
        row = cells, f"{width:.1f} x {depth:.1f} m", f"{room.objects:g}", f"{room.known:g}"
        _add(table, room.room_type, *map(str, room.splits), *row)
    return table


def _category_table(statistics: Sequence[SceneStatistics], task: Task) -> Table:
    table = _table("category", "in scenes", "number there", "height", "L* median", "L* p95")
    for category in category_summaries(statistics, task):
        row = f"{category.share:.0%}", f"{category.number:.2f}", f"{category.height:.2f} m"
        _add(table, category.name, *row, *map(str, category.lengths or ("-", "-")))
    return table


def _pair_table(statistics: Sequence[SceneStatistics], task: Task) -> Table:
    table = _table("i", "j", "P(j | i)", "P(j)", "phi")
    for pair in pair_summaries(statistics, task, _PAIRS):
        _add(table, pair.rarer, pair.other, f"{pair.given:.2f}", f"{pair.base:.2f}", f"{pair.phi:.2f}")
    return table


def _fit_table(statistics: Sequence[SceneStatistics], priors: np.ndarray) -> Table:
    table = _table("room type", "scenes", "KL mean", "KL quartiles", "cosine mean", "cosine quartiles")
    for fit in prior_fits(statistics, priors):
        row = []
        for values in (fit.gaps, fit.similarities) if len(fit.gaps) else ():
            row += [f"{values.mean():.2f}", " ".join(f"{q:.2f}" for q in np.quantile(values, [0.25, 0.5, 0.75]))]
        _add(table, fit.room_type, str(len(fit.gaps)), *row)
    return table


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for column in columns:
        table.add_column(column, justify="left" if column in ("room type", "category", "i", "j") else "right")
    return table


def _add(table: Table, *cells: str) -> None:
    table.add_row(*cells)
