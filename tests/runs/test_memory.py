"""Memory that a run needs: read from the system, compared before arrays are created, and equal to what they take."""

import jax
import jax.numpy as jnp
import pytest
from support.tiny_run import tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.numerics.trees import abstract_bytes
from jaxnav.runs import memory


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with 8 GiB available, whose control group files a test may write."""
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:       16777216 kB\nMemAvailable:    8388608 kB\n")
    monkeypatch.setattr(memory, "_MEMINFO", meminfo)
    monkeypatch.setattr(memory, "_CONTROL_GROUP", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("group_limit", "expected_gib"),
    [("max", 8), (str(3 * 2**30), 2), (str(2**29), 0), (str(64 * 2**30), 8)],
    ids=["unlimited", "limited", "exhausted", "above the machine"],
)
def test_free_memory_is_the_lesser_of_machine_and_control_group(machine, group_limit, expected_gib):
    (machine / "memory.max").write_text(f"{group_limit}\n")
    (machine / "memory.current").write_text(f"{2**30}\n")
    assert memory.free_bytes() == expected_gib * 2**30


def test_free_memory_is_unknown_without_files_of_the_system(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "none")
    monkeypatch.setattr(memory, "_CONTROL_GROUP", tmp_path)
    assert memory.free_bytes() is None
    memory.require_memory(10**18, "a run", "give less")


def test_require_memory_names_need_supply_and_remedy(machine):
    memory.require_memory(8 * 2**30, "a run", "give less")
    with pytest.raises(InputError, match=r"a run needs 9\.0 GB of memory, but 8\.6 GB are free; give less"):
        memory.require_memory(9_000_000_000, "a run", "give less")


def test_abstract_bytes_counts_arrays_and_random_keys():
    """Four float32 take 16 bytes, three int8 take 3, and a threefry key takes two words of 4 bytes."""
    tree = {"a": jnp.zeros(4), "b": jnp.zeros(3, jnp.int8), "key": jax.random.key(0)}
    assert abstract_bytes(tree) == 16 + 3 + 8
    assert abstract_bytes(jax.eval_shape(lambda: tree)) == 16 + 3 + 8


@pytest.mark.parametrize(
    ("free_before_each_check", "purpose"),
    [([1000], "the state of training"), ([10**12, 1000], "an update")],
)
def test_training_is_refused_before_it_exceeds_the_memory(tmp_path, monkeypatch, free_before_each_check, purpose):
    answers = iter(free_before_each_check)
    monkeypatch.setattr(memory, "free_bytes", lambda: next(answers))
    config = tiny_config(tmp_path)
    with pytest.raises(InputError, match=rf"{purpose} needs .* of memory, but 1 kB are free; give .*ppo\.num_envs"):
        jaxnav.train(config)
    assert not (config.run_dir / "checkpoints").exists()
