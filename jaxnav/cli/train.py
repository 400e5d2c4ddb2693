"""The training command: prior, two arms of N seeds, checkpoints, and the policies at the end."""

import dataclasses
import json
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from jaxnav.cli.arms import Arms, States
from jaxnav.cli.config import RunConfig, check
from jaxnav.cli.options import parse_run
from jaxnav.cli.overlay import apply_yaml
from jaxnav.env.make import build_for, in_split, load_scenes
from jaxnav.env.objectnav import ObjectNav
from jaxnav.errors import InputError
from jaxnav.layout import prior_from_counts
from jaxnav.scenes.compile import Bank, compile_bank
from jaxnav.store.checkpoint import restore, save
from jaxnav.store.export import export_params
from jaxnav.store.files import write_atomic
from jaxnav.store.manifest import differences, make_manifest
from jaxnav.store.runlog import append_row, truncate_after
from jaxnav.training.exploration import Exploration, explore

CONFIG_FILE, LOG_FILE, POLICIES = "config.json", "metrics.jsonl", "policies"
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
    env, params = build_for(bank, "train", config.worlds.train_step_limit)
    console.print(f"{len(bank.names)} training scenes, {len(bank.rows):,} poses ({len(bank.skipped)} skipped)")
    plain = settings(config)
    _claim(config.run_dir, plain)
    manifest = make_manifest(plain | {"scenes_crc32": zlib.crc32(bank.rows.tobytes())})

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


def settings(config: RunConfig) -> dict[str, Any]:
    """What makes a run the run it is: all its settings but where it is kept and how often it is saved."""
    plain = dataclasses.asdict(config) | {"scenes": str(config.scenes) if config.scenes else None}
    return {name: value for name, value in plain.items() if name not in ("run_dir", "save_every")}


def load_run(run_dir: Path) -> RunConfig:
    """Settings of an earlier run.

    Raises:
      InputError: the directory holds no run, or its config file is damaged.
    """
    path = run_dir / CONFIG_FILE
    if not path.exists():
        raise InputError(f"{run_dir}: holds no run ({CONFIG_FILE} is missing); train one there first")
    return dataclasses.replace(apply_yaml(RunConfig(), path), run_dir=run_dir)


def _claim(run_dir: Path, config: dict[str, Any]) -> None:
    """Make the run directory ours, or refuse if it holds another run."""
    path = run_dir / CONFIG_FILE
    if path.exists():
        if different := differences(settings(load_run(run_dir)), config):
            raise InputError(
                f"{run_dir}: holds another run (there != asked for): {'; '.join(different)}; "
                "choose another --run-dir or the same settings"
            )
        return
    if run_dir.exists() and not run_dir.is_dir():
        raise InputError(f"{run_dir}: is a file; choose another --run-dir")
    # A kill while the config is written leaves its temporary file alone in the directory.
    if run_dir.exists() and any(not item.match(f".{CONFIG_FILE}.*.tmp") for item in run_dir.iterdir()):
        raise InputError(f"{run_dir}: is not empty and holds no run; choose another --run-dir")
    write_atomic(path, (json.dumps(config, indent=2) + "\n").encode())


def _updates(
    config: RunConfig, arms: Arms, states: States, done: int, manifest: dict[str, Any], console: Console
) -> States:
    """Train chunk by chunk; between chunks log, show and save."""
    steps = config.chunk * config.ppo.num_envs * config.ppo.rollout * config.seeds * len(states)
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
                    append_row(config.run_dir / LOG_FILE, {"step": done, "arm": name, "seed": seed} | values)
            if done % (config.chunk * config.save_every) == 0 or done == config.total_updates:
                save(config.run_dir, done, states, manifest)
            success = {name: np.mean([values["success"] for values in seeds]) for name, seeds in metrics.items()}
            rates = ", ".join(f"{name} SR {100 * rate:.0f} %" for name, rate in success.items())
            line = f"update {done}/{config.total_updates}, {rate / 1000:.0f} k steps/s, {rates}"
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
