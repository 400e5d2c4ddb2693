"""Checkpoints: exact round trips, refusals, and kills at any moment."""

import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.errors import InputError
from jaxnav.store import checkpoint
from jaxnav.store.files import CHECKPOINT_FORMAT_VERSION, make_manifest

REPOSITORY = Path(__file__).parents[2]


class State(flax.struct.PyTreeNode):
    key: jax.Array
    env_keys: jax.Array
    params: dict
    moments: tuple
    step: jax.Array


def make_state(seed: int) -> State:
    key = jax.random.key(seed)
    kernel = jax.random.normal(key, (3, 4))
    return State(
        key=key,
        env_keys=jax.random.split(key, 5),
        params={"dense": {"kernel": kernel, "half": kernel.astype(jnp.bfloat16)}},
        moments=(jnp.uint8(seed), None, kernel > 0),
        step=jnp.int32(seed),
    )


ABSTRACT = jax.eval_shape(make_state, 0)
MANIFEST = make_manifest({"env": {"num_envs": 8, "view": (11, 11)}, "name": "run"})


def as_data(state: State) -> State:
    """Return a state with its keys as integers, which compare."""
    return state.replace(key=jax.random.key_data(state.key), env_keys=jax.random.key_data(state.env_keys))


def restored(run_dir: Path, abstract: Any = ABSTRACT, manifest: Mapping[str, Any] = MANIFEST) -> tuple[Any, int]:
    """Return the latest state and its step, which must exist."""
    result = checkpoint.restore_checkpoint(run_dir, abstract, manifest)
    assert result is not None
    assert result.damaged == ()
    return result.state, result.step


def test_state_round_trips_with_types_keys_and_step(tmp_path):
    state = make_state(7)
    assert not np.array_equal(state.params["dense"]["kernel"], make_state(8).params["dense"]["kernel"])
    checkpoint.save_checkpoint(tmp_path, 3, state, MANIFEST)
    loaded, step = restored(tmp_path)
    assert step == 3
    assert jax.tree.structure(loaded) == jax.tree.structure(state)
    chex.assert_trees_all_equal(as_data(loaded), as_data(state), strict=True)
    # The restored key is a live key: it draws what the saved one draws.
    assert jax.random.uniform(loaded.key) == jax.random.uniform(state.key)


def test_nothing_saved_restores_nothing(tmp_path):
    assert checkpoint.restore_checkpoint(tmp_path / "none", ABSTRACT, MANIFEST) is None
    (tmp_path / "checkpoints").mkdir()
    assert checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST) is None
    assert not (tmp_path / "none").exists()


def test_the_latest_two_steps_are_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_dir = Path("run")  # Orbax itself refuses relative paths
    for step in (1, 5, 10):
        checkpoint.save_checkpoint(run_dir, step, make_state(step), MANIFEST)
    assert sorted(p.name for p in (run_dir / "checkpoints").iterdir()) == ["10", "5"]
    loaded, step = restored(run_dir)
    assert (step, loaded.step) == (10, 10)


@pytest.mark.parametrize("step", [4, 5])
def test_a_step_cannot_be_saved_twice_or_backwards(tmp_path, step):
    checkpoint.save_checkpoint(tmp_path, 5, make_state(5), MANIFEST)
    with pytest.raises(InputError, match="holds step 5 already"):
        checkpoint.save_checkpoint(tmp_path, step, make_state(step), MANIFEST)
    assert restored(tmp_path)[1] == 5


def test_another_config_is_refused_with_keys_and_values(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
    other = make_manifest({"env": {"num_envs": 16, "view": (11, 11), "limit": 5}, "name": "run"})
    with pytest.raises(InputError) as error:
        checkpoint.restore_checkpoint(tmp_path, ABSTRACT, other)
    assert "env.limit: (absent) != 5; env.num_envs: 8 != 16;" in str(error.value)
    assert "env.view" not in str(error.value)


def test_another_format_version_is_refused(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST | {"format_version": 99})
    with pytest.raises(InputError, match=f"has format version 99, this code reads version {CHECKPOINT_FORMAT_VERSION}"):
        checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST)


def test_other_package_versions_are_allowed(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST | {"versions": {"jax": "0.0.1"}})
    assert restored(tmp_path)[1] == 1


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (lambda s: s.replace(step=jnp.float32(0)), ".step: 'int32[]' != 'float32[]'"),  # Orbax would cast it
        (lambda s: s.replace(params={"dense": jnp.ones((3, 5))}), ".params['dense']: (absent) != 'float32[3,5]'"),
        (lambda s: s.replace(env_keys=s.env_keys[:2]), ".env_keys: 'key<fry>[5]' != 'key<fry>[2]'"),
        (lambda s: s.replace(moments=s.moments[:2]), ".moments[2]: 'bool[3,4]' != (absent)"),
    ],
)
def test_another_state_is_refused_with_its_leaves(tmp_path, change, difference):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
    abstract = jax.eval_shape(lambda: change(make_state(1)))
    with pytest.raises(InputError) as error:
        checkpoint.restore_checkpoint(tmp_path, abstract, MANIFEST)
    assert difference in str(error.value)


@pytest.mark.parametrize("leaf", [3, 0.5, np.zeros(2), jnp.zeros((0, 2))])
def test_leaves_that_could_not_be_restored_are_not_saved(tmp_path, leaf):
    with pytest.raises(TypeError, match=r"state\.step is .*non-empty jax.Array"):
        checkpoint.save_checkpoint(tmp_path, 1, make_state(1).replace(step=leaf), MANIFEST)
    assert checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST) is None


@pytest.mark.parametrize("error", [MemoryError("full"), TypeError("a bug")])
def test_what_is_no_damage_is_not_reported_as_such(tmp_path, monkeypatch, error):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)

    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr("orbax.checkpoint._src.serialization.jax_array_handlers.ArrayHandler.deserialize", fail)
    with pytest.raises(BaseException) as raised:  # noqa: PT011  (Orbax chooses the type)
        checkpoint.restore_checkpoint(tmp_path, ABSTRACT, MANIFEST)
    assert not isinstance(raised.value, InputError)


def test_unfinished_commits_are_ignored_and_cleared(tmp_path):
    checkpoint.save_checkpoint(tmp_path, 1, make_state(1), MANIFEST)
    unfinished = tmp_path / "checkpoints" / "2.orbax-checkpoint-tmp"
    (unfinished / "state").mkdir(parents=True)
    assert restored(tmp_path)[1] == 1
    checkpoint.save_checkpoint(tmp_path, 2, make_state(2), MANIFEST)
    assert not unfinished.exists()
    assert restored(tmp_path)[1] == 2


# Saves step after step, each with arrays that only this step has, and says when a step is safe.
ENDLESS_SAVES = """
import sys
from pathlib import Path
import jax
from jaxnav.store import checkpoint
from jaxnav.store.files import make_manifest
for step in range(1, 10**6):
    state = {"bits": jax.random.bits(jax.random.key(step), (1024, 1024))}
    checkpoint.save_checkpoint(Path(sys.argv[1]), step, state, make_manifest({}))
    print(step, flush=True)
"""


@pytest.mark.parametrize(
    "delay", [0.0, *(pytest.param(seconds, marks=pytest.mark.slow) for seconds in (0.01, 0.03, 0.1))]
)
def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path, delay):
    command = [sys.executable, "-c", ENDLESS_SAVES, str(tmp_path)]
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as process:
        # From step 3 on a save also removes an older step. Wait until its commit is being written, then a little more.
        while not list(tmp_path.glob("checkpoints/[3-9].orbax-checkpoint-tmp")):
            assert process.poll() is None
            time.sleep(0.001)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        safe = [int(line) for line in process.stdout or []]
    assert process.returncode == -signal.SIGKILL
    abstract = {"bits": jax.ShapeDtypeStruct((1024, 1024), jnp.uint32)}
    state, step = restored(tmp_path, abstract, make_manifest({}))
    assert step >= safe[-1] >= 2  # what was said to be safe is there; a commit just before the kill may be too
    chex.assert_trees_all_equal(state, {"bits": jax.random.bits(jax.random.key(step), (1024, 1024))})
    checkpoint.save_checkpoint(tmp_path, step + 1, state, make_manifest({}))  # and the run goes on
    assert restored(tmp_path, abstract, make_manifest({}))[1] == step + 1
