"""The evaluation report: JSON, a console table, a Markdown table.

A report is a plain dictionary that JSON holds exactly; SR, SPL and SAE are in percent (0-100), DTS in metres.
"""

import importlib.metadata
import json
import platform
import typing
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxnav.causal import Form
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.statistics import paired_difference, scene_clusters, summary
from jaxnav.store.files import write_atomic

#: Version of the JSON layout.
FORMAT = 1

Metric = Literal["sr", "spl", "dts", "sae", "timeout", "wrong_done"]
Variant = Literal["oracle", "random", "baseline", "layout", "tde", "stde"]
Decoding = Literal["argmax", "sample"]

#: What every row has; in percent but for `dts`, which is in metres. `sr@N`, success within N actions, comes besides.
_METRICS: tuple[Metric, ...] = typing.get_args(Metric)
#: Variants without training, whose seeds are repetitions.
UNTRAINED: tuple[Variant, ...] = ("oracle", "random")
_BUCKETS = {"L>=1": 1, "L>=5": 5}


def build_row(
    *,
    variant: Variant,
    method: str,
    world: str,
    split: str,
    epsilon: float | None,
    decoding: Decoding,
    form: Form | None,
    metrics: dict[str, np.ndarray],
    episodes: EpisodeList,
) -> dict[str, Any]:
    """Build one row: a variant's metrics.

    They are over all episodes and over the buckets L* >= 1 and L* >= 5.

    Every episode has L* >= 1, so the overall metrics are those of the first bucket. A bucket without episodes holds
    `"episodes": 0` and no metrics.

    Args:
      variant: what is evaluated; with `method`, `world` and `split` it names the row.
      method: name of the method as printed, for example `ORG`.
      world: world of the episodes.
      split: `train`, `val` or `test`.
      epsilon: threshold of the sTDE, None where there is none.
      decoding: how actions are taken from logits.
      form: how the counterfactual logits are combined, None where there are none.
      metrics: those of `episode_metrics`, each [S, E].
      episodes: the E episodes.

    Raises:
      InputError: metrics missing, of unequal or wrong shape, not finite or out of range, or an L* below 1.
    """
    within = [name for name in metrics if name.startswith("sr@")]
    if set(metrics) - set(within) != set(_METRICS):
        raise InputError(f"metrics are {sorted(metrics)}; give exactly {sorted(_METRICS)}, and any sr@N")
    scaled = {name: _to_report_units(name, metrics[name]) for name in (*_METRICS, *within)}
    shape = scaled["sr"].shape
    if len(shape) != 2 or {values.shape for values in scaled.values()} != {shape}:
        raise InputError("metrics differ in shape; give each as [seeds, episodes]")
    if episodes.best_length.shape != shape[1:]:
        raise InputError(f"metrics have {shape[1]} episodes, and the list {len(episodes.best_length)}; give as many")
    if (episodes.best_length < 1).any():
        raise InputError("best_length holds values below 1; drop episodes whose goal no pose can see")

    buckets: dict[str, dict[str, Any]] = {}
    for name, shortest in _BUCKETS.items():
        kept = episodes.best_length >= shortest
        buckets[name] = {"episodes": int(kept.sum())}
        if kept.any():
            scenes = scene_clusters(episodes.plan[kept], episodes.room[kept])
            for metric, values in scaled.items():
                interval = summary(values[:, kept], scenes, trained=variant not in UNTRAINED)
                buckets[name][metric] = interval.to_json()
    identity = {"variant": variant, "method": method, "world": world, "split": split}
    setting = {"epsilon": epsilon, "decoding": decoding, "form": form}
    return {**identity, **setting, "seeds": shape[0], **buckets["L>=1"], "buckets": buckets}


def build_difference(
    metric: Metric,
    reference: tuple[str, np.ndarray],
    compared: tuple[str, np.ndarray],
    *,
    epsilon: float | None,
    form: Form | None,
    decoding: Decoding,
    episodes: EpisodeList,
    same_runs: bool = False,
) -> dict[str, Any]:
    """Build one paired difference of a metric.

    It is `compared - reference` over all episodes, in the report's units.

    Args:
      metric: a key of the metrics.
      reference: (name of the variant, its results [S, E] as given to `build_row`).
      compared: the same for the variant compared with it.
      epsilon: threshold of the sTDE, None where there is none.
      form: how the compared variant combines counterfactual logits, None where there are none.
      decoding: how actions are taken from logits, in both.
      episodes: the E episodes.
      same_runs: whether equal seed indexes mean the same network (see `paired_difference`).

    Raises:
      InputError: results of unequal or wrong shape, not finite or out of range.
    """
    (source, a), (target, b) = reference, compared
    a, b = _to_report_units(metric, a), _to_report_units(metric, b)
    difference = paired_difference(a, b, episodes.clusters(), same_runs=same_runs)
    identity = {"metric": metric, "from": source, "to": target, "epsilon": epsilon, "form": form}
    return {**identity, "decoding": decoding, **difference.to_json()}


def build_report(
    rows: list[dict[str, Any]],
    differences: list[dict[str, Any]],
    notes: list[str],
    compilations: int,
    run: dict[str, Any],
) -> dict[str, Any]:
    """Build the report.

    It holds rows, differences, notes, the number of compilations that the evaluation took, settings, versions and
    format.
    """
    return {
        "run": run,
        "rows": rows,
        "differences": differences,
        "notes": notes,
        "compilations": compilations,
        "versions": versions(),
        "format": FORMAT,
    }


def versions() -> dict[str, str]:
    """Return the versions that decide the results.

    They are of Python and of packages; `jaxnav` may run uninstalled, from its source.
    """
    try:
        jaxnav = importlib.metadata.version("jaxnav")
    except importlib.metadata.PackageNotFoundError:
        jaxnav = "source"
    others = {name: importlib.metadata.version(name) for name in ("jax", "flax", "numpy")}
    return {"jaxnav": jaxnav, **others, "python": platform.python_version()}


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write the report as JSON.

    The file is replaced at once, so a reader never sees half of one.

    Raises:
      ValueError: the report holds NaN or an infinity; nothing is written.
    """
    write_atomic(path, (json.dumps(report, indent=2, allow_nan=False) + "\n").encode())


def _to_report_units(metric: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float64)
    scale = 1.0 if metric == "dts" else 100.0
    highest = np.inf if metric == "dts" else 1.0
    if not ((values >= 0) & (values <= highest) & np.isfinite(values)).all():
        unit = "metres, at least 0" if metric == "dts" else "fractions from 0 to 1"
        raise InputError(f"{metric} holds NaN or values out of range; give {unit}")
    return values * scale
