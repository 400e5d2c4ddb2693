"""Results of an evaluation: outcomes of all episodes, their metrics, and files of them."""

import csv
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome, episode_metrics
from jaxnav.evaluation.report import build_row, markdown_table, write_report
from jaxnav.evaluation.variants import EvaluationRow
from jaxnav.store.files import expand_home, write_atomic


class Results(NamedTuple):
    """Results of an evaluation with R rows, S seeds and E episodes.

    Attributes:
      rows: rows of the table.
      outcome: outcomes of the episodes, leaves [R, S, E].
      episodes: the episodes.
      categories: names of the K categories.
      budgets: numbers of actions within which success is counted too.
      report: table, paired differences, settings and versions, as JSON.
    """

    rows: list[EvaluationRow]
    outcome: EpisodeOutcome
    episodes: EpisodeList
    categories: tuple[str, ...]
    budgets: tuple[int, ...]
    report: dict[str, Any]

    def __repr__(self) -> str:
        """Table of the results in Markdown, as a notebook or `print` shows them."""
        return markdown_table(self.report)

    def _repr_markdown_(self) -> str:
        return markdown_table(self.report)

    def metrics(self) -> dict[str, np.ndarray]:
        """Metrics of every episode, float64 [R, S, E].

        All metrics are in [0, 1], except for `dts`, which is in metres; see `episode_metrics`.
        """
        return episode_metrics(self.outcome, self.episodes.best_length, self.budgets)

    def write(self, path: str | Path) -> None:
        """Write the report, and next to it a CSV file with a line per row, seed and episode.

        Raises:
          OSError: a file cannot be written.
        """
        # `eval-val.json` is accompanied by `eval-val.episodes.csv`.
        path = expand_home(path)
        write_report(path, self.report)
        csv_path = path.with_name(f"{path.name.removesuffix('.json')}.episodes.csv")
        write_atomic(csv_path, _format_csv(self).encode())


def build_result_rows(results: Results, names: dict[str, str], *, trained: bool) -> list[dict[str, Any]]:
    """Build the rows of a report.

    Args:
      results: results of R rows.
      names: `method`, `world` and `split`, see `build_row`.
      trained: see `build_row`.
    """
    metrics = results.metrics()
    report_rows = []
    for index, row in enumerate(results.rows):
        report_row = build_row(
            variant=row.variant,
            **names,
            epsilon=row.epsilon,
            decoding=row.decoding,
            form=row.form,
            metrics={name: metric_values[index] for name, metric_values in metrics.items()},
            episodes=results.episodes,
            trained=trained,
        )
        report_rows.append(report_row)
    return report_rows


def _format_csv(results: Results) -> str:
    """CSV with a line per row, seed and episode."""
    metrics = results.metrics()
    outcome = results.outcome
    episodes = results.episodes
    csv_buffer = io.StringIO()
    csv_writer = csv.writer(csv_buffer, lineterminator="\n")
    episode_columns = ["scene", "room", "goal", "start_pose", "best_length"]
    # Header.
    csv_writer.writerow([*EvaluationRow._fields, "seed", *episode_columns, "length", *metrics, "mean_weight"])

    # Cells that all rows and seeds share.
    episode_cells = []
    for scene, room, goal, pose, best_length in zip(
        episodes.scene, episodes.room, episodes.goal, episodes.pose, episodes.best_length, strict=True
    ):
        names = (episodes.scenes[scene], episodes.rooms[room], results.categories[goal])
        episode_cells.append((*names, pose, best_length))

    # Measured values, with M columns.
    num_seeds = outcome.length.shape[1]
    metric_columns = (outcome.length, *metrics.values(), outcome.mean_weight)
    measured_values = np.stack(metric_columns, axis=-1)  # [R, S, E, M]
    for row_index, row in enumerate(results.rows):
        for seed in range(num_seeds):
            metric_values = measured_values[row_index, seed].tolist()
            for cells_of_episode, episode_values in zip(episode_cells, metric_values, strict=True):
                csv_writer.writerow((*row, seed, *cells_of_episode, *map("{:.6g}".format, episode_values)))
    return csv_buffer.getvalue()
