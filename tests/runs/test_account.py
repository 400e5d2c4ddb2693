"""Leads of a run over a run without experience, and the share of the lead that remains after removal."""

import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.runs.evaluate import measure_leads


@pytest.fixture
def halved_results(evaluated):
    """Results of an agent that fails in every second episode of the evaluation."""
    success = np.asarray(evaluated.outcome.success).copy()
    success[..., ::2] = False
    return evaluated._replace(outcome=evaluated.outcome._replace(success=success))


@pytest.mark.exhaustive
def test_account_has_a_lead_per_row_and_metric(evaluated, halved_results):
    entries = measure_leads(evaluated, halved_results)
    assert {entry.metric for entry in entries} == {"sr", "spl", "sr@20", "sr@50"}
    # Baseline, layout, TDE and sTDE with 11 thresholds make 14 rows in each of 2 decodings. Neither Random nor the
    # shortest path has a lead.
    assert len(entries) == 28 * 4

    # The lead of a row is its success minus that of the reference's baseline with equal decoding, in percent.
    rows = evaluated.rows
    success = evaluated.metrics()["sr"]
    reference_success = halved_results.metrics()["sr"]
    baseline_index = {row.decoding: index for index, row in enumerate(rows) if row.variant == "baseline"}
    expected_leads = []
    for index, row in enumerate(rows[:28]):
        reference_mean = reference_success[baseline_index[row.decoding]].mean()
        expected_leads.append(100 * (success[index].mean() - reference_mean))
    mean_leads = [entry.lead.mean for entry in entries if entry.metric == "sr"]
    np.testing.assert_allclose(mean_leads, expected_leads, rtol=1e-12, atol=1e-12)


@pytest.mark.exhaustive
def test_only_rows_with_removal_have_a_remaining_share(evaluated, halved_results):
    entries = measure_leads(evaluated, halved_results)
    shares = {entry.variant: entry.remaining for entry in entries if entry.metric == "sr"}
    assert shares["ORG (baseline)"] is None
    assert shares["+ w (layout)"] is None
    assert shares["+ w + TDE"] is not None


@pytest.mark.slow
def test_account_of_a_run_over_itself_is_zero(evaluated):
    baselines = [entry for entry in measure_leads(evaluated, evaluated) if entry.variant == "ORG (baseline)"]
    # Two decodings, four metrics.
    assert [entry.lead.mean for entry in baselines] == [0.0] * 8


@pytest.mark.slow
def test_account_refuses_runs_that_differ(evaluated):
    one_seed_results = evaluated._replace(outcome=type(evaluated.outcome)(*(leaf[:, :1] for leaf in evaluated.outcome)))
    with pytest.raises(InputError, match="has 1 seeds, but the run has 2"):
        measure_leads(evaluated, one_seed_results)

    reversed_goals = evaluated.episodes._replace(goal=evaluated.episodes.goal[::-1])
    with pytest.raises(InputError, match="has other episodes than the run"):
        measure_leads(evaluated, evaluated._replace(episodes=reversed_goals))

    layout_rows = evaluated._replace(rows=[row for row in evaluated.rows if row.variant != "baseline"])
    with pytest.raises(InputError, match="no arm `baseline`"):
        measure_leads(evaluated, layout_rows)
