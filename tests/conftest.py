"""Settings of the whole suite: no silent promotion of dtypes or ranks, a cache of its own, reproducible examples."""

import atexit
import gc
import importlib.metadata
import os
import shutil
import tempfile
from pathlib import Path

# JAX reads these when it is imported, here, in the suite's other workers and in the commands that tests start.
if "PYTEST_XDIST_WORKER" not in os.environ:
    # What one test has compiled another need not; nothing is kept from one run to the next, unless a folder is given.
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxnav-tests-")
        atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    # A process that reads a program while another one writes it compiles the program itself, after a warning.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:Error reading persistent compilation cache entry:UserWarning")
    # Most of the time goes into compilation, which this makes quicker; the README's commands run as users run them.
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    # XLA ends a process whose flags it does not know, and the flag is no promise of other versions.
    if "XLA_FLAGS" not in os.environ and importlib.metadata.version("jaxlib").startswith("0.10."):
        os.environ["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"  # a third of the time of compilation

import hypothesis
import jax
import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The first example compiles, which no deadline survives.
hypothesis.settings.register_profile("jaxnav", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxnav")


class ByFixtures(LoadScopeScheduling):
    """Keep together what shares fixtures: the tests of a file, all of `runs` and `cli`, and all of `experiments`."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        folder_name = Path(file).parent.name
        if folder_name in ("runs", "cli"):
            return "runs and cli"
        return folder_name if folder_name == "experiments" else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> ByFixtures:
    """Divide the tests among workers."""
    return ByFixtures(config, log)


@pytest.fixture
def optimised():
    """Compile as users do, for a test that computes for longer than it compiles."""
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


def pytest_collection_finish() -> None:
    """Collect garbage seldom: tracing makes many objects that live on."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


#: A process dies at 65,530 memory maps; at so many its programs hold some three gigabytes.
MAX_MEMORY_MAPS = 15_000


@pytest.fixture(autouse=True, scope="module")
def programs_are_let_go_before_there_are_too_many():
    """Keep compiled programs from module to module while there is room for their memory maps."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MAX_MEMORY_MAPS:
        jax.clear_caches()
