"""Roots of more equations than unknowns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._statics._least_squares import assessed, least_squares

EPS = np.finfo(float).eps


def searched(residuals, z0, free=None, rtol=1e-10):
    """(end point, assessment)."""
    z0 = jnp.asarray(z0)
    free = jnp.ones(z0.shape, bool) if free is None else jnp.asarray(free)

    def scale(z, F, J):
        return jnp.abs(J) @ z + jnp.abs(F)

    @jax.jit
    def run(z0):
        end = least_squares(residuals, scale, z0, free, 256)
        rounding = jnp.zeros_like(end.F)
        return end, assessed(end, free, z0, scale, rounding, jnp.asarray(rtol))

    return run(z0)


def circle(z):
    """Two lines of the plane and a circle through their intersection (0.6, 0.8)."""
    return jnp.stack([z[0] ** 2 + z[1] ** 2 - 1.0, z[0] - 0.75 * z[1], z[0] + z[1] - 1.4])


def test_root_of_more_equations_than_unknowns():
    end, root = searched(circle, [2.0, 0.3])
    assert root.found
    assert np.max(np.abs(end.z - np.array([0.6, 0.8]))) <= 4 * EPS
    assert np.max(np.abs(end.F)) <= 4 * EPS


def test_units_do_not_matter():
    units = jnp.array([1e6, 1e-5])
    rows = jnp.array([1e-7, 1.0, 1e5])
    end, root = searched(lambda z: rows * circle(z * units), np.array([2.0, 0.3]) / units)
    assert root.found
    assert np.max(np.abs(end.z * units - np.array([0.6, 0.8]))) <= 16 * EPS


def test_fixed_variables_keep_their_values():
    end, root = searched(lambda z: circle(z)[:1], [0.6, 0.3], free=[False, True])
    assert root.found
    assert end.z[0] == 0.6
    assert abs(end.z[1] - 0.8) <= 4 * EPS


def test_least_norm_where_roots_lie_beside_each_other():
    """One equation of two unknowns: the root nearest to the start in their units."""
    end, root = searched(lambda z: z[:1] + z[1:] - 1.0, [0.0, 0.0])
    assert root.found
    assert np.max(np.abs(end.z - 0.5)) <= 4 * EPS


@pytest.mark.parametrize(
    "residuals",
    [
        lambda z: jnp.stack([z[0] - 1.0, z[0] - 1.1]),  # contradictory
        lambda z: z**2 + 1.0,  # a minimum that is no root
        lambda z: jnp.exp(-z),  # vanishes at infinity alone
    ],
)
def test_no_root(residuals):
    assert not searched(residuals, [0.4])[1].found


def test_not_finite():
    root = searched(lambda z: jnp.sqrt(z - 2.0), [0.4])[1]
    assert not root.found
    assert not root.finite
