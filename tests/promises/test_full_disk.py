"""A training on a full disk ends with one line, and goes on where there is room again, bit for bit.

The disk is a small file system in memory, with room for so many bytes or files. `python -m support.disks` in `tests`
tries ten sizes and ten numbers of files, and prints where each training stopped.
"""

import os
import shutil

import pytest
from support.disks import FILE_LIMITS, SIZE_LIMITS, can_mount, foreign_lines, train_on_small_disk
from support.tiers import params_by_tier
from support.tiny_run import POLICY_NAMES, finished_run

LIMITS = [SIZE_LIMITS[0], SIZE_LIMITS[2], SIZE_LIMITS[7], FILE_LIMITS[1], FILE_LIMITS[6]]


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    return finished_run(tmp_path_factory)


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="only root mounts a file system")
@pytest.mark.parametrize("limit", params_by_tier(LIMITS, slow=["size=24k"]))
def test_training_on_a_full_disk_is_one_line_and_loses_nothing(whole_run, tmp_path, limit):
    if not can_mount(tmp_path / "probe"):
        pytest.skip("no file system can be mounted here")
    config_file, whole_dir = whole_run
    attempt = train_on_small_disk(config_file, tmp_path / "disk", limit)
    assert attempt.exit_code == 2, attempt
    assert attempt.message.startswith("error: "), attempt
    assert str(tmp_path / "disk") in attempt.message, attempt
    assert foreign_lines(attempt) == []

    # The same command finishes where there is room.
    assert attempt.exit_code_with_room == 0, attempt
    for name in POLICY_NAMES:
        parameters = f"policies/{name}/params.safetensors"
        assert attempt.files[parameters] == (whole_dir / parameters).read_bytes()
