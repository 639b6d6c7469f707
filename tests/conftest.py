"""Every test runs in float64 with strict dtype promotion; warnings of the project are errors."""

import jax

import jaxlag  # noqa: F401  (before the first compilation: it sets XLA's bound on small loops)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
