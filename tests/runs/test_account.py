"""The accounting of a run beside one without experience."""

import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.runs.evaluate import measure_leads


@pytest.fixture
def halved(evaluated):
    """The same evaluation by an agent that fails in every other episode."""
    success = np.asarray(evaluated.outcome.success).copy()
    success[..., ::2] = False
    return evaluated._replace(outcome=evaluated.outcome._replace(success=success))


@pytest.mark.exhaustive
def test_account_has_a_lead_per_row_and_metric(evaluated, halved):
    entries = measure_leads(evaluated, halved)
    assert {entry.metric for entry in entries} == {"sr", "spl", "sr@20", "sr@50"}
    assert len(entries) == 28 * 4  # neither Random nor the shortest path
    rows = evaluated.rows
    metrics = evaluated.metrics()["sr"]
    halved_metrics = halved.metrics()["sr"]
    baseline_rows = {row.decoding: i for i, row in enumerate(rows) if row.variant == "baseline"}
    mean_leads = [entry.lead.mean for entry in entries if entry.metric == "sr"]
    expected_leads = [
        100 * (metrics[i].mean() - halved_metrics[baseline_rows[row.decoding]].mean())
        for i, row in enumerate(rows[:28])
    ]
    np.testing.assert_allclose(mean_leads, expected_leads, rtol=1e-12, atol=1e-12)


@pytest.mark.exhaustive
def test_account_has_a_share_for_rows_with_removal_alone(evaluated, halved):
    shares = {entry.variant: entry.remaining for entry in measure_leads(evaluated, halved) if entry.metric == "sr"}
    assert shares["ORG (baseline)"] is None
    assert shares["+ w (layout)"] is None
    assert shares["+ w + TDE"] is not None


@pytest.mark.slow
def test_account_of_a_run_over_itself_is_zero(evaluated):
    baselines = [entry for entry in measure_leads(evaluated, evaluated) if entry.variant == "ORG (baseline)"]
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
