"""Free memory of the system, the memory that a run needs, and the refusal of runs that need more than is free."""

import jax
import jax.numpy as jnp
import pytest
from support.tiny_run import tiny_config

import jaxnav
from jaxnav.errors import InputError
from jaxnav.layout import ESTIMATORS
from jaxnav.numerics.trees import count_array_bytes
from jaxnav.plain_console import PlainConsole
from jaxnav.runs import memory
from jaxnav.runs.train import explore_world, learn_knowledge, make_trainer
from jaxnav.runs.worlds import compile_training_world
from jaxnav.training.devices import Devices

GIB = 2**30


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Folder that describes a machine with 8 GiB of available memory; a test may add control groups."""
    (tmp_path / "meminfo").write_text("MemTotal:       16777216 kB\nMemAvailable:    8388608 kB\n")
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_GROUPS_OF_PROCESS", tmp_path / "cgroup")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    return tmp_path


def write_group(folder, files):
    """Write the files of a control group."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(f"{text}\n")


@pytest.mark.parametrize(
    ("limit", "expected"),
    [("max", 8 * GIB), (3 * GIB, 2 * GIB), (GIB // 2, 0), (64 * GIB, 8 * GIB)],
    ids=["unlimited", "limited", "exhausted", "above the machine"],
)
def test_free_memory_is_the_lesser_of_machine_and_control_group(machine, limit, expected):
    (machine / "cgroup").write_text("0::/\n")
    write_group(machine / "groups", {"memory.max": limit, "memory.current": GIB})
    assert memory.read_free_bytes() == expected


def test_group_is_limited_by_the_groups_that_contain_it(machine):
    """The job may use 4 GiB, of which 1 GiB is used; its step has no limit of its own."""
    (machine / "cgroup").write_text("0::/slurm/job_7/step_0\n")
    job = machine / "groups" / "slurm" / "job_7"
    write_group(job, {"memory.max": 4 * GIB, "memory.current": GIB})
    write_group(job / "step_0", {"memory.max": "max", "memory.current": GIB})
    assert memory.read_free_bytes() == 3 * GIB


def test_cached_files_of_a_group_count_as_free(machine):
    (machine / "cgroup").write_text("0::/\n")
    files = {"memory.max": 4 * GIB, "memory.current": 3 * GIB, "memory.stat": f"anon {GIB}\ninactive_file {2 * GIB}"}
    write_group(machine / "groups", files)
    assert memory.read_free_bytes() == 3 * GIB


def test_groups_of_the_first_version_are_read(machine):
    (machine / "cgroup").write_text("5:cpu,cpuacct:/job\n4:memory:/job\n0::/\n")
    files = {"memory.limit_in_bytes": 4 * GIB, "memory.usage_in_bytes": 3 * GIB}
    write_group(machine / "groups" / "memory" / "job", files)
    assert memory.read_free_bytes() == GIB


@pytest.mark.parametrize("meminfo", [None, "", "MemTotal: 16 kB\nnot a table\n\n"])
def test_free_memory_is_unknown_where_the_system_does_not_say(machine, meminfo):
    (machine / "meminfo").unlink()
    if meminfo is not None:
        (machine / "meminfo").write_text(meminfo)
    assert memory.read_free_bytes() is None
    memory.require_memory(10**18, "a run", "give less")


@pytest.mark.parametrize(
    ("device_stats", "expected"),
    [({"bytes_limit": 5 * GIB, "bytes_in_use": GIB}, 4 * GIB), ({}, None), (None, None)],
)
def test_free_memory_of_an_accelerator_is_that_of_the_device(machine, monkeypatch, device_stats, expected):
    class Accelerator:
        def memory_stats(self):
            return device_stats

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: [Accelerator()])
    assert memory.read_free_bytes() == expected


def test_require_memory_names_needed_memory_free_memory_and_advice(machine):
    memory.require_memory(8 * GIB, "a run", "give less")
    with pytest.raises(InputError, match=r"a run needs 9\.0 GB of memory, but 8\.6 GB are free; give less"):
        memory.require_memory(9_000_000_000, "a run", "give less")


@pytest.mark.parametrize(
    ("num_bytes", "text"), [(0, "0 kB"), (1_500, "2 kB"), (2_000_000, "2 MB"), (1_234_000_000_000, "1,234.0 GB")]
)
def test_number_of_bytes_is_formatted_in_a_fitting_unit(num_bytes, text):
    assert memory.format_bytes(num_bytes) == text


def test_count_array_bytes_counts_arrays_and_random_keys():
    """Four float32 take 16 bytes, three int8 take 3, and a threefry key takes two words of 4 bytes."""
    tree = {"a": jnp.zeros(4), "b": jnp.zeros(3, jnp.int8), "key": jax.random.key(0)}
    assert count_array_bytes(tree) == 16 + 3 + 8
    assert count_array_bytes(jax.eval_shape(lambda: tree)) == 16 + 3 + 8


@pytest.mark.slow
def test_estimated_size_of_the_states_is_exact(tmp_path):
    config = tiny_config(tmp_path)
    compiled_world = compile_training_world(config, PlainConsole(quiet=True))
    estimator_config = ESTIMATORS["calibrated"]
    knowledge = learn_knowledge(config, compiled_world, explore_world(config, compiled_world), estimator_config)
    env_params = compiled_world.make_env_params(0)
    trainer = make_trainer(config, compiled_world.env, estimator_config, knowledge)

    num_bytes = trainer.estimate_state_bytes(env_params)
    assert num_bytes == count_array_bytes(trainer.init(env_params))

    # One device of a mesh holds all states.
    mesh = Devices(count=1).mesh(config.seeds, config.ppo.num_envs, config.ppo.minibatches)
    sharded_trainer = make_trainer(config, compiled_world.env, estimator_config, knowledge, mesh)
    assert sharded_trainer.estimate_state_bytes(env_params) == num_bytes


@pytest.mark.slow
@pytest.mark.parametrize(
    ("free_before_each_check", "message"),
    [
        ([1000], r"the state of training needs .*, but 1 kB are free; give fewer seeds or a smaller ppo\.num_envs"),
        ([10**12, 1000], r"an update needs .*, but 1 kB are free; give fewer seeds, .* or more ppo\.minibatches"),
    ],
)
def test_training_is_refused_before_it_exceeds_the_memory(tmp_path, monkeypatch, free_before_each_check, message):
    free_bytes = iter(free_before_each_check)
    monkeypatch.setattr(memory, "read_free_bytes", lambda: next(free_bytes))
    config = tiny_config(tmp_path)
    with pytest.raises(InputError, match=message):
        jaxnav.train(config)
    assert not (config.run_dir / "metrics.jsonl").exists()
