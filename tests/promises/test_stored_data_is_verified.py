"""What a run reads back is what it wrote: damage is told, and never used.

Seen to fail, each planted alone: the digests of a checkpoint, of a record, the checksum of a shard, the SHA-256 of an
export not compared; rows of a log not counted; shapes or values of an export not checked.
"""

import collections
import dataclasses
import functools
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from support.commands import train
from support.corridors import compile_corridors
from support.damage import damage
from support.tiny_run import POLICY_NAMES, finished_run, tiny_config

from jaxnav.errors import InputError
from jaxnav.runs.policies import PACKAGED_POLICIES
from jaxnav.runs.policy import load_policy
from jaxnav.runs.run import CONFIG_FILE, LOG_FILE, REACH_FILE, TIMES_FILE, Run, RunLogs, claim_run_dir, run_settings
from jaxnav.store import checkpoint
from jaxnav.store.export import export_params, load_params
from jaxnav.store.files import make_manifest, write_json_with_digest

MANIFEST = make_manifest({"seed": 1})
CHUNKS = 4
#: Damages of each kind of stored file in the slow tests.
NUM_DAMAGES = int(os.environ.get("JAXNAV_DAMAGES", "30"))


class Stored(NamedTuple):
    """Describe something that is stored: how it is written to a folder, read from it, and which part is damaged."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    part: str = ""


def state(step: int) -> dict[str, jax.Array]:
    key = jax.random.key(step)
    return {"key": key, "kernel": jax.random.normal(key, (40, 30)), "step": jax.numpy.int32(step)}


def save_two(folder):
    for step in (1, 2):
        checkpoint.save_checkpoint(folder, step, state(step), MANIFEST)


def restored(folder):
    """The state of the latest checkpoint, or its number and what is told of it if it is an earlier one."""
    result = checkpoint.restore_checkpoint(folder, jax.eval_shape(state, 0), MANIFEST)
    assert result is not None
    right = state(result.step)
    equal = jax.tree.map(lambda a, b: bool((a == b).all()), result.state, right)
    assert all(jax.tree.leaves(equal)), "silent"
    if result.step < 2:
        raise InputError("the one before")
    return result.step


@functools.cache
def config(folder):
    return dataclasses.replace(tiny_config(folder), seeds=1, total_steps=CHUNKS * 256)


def in_run(folder):
    return dataclasses.replace(config(folder.parent), run_dir=folder)


def log_rows(folder):
    logs = RunLogs(in_run(folder))
    for step in range(2, 2 * CHUNKS + 1, 2):
        rows = [{"step": step, "arm": arm, "seed": 0, "success": step / 7} for arm in ("baseline", "layout")]
        logs.append(rows, {"step": step, "wall_s": step / 3, "cpu_s": step / 2})


def resumed_logs(folder):
    logs = RunLogs(in_run(folder))
    logs.rewind(2 * CHUNKS)
    return logs.read(LOG_FILE), logs.read(TIMES_FILE)


def arrays() -> dict[str, Any]:
    draw = np.random.default_rng(0)
    return {"policy": {"kernel": draw.normal(size=(30, 40)).astype(np.float32)}, "counts": draw.integers(0, 9, (5, 5))}


def exported(folder):
    params, spec = load_params(folder)
    return jax.tree.map(np.ndarray.tolist, params), spec


def bank(folder):
    return [[np.asarray(part).tolist() for part in bank[1:]] for bank in compile_corridors(folder)]


def reach(folder):
    result = Run(in_run(folder)).success_by_budget()
    if result is None:
        raise InputError("is removed: as in a run without val scenes, nothing is shown")
    return result


STORED = {
    "checkpoint": Stored(save_two, restored, "checkpoints/2"),
    "log": Stored(lambda folder: (folder.mkdir(), log_rows(folder)), resumed_logs),
    "config": Stored(
        lambda folder: claim_run_dir(in_run(folder)), lambda folder: run_settings(Run.open(folder).config)
    ),
    "reach": Stored(
        lambda folder: write_json_with_digest(
            folder / REACH_FILE, {"budgets": [10, 25], "val": {"layout": [0.25, 0.5]}}
        ),
        reach,
    ),
    "export": Stored(lambda folder: export_params(folder, arrays(), {"method": "org", "size": 3}), exported),
    "shards": Stored(compile_corridors, bank),
}


def campaign(name, folder, number, seed) -> collections.Counter[str]:
    """Damage what is stored so many times; return how often what came of it."""
    stored, draw, outcomes = STORED[name], random.Random(f"{name} {seed}"), collections.Counter()
    whole, hurt = folder / "whole", folder / "hurt"
    stored.write(whole)
    expected = stored.read(whole)
    for _ in range(number):
        shutil.copytree(whole, hurt)
        damage(hurt / stored.part, draw)
        try:
            read = stored.read(hurt)
            outcomes["harmless" if read == expected else "silent"] += 1
        except InputError:
            outcomes["told"] += 1
        shutil.rmtree(hurt)
    return outcomes


@pytest.mark.parametrize(
    "name", [name if name != "checkpoint" else pytest.param(name, marks=pytest.mark.slow) for name in STORED]
)
def test_random_damage_is_never_used_silently(name, tmp_path):
    outcomes = campaign(name, tmp_path, 8, seed=0)
    assert outcomes["silent"] == 0
    assert outcomes["told"] >= 2  # the others change what is not read, such as spaces


@pytest.mark.slow
@pytest.mark.parametrize("name", STORED)
def test_many_random_damages_are_never_used_silently(name, tmp_path):
    outcomes = campaign(name, tmp_path, NUM_DAMAGES, seed=1)
    print(name, dict(outcomes))
    assert outcomes["silent"] == 0
    assert outcomes["told"] >= 0.3 * NUM_DAMAGES


@pytest.mark.parametrize(("name", "file"), [("config", CONFIG_FILE), ("reach", REACH_FILE), ("export", "policy.json")])
def test_signed_record_with_a_changed_digit_is_refused(name, file, tmp_path):
    """Which a parser takes for another number."""
    STORED[name].write(tmp_path / "whole")
    path = tmp_path / "whole" / file
    whole = path.read_bytes()
    places = [index for index, byte in enumerate(whole) if chr(byte).isdigit()]
    for index in places[:: len(places) // 8]:
        path.write_bytes(whole[:index] + str((whole[index] - ord("0") + 1) % 10).encode() + whole[index + 1 :])
        with pytest.raises(InputError, match=file):
            STORED[name].read(path.parent)


def test_log_with_a_changed_digit_is_refused(tmp_path):
    log_rows(tmp_path)
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(path.read_bytes().replace(b"0.57", b"0.67"))  # success of 4 / 7
    with pytest.raises(InputError, match=r"metrics.jsonl, line 3: is damaged or was changed by hand"):
        RunLogs(in_run(tmp_path)).read(LOG_FILE)


@pytest.mark.parametrize(
    "hurt",
    [
        lambda folder: (folder / "_CHECKPOINT_METADATA").write_text("{"),
        pytest.param(lambda folder: (folder / "state/_METADATA").unlink(), marks=pytest.mark.slow),
        pytest.param(lambda folder: (folder / "state/_METADATA").write_text(""), marks=pytest.mark.slow),
        lambda folder: flip(max((folder / "state").rglob("d/*"), key=lambda path: path.stat().st_size)),
    ],
)
def test_restore_names_a_damaged_checkpoint_and_uses_the_one_before(tmp_path, hurt):
    save_two(tmp_path)
    hurt(tmp_path / "checkpoints/2")
    result = checkpoint.restore_checkpoint(tmp_path, jax.eval_shape(state, 0), MANIFEST)
    assert result is not None
    assert result.step == result.state["step"] == 1
    (problem,) = result.damaged
    # Before Orbax reads anything.
    assert problem.startswith(f"{tmp_path}/checkpoints/2: is damaged (ValueError: missing or other than saved: ")
    checkpoint.set_aside_checkpoints_after(tmp_path, result.step)
    assert (tmp_path / "damaged/2").is_dir()
    checkpoint.save_checkpoint(tmp_path, 2, state(2), MANIFEST)  # and the run goes on
    assert restored(tmp_path) == 2


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_restore_refuses_when_every_checkpoint_is_damaged(tmp_path):
    save_two(tmp_path)
    for step in (1, 2):
        (tmp_path / f"checkpoints/{step}/_CHECKPOINT_METADATA").write_text("{")
    with pytest.raises(InputError, match=r"/2: is damaged .*/1: is damaged .*no checkpoint is left; restore one or"):
        checkpoint.restore_checkpoint(tmp_path, jax.eval_shape(state, 0), MANIFEST)


@pytest.mark.parametrize("lost", [0, 3, 7])
def test_log_with_a_missing_or_repeated_row_is_refused(tmp_path, lost):
    log_rows(tmp_path)
    path = tmp_path / "metrics.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:lost] + lines[lost + 1 :]))
    with pytest.raises(InputError, match=f"metrics.jsonl, line {lost + 1}: rows are missing or out of order; restore"):
        RunLogs(in_run(tmp_path)).rewind(2 * CHUNKS)
    path.write_bytes(b"".join(lines + lines[lost : lost + 1]))
    with pytest.raises(InputError, match=r"metrics.jsonl, line 9: rows are missing or out of order"):
        RunLogs(in_run(tmp_path)).read(LOG_FILE)


@pytest.mark.slow
def test_run_with_a_damaged_checkpoint_resumes_bit_for_bit(tmp_path, tmp_path_factory, capsys):
    config_file, run_dir = finished_run(tmp_path_factory)
    hurt = shutil.copytree(run_dir, tmp_path / "run")
    shutil.rmtree(hurt / "policies")
    flip(max((hurt / "checkpoints/4/state").rglob("d/*"), key=lambda path: path.stat().st_size))
    assert train(config_file, hurt) == 0
    output = capsys.readouterr().err
    assert f"{hurt}/checkpoints/4: is damaged (" in output
    assert "resumed after update 2 of 4" in output
    for path in (
        "metrics.jsonl",
        *(f"policies/{name}/params.safetensors" for name in POLICY_NAMES),
    ):
        assert (hurt / path).read_bytes() == (run_dir / path).read_bytes(), path


@pytest.mark.slow
def test_train_does_not_overwrite_a_different_export(tmp_path, tmp_path_factory, capsys):
    config_file, run_dir = finished_run(tmp_path_factory)
    run = shutil.copytree(run_dir, tmp_path / "run")
    folder = run / "policies" / "layout-0"
    params, spec = load_params(folder)
    params["policy"]["actor"]["bias"] = params["policy"]["actor"]["bias"] + 1
    shutil.rmtree(folder)
    export_params(folder, params, spec)
    before = (folder / "params.safetensors").read_bytes()
    assert train(config_file, run) == 2
    assert f"{folder}: holds another policy than would be exported" in capsys.readouterr().err
    assert (folder / "params.safetensors").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda params: params["policy"]["actor"]["bias"].fill(np.nan),
            "policy/actor/bias holds numbers that are not fin",
        ),
        (
            lambda params: params["layout"].update(prior=params["layout"]["prior"][:, :-1, :-1]),
            "['layout']['prior']: 'float",
        ),
        (
            lambda params: params["layout"].update(counts=params["layout"]["counts"].astype(np.int32)),
            "'int32[5,22,22]' != ",
        ),
        (lambda params: params["policy"].pop("actor"), "['policy']['actor']['bias']: (absent) != 'float32["),
    ],
)
def test_load_policy_refuses_signed_exports_with_invalid_arrays(tmp_path, change, problem):
    params, spec = load_params(PACKAGED_POLICIES / "rooms-org")
    params = jax.tree.map(np.array, params)
    export_params(tmp_path / "whole", params, spec)
    load_policy(tmp_path / "whole")
    change(params)
    export_params(tmp_path / "wrong", params, spec)
    with pytest.raises(InputError) as error:
        load_policy(tmp_path / "wrong")
    assert str(error.value).startswith(f"{tmp_path}/wrong: ")
    assert problem in str(error.value)
