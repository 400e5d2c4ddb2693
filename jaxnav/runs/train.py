"""Training of a run, from the prior to the exported policies."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax
from jax.sharding import Mesh
from rich.console import Console

from jaxnav.env.types import EnvParams
from jaxnav.errors import InputError, MissingSplitError
from jaxnav.layout import Setting
from jaxnav.policies.methods import METHODS, Knowledge
from jaxnav.policies.policy import Params
from jaxnav.policies.testing import check_method
from jaxnav.runs.check import check
from jaxnav.runs.config import RunConfig
from jaxnav.runs.directory import REACH_FILE, Run, claimed, settings
from jaxnav.runs.exports import export_policy
from jaxnav.runs.logs import TIMES_FILE, Logs
from jaxnav.runs.policies import POLICIES
from jaxnav.runs.prepare import calibrate_setting, explore_world, learn_knowledge, make_trainer, say_what_is_cut
from jaxnav.runs.stopwatch import Stopwatch
from jaxnav.runs.updates import do_updates
from jaxnav.runs.validation import Validator
from jaxnav.runs.worlds import CompiledWorld, bank_order, sample_bank, training_world
from jaxnav.store.checkpoint import restore, set_aside_after
from jaxnav.store.lock import Lock
from jaxnav.store.manifest import make_manifest
from jaxnav.store.signed import write_signed
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
      InputError: an impossible setting, a run directory that holds something else or is in use, or damaged files.
      Interrupted: Ctrl-C or SIGTERM came while it trained; it is saved, and the same call goes on from there.
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
    with claimed(config) as lock:
        _train(config, world, manifest, mesh, lock, clock, console)
    return Run(config)


def _train(
    config: RunConfig,
    world: CompiledWorld,
    manifest: dict[str, Any],
    mesh: Mesh | None,
    lock: Lock,
    clock: Stopwatch,
    console: Console,
) -> None:
    """Train in a run directory that is held."""
    say_what_is_cut(config, console)
    explored = explore_world(config, world)
    console.print(f"layout prior from {int(explored.steps):,} random steps, {int(explored.poses):,} distinct poses")
    setting = calibrate_setting(config, world, explored, console)
    knowledge = learn_knowledge(config, world, explored, setting)
    trainer = make_trainer(config, world.env, setting, knowledge, mesh)
    order = bank_order(world, config.seed, config.total_updates // config.chunk)
    if len(world.banks) > 1:
        console.print(
            f"one shard after the other: {len(order)} turns in {len(set(order))} of {len(world.banks)} shards"
        )
    states, done = _resumed(config, trainer, world.params(order[0]), manifest, console)
    clock = clock.resume(config.run_dir / TIMES_FILE)
    finished = done == config.total_updates and (config.run_dir / REACH_FILE).exists()
    validator = None if finished else _validator(config, trainer, knowledge, world, console)
    states = do_updates(config, trainer, validator, world, order, states, done, manifest, lock, clock, console)
    kept = {name: [_exported(state) for state in seeds] for name, seeds in trainer.unpack(states).items()}
    by_first_process(lambda: _export(config, kept, setting, knowledge, explored))
    if validator is not None:
        reach = validator.reach(kept)
        by_first_process(lambda: write_signed(config.run_dir / REACH_FILE, reach))
    console.print(f"{config.run_dir}: done in {clock.read()['wall_s']:.0f} s")


def _resumed(
    config: RunConfig, trainer: Trainer, first: EnvParams, manifest: dict[str, Any], console: Console
) -> tuple[States, int]:
    """Return the state to go on from, and its updates.

    What is later in the run directory is dropped: damaged checkpoints, and rows that will be logged again.
    """
    restored = restore(config.run_dir, trainer.abstract(first), manifest)
    for problem in restored.damaged if restored else ():
        console.print(f"{problem}; moved to {config.run_dir / 'damaged'}")
    done = restored.step if restored else 0
    by_first_process(lambda: set_aside_after(config.run_dir, done))
    by_first_process(lambda: Logs(config).rewind(done))
    if restored is None:
        return trainer.init(first), 0
    console.print(f"resumed after update {done} of {config.total_updates}")
    return trainer.pack(restored.state), done


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
        console.print(f"no val scenes, so the last policies are exported ({error})")
        return None


def _checked(config: RunConfig) -> RunConfig:
    """Return the config, complete and possible, its method checked.

    Raises:
      InputError: an impossible setting, or a method of another package that breaks the contract of methods.
    """
    config = check(config)
    if config.method not in METHODS:
        bank = sample_bank(config)
        try:
            check_method(config.method, method_sizes=config.method_sizes, bank=bank)
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
