"""Bodies in body rates: closed forms of tops, equations by hand, the origin of body axes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _closed_forms import close, move, space_axes
from _states import random_states
from numpy import cos, sin
from scipy.special import ellipj, ellipkinc

from systems.catalogue import ENTRIES

# ---- Tops ----------------------------------------------------------------------------------------


def free_rates(times, moments, w0):
    """omega of the free body by Jacobi's functions, shape (s, 3)."""
    moments, w0 = np.asarray(moments), np.asarray(w0)
    twice, square = moments @ w0**2, (moments**2) @ w0**2
    a, b, c = np.argsort(moments)
    if square < twice * moments[b]:
        a, c = c, a  # about the axis of the least moment
    A, B, C = moments[[a, b, c]]
    about_c = (square - twice * A) / (C * (C - A))
    about_b = (twice * C - square) / (B * (C - B))
    about_a = (twice * C - square) / (A * (C - A))
    rate = np.sqrt((C - B) * (square - twice * A) / (A * B * C))
    m = (B - A) * (twice * C - square) / ((C - B) * (square - twice * A))
    even = np.linalg.det(np.eye(3)[[a, b, c]])
    sign_c = np.sign(w0[c])
    sign_b = sign_c * np.sign(C - A) * even  # by B wB' = (C - A) wC wA if even
    sine, cosine = sign_b * w0[b] / np.sqrt(about_b), w0[a] / np.sqrt(about_a)
    tau = ellipkinc(np.arctan2(sine, cosine), m) + rate * times
    sn, cn, dn, _ = ellipj(tau, m)
    w = np.empty((len(times), 3))
    w[:, a], w[:, b] = np.sqrt(about_a) * cn, sign_b * np.sqrt(about_b) * sn
    w[:, c] = sign_c * np.sqrt(about_c) * dn
    return w


TOPS = {
    "largest": ((1.0, 2.0, 3.0), (0.3, 0.4, -1.2)),
    "least": ((1.0, 2.0, 3.0), (1.2, 0.3, 0.2)),
    "odd order": ((2.5, 1.0, 1.8), (0.9, -0.4, 0.5)),
    "flip": ((2.0, 1.0, 3.0), (1.5, 0.02, 0.03)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", TOPS)
def test_free_top_agrees_with_elliptic_functions(name):
    moments, w0 = TOPS[name]
    params = dict(zip(("I1", "I2", "I3"), moments, strict=True))
    times, start = np.linspace(0.0, 8.0, 13), (0.3, -0.1, 0.4)
    motion = move("torque_free_asymmetric_top", params, start, w0, times)
    expected = free_rates(times, moments, w0)
    close(motion.u, expected)
    if name == "flip":
        assert expected[:, 0].min() < -1.4  # it flipped
    K = [
        space_axes(q) @ (moments * u)
        for q, u in zip(*map(np.asarray, (motion.q, motion.u)), strict=True)
    ]
    close(K, np.tile(K[0], (13, 1)))


@pytest.mark.full
def test_torque_free_body_of_the_book_equals_the_free_top():
    """The same system under another name, without its torques."""
    moments, w0 = TOPS["largest"]
    params = dict(zip(("Ix", "Iy", "Iz"), moments, strict=True))
    params |= dict.fromkeys(("tau1", "tau2", "tau3"), 0.0)
    times = np.linspace(0.0, 3.0, 6)
    motion = move("rigid_body_roll_pitch_yaw", params, (0.3, -0.1, 0.4), w0, times)
    close(motion.u, free_rates(times, moments, w0))


LAGRANGE = {
    "cusps": (0.6, (0.0, 0.0, 60.0)),
    "loops": (0.9, (0.5, -1.2, 50.0)),
    "falling": (1.1, (-0.4, 2.0, 55.0)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", LAGRANGE)
def test_heavy_top_agrees_with_elliptic_functions(name):
    """cos(theta) by sn^2 between its turning points, and phi', psi' by the momenta."""
    theta0, (w1, w2, w3) = LAGRANGE[name]
    m, g, l, I1, I3 = 0.5, 9.81, 0.1, 0.008, 0.002  # noqa: E741
    params = {"m": m, "g": g, "l": l, "I1": I1, "I3": I3}
    times = np.linspace(0.0, 1.0, 11)
    motion = move("heavy_symmetric_top", params, (0.4, theta0, -0.2), (w1, w2, w3), times)

    x0, weight = cos(theta0), m * g * l
    p_phi, p_psi = I1 * w2 * sin(theta0) + I3 * w3 * x0, I3 * w3
    rest = 0.5 * I1 * (w1**2 + w2**2) + weight * x0  # E - p_psi^2/(2 I3)
    cubic = np.polymul([-2 / I1 * weight, 2 / I1 * rest], [-1.0, 0.0, 1.0])
    cubic = np.polysub(cubic, np.polymul([-p_psi, p_phi], [-p_psi, p_phi]) / I1**2)
    x1, x2, x3 = np.sort(np.roots(cubic).real)
    if name == "cusps":
        x2 = x0  # a turning point, to all digits
    rate, parameter = np.sqrt(weight * (x3 - x1) / (2 * I1)), (x2 - x1) / (x3 - x1)
    amplitude = np.arcsin(np.sqrt(np.clip((x0 - x1) / (x2 - x1), 0.0, 1.0)))
    begin = np.copysign(ellipkinc(amplitude, parameter), -w1 * sin(theta0))
    sn, cn, dn, _ = ellipj(rate * times + begin, parameter)
    x = x1 + (x2 - x1) * sn**2
    close(cos(motion["theta"]), x)
    s = np.sqrt(1 - x**2)
    close(motion["w1"], -2 * rate * (x2 - x1) * sn * cn * dn / s)
    close(motion["w2"], (p_phi - p_psi * x) / (I1 * s))
    close(motion["w3"], np.full(11, w3))
    close(motion.rate("phi"), (p_phi - p_psi * x) / (I1 * s**2))


# ---- Equations of motion at random states --------------------------------------------------------


def accelerations(name):
    """(t, q, v, params, u, u') at random states, u' along the motion."""
    entry = ENTRIES[name]

    @jax.jit
    def at(t, q, v, params):
        a = entry.system.acceleration(q, v, params, t=t)
        arguments = (jnp.ones_like(t), v, a)
        return jax.jvp(partial(velocities, entry.system, params), (t, q, v), arguments)

    for t, q, v, params in random_states(entry):
        u, u_rate = at(jnp.asarray(t), jnp.asarray(q), jnp.asarray(v), params)
        yield t, q, v, params, np.asarray(u), np.asarray(u_rate)


def velocities(system, params, t, q, v):
    return system.quasi_velocities(q, v, params, t=t)


ROUNDING = 1e-13
"""Tolerance of equations of motion at one state. Largest error: 1.2e-14, of the aircraft."""


def test_the_tricycle_obeys_the_reduced_equations():
    for _, q, _, p, u, u_rate in accelerations("tricycle"):
        (v, _, _, steer), c, s = u, cos(q[3]), sin(q[3])
        m, l, J = p["m"], p["l"], p["I_body"] + p["m"] * p["d"] ** 2  # noqa: E741
        v_rate = p["F_v"] - p["tau"] * s / l - (J / l**2 - m) * s * c * v * steer
        v_rate /= m * c**2 + J * s**2 / l**2
        turn_rate = (v_rate * s + v * c * steer) / l
        close(u_rate, [v_rate, 0.0, 0.0, p["tau"] / p["I_steer"] - turn_rate], ROUNDING)


@pytest.mark.full
def test_the_printed_tricycle_obeys_its_own_equations():
    """With the steering torque m v^2 tan(phi), which the consistent tricycle does not have."""
    for _, q, _, p, u, u_rate in accelerations("tricycle_book_lagrangian"):
        (v, _, _, steer), c, s = u, cos(q[3]), sin(q[3])
        m, l, inertia = p["m"], p["l"], p["I_theta"]  # noqa: E741
        v_rate = p["F_v"] - inertia * s * c * steer * v / l**2 - m * v * steer * s / c
        v_rate /= m + inertia * s**2 / l**2
        steer_rate = (p["tau"] + m * v**2 * s / c) / p["I_phi"]
        close(u_rate, [v_rate, 0.0, 0.0, steer_rate], ROUNDING)


@pytest.mark.full
def test_the_aircraft_obeys_the_pair_of_body_axis_equations():
    """m (V' + ...) = F + m g k and I_O omega' + ... = M + m g rc x k, solved for (V', omega')."""
    cross = np.cross
    for _, q, _, p, u, u_rate in accelerations("rigid_aircraft"):
        V, w, k = u[:3], u[3:], space_axes(q[3:])[2]
        rc, m, weight = np.array([p["xc"], p["yc"], p["zc"]]), p["m"], p["m"] * p["g"]
        I_O = np.array(
            [
                [p["Ix"], -p["Ixy"], -p["Ixz"]],
                [-p["Ixy"], p["Iy"], -p["Iyz"]],
                [-p["Ixz"], -p["Iyz"], p["Iz"]],
            ]
        )
        V_rate, w_rate = u_rate[:3], u_rate[3:]
        left = m * (V_rate + cross(w, V) + cross(w_rate, rc) + cross(w, cross(w, rc)))
        close(left, np.array([p["Fx"], p["Fy"], p["Fz"]]) + weight * k, ROUNDING)
        left = I_O @ w_rate + cross(w, I_O @ w) + m * cross(rc, V_rate + cross(w, V))
        close(left, np.array([p["Mx"], p["My"], p["Mz"]]) + weight * cross(rc, k), ROUNDING)


@pytest.mark.full
def test_the_quadcopter_obeys_the_body_axis_equations():
    for _, attitude, _, x, rates, u_rate in accelerations("quadcopter_body_axes"):
        (phi, theta), (u, v, w, p, q, r) = attitude[3:5], rates
        lift, drag, g = x["k"] * x["omega"] ** 2, x["b"] * x["omega"] ** 2, x["g"]
        H = x["Jr"] * (np.sum(x["omega"][1::2]) - np.sum(x["omega"][::2]))
        expected = [
            r * v - q * w - g * sin(theta),
            p * w - r * u + g * cos(theta) * sin(phi),
            q * u - p * v + g * cos(theta) * cos(phi) - np.sum(lift) / x["m"],
            ((lift[1] - lift[3]) * x["l"] - q * H - (x["Iz"] - x["Iy"]) * q * r) / x["Ix"],
            ((lift[0] - lift[2]) * x["l"] + p * H - (x["Ix"] - x["Iz"]) * p * r) / x["Iy"],
            (drag @ [1, -1, 1, -1] - (x["Iy"] - x["Ix"]) * p * q) / x["Iz"],
        ]
        close(u_rate, expected, ROUNDING)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "torques"),
    [
        ("rigid_body_roll_pitch_yaw", lambda t, w, p: [p["tau1"], p["tau2"], p["tau3"]]),
        (
            "euler_rotational_equations",
            lambda t, w, p: (
                np.array([p["t1"] * sin(p["nu"] * t), p["t2"] * cos(p["nu"] * t), p["t3"]])
                - p["c"] * w
            ),
        ),
    ],
)
def test_the_body_obeys_eulers_equations_at_every_angle(name, torques):
    """Not only at small angles."""
    for t, _, _, p, w, w_rate in accelerations(name):
        moments = np.array([p["Ix"], p["Iy"], p["Iz"]])
        left = moments * w_rate + np.cross(w, moments * w)
        close(left, torques(t, w, p), ROUNDING)


def test_particle_obeys_newton_in_rotating_axes():
    """m (V' + w x V) = F, with w of the prescribed attitude."""
    for t, _, _, p, V, V_rate in accelerations("body_axis_translation"):
        angles = p["phi0"] + p["phi1"] * t, p["theta0"] + p["theta1"] * sin(p["nu"] * t)
        phi_rate, psi_rate = p["phi1"], p["psi1"]
        theta_rate = p["theta1"] * p["nu"] * cos(p["nu"] * t)
        (c_ph, c_th), (s_ph, s_th) = cos(angles), sin(angles)
        w = [
            phi_rate - psi_rate * s_th,
            theta_rate * c_ph + psi_rate * c_th * s_ph,
            psi_rate * c_th * c_ph - theta_rate * s_ph,
        ]
        close(p["m"] * (V_rate + np.cross(w, V)), [p["Fx"], p["Fy"], p["Fz"]], ROUNDING)


# ---- The origin of body axes ---------------------------------------------------------------------

FROM_O = dict(ENTRIES["rigid_aircraft"].example.params)
POINT = np.array([0.7, -0.4, 0.2])
"""A point of the body, from O."""


def about_center(p):
    """(parameters with the mass center as origin, rc): moments by Steiner and Varignon."""
    rc, force = (np.array([p[name] for name in names]) for names in (CENTER, FORCE))
    moments, products, torque = (
        np.array([p[name] for name in names]) for names in (MOMENTS, PRODUCTS, TORQUE)
    )
    moments = moments - p["m"] * (rc @ rc - rc**2)
    products = products - p["m"] * np.array([rc[0] * rc[1], rc[0] * rc[2], rc[1] * rc[2]])
    torque = torque - np.cross(rc, force)
    new = {
        **dict.fromkeys(CENTER, 0.0),
        **dict(zip(MOMENTS, moments, strict=True)),
        **dict(zip(PRODUCTS, products, strict=True)),
        **dict(zip(TORQUE, torque, strict=True)),
    }
    return p | new, rc


CENTER, FORCE, TORQUE = ("xc", "yc", "zc"), ("Fx", "Fy", "Fz"), ("Mx", "My", "Mz")
MOMENTS, PRODUCTS = ("Ix", "Iy", "Iz"), ("Ixy", "Ixz", "Iyz")


@pytest.mark.full
def test_motion_of_the_aircraft_does_not_depend_on_the_origin():
    """Positions of one point of the body, attitudes and energies are equal."""
    from_G, rc = about_center(FROM_O)
    angles, V, w = np.array([0.1, 0.2, 0.4]), np.array([18.0, 1.0, 2.0]), np.array([0.3, 0.2, -0.2])
    times, at_O = np.linspace(0.0, 2.0, 6), np.array([10.0, -5.0, -100.0])
    at_G = at_O + space_axes(angles) @ rc
    one = move("rigid_aircraft", FROM_O, [*at_O, *angles], [*V, *w], times)
    start = [*at_G, *angles], [*(V + np.cross(w, rc)), *w]
    other = move("rigid_aircraft", from_G, *start, times)

    def point(motion, r):
        return [q[:3] + space_axes(q[3:]) @ r for q in np.asarray(motion.q)]

    close(point(one, POINT), point(other, POINT - rc))
    close(one.q[:, 3:], other.q[:, 3:])
    close(one.u[:, 3:], other.u[:, 3:])
    close(one.energy, other.energy)


@pytest.mark.full
def test_the_mass_center_of_the_aircraft_falls_freely():
    """Without forces it moves on a parabola, although O does not."""
    p = FROM_O | dict.fromkeys((*FORCE, *TORQUE), 0.0)
    rc, times = np.array([p[name] for name in CENTER]), np.linspace(0.0, 1.5, 6)
    motion = move("rigid_aircraft", p, [0.0] * 6, (5.0, 0.5, -0.4, 0.6, -0.8, 0.5), times)
    fallen = np.array([q[:3] + space_axes(q[3:]) @ rc for q in np.asarray(motion.q)])
    rate = np.array([5.0, 0.5, -0.4]) + np.cross([0.6, -0.8, 0.5], rc)
    gravity = np.array([0.0, 0.0, p["g"]])
    close(fallen, rc + times[:, None] * rate + 0.5 * times[:, None] ** 2 * gravity)
    close(motion.energy, np.full(6, motion.energy[0]))


@pytest.mark.full
def test_motion_under_a_yawing_force_has_its_closed_form():
    """X'' + i Y'' = (Fx + i Fy)/m e^(i psi), psi = psi0 + psi1 t."""
    entry = ENTRIES["body_axis_translation"]
    p = dict.fromkeys(entry.example.params, 0.0)
    p |= {"m": 2.0, "Fx": 1.0, "Fy": -0.5, "Fz": 0.3, "nu": 1.0, "psi0": 0.2, "psi1": 0.9}
    times = np.linspace(0.0, 4.0, 6)
    motion = move("body_axis_translation", p, (0.0, 1.0, -2.0), (3.0, 0.5, -0.2), times)
    force, rotation = (
        (p["Fx"] + 1j * p["Fy"]) / p["m"],
        np.exp(1j * (p["psi0"] + p["psi1"] * times)),
    )
    rate0 = (3.0 + 0.5j) * rotation[0]
    rate = rate0 + force * (rotation - rotation[0]) / (1j * p["psi1"])
    z = 1j + rate0 * times
    z += (
        force
        * ((rotation - rotation[0]) / (1j * p["psi1"]) - rotation[0] * times)
        / (1j * p["psi1"])
    )
    Z = -2.0 - 0.2 * times + 0.5 * p["Fz"] / p["m"] * times**2
    close(motion.q, np.column_stack([z.real, z.imag, Z]))
    body = rate / rotation
    w = -0.2 + p["Fz"] / p["m"] * times
    close(motion.u, np.column_stack([body.real, body.imag, w]))
