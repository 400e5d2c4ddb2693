"""Removal in a mixed population: what is compared with what."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.statistics import Interval
from jaxnav.study.claims import experience_claims
from jaxnav.study.document import experience_value_table, gap_controls_table, removal_table, timing_table
from jaxnav.study.mixture import PopulationMetrics, clock_trials, join_end_to_end
from jaxnav.study.records import NEVER, ControlComparison, MixtureReport, RemovalReport, from_json, to_json

SCENES, EACH, RUNS = 6, 4, 3
SHIFT = np.repeat([0, 1], SCENES * EACH)


def episodes(pose=0):
    """Return episodes in six scenes at both shifts, L* = 10."""
    count = 2 * SCENES * EACH
    return EpisodeList(
        scene=np.repeat(np.arange(2 * SCENES), EACH).astype(np.int32),
        goal=np.zeros(count, np.int32),
        pose=np.full(count, pose, np.int32),
        best_length=np.full(count, 10, np.int32),
        room=np.zeros(count, int),
        rooms=("house",),
        scenes=tuple(f"house-{i}" for i in range(SCENES)) * 2,
    )


def outcome(success, length=20, weight=0.0):
    """Return outcomes of three runs; `success` is what share of the four episodes of each scene succeeds."""
    shape = (RUNS, 2 * SCENES * EACH)
    lucky = np.tile(np.arange(EACH), 2 * SCENES) < EACH * np.where(SHIFT == 0, *success)
    start = EpisodeOutcome.zeros(shape)
    return start._replace(
        done=jnp.ones(shape, bool),
        success=jnp.asarray(np.broadcast_to(lucky, shape)),
        length=jnp.full(shape, length),
        choices=jnp.full(shape, length),
        mean_weight=jnp.asarray(np.broadcast_to(np.where(SHIFT == 0, 0.0, weight), shape), jnp.float32),
    )


LEDGER = PopulationMetrics(episodes(), SHIFT, (15, 30))
# Without experience half of the goals are found; with it three of four where the layout holds, and one of four else.
NOBODY, AGENT = outcome((0.5, 0.5)), outcome((0.75, 0.25))
HARD = outcome((0.5, 0.5), weight=1.0)


def means(by_shift):
    return [item.mean for item in by_shift]


def test_the_metrics_of_each_shift():
    result = LEDGER.means(LEDGER.percent_metrics(AGENT))
    # All take 20 actions where 10 do: SPL is half of SR, none succeeds within 15.
    assert {name: means(item) for name, item in result.items()} == {
        "sr": [75.0, 25.0],
        "spl": [37.5, 12.5],
        "sr@15": [0.0, 0.0],
        "sr@30": [75.0, 25.0],
    }


def test_value_and_cost_are_leads_over_the_agent_without_experience():
    nobody, agent = LEDGER.percent_metrics(NOBODY), LEDGER.percent_metrics(AGENT)
    assert means(LEDGER.differences(nobody, agent, same_runs=False)["sr"]) == [25.0, -25.0]


def test_the_mixture_weighs_both_shifts():
    agent, hard = LEDGER.percent_metrics(AGENT), LEDGER.percent_metrics(HARD)
    assert means(LEDGER.differences(agent, hard, same_runs=True)["sr"]) == [-25.0, 25.0]
    assert LEDGER.overall_differences(agent, hard)["sr"].mean == 0.0


def test_who_is_told_the_shift_keeps_the_value_and_recovers_the_cost():
    oracle = LEDGER.oracle_removal(AGENT, HARD)
    assert LEDGER.removal_weights(oracle) == (0.0, 1.0)
    nobody, agent, removed = (LEDGER.percent_metrics(item) for item in (NOBODY, AGENT, oracle))
    # Of the value all is left, of the cost nothing. No scene differs from another, so the leads are clear of 0.
    assert means(LEDGER.remaining_shares(nobody, agent, removed)["sr"]) == [100.0, 0.0]
    assert LEDGER.overall_differences(agent, removed)["sr"].mean == 12.5


def test_clocks_go_by_the_budget():
    trials = clock_trials("sample", 150)
    assert list(trials)[:3] == ["constant 0.25", "constant 0.5", "constant 0.75"]
    assert [trials[f"after step {step}"].step for step in (15, 38, 75)] == [15, 38, 75]
    after, until, constant = (
        trials[name].grid_cells(("layout",), 1) for name in ("after step 38", "until step 38", "constant 0.25")
    )
    times = [(cell.gap_begin.item(), cell.gap_end.item(), cell.given_gap.item()) for cell in (after, until, constant)]
    assert times == [(38, NEVER, 1.0), (0, 38, 1.0), (0, NEVER, 0.25)]
    assert [cell.epsilon.item() for cell in (after, until, constant)] == [0.0] * 3


def test_lists_of_banks_end_to_end():
    whole = join_end_to_end([episodes(3), episodes(4)], [100, 200])
    assert sorted(set(whole.pose.tolist())) == [3, 104]
    assert whole.scene.max() == 4 * SCENES - 1
    second = whole.take(whole.pose == 104)
    assert len(second.goal) == 2 * SCENES * EACH
    # One floor plan is one cluster, at whatever shift: six of them, and so five degrees of freedom.
    assert whole.clusters().degrees_of_freedom == second.clusters().degrees_of_freedom == SCENES - 1


# The document


def interval(mean):
    return Interval(mean, mean - 1.0, mean + 1.0)


def both(first, last):
    return {name: (interval(first), interval(last)) for name in ("sr", "spl", "sr@15", "sr@30")}


def removal(name, controls=None):
    gained = {name: interval(value) for name, value in zip(("sr", "spl", "sr@15", "sr@30"), range(1, 5), strict=True)}
    return RemovalReport(
        name=name,
        weight=(0.1, 0.9),
        change=both(-1.0, 2.0),
        mixture={metric: interval(0.5) for metric in ("sr", "spl", "sr@15", "sr@30")},
        left=both(80.0, 30.0),
        compared=controls and dict.fromkeys(controls, ControlComparison((0.3, 0.7), gained)),
    )


MIXTURE = MixtureReport(
    run="streams",
    decoding="sample",
    world="houses",
    shifts=(0.0, 1.0),
    scenes=6,
    episodes=24,
    length=(40.0, 50.0),
    without=both(50.0, 50.0),
    agent=both(75.0, 25.0),
    lead=both(25.0, -25.0),
    removals=(
        removal("TDE"),
        removal("after step 15"),
        removal("evidence, paper, eps 0", ("shuffled", "after step 15")),
    ),
)


def test_a_mixture_survives_json():
    assert repr(from_json(MixtureReport, to_json(MIXTURE))) == repr(MIXTURE)  # NaN is not equal to itself
    assert MIXTURE.removal("TDE").weight == (0.1, 0.9)
    with pytest.raises(KeyError, match="no removal 'none'"):
        MIXTURE.removal("none")


def test_the_tables_hold_what_was_measured():
    assert experience_value_table([MIXTURE])[-1].startswith("| its value (or cost) | +25.0 [+24.0, +26.0] |")
    last = removal_table(MIXTURE)[-1]
    # Kept: 80 %. Recovered: 100 - 30 %. Both of success within 30 and of success.
    assert last.endswith("| 80 [79, 81] | 80 [79, 81] | 70 [69, 71] | 70 [69, 71] |")
    assert "| 0.10, 0.90 | -1.0 [-2.0, +0.0] |" in last
    clock, other = gap_controls_table(MIXTURE)[-1], gap_controls_table(MIXTURE)[-2]
    assert clock.split("|")[2:4] == [" `after step 15`, the best clock (0.30, 0.70) ", " +4.0 [+3.0, +5.0] "]
    assert "the gap of another episode" in other
    assert [line.split("|")[1].strip() for line in timing_table(MIXTURE)[2:]] == ["after step 15"]


def test_claims_of_experience_are_read_from_the_mixture():
    result = [(claim.effect.mean, claim.verdict) for claim in experience_claims(MIXTURE)]
    # Value 25, cost 25, what TDE changes at the last shift, and what the gap's removal gains in all: 0.5 [-0.5, 1.5].
    assert result == [(25.0, "holds"), (25.0, "holds"), (2.0, "holds"), (0.5, "too small to matter")]
    assert experience_claims(dataclasses.replace(MIXTURE, decoding="argmax")) == []
