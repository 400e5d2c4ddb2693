"""Scores and their paired differences: the measurements `evaluation`, `frontier`, `groups` and `account`."""

import dataclasses
import shutil
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from rich.console import Console
from support.episodes import episodes_in
from support.intervals import around, bounds

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
#: Where the agents of an evaluation are found in a table.
AT = {"world": "rooms", "run": "main", "shift": 0.0}


def without_every_other_success(results: jaxnav.Results) -> jaxnav.Results:
    """The same evaluation by an agent that fails in every other episode."""
    success = np.asarray(results.outcome.success).copy()
    success[..., ::2] = False
    return results._replace(outcome=results.outcome._replace(success=success))


@pytest.fixture
def bench(make_bench, drawn_run, evaluated, monkeypatch):
    """A bench that finds two evaluations done: that of `main`, and of `other`, which fails more often."""
    other_dir = drawn_run.config.run_dir.with_name("other")
    if not other_dir.exists():
        shutil.copytree(drawn_run.config.run_dir, other_dir)
    results_by_dir = {drawn_run.config.run_dir: evaluated, other_dir: without_every_other_success(evaluated)}
    monkeypatch.setattr("jaxnav.experiments.bench.evaluate", lambda run, **options: results_by_dir[run.config.run_dir])
    return make_bench(
        agents={
            "main": {"run": str(drawn_run.config.run_dir), "against": ["other", "other/baseline"]},
            "other": {"run": str(other_dir)},
        },
        reference="other",
    )


def fields_of(row: EvaluationRow) -> dict:
    """Fields of the rows of a result table that belong to a row of an evaluation."""
    fields = {**AT, "variant": row.variant}
    if row.variant not in ("random", "oracle"):
        fields["decoding"] = row.decoding
    if row.variant == "stde":
        fields |= {"epsilon": row.epsilon, "form": row.form}
    return fields


# Evaluation


def test_scores_are_those_of_an_evaluation(bench, evaluated):
    table = ResultTable(measure_evaluation(bench, bench.find_run("rooms", "main")))
    for row, reported in zip(evaluated.rows, evaluated.report["rows"], strict=True):
        for metric in SCALES:
            score = table.find(fields_of(row), metric=metric)
            expected = Interval.from_json(reported[metric])
            assert bounds(score) == pytest.approx(bounds(expected), nan_ok=True)
            assert score.seeds == pytest.approx(expected.seeds)


def test_differences_within_a_run_are_those_of_an_evaluation(bench, evaluated):
    table = ResultTable(measure_evaluation(bench, bench.find_run("rooms", "main")))
    for reported in evaluated.report["differences"]:
        row = EvaluationRow(reported["to"], reported["epsilon"], reported["form"], reported["decoding"])
        difference = table.find(fields_of(row), reference=reported["from"], metric=reported["metric"])
        expected = Interval.from_json(reported)
        assert bounds(difference) == pytest.approx(bounds(expected), nan_ok=True)
        assert difference.seeds == pytest.approx(expected.seeds)


def test_agents_are_compared_variant_by_variant_or_with_one_variant(bench, evaluated):
    table = ResultTable(measure_evaluation(bench, bench.find_run("rooms", "main")))
    success = 100.0 * evaluated.metrics()["sr"]
    other_success = 100.0 * without_every_other_success(evaluated).metrics()["sr"]
    rows = evaluated.rows
    for decoding in ("argmax", "sample"):
        baseline = rows.index(table_row("baseline", None, None, decoding))
        layout = rows.index(table_row("layout", None, None, decoding))
        # Against an agent: each variant with the same one. Against a variant: the last arm.
        for compared, reference, name in (
            (baseline, baseline, "other/baseline"),
            (layout, layout, "other/layout"),
            (layout, baseline, "other/baseline"),
        ):
            difference = table.find(fields_of(rows[compared]), reference=name, metric="sr")
            assert difference.mean == pytest.approx(success[compared].mean() - other_success[reference].mean())
            assert difference.seeds == ()  # trained apart


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

#: Three scenes of two episodes, of one room type.
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
    lead = table.find(AT, variant="layout", decoding="argmax", reference="chance", metric="sr")
    # By scene 100, 50 and 25 points: the mean is 175 / 3, and the variance (41.7^2 + 8.3^2 + 33.3^2) / 2 / 3 = 486.1.
    # Both runs are given, so that their spread of 50 points does not count.
    assert bounds(lead) == pytest.approx(around(175 / 3, 17500 / 36, 2))

    # Random choices of this method are random actions, which need no comparison in every metric.
    assert not table.where(reference="random").rows


def test_random_choices_that_are_no_actions_are_a_reference(make_bench):
    run = make_bench().find_run("rooms", "main")
    searching_run = run._replace(config=dataclasses.replace(run.config, method="semexp"))
    scores = make_scores({"baseline": [[1, 1, 1, 1, 0, 0]] * 2, "random": [[1, 0, 0, 0, 0, 0]] * 2})
    table = ResultTable(difference_rows(searching_run, 0.0, scores, {}))
    # Four of six episodes against one of six: 50 points of SR, 25 of SPL, and 0.5 m less.
    lead = {"variant": "baseline", "decoding": "argmax", "reference": "random"}
    assert [table.find(AT, lead, metric=metric).mean for metric in SCALES] == pytest.approx([50.0, 25.0, -0.5])


def test_agents_that_met_other_episodes_are_refused():
    check_same_episodes(SIX_EPISODES, episodes_in([0, 0, 1, 1, 2, 2]))
    for other in (
        episodes_in([0, 0, 1, 1, 2, 2], goal=[1] * 6),
        episodes_in([0, 0, 1, 1, 2, 2], names=("a", "b", "c")),
    ):
        with pytest.raises(InputError, match="train both"):
            check_same_episodes(SIX_EPISODES, other)


# Groups of agents

#: Three scenes of one episode.
THREE_EPISODES = episodes_in([0, 1, 2])
SCORES_BY_AGENT = {
    "a": make_scores({"layout": [[0, 1, 0], [0, 0, 0]], "stde": [[1, 1, 0], [1, 0, 0]]}, THREE_EPISODES),
    "b": make_scores({"layout": [[1, 0, 0], [1, 1, 0]], "stde": [[1, 0, 0], [1, 1, 1]]}, THREE_EPISODES),
    "c": make_scores({"baseline": [[1, 0, 0], [0, 0, 0]], "random": [[0, 0, 1], [1, 0, 0]]}, THREE_EPISODES),
}


@pytest.fixture
def measured_groups(make_bench, drawn_run, monkeypatch):
    """Measure groups of three agents; the agent `d` is in no world."""

    def measure(**groups) -> ResultTable:
        agents = {agent: {"run": str(drawn_run.config.run_dir)} for agent in "abcd"}
        bench = make_bench(agents=agents, left_out=("*-d",), groups=groups)
        monkeypatch.setattr(bench, "evaluate", lambda run, shift: SCORES_BY_AGENT[run.agent])
        return ResultTable(measure_groups(bench, bench.find_run("rooms", "a")))

    return measure


def test_groups_compare_two_variants_of_their_agents(measured_groups):
    table = measured_groups(
        gain={"agents": ["a", "b"], "variant": "stde", "against": "layout"},
        # An agent without the variants, and one that is left out, do not count.
        wider={"agents": ["a", "b", "c", "d"], "variant": "stde", "against": "layout"},
    )
    # Gains by run are 1 of 3 and 1 of 3 for a, 0 and 1 of 3 for b: 50 / 3 and 100 / 3 on average.
    for name in ("gain", "wider"):
        fields = AT | {"run": name, "variant": "stde", "decoding": "argmax", "reference": "layout"}
        effect = table.find(fields, metric="sr")
        assert effect.mean == pytest.approx(25.0)
        assert effect.seeds == pytest.approx((50 / 3, 100 / 3))
        # Successful episodes are twice as long as needed.
        assert table.find(fields, metric="spl").mean == pytest.approx(12.5)
        assert table.find(fields, metric="agents").mean == 2


def test_groups_are_compared_with_a_variant_of_an_agent(measured_groups):
    table = measured_groups(
        trained={"agents": ["a", "b"], "variant": "stde", "against": "c/baseline"},
        untrained={"agents": ["a", "b"], "variant": "stde", "against": "c/random"},
    )
    stde = {"variant": "stde", "decoding": "argmax", "metric": "sr"}
    trained = table.find(AT | stde, run="trained", reference="c/baseline")
    untrained = table.find(AT | stde, run="untrained", reference="c/random")
    # sTDE has 3 of 6 and 4 of 6, 350 / 6 on average; c has 1 of 6, and Random 2 of 6.
    assert trained.mean == pytest.approx(250 / 6)
    assert untrained.mean == pytest.approx(150 / 6)
    # Only the runs of the group vary where the reference has no networks.
    assert trained.seeds == ()
    assert len(untrained.seeds) == 2


def test_groups_without_agents_or_reference_have_no_rows(measured_groups):
    table = measured_groups(
        nobody={"agents": ["d"], "variant": "stde", "against": "layout"},
        untrained={"agents": ["c"], "variant": "stde", "against": "c/baseline"},
        alone={"agents": ["a"], "variant": "stde", "against": "d/baseline"},
        other={"agents": ["a"], "variant": "stde", "against": "c/tde"},
    )
    assert table.rows == ()


def test_groups_of_agents_in_other_episodes_are_refused(measured_groups, monkeypatch):
    elsewhere = make_scores({"layout": [[0, 1, 0]], "stde": [[0, 1, 0]]}, episodes_in([0, 1, 2], goal=[1] * 3))
    monkeypatch.setitem(SCORES_BY_AGENT, "b", elsewhere)
    with pytest.raises(InputError, match="train both"):
        measured_groups(gain={"agents": ["a", "b"], "variant": "stde", "against": "layout"})


# Value and cost of experience


def test_accounts_are_leads_over_the_layout_blind_agents(bench, evaluated):
    table = ResultTable(measure_account(bench, bench.find_run("rooms", "main")))
    metrics = evaluated.metrics()
    layout_blind_metrics = without_every_other_success(evaluated).metrics()
    for index, row in enumerate(evaluated.rows[:-2]):  # neither Random nor the shortest path
        layout_blind = evaluated.rows.index(table_row("baseline", None, None, row.decoding))
        for metric in ("sr", "spl", "sr@20", "sr@50"):
            lead = table.find(fields_of(row), reference="other", metric=metric)
            expected = 100.0 * (metrics[metric][index].mean() - layout_blind_metrics[metric][layout_blind].mean())
            assert lead.mean == pytest.approx(expected)
    assert not table.where(variant="random").rows


def test_accounts_agree_with_the_leads_of_two_evaluations(bench, evaluated):
    table = ResultTable(measure_account(bench, bench.find_run("rooms", "main")))
    leads = measure_leads(evaluated, without_every_other_success(evaluated))
    num_shares = 0
    for lead in leads:
        fields = fields_of(evaluated.rows[lead.row_index]) | {"reference": "other"}
        assert bounds(table.find(fields, metric=lead.metric)) == pytest.approx(bounds(lead.lead), nan_ok=True)
        # Only what removes experience has a share.
        share = Interval(float("nan")) if lead.remaining is None else lead.remaining
        num_shares += table.has(fields, metric=f"{lead.metric} remaining")
        assert bounds(table.find(fields, metric=f"{lead.metric} remaining")) == pytest.approx(
            bounds(share), nan_ok=True
        )
    # TDE and sTDE, with two decodings, in four metrics.
    assert num_shares == 2 * 2 * 4


def test_accounts_need_layout_blind_agents(make_bench):
    bench = make_bench()
    with pytest.raises(InputError, match="--reference"):
        next(measure_account(bench, bench.find_run("rooms", "main")))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seeds": 3}, "seeds"),
        ({"scenes": "missing.jsonl"}, "scenes"),
        ({"worlds": {"num_val": 5}}, "worlds"),
        ({"detector": {"seed": 1}}, "task"),
        ({"arms": ["layout"]}, "baseline"),
    ],
)
def test_accounts_refuse_agents_of_another_world_or_without_a_baseline(make_bench, drawn_run, changes, named):
    agents = {"main": {"run": str(drawn_run.config.run_dir)}, "anonymous": changes}
    bench = make_bench(agents=agents, base=drawn_run.config)
    with pytest.raises(InputError, match=named):
        next(measure_account(bench, bench.find_run("rooms", "main")))


# Training, and frontier search


def test_training_rows_count_steps_seconds_and_success(drawn_run, make_bench, tmp_path):
    run_dir = tmp_path / "logged"
    shutil.copytree(drawn_run.config.run_dir, run_dir)
    run = make_bench().find_run("rooms", "main")
    run = run._replace(config=load_run_config(run_dir))

    # Without logs only the steps are known: 64 walks of 20 steps were drawn, and 4 updates of 16 x 8 learned from.
    table = ResultTable(training_rows(run))
    fields = {"world": "rooms", "run": "main"}
    steps = [
        table.find(fields, metric=f"{purpose} (steps)").mean for purpose in ("exploration", "imitation", "learning")
    ]
    assert steps == [1280, 0, 512]
    assert not table.has(fields, metric="training (s)")

    # Two chunks of two updates each, with success on `val` after both.
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
        # Living rooms have 14 actions, all others 12.
        limits = np.array([14 if room == "living_room" else 12 for room in bank.room_types])
        searched = run_frontier_search(bank, draw_episodes(bank, 24), limits)
        fields = {"world": "rooms", "run": "main", "variant": "frontier", "shift": shift}
        assert table.find(fields, metric="sr").mean == pytest.approx(100 * np.mean(searched.success))
        assert table.num_scenes(fields) == 4
