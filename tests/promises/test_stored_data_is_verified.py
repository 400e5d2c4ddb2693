"""Stored data are verified when read: damage is reported, and damaged data are never used.

Seen to fail with each of these checks removed: the digests of a checkpoint, the digests of a record, the checksum of a
shard, the SHA-256 of an export, the count of a log's rows, the shapes and the values of an export.
"""

import collections
import dataclasses
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
from support.commands import train
from support.corridors import compile_corridors
from support.damage import damage
from support.refusals import assert_message_names
from support.tiers import params_by_tier
from support.tiny_run import POLICY_NAMES, finished_run, tiny_config

from jaxnav.errors import InputError
from jaxnav.runs.loaded_policy import load_policy
from jaxnav.runs.policies import CONFIG_FILE, PACKAGED_POLICIES
from jaxnav.runs.run import LOG_FILE, REACH_FILE, TIMES_FILE, Run, RunLogs, claim_run_dir, run_settings
from jaxnav.store import checkpoint
from jaxnav.store.export import export_params, load_params
from jaxnav.store.files import make_manifest, write_json_with_digest

MANIFEST = make_manifest({"seed": 1})
NUM_CHUNKS = 4
#: Damages of each kind of stored file in the slow tests.
NUM_DAMAGES = int(os.environ.get("JAXNAV_DAMAGES", "30"))


# Kinds of stored data, with their writers and readers


class StoredKind(NamedTuple):
    """A kind of stored data.

    Attributes:
      write: writes the data to a folder.
      read: reads the data from a folder.
      damaged_part: path in the folder below which a file is damaged.
    """

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    damaged_part: str = ""


def make_state(step: int) -> dict[str, jax.Array]:
    """Return the training state of an update: a key, a float32 kernel [40, 30] and the int32 step."""
    key = jax.random.key(step)
    return {"key": key, "kernel": jax.random.normal(key, (40, 30)), "step": jax.numpy.int32(step)}


def save_two_checkpoints(folder):
    for step in (1, 2):
        checkpoint.save_checkpoint(folder, step, make_state(step), MANIFEST)


def restore_latest(folder):
    """Return the restored checkpoint, whose state must be that of its step."""
    restored = checkpoint.restore_checkpoint(folder, jax.eval_shape(make_state, 0), MANIFEST)
    assert restored is not None
    expected_state = make_state(restored.step)
    is_equal = jax.tree.map(lambda leaf, expected: bool((leaf == expected).all()), restored.state, expected_state)
    assert all(jax.tree.leaves(is_equal)), "a damaged state was used"
    return restored


def restore_second(folder):
    """Return the step of the second checkpoint; an error if the first one had to be used."""
    restored = restore_latest(folder)
    if restored.step < 2:
        raise InputError("the first checkpoint was used")
    return restored.step


def run_config(run_dir):
    """Return the settings of a run of one seed in a directory."""
    config = tiny_config(run_dir.parent)
    return dataclasses.replace(config, seeds=1, total_steps=NUM_CHUNKS * 256, run_dir=run_dir)


def write_logs(folder):
    """Write the logs of chunks of two updates: per chunk a row for each of two arms, and a row of times."""
    logs = RunLogs(run_config(folder))
    for step in range(2, 2 * NUM_CHUNKS + 1, 2):
        rows = [{"step": step, "arm": arm, "seed": 0, "success": step / 7} for arm in ("baseline", "layout")]
        logs.append(rows, {"step": step, "wall_s": step / 3, "cpu_s": step / 2})


def make_folder_of_logs(folder):
    folder.mkdir()
    write_logs(folder)


def read_logs(folder):
    """Read the logs as a resumed run does."""
    logs = RunLogs(run_config(folder))
    logs.rewind(2 * NUM_CHUNKS)
    return logs.read(LOG_FILE), logs.read(TIMES_FILE)


def claim_folder(folder):
    claim_run_dir(run_config(folder))


def read_settings(folder):
    return run_settings(Run.open(folder).config)


def write_export(folder):
    """Export a float32 kernel [30, 40] and int64 counts [5, 5]."""
    rng = np.random.default_rng(0)
    kernel = rng.normal(size=(30, 40)).astype(np.float32)
    counts = rng.integers(0, 9, (5, 5))
    export_params(folder, {"policy": {"kernel": kernel}, "counts": counts}, {"method": "org", "size": 3})


def read_export(folder):
    params, spec = load_params(folder)
    return jax.tree.map(np.ndarray.tolist, params), spec


def read_shards(folder):
    """Return the arrays of every shard as lists."""
    shards = []
    for bank in compile_corridors(folder):
        shards.append([np.asarray(array).tolist() for array in bank[1:]])
    return shards


def write_reach(folder):
    write_json_with_digest(folder / REACH_FILE, {"budgets": [10, 25], "val": {"layout": [0.25, 0.5]}})


def read_reach(folder):
    reach = Run(run_config(folder)).success_by_budget()
    if reach is None:
        raise InputError("the file is missing, as in a run without val scenes, so nothing is shown")
    return reach


STORED_KINDS = {
    "checkpoint": StoredKind(save_two_checkpoints, restore_second, "checkpoints/2"),
    "log": StoredKind(make_folder_of_logs, read_logs),
    "config": StoredKind(claim_folder, read_settings),
    "reach": StoredKind(write_reach, read_reach),
    "export": StoredKind(write_export, read_export),
    "shards": StoredKind(compile_corridors, read_shards),
}


# Random damage


def damage_repeatedly(name, folder, num_damages, seed) -> collections.Counter[str]:
    """Damage one file of a copy of the stored data at a time, and count how reading it ends.

    Returns:
      The number of damages that were "reported", "harmless" (the data are read unchanged) or "silent" (changed data
      are read without an error).
    """
    stored_kind = STORED_KINDS[name]
    rng = random.Random(f"{name} {seed}")
    original_dir = folder / "whole"
    damaged_dir = folder / "hurt"
    stored_kind.write(original_dir)
    expected_data = stored_kind.read(original_dir)

    # Damage a fresh copy each time.
    outcomes = collections.Counter()
    for _ in range(num_damages):
        shutil.copytree(original_dir, damaged_dir)
        damage(damaged_dir / stored_kind.damaged_part, rng)
        try:
            is_harmless = stored_kind.read(damaged_dir) == expected_data
            outcomes["harmless" if is_harmless else "silent"] += 1
        except InputError:
            outcomes["reported"] += 1
        shutil.rmtree(damaged_dir)
    return outcomes


@pytest.mark.parametrize(
    "name", params_by_tier(STORED_KINDS, fast=STORED_KINDS.keys() - {"checkpoint"}, slow=["checkpoint"])
)
def test_random_damage_is_never_used_silently(name, tmp_path):
    outcomes = damage_repeatedly(name, tmp_path, 8, seed=0)
    assert outcomes["silent"] == 0
    assert outcomes["reported"] >= 2  # harmless damage changes parts that are not read, such as spaces


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", STORED_KINDS)
def test_many_random_damages_are_never_used_silently(name, tmp_path):
    outcomes = damage_repeatedly(name, tmp_path, NUM_DAMAGES, seed=1)
    print(name, dict(outcomes))
    assert outcomes["silent"] == 0
    assert outcomes["reported"] >= 0.3 * NUM_DAMAGES


# Changed digits, which a parser reads as another number


@pytest.mark.parametrize(
    ("name", "file_name"), [("config", CONFIG_FILE), ("reach", REACH_FILE), ("export", "policy.json")]
)
def test_signed_record_with_a_changed_digit_is_refused(name, file_name, tmp_path):
    record_dir = tmp_path / "whole"
    STORED_KINDS[name].write(record_dir)
    record = (record_dir / file_name).read_bytes()
    digit_indices = [index for index, byte in enumerate(record) if chr(byte).isdigit()]

    # Change eight digits of the record, one at a time: 0 becomes 1, ..., 9 becomes 0.
    for index in digit_indices[:: len(digit_indices) // 8]:
        next_digit = str((record[index] - ord("0") + 1) % 10).encode()
        (record_dir / file_name).write_bytes(record[:index] + next_digit + record[index + 1 :])
        with pytest.raises(InputError, match=file_name):
            STORED_KINDS[name].read(record_dir)


def test_log_with_a_changed_digit_is_refused(tmp_path):
    write_logs(tmp_path)
    log_file = tmp_path / LOG_FILE
    log_file.write_bytes(log_file.read_bytes().replace(b"0.57", b"0.67"))  # success of 4 / 7
    with pytest.raises(InputError, match=rf"{LOG_FILE}, line 3: .*damaged"):
        RunLogs(run_config(tmp_path)).read(LOG_FILE)


# Damaged checkpoints and incomplete logs


def flip_bit(path):
    """Flip a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def find_largest_array_file(checkpoint_dir):
    return max((checkpoint_dir / "state").rglob("d/*"), key=lambda path: path.stat().st_size)


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage_checkpoint",
    [
        pytest.param(lambda folder: (folder / "_CHECKPOINT_METADATA").write_text("{"), marks=pytest.mark.exhaustive),
        pytest.param(lambda folder: (folder / "state/_METADATA").unlink(), marks=pytest.mark.exhaustive),
        pytest.param(lambda folder: (folder / "state/_METADATA").write_text(""), marks=pytest.mark.exhaustive),
        lambda folder: flip_bit(find_largest_array_file(folder)),
    ],
)
def test_restore_names_a_damaged_checkpoint_and_uses_the_one_before(tmp_path, damage_checkpoint):
    save_two_checkpoints(tmp_path)
    damage_checkpoint(tmp_path / "checkpoints/2")

    # The files are verified before Orbax reads them.
    restored = restore_latest(tmp_path)
    assert restored.step == 1
    (problem,) = restored.damaged
    assert problem.startswith(f"{tmp_path}/checkpoints/2: is damaged (ValueError: missing or changed since saving: ")

    # The run can go on and save the second checkpoint again.
    checkpoint.set_aside_checkpoints_after(tmp_path, restored.step)
    assert (tmp_path / "damaged/2").is_dir()
    assert (tmp_path / "checkpoints/1").is_dir()
    checkpoint.save_checkpoint(tmp_path, 2, make_state(2), MANIFEST)
    assert restore_latest(tmp_path).step == 2


@pytest.mark.slow
def test_restore_refuses_when_every_checkpoint_is_damaged(tmp_path):
    save_two_checkpoints(tmp_path)
    for step in (1, 2):
        (tmp_path / f"checkpoints/{step}/_CHECKPOINT_METADATA").write_text("{")
    with pytest.raises(InputError) as error:
        checkpoint.restore_checkpoint(tmp_path, jax.eval_shape(make_state, 0), MANIFEST)
    assert_message_names(error.value, "/2: is damaged", "/1: is damaged", "no checkpoint is left", "restore one")


@pytest.mark.parametrize("row_index", [0, 3, 7])
def test_log_with_a_missing_or_repeated_row_is_refused(tmp_path, row_index):
    write_logs(tmp_path)
    log_file = tmp_path / LOG_FILE
    lines = log_file.read_bytes().splitlines(keepends=True)

    log_file.write_bytes(b"".join(lines[:row_index] + lines[row_index + 1 :]))
    with pytest.raises(InputError, match=f"{LOG_FILE}, line {row_index + 1}: rows are missing .*; restore"):
        RunLogs(run_config(tmp_path)).rewind(2 * NUM_CHUNKS)

    # The eight rows with one of them repeated have a ninth line.
    log_file.write_bytes(b"".join([*lines, lines[row_index]]))
    with pytest.raises(InputError, match=f"{LOG_FILE}, line 9: "):
        RunLogs(run_config(tmp_path)).read(LOG_FILE)


# Whole runs


@pytest.mark.exhaustive
def test_run_with_a_damaged_checkpoint_resumes_bit_for_bit(tmp_path, tmp_path_factory, capsys):
    config_file, original_dir = finished_run(tmp_path_factory)
    damaged_dir = shutil.copytree(original_dir, tmp_path / "run")
    shutil.rmtree(damaged_dir / "policies")
    flip_bit(find_largest_array_file(damaged_dir / "checkpoints/4"))

    # The checkpoint of update 4 is reported, and training resumes from that of update 2.
    assert train(config_file, damaged_dir) == 0
    output = capsys.readouterr().err
    assert f"{damaged_dir}/checkpoints/4: is damaged (" in output
    assert "resumed after update 2 of 4" in output

    for file_name in ("metrics.jsonl", *(f"policies/{name}/params.safetensors" for name in POLICY_NAMES)):
        assert (damaged_dir / file_name).read_bytes() == (original_dir / file_name).read_bytes(), file_name


@pytest.mark.slow
def test_train_does_not_overwrite_a_different_export(tmp_path, tmp_path_factory, capsys):
    config_file, original_dir = finished_run(tmp_path_factory)
    run_dir = shutil.copytree(original_dir, tmp_path / "run")

    # Replace an export by one with another bias and a valid digest.
    policy_dir = run_dir / "policies" / "layout-0"
    params, spec = load_params(policy_dir)
    params["policy"]["actor"]["bias"] = params["policy"]["actor"]["bias"] + 1
    shutil.rmtree(policy_dir)
    export_params(policy_dir, params, spec)
    exported_params = (policy_dir / "params.safetensors").read_bytes()

    assert train(config_file, run_dir) == 2
    assert f"{policy_dir}: holds another policy" in capsys.readouterr().err
    assert (policy_dir / "params.safetensors").read_bytes() == exported_params


# Exports with a valid digest and invalid arrays


def set_bias_to_nan(params):
    params["policy"]["actor"]["bias"].fill(np.nan)


def drop_last_category_of_prior(params):
    params["layout"]["prior"] = params["layout"]["prior"][:, :-1, :-1]


def convert_counts_to_integers(params):
    params["layout"]["counts"] = params["layout"]["counts"].astype(np.int32)


def remove_actor(params):
    del params["policy"]["actor"]


@pytest.mark.parametrize(
    ("change", "named_parts"),
    [
        (set_bias_to_nan, ["policy/actor/bias", "not fin"]),
        (drop_last_category_of_prior, ["['layout']['prior']", "'float"]),
        (convert_counts_to_integers, ["'int32[5,22,22]' != "]),
        (remove_actor, ["['policy']['actor']['bias']", "(absent) != 'float32["]),
    ],
)
def test_load_policy_refuses_signed_exports_with_invalid_arrays(tmp_path, change, named_parts):
    exported_params, spec = load_params(PACKAGED_POLICIES / "rooms-org")
    params = jax.tree.map(np.array, exported_params)
    export_params(tmp_path / "whole", params, spec)
    load_policy(tmp_path / "whole")

    change(params)
    export_params(tmp_path / "wrong", params, spec)
    with pytest.raises(InputError) as error:
        load_policy(tmp_path / "wrong")
    assert str(error.value).startswith(f"{tmp_path}/wrong: ")
    assert_message_names(error.value, *named_parts)
