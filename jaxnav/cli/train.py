"""The training command: prior, two arms of N seeds, checkpoints, and the policies at the end."""

import dataclasses
import sys
import time
import zlib
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from jaxnav.cli.arms import Arms, States
from jaxnav.cli.config import RunConfig, check
from jaxnav.cli.options import parse_run
from jaxnav.cli.runs import LOG_FILE, POLICIES, claim, settings
from jaxnav.env.make import build_training, in_split, load_scenes
from jaxnav.env.objectnav import ObjectNav
from jaxnav.errors import InputError
from jaxnav.layout import prior_from_counts
from jaxnav.scenes.compile import Bank, compile_bank
from jaxnav.store.checkpoint import restore, save
from jaxnav.store.export import export_params
from jaxnav.store.manifest import make_manifest
from jaxnav.store.runlog import append_row, truncate_after
from jaxnav.training.exploration import Exploration, explore

_EXPLORE = 2**31 - 1  # purpose of the prior's key; seeds use 0, 1, ...


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0, or 2 after bad input."""
    console = Console(stderr=True, highlight=False)
    try:
        train(check(parse_run(sys.argv[1:] if arguments is None else arguments)), console)
    except InputError as error:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def train(config: RunConfig, console: Console) -> None:
    """Train all arms and seeds of a run, from its last checkpoint if it has one, and export the policies."""
    started = time.monotonic()
    bank = training_bank(config)
    env, params = build_training(bank, config.worlds.train_step_limit)
    console.print(f"{len(bank.names)} training scenes, {len(bank.rows):,} poses ({len(bank.skipped)} skipped)")
    claim(config)
    manifest = make_manifest(settings(config) | {"scenes_crc32": checksum(bank)})

    key = jax.random.fold_in(jax.random.key(config.seed), _EXPLORE)
    found = jax.jit(explore, static_argnums=(0, 3, 4))(env, params, key, config.layout.walks, config.layout.steps)
    priors = jax.vmap(lambda counts: prior_from_counts(counts, config.layout.setting))(found.counts)
    console.print(f"layout prior from {int(found.steps):,} random steps, {int(found.poses):,} distinct poses")

    arms = Arms(config, env, params, priors)
    restored = restore(config.run_dir, jax.eval_shape(arms.init), manifest)
    states, done = restored or (arms.init(), 0)
    truncate_after(config.run_dir / LOG_FILE, done)
    if restored:
        console.print(f"resumed after update {done} of {config.total_updates}")
    states = _updates(config, arms, states, done, manifest, console)
    _export(config, env, states, priors, found)
    console.print(f"{config.run_dir}: done in {time.monotonic() - started:.0f} s")


def training_bank(config: RunConfig) -> Bank:
    """The compiled training scenes of a run."""
    worlds = config.worlds
    scenes = load_scenes(config.source, worlds.num_train, worlds.num_val, worlds.num_test, worlds.seed)
    return compile_bank(in_split(scenes, "train", config.source), detector=config.detector)


def checksum(bank: Bank) -> int:
    """CRC-32 of everything in a bank."""
    crc = 0
    for part in bank:
        crc = zlib.crc32(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode(), crc)
    return crc


def _updates(
    config: RunConfig, arms: Arms, states: States, done: int, manifest: dict[str, Any], console: Console
) -> States:
    """Train chunk by chunk; between chunks log, show and save."""
    steps = config.chunk * config.update_steps * config.seeds * len(states)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("compiling", total=config.total_updates, completed=done)
        while done < config.total_updates:
            began = time.monotonic()
            states, metrics = arms.train(states)
            done += config.chunk
            rate = steps / (time.monotonic() - began)
            for name, seeds in metrics.items():
                for seed, values in enumerate(seeds):
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


def _export(config: RunConfig, env: ObjectNav, states: States, priors: jax.Array, found: Exploration) -> None:
    """Write every seed's policy with the prior it was trained with."""
    for name, seeds in states.items():
        spec = {
            "method": config.method,
            "categories": list(env.categories),
            "sizes": dataclasses.asdict(config.sizes),
            "layout": config.layout.setting if name == "layout" else None,
            "prior_steps": int(found.steps),
            "prior_poses": int(found.poses),
        }
        for seed, state in enumerate(seeds):
            tensors = {"policy": jax.device_get(state.params), "layout": {"prior": np.asarray(priors)}}
            export_params(config.run_dir / POLICIES / f"{name}-{seed}", tensors, spec)
