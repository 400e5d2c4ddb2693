"""Random input of every kind: scene files, exports, configurations, command lines, and what the importers read."""

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
from jaxnav.runs.policies import PACKAGED_POLICIES
from jaxnav.runs.policy import load_policy
from jaxnav.scenes.files.scene_file import write_scenes
from jaxnav.store.files import DIGEST_KEY, add_digest
from support import fuzz_importers
from support.fuzz_importers import NASTY, damaged, mutated
from support.tiny_world import BEDROOM, KITCHEN

#: Words of a command line, besides options and the names of commands.
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


def _scene_file(folder: Path, draw: random.Random) -> int:
    path = folder / "rooms.jsonl.gz"
    write_scenes(path, [KITCHEN, BEDROOM])
    if draw.random() < 0.3:
        path.write_bytes(damaged(path.read_bytes(), draw))
    else:
        scenes = [mutated(json.loads(line), draw) for line in gzip.decompress(path.read_bytes()).splitlines()]
        path.write_bytes(gzip.compress("\n".join(map(json.dumps, scenes)).encode()))
    return main(["scenes", "stats", str(path)])


def _export(folder: Path, draw: random.Random) -> int:
    export = shutil.copytree(PACKAGED_POLICIES / "rooms-org", folder / "export")
    if draw.random() < 0.3:
        file = draw.choice([export / "params.safetensors", export / "policy.json"])
        file.write_bytes(damaged(file.read_bytes(), draw))
    else:
        path = export / "policy.json"
        policy = json.loads(path.read_text())
        del policy[DIGEST_KEY]
        policy = mutated(policy, draw)
        # Signed again, so that the mutation itself is read; NaN cannot be signed.
        with contextlib.suppress(ValueError):
            policy = add_digest(policy) if isinstance(policy, dict) else policy
        path.write_text(json.dumps(policy))
    return run_command(lambda _: load_policy(export))


def _config(folder: Path, draw: random.Random) -> int:
    path = folder / "run.yaml"
    plain = json.loads(json.dumps(dataclasses.asdict(RunConfig()), default=str))
    fields = {name: plain[name] for name in draw.sample(sorted(plain), 8)}
    text = yaml.safe_dump(mutated(fields, draw), allow_unicode=draw.random() < 0.5).encode("utf-8", "replace")
    path.write_bytes(damaged(text, draw) if draw.random() < 0.3 else text)
    return run_command(lambda _: check_config(parse_config(RunConfig(), ["--config", str(path)], "jaxnav train", "")))


def _command_line(folder: Path, draw: random.Random) -> int:
    values = [str(value) for value in NASTY if value != "\ud800"]
    words = [draw.choice([*_WORDS, *_OPTIONS, *values]) for _ in range(draw.randrange(6))]
    if draw.random() < 0.5:
        return run_command(lambda _: check_config(parse_config(RunConfig(), words, "jaxnav train", "")))
    with contextlib.chdir(folder):
        return main([draw.choice([*_COMMANDS, *_WORDS]), *words])


_RUN_BY_KIND: dict[str, Callable[[Path, random.Random], int]] = {
    "scene file": _scene_file,
    "export": _export,
    "config": _config,
    "command line": _command_line,
}
_FORMAT_BY_KIND = {" ".join((form.name, *form.options)): form for form in fuzz_importers.FORMATS}
KINDS = (*_RUN_BY_KIND, *_FORMAT_BY_KIND)


def fuzz(kind: str, folder: Path, runs: int, seed: int) -> tuple[collections.Counter, float]:
    """Return runs by exit code, or by the error that ended them, and the seconds of the slowest."""
    if kind in _FORMAT_BY_KIND:
        return fuzz_importers.fuzz(_FORMAT_BY_KIND[kind], runs, seed)
    draw = random.Random(f"{kind} {seed}")
    codes = collections.Counter()
    slowest = 0.0
    for number in range(runs):
        run_folder = folder / str(number)
        run_folder.mkdir()
        start_time = time.perf_counter()
        try:
            code = _RUN_BY_KIND[kind](run_folder, draw)
        except SystemExit as end:  # of the parser
            code = end.code
        except Exception as error:
            code = f"{number}: {type(error).__name__}: {error}"
        slowest = max(slowest, time.perf_counter() - start_time)
        codes[code] += 1
        shutil.rmtree(run_folder)
    return codes, slowest


def _alone(kind: str, runs: int, seed: int) -> dict[str, object]:
    """Return the results of `fuzz`, and the peak memory of this process in MiB."""
    with tempfile.TemporaryDirectory() as folder:
        codes, slowest = fuzz(kind, Path(folder), runs, seed)
    status_lines = Path("/proc/self/status").read_text().splitlines()
    (peak,) = (line.split()[1] for line in status_lines if "VmHWM" in line)
    return {"codes": list(codes.items()), "slowest": slowest, "peak": int(peak) / 1024}


if __name__ == "__main__":
    print(json.dumps(_alone(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
