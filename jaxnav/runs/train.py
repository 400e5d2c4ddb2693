"""Training of a run, from the prior to the exported policies."""

import dataclasses
import json
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from jaxnav.env.objectnav import ObjectNav
from jaxnav.errors import InputError
from jaxnav.layout import SETTINGS, Setting
from jaxnav.policies.acting import Acting
from jaxnav.policies.methods import METHODS, Knowledge, find_method
from jaxnav.policies.testing import check_method
from jaxnav.runs.config import RunConfig, check
from jaxnav.runs.directory import LOG_FILE, Run, claim, settings
from jaxnav.runs.policies import POLICIES, export_policy
from jaxnav.runs.worlds import CompiledWorld, bank_order, read_ahead, training_world
from jaxnav.store.checkpoint import restore, save
from jaxnav.store.manifest import make_manifest
from jaxnav.store.runlog import append_row, truncate_after
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, calibrate, layout_priors
from jaxnav.training.devices import Devices, by_first_process, check_agreement, first_process
from jaxnav.training.exploration import Exploration, explore
from jaxnav.training.learner import Learner
from jaxnav.training.peers import watched
from jaxnav.training.trainer import Seeds, ShardedTrainer, States, Trainer, stage_at

_EXPLORE, _CALIBRATE = 2**31 - 1, 2**31 - 2  # purposes of keys; arms use 0, 1, ...


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
    started = time.monotonic()
    config = _checked(config)
    mesh = connected(config)
    if console is None or not first_process():
        console = Console(quiet=True)
    check_agreement(json.dumps(make_manifest(settings(config))))  # before the scenes, which may take long
    world = training_world(config, console)
    manifest = make_manifest(settings(config) | {"scenes_fingerprint": world.fingerprint})
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
    by_first_process(lambda: truncate_after(config.run_dir / LOG_FILE, done))
    if restored:
        console.print(f"resumed after update {done} of {config.total_updates}")
    states = _do_updates(config, trainer, world, order, states, done, manifest, console)
    seeds = trainer.unpack(states)
    by_first_process(lambda: _export(config, seeds, setting, knowledge, explored))
    console.print(f"{config.run_dir}: done in {time.monotonic() - started:.0f} s")
    return Run(config)


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


def explore_world(config: RunConfig, world: CompiledWorld) -> Exploration:
    """Walk the training scenes at random.

    The walks are divided among the banks.
    """
    key = jax.random.fold_in(jax.random.key(config.seed), _EXPLORE)
    walks = -(-config.layout.walks // len(world.banks))
    walk = jax.jit(explore, static_argnums=(0, 3, 4))
    explored = [
        walk(world.env, params, jax.random.fold_in(key, bank), walks, config.layout.steps)
        for bank, params in enumerate(read_ahead(world, range(len(world.banks))))
    ]
    whole = jax.tree.map(lambda *parts: sum(parts), *explored)
    if config.layout.prior == "room":
        return whole
    return whole._replace(counts=jax.numpy.broadcast_to(whole.counts.sum(axis=0), whole.counts.shape))


def calibrate_setting(config: RunConfig, world: CompiledWorld, explored: Exploration, console: Console) -> Setting:
    """Return the estimator's setting, complete.

    What the config leaves open is chosen in the training scenes (of the first bank).
    """
    setting, layout = SETTINGS[config.layout.setting], config.layout
    if setting.strength is None:
        return setting  # rows keep the sums of the counts
    key = jax.random.fold_in(jax.random.key(config.seed), _CALIBRATE)
    strengths = STRENGTHS if layout.strength is None else (layout.strength,)
    reductions = REDUCTIONS if layout.reduction is None else (layout.reduction,)
    chosen = calibrate(world.env, world.params(0), explored.counts, setting, key, strengths, reductions)
    console.print(
        f"layout estimator: prior rows of {chosen.setting.strength:g}, reduction {chosen.setting.reduction}; "
        f"gap {chosen.early:.2f} in the first views, {chosen.late:.2f} after twenty steps"
    )
    return chosen.setting


def learn_knowledge(config: RunConfig, world: CompiledWorld, explored: Exploration, setting: Setting) -> Knowledge:
    """Learn what is known before training.

    That is the layout priors, and what the method learns.
    """
    learn, layout = find_method(config.method).learn, layout_priors(explored.counts, setting)
    if learn is None:
        return Knowledge(layout)
    return Knowledge(layout, jax.tree.map(jax.numpy.asarray, learn(world.banks, np.asarray(explored.counts))))


def make_trainer(
    config: RunConfig, env: ObjectNav, setting: Setting, knowledge: Knowledge, mesh: Mesh | None = None
) -> Trainer:
    """Make the trainer of a run's arms and seeds.

    Args:
      config: the run's settings.
      env: the environment.
      setting: of the layout estimator; training has no use for its gap, which is left out.
      knowledge: what was learned before training.
      mesh: of devices; None for one device.
    """
    spec = config.policy_spec(len(env.categories))
    settings = {"baseline": None, "layout": dataclasses.replace(setting, gap="none")}
    learners = {
        name: Learner(Acting(env, spec, settings[name]), config.ppo, config.counterfactual) for name in config.arms
    }
    scalars, key = config.ppo.scalars(config.total_updates), jax.random.key(config.seed)
    arguments = learners, scalars, knowledge, key, config.seeds, config.chunk
    return Trainer(*arguments) if mesh is None else ShardedTrainer(*arguments, mesh=mesh)


def _do_updates(
    config: RunConfig,
    trainer: Trainer,
    world: CompiledWorld,
    order: Sequence[int],
    states: States,
    done: int,
    manifest: dict[str, Any],
    console: Console,
) -> States:
    """Train chunk by chunk.

    Each is in the next bank of scenes; between chunks the run logs, shows and saves.
    """
    stages = find_method(config.method).stages
    steps = config.chunk * config.update_steps * config.seeds * len(states)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("compiling", total=config.total_updates, completed=done)
        left = range(done // config.chunk, len(order))
        began = time.monotonic()
        for turn, params in zip(left, read_ahead(world, [order[turn] for turn in left]), strict=True):
            if turn and order[turn] != order[turn - 1]:
                states = trainer.restart(states, params)
            states, metrics = trainer.train(states, params, stage_at(stages, done / config.total_updates))
            done += config.chunk
            rate, began = steps / (time.monotonic() - began), time.monotonic()
            for name, seeds in metrics.items():
                for seed, values in enumerate(seeds if first_process() else ()):
                    row = {"step": done, "arm": name, "seed": seed, "env_steps": done * config.update_steps}
                    append_row(config.run_dir / LOG_FILE, row | values)
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


def _export(config: RunConfig, seeds: Seeds, setting: Setting, knowledge: Knowledge, explored: Exploration) -> None:
    """Export every seed's policy."""
    for name, states in seeds.items():
        for seed, state in enumerate(states):
            folder = config.run_dir / POLICIES / f"{name}-{seed}"
            export_policy(folder, config, state.params, knowledge, setting if name == "layout" else None, explored)
