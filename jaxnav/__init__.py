"""Layout-based causal inference for object navigation, in JAX."""
