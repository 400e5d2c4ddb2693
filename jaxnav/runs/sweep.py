"""Sweeps: sTDE at many thresholds.

`sweep` evaluates all thresholds and all seeds in one compiled call; `sweep_shifts` does so at several layout shifts.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxnav.choices import Decoding, EstimatorName, Form, ShiftKind
from jaxnav.errors import InputError
from jaxnav.evaluation.episodes import EpisodeList, join_episode_lists
from jaxnav.evaluation.grid import EpisodeOutcome, Evaluator, episode_metrics
from jaxnav.evaluation.sweep_tables import ThresholdRow, sweep_notes, sweep_table, threshold_rows
from jaxnav.evaluation.variants import table_row
from jaxnav.plain_console import to_plain_console
from jaxnav.progress import show_activity
from jaxnav.runs.config import RunConfig
from jaxnav.runs.evaluate import check_seed, describe_evaluation, evaluate_rows
from jaxnav.runs.loaded_policy import LoadedPolicy
from jaxnav.runs.policies import CONFIG_FILE, Policies, is_policy, list_packaged_policies, load_policy_as_run
from jaxnav.runs.run import Run
from jaxnav.runs.subjects import policy_in_memory_as_run
from jaxnav.runs.worlds import compile_evaluation_world, evaluation_shift
from jaxnav.store.files import expand_home

#: Usual thresholds of a sweep.
SWEPT_THRESHOLDS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class Sweep(NamedTuple):
    """Results of a sweep over X thresholds, S seeds and E episodes, at one layout shift.

    Attributes:
      epsilon: float64 [X], thresholds.
      sr, spl: float64 [X, S, E], in [0, 1].
      dts: float64 [X, S, E], in metres.
      outcome: outcomes of the episodes, leaves [X, S, E].
      compilations: number of compilations; 1 where the scenes are in memory.
      no_removal: outcomes of the same episodes without removal, leaves [S, E].
      episodes: the episodes.
      settings: settings of the sweep as JSON: source, method, split, layout shift, decoding and more.
    """

    epsilon: np.ndarray
    sr: np.ndarray
    spl: np.ndarray
    dts: np.ndarray
    outcome: EpisodeOutcome
    compilations: int
    no_removal: EpisodeOutcome
    episodes: EpisodeList
    settings: dict[str, Any]

    def rows(self) -> list[ThresholdRow]:
        """Mean of every metric at every threshold, and its difference to no removal, with 95 % intervals."""
        return threshold_rows(
            self.epsilon,
            {"sr": self.sr, "spl": self.spl, "dts": self.dts},
            episode_metrics(self.no_removal, self.episodes.best_length),
            np.asarray(self.outcome.mean_weight, np.float64),
            self.episodes,
            self.settings["shift"],
        )

    def notes(self) -> list[str]:
        """Notes on the coverage of the intervals, one sentence per note."""
        return sweep_notes(self.sr.shape[1], self.episodes)

    def table(self) -> Table:
        """Table of SR and SPL by threshold for a terminal; print it with `rich.print`."""
        return sweep_table(self.rows())


def sweep(
    source: Run | LoadedPolicy | str | Path,
    epsilon: float | Sequence[float] | np.ndarray = SWEPT_THRESHOLDS,
    params: Any = None,
    *,
    split: str = "val",
    scenes: str | Path | None = None,
    world: str | None = None,
    shift: float | None = None,
    shift_by: ShiftKind = "size",
    episodes: int = 1000,
    decoding: Decoding = "argmax",
    form: Form | None = None,
    setting: EstimatorName | None = None,
    hold: bool = False,
    seed: int = 0,
    console: Console | None = None,
) -> Sweep:
    """Evaluate sTDE at every threshold and for every seed in one compiled call.

    Args:
      source: a finished run with the arm `layout`, or its directory; or a single policy of that arm, which counts as
        one seed: a `LoadedPolicy`, the folder of an export, or the name of a packaged policy, such as `rooms-org`.
      epsilon: thresholds [X]; no experience is removed for epsilon >= 1.
      params: network parameters of your own, leaves [S, ...]; None for those of the source.
      split, scenes, world, shift, shift_by, episodes, setting, hold, seed, console: as in `jaxnav.evaluate`. A policy
        is evaluated in the generated world that it was trained for, unless `scenes` or `world` is given.
      decoding: `argmax` for best actions, `sample` for sampled ones.
      form: form in which sTDE combines the logits; None for the form of the layout estimator.

    Raises:
      InputError: the source is no finished run and no policy, it has no arm `layout`, or an argument is impossible.
    """
    (result,) = sweep_shifts(
        source,
        epsilon,
        (shift,),
        params,
        split=split,
        scenes=scenes,
        world=world,
        shift_by=shift_by,
        episodes=episodes,
        decoding=decoding,
        form=form,
        setting=setting,
        hold=hold,
        seed=seed,
        console=console,
    )
    return result


def sweep_shifts(
    source: Run | LoadedPolicy | str | Path,
    epsilon: float | Sequence[float] | np.ndarray = SWEPT_THRESHOLDS,
    shifts: Sequence[float | None] = (0.0, 1.0),
    params: Any = None,
    *,
    split: str = "val",
    scenes: str | Path | None = None,
    world: str | None = None,
    shift_by: ShiftKind = "size",
    episodes: int = 1000,
    decoding: Decoding = "argmax",
    form: Form | None = None,
    setting: EstimatorName | None = None,
    hold: bool = False,
    seed: int = 0,
    console: Console | None = None,
) -> list[Sweep]:
    """Sweep at several layout shifts; returns a `Sweep` for each.

    Shifts whose scene tables have equal shapes share a compilation, which the first of them counts. For the other
    arguments and errors see `sweep`.
    """
    check_seed(seed)
    console = to_plain_console(console)
    scenes = None if scenes is None else expand_home(scenes)
    epsilons = np.atleast_1d(np.asarray(epsilon, np.float64))
    if not len(epsilons):
        raise InputError("--epsilon: give at least one number")
    config, policies = _load_layout_policies(source, setting, hold)
    estimator_config = policies.estimator_config
    assert estimator_config is not None  # policies of the arm `layout` have an estimator

    # Random numbers depend on `policy_index`. Repeating the layout parameters for every arm gives them the same index
    # as in `evaluate`, and so both functions sample the same actions.
    arm_names = config.arms
    params = policies.params if params is None else params
    repeated_params = jax.tree.map(lambda leaf: jnp.concatenate([jnp.asarray(leaf)] * len(arm_names)), params)
    policies = policies._replace(params=repeated_params, arms=arm_names)

    # One row for each threshold, and one without removal for the differences.
    form = estimator_config.form if form is None else form
    rows = [table_row("stde", float(threshold), form, decoding) for threshold in epsilons]
    rows.append(table_row("layout", None, None, decoding))

    results = []
    evaluator = None
    for shift in shifts:
        applied_shift = evaluation_shift(config, scenes or world, shift)
        compiled = compile_evaluation_world(config, split, scenes, shift, console, world, shift_by)
        num_seeds = policies.num_seeds
        seed_text = "1 seed" if num_seeds == 1 else f"{num_seeds} seeds"
        console.print(f"shift {applied_shift:g}: {len(epsilons)} thresholds x {seed_text} x {episodes:,} episodes")

        # The agent loop depends on the task and the policy alone, so one evaluator serves all shifts.
        evaluator = evaluator or Evaluator(policies.make_agent_loop(compiled), has_controls=False)
        earlier_compilations = evaluator.compilations
        with show_activity(console, describe_evaluation(episodes, applied_shift)):
            episode_lists, outcome, compilations = evaluate_rows(rows, policies, compiled, episodes, seed, evaluator)

        episode_list = join_episode_lists(episode_lists)
        threshold_outcome = jax.tree.map(lambda leaf: leaf[:-1], outcome)
        metrics = episode_metrics(threshold_outcome, episode_list.best_length)
        sweep_settings = {
            "source": _source_name(source),
            "method": config.method,
            "seeds": num_seeds,
            "scenes": str(scenes or world or config.scene_source),
            "split": split,
            "shift": applied_shift,
            "shift_by": shift_by,
            "episodes": len(episode_list.goal),
            "decoding": decoding,
            "form": form,
            "setting": setting,
            "hold": hold,
            "seed": seed,
        }
        result = Sweep(
            epsilon=epsilons,
            sr=metrics["sr"],
            spl=metrics["spl"],
            dts=metrics["dts"],
            outcome=threshold_outcome,
            compilations=compilations - earlier_compilations,
            no_removal=jax.tree.map(lambda leaf: leaf[-1], outcome),
            episodes=episode_list,
            settings=sweep_settings,
        )
        results.append(result)
    return results


def _load_layout_policies(
    source: Run | LoadedPolicy | str | Path, setting: EstimatorName | None, hold: bool
) -> tuple[RunConfig, Policies]:
    """Load the policies of the arm `layout` of a run, or a single policy; see `sweep`."""
    # A single policy, with one seed.
    if isinstance(source, LoadedPolicy):
        config, policies = policy_in_memory_as_run(source)
    elif not isinstance(source, Run) and is_policy(source):
        config, policies = load_policy_as_run(source)
    else:
        run = _open_run(source)
        config = run.config
        if not config.policy_method.hosts_layout:
            raise InputError(
                f"{config.run_dir}: method {config.method!r} cannot use the layout, which sTDE needs; give a run of "
                "another method (`jaxnav list methods`)"
            )
        policies = run.policies(("layout",))
    if policies.estimator_config is None:
        raise InputError(
            f"{_source_name(source)}: a policy of the arm 'baseline', which does not use the layout; give a policy of "
            "the arm 'layout'"
        )
    return config, policies.with_estimator(setting, hold)


def _open_run(source: Run | str | Path) -> Run:
    """Open a run; text that names neither a run nor a policy is refused with the names of packaged policies."""
    if isinstance(source, Run):
        return source
    if not (expand_home(source) / CONFIG_FILE).exists():
        packaged_names = ", ".join(list_packaged_policies())
        raise InputError(
            f"{source}: neither a run directory ({CONFIG_FILE} is missing) nor an exported policy; train a run, or "
            f"give a packaged policy: {packaged_names}"
        )
    return Run.open(source)


def _source_name(source: Run | LoadedPolicy | str | Path) -> str:
    if isinstance(source, Run):
        return str(source.config.run_dir)
    return f"{source.spec.method.name} policy" if isinstance(source, LoadedPolicy) else str(source)
