"""Settings of the whole suite: no silent promotion of dtypes or ranks, no cache between runs, reproducible examples."""

import hypothesis
import jax

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_enable_compilation_cache", False)

# The first example compiles, which no deadline survives.
hypothesis.settings.register_profile("jaxnav", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxnav")
