"""Settings of the whole suite: no silent promotion of dtypes or ranks, no cache between runs, reproducible examples."""

import atexit
import shutil
import tempfile

import hypothesis
import jax

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# What one test has compiled another need not; nothing is kept from one run to the next.
_compiled = tempfile.mkdtemp(prefix="jaxnav-tests-")
atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", _compiled)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)

# The first example compiles, which no deadline survives.
hypothesis.settings.register_profile("jaxnav", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxnav")
