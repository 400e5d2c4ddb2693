"""The training command: prior, two arms of N seeds, checkpoints, and the policies at the end."""

import dataclasses
import json
import time
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from jaxnav.cli.command import exit_code
from jaxnav.cli.options import parse
from jaxnav.env.objectnav import ObjectNav
from jaxnav.layout import SETTINGS, Setting
from jaxnav.runs.config import RunConfig, check
from jaxnav.runs.directory import LOG_FILE, POLICIES, claim, settings
from jaxnav.runs.worlds import CompiledWorld, bank_order, read_ahead, training_world
from jaxnav.store.checkpoint import restore, save
from jaxnav.store.export import export_params
from jaxnav.store.manifest import make_manifest
from jaxnav.store.runlog import append_row, truncate_after
from jaxnav.training.calibration import REDUCTIONS, STRENGTHS, calibrate, layout_priors
from jaxnav.training.devices import Devices, by_first_process, check_agreement, first_process
from jaxnav.training.exploration import Exploration, explore
from jaxnav.training.trainer import Arms, ShardedArms, States

_EXPLORE, _CALIBRATE = 2**31 - 1, 2**31 - 2  # purposes of keys; arms use 0, 1, ...


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    what = "Train a method with and without the layout estimator."
    return exit_code(lambda console: train(check(parse(RunConfig(), arguments, "train.py", what)), console))


def train(config: RunConfig, console: Console) -> None:
    """Train all arms and seeds of a run, from its last checkpoint if it has one, and export the policies."""
    started = time.monotonic()
    mesh = connected(config)
    if not first_process():
        console = Console(quiet=True)
    world = training_world(config, console)
    manifest = make_manifest(settings(config) | {"scenes_fingerprint": world.fingerprint})
    check_agreement(json.dumps(manifest))
    by_first_process(lambda: claim(config))

    found = explored(config, world)
    console.print(f"layout prior from {int(found.steps):,} random steps, {int(found.poses):,} distinct poses")
    setting = calibrated(config, world, found, console)
    priors = layout_priors(found.counts, setting)

    parts = config, world.env, setting, priors
    arms = ShardedArms(*parts, mesh) if mesh else Arms(*parts)
    order = bank_order(world, config.seed, config.total_updates // config.chunk)
    if len(world.banks) > 1:
        console.print(
            f"one shard after the other: {len(order)} turns in {len(set(order))} of {len(world.banks)} shards"
        )
    first = world.params(order[0])
    restored = restore(config.run_dir, arms.abstract(first), manifest)
    states, done = restored or (arms.init(first), 0)
    by_first_process(lambda: truncate_after(config.run_dir / LOG_FILE, done))
    if restored:
        console.print(f"resumed after update {done} of {config.total_updates}")
    states = _updates(config, arms, world, order, states, done, manifest, console)
    by_first_process(lambda: _export(config, world.env, states, setting, priors, found))
    console.print(f"{config.run_dir}: done in {time.monotonic() - started:.0f} s")


def connected(config: RunConfig) -> Mesh | None:
    """The devices that are asked for, other processes joined; None where one is enough."""
    devices = None if config.devices is None else Devices.parse(str(config.devices))
    if devices is None:
        return None
    devices.connect()
    return devices.mesh(config.seeds, config.ppo.num_envs, config.ppo.minibatches)


def explored(config: RunConfig, world: CompiledWorld) -> Exploration:
    """What random walks find in the training scenes, the walks divided among the banks."""
    key = jax.random.fold_in(jax.random.key(config.seed), _EXPLORE)
    walks = -(-config.layout.walks // len(world.banks))
    walk = jax.jit(explore, static_argnums=(0, 3, 4))
    found = [
        walk(world.env, params, jax.random.fold_in(key, bank), walks, config.layout.steps)
        for bank, params in enumerate(read_ahead(world, range(len(world.banks))))
    ]
    return jax.tree.map(lambda *parts: sum(parts), *found)


def calibrated(config: RunConfig, world: CompiledWorld, found: Exploration, console: Console) -> Setting:
    """The estimator's setting, what it leaves open chosen in the training scenes (of the first bank)."""
    setting, layout = SETTINGS[config.layout.setting], config.layout
    if setting.strength is None:
        return setting  # rows keep the sums of the counts
    key = jax.random.fold_in(jax.random.key(config.seed), _CALIBRATE)
    strengths = STRENGTHS if layout.strength is None else (layout.strength,)
    reductions = REDUCTIONS if layout.reduction is None else (layout.reduction,)
    chosen = calibrate(world.env, world.params(0), found.counts, setting, key, strengths, reductions)
    console.print(
        f"layout estimator: prior rows of {chosen.setting.strength:g}, reduction {chosen.setting.reduction}; "
        f"gap {chosen.early:.2f} in the first views, {chosen.late:.2f} after twenty steps"
    )
    return chosen.setting


def _updates(
    config: RunConfig,
    arms: Arms,
    world: CompiledWorld,
    order: list[int],
    states: States,
    done: int,
    manifest: dict[str, Any],
    console: Console,
) -> States:
    """Train chunk by chunk, each in the next bank of scenes; between chunks log, show and save."""
    steps = config.chunk * config.update_steps * config.seeds * len(states)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("compiling", total=config.total_updates, completed=done)
        left = range(done // config.chunk, len(order))
        began = time.monotonic()
        for turn, params in zip(left, read_ahead(world, [order[turn] for turn in left]), strict=True):
            if turn and order[turn] != order[turn - 1]:
                states = arms.restart(states, params)
            states, metrics = arms.train(states, params)
            done += config.chunk
            rate, began = steps / (time.monotonic() - began), time.monotonic()
            for name, seeds in metrics.items():
                for seed, values in enumerate(seeds if first_process() else ()):
                    row = {"step": done, "arm": name, "seed": seed, "env_steps": done * config.update_steps}
                    append_row(config.run_dir / LOG_FILE, row | values)
            if done % (config.chunk * config.save_every) == 0 or done == config.total_updates:
                save(config.run_dir, done, states, manifest)
            success = {name: np.mean([values["success"] for values in seeds]) for name, seeds in metrics.items()}
            shares = ", ".join(f"{name} SR {100 * share:.0f} %" for name, share in success.items())
            skipped = sum(values["skipped_steps"] for seeds in metrics.values() for values in seeds)
            warning = f", {skipped:.0f} gradient steps skipped as not finite" if skipped else ""
            line = f"update {done}/{config.total_updates}, {rate / 1000:.0f} k steps/s, {shares}{warning}"
            progress.update(task, completed=done, description=line)
            if not console.is_terminal and (done // config.chunk) % 4 == 0:
                console.print(line)
    return states


def _export(
    config: RunConfig, env: ObjectNav, states: States, setting: Setting, priors: jax.Array, found: Exploration
) -> None:
    """Write every seed's policy with the prior it was trained with."""
    for name, seeds in states.items():
        spec = {
            "method": config.method,
            "categories": list(env.categories),
            "task": dataclasses.asdict(env.task),
            "sizes": dataclasses.asdict(config.sizes),
            "direct": config.direct,
            "done_gate": config.done_gate,
            "layout": dataclasses.asdict(setting) if name == "layout" else None,
            "prior_steps": int(found.steps),
            "prior_poses": int(found.poses),
        }
        for seed, state in enumerate(seeds):
            tensors = {
                "policy": jax.device_get(state.params),
                "layout": {"prior": np.asarray(priors), "counts": np.asarray(found.counts)},
            }
            export_params(config.run_dir / POLICIES / f"{name}-{seed}", tensors, spec)
