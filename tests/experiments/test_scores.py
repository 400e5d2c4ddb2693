"""Scores of agents and their paired differences: the measurements `evaluation`, `frontier`, `groups` and `account`."""

import dataclasses
import shutil
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from rich.console import Console
from support.episodes import episodes_in
from support.intervals import bounds, student_interval

import jaxnav
from jaxnav.baselines.frontier import run_frontier_search
from jaxnav.choices import Variant
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import draw_episodes
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.statistics import Interval
from jaxnav.evaluation.variants import EvaluationRow, table_row
from jaxnav.experiments.bench import Scores
from jaxnav.experiments.scores import (
    check_same_episodes,
    difference_rows,
    measure_account,
    measure_evaluation,
    measure_frontier,
    measure_groups,
    training_rows,
)
from jaxnav.experiments.table import ResultTable
from jaxnav.runs.evaluate import measure_leads
from jaxnav.runs.run import RunLogs, load_run_config
from jaxnav.runs.worlds import compile_evaluation_world

QUIET = Console(quiet=True)
SCALES = {"sr": 100.0, "spl": 100.0, "dts": 1.0}
#: Fields of the evaluated agent in a result table.
MAIN_FIELDS = {"world": "rooms", "run": "main", "shift": 0.0}


def fail_every_other_episode(results: jaxnav.Results) -> jaxnav.Results:
    """Results of an agent that also fails in every other episode."""
    success = np.asarray(results.outcome.success).copy()
    success[..., ::2] = False
    return results._replace(outcome=results.outcome._replace(success=success))


@pytest.fixture
def bench(make_bench, drawn_run, evaluated, monkeypatch):
    """Bench with two finished evaluations: that of `main`, and that of `other`, which fails more often."""
    other_dir = drawn_run.config.run_dir.with_name("other")
    if not other_dir.exists():
        shutil.copytree(drawn_run.config.run_dir, other_dir)
    results_by_dir = {drawn_run.config.run_dir: evaluated, other_dir: fail_every_other_episode(evaluated)}
    monkeypatch.setattr("jaxnav.experiments.bench.evaluate", lambda run, **options: results_by_dir[run.config.run_dir])
    return make_bench(
        agents={
            "main": {"run": str(drawn_run.config.run_dir), "against": ["other", "other/baseline"]},
            "other": {"run": str(other_dir)},
        },
        reference="other",
    )


def result_fields(row: EvaluationRow) -> dict:
    """Fields in a result table of the agent in a row of an evaluation."""
    fields = {**MAIN_FIELDS, "variant": row.variant}
    if row.variant not in ("random", "oracle"):
        fields["decoding"] = row.decoding
    if row.variant == "stde":
        fields |= {"epsilon": row.epsilon, "form": row.form}
    return fields


# Evaluation


def test_scores_are_those_of_an_evaluation(bench, evaluated):
    table = ResultTable(measure_evaluation(bench, bench.find_run("rooms", "main")))
    for row, row_report in zip(evaluated.rows, evaluated.report["rows"], strict=True):
        for metric in SCALES:
            score = table.find(result_fields(row), metric=metric)
            expected = Interval.from_json(row_report[metric])
            assert bounds(score) == pytest.approx(bounds(expected), nan_ok=True)
            assert score.seeds == pytest.approx(expected.seeds)


def test_differences_within_a_run_are_those_of_an_evaluation(bench, evaluated):
    table = ResultTable(measure_evaluation(bench, bench.find_run("rooms", "main")))
    for report in evaluated.report["differences"]:
        row = EvaluationRow(report["to"], report["epsilon"], report["form"], report["decoding"])
        difference = table.find(result_fields(row), reference=report["from"], metric=report["metric"])
        expected = Interval.from_json(report)
        assert bounds(difference) == pytest.approx(bounds(expected), nan_ok=True)
        assert difference.seeds == pytest.approx(expected.seeds)


def test_agents_are_compared_variant_by_variant_or_with_one_variant(bench, evaluated):
    table = ResultTable(measure_evaluation(bench, bench.find_run("rooms", "main")))
    main_success = 100.0 * evaluated.metrics()["sr"]
    other_success = 100.0 * fail_every_other_episode(evaluated).metrics()["sr"]
    rows = evaluated.rows
    for decoding in ("argmax", "sample"):
        baseline = rows.index(table_row("baseline", None, None, decoding))
        layout = rows.index(table_row("layout", None, None, decoding))

        # Against an agent, each variant is compared with the variant of the same name; against a variant, only the
        # last arm is compared.
        for variant_index, reference_index, reference_name in (
            (baseline, baseline, "other/baseline"),
            (layout, layout, "other/layout"),
            (layout, baseline, "other/baseline"),
        ):
            difference = table.find(result_fields(rows[variant_index]), reference=reference_name, metric="sr")
            expected_mean = main_success[variant_index].mean() - other_success[reference_index].mean()
            assert difference.mean == pytest.approx(expected_mean)
            assert difference.seeds == ()  # the agents were trained independently


@pytest.mark.slow
def test_bench_evaluates_with_the_settings_of_the_experiment(make_bench, drawn_run):
    settings = {"split": "test", "episodes": 12, "epsilon": (0.25, 0.75), "seed": 3}
    bench = make_bench(shifts=(0.5, 1.0), form="paper", **settings)
    scores = bench.evaluate(bench.find_run("rooms", "main"), 0.5)
    expected = jaxnav.evaluate(drawn_run, shift=0.5, form=("paper",), **settings)
    assert list(scores.metrics) == expected.rows
    for index, metrics in enumerate(scores.metrics.values()):
        for name, values in expected.metrics().items():
            np.testing.assert_array_equal(metrics[name], SCALES.get(name, 100.0) * values[index])


# Differences, worked out by hand

#: Two episodes in each of three scenes, of one room type.
SIX_EPISODES = episodes_in([0, 0, 1, 1, 2, 2])


def make_scores(success: Mapping[Variant, Sequence[Sequence[float]]], episodes=SIX_EPISODES) -> Scores:
    """Scores of variants with best actions; `success` is [S, E]. SPL is half of SR, and DTS is 1 m after a failure."""
    metrics = {}
    for variant, values in success.items():
        rate = np.array(values, np.float64)
        row = table_row(variant, 0.5, "residual", "sample" if variant == "random" else "argmax")
        metrics[row] = {"sr": 100.0 * rate, "spl": 50.0 * rate, "dts": 1.0 - rate}
    results = jaxnav.Results(list(metrics), EpisodeOutcome.zeros((0,)), episodes, ("Book",), (), {})
    return Scores(metrics, episodes, results)


def test_chance_is_random_in_other_scenes_for_the_same_policies(make_bench):
    run = make_bench().find_run("rooms", "main")
    scores = make_scores(
        {
            "layout": [[1, 1, 1, 1, 1, 1], [1, 1, 0, 0, 0, 1]],
            "random": [[0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 1]],
        }
    )
    table = ResultTable(difference_rows(run, 0.0, scores, {}))
    lead = table.find(MAIN_FIELDS, variant="layout", decoding="argmax", reference="chance", metric="sr")

    # The leads by scene are 100, 50 and 25 points: their mean is 175 / 3, and its variance is
    # (41.7^2 + 8.3^2 + 33.3^2) / 2 / 3 = 486.1. The interval is for these two runs, so their spread of 50 points does
    # not count.
    assert bounds(lead) == pytest.approx(student_interval(175 / 3, 17500 / 36, 2))

    # Random choices of this method are random actions, so `chance` is the only comparison with them.
    assert not table.where(reference="random").rows


def test_random_choices_that_are_no_actions_are_a_reference(make_bench):
    run = make_bench().find_run("rooms", "main")
    searching_run = run._replace(config=dataclasses.replace(run.config, method="semexp"))
    scores = make_scores({"baseline": [[1, 1, 1, 1, 0, 0]] * 2, "random": [[1, 0, 0, 0, 0, 0]] * 2})
    table = ResultTable(difference_rows(searching_run, 0.0, scores, {}))

    # Four of six episodes against one of six are a lead of 50 points of SR, 25 of SPL, and 0.5 m less.
    lead_fields = MAIN_FIELDS | {"variant": "baseline", "decoding": "argmax", "reference": "random"}
    assert [table.find(lead_fields, metric=metric).mean for metric in SCALES] == pytest.approx([50.0, 25.0, -0.5])


def test_agents_that_ran_in_different_episodes_are_refused():
    check_same_episodes(SIX_EPISODES, episodes_in([0, 0, 1, 1, 2, 2]))
    for other_episodes in (
        episodes_in([0, 0, 1, 1, 2, 2], goal=[1] * 6),
        episodes_in([0, 0, 1, 1, 2, 2], names=("a", "b", "c")),
    ):
        with pytest.raises(InputError, match="train both"):
            check_same_episodes(SIX_EPISODES, other_episodes)


# Groups of agents

#: One episode in each of three scenes.
THREE_EPISODES = episodes_in([0, 1, 2])
SCORES_BY_AGENT = {
    "a": make_scores({"layout": [[0, 1, 0], [0, 0, 0]], "stde": [[1, 1, 0], [1, 0, 0]]}, THREE_EPISODES),
    "b": make_scores({"layout": [[1, 0, 0], [1, 1, 0]], "stde": [[1, 0, 0], [1, 1, 1]]}, THREE_EPISODES),
    "c": make_scores({"baseline": [[1, 0, 0], [0, 0, 0]], "random": [[0, 0, 1], [1, 0, 0]]}, THREE_EPISODES),
}


@pytest.fixture
def tabulate_groups(make_bench, drawn_run, monkeypatch):
    """Function that measures groups of three agents; the agent `d` is in no world."""

    def measure(**groups) -> ResultTable:
        agents = {agent: {"run": str(drawn_run.config.run_dir)} for agent in "abcd"}
        bench = make_bench(agents=agents, left_out=("*-d",), groups=groups)
        monkeypatch.setattr(bench, "evaluate", lambda run, shift: SCORES_BY_AGENT[run.agent])
        return ResultTable(measure_groups(bench, bench.find_run("rooms", "a")))

    return measure


def test_groups_compare_two_variants_of_their_agents(tabulate_groups):
    table = tabulate_groups(
        gain={"agents": ["a", "b"], "variant": "stde", "against": "layout"},
        # The agent `c` lacks the variants, and `d` is left out, so neither counts.
        wider={"agents": ["a", "b", "c", "d"], "variant": "stde", "against": "layout"},
    )
    # Gains by run are 1 of 3 and 1 of 3 for a, 0 and 1 of 3 for b: 50 / 3 and 100 / 3 on average.
    for name in ("gain", "wider"):
        fields = MAIN_FIELDS | {"run": name, "variant": "stde", "decoding": "argmax", "reference": "layout"}
        effect = table.find(fields, metric="sr")
        assert effect.mean == pytest.approx(25.0)
        assert effect.seeds == pytest.approx((50 / 3, 100 / 3))

        # Successful episodes are twice as long as needed.
        assert table.find(fields, metric="spl").mean == pytest.approx(12.5)
        assert table.find(fields, metric="agents").mean == 2


def test_groups_are_compared_with_a_variant_of_an_agent(tabulate_groups):
    table = tabulate_groups(
        trained={"agents": ["a", "b"], "variant": "stde", "against": "c/baseline"},
        untrained={"agents": ["a", "b"], "variant": "stde", "against": "c/random"},
    )
    stde_fields = MAIN_FIELDS | {"variant": "stde", "decoding": "argmax", "metric": "sr"}
    baseline_lead = table.find(stde_fields, run="trained", reference="c/baseline")
    random_lead = table.find(stde_fields, run="untrained", reference="c/random")

    # sTDE has 3 of 6 and 4 of 6, 350 / 6 on average; c has 1 of 6, and Random 2 of 6.
    assert baseline_lead.mean == pytest.approx(250 / 6)
    assert random_lead.mean == pytest.approx(150 / 6)

    # Random has no networks, so only the runs of the group vary.
    assert baseline_lead.seeds == ()
    assert len(random_lead.seeds) == 2


def test_groups_without_agents_or_reference_have_no_rows(tabulate_groups):
    table = tabulate_groups(
        missing_agents={"agents": ["d"], "variant": "stde", "against": "layout"},
        missing_variant={"agents": ["c"], "variant": "stde", "against": "c/baseline"},
        missing_reference={"agents": ["a"], "variant": "stde", "against": "d/baseline"},
        missing_reference_variant={"agents": ["a"], "variant": "stde", "against": "c/tde"},
    )
    assert table.rows == ()


def test_groups_of_agents_in_other_episodes_are_refused(tabulate_groups, monkeypatch):
    other_scores = make_scores({"layout": [[0, 1, 0]], "stde": [[0, 1, 0]]}, episodes_in([0, 1, 2], goal=[1] * 3))
    monkeypatch.setitem(SCORES_BY_AGENT, "b", other_scores)
    with pytest.raises(InputError, match="train both"):
        tabulate_groups(gain={"agents": ["a", "b"], "variant": "stde", "against": "layout"})


# Value and cost of experience


def test_accounts_are_leads_over_the_layout_blind_agents(bench, evaluated):
    table = ResultTable(measure_account(bench, bench.find_run("rooms", "main")))
    metrics = evaluated.metrics()
    layout_blind_metrics = fail_every_other_episode(evaluated).metrics()
    for index, row in enumerate(evaluated.rows[:-2]):  # neither Random nor the shortest path
        blind_index = evaluated.rows.index(table_row("baseline", None, None, row.decoding))
        for metric in ("sr", "spl", "sr@20", "sr@50"):
            lead = table.find(result_fields(row), reference="other", metric=metric)
            expected_lead = metrics[metric][index].mean() - layout_blind_metrics[metric][blind_index].mean()
            assert lead.mean == pytest.approx(100.0 * expected_lead)
    assert not table.where(variant="random").rows


def test_accounts_agree_with_the_leads_of_two_evaluations(bench, evaluated):
    table = ResultTable(measure_account(bench, bench.find_run("rooms", "main")))
    leads = measure_leads(evaluated, fail_every_other_episode(evaluated))
    num_shares = 0
    for lead in leads:
        fields = result_fields(evaluated.rows[lead.row_index]) | {"reference": "other"}
        assert bounds(table.find(fields, metric=lead.metric)) == pytest.approx(bounds(lead.lead), nan_ok=True)

        # Only rows that remove experience have a remaining share.
        expected_share = Interval(float("nan")) if lead.remaining is None else lead.remaining
        share = table.find(fields, metric=f"{lead.metric} remaining")
        num_shares += table.has(fields, metric=f"{lead.metric} remaining")
        assert bounds(share) == pytest.approx(bounds(expected_share), nan_ok=True)

    # TDE and sTDE, with two decodings, in four metrics.
    assert num_shares == 2 * 2 * 4


def test_accounts_need_layout_blind_agents(make_bench):
    bench = make_bench()
    with pytest.raises(InputError, match="--reference"):
        next(measure_account(bench, bench.find_run("rooms", "main")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": 3}, "seeds"),
        ({"scenes": "missing.jsonl"}, "scenes"),
        ({"worlds": {"num_val": 5}}, "worlds"),
        ({"detector": {"seed": 1}}, "task"),
        ({"arms": ["layout"]}, "baseline"),
    ],
)
def test_accounts_refuse_agents_of_another_world_or_without_a_baseline(make_bench, drawn_run, changes, message):
    agents = {"main": {"run": str(drawn_run.config.run_dir)}, "anonymous": changes}
    bench = make_bench(agents=agents, base=drawn_run.config)
    with pytest.raises(InputError, match=message):
        next(measure_account(bench, bench.find_run("rooms", "main")))


# Training, and frontier search


def test_training_rows_count_steps_seconds_and_success(drawn_run, make_bench, tmp_path):
    # The copy of the run gets logs further below.
    run_dir = tmp_path / "logged"
    shutil.copytree(drawn_run.config.run_dir, run_dir)
    run = make_bench().find_run("rooms", "main")
    run = run._replace(config=load_run_config(run_dir))

    # Without logs only the steps are known: exploration drew 64 walks of 20 steps, and 4 updates learned from 16 x 8.
    table = ResultTable(training_rows(run))
    fields = {"world": "rooms", "run": "main"}
    for purpose, num_steps in (("exploration", 1280), ("imitation", 0), ("learning", 512)):
        assert table.find(fields, metric=f"{purpose} (steps)").mean == num_steps
    assert not table.has(fields, metric="training (s)")

    # The logs have two chunks of two updates each, with the success on `val` after each chunk.
    logs = RunLogs(run.config)
    for chunk, success in ((2, 0.25), (4, 0.5)):
        rows = []
        for arm in ("baseline", "layout"):
            for seed in range(2):
                rows.append({"step": chunk, "arm": arm, "seed": seed, "env_steps": 128 * chunk, "val_success": success})
        logs.append(rows, {"step": chunk, "wall_s": 10.0 * chunk, "cpu_s": 1.0})
    table = ResultTable(training_rows(run))
    assert table.find(fields, metric="training (s)").mean == 40
    assert table.find(fields, metric="val sr before the last quarter").mean == 25
    assert table.find(fields, metric="val sr at the end").mean == 50


@pytest.mark.slow
def test_frontier_rows_are_searches_of_the_same_episodes(make_bench, drawn_run):
    bench = make_bench(shifts=(0.0, 1.0))
    table = ResultTable(measure_frontier(bench, bench.find_run("rooms", "main")))
    for shift in (0.0, 1.0):
        compiled_world = compile_evaluation_world(drawn_run.config, "val", None, shift, QUIET)
        bank = compiled_world.banks[0]

        # Living rooms have 14 actions, all further rooms 12.
        step_limits = np.where(np.array(bank.room_types) == "living_room", 14, 12)
        outcome = run_frontier_search(bank, draw_episodes(bank, 24), step_limits)
        fields = {"world": "rooms", "run": "main", "variant": "frontier", "shift": shift}
        assert table.find(fields, metric="sr").mean == pytest.approx(100 * np.mean(outcome.success))
        assert table.num_scenes(fields) == 4
