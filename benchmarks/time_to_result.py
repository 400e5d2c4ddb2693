"""Where the seconds of `make run` go: `python benchmarks/time_to_result.py [OPTIONS OF train.py]`.

Runs train.py's command and then eval.py's, each in a process of its own, in a temporary run directory. Public functions
are timed from outside, compilation by JAX's own events; where spans overlap a second belongs to the label that stands
first in `LABELS`. Training cannot be looked into from outside: it is divided by the rollout's share of an update, which
is measured afterwards.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from _common import in_turns, report
from _phases import phases

import jaxnav.cli.eval
import jaxnav.cli.train
from jaxnav.cli.options import parse
from jaxnav.env.make import make
from jaxnav.layout import SETTINGS
from jaxnav.runs.config import RunConfig
from jaxnav.training.calibration import layout_priors
from jaxnav.training.exploration import explore
from jaxnav.training.trainer import Arms

TIMED: dict[str, tuple[tuple[Any, str], ...]] = {
    "scenes": ((jaxnav.cli.train, "training_world"), (jaxnav.cli.eval, "evaluation_world")),
    "prior": ((jaxnav.cli.train, "explored"),),
    "calibration": ((jaxnav.cli.train, "calibrated"),),
    "training": ((Arms, "init"), (Arms, "train")),
    "checkpoints": ((jaxnav.cli.train, "restore"), (jaxnav.cli.train, "save"), (jaxnav.cli.train, "export_params")),
    "evaluation": ((jaxnav.cli.eval, "evaluate_grid"),),
    "report": tuple(
        (jaxnav.cli.eval, name)
        for name in ("oracle_outcome", "build_row", "build_difference", "build_report", "write_report", "write_atomic")
    ),
}
LABELS = ("imports", "compile", *TIMED)
COMMANDS = {"train.py": jaxnav.cli.train.main, "eval.py": jaxnav.cli.eval.main}
TURNS = 5
Spans = dict[str, list[tuple[float, float]]]


def main(options: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        run = str(Path(folder) / "run")
        found = {
            "train.py": timed("train.py", [*options, "--run-dir", run], Path(folder) / "train.json"),
            "eval.py": timed("eval.py", [run], Path(folder) / "eval.json"),
        }
    share = rollout_share(parse(RunConfig(), options, "train.py", ""))
    training = found["train.py"].pop("training")
    found["train.py"] |= {"rollout": round(share * training, 2), "learning": round((1 - share) * training, 2)}
    wall = {command: round(sum(seconds.values()), 2) for command, seconds in found.items()}
    report(
        {
            "options": options,
            "wall_s": wall | {"both": round(sum(wall.values()), 2)},
            "rollout_share_of_update": round(share, 3),
            "seconds": found,
        }
    )


def timed(command: str, arguments: list[str], target: Path) -> dict[str, float]:
    """Seconds of every label of one command, and of what has none."""
    print(command, *arguments, file=sys.stderr, flush=True)
    began = time.time()
    own = [sys.executable, __file__, "--timed", command, str(target), str(began)]
    subprocess.run([*own, *arguments], check=True, stdout=subprocess.DEVNULL)
    wall = time.time() - began
    found = {label: seconds for label, seconds in json.loads(target.read_text()).items() if seconds}
    return {name: round(seconds, 2) for name, seconds in (found | {"other": wall - sum(found.values())}).items()}


def run_timed(command: str, target: str, began: str, *arguments: str) -> None:
    """Run one command in this process, which the parent started at `began`, and write what its seconds went to."""
    spans: Spans = {"imports": [(float(began), time.time())]}

    def timer(label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.time()
            result = function(*args, **kwargs)
            spans.setdefault(label, []).append((began, time.time()))
            return result

        return call

    def compiled(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            spans.setdefault("compile", []).append((time.time() - duration_secs, time.time()))

    jax.monitoring.register_event_duration_secs_listener(compiled)
    for label, places in TIMED.items():
        for owner, name in places:
            setattr(owner, name, timer(label, getattr(owner, name)))
    code = COMMANDS[command](list(arguments))
    Path(target).write_text(json.dumps(painted(spans)))
    sys.exit(code)


def painted(spans: Spans) -> dict[str, float]:
    """Seconds of each label that no label before it has."""
    seen: list[tuple[float, float]] = []
    found, before = {}, 0.0
    for label in LABELS:
        seen += spans.get(label, [])
        total, reached = 0.0, 0.0
        for start, stop in sorted(seen):
            total += max(0.0, stop - max(start, reached))
            reached = max(reached, stop)
        found[label], before = total - before, total
    return found


def rollout_share(config: RunConfig) -> float:
    """The rollout's share of the arms' updates."""
    env, params = make(config.world)
    counts = jax.jit(explore, static_argnums=0)(env, params, jax.random.key(0)).counts
    setting = SETTINGS[config.layout.setting]
    priors = layout_priors(counts, setting)
    programs = phases(Arms(config, env, setting, priors), config, params, priors)
    taken = in_turns({name: program.call for name, program in programs.items()}, TURNS)
    rolling = sum(min(seconds) for name, seconds in taken.items() if name.endswith("rollout"))
    return rolling / sum(min(seconds) for name, seconds in taken.items() if name.endswith("update"))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--timed"]:
        run_timed(*sys.argv[2:])
    else:
        main(sys.argv[1:])
