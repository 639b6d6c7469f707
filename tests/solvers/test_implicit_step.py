"""Newton's method converged to rounding, where some unknowns are zero and only rounding is left."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag.solvers._implicit_step import root

SIZE = 51
ROUNDING = 1e-12  # of the residual


def noise(z):
    """Numbers in (-1, 1) that change with the last digits of z."""
    z = jax.lax.stop_gradient(1e17 * z)
    return jnp.sin(z + jnp.sum(z) + jnp.arange(z.size, dtype=float))


@pytest.mark.parametrize("zeros", [0, 16, SIZE])
def test_noise_in_unknowns_that_are_zero_ends_the_iteration(zeros):
    """Increments of zero unknowns are never small beside them. They stop one after the other."""
    rng = np.random.default_rng(1)
    J = jnp.asarray(np.eye(SIZE) + 0.1 * rng.normal(size=(SIZE, SIZE)))
    exact = jnp.asarray(np.where(np.arange(SIZE) < zeros, 0.0, rng.uniform(1, 2, SIZE)))

    def residual(z):
        d = z - exact
        return J @ d + 0.1 * d**2 + ROUNDING * noise(z)

    start = exact + 1e-4 * jnp.asarray(rng.normal(size=SIZE))
    z, found = jax.jit(lambda start: root(residual, start, jnp.abs(exact)))(start)
    assert found
    assert jnp.linalg.norm(z - exact) <= 2 * ROUNDING * SIZE**0.5 * jnp.linalg.norm(
        jnp.linalg.inv(J), 2
    )
