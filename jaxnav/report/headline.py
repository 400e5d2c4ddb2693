"""The headline of the report: the main results as two or three sentences and as a few key figures.

`make_headline` reads reports of evaluations and leads over layout-blind agents. All numbers are those of the tables.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxnav.evaluation.report import ExperienceLead
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.figures import interval_text

#: Report of an evaluation, as in JSON.
_Report = Mapping[str, Any]

_PERCENT_AXIS = (0.0, 100.0)


class KeyFigure(NamedTuple):
    """One quantity at every shift.

    Attributes:
      title: name of the quantity.
      note: one short sentence on how to read it.
      unit: unit of the values, such as `%`.
      axis: ends of the axis on which the page draws the values.
      values: value with its interval, by name of the shift.
    """

    title: str
    note: str
    unit: str
    axis: tuple[float, float]
    values: Mapping[str, Interval]

    @property
    def is_difference(self) -> bool:
        """True for differences, whose axis has 0 in its middle."""
        return self.axis[0] < 0


class Headline(NamedTuple):
    """The main results in words and numbers."""

    sentences: tuple[str, ...]
    figures: tuple[KeyFigure, ...]


def make_headline(
    reports: Mapping[float, _Report], accounts: Mapping[float, Sequence[ExperienceLead] | None], threshold: float
) -> Headline:
    """Summarize the results with best actions.

    Args:
      reports: reports of evaluations, by shift.
      accounts: leads over layout-blind agents, by shift; None without such agents.
      threshold: threshold of sTDE.
    """
    # The agent of the headline uses its layout weights if it has any.
    success = {}
    path_success = {}
    agent_name = split = ""
    for shift, report in reports.items():
        main_row = _find_main_row(report)
        agent_name = _describe_agent(main_row)
        split = main_row["split"]
        success[_shift_name(shift)] = Interval.from_json(main_row["sr"])
        path_success[_shift_name(shift)] = Interval.from_json(main_row["spl"])

    success_texts = []
    for shift, value in _lower_names(success).items():
        success_texts.append(f"in {_value_text(value, '.1f', '%')} of the {split} episodes at {shift}")
    sentences = [f"{agent_name} reaches the goal {_join_words(success_texts)}."]
    figures = [
        KeyFigure("Success rate", "SR, best actions.", "%", _PERCENT_AXIS, success),
        KeyFigure("Success weighted by path length", "SPL, best actions.", "%", _PERCENT_AXIS, path_success),
    ]

    # What a removal of experience changes.
    removal_changes = _removal_changes(reports, threshold)
    if removal_changes:
        removal_name = f"Removal of experience by sTDE (ε = {threshold:g})"
        sentences.append(_change_sentence(f"{removal_name} changes success by", removal_changes))
        figures.append(_change_figure("Change by removal", f"SR, sTDE with ε = {threshold:g}.", removal_changes))

    # What experience is worth, compared with layout-blind agents.
    leads = _success_leads(reports, accounts)
    if leads:
        sentences.append(_change_sentence("The lead over layout-blind agents in success is", leads))
        figures.append(_change_figure("Lead over layout-blind agents", "SR; value or cost of experience.", leads))

    # How much of the behavior depends on experience of other categories.
    category_shares = _category_shares(reports)
    if category_shares:
        share_note = "Share of decisions; near 0, neither w nor sTDE can matter."
        figures.append(
            KeyFigure("Decisions that need other categories", share_note, "%", _PERCENT_AXIS, category_shares)
        )
    return Headline(tuple(sentences), tuple(figures))


def _find_main_row(report: _Report) -> Mapping[str, Any]:
    """Return the row with layout weights and best actions, or else the first row."""
    for row in report["rows"]:
        if (row["variant"], row["decoding"]) == ("layout", "argmax"):
            return row
    return report["rows"][0]


def _describe_agent(row: Mapping[str, Any]) -> str:
    if row["variant"] == "layout":
        return f"{row['method']} with layout weights"
    return row["method"]


def _removal_changes(reports: Mapping[float, _Report], threshold: float) -> dict[str, Interval]:
    """Return the paired difference of sTDE in success at each shift; empty for agents without layout weights."""
    changes = {}
    for shift, report in reports.items():
        for entry in report["differences"]:
            compared = (entry["metric"], entry["decoding"], entry["from"], entry["to"], entry["epsilon"])
            if compared == ("sr", "argmax", "layout", "stde", threshold):
                changes[_shift_name(shift)] = Interval.from_json(entry)
    return changes


def _success_leads(
    reports: Mapping[float, _Report], accounts: Mapping[float, Sequence[ExperienceLead] | None]
) -> dict[str, Interval]:
    """Return the lead of the main row in success at each shift; empty without layout-blind agents."""
    leads = {}
    for shift, account in accounts.items():
        main_index = reports[shift]["rows"].index(_find_main_row(reports[shift]))
        for lead in account or ():
            if (lead.row_index, lead.metric) == (main_index, "sr"):
                leads[_shift_name(shift)] = lead.lead
    return leads


def _category_shares(reports: Mapping[float, _Report]) -> dict[str, Interval]:
    """Return the share of decisions that depend on other categories at each shift; empty if not measured."""
    shares = {}
    for shift, report in reports.items():
        variant = _find_main_row(report)["variant"]
        for entry in report["decision_shares"]:
            measured = (entry["variant"], entry["decoding"], entry["part"])
            if measured == (variant, "argmax", "other_categories") and entry["share"]["mean"] is not None:
                shares[_shift_name(shift)] = Interval.from_json(entry["share"])
    return shares


def _change_sentence(start: str, changes: Mapping[str, Interval]) -> str:
    """Return a sentence with the changes at every shift, and what their intervals say."""
    change_texts = []
    verdicts = []
    for shift, change in _lower_names(changes).items():
        change_texts.append(f"{_value_text(change, '+.1f', 'points')} at {shift}")
        verdicts.append(_describe_change(change))

    # One verdict that holds at every shift stands at the end.
    if len(set(verdicts)) == 1:
        return f"{start} {_join_words(change_texts)}: {verdicts[0]}."
    judged_texts = []
    for change_text, verdict in zip(change_texts, verdicts, strict=True):
        judged_texts.append(f"{change_text} ({verdict})")
    return f"{start} {_join_words(judged_texts)}."


def _change_figure(title: str, note: str, changes: Mapping[str, Interval]) -> KeyFigure:
    """Return a figure of differences, on an axis that is as long to the left of 0 as to its right."""
    largest_bound = 1.0
    for change in changes.values():
        for bound in (change.mean, change.low, change.high):
            # Missing bounds are NaN, which no comparison prefers.
            largest_bound = max(largest_bound, abs(bound))
    return KeyFigure(title, note, "points", (-1.1 * largest_bound, 1.1 * largest_bound), changes)


def _describe_change(change: Interval) -> str:
    if not change.has_bounds:
        return "no interval"
    if change.low > 0:
        return "a gain"
    if change.high < 0:
        return "a loss"
    return "no measurable difference"


def _value_text(value: Interval, number_format: str, unit: str) -> str:
    """Return a value with its unit before its bounds."""
    number, _, bounds = interval_text(value, number_format).partition(" ")
    return f"{number} {unit} {bounds}".strip()


def _shift_name(shift: float) -> str:
    return f"Shift {shift:g}"


def _lower_names(values: Mapping[str, Interval]) -> dict[str, Interval]:
    """Return values by names for the middle of a sentence."""
    return {name.lower(): value for name, value in values.items()}


def _join_words(words: Sequence[str]) -> str:
    """Join parts of a sentence with commas and a last `and`."""
    *first_words, last_word = words
    if not first_words:
        return last_word
    return f"{', '.join(first_words)} and {last_word}"
