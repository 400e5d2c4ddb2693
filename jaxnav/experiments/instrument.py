"""The layout shift as an instrument: which properties of scenes and agents it changes.

A valid shift leaves the difficulty of the scenes unchanged, costs agents that rely on the training layout, and costs
nothing to layout-blind agents. `measure_scenes` measures a world at one shift, scene by scene;
`compare_shifts` turns the measures of several shifts into rows of results, and `judge_shift` judges these by criteria.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnav.baselines.difficulty import expected_length, random_success
from jaxnav.baselines.frontier import run_frontier_search
from jaxnav.env.objectnav import prior_index
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import episode_metrics
from jaxnav.evaluation.similarity import cooccurrence_counts, scene_layout_gap, scene_layout_similarity
from jaxnav.evaluation.statistics import Interval, SharedDesign, divide_or_nan
from jaxnav.evaluation.variants import table_row
from jaxnav.experiments.bench import Bench
from jaxnav.experiments.config import AgentRun
from jaxnav.experiments.scores import require_layout_blind_run
from jaxnav.experiments.table import ResultRow, ResultTable
from jaxnav.runs.evaluate import evaluate_rows
from jaxnav.runs.policies import Policies, load_policies
from jaxnav.runs.worlds import CompiledWorld
from jaxnav.scenes.scene import Scene
from jaxnav.scenes.tables.compile import Bank, categories_in_view
from jaxnav.scenes.tables.observation_row import RowFormat

#: Measures of difficulty, which the shift must not change.
DIFFICULTY_MEASURES = ("best_length", "random_sr", "frontier_sr", "start_distance")
#: Measures that may differ between categories, but that the shift must not change in any of them.
CATEGORY_MEASURES = ("goal_detected", "done_succeeds")
#: Measures of the layout: scenes with co-occurrence weigh alike. All other measures weigh scenes by their episodes.
LAYOUT_MEASURES = ("layout_gap", "layout_similarity")
BASELINE_MEASURES = ("baseline_argmax_sr", "baseline_sample_sr")
#: Measures of layout-blind agents, which a shift cannot mislead.
LAYOUT_BLIND_MEASURES = (
    "layout_blind_argmax_sr",
    "layout_blind_sample_sr",
    "layout_blind_argmax_wrong",
    "layout_blind_sample_wrong",
)
#: Largest change of difficulty, in %, and largest mean change over categories, in points.
MAX_CHANGE = 5.0
#: Least loss of agents that rely on the layout, in points.
MIN_LOSS = 8.0
#: Largest loss of layout-blind agents, in points.
MAX_LAYOUT_BLIND_LOSS = 2.0


def measure_instrument(bench: Bench, run: AgentRun) -> Iterator[ResultRow]:
    """Measure the baseline of a run at every shift and compare the shifts, with layout-blind agents if there are any.

    Raises:
      InputError: the run has no arm `baseline`, or see `require_layout_blind_run`.
    """
    if "baseline" not in run.config.arms:
        raise InputError(f"{run.config.run_dir}: has no arm `baseline`, which `instrument` measures; give another run")
    bench.train(run)
    policies = load_policies(run.config, ("baseline",))
    layout_blind_policies = None
    if bench.layout_blind_run(run.world) is not None:
        layout_blind_run = require_layout_blind_run(bench, run)
        bench.train(layout_blind_run)
        layout_blind_policies = load_policies(layout_blind_run.config, ("baseline",))

    shifts = bench.config.shifts
    totals_by_shift = []
    for shift in shifts:
        compiled_world = bench.compile_world(run, shift)
        episodes = bench.config.episodes
        totals_by_shift.append(
            measure_scenes(compiled_world, policies, layout_blind_policies, episodes, bench.config.seed)
        )
    yield from compare_shifts({"world": run.world, "run": run.agent}, shifts, totals_by_shift)


# Measures of one shift


class SceneTotals(NamedTuple):
    """Measures of N scenes at one shift.

    Attributes:
      values: float64 [S, N], sums over the episodes of each scene by seed, or, for `LAYOUT_MEASURES`, one value of each
        scene; S = 1 for measures without training.
      weights: float64 [N], number of episodes of each scene, or 1 for `LAYOUT_MEASURES`; 0 for scenes that the measure
        leaves out. A mean is the sum of values / the sum of weights.
      categories: float64 [N, K], means by goal category; NaN for categories that do not occur.
      rooms: [N], room types.
      names: [N], names of the scenes.
    """

    values: Mapping[str, np.ndarray]
    weights: Mapping[str, np.ndarray]
    categories: Mapping[str, np.ndarray]
    rooms: tuple[str, ...]
    names: tuple[str, ...]


def measure_scenes(
    compiled_world: CompiledWorld,
    policies: Policies,
    layout_blind_policies: Policies | None,
    num_episodes: int,
    seed: int,
) -> SceneTotals:
    """Measure the scenes of a world at one shift.

    L* and Random are exact means over all episodes that could be drawn in a scene, not over the drawn ones.

    Args:
      compiled_world: the scenes.
      policies: policies with the baseline among their arms.
      layout_blind_policies: policies of layout-blind agents, with as many seeds.
      num_episodes: number of episodes in all scenes together.
      seed: seed of the episode lists and the sampled actions.
    """
    # Results of the baseline, bool [2, S, E]: with best actions, and with sampled ones.
    rows = [table_row("baseline", None, None, decoding) for decoding in ("argmax", "sample")]
    episode_lists, outcome, _ = evaluate_rows(rows, policies, compiled_world, num_episodes, seed)
    episodes = join_episode_lists(episode_lists)
    num_scenes = len(episodes.scenes)

    def sum_by_scene(values: np.ndarray) -> np.ndarray:
        """Sum values [S, E] over the episodes of each scene, [S, N]."""
        scene_sums = []
        for run_values in values:
            scene_sums.append(np.bincount(episodes.scene, run_values, num_scenes))
        return np.stack(scene_sums)

    # Measures without training, bank by bank. The scenes are read once, in order.
    priors = np.asarray(policies.knowledge.priors, np.float64)
    scenes_in_order = (compiled_world.scenes[index] for index in range(len(compiled_world.scenes)))
    bank_measures = []
    for bank, bank_episodes in zip(compiled_world.banks, episode_lists, strict=True):
        bank_measures.append(_measure_bank(bank, bank_episodes, compiled_world, priors, scenes_in_order))
    scenes = BankMeasures(*map(np.concatenate, zip(*bank_measures, strict=True)))

    # Exact means count as often as a scene has episodes, so that all measures are sums over episodes.
    episode_counts = np.bincount(episodes.scene, minlength=num_scenes).astype(np.float64)
    baseline_argmax, baseline_sample = 100.0 * np.asarray(outcome.success, np.float64)

    # Done can only be judged where a goal is detected; a scene without any such goal does not count.
    num_judged_goals = (~np.isnan(scenes.succeeds)).sum(axis=1)
    done_succeeds = np.nansum(scenes.succeeds, axis=1) / np.maximum(num_judged_goals, 1)
    judged_counts = episode_counts * (num_judged_goals > 0)
    values: dict[str, np.ndarray] = {
        "best_length": episode_counts * scenes.best_length[None],
        "random_sr": episode_counts * 100.0 * scenes.random_success[None],
        "frontier_sr": sum_by_scene(100.0 * scenes.success[None]),
        "frontier_steps": sum_by_scene(scenes.actions[None].astype(np.float64)),
        "start_distance": episode_counts * np.nanmean(scenes.distance, axis=1)[None],
        "goal_detected": episode_counts * 100.0 * np.nanmean(scenes.detected, axis=1)[None],
        "done_succeeds": judged_counts * 100.0 * done_succeeds[None],
        "layout_gap": np.nan_to_num(scenes.gap)[None],
        "layout_similarity": np.nan_to_num(scenes.similarity)[None],
        "baseline_argmax_sr": sum_by_scene(baseline_argmax),
        "baseline_sample_sr": sum_by_scene(baseline_sample),
    }

    # Layout-blind agents meet the same episodes.
    if layout_blind_policies is not None:
        _, layout_blind_outcome, _ = evaluate_rows(rows, layout_blind_policies, compiled_world, num_episodes, seed)
        layout_blind_metrics = episode_metrics(layout_blind_outcome, episodes.best_length)
        argmax_success, sample_success = 100.0 * layout_blind_metrics["sr"]
        argmax_wrong, sample_wrong = 100.0 * layout_blind_metrics["wrong_done"]
        values["layout_blind_argmax_sr"] = sum_by_scene(argmax_success)
        values["layout_blind_sample_sr"] = sum_by_scene(sample_success)
        values["layout_blind_argmax_wrong"] = sum_by_scene(argmax_wrong)
        values["layout_blind_sample_wrong"] = sum_by_scene(sample_wrong)

    # Weights of the scenes in the mean of every measure.
    has_cooccurrence = (~np.isnan(scenes.gap)).astype(np.float64)
    weights = dict.fromkeys(values, episode_counts) | {"done_succeeds": judged_counts}
    weights |= dict.fromkeys(LAYOUT_MEASURES, has_cooccurrence)

    # Room types in the order of the scenes, bank by bank.
    room_types: list[str] = []
    for bank in compiled_world.banks:
        room_types.extend(bank.room_types)

    return SceneTotals(
        values=values,
        weights=weights,
        categories={"goal_detected": 100.0 * scenes.detected, "done_succeeds": 100.0 * scenes.succeeds},
        rooms=tuple(room_types),
        names=episodes.scenes,
    )


class BankMeasures(NamedTuple):
    """Measures of one bank that need no policies.

    Attributes:
      best_length, random_success: float64 [N], means over all episodes that could be drawn in a scene.
      success, actions: bool and int [E], of the frontier search.
      gap, similarity: float64 [N], between layout and prior; NaN for a scene without co-occurrence.
      detected, succeeds, distance: float64 [N, K], see `DetectionShares`.
    """

    best_length: np.ndarray
    random_success: np.ndarray
    success: np.ndarray
    actions: np.ndarray
    gap: np.ndarray
    similarity: np.ndarray
    detected: np.ndarray
    succeeds: np.ndarray
    distance: np.ndarray


def _measure_bank(
    bank: Bank, episodes: EpisodeList, compiled_world: CompiledWorld, priors: np.ndarray, scenes: Iterator[Scene]
) -> BankMeasures:
    # The frontier search plays the drawn episodes within the step limits of their scenes.
    step_limits = compiled_world.scene_step_limits(bank)
    frontier = run_frontier_search(bank, episodes, step_limits)

    # Every scene is compared with the prior of its own room type, both [N, K, K].
    counts = cooccurrence_counts(bank)
    prior = priors[list(map(prior_index, bank.room_types))]
    detection = measure_detection(bank, scenes)
    return BankMeasures(
        best_length=expected_length(bank),
        random_success=random_success(bank, step_limits),
        success=np.asarray(frontier.success),
        actions=np.asarray(frontier.length),
        gap=scene_layout_gap(counts, prior),
        similarity=scene_layout_similarity(counts, prior),
        detected=detection.detected,
        succeeds=detection.succeeds,
        distance=detection.distance,
    )


class DetectionShares(NamedTuple):
    """Detection by scene and goal category.

    All are float64 [N, K], NaN for categories that are no goal of a scene.

    Attributes:
      detected: share of the poses with the goal in view (see `in_view`) that detect it.
      succeeds: share of the detecting poses where Done would succeed; NaN for a goal that is never detected.
      distance: mean distance of the cells to the nearest goal object, metres; see `Bank.goal_distance`.
    """

    detected: np.ndarray
    succeeds: np.ndarray
    distance: np.ndarray


def measure_detection(bank: Bank, scenes: Iterator[Scene]) -> DetectionShares:
    """Measure the detection of goals over all poses.

    Args:
      bank: N scenes.
      scenes: the scenes that the bank was compiled from, in order; scenes that the bank left out are skipped.
    """
    poses_per_cell = bank.task.rules.poses_per_cell
    row_format = RowFormat(len(bank.task.categories))
    share_shape = (len(bank.names), len(bank.task.categories))
    shares = DetectionShares(np.full(share_shape, np.nan), np.full(share_shape, np.nan), np.full(share_shape, np.nan))

    for index, name in enumerate(bank.names):
        # Cells and poses of the scene are slices of the bank.
        scene = _find_scene(scenes, name)
        first_cell = bank.first_cell[index]
        cell_slice = slice(first_cell, first_cell + bank.num_cells[index])
        pose_slice = slice(cell_slice.start * poses_per_cell, cell_slice.stop * poses_per_cell)
        goals = bank.goals[index, : bank.num_goals[index]]

        # Poses [P, goals]; detections without the goal in view are false alarms and do not count.
        in_view = categories_in_view(scene, bank.task)[:, goals]
        detected = in_view & row_format.presence(bank.rows[pose_slice])[:, goals]
        succeeds = detected & (bank.best_length[pose_slice][:, goals] == 1)
        shares.detected[index, goals] = divide_or_nan(detected.sum(axis=0), in_view.sum(axis=0))
        shares.succeeds[index, goals] = divide_or_nan(succeeds.sum(axis=0), detected.sum(axis=0))

        # Cells [C, goals]; cells without a path to the goal have an infinite distance and do not count.
        goal_distance = bank.goal_distance[cell_slice][:, goals]
        is_finite = np.isfinite(goal_distance)
        shares.distance[index, goals] = np.where(is_finite, goal_distance, 0.0).sum(axis=0) / is_finite.sum(axis=0)
    return shares


def _find_scene(scenes: Iterator[Scene], name: str) -> Scene:
    """Read on to the scene with a name."""
    return next(scene for scene in scenes if scene.name == name)


# Comparison of shifts


def compare_shifts(
    fields: Mapping[str, Any], shifts: Sequence[float], totals: Sequence[SceneTotals]
) -> Iterator[ResultRow]:
    """Make the rows of every measure at each shift, and of its change from the first shift.

    Rows with the reference `first shift` hold changes: of difficulty in percent, of the measures by category (metric
    `MEASURE by category`) the mean absolute change in points, and of success the loss in points.

    Args:
      fields: fields of all rows.
      shifts: layout shifts, rising.
      totals: measures at each shift; all share training runs, and floor plans by name.

    Raises:
      InputError: a measure of difficulty is 0 at the first shift.
    """
    # Scenes are left out of all shifts at once, so that their difficulty cancels in the differences.
    num_seeds = len(totals[0].values[BASELINE_MEASURES[0]])
    conditions = [(total.names, total.rooms) for total in totals]
    design = SharedDesign.from_conditions(conditions, num_seeds)

    for measure in totals[0].values:
        # Leave-one-out means at every shift.
        means = []
        for shift, total in zip(shifts, totals, strict=True):
            is_trained = measure in BASELINE_MEASURES + LAYOUT_BLIND_MEASURES
            values = total.values[measure]
            mean = design.jackknife_means(values, total.weights[measure], total.names, trained=is_trained)
            means.append(mean)
            row_fields = {**fields, "shift": shift, "scenes": len(total.names)}
            yield ResultRow(**row_fields, metric=measure, value=design.interval(mean))

        # Changes of difficulty at every further shift, and the loss of agents from the first shift to the last.
        changes: dict[float, np.ndarray] = {}
        if measure in DIFFICULTY_MEASURES:
            changes = _percent_changes(measure, shifts, means)
        elif measure in BASELINE_MEASURES + LAYOUT_BLIND_MEASURES:
            sign = -1.0 if measure.endswith("wrong") else 1.0  # more wrong Dones are a loss
            changes = {shifts[-1]: sign * (means[0] - means[-1])}
        for shift, change in changes.items():
            change_fields = {**fields, "shift": shift, "reference": "first shift"}
            yield ResultRow(**change_fields, metric=measure, value=design.interval(change))

    # Changes by category, and the number of episodes.
    for measure in CATEGORY_MEASURES:
        for shift, change in _category_changes(measure, shifts, totals, design).items():
            change_fields = {**fields, "shift": shift, "reference": "first shift"}
            yield ResultRow(**change_fields, metric=f"{measure} by category", value=change)
    for shift, total in zip(shifts, totals, strict=True):
        num_episodes = Interval(float(total.weights["frontier_sr"].sum()))
        yield ResultRow(**fields, shift=shift, metric="episodes", value=num_episodes, scenes=len(total.names))


def _percent_changes(measure: str, shifts: Sequence[float], means: Sequence[np.ndarray]) -> dict[float, np.ndarray]:
    """Compute the changes from the first shift in percent; the first entry of each array is the change itself."""
    first_mean = means[0]
    if not first_mean.flat[0]:
        raise InputError(f"{measure} is 0 at shift {shifts[0]:g}: nothing to compare with; give more --episodes")
    changes = {}
    for shift, shift_mean in zip(shifts[1:], means[1:], strict=True):
        changes[shift] = 100.0 * (shift_mean - first_mean) / first_mean
    return changes


def _category_changes(
    measure: str, shifts: Sequence[float], totals: Sequence[SceneTotals], design: SharedDesign
) -> dict[float, Interval]:
    """Compute the mean absolute change over the categories, from the first shift.

    A category weighs as many scenes as have it at the first shift. Categories of few scenes change by chance, so the
    mean is above 0 even without a real change.
    """
    # Leave-one-out means by category at each shift, and the scenes that weigh a category.
    means = [_category_means(total, measure, design) for total in totals]
    num_scenes = (~np.isnan(totals[0].categories[measure])).sum(axis=0)  # [K]
    changes = {}
    for shift, shift_mean in zip(shifts[1:], means[1:], strict=True):
        change_sizes = np.abs(shift_mean - means[0])  # [K, 1 + C]
        category_weights = num_scenes[:, None] * ~np.isnan(change_sizes)

        # A replicate that leaves out every scene of a category is NaN there, and skips the category.
        mean_size = np.nansum(category_weights * np.nan_to_num(change_sizes), axis=0) / category_weights.sum(axis=0)
        changes[shift] = design.interval(mean_size)
    return changes


def _category_means(total: SceneTotals, measure: str, design: SharedDesign) -> np.ndarray:
    """Compute the leave-one-out means of each category over its scenes, [K, 1 + C]."""
    category_means = []
    for scene_values in total.categories[measure].T:
        # Scenes without the category as a goal weigh 0; every other scene weighs 1.
        scene_weights = 1.0 - np.isnan(scene_values)
        category_means.append(
            design.jackknife_means(np.nan_to_num(scene_values)[None], scene_weights, total.names, trained=False)
        )
    return np.stack(category_means)


# Judgement


class Criterion(NamedTuple):
    """A criterion of a valid layout shift, judged by one measure.

    Attributes:
      name: name of the criterion.
      measure: name of the measure.
      changes: changes at the further shifts, in percent of the first shift for measures of difficulty, else in points;
        a loss is that at the last shift alone.
      is_met: True if the means of all changes are within the limit, and a loss that is wanted is clear of 0.
    """

    name: str
    measure: str
    changes: tuple[Interval, ...]
    is_met: bool


def judge_shift(table: ResultTable, fields: Mapping[str, Any], shifts: Sequence[float]) -> list[Criterion]:
    """Judge whether a layout shift keeps the difficulty, costs agents that rely on the layout, and costs no others.

    Args:
      table: rows of `measure_instrument`.
      fields: world and run of these rows.
      shifts: layout shifts; the first is the training layout.
    """

    def change_of(measure: str, shift: float) -> Interval:
        return table.find(fields, shift=shift, reference="first shift", metric=measure)

    criteria = []
    for measure in DIFFICULTY_MEASURES:
        changes = tuple(change_of(measure, shift) for shift in shifts[1:])
        is_met = all(abs(change.mean) <= MAX_CHANGE for change in changes)
        criteria.append(Criterion("Difficulty matched", measure, changes, is_met))
    for measure in CATEGORY_MEASURES:
        changes = tuple(change_of(f"{measure} by category", shift) for shift in shifts[1:])
        is_met = all(change.mean <= MAX_CHANGE for change in changes)
        criteria.append(Criterion("Categories matched", measure, changes, is_met))
    for measure in BASELINE_MEASURES:
        loss = change_of(measure, shifts[-1])
        is_met = loss.mean >= MIN_LOSS and loss.low > 0.0
        criteria.append(Criterion("Discriminating", measure, (loss,), is_met))
    if table.has(fields, shift=shifts[0], metric=LAYOUT_BLIND_MEASURES[0]):
        for measure in LAYOUT_BLIND_MEASURES:
            loss = change_of(measure, shifts[-1])
            criteria.append(Criterion("No loss if layout-blind", measure, (loss,), loss.mean < MAX_LAYOUT_BLIND_LOSS))
    return criteria
