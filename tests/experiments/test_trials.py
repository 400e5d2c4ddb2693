"""Trials: their cells of the evaluation grid, their rows of results, and the measurements that run them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.episodes import episodes_in
from support.intervals import bounds, student_interval

from jaxnav.errors import InputError
from jaxnav.evaluation.grid import EpisodeOutcome
from jaxnav.evaluation.removal import GapSource, RemovedLogits
from jaxnav.evaluation.replacements import ReplacedPart
from jaxnav.evaluation.statistics import Interval
from jaxnav.evaluation.variants import inference_grid, table_rows
from jaxnav.experiments.bench import best_epsilon
from jaxnav.experiments.config import part_settings
from jaxnav.experiments.table import ResultRow, ResultTable, write_part
from jaxnav.experiments.trials import (
    NEVER,
    EvaluatedRun,
    GapSchedule,
    Trial,
    TrialControl,
    TrialOutcomes,
    TrialRunner,
    mean_removal_weight,
    measure_growth,
    measure_trials,
    measure_variants,
    prepare_run,
    require_estimator_config,
    sum_by_scene,
    trial_grid,
)

ARMS = ("baseline", "layout")
NUM_SEEDS = 2
#: Fields of the measured agent in a result table.
MAIN_FIELDS = {"world": "rooms", "run": "main", "shift": 0.0}
#: sTDE at the paper's threshold, and without a threshold in the paper's form.
PAPER_STDE = {"variant": "stde", "epsilon": 0.5, "form": "residual"}
ZERO_STDE = {"variant": "stde", "epsilon": 0.0, "form": "paper"}


# Cells of the grid


def select_cells(grid, index: int):
    """Cells of one row or trial of a grid."""
    return jax.tree.map(lambda leaf: leaf[NUM_SEEDS * index : NUM_SEEDS * (index + 1)], grid)


@pytest.mark.parametrize("epsilon", [float("nan"), -0.1, float("inf"), float("-inf")])
def test_table_rows_refuse_impossible_epsilons(epsilon):
    with pytest.raises(InputError, match="--epsilon"):
        table_rows([0.5, epsilon], ["paper"], ARMS)


def test_inference_grid_holds_a_cell_per_row_and_seed():
    rows = table_rows([0.0, 0.2, 1.0], ["residual", "paper"], ARMS)
    grid = inference_grid(rows, ARMS, NUM_SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(rows) * NUM_SEEDS,)}
    for index, row in enumerate(rows):
        cells = select_cells(grid, index)

        # Baseline and Random use the first two sets of parameters, and all further rows use the last two.
        is_plain = row.variant in ("baseline", "random")
        np.testing.assert_array_equal(cells.policy_index, [0, 1] if is_plain else [2, 3])
        np.testing.assert_array_equal(cells.use_layout, [not is_plain] * 2)
        np.testing.assert_array_equal(cells.greedy, [row.decoding == "argmax"] * 2)
        np.testing.assert_array_equal(cells.act_randomly, [row.variant == "random"] * 2)
        np.testing.assert_array_equal(cells.remove_completely, [row.variant == "tde"] * 2)
        epsilon = np.inf if row.epsilon is None else row.epsilon
        np.testing.assert_array_equal(cells.epsilon, np.full(2, epsilon, np.float32))


def test_controls_change_the_cells_of_stde_and_nothing_else():
    plain_cells = Trial("stde", "sample", 0.5, "residual").grid_entries(ARMS, NUM_SEEDS)
    # Every control and every schedule changes few fields of the cells.
    given_gap = {"gap_source": GapSource.GIVEN, "given_gap": 1.0}
    changed_fields: dict[TrialControl | GapSchedule, dict[str, Any]] = {
        "shuffled": {"gap_source": GapSource.OTHER},
        "course": {"gap_source": GapSource.MEAN},
        "constant": given_gap | {"given_gap": np.float32(0.3), "gap_end": NEVER, "epsilon": np.float32(0.0)},
        "after": given_gap | {"gap_begin": 7, "gap_end": NEVER},
        "until": given_gap | {"gap_end": 7},
        "zeros": {"removed_source": RemovedLogits.ZEROS},
        "noise": {"removed_source": RemovedLogits.NOISE},
        "random": {"direct_noise": 1.0},
        "other_categories": {"replaced_part": ReplacedPart.OTHER_CATEGORIES, "replaces_factual": False},
        "other_experience": {"replaced_part": ReplacedPart.EXPERIENCE, "replaces_factual": False},
        "other_memory": {"replaced_part": ReplacedPart.MEMORY, "replaces_factual": False},
    }
    assert set(changed_fields) == {*get_args(TrialControl), *get_args(GapSchedule)}

    # All further fields equal those of sTDE without a control.
    for control, changes in changed_fields.items():
        cells = Trial("stde", "sample", 0.5, "residual", control, 7, 0.3).grid_entries(ARMS, NUM_SEEDS)
        chex.assert_trees_all_equal_shapes_and_dtypes(cells, plain_cells)
        for name in vars(plain_cells):
            expected_values = np.broadcast_to(changes.get(name, getattr(plain_cells, name)), (NUM_SEEDS,))
            np.testing.assert_array_equal(getattr(cells, name), expected_values, err_msg=f"{control}: {name}")


def test_trial_grid_has_the_seeds_of_each_trial_in_turn():
    trials = [Trial("baseline", "sample"), Trial("stde", "argmax", 0.2, "paper", "noise"), Trial("tde", "argmax")]
    grid = trial_grid(trials, ARMS, NUM_SEEDS)
    assert {leaf.shape for leaf in jax.tree.leaves(grid)} == {(len(trials) * NUM_SEEDS,)}
    for index, trial in enumerate(trials):
        chex.assert_trees_all_equal(select_cells(grid, index), trial.grid_entries(ARMS, NUM_SEEDS))


# Rows of results

BASELINE = Trial("baseline", "sample")
LAYOUT = Trial("layout", "sample")
STDE = Trial("stde", "sample", 0.5, "residual")
BEST_LAYOUT = Trial("layout", "argmax")
#: Outcomes of two runs in four episodes; L* = 2, so that success after 4 actions has SPL 0.5.
SUCCESS: Mapping[Trial, Sequence[Sequence[int]]] = {
    BASELINE: [[0, 0, 1, 1], [0, 1, 0, 1]],  # 50 %
    LAYOUT: [[1, 0, 1, 1], [1, 1, 1, 1]],  # 75 % and 100 %
    STDE: [[1, 1, 1, 1], [1, 1, 1, 0]],  # 100 % and 75 %
    BEST_LAYOUT: [[0, 0, 0, 0], [0, 0, 0, 1]],  # 0 % and 25 %
}
LENGTH = np.array([[2, 4, 4, 10], [2, 4, 4, 10]])
WEIGHT = np.array([[0.5, 0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 0.0]], np.float32)
FOUR_EPISODES = episodes_in([0, 1, 2, 3], best_length=2)


def make_outcome(success, length=LENGTH, weight=WEIGHT) -> EpisodeOutcome:
    """Outcomes [S, E] that end 2.5 m from the goal."""
    shape = np.shape(length)
    return EpisodeOutcome(
        done=jnp.ones(shape, bool),
        success=jnp.asarray(success, bool),
        length=jnp.asarray(length),
        moves=jnp.ones(shape, jnp.int32),
        distance=jnp.full(shape, 2.5),
        num_decisions=jnp.asarray(length),
        total_weight=jnp.asarray(weight * length, jnp.float32),
    )


def make_table(success_by_trial, gap: str = "") -> ResultTable:
    """Rows of trials in the four episodes."""
    outcomes = {trial: make_outcome(success) for trial, success in success_by_trial.items()}
    return ResultTable(TrialOutcomes(outcomes, FOUR_EPISODES).trial_rows(MAIN_FIELDS, gap))


def test_mean_removal_weight_is_over_decisions():
    outcome = make_outcome(SUCCESS[STDE])
    # Weights of 0.5 in 2 decisions and of 0.1 in 10, of 2 x 20 in all: (1 + 1) / 40. The mean over episodes is 0.6 / 8.
    assert mean_removal_weight(outcome) == pytest.approx(0.05)
    assert mean_removal_weight(EpisodeOutcome.zeros((2, 4))) == 0.0


def test_trial_rows_have_metrics_and_weights():
    layout_fields = MAIN_FIELDS | LAYOUT.row_fields()
    table = make_table(SUCCESS)
    assert table.find(layout_fields, metric="sr").mean == 87.5
    assert table.find(layout_fields, metric="sr").seeds == (75.0, 100.0)

    # The SPL of a success is 2 / length: (1 + 1/2 + 1/5) / 4 and (1 + 1/2 + 1/2 + 1/5) / 4.
    assert table.find(layout_fields, metric="spl").seeds == pytest.approx((42.5, 55.0))

    # DTS is 2.5 m less the success distance of 1 m.
    assert table.find(layout_fields, metric="dts").mean == 1.5
    assert table.find(layout_fields, metric="weight").mean == pytest.approx(0.05)
    assert table.num_scenes(layout_fields) == 4


def test_trial_rows_compare_layout_with_baseline_and_further_trials_with_layout():
    table = make_table(SUCCESS)

    # The networks differ: the deviation is that of both arms, 0 and 25 / sqrt(2), and gains by run are undefined.
    layout_gain = table.find(MAIN_FIELDS | LAYOUT.row_fields(), reference="baseline", metric="sr")
    assert layout_gain.mean == 37.5
    assert layout_gain.std == pytest.approx(25 / 2**0.5)
    assert layout_gain.seeds == ()

    # The networks are equal, so gains by run are defined: +25 and -25 points.
    stde_table = make_table(SUCCESS, gap="evidence")
    stde_gain = stde_table.find(MAIN_FIELDS | STDE.row_fields(), gap="evidence", reference="layout", metric="sr")
    assert stde_gain.mean == 0.0
    assert stde_gain.seeds == pytest.approx((25.0, -25.0))

    # sTDE less + w is 0, 100, 0, 0 points in the first run and 0, 0, 0, -100 in the second. The variance by run is
    # 1250 / 2 = 625; by scene, with means of 0, 50, 0 and -50, 5000 / 3 / 4 = 417; by residual, which is 25 or -25 in
    # all eight, 8 x 625 / 3 / 8 = 208. The total of 417 + 625 - 208 = 833 has
    # 833^2 / (417^2 / 3 + 625^2 / 1 + 208^2 / 3) = 1.50 degrees of freedom.
    components = np.array([5000 / 12, 625, 5000 / 24])
    variance = components[0] + components[1] - components[2]
    degrees = variance**2 / (components**2 / [3, 1, 3]).sum()
    assert bounds(stde_gain) == pytest.approx(student_interval(0, variance, degrees))

    # Only outcomes of equal decoding are compared, and the baseline is not compared.
    assert not table.where(MAIN_FIELDS | BEST_LAYOUT.row_fields(), reference="baseline").rows
    assert not table.where(variant="baseline", reference="layout").rows


def test_trial_rows_of_a_gap_are_those_of_stde():
    assert set(make_table(SUCCESS).distinct("variant")) == {"baseline", "layout"}
    table = make_table(SUCCESS, gap="clock")
    assert table.distinct("variant") == ["stde"]
    assert table.distinct("gap") == ["clock"]


def test_equal_outcomes_have_equal_intervals_and_no_difference():
    success = {LAYOUT: SUCCESS[LAYOUT], STDE: SUCCESS[LAYOUT]}
    layout_sr = make_table(success).find(MAIN_FIELDS | LAYOUT.row_fields(), metric="sr")
    table = make_table(success, gap="novelty")
    assert layout_sr.has_bounds
    assert table.find(MAIN_FIELDS | STDE.row_fields(), gap="novelty", metric="sr") == layout_sr
    difference = table.find(MAIN_FIELDS | STDE.row_fields(), gap="novelty", reference="layout", metric="sr")
    assert difference == Interval(0.0, 0.0, 0.0, 0.0, (0.0, 0.0))


def test_intervals_are_over_floor_plans_of_a_room_type():
    # Three of six episodes succeed. Apartments 00-0 and 00-1 have one floor plan: the SR by plan is 0, 100 and 50 %,
    # with a sample variance of 2500. The runs are equal, so only scenes contribute.
    names = ("val-apartment-00-0", "val-apartment-00-1", "val-apartment-01-0", "val-apartment-02-0")
    episodes = episodes_in([0, 1, 2, 2, 3, 3], names=names, best_length=2)
    length = np.full((2, 6), 2)
    outcome = make_outcome([[0, 0, 1, 1, 0, 1]] * 2, length, np.zeros((2, 6), np.float32))
    table = ResultTable(TrialOutcomes({LAYOUT: outcome}, episodes).trial_rows(MAIN_FIELDS, ""))
    interval = table.find(MAIN_FIELDS | LAYOUT.row_fields(), metric="sr")
    assert bounds(interval) == pytest.approx(student_interval(50, 2500 / 3, 2))


def test_sum_by_scene_leaves_out_scenes_without_episodes():
    sums = sum_by_scene(np.array([[1.0, 2.0, 4.0], [0.0, 8.0, 0.0]]), episodes_in([2, 0, 2], room=[0, 0, 0]))
    # Scene 0 has the second episode, and scene 2 has the first and the third.
    np.testing.assert_array_equal(sums.values, [[2.0, 5.0], [8.0, 0.0]])
    np.testing.assert_array_equal(sums.counts, [1, 2])


# Measurements


@pytest.mark.slow
def test_variants_are_those_of_an_evaluation(make_bench, evaluated):
    bench = make_bench()
    table = ResultTable(measure_variants(bench, bench.find_run("rooms", "main"), 0.0))
    rows_by_variant = {}
    for row in evaluated.report["rows"]:
        if row["decoding"] == "argmax":
            rows_by_variant[row["variant"]] = row
    for variant, fields in {"baseline": {}, "layout": {}, "tde": {}, "stde": PAPER_STDE | {"gap": "novelty"}}.items():
        for metric in ("sr", "spl", "dts"):
            score = table.find(MAIN_FIELDS, {"variant": variant, "decoding": "argmax"} | fields, metric=metric)
            expected_score = Interval.from_json(rows_by_variant[variant][metric])
            assert bounds(score) == pytest.approx(bounds(expected_score), nan_ok=True)

    # TDE removes all experience at every choice.
    assert table.find(MAIN_FIELDS, variant="tde", decoding="argmax", metric="weight").mean == 1.0
    assert table.find(MAIN_FIELDS, ZERO_STDE, gap="novelty", decoding="argmax", metric="weight").mean > 0.0


def test_growth_is_the_change_of_the_gain_between_the_shifts(make_bench, monkeypatch):
    # Of six episodes in each scene, sTDE succeeds in one at the first shift and in five at the last; + w always fails.
    num_successes_by_shift = iter([1, 5])

    def run_trials(runner, evaluated_run: EvaluatedRun, estimator, trials: Sequence[Trial]):
        num_successes = next(num_successes_by_shift)
        scene = evaluated_run.episodes.scene
        shape = (2, len(scene))
        episode_in_scene = np.array([np.sum(scene[:index] == scene[index]) for index in range(len(scene))])
        outcomes = {}
        for trial in trials:
            success = (episode_in_scene < num_successes) & (trial.variant == "stde")
            success_by_run = np.broadcast_to(success, shape)
            outcomes[trial] = make_outcome(success_by_run, np.ones(shape, int), np.zeros(shape, np.float32))
        return outcomes

    monkeypatch.setattr(TrialRunner, "run_trials", run_trials)
    bench = make_bench(shifts=(0.0, 0.5, 1.0))
    (growth,) = measure_growth(bench, bench.find_run("rooms", "main"))
    assert (growth.metric, growth.variant, growth.reference) == ("sr growth", "stde", "layout")

    # SR rises from 1 / 6 to 5 / 6 in all scenes and runs.
    assert isinstance(growth.value, Interval)
    assert bounds(growth.value) == pytest.approx((400 / 6,) * 3)
    assert growth.scenes == 4


@pytest.mark.exhaustive
def test_trials_vary_gap_threshold_and_controls(make_bench):
    bench = make_bench(epsilon=(0.0, 1.0))
    table = ResultTable(measure_trials(bench, bench.find_run("rooms", "main"), 0.0))
    argmax_fields = MAIN_FIELDS | {"decoding": "argmax"}
    assert set(table.distinct("gap", variant="stde", metric="sr")) == {"novelty", "evidence", "clock"}
    assert {len(table.where(variant=variant, metric="dts").rows) for variant in ("baseline", "layout", "tde")} == {2}

    # The sweep has the given thresholds and those of the paper. For epsilon >= 1 no experience is removed.
    for form in ("residual", "paper"):
        sweep = {"variant": "stde", "form": form, "gap": "novelty", "control": "", "metric": "sr", "reference": ""}
        assert sorted(table.distinct("epsilon", argmax_fields, sweep)) == [0.0, 0.5, 1.0]
    layout_sr = table.find(argmax_fields, variant="layout", metric="sr")
    no_removal = argmax_fields | {"variant": "stde", "epsilon": 1.0, "form": "residual", "gap": "novelty"}
    assert table.find(no_removal, metric="sr") == layout_sr
    assert table.find(no_removal, metric="weight").mean == 0.0

    # The constant control removes as much as sTDE does on average.
    for gap in ("novelty", "evidence"):
        gap_fields = argmax_fields | ZERO_STDE | {"gap": gap}
        assert set(table.distinct("control", gap_fields)) == {"", "shuffled", "noise", "random", "constant"}
        weight = table.find(gap_fields, metric="weight").mean
        assert table.find(gap_fields, control="constant", metric="weight").mean == pytest.approx(weight, 1e-5)
        assert weight > 0.0

        # The control with zeros changes no best action, so its actions are sampled.
        assert table.has(MAIN_FIELDS, PAPER_STDE, gap=gap, decoding="sample", control="zeros", metric="sr")

    # The rows include the relation of success to similarity, and the size of the policies.
    assert table.has(MAIN_FIELDS, variant="baseline", metric="sr by similarity, pearson")
    assert table.find(MAIN_FIELDS, metric="parameters").mean > 1000


@pytest.mark.slow
def test_runs_without_a_baseline_arm_have_only_the_variants_of_the_layout(make_bench, drawn_run):
    bench = make_bench()
    run = bench.find_run("rooms", "main")
    layout_run = run._replace(config=dataclasses.replace(drawn_run.config, arms=("layout",)))
    policies = prepare_run(bench, layout_run, 0.0).policies
    # Both arms have the parameters of the layout arm, so its policies draw the random numbers of a run with two arms.
    all_policies = prepare_run(bench, run, 0.0).policies
    chex.assert_trees_all_equal(policies.arm_params("layout"), all_policies.arm_params("layout"))
    chex.assert_trees_all_equal(policies.arm_params("baseline"), all_policies.arm_params("layout"))
    assert policies.arms == all_policies.arms


def test_trials_need_policies_with_the_layout(drawn_run):
    with pytest.raises(InputError, match="layout"):
        require_estimator_config(drawn_run.policies(("baseline",))._replace(estimator_config=None))


# Selection of the threshold on `val`


def make_success_row(success: float, epsilon: float = 0.5, **fields: Any) -> ResultRow:
    """SR of plain sTDE at a threshold, with further fields changed."""
    row = ResultRow(
        world="rooms",
        run="main",
        variant="stde",
        decoding="argmax",
        shift=0.0,
        gap="novelty",
        epsilon=epsilon,
        form="residual",
        metric="sr",
        value=Interval(success),
    )
    return dataclasses.replace(row, **fields)


def test_best_epsilon_has_the_greatest_success_of_plain_stde():
    # Of equal successes the first counts. Rows of further gaps, forms, controls, shifts, actions and differences, which
    # have a greater success, do not count.
    ignored_changes = [
        *({"gap": "clock"}, {"form": "paper"}, {"control": "noise"}, {"shift": 1.0}, {"decoding": "sample"}),
        *({"reference": "layout"}, {"metric": "spl"}, {"run": "other"}, {"category": "Book"}),
    ]
    rows = [make_success_row(60, 0.2), make_success_row(70, 0.4), make_success_row(70, 0.6)]
    rows += [make_success_row(90, 0.9, **changes) for changes in ignored_changes]
    assert best_epsilon(ResultTable(rows), "rooms", "main", 0.0) == 0.4
    assert best_epsilon(ResultTable([]), "rooms", "main", 0.0) is None


def test_trials_on_test_need_the_threshold_of_val(make_bench, drawn_run):
    # Without a threshold, the run is not trained.
    bench = make_bench(split="test", agents={"main": {}}, base=drawn_run.config)
    run = bench.find_run("rooms", "main")
    with pytest.raises(InputError, match="--split val"):
        next(measure_trials(bench, run, 0.0))
    assert not run.config.run_dir.exists()

    # The threshold is read from trials of the run on `val` with the settings of the experiment.
    settings = part_settings(dataclasses.replace(bench.config, split="val"), run, [])
    val_folder = bench.config.results / "val"
    write_part(val_folder / "rooms-main-trials-0.jsonl", settings, [make_success_row(50, 0.3)])
    write_part(val_folder / "rooms-other-trials-0.jsonl", settings, [make_success_row(50, 0.7)])
    assert bench.chosen_epsilon(run) == 0.3

    # Trials with another seed do not count.
    other_settings = settings | {"seed": settings["seed"] + 1}
    write_part(val_folder / "rooms-main-trials-0.jsonl", other_settings, [make_success_row(50, 0.5)])
    with pytest.raises(InputError, match="with these settings"):
        bench.chosen_epsilon(run)
