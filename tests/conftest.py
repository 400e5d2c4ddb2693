"""Settings of the whole suite: no silent promotion of dtypes or ranks, no cache between runs, reproducible examples."""

import atexit
import os
import shutil
import tempfile

# JAX reads these when it is imported, here, in the suite's other workers and in the commands that tests start.
if "PYTEST_XDIST_WORKER" not in os.environ:
    # What one test has compiled another need not; nothing is kept from one run to the next.
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxnav-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
    # Most of the time goes into compilation, which this makes quicker; `make test-slow` leaves it as users have it.
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

import hypothesis
import jax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The first example compiles, which no deadline survives.
hypothesis.settings.register_profile("jaxnav", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxnav")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep together what shares fixtures: the tests of a file, and all of `runs`."""
    for item in items:
        folder = item.path.parent
        item.add_marker(pytest.mark.xdist_group(str(folder if folder.name == "runs" else item.path)))
