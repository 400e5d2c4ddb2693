"""Tests of the headline: its numbers are those of the report, and its verdicts follow from the intervals."""

import re

import pytest

from jaxnav.evaluation.report import ExperienceLead
from jaxnav.evaluation.statistics import Interval
from jaxnav.report.headline import make_headline


def interval_json(mean, bounds):
    return {"mean": mean, "ci95": bounds}


def make_row(variant, decoding, mean):
    metrics = {"sr": interval_json(mean, [mean - 5, mean + 5]), "spl": interval_json(mean / 2, None)}
    return {"variant": variant, "decoding": decoding, "method": "ORG", "split": "val"} | metrics


def make_difference(epsilon, mean, bounds):
    identity = {"metric": "sr", "from": "layout", "to": "stde", "epsilon": epsilon, "decoding": "argmax"}
    return identity | interval_json(mean, bounds)


def make_example_report(mean, change, bounds):
    """Report with a baseline, layout weights and the change by sTDE at 0.5, next to entries of other rows."""
    rows = [
        make_row("baseline", "argmax", 11.0),
        make_row("layout", "sample", 12.0),
        make_row("layout", "argmax", mean),
    ]
    differences = [make_difference(0.25, 77.0, [70, 80]), make_difference(0.5, change, bounds)]
    share = {"variant": "layout", "decoding": "argmax", "part": "other_categories"}
    shares = [
        {**share, "share": interval_json(3.0, None)},
        {**share, "part": "memory", "share": interval_json(9, None)},
    ]
    return {"rows": rows, "differences": differences, "decision_shares": shares}


REPORTS = {0.0: make_example_report(80.0, -1.0, [-2.0, 0.5]), 1.0: make_example_report(60.0, 4.0, [1.0, 7.0])}
NO_ACCOUNTS = dict.fromkeys(REPORTS)


def signed_numbers(text):
    return [float(number.replace("\N{MINUS SIGN}", "-")) for number in re.findall(r"[-+\N{MINUS SIGN}]?\d+\.\d", text)]


def test_headline_states_success_with_best_actions_and_layout_weights():
    success_sentence, _ = make_headline(REPORTS, NO_ACCOUNTS, 0.5).sentences
    assert signed_numbers(success_sentence) == [80.0, 75.0, 85.0, 60.0, 55.0, 65.0]


def test_headline_states_the_change_by_removal_at_the_threshold():
    _, removal_sentence = make_headline(REPORTS, NO_ACCOUNTS, 0.5).sentences
    assert signed_numbers(removal_sentence) == [0.5, -1.0, -2.0, 0.5, 4.0, 1.0, 7.0]


@pytest.mark.parametrize(
    ("bounds", "verdict"),
    [
        ([0.5, 2.0], "a gain"),
        ([-2.0, -0.5], "a loss"),
        ([-2.0, 0.5], "no measurable difference"),
        (None, "no interval"),
    ],
)
def test_headline_judges_a_change_by_its_interval(bounds, verdict):
    reports = {1.0: make_example_report(80.0, 1.0, bounds)}
    _, removal_sentence = make_headline(reports, {1.0: None}, 0.5).sentences
    assert removal_sentence.endswith(f"{verdict}.")


def test_key_figures_show_the_values_at_every_shift():
    values_by_title = {}
    for figure in make_headline(REPORTS, NO_ACCOUNTS, 0.5).figures:
        values_by_title[figure.title] = [value.mean for value in figure.values.values()]
    assert list(values_by_title.values()) == [[80.0, 60.0], [40.0, 30.0], [-1.0, 4.0], [3.0, 3.0]]


def test_axis_of_a_change_is_symmetric_and_contains_its_interval():
    change_figure = make_headline(REPORTS, NO_ACCOUNTS, 0.5).figures[2]
    low, high = change_figure.axis
    assert low == -high
    assert high > 7.0
    assert change_figure.is_difference


def test_lead_over_layout_blind_agents_is_that_of_the_main_row():
    def make_lead(row_index, metric, mean):
        return ExperienceLead(row_index, "", "argmax", metric, Interval(mean, mean - 1, mean + 1), None)

    # The main row, layout weights with best actions, has index 2.
    accounts = {}
    for shift in REPORTS:
        accounts[shift] = [make_lead(0, "sr", 50.0), make_lead(2, "spl", 40.0), make_lead(2, "sr", 5.0 - shift)]
    headline = make_headline(REPORTS, accounts, 0.5)
    assert signed_numbers(headline.sentences[-1]) == [5.0, 4.0, 6.0, 4.0, 3.0, 5.0]
    assert [value.mean for value in headline.figures[3].values.values()] == [5.0, 4.0]


def test_agents_without_layout_weights_have_no_change_by_removal():
    reports = {0.0: {"rows": [make_row("baseline", "argmax", 11.0)], "differences": [], "decision_shares": []}}
    headline = make_headline(reports, {0.0: None}, 0.5)
    assert len(headline.sentences) == 1
    assert len(headline.figures) == 2
