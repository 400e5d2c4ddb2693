"""Removal of experience in a mixed population of shifts: metrics, removals, and their comparisons."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from support.tiny_run import draw_run

from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.statistics import Interval
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import ExperimentConfig, check_experiment, join_folds
from jaxnav.experiments.mixture import (
    HARD_CONTROLS,
    LAYOUT_BLIND,
    ORACLE_NAME,
    PERMUTED_CONTROL,
    REMOVAL_RULES,
    WITHOUT_REMOVAL,
    PopulationMetrics,
    join_end_to_end,
    list_fixed_trials,
    list_removal_names,
    measure_removals,
    select_removals,
)
from jaxnav.experiments.table import ResultTable
from jaxnav.experiments.trials import NEVER, TrialRunner
from jaxnav.runs.evaluate import evaluate
from jaxnav.runs.policies import EVIDENCE_GAPS

NUM_SCENES = 6
EPISODES_PER_SCENE = 4
NUM_RUNS = 3
#: Shift of each episode: 0 for the first, 1 for the second.
SHIFT = np.repeat([0, 1], NUM_SCENES * EPISODES_PER_SCENE)
METRICS = ("sr", "spl", "sr@20", "sr@50")


# Metrics of a population


def population_episodes(pose: int = 0) -> EpisodeList:
    """Episodes in six scenes at both shifts, L* = 10."""
    num_episodes = len(SHIFT)
    return EpisodeList(
        scene=np.repeat(np.arange(2 * NUM_SCENES), EPISODES_PER_SCENE).astype(np.int32),
        goal=np.zeros(num_episodes, np.int32),
        pose=np.full(num_episodes, pose, np.int32),
        best_length=np.full(num_episodes, 10, np.int32),
        room=np.zeros(num_episodes, int),
        rooms=("house",),
        scenes=tuple(f"house-{index}" for index in range(NUM_SCENES)) * 2,
    )


def make_outcome(success: tuple[float, float], weight: float = 0.0) -> EpisodeOutcome:
    """Outcomes of three runs, whose episodes take 20 actions.

    Args:
      success: share of the episodes of each scene that succeed, at either shift.
      weight: mean weight of the removed logits at the second shift; nothing is removed at the first.
    """
    shape = (NUM_RUNS, len(SHIFT))
    episode_in_scene = np.tile(np.arange(EPISODES_PER_SCENE), 2 * NUM_SCENES)
    is_success = episode_in_scene < EPISODES_PER_SCENE * np.where(SHIFT == 0, *success)
    weights = np.where(SHIFT == 0, 0.0, weight)
    return EpisodeOutcome.zeros(shape)._replace(
        done=jnp.ones(shape, bool),
        success=jnp.asarray(np.broadcast_to(is_success, shape)),
        length=jnp.full(shape, 20),
        num_decisions=jnp.full(shape, 20),
        total_weight=jnp.asarray(np.broadcast_to(20 * weights, shape), jnp.float32),
    )


POPULATION = PopulationMetrics(population_episodes(), SHIFT, (15, 30))
#: Layout-blind agents reach half of the goals at either shift.
LAYOUT_BLIND_OUTCOME = make_outcome((0.5, 0.5))
#: With experience, the agent reaches three of four goals at the first shift and one of four at the second.
AGENT_OUTCOME = make_outcome((0.75, 0.25))
#: Hard removal makes the agent as good as a layout-blind agent.
HARD_OUTCOME = make_outcome((0.5, 0.5), weight=1.0)


def list_means(intervals: tuple[Interval, ...]) -> list[float]:
    return [interval.mean for interval in intervals]


def test_population_metrics_are_means_at_each_shift():
    means = POPULATION.means(POPULATION.percent_metrics(AGENT_OUTCOME))
    # Episodes take 20 actions instead of 10: SPL is half of SR, and none succeeds within 15 actions.
    assert {name: list_means(intervals) for name, intervals in means.items()} == {
        "sr": [75.0, 25.0],
        "spl": [37.5, 12.5],
        "sr@15": [0.0, 0.0],
        "sr@30": [75.0, 25.0],
    }


def test_value_and_cost_are_differences_to_the_layout_blind_agent():
    layout_blind = POPULATION.percent_metrics(LAYOUT_BLIND_OUTCOME)
    agent = POPULATION.percent_metrics(AGENT_OUTCOME)
    assert list_means(POPULATION.differences(layout_blind, agent, same_runs=False)["sr"]) == [25.0, -25.0]


def test_overall_differences_weigh_both_shifts():
    agent = POPULATION.percent_metrics(AGENT_OUTCOME)
    hard = POPULATION.percent_metrics(HARD_OUTCOME)
    assert list_means(POPULATION.differences(agent, hard, same_runs=True)["sr"]) == [-25.0, 25.0]
    assert POPULATION.overall_differences(agent, hard)["sr"].mean == 0.0


def test_oracle_keeps_the_value_and_recovers_the_cost():
    oracle_outcome = POPULATION.oracle_removal(AGENT_OUTCOME, HARD_OUTCOME)
    assert POPULATION.removal_weights(oracle_outcome) == (0.0, 1.0)
    layout_blind = POPULATION.percent_metrics(LAYOUT_BLIND_OUTCOME)
    agent = POPULATION.percent_metrics(AGENT_OUTCOME)
    oracle = POPULATION.percent_metrics(oracle_outcome)

    # The oracle leaves 100 % of the value and 0 % of the cost. All scenes are alike, so the intervals of the leads
    # exclude 0.
    assert list_means(POPULATION.remaining_shares(layout_blind, agent, oracle, same_runs=False)["sr"]) == [100.0, 0.0]

    # The change is 0 points at the first shift and 25 at the second.
    assert POPULATION.overall_differences(agent, oracle)["sr"].mean == 12.5


# Clocks and populations


def test_clocks_remove_at_shares_of_the_budget():
    trials = list_fixed_trials("sample", 150)
    # Clocks begin or end after 0.1, 0.25 and 0.5 of 150 actions, rounded.
    assert list(trials) == [
        *("constant 0.25", "constant 0.5", "constant 0.75"),
        *("after step 15", "after step 38", "after step 75"),
        *("until step 15", "until step 38", "until step 75"),
    ]

    # Begin, end and size of the gap; without a threshold the gap is the weight.
    expected_gaps = {
        "after step 38": (38, NEVER, 1.0),
        "until step 38": (0, 38, 1.0),
        "constant 0.25": (0, NEVER, 0.25),
    }
    for name, expected in expected_gaps.items():
        cell = trials[name].grid_entries(("layout",), 1)
        assert (cell.gap_begin.item(), cell.gap_end.item(), cell.given_gap.item()) == expected
        assert cell.epsilon.item() == 0.0


def test_removals_are_selected_by_pattern():
    trials = list_fixed_trials("sample", 150)
    selected = select_removals(trials, ("constant*", "until step 15"))
    assert list(selected) == ["constant 0.25", "constant 0.5", "constant 0.75", "until step 15"]
    assert select_removals(trials, ("*",)) == trials
    assert select_removals(trials, ()) == {}
    assert {"surprise, paper, eps 0", "constant 0.5", *HARD_CONTROLS} <= set(list_removal_names())


def test_joined_lists_number_the_poses_and_scenes_of_all_banks():
    joined = join_end_to_end([population_episodes(3), population_episodes(4)], [100, 200])
    # The second bank's poses follow the 100 poses of the first.
    assert sorted(set(joined.pose.tolist())) == [3, 104]
    assert joined.scene.max() == 4 * NUM_SCENES - 1

    # A floor plan is one cluster at all shifts: six clusters have five degrees of freedom.
    second_list = joined.take(joined.pose == 104)
    assert len(second_list.goal) == len(SHIFT)
    assert joined.clusters().degrees_of_freedom == second_list.clusters().degrees_of_freedom == NUM_SCENES - 1


# Measurements, in which the baseline of the run stands in for layout-blind agents


@pytest.fixture
def bench(make_bench, drawn_run):
    run = {"run": str(drawn_run.config.run_dir)}
    return make_bench(agents={"main": run, "anonymous": run}, shifts=(0.0, 1.0), episodes=8)


#: The rules of removal that the mixture of the drawn run measures; each estimator compiles again, so they are two.
MEASURED_RULES = (REMOVAL_RULES[0], REMOVAL_RULES[-1])
#: Fields of all rows of this mixture.
MIXTURE_FIELDS = {"world": "rooms", "run": "main", "decoding": "sample"}


@pytest.fixture(scope="module")
def mixture_table(drawn_run, tmp_path_factory) -> ResultTable:
    """Results of the removals with sampled actions, of the drawn run in rooms at both shifts."""
    folder = tmp_path_factory.mktemp("mixture")
    run = {"run": str(drawn_run.config.run_dir)}
    config = ExperimentConfig(
        results=folder / "results",
        runs=folder / "runs",
        worlds={"rooms": {}},
        agents={"main": run, "anonymous": run},
        shifts=(0.0, 1.0),
        episodes=8,
    )
    bench = Bench(check_experiment(config), Console(quiet=True))

    # The run has no evidence of sightings, so the table has no rules of the gap `surprise`.
    surprise_rules = [rule for rule in REMOVAL_RULES if rule.gap == "surprise"]
    assert surprise_rules
    requested_rules = (*surprise_rules, *MEASURED_RULES)
    agent_run = bench.find_run("rooms", "main")
    assert agent_run is not None
    return ResultTable(measure_removals(bench, agent_run, "sample", "own", requested_rules))


def list_removals(table: ResultTable) -> list[str]:
    return table.distinct("variant", MIXTURE_FIELDS, reference=WITHOUT_REMOVAL)


@pytest.mark.exhaustive
def test_mixture_measures_every_removal_at_both_shifts(mixture_table):
    assert {(row.world, row.run, row.decoding) for row in mixture_table.rows} == {("rooms", "main", "sample")}
    assert {row.scenes for row in mixture_table.rows} == {4}

    # The removals are TDE and the oracle, nine clocks, three controls of TDE, and the rules.
    removals = list_removals(mixture_table)
    assert removals[:2] == ["TDE", ORACLE_NAME]
    assert removals[-2:] == [str(rule) for rule in MEASURED_RULES]
    assert len(removals) == 2 + 9 + 3 + 2
    assert removals[-5:-2] == list(HARD_CONTROLS)


@pytest.mark.exhaustive
def test_oracle_of_a_mixture_removes_nothing_at_the_first_shift_and_all_experience_at_the_last(mixture_table):
    for shift, weight in ((0.0, 0.0), (1.0, 1.0)):
        assert mixture_table.find(MIXTURE_FIELDS, variant="TDE", shift=shift, metric="weight").mean == 1.0
        assert mixture_table.find(MIXTURE_FIELDS, variant=ORACLE_NAME, shift=shift, metric="weight").mean == weight
    change_fields = MIXTURE_FIELDS | {"reference": WITHOUT_REMOVAL, "metric": "sr"}
    assert mixture_table.find(change_fields, variant=ORACLE_NAME, shift=0.0).mean == 0.0
    last_change = mixture_table.find(change_fields, variant="TDE", shift=1.0)
    assert mixture_table.find(change_fields, variant=ORACLE_NAME, shift=1.0) == last_change


@pytest.mark.exhaustive
@pytest.mark.parametrize("metric", METRICS)
def test_values_leads_and_changes_of_a_mixture_add_up(mixture_table, metric):
    for shift in (0.0, 1.0):
        fields = MIXTURE_FIELDS | {"shift": shift, "metric": metric}
        values = {}
        for variant in (LAYOUT_BLIND, WITHOUT_REMOVAL):
            values[variant] = mixture_table.find(fields, variant=variant).mean
        lead = mixture_table.find(fields, variant=WITHOUT_REMOVAL, reference=LAYOUT_BLIND)
        assert lead.mean == pytest.approx(values[WITHOUT_REMOVAL] - values[LAYOUT_BLIND])

    # The mixture weighs both shifts equally.
    for removal in list_removals(mixture_table):
        removal_fields = MIXTURE_FIELDS | {"variant": removal, "reference": WITHOUT_REMOVAL, "metric": metric}
        changes = [mixture_table.find(removal_fields, shift=shift).mean for shift in (0.0, 1.0)]
        assert mixture_table.find(removal_fields).mean == pytest.approx(sum(changes) / 2)


@pytest.mark.exhaustive
def test_every_rule_of_a_mixture_is_compared_with_its_controls(mixture_table):
    # Every rule is compared with the gap of another episode, with the mean gap unless the rule is a switch, and with a
    # clock. Gaps by evidence also have a permuted control.
    removals = list_removals(mixture_table)
    for rule, rule_controls in zip(MEASURED_RULES, (["shuffled", "course"], ["shuffled"]), strict=True):
        controls = mixture_table.distinct("control", MIXTURE_FIELDS, variant=str(rule), reference="control")
        assert controls[:-1] == rule_controls + [PERMUTED_CONTROL] * (rule.gap in EVIDENCE_GAPS)
        assert controls[-1] in removals[2:-5]


@pytest.mark.exhaustive
def test_handover_leaves_the_layout_blind_agents(bench):
    table = ResultTable(measure_removals(bench, bench.find_run("rooms", "main"), "argmax", "layout-blind", ()))
    (run_name,) = table.distinct("run")
    row_fields = {"world": "rooms", "run": run_name, "decoding": "argmax"}

    # An agent that hands over at once has the metrics of the layout-blind agents.
    for metric in METRICS:
        for shift in (0.0, 1.0):
            agent = table.find(row_fields, variant=WITHOUT_REMOVAL, shift=shift, metric=metric)
            change = table.find(row_fields, variant="TDE", reference=WITHOUT_REMOVAL, shift=shift, metric=metric)
            layout_blind = table.find(row_fields, variant=LAYOUT_BLIND, shift=shift, metric=metric)
            assert agent.mean + change.mean == pytest.approx(layout_blind.mean)


@pytest.mark.exhaustive
def test_folds_of_a_dataset_count_as_one_world(make_bench, drawn_run):
    # Two folds share 16 episodes, so every mean over the dataset is the mean of two folds with eight episodes each.
    run = {"run": str(drawn_run.config.run_dir)}
    folds = {"first": {"worlds": {"seed": 1}}, "second": {"worlds": {"seed": 2}}}
    settings = {"worlds": folds, "agents": {"main": run, "anonymous": run}, "shifts": (0.0, 1.0), "removals": ()}
    fold_tables = []
    for fold in folds:
        fold_bench = make_bench(**settings, episodes=8)
        fold_run = fold_bench.find_run(fold, "main")
        fold_tables.append(ResultTable(measure_removals(fold_bench, fold_run, "argmax", "layout-blind", ())))

    # The dataset joins the folds into one world.
    dataset_bench = make_bench(**settings, episodes=16, folds={"dataset": list(folds)})
    (dataset_run,) = join_folds(dataset_bench.config, [dataset_bench.find_run("first", "main")])
    assert [fold.world for fold in dataset_run.folds] == list(folds)
    table = ResultTable(measure_removals(dataset_bench, dataset_run, "argmax", "layout-blind", ()))
    assert table.num_scenes(variant=WITHOUT_REMOVAL) == 2 * fold_tables[0].num_scenes(variant=WITHOUT_REMOVAL)

    # Every mean of the dataset is compared with the folds.
    field_names = ("run", "variant", "decoding", "shift", "reference", "metric")
    num_compared = 0
    for row in table.rows:
        if row.metric in METRICS and row.variant != ORACLE_NAME:
            fields = {name: getattr(row, name) for name in field_names}
            fold_means = []
            for fold, fold_table in zip(folds, fold_tables, strict=True):
                fold_means.append(fold_table.find(fields, world=fold).mean)
            assert row.world == "dataset"
            assert row.value.mean == pytest.approx(sum(fold_means) / 2)
            num_compared += 1

    # Two agents, their lead and the change by removal at two shifts, and the change over the mixture.
    assert num_compared == len(METRICS) * (4 * 2 + 1)


@pytest.mark.slow
def test_interrupted_mixtures_keep_finished_outcomes(make_bench, drawn_run, tmp_path, monkeypatch):
    run = {"run": str(drawn_run.config.run_dir)}
    settings = {"agents": {"main": run, "anonymous": run}, "shifts": (0.0, 1.0), "removals": (), "episodes": 4}
    calls = []
    run_trials = TrialRunner.run_trials

    def interrupt_second_call(runner, *arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return run_trials(runner, *arguments)

    def measure(folder):
        bench = make_bench(**settings)
        bench.unfinished_folder = folder
        rows = measure_removals(bench, bench.find_run("rooms", "main"), "argmax", "layout-blind", ())
        return [row.to_json() for row in rows]

    # The trials of the agent are interrupted after those of the layout-blind agents.
    expected_rows = measure(None)
    monkeypatch.setattr(TrialRunner, "run_trials", interrupt_second_call)
    with pytest.raises(KeyboardInterrupt):
        measure(tmp_path)

    # The second measurement does not run the layout-blind agents again, and the third runs nothing.
    assert measure(tmp_path) == expected_rows
    assert len(calls) == 3
    assert measure(tmp_path) == expected_rows
    assert len(calls) == 3

    # Damaged outcomes are measured again.
    cut_path, changed_path = tmp_path.iterdir()
    cut_path.write_bytes(cut_path.read_bytes()[:50])
    content = bytearray(changed_path.read_bytes())
    content[80:120] = bytes(40)  # compressed data
    changed_path.write_bytes(content)
    assert measure(tmp_path) == expected_rows
    assert len(calls) == 5


@pytest.mark.exhaustive
def test_cde_leaves_the_network_without_experience(make_bench, drawn_run, tmp_path_factory):
    config = drawn_run.config
    dropping_config = dataclasses.replace(
        config,
        run_dir=tmp_path_factory.mktemp("dropping") / "run",
        counterfactual_memory="own",
        ppo=dataclasses.replace(config.ppo, experience=0.8),
    )
    run = {"run": str(draw_run(dropping_config).config.run_dir)}
    bench = make_bench(agents={"main": run, "anonymous": run}, shifts=(0.0, 1.0), episodes=8)
    table = ResultTable(measure_removals(bench, bench.find_run("rooms", "main"), "argmax", "without experience", ()))
    row_fields = {"world": "rooms", "run": "main, without experience", "decoding": "argmax"}
    removals = table.distinct("variant", row_fields, reference=WITHOUT_REMOVAL)
    assert removals[:2] == ["CDE", ORACLE_NAME]
    for shift in (0.0, 1.0):
        assert table.find(row_fields, variant="CDE", shift=shift, metric="weight").mean == 1.0

    # The changes equal those of an evaluation of the run.
    results = evaluate(run["run"], episodes=8, epsilon=0.5, removal="cde", shift=0.0)
    metrics = results.metrics()
    row_indices = {(row.variant, row.decoding): index for index, row in enumerate(results.rows)}
    for metric in ("sr", "spl"):
        change = table.find(row_fields, variant="CDE", reference=WITHOUT_REMOVAL, shift=0.0, metric=metric)
        cde_mean = metrics[metric][row_indices["cde", "argmax"]].mean()
        layout_mean = metrics[metric][row_indices["layout", "argmax"]].mean()
        assert change.mean == pytest.approx(100 * (cde_mean - layout_mean), abs=1e-6)

    # A mixture with the counterfactual memory of the run also has removal with the factual memory.
    table = ResultTable(measure_removals(bench, bench.find_run("rooms", "main"), "argmax", "own", ()))
    assert "TDE, factual memory" in table.distinct("variant", reference=WITHOUT_REMOVAL)


@pytest.mark.parametrize("remaining", ["own", "layout-blind", "without experience"])
@pytest.mark.parametrize("changes", [{"seeds": 3}, {"world": "houses"}, {"worlds": {"num_val": 5}}])
def test_mixtures_refuse_runs_that_differ_before_any_training(make_bench, drawn_run, remaining, changes):
    bench = make_bench(agents={"main": {}, "anonymous": changes}, base=drawn_run.config, shifts=(0.0, 1.0))
    run = bench.find_run("rooms", "main")
    with pytest.raises(InputError, match=f"differ in {next(iter(changes))}"):
        next(measure_removals(bench, run, "sample", remaining))
    assert not run.config.run_dir.exists()
