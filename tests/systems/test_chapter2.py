"""Chapter 2: kinetic energies and forces by two derivations, by hand and by points and poses.

With J_i = dr/dq_i, a velocity sum(J_i v_i) has errors of a few eps in each J_i v_i, so that T, the
sum of m |velocity|^2/2, has an error of a few eps of (sum sqrt(M_ii) |v_i|)^2/2 (Minkowski's
inequality, M_ii = sum(m |J_i|^2)). With K = 32 roundings allowed, both agree to K eps times that.
"""

from math import atan2

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _hand_equations2 import fixed_force, following_force, motor_forces
from _scales import scale_of_T
from _states import random_states
from jax.numpy import cos, sin

import jaxlag as jl
from systems import two_link_robot_arm
from systems.catalogue import ENTRIES
from systems.catalogue.chapter2.disk_on_shaft import entry as DISK
from systems.catalogue.chapter2.rotating_body_on_frame import entry as FRAME
from systems.catalogue.chapter2.rotating_body_on_frame import pose as frame_pose

K = 32
EPS = np.finfo(float).eps


def rotating_body_on_frame(t, q, v, M, A, B, C, xb, yb, zb, theta, **others):
    """1/2 omega . I omega of the body, and of its mass at the center, which moves at omega x c."""
    (_, phi), (psi_rate, phi_rate) = q, v
    p, r = psi_rate * sin(theta) * sin(phi), phi_rate + psi_rate * cos(theta)
    q_ = psi_rate * sin(theta) * cos(phi)
    speeds = (q_ * zb - r * yb, r * xb - p * zb, p * yb - q_ * xb)
    return 0.5 * (A * p**2 + B * q_**2 + C * r**2) + 0.5 * M * sum(s**2 for s in speeds)


def disk_pose(t, q, params):
    """The axes of the disk, and its center, which is fixed to them on the tilted shaft."""
    R = jl.rotation.zxz.matrix((q[0] + jnp.pi / 2, params["theta"], q[1]))
    return R, R @ jnp.array([0.0, 0.0, params["s"]])


def disk_on_shaft(t, q, v, **params):
    disk = jl.energy.RigidBody(params["M"], (params["It"], params["It"], params["Ia"]))
    return disk.kinetic(disk_pose, t, q, v, params)


def lamina_two_forces(t, q, v, M, Iz, xb, yb, **others):
    (_, _, theta), (x_rate, y_rate, w) = q, v
    along = (y_rate * xb - x_rate * yb) * cos(theta)
    across = (x_rate * xb + y_rate * yb) * sin(theta)
    return 0.5 * M * (x_rate**2 + y_rate**2) + 0.5 * Iz * w**2 + M * w * (along - across)


def lamina_double_pendulum(t, q, v, M, Iz, r, xb, yb, g):
    (theta, phi), (w, phi_rate) = q, v
    cross = M * r * phi_rate * w * (xb * cos(phi - theta) - yb * sin(phi - theta))
    return 0.5 * M * (r * w) ** 2 + 0.5 * Iz * phi_rate**2 + cross


def rotating_slender_rod(t, q, v, rho, L, R, **others):
    """The rod about the pin O: its axis is body Y, radially outward at theta2 = pi/2."""
    M, about_O = rho * L, rho * L**3 / 3
    rod = jl.energy.RigidBody(M, (about_O, 0.0, about_O), (0.0, L / 2, 0.0))

    def pose(t, q, params):
        arm = jl.rotation.about_z(q[0])  # its y axis points outward
        return arm @ jl.rotation.about_x(jnp.pi / 2 - q[1]), arm @ jnp.array([0.0, R, 0.0])

    return rod.kinetic(pose, t, q, v, None)


def arm(t, q, v, mA, m, l1, l2, **others):
    (theta1, theta2), (w1, w2) = q, v
    cross = 2 * l1 * l2 * w1 * w2 * cos(theta1 - theta2)
    load = 0.5 * m * ((l1 * w1) ** 2 + (l2 * w2) ** 2 + cross)
    return 0.5 * mA * (l1 * w1) ** 2 + load


def pendulum_bob_energy(t, q, v, W, l, g):  # noqa: E741
    def position(t, q, params):
        return l * jnp.array([sin(q[0]), -cos(q[0])])

    return jl.energy.particles(position, W / g, t, q, v, None)


KINETIC = {
    "rotating_body_on_frame": rotating_body_on_frame,
    "disk_on_shaft": disk_on_shaft,
    "lamina_two_forces": lamina_two_forces,
    "lamina_two_forces_fixed_direction": lamina_two_forces,
    "lamina_double_pendulum": lamina_double_pendulum,
    "rotating_slender_rod": rotating_slender_rod,
    "two_link_robot_arm": arm,
    "pendulum_bob_energy": pendulum_bob_energy,
}


@pytest.mark.parametrize("name", mostly_full(KINETIC, "lamina_two_forces", "two_link_robot_arm"))
def test_kinetic_energy_agrees_with_another_derivation(name):
    entry = ENTRIES[name]

    @jax.jit
    def both(params, t, q, v):
        return entry.system.kinetic(q, v, params, t=t), KINETIC[name](t, q, v, **params)

    for t, q, v, params in random_states(entry):
        T, other = both(params, t, q, v)
        tolerance = K * EPS * scale_of_T(entry.system, params, t, q, v)
        np.testing.assert_allclose(T, other, rtol=0, atol=tolerance)


def from_pivot(p):
    """Origins (3) and (2) of the physical pendulum from its pivot, in body axes."""
    third = -p["r"] * np.array([np.sin(p["alpha"]), np.cos(p["alpha"]), 0.0])
    return third, third + np.array([p["xb"], p["yb"], 0.0])


def test_energy_of_the_pendulum_is_equal_from_three_origins():
    """The errors are those of the parts of l^2, whose sum is (r + |c|)^2, c = (xb, yb)."""
    entry = ENTRIES["physical_pendulum_three_origins"]
    for t, q, v, p in random_states(entry):
        third, center = from_pivot(p)
        hang = -np.pi / 2 - atan2(center[1], center[0])  # rotates the center to below the pivot
        l2_parts = (p["r"] + np.hypot(p["xb"], p["yb"])) ** 2
        inertia, lever = p["Ic"] + p["M"] * l2_parts, l2_parts / np.linalg.norm(center)
        for origin in (np.zeros(3), center, third):

            def pose(t, q, params, origin=origin, hang=hang):
                R = jl.rotation.about_z(q[0] + hang)
                return R, R @ origin

            c = center - origin
            body = jl.energy.RigidBody(p["M"], (0.0, 0.0, p["Ic"] + p["M"] * (c @ c)), c)
            T = entry.system.kinetic(q, v, p, t=t)
            tolerance = K * EPS * 0.5 * inertia * v[0] ** 2
            np.testing.assert_allclose(body.kinetic(pose, t, q, v, p), T, rtol=0, atol=tolerance)
            V = entry.system.potential(q, params=p, t=t)
            weight = body.gravity(pose, t, q, p, (0.0, -p["g"], 0.0))
            tolerance = K * EPS * p["M"] * p["g"] * lever
            np.testing.assert_allclose(weight, V, rtol=0, atol=tolerance)


def potential_of_the_body_on_frame(t, q, M, xb, yb, zb, theta, g, **others):
    lever = (xb * np.sin(q[1]) + yb * np.cos(q[1])) * np.sin(theta) + zb * np.cos(theta)
    return M * g * lever, M * g * (abs(xb) + abs(yb) + abs(zb))


def potential_of_the_hanging_lamina(t, q, M, Iz, r, xb, yb, g):
    height = r * np.cos(q[0]) + xb * np.cos(q[1]) - yb * np.sin(q[1])
    return -M * g * height, M * g * (r + abs(xb) + abs(yb))


def potential_of_the_arm(t, q, mA, m, l1, l2, g, **others):
    weights = (mA + m) * g * l1, m * g * l2
    return weights @ np.sin(q), sum(weights)


@pytest.mark.parametrize(
    ("name", "by_hand"),
    [
        ("rotating_body_on_frame", potential_of_the_body_on_frame),
        ("lamina_double_pendulum", potential_of_the_hanging_lamina),
        ("two_link_robot_arm", potential_of_the_arm),
    ],
)
def test_potential_equals_the_weight_by_hand(name, by_hand):
    entry = ENTRIES[name]
    for t, q, _, params in random_states(entry):
        V, scale = by_hand(t, q, **params)
        found = entry.system.potential(q, params=params, t=t)
        np.testing.assert_allclose(found, V, rtol=0, atol=K * EPS * scale)


def following_forces(t, q, x1, y1, x2, y2, f1x, f1y, f2x, f2y, **others):
    return [following_force(q, x1, y1, f1x, f1y), following_force(q, x2, y2, f2x, f2y)]


def fixed_forces(t, q, x1, y1, x2, y2, F1X, F1Y, F2X, F2Y, **others):
    return [fixed_force(q, x1, y1, F1X, F1Y), fixed_force(q, x2, y2, F2X, F2Y)]


def motors(t, q, tauO0, tauA0, Omega, **others):
    return motor_forces(t, tauO0, tauA0, Omega)


@pytest.mark.parametrize(
    ("name", "by_hand"),
    [
        ("lamina_two_forces", following_forces),
        ("lamina_two_forces_fixed_direction", fixed_forces),
        ("two_link_robot_arm", motors),
    ],
)
def test_generalized_forces_equal_those_by_hand(name, by_hand):
    """To K eps times the forces: no lever arm here is as long as 1 m."""
    entry = ENTRIES[name]
    for t, q, v, params in random_states(entry):
        terms = by_hand(t, q, **params)
        found = entry.system.generalized_force(q, v, params, t=t)
        tolerance = K * EPS * np.sum(np.linalg.norm(terms, axis=1))
        np.testing.assert_allclose(found, np.sum(terms, axis=0), rtol=0, atol=tolerance)


def velocity_in_body_axes(pose, r, t, q, v, params):
    """Velocity of R r by its derivative, in body axes, and the size of its terms."""

    def position(t, q, params):
        return pose(t, q, params)[0] @ r

    R, _ = pose(t, q, params)
    size = np.sum(np.abs(v)) * np.sum(np.abs(r))
    return R.T @ jl.energy.velocity(position, t, q, v, params), size


def test_velocity_of_the_particle_on_the_frame_agrees_with_the_book():
    """Equations 2.6 and 2.7."""
    for t, q, v, p in random_states(FRAME):
        r2 = np.array([p["x2"], p["y2"], p["z2"]])
        origin, size2 = velocity_in_body_axes(frame_pose, r2, t, q, v, p)
        found = FRAME.extras["v_origin_body"](t, q, v, None, p)
        np.testing.assert_allclose(found, origin, rtol=0, atol=K * EPS * size2)
        r = np.array([p["x"], p["y"], p["z"]])
        relative, size = velocity_in_body_axes(frame_pose, r, t, q, v, p)
        found = FRAME.extras["v_point_body"](t, q, v, None, p)
        tolerance = K * EPS * (size2 + size)
        np.testing.assert_allclose(found, origin + relative, rtol=0, atol=tolerance)


def test_rates_of_the_disk_and_its_particle_agree_with_the_book():
    """Equations 2.8 to 2.10 and 2.14."""
    for t, q, v, p in random_states(DISK):
        from_bend = np.array([p["x"], p["y"], p["z"] + p["s"]])
        expected, size = velocity_in_body_axes(disk_pose, from_bend, t, q, v, p)
        found = DISK.extras["v_point_body"](t, q, v, None, p)
        np.testing.assert_allclose(found, expected, rtol=0, atol=K * EPS * size)

        _, omega = jl.energy.body_velocity(disk_pose, t, q, v, p)
        tolerance = K * EPS * np.sum(np.abs(v))
        found = DISK.extras["omega_body"](t, q, v, None, p)
        np.testing.assert_allclose(found, omega, rtol=0, atol=tolerance)
        found = DISK.extras["omega_fixed"](t, q, v, None, p)
        fixed = disk_pose(t, q, p)[0] @ omega
        np.testing.assert_allclose(found, fixed, rtol=0, atol=tolerance)
        found = DISK.extras["omega_magnitude"](t, q, v, None, p)
        size = np.linalg.norm(omega)
        tolerance *= np.sum(np.abs(v)) / size  # the root of a square of that size
        np.testing.assert_allclose(found, size, rtol=0, atol=tolerance)


def test_moment_on_the_load_equals_the_closed_form():
    """m l2 [l2 theta2'' + l1 (theta1'' cos(d) + theta1'^2 sin(d))] with d = theta2 - theta1."""
    entry = ENTRIES["two_link_robot_arm"]
    for t, q, v, p in random_states(entry):
        a = entry.system.acceleration(q, v, p, t=t)
        m, l1, l2 = p["m"], p["l1"], p["l2"]
        d = q[1] - q[0]
        terms = m * l2 * np.array([l2 * a[1], l1 * a[0] * np.cos(d), l1 * v[0] ** 2 * np.sin(d)])
        t = jnp.asarray(t)
        moment = two_link_robot_arm.load_moment(t, q, v, a, p)
        other = two_link_robot_arm.load_moment_from_momentum(t, q, v, a, p)
        size = m * l2 * (l2 + l1) * np.sum(np.abs(a) + v**2)
        np.testing.assert_allclose(moment, np.sum(terms), rtol=0, atol=K * EPS * size)
        np.testing.assert_allclose(other, moment, rtol=0, atol=K * EPS * size)
