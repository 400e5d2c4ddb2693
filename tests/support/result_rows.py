"""Rows of results, intervals and curves with round numbers."""

import dataclasses
import math
from typing import Any

import numpy as np

from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.table import Curve, ResultRow


def make_row(value: Interval | Curve | float = 50.0, **fields: Any) -> ResultRow:
    """Row of the main agent in rooms."""
    row_value = value if isinstance(value, Interval | Curve) else Interval(value)
    return ResultRow(**{"world": "rooms", "run": "main", "metric": "sr", **fields}, value=row_value)


def make_interval(mean: float, half_width: float = 1.0) -> Interval:
    """Interval without seeds."""
    return Interval(mean, mean - half_width, mean + half_width)


def make_seeded_interval(mean: float, half_width: float = 1.0) -> Interval:
    """Interval with three seeds at a distance of 1."""
    interval = make_interval(mean, half_width)
    return dataclasses.replace(interval, std=1.0, seeds=(mean - 1.0, mean, mean + 1.0))


def make_curve(*means: float, half_width: float = math.nan) -> Curve:
    """Curve at the positions 0, 1, 2, ...; it has no bounds unless a half-width is given."""
    mean = np.array(means)
    return Curve(np.arange(len(means), dtype=float), mean, mean - half_width, mean + half_width)
