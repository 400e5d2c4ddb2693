"""Random input of every kind: scene files, exports, configurations, command lines, and files for the importers."""

import collections
import contextlib
import dataclasses
import gzip
import json
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import yaml

from jaxnav.__main__ import main
from jaxnav.cli.console import parse_config, run_command
from jaxnav.runs.config import RunConfig, check_config
from jaxnav.runs.loaded_policy import load_policy
from jaxnav.runs.policies import PACKAGED_POLICIES
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.store.files import DIGEST_KEY, add_digest
from support import fuzz_importers
from support.fuzz_importers import NASTY, damaged, randomly_mutated
from support.tiny_world import BEDROOM, KITCHEN

#: Words of a command line that are neither options nor names of commands.
_WORDS = ("", "-1", "0", "7", "1e999", "nan", "10" * 40, "rooms", "val", "none", "a=b", "--", "-h", "[/x]", "\x1b[0m")
_OPTIONS = ("--run-dir", "--seeds", "--config", "--split", "--epsilon", "--episodes", "--seed", "--scenes", "--out")
_COMMANDS = (
    "eval",
    "sweep",
    "account",
    "mixture",
    "report",
    "export",
    "episode",
    "table",
    "scenes",
    "help",
    "completion",
)


def _run_on_scene_file(folder: Path, rng: random.Random) -> int:
    """Print the statistics of a scene file with damaged bytes or mutated scenes."""
    path = folder / "rooms.jsonl.gz"
    write_scenes(path, [KITCHEN, BEDROOM])
    if rng.random() < 0.3:
        path.write_bytes(damaged(path.read_bytes(), rng))
    else:
        scenes = [randomly_mutated(json.loads(line), rng) for line in gzip.decompress(path.read_bytes()).splitlines()]
        path.write_bytes(gzip.compress("\n".join(map(json.dumps, scenes)).encode()))
    return main(["scenes", "stats", str(path)])


def _run_on_export(folder: Path, rng: random.Random) -> int:
    """Load an export with damaged bytes or a mutated description."""
    export = shutil.copytree(PACKAGED_POLICIES / "rooms-org", folder / "export")
    if rng.random() < 0.3:
        file = rng.choice([export / "params.safetensors", export / "policy.json"])
        file.write_bytes(damaged(file.read_bytes(), rng))
    else:
        path = export / "policy.json"
        policy = json.loads(path.read_text())
        del policy[DIGEST_KEY]
        policy = randomly_mutated(policy, rng)
        # A new digest, so that the mutation is not refused as damage; there is none for NaN.
        with contextlib.suppress(ValueError):
            policy = add_digest(policy) if isinstance(policy, dict) else policy
        path.write_text(json.dumps(policy))
    return run_command(lambda _: load_policy(export))


def _run_on_config(folder: Path, rng: random.Random) -> int:
    """Check a configuration file of eight mutated settings, some with damaged bytes."""
    path = folder / "run.yaml"
    settings = json.loads(json.dumps(dataclasses.asdict(RunConfig()), default=str))
    chosen_settings = {name: settings[name] for name in rng.sample(sorted(settings), 8)}
    mutated_settings = randomly_mutated(chosen_settings, rng)
    text = yaml.safe_dump(mutated_settings, allow_unicode=rng.random() < 0.5).encode("utf-8", "replace")
    path.write_bytes(damaged(text, rng) if rng.random() < 0.3 else text)
    return _check_arguments(["--config", str(path)])


def _run_command_line(folder: Path, rng: random.Random) -> int:
    """Check up to five random words as arguments of the train command, or run them after a random command."""
    values = [str(value) for value in NASTY if value != "\ud800"]
    words = [rng.choice([*_WORDS, *_OPTIONS, *values]) for _ in range(rng.randrange(6))]
    if rng.random() < 0.5:
        return _check_arguments(words)
    with contextlib.chdir(folder):
        return main([rng.choice([*_COMMANDS, *_WORDS]), *words])


def _check_arguments(words: list[str]) -> int:
    """Read the arguments of the train command, and return the exit code."""
    return run_command(lambda _: check_config(parse_config(RunConfig(), words, "jaxnav train", "")))


_RUN_BY_KIND: dict[str, Callable[[Path, random.Random], int]] = {
    "scene file": _run_on_scene_file,
    "export": _run_on_export,
    "config": _run_on_config,
    "command line": _run_command_line,
}
_FORMAT_BY_KIND = {
    " ".join((scene_format.name, *scene_format.options)): scene_format for scene_format in fuzz_importers.FORMATS
}
KINDS = (*_RUN_BY_KIND, *_FORMAT_BY_KIND)


def fuzz(kind: str, folder: Path, num_runs: int, seed: int) -> tuple[collections.Counter, float]:
    """Return the number of runs by exit code, or by the error that ended them, and the seconds of the slowest run."""
    if kind in _FORMAT_BY_KIND:
        return fuzz_importers.fuzz(_FORMAT_BY_KIND[kind], num_runs, seed)

    rng = random.Random(f"{kind} {seed}")
    exit_codes = collections.Counter()
    slowest_s = 0.0
    for run_index in range(num_runs):
        run_folder = folder / str(run_index)
        run_folder.mkdir()
        start_time = time.perf_counter()
        try:
            exit_code = _RUN_BY_KIND[kind](run_folder, rng)
        except SystemExit as parser_exit:
            exit_code = parser_exit.code
        except Exception as error:
            exit_code = f"{run_index}: {type(error).__name__}: {error}"
        slowest_s = max(slowest_s, time.perf_counter() - start_time)
        exit_codes[exit_code] += 1
        shutil.rmtree(run_folder)
    return exit_codes, slowest_s


def _fuzz_and_measure(kind: str, num_runs: int, seed: int) -> dict[str, object]:
    """Return the results of `fuzz`, and the peak memory of this process in MiB."""
    with tempfile.TemporaryDirectory() as folder:
        exit_codes, slowest_s = fuzz(kind, Path(folder), num_runs, seed)
    status_lines = Path("/proc/self/status").read_text().splitlines()
    (peak_kib,) = (line.split()[1] for line in status_lines if "VmHWM" in line)
    return {"codes": list(exit_codes.items()), "slowest": slowest_s, "peak": int(peak_kib) / 1024}


if __name__ == "__main__":
    print(json.dumps(_fuzz_and_measure(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
