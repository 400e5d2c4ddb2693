"""Rows are picked by their trial and their gap."""

import pytest
from support import study_results

from jaxnav.causal import Form
from jaxnav.study.records import ZERO_THRESHOLD, Trial

PAPER = Trial("stde", "argmax", *ZERO_THRESHOLD)


def test_a_row_is_picked_by_its_trial_and_else_is_the_main_one():
    condition = study_results.condition(1.0)
    row = condition.row(PAPER)
    assert (row.gap, row.trial) == ("novelty", PAPER)
    assert condition.sr_difference(PAPER).mean == 5.0  # best actions: 100 more when sampled
    assert condition.sr_difference(PAPER, "evidence").mean == 4.0
    assert condition.sr_difference(Trial("layout", "sample")).mean == 101.0
    assert condition.row(Trial("stde", "argmax", 0.0, "paper", "noise")).trial.control == "noise"


def test_a_constant_is_picked_whatever_its_weight():
    weighed = Trial("stde", "argmax", 0.0, "paper", "constant", weight=0.3)
    assert study_results.condition(1.0).row(weighed).trial.weight == 0.0


def test_what_is_missing_is_a_key_error():
    coin = study_results.condition(1.0, "coin")
    assert not coin.has_row(Trial("baseline"))
    assert coin.has_row(Trial("layout"))
    with pytest.raises(KeyError, match=r"no row of Trial.*baseline"):
        coin.row(Trial("baseline"))
    with pytest.raises(KeyError, match="compared with nothing"):
        study_results.condition(1.0).sr_difference(Trial("baseline"))


def test_a_sweep_holds_every_epsilon_of_its_form():
    condition = study_results.condition(1.0)
    gains: dict[Form, float] = {"residual": 2.0, "paper": 5.0}
    for form, gain in gains.items():
        sweep = condition.rows_by_epsilon(form)
        assert list(sweep) == [0.0, 0.5, 1.0]
        for epsilon, row in sweep.items():
            assert row.trial == Trial("stde", "argmax", epsilon, form)
            assert condition.sr_difference(row.trial).mean == gain
