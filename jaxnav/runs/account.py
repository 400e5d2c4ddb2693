"""What experience is worth to a run."""

from typing import Any

import numpy as np

from jaxnav.errors import InputError
from jaxnav.evaluation.accounting import Entry, share_left
from jaxnav.evaluation.report_tables import label
from jaxnav.evaluation.statistics import paired_difference
from jaxnav.evaluation.variants import Row
from jaxnav.runs.directory import Run
from jaxnav.runs.evaluate import Results, evaluate
from jaxnav.runs.policies import EstimatorName


def account(
    run: Run, without: Run, *, setting: EstimatorName | None = None, hold: bool = False, **options: Any
) -> list[Entry]:
    """Account for the experience of a run, on fixed episodes.

    Args:
      run: a finished run.
      without: a finished run of agents that cannot know any layout, such as those of the method `anonymous`.
      setting, hold: layout estimator to use instead of the run's.
      **options: the others of `evaluate`, for both runs.

    Raises:
      InputError: no finished run, an impossible option, or runs that `leads` cannot compare.
    """
    return leads(evaluate(run, setting=setting, hold=hold, **options), evaluate(without, **options))


def leads(results: Results, without: Results) -> list[Entry]:
    """Return the lead of every row of an evaluation.

    It is in success, SPL and success within the world's budgets; see `Entry`.

    Args:
      results: of the agents with experience.
      without: of those that cannot know any layout; its baseline is compared with.

    Raises:
      InputError: other episodes, other numbers of seeds, or no baseline in `without`.
    """
    if not _same_episodes(results, without):
        raise InputError("account: the runs do not meet the same episodes; train both in one world, with equal rules")
    measured, known = results.metrics(), without.metrics()
    seeds, others = measured["sr"].shape[1], known["sr"].shape[1]
    if seeds != others:
        raise InputError(f"account: {seeds} seeds with experience and {others} without; train as many of each")
    if Row("baseline", None, None, "argmax") not in without.rows:
        raise InputError("account: the run without experience has no arm `baseline`; train it with one")
    scenes, entries = results.episodes.clusters(), []
    for i, row in enumerate(results.rows):
        if row.arm is None:
            continue
        plain = without.rows.index(Row("baseline", None, None, row.decoding))
        acting = results.rows.index(Row(row.arm, None, None, row.decoding))
        for metric in ("sr", "spl", *(f"sr@{budget}" for budget in results.budgets)):
            nobody, agent, removed = known[metric][plain], measured[metric][acting], measured[metric][i]
            lead = paired_difference(100.0 * nobody, 100.0 * removed, scenes)
            left = None if i == acting else share_left(nobody, agent, removed, scenes)
            entries.append(Entry(label(results.report["rows"][i]), row.decoding, metric, lead, left))
    return entries


def _same_episodes(a: Results, b: Results) -> bool:
    """Return whether two evaluations met the same episodes."""
    return a.episodes.scenes == b.episodes.scenes and all(
        np.array_equal(getattr(a.episodes, name), getattr(b.episodes, name)) for name in ("scene", "goal", "pose")
    )
