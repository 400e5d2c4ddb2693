"""Training of a run, from the prior to the exported policies."""

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from jaxnav.errors import InputError, MissingSplitError
from jaxnav.layout import Setting
from jaxnav.policies.methods import METHODS, Knowledge
from jaxnav.policies.policy import Params
from jaxnav.policies.testing import check_method
from jaxnav.runs.check import check
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import LOG_FILE, REACH_FILE, TIMES_FILE, Run, claim, settings
from jaxnav.runs.policies import POLICIES, export_policy
from jaxnav.runs.prepare import calibrate_setting, explore_world, learn_knowledge, make_trainer
from jaxnav.runs.stopwatch import Stopwatch
from jaxnav.runs.validation import SCORE, Validator
from jaxnav.runs.worlds import CompiledWorld, bank_order, read_ahead, training_world
from jaxnav.store.checkpoint import restore, save
from jaxnav.store.files import write_atomic
from jaxnav.store.manifest import make_manifest
from jaxnav.store.runlog import append_row, truncate_after
from jaxnav.training.devices import Devices, by_first_process, check_agreement, first_process
from jaxnav.training.exploration import Exploration
from jaxnav.training.learner import LearnerState
from jaxnav.training.peers import watched
from jaxnav.training.trainer import States, Trainer


@watched()
def train(config: RunConfig, console: Console | None = None) -> Run:
    """Train a run and export its policies.

    Training goes on from the run's last checkpoint if it has one.

    Args:
      config: the settings.
      console: to tell of progress on; None for silence.

    Returns:
      The finished run.

    Raises:
      InputError: an impossible setting, or a run directory that holds something else.
    """
    clock = Stopwatch.start()
    config = _checked(config)
    mesh = connected(config)
    if console is None or not first_process():
        console = Console(quiet=True)
    check_agreement(json.dumps(make_manifest(settings(config))))  # before the scenes, which may take long
    world = training_world(config, console)
    manifest = make_manifest(settings(config) | {"scenes_fingerprint": world.fingerprint, "budget": config.budget})
    check_agreement(json.dumps(manifest))
    by_first_process(lambda: claim(config))

    explored = explore_world(config, world)
    console.print(f"layout prior from {int(explored.steps):,} random steps, {int(explored.poses):,} distinct poses")
    setting = calibrate_setting(config, world, explored, console)
    knowledge = learn_knowledge(config, world, explored, setting)
    trainer = make_trainer(config, world.env, setting, knowledge, mesh)
    turns = config.total_updates // config.chunk
    order = bank_order(world, config.seed, turns)
    if len(world.banks) > 1:
        console.print(
            f"one shard after the other: {len(order)} turns in {len(set(order))} of {len(world.banks)} shards"
        )
    first = world.params(order[0])
    restored = restore(config.run_dir, trainer.abstract(first), manifest)
    states, done = (trainer.pack(restored[0]), restored[1]) if restored else (trainer.init(first), 0)
    by_first_process(lambda: [truncate_after(config.run_dir / name, done) for name in (LOG_FILE, TIMES_FILE)])
    if restored:
        console.print(f"resumed after update {done} of {config.total_updates}")
    clock = clock.resume(config.run_dir / TIMES_FILE)
    finished = done == config.total_updates and (config.run_dir / REACH_FILE).exists()
    validator = None if finished else _validator(config, trainer, knowledge, world, console)
    states = _do_updates(config, trainer, validator, world, order, states, done, manifest, clock, console)
    kept = {name: [_exported(state) for state in seeds] for name, seeds in trainer.unpack(states).items()}
    by_first_process(lambda: _export(config, kept, setting, knowledge, explored))
    if validator is not None:
        reach = validator.reach(kept)
        by_first_process(lambda: write_atomic(config.run_dir / REACH_FILE, (json.dumps(reach) + "\n").encode()))
    console.print(f"{config.run_dir}: done in {clock.read()['wall_s']:.0f} s")
    return Run(config)


def _validator(
    config: RunConfig, trainer: Trainer, knowledge: Knowledge, world: CompiledWorld, console: Console
) -> Validator | None:
    """Make what measures the policies, if there are scenes for it."""
    if not config.validations:
        return None
    acting = trainer.learners[config.arms[-1]].acting
    try:
        return Validator(config, acting, knowledge, world, console)
    except MissingSplitError as error:
        console.print(f"no val scenes, so the last policies are exported ({error})", soft_wrap=True)
        return None


def _checked(config: RunConfig) -> RunConfig:
    """Return the config, complete and possible, its method checked.

    Raises:
      InputError: an impossible setting, or a method of another package that breaks the contract of methods.
    """
    config = check(config)
    if config.method not in METHODS:
        try:
            check_method(config.method, method_sizes=config.method_sizes)
        except Exception as error:  # whatever another's module raises
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise InputError(f"method {config.method!r}: fails check_method ({reason}); mend it") from error
    return config


def connected(config: RunConfig) -> Mesh | None:
    """Join other processes and return the mesh of devices.

    None where one device is enough.
    """
    devices = None if config.devices is None else Devices.parse(str(config.devices))
    if devices is None:
        return None
    devices.connect()
    return devices.mesh(config.seeds, config.ppo.num_envs, config.ppo.minibatches)


def _do_updates(
    config: RunConfig,
    trainer: Trainer,
    validator: Validator | None,
    world: CompiledWorld,
    order: Sequence[int],
    states: States,
    done: int,
    manifest: dict[str, Any],
    clock: Stopwatch,
    console: Console,
) -> States:
    """Train chunk by chunk.

    Each is in the next bank of scenes; between chunks the run measures its policies, logs, shows and saves.
    """
    steps, schedule = config.chunk * config.update_steps * config.seeds * len(states), config.schedule
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("compiling", total=config.total_updates, completed=done)
        left = range(done // config.chunk, len(order))
        began = time.monotonic()
        for turn, params in zip(left, read_ahead(world, [order[turn] for turn in left]), strict=True):
            if turn and order[turn] != order[turn - 1]:
                states = trainer.restart(states, params, schedule[turn])
            states, metrics = trainer.train(states, params, schedule[turn])
            done += config.chunk
            rate = steps / (time.monotonic() - began)
            if validator is not None and done in config.validated:
                present = {name: [each.params for each in seeds] for name, seeds in trainer.unpack(states).items()}
                scores = validator.measure(present, config.stages[schedule[turn]].adapts)
                if schedule[turn] == schedule[-1]:  # before that part of the policy has not learned
                    found = {name: [row[SCORE] for row in rows] for name, rows in scores.items()}
                    states = trainer.keep(states, found)
                metrics = {name: [a | b for a, b in zip(metrics[name], scores[name], strict=True)] for name in metrics}
            began = time.monotonic()
            if first_process():
                for name, seeds in metrics.items():
                    for seed, values in enumerate(seeds):
                        row = {"step": done, "arm": name, "seed": seed, "env_steps": done * config.update_steps}
                        append_row(config.run_dir / LOG_FILE, row | values)
                append_row(config.run_dir / TIMES_FILE, {"step": done} | clock.read())
            if done % (config.chunk * config.save_every) == 0 or done == config.total_updates:
                save(config.run_dir, done, trainer.unpack(states), manifest)
            success = {name: np.mean([values["success"] for values in seeds]) for name, seeds in metrics.items()}
            shares = ", ".join(f"{name} SR {100 * share:.0f} %" for name, share in success.items())
            skipped = sum(values["skipped_steps"] for seeds in metrics.values() for values in seeds)
            warning = f", {skipped:.0f} gradient steps skipped as not finite" if skipped else ""
            line = f"update {done}/{config.total_updates}, {rate / 1000:.0f} k steps/s, {shares}{warning}"
            progress.update(task, completed=done, description=line)
            if not console.is_terminal and (done // config.chunk) % 4 == 0:
                console.print(line)
    return states


def _exported(state: LearnerState) -> Params:
    """Return the policy that was kept, else the last one."""
    return jax.device_get(state.kept.params if state.kept.score >= 0 else state.params)


def _export(
    config: RunConfig,
    policies: Mapping[str, Sequence[Params]],
    setting: Setting,
    knowledge: Knowledge,
    explored: Exploration,
) -> None:
    """Export every seed's policy."""
    for name, seeds in policies.items():
        for seed, params in enumerate(seeds):
            folder = config.run_dir / POLICIES / f"{name}-{seed}"
            export_policy(folder, config, params, knowledge, setting if name == "layout" else None, explored)
