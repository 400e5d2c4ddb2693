"""Settings of the whole suite: no silent promotion of dtypes or ranks, no cache between runs, reproducible examples."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

# JAX reads these when it is imported, here, in the suite's other workers and in the commands that tests start.
if "PYTEST_XDIST_WORKER" not in os.environ:
    # What one test has compiled another need not; nothing is kept from one run to the next.
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxnav-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
    # Most of the time goes into compilation, which this makes quicker; the README's commands run as users run them.
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

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
    """Keep together what shares fixtures: the tests of a file, all of `runs` and all of `cli`."""

    def _split_scope(self, nodeid: str) -> str:
        file, folder = nodeid.partition("::")[0], Path(nodeid.partition("::")[0]).parent
        return str(folder) if folder.name in ("runs", "cli") else file


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


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_module_are_let_go():
    """A program holds memory maps; a process dies at 65,530 of them, which the slow tests together reach."""
    yield
    jax.clear_caches()
