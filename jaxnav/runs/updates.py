"""The updates of a training run, chunk by chunk."""

from collections.abc import Sequence
from typing import Any

from rich.console import Console

from jaxnav.errors import Interrupted
from jaxnav.runs.config import RunConfig
from jaxnav.runs.interrupts import Interrupts
from jaxnav.runs.logs import Logs
from jaxnav.runs.progress import Shown
from jaxnav.runs.stopwatch import Stopwatch
from jaxnav.runs.validation import SCORE, Validator
from jaxnav.runs.worlds import CompiledWorld, read_ahead
from jaxnav.store.checkpoint import save
from jaxnav.store.lock import Lock
from jaxnav.store.runlog import Row
from jaxnav.training.devices import by_first_process, first_process
from jaxnav.training.trainer import Metrics, States, Trainer


def do_updates(
    config: RunConfig,
    trainer: Trainer,
    validator: Validator | None,
    world: CompiledWorld,
    order: Sequence[int],
    states: States,
    done: int,
    manifest: dict[str, Any],
    lock: Lock,
    clock: Stopwatch,
    console: Console,
) -> States:
    """Train chunk by chunk.

    Each is in the next bank of scenes; between chunks the run measures its policies, logs, shows and saves.

    Raises:
      Interrupted: a signal asked for an end; the chunk is saved.
    """
    schedule, logs = config.schedule, Logs(config)
    left = range(done // config.chunk, len(order))
    with Shown(config, done, console) as shown, Interrupts() as interrupts:
        for turn, params in zip(left, read_ahead(world, [order[turn] for turn in left]), strict=True):
            if turn and order[turn] != order[turn - 1]:
                states = trainer.restart(states, params, schedule[turn])
            states, metrics = trainer.train(states, params, schedule[turn])
            done += config.chunk
            shown.trained()
            if validator is not None and done in config.validated:
                present = {name: [each.params for each in seeds] for name, seeds in trainer.unpack(states).items()}
                scores = validator.measure(present, config.stages[schedule[turn]].adapts)
                if schedule[turn] == schedule[-1]:  # before that part of the policy has not learned
                    found = {name: [row[SCORE] for row in rows] for name, rows in scores.items()}
                    states = trainer.keep(states, found)
                metrics = {name: [a | b for a, b in zip(metrics[name], scores[name], strict=True)] for name in metrics}
            stopping = interrupts.asked()
            by_first_process(lock.check)
            if first_process():
                logs.append(_rows(config, metrics, done), {"step": done} | clock.read())
            if stopping or done % (config.chunk * config.save_every) == 0 or done == config.total_updates:
                save(config.run_dir, done, trainer.unpack(states), manifest)
            shown.tell(metrics, done)
            if stopping:
                raise _interrupted(config, stopping, done)
        if stopping := interrupts.asked():  # during the last save
            raise _interrupted(config, stopping, done)
    return states


def _interrupted(config: RunConfig, number: int, done: int) -> Interrupted:
    return Interrupted(number, f"{config.run_dir}: stopped after update {done} of {config.total_updates} and saved")


def _rows(config: RunConfig, metrics: Metrics, done: int) -> list[Row]:
    """Return the rows of a chunk in the log."""
    return [
        {"step": done, "arm": name, "seed": seed, "env_steps": done * config.update_steps} | values
        for name, seeds in metrics.items()
        for seed, values in enumerate(seeds)
    ]
