"""Statistics of scenes as console tables, and remarks about scenes with unusual content."""

from collections.abc import Iterable, Sequence

import numpy as np
from rich.table import Table

from jaxnav.evaluation.scene_statistics import (
    SceneStatistics,
    fit_priors,
    summarize_categories,
    summarize_pairs,
    summarize_rooms,
)
from jaxnav.scenes.categories import count_unknown_types
from jaxnav.scenes.scene import SPLITS
from jaxnav.scenes.task import Task

_MAX_PAIRS = 15

_ROOM_TITLE = "Room types: scenes of each split, standable cells (minimum, quartiles, maximum), and medians of the rest"
_CATEGORY_TITLE = (
    "Categories: share of the scenes; mean number in these scenes; median height of the centre; actions L* to success"
)
_PAIR_TITLE = "Detected together: pairs with the strongest correlation phi over all poses; i is the rarer category"
_PRIOR_TITLE = "Layout priors of the run against the layouts of the scenes: KL divergence in nats, cosine similarity"

#: Columns of names; the other columns have numbers, aligned to the right.
_NAME_COLUMNS = ("room type", "category", "i", "j")


def scene_tables(
    statistics: Sequence[SceneStatistics], task: Task, priors: np.ndarray | None = None
) -> dict[str, Table]:
    """Build the tables of scenes by title.

    Args:
      statistics: statistics of at least one scene.
      task: categories and rules of these statistics.
      priors: layout priors to compare the scenes with, see `fit_priors`.
    """
    tables = {
        _ROOM_TITLE: _room_table(statistics),
        _CATEGORY_TITLE: _category_table(statistics, task),
        _PAIR_TITLE: _pair_table(statistics, task),
    }
    if priors is not None:
        tables[_PRIOR_TITLE] = _prior_table(statistics, priors)
    return tables


def scene_remarks(statistics: Sequence[SceneStatistics], task: Task) -> list[str]:
    """List absent categories, unknown types and scenes without a goal."""
    # Gather the scenes, those without a goal, and which categories occur in any of them, bool [K].
    scenes = []
    scenes_without_goal = []
    is_present = np.zeros(len(task.categories), bool)
    for scene_statistics in statistics:
        scenes.append(scene_statistics.scene)
        is_present |= np.asarray(scene_statistics.num_objects) > 0
        if not scene_statistics.has_goal:
            scenes_without_goal.append(scene_statistics.scene.name)
    absent_categories = [task.categories[category] for category in np.flatnonzero(~is_present)]

    # Objects of unknown types, the most frequent first.
    unknown_types = []
    for type_name, count in count_unknown_types(scenes, task.categories).most_common():
        unknown_types.append(f"{type_name} x {count}")

    # One line each, also where there is nothing to remark.
    names_by_title = {
        "Categories in no scene": absent_categories,
        "Unknown types, which only block the sight": unknown_types,
        "Scenes without a goal": scenes_without_goal,
    }
    remarks = []
    for remark_title, remark_names in names_by_title.items():
        remarks.append(f"{remark_title}: {', '.join(remark_names) or 'none'}")
    return remarks


def _room_table(statistics: Sequence[SceneStatistics]) -> Table:
    table = _make_table("room type", *SPLITS, "standable cells", "width x depth", "objects", "in a category")
    for room in summarize_rooms(statistics):
        width, depth = room.size
        table.add_row(
            room.room_type,
            *map(str, room.splits),
            _join_formatted(room.cells, ".0f"),
            f"{width:.1f} x {depth:.1f} m",
            f"{room.num_objects:g}",
            f"{room.num_categorized:g}",
        )
    return table


def _category_table(statistics: Sequence[SceneStatistics], task: Task) -> Table:
    table = _make_table("category", "scenes", "number", "height", "L* median", "L* 95 %")
    for category in summarize_categories(statistics, task):
        table.add_row(
            category.name,
            f"{category.share:.0%}",
            f"{category.number:.2f}",
            f"{category.height:.2f} m",
            *map(str, category.path_lengths or ("-", "-")),
        )
    return table


def _pair_table(statistics: Sequence[SceneStatistics], task: Task) -> Table:
    table = _make_table("i", "j", "P(j | i)", "P(j)", "phi")
    for pair in summarize_pairs(statistics, task, _MAX_PAIRS):
        pair_probabilities = (f"{pair.conditional:.2f}", f"{pair.marginal:.2f}", f"{pair.phi:.2f}")
        table.add_row(pair.rarer, pair.other, *pair_probabilities)
    return table


def _prior_table(statistics: Sequence[SceneStatistics], priors: np.ndarray) -> Table:
    table = _make_table("room type", "scenes", "KL mean", "KL quartiles", "cosine mean", "cosine quartiles")
    for prior_fit in fit_priors(statistics, priors):
        # Without scenes that can be compared, the other cells stay empty.
        row_cells = [prior_fit.room_type, str(len(prior_fit.gaps))]
        if len(prior_fit.gaps):
            row_cells += _mean_and_quartiles(prior_fit.gaps)
            row_cells += _mean_and_quartiles(prior_fit.similarities)
        table.add_row(*row_cells)
    return table


def _mean_and_quartiles(fit_values: np.ndarray) -> tuple[str, str]:
    quartiles = np.quantile(fit_values, [0.25, 0.5, 0.75])
    return f"{fit_values.mean():.2f}", _join_formatted(quartiles, ".2f")


def _join_formatted(numbers: Iterable[float], number_format: str) -> str:
    return " ".join(format(number, number_format) for number in numbers)


def _make_table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for column in columns:
        table.add_column(column, justify="left" if column in _NAME_COLUMNS else "right")
    return table
