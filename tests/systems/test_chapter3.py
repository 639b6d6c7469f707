"""Chapter 3: energies, forces and reactions by two derivations, by hand and by points and poses.

If the system's file has one of the two, this file has the other.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _hand_equations3 import drive_on_disk, pulls_on_pendulum, push_on_puck
from _scales import scale_of_T
from _states import random_states
from jax.numpy import cos, sin

import jaxlag as jl
from jaxlag import energy, rotation
from systems.catalogue import ENTRIES
from systems.catalogue.chapter3.falling_stick import center as stick_center
from systems.catalogue.chapter3.falling_stick import normal_force
from systems.catalogue.chapter3.spherical_pendulum_fixed import tension
from systems.catalogue.chapter3.symmetric_plane_pendulum import pin_reaction

K = 32
EPS = np.finfo(float).eps


def straight(t, q, v, *masses):
    """T of masses along parallel lines, one coordinate for each."""
    return energy.particles(lambda t, q, _: q[:, None], jnp.stack(masses), t, q, v, None)


def planar(mass, about_origin, pose, t, q, v, center=(0.0, 0.0, 0.0)):
    """T of a body in the plane; `pose(q)` gives its angle and the x, y of its origin."""

    def in_space(t, q, _):
        angle, x, y = pose(q)
        return rotation.about_z(angle), jnp.stack([x, y, 0.0])

    body = energy.RigidBody(mass, jnp.stack([0.0, 0.0, about_origin]), jnp.array(center))
    return body.kinetic(in_space, t, q, v, None)


def on_strings(lengths, q):
    """Positions of bobs, each suspended from the one before; q from the downward vertical."""
    links = jnp.stack(lengths)[:, None] * jnp.stack([sin(q), -cos(q)], axis=1)
    return jnp.cumsum(links, axis=0)


def mass_spring(t, q, v, m, **others):
    return straight(t, q, v, m)


def two_masses(t, q, v, m1, m2, **others):
    return straight(t, q, v, m1, m2)


def simple_pendulum(t, q, v, m1, h1, **others):
    return energy.particles(lambda t, q, _: on_strings([h1], q)[0], m1, t, q, v, None)


def double_pendulum(t, q, v, m1, m2, h1, h2, **others):
    masses = jnp.stack([m1, m2])
    return energy.particles(lambda t, q, _: on_strings([h1, h2], q), masses, t, q, v, None)


def double_pendulum_forces(t, q, v, m1, m2, l1, l2, **others):
    (theta1, theta2), (w1, w2) = q, v
    cross = 2 * l1 * l2 * w1 * w2 * cos(theta1 - theta2)
    return 0.5 * m1 * (l1 * w1) ** 2 + 0.5 * m2 * ((l1 * w1) ** 2 + (l2 * w2) ** 2 + cross)


def sleeve_pendulum(t, q, v, M1, M2, IA, IG, **others):
    rod = planar(M1, IA, lambda q: (q[1], 0.0, 0.0), t, q, v)

    def on_rod(q):
        x1, theta = q
        return theta, x1 * sin(theta), -x1 * cos(theta)

    return rod + planar(M2, IG, on_rod, t, q, v)


def cart_pendulum(t, q, v, m1, m2, l, **others):  # noqa: E741
    """The rod about its pin, where its inertia is m2 l^2/3; body y points up the rod."""
    center = (0.0, -0.5 * l, 0.0)
    rod = planar(m2, m2 * l**2 / 3, lambda q: (q[1], q[0], 0.0), t, q, v, center)
    return straight(t, q[:1], v[:1], m1) + rod


def central_motion(t, q, v, m, **others):
    def position(t, q, _):
        return q[0] * jnp.stack([cos(q[1]), sin(q[1])])

    return energy.particles(position, m, t, q, v, None)


def swung(L, theta, phi):
    """Position of the bob of a spherical pendulum (3.3)."""
    return L * jnp.stack([cos(theta) * sin(phi), sin(theta) * sin(phi), -cos(phi)])


def spherical_pendulum_fixed(t, q, v, m, L, **others):
    return energy.particles(lambda t, q, _: swung(L, *q), m, t, q, v, None)


def spherical_pendulum_elastic(t, q, v, m, **others):
    return energy.particles(lambda t, q, _: swung(*q), m, t, q, v, None)


def quadcopter(t, q, v, m, Ix, Iy, Iz, **others):
    def pose(t, q, _):
        about_z, about_y = rotation.about_z(q[3]), rotation.about_y(q[4])
        return about_z @ about_y @ rotation.about_x(q[5]), q[:3]

    return energy.RigidBody(m, jnp.stack([Ix, Iy, Iz])).kinetic(pose, t, q, v, None)


def disk_on_moving_cart(t, q, v, m0, m, theta, **others):
    X_rate, x1_rate = v
    center_squared = X_rate**2 + 2 * X_rate * x1_rate * cos(theta) + x1_rate**2
    return 0.5 * m0 * X_rate**2 + 0.5 * m * center_squared + 0.25 * m * x1_rate**2


def puck(t, q, v, M, kappa, **others):
    return planar(M, M * kappa**2, tuple, t, q, v)


def symmetric_plane_pendulum(t, q, v, M, IG, L, **others):
    """The body about its mass center."""
    return planar(M, IG, lambda q: (q[0], L * sin(q[0]), -L * cos(q[0])), t, q, v)


def atwood_machine(t, q, v, m1, m2, m3, kappa, R, g):
    hung = jnp.stack([m1, m2])
    masses = energy.particles(lambda t, q, _: jnp.stack([-q, q]), hung, t, q, v, None)
    pulley = planar(m3, m3 * kappa**2, lambda q: (q[0] / R, 0.0, 0.0), t, q, v)
    return masses + pulley


def falling_stick(t, q, v, m, L, g):
    x_rate, w = v
    center_squared = x_rate**2 + 0.25 * L**2 * cos(q[1]) ** 2 * w**2
    return 0.5 * m * center_squared + 0.5 * (m * L**2 / 12) * w**2


KINETIC = {
    "mass_spring": mass_spring,
    "two_mass_three_springs": two_masses,
    "simple_pendulum": simple_pendulum,
    "double_pendulum": double_pendulum,
    "double_pendulum_forces": double_pendulum_forces,
    "double_pendulum_rayleigh": double_pendulum,
    "quadcopter": quadcopter,
    "mass_spring_dashpot": mass_spring,
    "sleeve_pendulum": sleeve_pendulum,
    "cart_pendulum": cart_pendulum,
    "spherical_pendulum_fixed": spherical_pendulum_fixed,
    "spherical_pendulum_elastic": spherical_pendulum_elastic,
    "disk_on_moving_cart": disk_on_moving_cart,
    "two_carts_spring": two_masses,
    "hockey_puck": puck,
    "hockey_puck_cord": puck,
    "symmetric_plane_pendulum": symmetric_plane_pendulum,
    "atwood_machine": atwood_machine,
    "falling_stick": falling_stick,
    "central_motion": central_motion,
}


@pytest.mark.parametrize(
    "name", mostly_full(KINETIC, "cart_pendulum", "spherical_pendulum_elastic", "quadcopter")
)
def test_kinetic_energy_agrees_with_another_derivation(name):
    entry = ENTRIES[name]

    @jax.jit
    def both(params, t, q, v):
        return entry.system.kinetic(q, v, params, t=t), KINETIC[name](t, q, v, **params)

    for t, q, v, params in random_states(entry):
        T, other = both(params, t, q, v)
        tolerance = K * EPS * scale_of_T(entry.system, params, t, q, v)
        np.testing.assert_allclose(T, other, rtol=0, atol=tolerance)


POTENTIAL = {
    "double_pendulum_forces": lambda q, m1, m2, l1, l2, g, **others: [
        -(m1 + m2) * g * l1 * np.cos(q[0]),
        -m2 * g * l2 * np.cos(q[1]),
    ],
    "falling_stick": lambda q, m, L, g: [0.5 * m * g * L * np.sin(q[1])],
}
"""Name -> terms of V by hand, if the file has points."""


@pytest.mark.parametrize("name", POTENTIAL)
def test_potential_by_points_equals_that_by_hand(name):
    entry = ENTRIES[name]
    for t, q, _, params in random_states(entry):
        terms = POTENTIAL[name](q, **params)
        V = entry.system.potential(q, params=params, t=t)
        np.testing.assert_allclose(V, sum(terms), rtol=0, atol=K * EPS * np.sum(np.abs(terms)))


def rotor_forces(t, q, v, m, Ix, Iy, Iz, l, g, k, b, Im, w1, w2, w3, w4):  # noqa: E741
    """Q of thrust and torques; those of the angles are W^T times the torques in body axes."""
    psi, theta, phi = q[3:]
    psi_rate, theta_rate, phi_rate = v[3:]
    c_th, s_th, c_ph, s_ph = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
    omega_x = phi_rate - psi_rate * s_th
    omega_y = theta_rate * c_ph + psi_rate * c_th * s_ph
    f1, f2, f3, f4 = k * w1**2, k * w2**2, k * w3**2, k * w4**2
    spin = Im * (-w1 + w2 - w3 + w4)
    thrust = f1 + f2 + f3 + f4
    across = thrust * c_ph * s_th * np.array([np.cos(psi), np.sin(psi), 0.0])
    aside = thrust * s_ph * np.array([np.sin(psi), -np.cos(psi), 0.0])
    forces = [across, aside, np.array([0.0, 0.0, thrust * c_ph * c_th])]
    about_x = np.array([-s_th, 0.0, 1.0])
    about_y = np.array([c_th * s_ph, c_ph, 0.0])
    about_z = np.array([c_th * c_ph, -s_ph, 0.0])
    torques = [
        *(f2 * l * about_x, -f4 * l * about_x, -omega_y * spin * about_x),
        *(f3 * l * about_y, -f1 * l * about_y, omega_x * spin * about_y),
        *(b * w**2 * about_z for w in (w1, w3)),
        *(-b * w**2 * about_z for w in (w2, w4)),
    ]
    zeros = np.zeros(3)
    return [np.append(x, zeros) for x in forces] + [np.append(zeros, x) for x in torques]


FORCES = {
    "double_pendulum_forces": lambda t, q, v, m1, m2, g, **others: pulls_on_pendulum(
        t, q, **others
    ),
    "quadcopter": rotor_forces,
    "disk_on_moving_cart": lambda t, q, v, theta, F1, Omega, **others: [
        drive_on_disk(t, theta, F1, Omega)
    ],
    "hockey_puck": lambda t, q, v, R, F1, **others: [push_on_puck(q[0], R, F1)],
    "hockey_puck_cord": lambda t, q, v, R, F1, gamma, **others: [push_on_puck(gamma, R, F1)],
}
"""Name -> terms of Q by hand without dampers, if the file has forces at points."""


@pytest.mark.parametrize("name", FORCES)
def test_forces_at_points_equal_generalized_forces_by_hand(name):
    entry = ENTRIES[name]
    drives = [force.name for force in entry.system.forces if not isinstance(force, jl.Rayleigh)]
    for t, q, v, params in random_states(entry):
        terms = np.array(FORCES[name](t, q, v, **params))
        Q = entry.system.generalized_force(q, v, params, t=t, names=drives)
        tolerance = K * EPS * np.max(np.sum(np.abs(terms), axis=0))
        np.testing.assert_allclose(Q, np.sum(terms, axis=0), rtol=0, atol=tolerance)


def rod_end(t, q, params):
    x, theta = q
    return jnp.stack([x + params["l"] * sin(theta), -params["l"] * cos(theta)])


def rod_end_force(t, q, v, params):
    return jnp.stack([params["F2"] * sin(params["Omega"] * t), 0.0])


def sleeve_end(t, q, params):
    x1, theta = q
    return (x1 + 0.5 * params["L2"]) * jnp.stack([sin(theta), -cos(theta)])


def sleeve_end_force(t, q, v, params):
    return jnp.stack([params["F0"] * cos(params["omega"] * t), 0.0])


@pytest.mark.parametrize(
    ("name", "by_hand", "by_point"),
    [
        ("cart_pendulum", "rod end", jl.PointForce(rod_end, rod_end_force, "end")),
        ("sleeve_pendulum", "drive", jl.PointForce(sleeve_end, sleeve_end_force, "end")),
    ],
)
def test_generalized_forces_by_hand_equal_those_of_points(name, by_hand, by_point):
    system = ENTRIES[name].system
    for t, q, v, params in random_states(ENTRIES[name]):
        Q = system.generalized_force(q, v, params, t=t, names=[by_hand])
        other = by_point(*map(jnp.asarray, (t, q, v)), params, {})
        tolerance = K * EPS * np.max(np.abs(Q))
        np.testing.assert_allclose(Q, other, rtol=0, atol=tolerance)


def plane_center(t, q, params):
    return params["L"] * jnp.stack([sin(q[0]), -cos(q[0])])


def bob(t, q, params):
    return swung(params["L"], *q)


def along_string(force, q, params):
    return -force @ bob(0.0, q, params) / params["L"]


@pytest.mark.parametrize(
    ("name", "reaction", "mass", "center", "component"),
    [
        ("spherical_pendulum_fixed", tension, "m", bob, along_string),
        (
            "symmetric_plane_pendulum",
            pin_reaction,
            "M",
            plane_center,
            lambda force, q, params: force,
        ),
        ("falling_stick", normal_force, "m", stick_center, lambda force, q, params: force[1]),
    ],
)
def test_reactions_equal_mass_times_acceleration_less_gravity(
    name, reaction, mass, center, component
):
    """m (a_G - g) of the mass center, for any accelerations."""
    rng = np.random.default_rng(3)
    for t, q, v, params in random_states(ENTRIES[name]):
        a = rng.uniform(-5.0, 5.0, len(q))

        def velocity(q, v, t=t, params=params):
            return energy.velocity(center, t, q, v, params)

        _, acceleration = jax.jvp(velocity, (q, v), (v, a))
        force = params[mass] * acceleration.at[-1].add(params["g"])
        size = params["g"] + params["L"] * (np.sum(np.abs(a)) + np.sum(np.abs(v)) ** 2)
        np.testing.assert_allclose(
            reaction(t, q, v, a, params),
            component(force, q, params),
            rtol=0,
            atol=K * EPS * params[mass] * size,
        )
