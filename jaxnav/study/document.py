"""The study's document, written from its results."""

from collections.abc import Sequence
from pathlib import Path

from jaxnav.errors import InputError
from jaxnav.store.files import write_atomic
from jaxnav.study.mixture_tables import mixture_sections
from jaxnav.study.results import StudyResults, load_results
from jaxnav.study.tables import (
    claims_table,
    controls_table,
    gap_tables,
    instrument_table,
    metrics_table,
    runs_table,
)

READING = "<!-- reading -->"
CAPTIONS = {
    "fig4": "Fig. 4: success of the baseline against similarity of the layout, a point per category and scene",
    "fig5": "Fig. 5: gain of + w + sTDE (epsilon 0.5) over the baseline, per category",
    "fig6a": "Fig. 6a: SR, SPL and DTS over epsilon",
    "fig6b": "Fig. 6b: mean gap per step, updated and frozen",
    "auc": "AUC of the gap per step, last shift against the first",
    "effects": "Differences of SR to the layout's weights",
}


def check_document(document: Path) -> None:
    """Refuse to write over another document.

    Raises:
      InputError: the file is there without two reading marks.
    """
    if document.exists() and document.read_text(encoding="utf-8").count(READING) != 2:
        raise InputError(f"{document}: is there, without two lines {READING}; give another --document")


def write_document(results: Path, document: Path) -> None:
    """Write the document from the results on `val` and `test`.

    What stands between the two lines `<!-- reading -->` of the document is kept: it is written by hand.

    Raises:
      InputError: there are no results on `val`, or see `check_document`.
    """
    val, test = (load_results(results / split) for split in ("val", "test"))
    if val is None:
        raise InputError(f"{results / 'val'}: holds no results; run the study first")
    lines = _head(val, reading_section(document))
    for world in val.worlds:
        lines += _world(val, world)
    if test is not None:
        lines += ["## Test, touched once", ""]
        lines += ["Epsilon (of the residual form) was chosen on `val`, at the first shift.", ""]
        for world in test.worlds.values():
            lines += [*metrics_table(world.conditions, "argmax"), ""]
    write_lines(document, lines)


def reading_section(document: Path) -> list[str]:
    """Return the section whose text is written by hand, and kept.

    Raises:
      InputError: see `check_document`.
    """
    check_document(document)
    reading = document.read_text(encoding="utf-8").split(READING)[1] if document.exists() else "\n\n"
    return ["## Summary", "", READING + reading + READING, ""]


def write_lines(document: Path, lines: Sequence[str]) -> None:
    """Write a document at once."""
    write_atomic(document, ("\n".join(lines).rstrip() + "\n").encode())


def _head(results: StudyResults, reading: Sequence[str]) -> list[str]:
    return [
        "# The study: the paper's claims put to the test",
        "",
        f"{results.seeds} seeds, {results.total_steps:,} steps a policy, {results.episodes:,} episodes at each shift, "
        "split `val`. Intervals are of 95 %, over training runs and scenes (statistics.md), not corrected for their "
        "number. `least` is the least effect that would matter. All but the summary is written by `jaxnav study`, from "
        "the results.",
        "",
        *reading,
    ]


def _world(results: StudyResults, world: str) -> list[str]:
    """Return all sections of one world."""
    in_world = results.worlds[world]
    conditions, goal = in_world.conditions, results.runs.get("goal")
    title = f"Generated {conditions[0].world}" if world == "main" else "Scenes of the file"
    lines = [f"## {title}: {conditions[0].scenes} scenes", ""]
    lines += ["### Claims", "", *claims_table(results, world), ""]
    lines += ["### Is it an instrument?", "", *instrument_table(in_world.instrument), ""]
    lines += [
        "### Table 1",
        "",
        "SR and SPL in percent, DTS in metres; ± is over seeds. `to +w` is the difference of",
        "SR to the layout's weights, paired (for `+ w`: to the baseline). Weight: mean of what is taken out.",
        "",
    ]
    lines += ["Best actions:", "", *metrics_table(conditions, "argmax"), ""]
    lines += ["Sampled actions:", "", *metrics_table(conditions, "sample"), ""]
    if world == "main" and results.mixtures:
        lines += mixture_sections(results.mixtures)
    lines += ["### Controls", "", *controls_table(conditions), ""]
    if world == "main" and goal:
        title = "### Controls where the direct pathway sees the goal's detection alone"
        lines += [title, "", *controls_table(goal), ""]
    if world == "main":
        title = "### How the parts are made: settings, counterfactual branch, one factor at a time"
        lines += [title, "", *runs_table(results), ""]
    lines += ["### Does the gap track the layout?", "", *gap_tables(in_world.course), ""]
    images = [f"![{text}](images/study/{world}-{name}.png)\n\n*{text}*\n" for name, text in CAPTIONS.items()]
    return [*lines, "### Figures", "", *images, ""]
