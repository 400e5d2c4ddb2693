"""Training of a run, from the layout prior to the exported policies.

`train` is the entry point, and `batch.train_batch` that of several runs side by side; both call `train_runs`. Before
training, `explore_world`, `calibrate_estimator` and `learn_knowledge` collect the layout prior and everything else that
is known from the training scenes; `prepare_training` stores the results in the run directory. `make_trainer` builds the
trainer of all seeds of both arms (`baseline`: policies without the layout estimator, `layout`: with it), and
`run_updates` trains chunk by chunk. A chunk is one compiled call of several updates in one bank of scenes (a shard,
where scenes are streamed). Between chunks the run validates, logs and saves its policies. A run resumes from its last
checkpoint, and a signal ends it after the current chunk (`Interrupts`).
"""

import dataclasses
import functools
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column

from jaxnav.env.objectnav import EnvParams, ObjectNav
from jaxnav.errors import InputError, Interrupted, MissingSplitError
from jaxnav.gaps import NUM_NEAR_FEATURES
from jaxnav.layout import ESTIMATORS, EstimatorConfig
from jaxnav.plain_console import PlainConsole, to_plain_console
from jaxnav.policies.agent_loop import AgentLoop
from jaxnav.policies.method import Knowledge
from jaxnav.policies.methods import METHODS
from jaxnav.policies.network import Params
from jaxnav.policies.testing import check_method
from jaxnav.progress import show_activity
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.memory import format_bytes, require_memory
from jaxnav.runs.policies import POLICIES_DIR, export_policy
from jaxnav.runs.preparation import (
    PREPARATION_DIR,
    Preparation,
    has_preparation,
    load_preparation,
    save_preparation,
)
from jaxnav.runs.run import (
    LOG_FILE,
    REACH_FILE,
    TIMES_FILE,
    Run,
    RunLogs,
    claim_run_dir,
    lock_run_dir,
    manifest_settings,
    run_settings,
)
from jaxnav.runs.validation import SCORE_METRIC, Validator
from jaxnav.runs.worlds import (
    CompiledWorld,
    compile_sample_bank,
    compile_training_world,
    draw_bank_order,
    prefetch_env_params,
)
from jaxnav.store.checkpoint import has_checkpoints, restore_checkpoint, save_checkpoint, set_aside_checkpoints_after
from jaxnav.store.files import (
    FolderLock,
    LogRow,
    make_manifest,
    read_log_rows,
    write_json_with_digest,
    write_log_rows,
)
from jaxnav.training.calibration import (
    REDUCTIONS,
    STRENGTHS,
    Exploration,
    calibrate,
    explore,
    fit_shift_classifier,
    fit_sighting_classifier,
    layout_priors,
    limit_walks,
)
from jaxnav.training.devices import (
    Devices,
    check_agreement,
    exit_if_process_lost,
    is_first_process,
    require_float32,
    run_on_first_process,
)
from jaxnav.training.ppo import EPISODE_MEANS, Learner, LearnerState
from jaxnav.training.trainer import ARM_KEY_PURPOSES, SeedMetrics, ShardedTrainer, Trainer, TrainerStates

# Constants folded into the run's key; the arms use 0, 1, ... (`ARM_KEY_PURPOSES`).
_EXPLORE = 2**31 - 1
_CALIBRATE = 2**31 - 2
_COOCCURRENCE = 2**31 - 3
_SIGHTINGS = 2**31 - 4

#: Random walks of the co-occurrence evidence, as a multiple of those of the prior.
_EVIDENCE_WALK_FACTOR = 4
#: The same for the sightings of the gap `surprise`.
_SIGHTING_WALK_FACTOR = 2

#: Signals that end a run after the current chunk: Ctrl-C, and SIGTERM as schedulers send it.
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Relative excess of a run's steps over `total_steps` from which the run prints its true length.
_NOTED_EXCESS = 0.05
#: Width of the progress bar, and of the two times after it with the spaces between them, in columns.
_BAR_WIDTH = 12
_TIMES_WIDTH = 17
#: Chunks between two lines of progress on a console without a progress bar.
_CHUNKS_PER_LINE = 4


#: Called in every process after every chunk of updates with the chunk's rows of the training log, one for each arm and
#: seed; never for methods that are fitted without PPO.
TrainCallback = Callable[[Sequence[LogRow]], None]


@exit_if_process_lost()
def train(config: RunConfig, console: Console | None = None, callback: TrainCallback | None = None) -> Run:
    """Train a run and export its policies.

    Training resumes from the last checkpoint of the run directory if there is one. A script calls this below
    `if __name__ == "__main__":`, because many scenes are compiled in several processes that import the script.

    Args:
      config: configuration of the run.
      console: console for progress; None for silence.
      callback: called after every chunk of `config.chunk` updates with the rows of the training log (`Run.log`) that
        the chunk adds. An exception ends the training, which then resumes from its last checkpoint.

    Returns:
      The finished run.

    Raises:
      InputError: a setting is impossible, the run directory holds something else or is in use, or files are damaged.
      Interrupted: Ctrl-C or SIGTERM came during training. The run is saved, and the same call resumes it.
    """
    config = check_config_and_method(config)
    train_runs(config, [config], console, callback)
    return Run(config)


def train_runs(
    config: RunConfig, run_configs: Sequence[RunConfig], console: Console | None, callback: TrainCallback | None
) -> None:
    """Train runs side by side that differ in traced settings of PPO alone, and export the policies of each.

    Args:
      config: checked configuration that all share, with the directory of the training state; its seeds are those of
        all runs. Of a single run it is the configuration itself.
      run_configs: checked configurations of the runs.
      console, callback: see `train`.
    """
    require_float32()
    stopwatch = Stopwatch.start()
    mesh = connect_devices(config)
    console = to_plain_console(console if is_first_process() else None)

    # All processes must train the same run. Settings are compared before the scenes, whose compilation may take long.
    check_agreement(json.dumps(make_manifest(run_settings(config))))
    compiled_world = compile_training_world(config, console)
    manifest_fields = {"scenes_fingerprint": compiled_world.fingerprint, "budget": config.steps_by_purpose}
    if list(run_configs) != [config]:
        # The settings of all points, one list per name.
        values_by_name: dict[str, list[Any]] = {}
        for run_config in run_configs:
            for name, setting_value in run_settings(run_config)["ppo"].items():
                values_by_name.setdefault(name, []).append(setting_value)
        manifest_fields["points"] = values_by_name
    manifest = make_manifest(manifest_settings(config) | manifest_fields)
    check_agreement(json.dumps(manifest))

    with lock_run_dir(config) as lock:
        _train_in_run_dir(config, run_configs, compiled_world, manifest, mesh, lock, stopwatch, console, callback)


def _train_in_run_dir(
    config: RunConfig,
    run_configs: Sequence[RunConfig],
    compiled_world: CompiledWorld,
    manifest: dict[str, Any],
    mesh: Mesh | None,
    lock: FolderLock,
    stopwatch: "Stopwatch",
    console: PlainConsole,
    callback: TrainCallback | None,
) -> None:
    """Train in a run directory whose lock is held; see `train_runs`."""
    # A directory of policies alone was copied without its training state, or is that of a run of a batch.
    has_training_state = has_preparation(config.run_dir) or has_checkpoints(config.run_dir)
    if (config.run_dir / POLICIES_DIR).exists() and not has_training_state:
        raise InputError(
            f"{config.run_dir}: holds trained policies without the state of their training; evaluate them, or train in "
            "another --run-dir (a run of train_batch is trained by repeating that call)"
        )
    warn_if_rollout_too_short(config, console)
    warn_if_more_steps(config, console)
    preparation = prepare_training(config, compiled_world, manifest, console)
    exploration, estimator_config, knowledge, fitted_params = preparation
    if fitted_params:
        _finish_fitted_run(config, compiled_world, preparation, lock, stopwatch, console)
        return

    trainer = make_trainer(config, compiled_world.env, estimator_config, knowledge, mesh, run_configs)

    # Draw the bank of scenes in which each chunk trains.
    bank_order = draw_bank_order(compiled_world, config.seed, config.total_updates // config.chunk)
    if len(compiled_world.banks) > 1:
        num_used = len(set(bank_order))
        shard_counts = f"{len(bank_order)} turns in {num_used} of {len(compiled_world.banks)} shards"
        console.print(f"training in one shard of scenes at a time: {shard_counts}")

    # Resume from the last checkpoint. A finished run needs no validator.
    env_params = compiled_world.make_env_params(bank_order[0])
    states, update = _restore_or_init(config, trainer, env_params, manifest, console)
    stopwatch = stopwatch.resume(config.run_dir / TIMES_FILE)
    has_success_by_budget = all((run_config.run_dir / REACH_FILE).exists() for run_config in run_configs)
    is_finished = update == config.total_updates and has_success_by_budget
    validator = None if is_finished else _make_validator(config, trainer, knowledge, compiled_world, console)

    session = TrainingSession(
        config, trainer, validator, compiled_world, bank_order, manifest, lock, stopwatch, console, callback
    )
    states = run_updates(session, states, update)

    # Export the best policies of each run, and measure them.
    seed_states = trainer.unpack(states)
    first_seed = 0
    for run_config in run_configs:
        policies = {}
        for arm, arm_states in seed_states.items():
            run_states = arm_states[first_seed : first_seed + run_config.seeds]
            policies[arm] = [_best_params(state) for state in run_states]
        # Folders of the runs of a batch are made here; of a single run, this repeats the check.
        run_on_first_process(functools.partial(claim_run_dir, run_config))
        if run_config.run_dir != config.run_dir:
            run_on_first_process(functools.partial(_copy_logs, config, run_config, first_seed))
        export = functools.partial(_export_policies, run_config, policies, estimator_config, knowledge, exploration)
        run_on_first_process(export)
        if validator is not None:
            _write_success_by_budget(run_config, validator, policies, console)
        first_seed += run_config.seeds
    console.print(f"{config.run_dir}: done in {stopwatch.read()['wall_s']:.0f} s")


def check_config_and_method(config: RunConfig) -> RunConfig:
    """Complete and check a configuration, and check a method of another package.

    Raises:
      InputError: this is no configuration, a setting is impossible, or the method breaks the contract of methods.
    """
    if not isinstance(config, RunConfig):
        raise InputError(
            f"{type(config).__name__} is no configuration; give a jaxnav.RunConfig (the command jaxnav train --config "
            "reads named configurations and files)"
        )
    config = check_config(config)
    if config.method not in METHODS:
        bank = compile_sample_bank(config)
        try:
            check_method(config.method, method_sizes=config.method_sizes, bank=bank)
        except Exception as error:  # code of another package may raise anything
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise InputError(f"method {config.method!r}: fails check_method ({reason}); fix the method") from error
    return config


def connect_devices(config: RunConfig) -> Mesh | None:
    """Join the other processes of the run, and return the mesh of its devices; None if `devices` is not set."""
    devices = None if config.devices is None else Devices.parse(str(config.devices))
    if devices is None:
        return None
    devices.connect()
    return devices.mesh(config.seeds, config.ppo.num_envs, config.ppo.minibatches)


def warn_if_rollout_too_short(config: RunConfig, console: PlainConsole) -> None:
    """Warn if rollouts are shorter than the interval between two choices of the method."""
    # Methods such as `semexp` choose once in several actions.
    choice_interval = config.policy_method.control.interval
    rollout = config.ppo.rollout
    if rollout < choice_interval:
        console.print(
            f"{config.method} chooses every {choice_interval} actions, so rollouts of {rollout} steps rarely contain "
            f"the outcome of a choice; give --ppo.rollout {2 * choice_interval} or more, and fewer --ppo.num-envs"
        )


def warn_if_more_steps(config: RunConfig, console: PlainConsole) -> None:
    """Warn if whole chunks make the run more than 5 % longer than its `total_steps`."""
    asked_steps = config.total_steps
    num_steps = config.total_updates * config.steps_per_update
    if asked_steps is not None and num_steps > (1 + _NOTED_EXCESS) * asked_steps:
        chunk_steps = config.chunk * config.steps_per_update
        console.print(
            f"training for {num_steps:,} steps instead of {asked_steps:,}: whole chunks of {chunk_steps:,} steps each"
        )


def prepare_training(
    config: RunConfig, compiled_world: CompiledWorld, manifest: dict[str, Any], console: PlainConsole
) -> Preparation:
    """Learn what a run learns once: layout prior and estimator, the method's knowledge, and policies that are fitted.

    Args:
      config: configuration of the run, whose directory is locked.
      compiled_world: compiled training scenes.
      manifest: manifest of the run.
      console: console for progress.

    Raises:
      InputError: the run directory holds knowledge of other settings or scenes.
    """
    # A repeated command reads the knowledge: other hardware would learn it with other last digits.
    if has_preparation(config.run_dir):
        preparation = load_preparation(config.run_dir, manifest)
        if preparation is not None:
            # Join the barrier of `save_preparation` below: another process may find what this one has just stored.
            run_on_first_process(lambda: None)
            console.print(f"layout prior of this run, from {int(preparation.exploration.steps):,} random steps")
            return preparation
        console.print(f"{config.run_dir / PREPARATION_DIR}: is damaged, so it is learned again")

    # Learn the layout prior, the estimator, and then everything that builds on both.
    with show_activity(console, "random walks for the layout prior"):
        exploration = explore_world(config, compiled_world)
        num_steps = int(exploration.steps)
        num_poses = int(exploration.poses)
    console.print(f"layout prior from {num_steps:,} random steps, {num_poses:,} distinct poses")
    with show_activity(console, "calibrating the layout estimator"):
        estimator_config = calibrate_estimator(config, compiled_world, exploration, console)
    with show_activity(console, "learning statistics of the training scenes"):
        knowledge = learn_knowledge(config, compiled_world, exploration, estimator_config)

    # Methods without training by PPO fit their policies here.
    fitted_params: tuple[Params, ...] = ()
    if config.policy_method.fit is not None:
        fitted_params = fit_policies(config, compiled_world, estimator_config, knowledge, console)

    preparation = Preparation(exploration, estimator_config, knowledge, fitted_params)
    run_on_first_process(lambda: save_preparation(config.run_dir, preparation, manifest))
    return preparation


def explore_world(config: RunConfig, compiled_world: CompiledWorld) -> Exploration:
    """Collect co-occurrence counts on random walks in the training scenes.

    The walks are divided equally among the banks of scenes.
    """
    key = jax.random.fold_in(jax.random.key(config.seed), _EXPLORE)
    num_banks = len(compiled_world.banks)
    walks_per_bank = -(-config.layout.walks // num_banks)  # rounded up

    # Explore bank by bank, and add up the counts.
    estimator_config = named_estimator(config)
    explore_bank = jax.jit(explore, static_argnames=("env", "num_walks", "num_steps", "estimator_config"))
    explorations = []
    for bank_index, params in enumerate(prefetch_env_params(compiled_world, range(num_banks))):
        bank_key = jax.random.fold_in(key, bank_index)
        explorations.append(
            explore_bank(compiled_world.env, params, bank_key, walks_per_bank, config.layout.steps, estimator_config)
        )
    exploration = jax.tree.map(lambda *bank_leaves: sum(bank_leaves), *explorations)

    # A pooled prior gives every room type the counts of all rooms.
    if config.layout.prior == "room":
        return exploration
    return exploration._replace(
        counts=_pool_rooms(exploration.counts), prior_counts=_pool_rooms(exploration.prior_counts)
    )


def _pool_rooms(counts: jax.Array) -> jax.Array:
    """Give every room type the counts of all rooms, float32 [rooms, K, K]."""
    return jnp.broadcast_to(counts.sum(axis=0), counts.shape)


def named_estimator(config: RunConfig) -> EstimatorConfig:
    """Layout estimator that `layout.setting` and `layout.counts` name, before calibration."""
    return dataclasses.replace(ESTIMATORS[config.layout.setting], counts=config.layout_counts)


def calibrate_estimator(
    config: RunConfig, compiled_world: CompiledWorld, exploration: Exploration, console: PlainConsole
) -> EstimatorConfig:
    """Configuration of the layout estimator, with strength and reduction.

    Values that the run's configuration leaves open are calibrated in the training scenes of the first bank.
    """
    estimator_config = named_estimator(config)
    if config.policy_method.has_additive_scores:
        # The default `residual` would rescale the direct scores.
        estimator_config = dataclasses.replace(estimator_config, form="paper")
    if estimator_config.strength is None:
        return estimator_config  # `paper` and `released` keep the sums of the counts, so nothing is calibrated

    # Search both values, or use the value that the configuration sets.
    candidate_strengths = STRENGTHS if config.layout.strength is None else (config.layout.strength,)
    candidate_reductions = REDUCTIONS if config.layout.reduction is None else (config.layout.reduction,)
    key = jax.random.fold_in(jax.random.key(config.seed), _CALIBRATE)
    calibration = calibrate(
        compiled_world.env,
        compiled_world.make_env_params(0),
        exploration.prior_counts,
        estimator_config,
        key,
        candidate_strengths,
        candidate_reductions,
    )

    estimator_config = calibration.estimator_config
    console.print(
        f"layout estimator: prior strength {estimator_config.strength:g}, reduction {estimator_config.reduction}; "
        f"layout gap {calibration.early:.2f} in the first views, {calibration.late:.2f} after twenty steps"
    )
    return estimator_config


def learn_knowledge(
    config: RunConfig, compiled_world: CompiledWorld, exploration: Exploration, estimator_config: EstimatorConfig
) -> Knowledge:
    """Knowledge from before training: layout priors, the method's own, and evidence from co-occurrence.

    The evidence is learned in the training scenes of the first bank, and only where policies use the layout.
    """
    priors = layout_priors(exploration.prior_counts, estimator_config)

    # The method's own knowledge, from the tables of all banks.
    learn = config.policy_method.learn
    method_knowledge = {}
    if learn is not None:
        method_knowledge = jax.tree.map(jnp.asarray, learn(compiled_world.banks, np.asarray(exploration.counts)))
    if "layout" not in config.arms:
        return Knowledge(priors, method_knowledge)

    # Log odds that a pair of categories seen together indicates a shifted layout.
    key = jax.random.fold_in(jax.random.key(config.seed), _COOCCURRENCE)
    num_categories = exploration.counts.shape[-1]
    num_walks = limit_walks(_EVIDENCE_WALK_FACTOR * config.layout.walks, 1, num_categories)
    is_pooled = config.layout.prior == "pooled"
    learn_evidence = jax.jit(fit_shift_classifier, static_argnames=("env", "num_walks", "pooled"))
    env_params = compiled_world.make_env_params(0)
    cooccurrence = learn_evidence(compiled_world.env, env_params, exploration.counts, key, num_walks, is_pooled)

    # Log odds of the distances at which pairs were seen.
    near_key = jax.random.fold_in(jax.random.key(config.seed), _SIGHTINGS)
    num_walks = limit_walks(_SIGHTING_WALK_FACTOR * config.layout.walks, NUM_NEAR_FEATURES, num_categories)
    learn_near_evidence = jax.jit(fit_sighting_classifier, static_argnames=("env", "num_walks", "pooled"))
    near_log_odds = learn_near_evidence(
        compiled_world.env, env_params, exploration.counts, near_key, num_walks, is_pooled
    )
    return Knowledge(priors, method_knowledge, cooccurrence._replace(near_log_odds=near_log_odds))


def fit_policies(
    config: RunConfig,
    compiled_world: CompiledWorld,
    estimator_config: EstimatorConfig,
    knowledge: Knowledge,
    console: PlainConsole,
) -> tuple[Params, ...]:
    """Fit the policy of each seed to searches in the training scenes of the first bank; see `Method.fit`.

    Args:
      config: configuration of the run, whose method is fitted.
      compiled_world: compiled training scenes.
      estimator_config: layout estimator.
      knowledge: knowledge from before training.
      console: console for progress.
    """
    fit = config.policy_method.fit
    assert fit is not None
    compiled_world.check_method(config.policy_method, knowledge)
    agent_loop = _make_fitted_loop(config, compiled_world.env, estimator_config)
    env_params = compiled_world.make_env_params(0)
    arm_key = jax.random.fold_in(jax.random.key(config.seed), ARM_KEY_PURPOSES["layout"])
    num_steps = config.total_updates * config.ppo.rollout

    fitted_params = []
    for seed in range(config.seeds):
        with show_activity(console, f"fitting policy {seed + 1} of {config.seeds} to searches"):
            seed_key = jax.random.fold_in(arm_key, seed)
            params = fit(
                agent_loop, compiled_world.banks[0], env_params, knowledge, seed_key, config.ppo.num_envs, num_steps
            )
            fitted_params.append(jax.block_until_ready(params))
        console.print(f"policy {seed + 1} of {config.seeds}: fitted to {config.ppo.num_envs * num_steps:,} steps")
    return tuple(fitted_params)


def _make_fitted_loop(config: RunConfig, env: ObjectNav, estimator_config: EstimatorConfig) -> AgentLoop:
    """Agent loop of policies that are fitted; it has no use for the gap."""
    policy_spec = config.policy_spec(len(env.categories))
    return AgentLoop(env, policy_spec, dataclasses.replace(estimator_config, gap="none"))


def _finish_fitted_run(
    config: RunConfig,
    compiled_world: CompiledWorld,
    preparation: Preparation,
    lock: FolderLock,
    stopwatch: "Stopwatch",
    console: PlainConsole,
) -> None:
    """Export the policies that were fitted, and measure them."""
    exploration, estimator_config, knowledge, fitted_params = preparation
    policies = {"layout": [jax.device_get(params) for params in fitted_params]}
    run_on_first_process(lock.check)
    run_on_first_process(lambda: _export_policies(config, policies, estimator_config, knowledge, exploration))

    # Success within budgets of actions; a finished run has it already.
    if config.validations and not (config.run_dir / REACH_FILE).exists():
        agent_loop = _make_fitted_loop(config, compiled_world.env, estimator_config)
        try:
            validator = Validator(config, agent_loop, knowledge, compiled_world, console)
        except MissingSplitError as error:
            console.print(f"no val scenes, so the policies are not measured ({error})")
        else:
            _write_success_by_budget(config, validator, policies, console)
    console.print(f"{config.run_dir}: done in {stopwatch.read()['wall_s']:.0f} s")


def _write_success_by_budget(
    config: RunConfig, validator: Validator, policies: Mapping[str, Sequence[Params]], console: PlainConsole
) -> None:
    """Measure the exported policies of a run, and store their success within budgets of actions."""
    with show_activity(console, "measuring the exported policies"):
        success_by_budget = validator.success_by_budget(policies)
    run_on_first_process(lambda: write_json_with_digest(config.run_dir / REACH_FILE, success_by_budget))


def _copy_logs(config: RunConfig, run_config: RunConfig, first_seed: int) -> None:
    """Give a run of a batch its rows of the training log, with its own numbers of seeds, and the times of all.

    Args:
      config: configuration of the batch.
      run_config: configuration of the run.
      first_seed: number of the run's first seed in the batch.
    """
    run_rows = []
    for row in RunLogs(config).read(LOG_FILE):
        if first_seed <= row["seed"] < first_seed + run_config.seeds:
            run_rows.append(row | {"seed": row["seed"] - first_seed})
    write_log_rows(run_config.run_dir / LOG_FILE, run_rows)
    write_log_rows(run_config.run_dir / TIMES_FILE, RunLogs(config).read(TIMES_FILE))


def make_trainer(
    config: RunConfig,
    env: ObjectNav,
    estimator_config: EstimatorConfig,
    knowledge: Knowledge,
    mesh: Mesh | None = None,
    run_configs: Sequence[RunConfig] | None = None,
) -> Trainer:
    """Make the trainer of all arms and seeds of a run.

    Args:
      config: configuration of the run.
      env: environment of the training scenes.
      estimator_config: layout estimator. Training does not use the gap, so it is switched off.
      knowledge: knowledge from before training.
      mesh: mesh of devices; None for one device.
      run_configs: runs that are trained side by side, which differ from `config` in traced settings of PPO alone; the
        seeds of each follow those of the one before. None for the run itself.
    """
    policy_spec = config.policy_spec(len(env.categories))
    # Training episodes may start near their goals.
    env = dataclasses.replace(env, near_starts=config.near_starts)

    # Arms differ only in the estimator.
    arm_estimators = {"baseline": None, "layout": dataclasses.replace(estimator_config, gap="none")}
    learners = {}
    for arm in config.arms:
        agent_loop = AgentLoop(env, policy_spec, arm_estimators[arm])
        learners[arm] = Learner(agent_loop, config.ppo, config.counterfactual)

    # Traced settings of each policy, stacked for each stage.
    run_configs = [config] if run_configs is None else run_configs
    scalars_by_policy = []
    for run_config in run_configs:
        run_scalars = run_config.ppo.stage_scalars(config.stages, config.stage_by_chunk, config.chunk)
        scalars_by_policy += [run_scalars] * run_config.seeds
    stage_scalars = []
    for policy_scalars in zip(*scalars_by_policy, strict=True):
        stage_scalars.append(jax.tree.map(lambda *leaves: np.stack(leaves), *policy_scalars))

    # With a mesh, seeds and environments are sharded over its devices.
    trainer_class = Trainer if mesh is None else functools.partial(ShardedTrainer, mesh=mesh)
    return trainer_class(
        learners,
        stages=config.stages,
        stage_scalars=stage_scalars,
        knowledge=knowledge,
        key=jax.random.key(config.seed),
        seeds=[seed for run_config in run_configs for seed in range(run_config.seeds)],
        chunk_size=config.chunk,
    )


def _restore_or_init(
    config: RunConfig, trainer: Trainer, env_params: EnvParams, manifest: dict[str, Any], console: PlainConsole
) -> tuple[TrainerStates, int]:
    """Training states of the last checkpoint or of the start, and the number of updates done in them.

    Checkpoints and log rows after the restored update are moved away or dropped, because training will write them
    again.
    """
    state_bytes = trainer.estimate_state_bytes(env_params)
    require_memory(
        state_bytes, "the state of training", "give fewer seeds or a smaller ppo.num_envs in a new --run-dir"
    )

    checkpoint = None
    if has_checkpoints(config.run_dir):
        checkpoint = restore_checkpoint(config.run_dir, trainer.abstract_states(env_params), manifest)
    update = 0
    if checkpoint is not None:
        update = checkpoint.step
        for damage_note in checkpoint.damaged:
            console.print(f"{damage_note}; moved to {config.run_dir / 'damaged'}")
    run_on_first_process(lambda: set_aside_checkpoints_after(config.run_dir, update))
    run_on_first_process(lambda: RunLogs(config).rewind(update))

    if checkpoint is None:
        return trainer.init(env_params), 0
    console.print(f"resumed after update {update} of {config.total_updates}")
    return trainer.pack(checkpoint.state), update


def _make_validator(
    config: RunConfig, trainer: Trainer, knowledge: Knowledge, compiled_world: CompiledWorld, console: PlainConsole
) -> Validator | None:
    """Validator of the policies; None without validations or val scenes."""
    if not config.validations:
        return None
    # The loop with the estimator serves both arms; rows of the baseline set the layout weights to ones.
    arm = "layout" if "layout" in config.arms else "baseline"
    agent_loop = trainer.learners[arm].agent_loop
    try:
        return Validator(config, agent_loop, knowledge, compiled_world, console)
    except MissingSplitError as error:
        console.print(f"no val scenes, so the policies of the last update are exported ({error})")
        return None


@dataclasses.dataclass(frozen=True)
class TrainingSession:
    """Everything that the chunks of a training run share.

    Attributes:
      config: configuration of the run.
      trainer: trainer of all arms and seeds.
      validator: measures policies in val scenes; None without such scenes.
      compiled_world: compiled training scenes.
      bank_order: index of the bank of scenes of every chunk.
      manifest: identity of the run in its checkpoints.
      lock: lock of the run directory.
      stopwatch: seconds of the run.
      console: console for progress.
      callback: called with the log rows of every chunk.
    """

    config: RunConfig
    trainer: Trainer
    validator: Validator | None
    compiled_world: CompiledWorld
    bank_order: Sequence[int]
    manifest: dict[str, Any]
    lock: FolderLock
    stopwatch: "Stopwatch"
    console: PlainConsole
    callback: TrainCallback | None = None


def run_updates(session: TrainingSession, states: TrainerStates, update: int) -> TrainerStates:
    """Train chunk by chunk, from `update` updates to the end of the run.

    Raises:
      Interrupted: a signal asked for an end. The current chunk is saved.
    """
    # The remaining chunks, and the environment's parameters for each.
    config = session.config
    trainer = session.trainer
    bank_order = session.bank_order
    stage_by_chunk = config.stage_by_chunk
    validation_updates = config.validation_updates
    remaining_chunks = range(update // config.chunk, len(bank_order))
    params_by_chunk = prefetch_env_params(session.compiled_world, [bank_order[chunk] for chunk in remaining_chunks])

    with ProgressDisplay(config, update, session.console) as progress, Interrupts() as interrupts:
        for chunk_index, env_params in zip(remaining_chunks, params_by_chunk, strict=True):
            stage_index = stage_by_chunk[chunk_index]
            # A new bank of scenes invalidates the running episodes, so restart them.
            if chunk_index and bank_order[chunk_index] != bank_order[chunk_index - 1]:
                states = trainer.restart(states, env_params, stage_index)

            # Train, and validate if due.
            if not trainer.is_compiled(stage_index):
                _compile_training(session, progress, states, env_params, stage_index)
                progress.show_activity(f"updates {update + 1} to {update + config.chunk}")
            progress.start_timing()
            states, metrics = trainer.train(states, env_params, stage_index)
            metrics = mark_undefined_means(metrics)
            update += config.chunk
            progress.stop_timing()
            if session.validator is not None and update in validation_updates:
                progress.show_activity("measuring the policies in val scenes")
                states, metrics = _validate(session, session.validator, states, metrics, stage_index)

            # All processes agree on a signal before process 0 writes. The check of the lock stops the run if its
            # directory was removed or replaced.
            signal_number = interrupts.pending_signal()
            run_on_first_process(session.lock.check)

            # Write the log, and the checkpoint if due.
            log_rows = _log_rows(config, metrics, update)
            if is_first_process():
                RunLogs(config).append(log_rows, {"step": update} | session.stopwatch.read())
            is_save_due = update % (config.chunk * config.save_every) == 0 or update == config.total_updates
            if signal_number or is_save_due:
                save_checkpoint(config.run_dir, update, trainer.unpack(states), session.manifest)

            progress.show_chunk(metrics, update)
            if session.callback is not None:
                session.callback(log_rows)
            if signal_number:
                break

        # A signal may also come during the last save.
        signal_number = interrupts.pending_signal()
        if signal_number:
            stop_message = f"{config.run_dir}: stopped after update {update} of {config.total_updates} and saved"
            raise Interrupted(signal_number, stop_message)
    return states


def _compile_training(
    session: TrainingSession,
    progress: "ProgressDisplay",
    states: TrainerStates,
    env_params: EnvParams,
    stage_index: int,
) -> None:
    """Compile the updates of every arm in a stage, and say how long it took and how much memory they need.

    Raises:
      InputError: the first stage needs more memory than is free.
    """
    arm_times = []
    for arm in session.trainer.learners:
        progress.show_activity(f"compiling the training of arm {arm}")
        start = time.monotonic()
        session.trainer.compile(arm, states, env_params, stage_index)
        arm_times.append(f"{arm} {time.monotonic() - start:.1f} s")
    num_bytes = session.trainer.estimate_temporary_bytes(stage_index)
    session.console.print(f"compiled the training: {', '.join(arm_times)}; updates need {format_bytes(num_bytes)}")

    # Later stages try in any case, because a refusal would lose the updates since the last checkpoint.
    if stage_index == 0:
        remedy = "give fewer seeds, a smaller ppo.num_envs or ppo.rollout, or more ppo.minibatches in a new --run-dir"
        require_memory(num_bytes, "an update", remedy)


def mark_undefined_means(metrics: SeedMetrics) -> SeedMetrics:
    """Metrics with NaN, which the log holds as null, for means over no episode."""
    marked_metrics: SeedMetrics = {}
    for arm, metrics_by_seed in metrics.items():
        marked_metrics[arm] = []
        for seed_metrics in metrics_by_seed:
            undefined_means = {} if seed_metrics["episodes"] else dict.fromkeys(EPISODE_MEANS, math.nan)
            marked_metrics[arm].append(seed_metrics | undefined_means)
    return marked_metrics


def _validate(
    session: TrainingSession, validator: Validator, states: TrainerStates, metrics: SeedMetrics, stage_index: int
) -> tuple[TrainerStates, SeedMetrics]:
    """Measure all policies in val scenes, and keep the best of each seed.

    Returns:
      The states with the best policies, and the metrics with the scores.
    """
    config = session.config
    trainer = session.trainer
    # Score the current parameters, with adaptation as in this stage.
    params_by_arm = {}
    for arm, seed_states in trainer.unpack(states).items():
        params_by_arm[arm] = [state.params for state in seed_states]
    scores_by_arm = validator.measure(params_by_arm, config.stages[stage_index].adapts_online)

    # Only policies of the last stage compete: earlier stages leave parts of the policy untrained.
    if stage_index == config.stage_by_chunk[-1]:
        val_success = {}
        for arm, arm_scores in scores_by_arm.items():
            val_success[arm] = [seed_scores[SCORE_METRIC] for seed_scores in arm_scores]
        states = trainer.keep_best(states, val_success)

    # Scores become further columns of the log.
    scored_metrics: SeedMetrics = {}
    for arm, seed_metrics in metrics.items():
        seed_scores = scores_by_arm[arm]
        scored_metrics[arm] = [row | scores for row, scores in zip(seed_metrics, seed_scores, strict=True)]
    return states, scored_metrics


def _log_rows(config: RunConfig, metrics: SeedMetrics, update: int) -> list[LogRow]:
    """Rows of one chunk in the training log, one for each arm and seed."""
    log_rows: list[LogRow] = []
    for arm, metrics_by_seed in metrics.items():
        for seed, seed_metrics in enumerate(metrics_by_seed):
            row_labels = {"step": update, "arm": arm, "seed": seed, "env_steps": update * config.steps_per_update}
            log_rows.append(row_labels | seed_metrics)
    return log_rows


def _best_params(state: LearnerState) -> Params:
    """Parameters of a seed's best policy in validation, or of its last one without validation."""
    # The score is -1 before the first validation.
    params = state.best.params if state.best.score >= 0 else state.params
    return jax.device_get(params)


def _export_policies(
    config: RunConfig,
    policies: Mapping[str, Sequence[Params]],
    estimator_config: EstimatorConfig,
    knowledge: Knowledge,
    exploration: Exploration,
) -> None:
    """Export the policy of every arm and seed."""
    for arm, params_by_seed in policies.items():
        # Baselines are exported without the layout estimator.
        arm_estimator = estimator_config if arm == "layout" else None
        for seed, params in enumerate(params_by_seed):
            export_folder = config.run_dir / POLICIES_DIR / f"{arm}-{seed}"
            export_policy(export_folder, config, params, knowledge, arm_estimator, exploration)


@dataclasses.dataclass(frozen=True)
class Stopwatch:
    """Seconds of a run, added up over interruptions.

    Attributes:
      wall_start, cpu_start: readings of the clocks at which a run without interruptions would have started.
    """

    wall_start: float
    cpu_start: float

    @classmethod
    def start(cls) -> "Stopwatch":
        """Start counting."""
        return cls(time.monotonic(), time.process_time())

    def resume(self, path: Path) -> "Stopwatch":
        """Continue from the last row of a file of times, which may be missing."""
        log_rows = read_log_rows(path)
        if not log_rows:
            return self
        return Stopwatch(self.wall_start - log_rows[-1]["wall_s"], self.cpu_start - log_rows[-1]["cpu_s"])

    def read(self) -> dict[str, float]:
        """Seconds of the run, `wall_s` and `cpu_s`."""
        wall_seconds = time.monotonic() - self.wall_start
        cpu_seconds = time.process_time() - self.cpu_start
        return {"wall_s": round(wall_seconds, 2), "cpu_s": round(cpu_seconds, 2)}


class Interrupts:
    """Context in which the first signal is noted and a second one ends the process.

    Outside the main thread, where Python cannot handle signals, no signal is noted.
    """

    def __enter__(self) -> "Interrupts":
        self._signal_number = 0
        self._previous_handlers = {}
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                # Signals that the parent ignores, or that are not handled by Python, stay as they are.
                if signal.getsignal(number) not in (signal.SIG_IGN, None):
                    self._previous_handlers[number] = signal.signal(number, self._note_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, signal_handler in self._previous_handlers.items():
            signal.signal(number, signal_handler)

    def pending_signal(self) -> int:
        """Number of a signal that any process of the run received, else 0."""
        if jax.process_count() == 1:
            return self._signal_number
        return int(multihost_utils.process_allgather(np.int32(self._signal_number)).max())

    def _note_signal(self, number: int, _: FrameType | None) -> None:
        # A second signal finds the default handlers, and ends the process.
        self._signal_number = number
        for handled_number in self._previous_handlers:
            signal.signal(handled_number, signal.SIG_DFL)


class ProgressDisplay:
    """Progress of training on a console: a bar on a terminal, else lines."""

    def __init__(self, config: RunConfig, update: int, console: PlainConsole) -> None:
        """Prepare to show a run that starts or resumes after `update`."""
        # Long words are cut, never the bar and the times.
        words_width = max(1, console.width - _BAR_WIDTH - _TIMES_WIDTH)
        progress_columns = (
            TextColumn("{task.description}", table_column=Column(no_wrap=True, max_width=words_width)),
            BarColumn(bar_width=_BAR_WIDTH),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._config = config
        self._console = console
        self._bar = Progress(*progress_columns, console=console, disable=not console.is_terminal)
        first_activity = f"updates {update + 1} to {update + config.chunk}"
        self._task = self._bar.add_task(first_activity, total=config.total_updates, completed=update)

    def __enter__(self) -> "ProgressDisplay":
        self._bar.start()
        self._chunk_start = 0.0
        self._chunk_seconds = 0.0
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show_activity(self, activity: str) -> None:
        """Show on the bar what happens between two chunks."""
        self._bar.update(self._task, description=activity)

    def start_timing(self) -> None:
        """Mark the start of a chunk's training, so that its speed excludes compilation."""
        self._chunk_start = time.monotonic()

    def stop_timing(self) -> None:
        """Mark the end of a chunk's training, so that its speed excludes validation and saving."""
        self._chunk_seconds = time.monotonic() - self._chunk_start

    def show_chunk(self, metrics: SeedMetrics, update: int) -> None:
        """Show the metrics of a chunk."""
        config = self._config
        # Speed over all arms and seeds together.
        chunk_steps = config.chunk * config.steps_per_update * config.seeds * len(metrics)
        steps_per_second = chunk_steps / self._chunk_seconds

        # Mean success of each arm, and gradient steps that were skipped in any seed.
        success_rates = []
        num_skipped = 0
        for arm, metrics_by_seed in metrics.items():
            # Success is undefined in seeds in which no episode ended.
            seed_success = [seed_metrics["success"] for seed_metrics in metrics_by_seed]
            has_success = not np.isnan(seed_success).all()
            success_text = f"{100 * np.nanmean(seed_success):.0f} %" if has_success else "undefined (no episode ended)"
            success_rates.append(f"{arm} {success_text}")
            num_skipped += sum(seed_metrics["skipped_steps"] for seed_metrics in metrics_by_seed)
        skip_note = f", {num_skipped:.0f} gradient steps skipped as not finite" if num_skipped else ""

        # This is success in training scenes, with sampled actions. Next to the bar is no room for the speed.
        update_counts = f"{update}/{config.total_updates}"
        training_success = f"training SR: {', '.join(success_rates)}{skip_note}"
        self._bar.update(self._task, completed=update, description=f"{update_counts}, {training_success}")
        progress_line = f"update {update_counts}, {steps_per_second / 1000:.0f} k steps/s, {training_success}"
        # A log file gets a line only every few chunks, and after the last one.
        is_line_due = (update // config.chunk) % _CHUNKS_PER_LINE == 0 or update == config.total_updates
        if not self._console.is_terminal and is_line_due:
            self._console.print(progress_line)
