"""Inertias that are impossible for a body are refused, all others are accepted."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import energy, rotation

T = jnp.array(0.4)


@pytest.mark.parametrize(
    ("inertia", "message"),
    [
        (np.diag([1.0, 2.0, -0.5]), "its eigenvalue about the axis (0, 0, 1) was -0.5 kg m^2"),
        ([[1, 0.9, 0], [0.9, 0.5, 0], [0, 0, 1]], "was -0.184077 kg m^2. Products of inertia"),
        ([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], "be symmetric, but element (0, 1) was 0.1 and (1, 0"),
        (np.eye(3) * np.nan, "`inertia` must be finite"),
        ([1.0, np.inf, 1.0], "`inertia` must be finite"),
        ([1.0, 1.0, 1j], "`inertia` must be real, but its dtype was complex128"),
        (None, "`inertia` must be real numbers, but it was None"),
        ([[1, 2], [3]], "`inertia` must be real numbers, but it was [[1, 2], [3]]"),
        (
            np.eye(2),
            "`inertia` must be (3, 3), or (3,) principal moments, but its shape was (2, 2)",
        ),
        (1.0, "`inertia` must be (3, 3), or (3,) principal moments, but its shape was ()"),
    ],
    ids=str,
)
def test_impossible_inertia_is_refused(inertia, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        energy.RigidBody(1.0, inertia)


def test_check_finds_impossible_inertia_in_a_system():
    """`check` does not trace and sees the values inside a Lagrangian."""

    def kinetic(t, q, v, params):
        body = energy.RigidBody(1.0, jnp.stack([params["I"], params["I"], params["I"]]))
        return body.kinetic(lambda t, q, params: (rotation.about_z(q[0]), q), t, q, v, params)

    system = jl.System(kinetic, ("x", "y", "z"))
    state = [0.1, 0.2, 0.3], [0.0, 0.0, 1.0]
    system.check(*state, {"I": 0.4})
    with pytest.raises(ValueError, match="have no negative principal moment, but its eigenvalue"):
        system.check(*state, {"I": -0.4})


def test_literals_in_a_traced_lagrangian_are_checked():
    """Literals have values under jit, each independently; traced values are not checked."""

    def kinetic(mass, inertia, center=None):
        return energy.RigidBody(mass, inertia, center).kinetic_from_rates(np.ones(3), np.ones(3))

    principal, central = "have no negative principal moment", "use energy.parallel_axis"
    for function, given, message in [
        (lambda m: kinetic(m, [1.0, 2.0, -3.0]), 1.0, principal),
        (lambda m: kinetic(1.0, [1.0, 2.0, -3.0]), 1.0, principal),
        (lambda m: kinetic(1.0, energy.inertia_matrix(1.0, 2.0, -3.0)), 1.0, principal),
        (lambda m: kinetic(m, energy.inertia_matrix(1, 1, 1, 3)), 1.0, principal),
        (lambda inertia: kinetic(-1.0, inertia), np.ones(3), "`mass` must not be negative"),
        (lambda m: kinetic(m, [1, 1, 1], [0, 0, np.nan]), 1.0, "`center` must be finite"),
        (lambda m: kinetic(1.0, [0.1, 0.1, 0.1], [1, 0, 0]), 1.0, central),
    ]:
        with pytest.raises(ValueError, match=message):
            jax.jit(function)(given)
    about_g = energy.parallel_axis([0.1, 0.1, 0.1], 1.0, [1.0, 0.0, 0.0])
    for mass in (1.0, 9.0):  # traced: otherwise the second would be refused
        jax.jit(lambda m: kinetic(m, about_g, [1.0, 0.0, 0.0]))(mass)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_an_inertia_about_the_mass_center_is_refused(dtype):
    """I_G given for I_O: if accepted, T = -0.45 J for a motion of 1 m/s and 1 rad/s."""
    central, c = np.full(3, 0.1, dtype), np.array([1.0, 0.0, 0.0], dtype)
    message = (
        "RigidBody: `inertia` must be at least that of a point mass at the center, m (|c|^2 E - c "
        "c^T), but the difference, the inertia about the mass center, has the eigenvalue -0.9 kg "
        "m^2 about the axis (0, "
    )
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        energy.RigidBody(1.0, central, c)
    advice = "Give the inertia about the body's origin: use energy.parallel_axis."
    assert str(caught.value).endswith(advice)
    body = energy.RigidBody(1.0, energy.parallel_axis(central, 1.0, c), c)
    assert body.kinetic_from_rates([0, -1, 0], [0, 0, 1]) > 0
    with pytest.raises(ValueError, match=r"about the axis \(0, 0, 1\)\. Give the inertia about"):
        energy.RigidBody(2.0, (0.0, 0.0, 0.1), (0.3, 0.2, 0.0))


def test_point_mass_is_a_valid_body():
    """The inertia about the mass center vanishes up to rounding, for any mass center."""
    for c in np.random.default_rng(5).normal(size=(100, 3)):
        for dtype in (np.float64, np.float32):
            c_mass, zero = np.array([*c, 0.7], dtype), np.zeros((3, 3), dtype)
            inertia = energy.parallel_axis(zero, c_mass[3], c_mass[:3])
            energy.RigidBody(c_mass[3], inertia, c_mass[:3])


def test_slender_and_plane_bodies_are_allowed():
    energy.RigidBody(1.0, (0.2, 0.0, 0.2))
    energy.RigidBody(1.0, (0.2, 0.0, 0.2), (0.0, 0.4, 0.0))
    energy.RigidBody(1.0, (0.0, 0.0, 0.3), (0.4, 0.1, 0.0))
    energy.RigidBody(1.0, (0.0, 0.0, 0.0), (0.4, 0.1, 0.0))
    energy.RigidBody(0.0, np.zeros((3, 3)))


def test_a_body_may_be_given_in_integers():
    """Also under strict promotion; the mass is a real number for derivatives."""
    whole = energy.RigidBody(2, [2, 5, 5], [1, 0, 0])
    same = energy.RigidBody(2.0, np.diag([2.0, 5.0, 5.0]), [1.0, 0.0, 0.0])
    assert all(jnp.issubdtype(x.dtype, jnp.floating) for x in jax.tree.leaves(whole))
    V, w = [1, 2, 3], np.array([3, 1, 2])
    np.testing.assert_array_equal(whole.kinetic_from_rates(V, w), same.kinetic_from_rates(V, w))
    eye = energy.RigidBody(1, np.eye(3, dtype=int))
    np.testing.assert_array_equal(eye.kinetic_from_rates(V, w), 14)
    np.testing.assert_array_equal(energy.inertia_matrix(1, 2, 3), np.diag([1.0, 2.0, 3.0]))
    assert jax.grad(lambda body: body.kinetic_from_rates(V, w))(eye).mass == 7


def test_integer_positions_do_not_round_results():
    """9.81 m/s^2 stays 9.81 along integer positions."""
    np.testing.assert_allclose(energy.gravity(2.0, jnp.array([0, 2]), [0.0, -9.81]), 4 * 9.81)
    np.testing.assert_allclose(energy.gravity(2, [0, 2], [0, -10]), 40)

    def pose(t, q, params):
        return jnp.eye(3, dtype=int), [0, 2, 0]

    for body in (energy.RigidBody(2, [1, 1, 1]), energy.RigidBody(2.0, [1, 3, 3], [0.5, 0, 0])):
        V = body.gravity(pose, T, [1, 2], None, [0.0, -9.81, 0.0])
        np.testing.assert_allclose(V, 4 * 9.81)
        assert body.kinetic(pose, T, [1, 2], [1, 2], None) == 0
    np.testing.assert_allclose(energy.spring(2, [3, 4], 4), 1)
