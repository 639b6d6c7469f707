"""Coordinates in units of ratio 1e6: results are the same as in equal units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._lowering import ArrayTerms, ScalarProgram, State

# ---- Rows ----------------------------------------------------------------------------------------


def falling(t, q, v, params):
    """z has no row, and a large acceleration."""
    return 0.5 * (v[0] ** 2 + 1e10 * v[1] ** 2 + 1e-6 * v[2] ** 2) - 1e-3 * q[2]


def bending(t, q, params):
    """The second row equals the first at y = 1e-5, but requires another acceleration there."""
    r = q[0] - 1e5 * q[1]
    return jnp.stack([r, r + params * (1e5 * q[1] - 1.0) ** 2])


def test_contradiction_is_reported_beside_large_accelerations():
    """The accelerations of y by two rows differ by 2e-5, that of z is 1000."""
    system = jl.System(falling, ("x", "y", "z"), constraints=(jl.Holonomic(bending, "rows"),))
    state = [1.0, 1e-5, 0.0], [1.0, 1e-5, 0.0]
    assert np.all(np.isnan(system.acceleration(*state, 1.0)))
    np.testing.assert_allclose(system.acceleration(*state, 0.0), [0.0, 0.0, -1000.0], atol=1e-12)


def pressed(t, q, v, params):
    return 0.5 * (v[0] ** 2 + 1e9 * v[1] ** 2 + 1e-9 * v[2] ** 2) - 0.3 * q[2] + q[0]


def led(t, q, params):
    """As many rows as coordinates: nothing moves, for any forces."""
    return jnp.stack(
        [q[0] - 1e-5 * q[2] + 9e3 * q[1], 0.7 * q[0] + 1e-5 * q[2], q[1] + 1e-9 * q[2]]
    )


def test_fully_constrained_system_has_accelerations_of_rounding():
    """Forces of 1e4 in units of inertia leave only rounding in accelerations."""
    system = jl.System(pressed, ("x", "y", "z"), constraints=(jl.Holonomic(led, "rows"),))
    at_rest = np.zeros(3), np.zeros(3)
    units = np.array([1.0, 1e9, 1e-9]) ** -0.5
    a = np.asarray(system.acceleration(*at_rest))
    # Measured 2026-11-26: 2e-16 of the forces 0.3 / 1e-9^(1/2), three orders within the bound.
    assert np.max(np.abs(a / units)) <= 1e3 * np.finfo(float).eps * 0.3 * units[2]
    force = np.asarray(system.constraint_force(*at_rest))
    np.testing.assert_allclose(force * units, [-1.0, 0.0, 0.3 * units[2]], atol=1e-9)


# ---- Quasi-velocities ----------------------------------------------------------------------------


def crossed(t, q, u, params):
    """x in units of 1e5, y and b in units of 1e-6."""
    cosine = jnp.cos(q[0] * 1e-5)
    return jnp.stack([1e5 * (u[0] + 0.3 * cosine * 1e6 * u[1]), 1e-6 * (1e6 * u[1] + 0.3 * u[0])])


def swinging(t, q, u, params):
    return 0.5 * (u[0] ** 2 + 2e12 * u[1] ** 2) - jnp.sin(q[0] * 1e-5) - (1e6 * q[1]) ** 2


def plainly(q, u):
    """The same in units of 1: u' from Hamel's equations, and v' = B u' + B' u."""
    b = np.array([[1.0, 0.3 * np.cos(q[0])], [0.3, 1.0]])
    v = b @ u
    turning = np.array([[0.0, -0.3 * np.sin(q[0]) * v[0]], [0.0, 0.0]])  # B'
    mass, force = np.diag([1.0, 2.0]), np.array([-np.cos(q[0]), -2.0 * q[1]])
    theta = np.linalg.inv(b)  # u = theta v, p = mass u
    p = mass @ u
    rate = -theta @ turning @ theta
    # The slopes of theta v by x, at constant v: B depends on x alone.
    slopes = -theta @ np.array([[0.0, -0.3 * np.sin(q[0])], [0.0, 0.0]]) @ theta @ v
    bending = np.array([p @ slopes, 0.0])
    effort = force - rate.T @ p + bending
    du = np.linalg.solve(mass, b.T @ effort)
    return b @ du + turning @ u


@pytest.mark.full
def test_kinematics_of_unlike_units_equal_those_of_equal_units():
    """u from v, and L written in u: every program gives the result in units of 1."""
    quasi = jl.QuasiVelocities(kinematics=crossed, names=("a", "b"))
    system = jl.System(swinging, ("x", "y"), quasi=quasi, written_in="u")
    units, speeds = np.array([1e5, 1e-6]), np.array([1.0, 1e-6])
    x, y = np.array([0.4, 0.1]), np.array([0.3, -0.7])
    q, u = x * units, y * speeds
    right, v = plainly(x, y), system.velocities(q, u)
    np.testing.assert_allclose(system.quasi_velocities(q, v), u, rtol=1e-14)
    # As a function of v, by multipliers, and in u.
    state = q, v
    for a in (system.acceleration(*state), system._quasi_reactions(*state)["a"]):
        np.testing.assert_allclose(a / units, right, rtol=1e-13)
    scalars = ScalarProgram(ArrayTerms(system.lagrangian, (), quasi=quasi, in_u=system._in_u), None)
    given = jnp.asarray(q), None, {}
    state = State(jnp.zeros(()), given[0], jnp.asarray(u), None, {})
    rates = scalars.quasi_rates(state, scalars.precompute(*given))
    np.testing.assert_allclose(rates[:2], v, rtol=1e-14)
    turning = jax.jvp(
        lambda q, u: quasi.velocities(jnp.zeros(()), q, u, None),
        (given[0], jnp.asarray(u)),
        (rates[:2], rates[2:]),
    )[1]
    np.testing.assert_allclose(turning / units, right, rtol=1e-13)


@pytest.mark.full
def test_formulations_agree_for_unlike_units():
    quasi = jl.QuasiVelocities(kinematics=crossed, names=("a", "b"))
    motions = [
        jl.simulate(
            jl.System(swinging, ("x", "y"), quasi=quasi, written_in="u", lowering=lowering),
            [0.4e5, 0.1e-6],
            None,
            ts=[0.0, 0.5],
            u0=[0.3, -0.7e-6],
            atol=1e-15,
            formulation=formulation,
        )
        for lowering, formulation in (
            ("auto", "quasi"),
            ("array", "quasi"),
            ("auto", "multipliers"),
        )
    ]
    for motion in motions[1:]:
        np.testing.assert_allclose(motion.q[-1], motions[0].q[-1], rtol=1e-9)


def slanted(t, q, v, params):
    return jnp.stack([1e-5 * v[0] + jnp.tanh(q[0]) * 1e4 * v[1], 1e4 * v[1]])


@pytest.mark.parametrize("derivative", [False, True])
def test_quasi_velocities_of_unlike_units_are_inverted_to_rounding(derivative):
    """The round trip is exact to rounding, although rows of dU/dv are 1e-9 from parallel."""
    quasi = jl.QuasiVelocities(slanted, ("a", "b"))
    q, v = jnp.array([0.4, 0.1]), jnp.array([1.3e5, 0.7e-4])

    def round_trip(v):
        return quasi.velocities(jnp.zeros(()), q, quasi.of(jnp.zeros(()), q, v, None), None)

    if derivative:
        found = jax.jacrev(round_trip)(v) @ v, jax.jvp(round_trip, (v,), (v,))[1]
    else:
        found = (round_trip(v),)
    for x in found:
        np.testing.assert_allclose(x, v, rtol=1e-14)


SCALES = np.array([1.0, 1e-6, 1e6])


def turned(x):
    """The units of the inputs differ from row to row."""
    c, s = jnp.cos(x), jnp.sin(x)
    return jnp.array([[1.6, 0.3 * s, 0.0], [0.0, 1.6, 0.3 * c], [0.3, 0.0, 1.6 + 0.4 * s]])


def round_about(t, q, u, params):
    return SCALES * (turned(q[0]) @ (u / SCALES) + 0.2)


def led_along(t, q, u, params):
    """A fourth coordinate that depends on the others."""
    w = u / SCALES
    more = 1e3 * (w[0] - jnp.sin(q[0]) * w[2])
    return jnp.append(SCALES * (turned(q[0]) @ w), more)


@pytest.mark.parametrize(("kinematics", "n"), [(round_about, 3), (led_along, 4)])
def test_kinematics_of_unlike_units_are_inverted_to_rounding(kinematics, n):
    """The round trip is the identity; so are its first and second derivatives, in both modes."""
    quasi = jl.QuasiVelocities(kinematics=kinematics, names=("a", "b", "c"))
    q, x, dx = jnp.full(n, 0.4), jnp.array([0.7, -0.3, 0.5]), jnp.array([0.1, 0.2, -0.4])

    def round_trip(q, x):
        t = jnp.zeros(())
        return quasi.of(t, q, quasi.velocities(t, q, SCALES * x, None), None) / SCALES

    def tangent(q, x):
        return jax.jvp(round_trip, (q, x), (jnp.ones(n), dx))[1]

    # Measured 2026-11-27: 6e-16. With derivatives of the factors: 1e-5.
    off = 1e-13
    np.testing.assert_allclose(round_trip(q, x), x, atol=off)
    np.testing.assert_allclose(tangent(q, x), dx, atol=off)
    np.testing.assert_allclose(
        jax.jvp(tangent, (q, x), (jnp.ones(n), dx))[1], np.zeros(3), atol=off
    )
    of_q, of_x = jax.vjp(round_trip, q, x)[1](jnp.ones(3))
    np.testing.assert_allclose(of_q, np.zeros(n), atol=off)
    np.testing.assert_allclose(of_x, np.ones(3), atol=off)


def off_the_way(t, q, u, params):
    """In single precision; the second coordinate moves at twice the speed of the first."""
    return jnp.stack([u[0], 2.0 * u[0], 1e3 * (u[1] + 0.3 * u[0])])


def test_velocities_outside_the_kinematics_are_projected():
    """Tall kinematics take the nearest; derivatives, too."""
    quasi = jl.QuasiVelocities(kinematics=off_the_way, names=("a", "b"))
    v = jnp.array([1.0, 1.0, 1e3], jnp.float32)

    def of(v):
        return quasi.of(jnp.zeros(()), jnp.zeros(3, v.dtype), v, None)

    B = np.array([[1.0, 0.0], [2.0, 0.0], [300.0, 1e3]])
    slopes = np.linalg.pinv(B)
    np.testing.assert_allclose(of(v), slopes @ np.asarray(v, float), rtol=1e-6)
    for found in (jax.jacfwd(of)(v), jax.jacrev(of)(v)):
        np.testing.assert_allclose(found, slopes, rtol=1e-6, atol=1e-7)


def uneven(t, q, v, params):
    C = jnp.array([[1.6, 0.3, 0.2], [0.0, 1.6, 0.3], [0.3, 0.0, 1.5]])
    return jnp.array([1e-6, 1e-4, 1e5]) * (C @ (v / jnp.array([1e6, 1e-6, 1e-4])))


def test_velocities_are_refined_to_rounding():
    """Measured 2026-11-27: 8e-16; with one step of refinement 1e-10."""
    quasi = jl.QuasiVelocities(uneven, ("a", "b", "c"))
    t, v = jnp.zeros(()), jnp.array([0.7e6, -0.3e-6, 0.5e-4])
    np.testing.assert_allclose(quasi.velocities(t, v, quasi.of(t, v, v, None), None), v, rtol=1e-13)


def test_quasi_velocities_may_read_arrays_from_outside():
    """Like every other function, also with constrained names."""
    matrix = np.array([[0.5, -1.0], [2.0, 0.25]])

    def U(t, q, v, params):
        return jnp.asarray(matrix) @ v

    def energy(t, q, v, params):
        return 0.5 * v @ v

    system = jl.System(energy, ("x", "y"), quasi=jl.QuasiVelocities(U, ("a", "b"), ("b",)))
    np.testing.assert_allclose(
        system.velocities([0.0, 0.0], {"a": 1.0}), np.array([0.25, -2.0]) / 2.125
    )
