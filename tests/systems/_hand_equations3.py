"""Equations of motion by hand of chapter 3: mass matrix M and terms with M a = sum(terms).

They are the book's if it has them. Those of the spherical pendulum are Lagrange's, those of the
quadcopter are Newton's and Euler's, with the terms of the rotors written out.
"""

import numpy as np
from numpy import cos, sin


def spherical_pendulum_fixed(t, q, v, m, L, g):
    (_, phi), (turn, w) = q, v
    c, s = cos(phi), sin(phi)
    M = np.diag([m * L**2 * s**2, m * L**2])
    return M, [
        [-2 * m * L**2 * s * c * turn * w, m * L**2 * s * c * turn**2],
        [0.0, -m * g * L * s],
    ]


def spherical_pendulum_elastic(t, q, v, m, L0, k, g):
    (L, _, phi), (L_rate, turn, w) = q, v
    c, s = cos(phi), sin(phi)
    M = np.diag([m, m * L**2 * s**2, m * L**2])
    return M, [
        [m * L * w**2, -2 * m * L * L_rate * turn * s**2, -2 * m * L * L_rate * w],
        [m * L * turn**2 * s**2, -2 * m * L**2 * s * c * turn * w, m * L**2 * s * c * turn**2],
        [m * g * c, 0.0, -m * g * L * s],
        [-k * (L - L0), 0.0, 0.0],
    ]


def double_pendulum_forces(t, q, v, m1, m2, l1, l2, g, Fx, Fy, Bx, By, Omega):
    (theta1, theta2), (w1, w2) = q, v
    c, s = cos(theta1 - theta2), sin(theta1 - theta2)
    M = [[(m1 + m2) * l1**2, m2 * l1 * l2 * c], [m2 * l1 * l2 * c, m2 * l2**2]]
    return M, [
        [-m2 * l1 * l2 * w2**2 * s, m2 * l1 * l2 * w1**2 * s],
        [-(m1 + m2) * g * l1 * sin(theta1), -m2 * g * l2 * sin(theta2)],
        *pulls_on_pendulum(t, q, l1, l2, Fx, Fy, Bx, By, Omega),
    ]


def pulls_on_pendulum(t, q, l1, l2, Fx, Fy, Bx, By, Omega):
    """(Q1, Q2) of 3.134, by components of the two forces."""
    (c1, c2), (s1, s2), beat = cos(q), sin(q), cos(Omega * t)
    return [
        [Fx * beat * l1 * c1, Fx * beat * l2 * c2],
        [Fy * beat * l1 * s1, Fy * beat * l2 * s2],
        [Bx * l1 * c1, 0.0],
        [By * l1 * s1, 0.0],
    ]


def quadcopter(t, q, v, m, Ix, Iy, Iz, l, g, k, b, Im, w1, w2, w3, w4):  # noqa: E741
    (_, _, _, psi, theta, phi), rates = q, v[3:]
    _, theta_rate, phi_rate = rates
    c_th, s_th, c_ph, s_ph = cos(theta), sin(theta), cos(phi), sin(phi)
    W = np.array([[-s_th, 0.0, 1.0], [c_th * s_ph, c_ph, 0.0], [c_th * c_ph, -s_ph, 0.0]])
    W_theta = np.array([[-c_th, 0.0, 0.0], [-s_th * s_ph, 0.0, 0.0], [-s_th * c_ph, 0.0, 0.0]])
    W_phi = np.array([[0.0, 0.0, 0.0], [c_th * c_ph, -s_ph, 0.0], [-c_th * s_ph, -c_ph, 0.0]])
    moments = np.array([Ix, Iy, Iz])
    M = np.zeros((6, 6))
    M[:3, :3], M[3:, 3:] = m * np.eye(3), moments[:, None] * W
    f1, f2, f3, f4 = k * w1**2, k * w2**2, k * w3**2, k * w4**2
    omega = W @ rates
    spin = np.array([0.0, 0.0, Im * (-w1 + w2 - w3 + w4)])
    thrust = (f1 + f2 + f3 + f4) * np.array(
        [
            c_ph * s_th * cos(psi) + s_ph * sin(psi),
            c_ph * s_th * sin(psi) - s_ph * cos(psi),
            c_ph * c_th,
        ]
    )
    forces = [thrust, [0.0, 0.0, -m * g]]
    torques = [
        -moments * (theta_rate * W_theta @ rates),
        -moments * (phi_rate * W_phi @ rates),
        -np.cross(omega, moments * omega),
        [f2 * l, f3 * l, b * (w1**2 + w3**2)],
        [-f4 * l, -f1 * l, -b * (w2**2 + w4**2)],
        -np.cross(omega, spin),
    ]
    zeros = np.zeros(3)
    return M, [np.concatenate([x, zeros]) for x in forces] + [
        np.concatenate([zeros, x]) for x in torques
    ]


def disk_on_moving_cart(t, q, v, m0, m, R, theta, K1, K2, b, F1, Omega, g):
    X, x1 = q
    c = cos(theta)
    M = [[m0 + m, m * c], [m * c, 1.5 * m]]
    drive = drive_on_disk(t, theta, F1, Omega)
    return M, [[-K2 * X, -K1 * x1], [-b * v[0], 0.0], drive]


def drive_on_disk(t, theta, F1, Omega):
    """(Q_X, Q_x1) of the force on the disk's center."""
    F = F1 * cos(Omega * t)
    return [F, F * cos(theta)]


def two_carts_spring(t, q, v, m1, m2, k, l0, F1):
    x1, x2 = q
    pull1, pull2, rest = k * x1, k * x2, k * l0
    return np.diag([m1, m2]), [[pull2, -pull2], [-pull1, pull1], [-rest, rest], [F1, 0.0]]


def hockey_puck(t, q, v, M, kappa, R, F1):
    return np.diag([M * kappa**2, M, M]), [push_on_puck(q[0], R, F1)]


def hockey_puck_cord(t, q, v, M, kappa, R, F1, gamma):
    return np.diag([M * kappa**2, M, M]), [push_on_puck(gamma, R, F1)]


def push_on_puck(direction, R, F1):
    """(Q_theta, Q_x, Q_y) of a force with the lever arm R about the center."""
    return [F1 * R, F1 * cos(direction), F1 * sin(direction)]


def symmetric_plane_pendulum(t, q, v, M, IG, L, g):
    return [[IG + M * L**2]], [[-M * g * L * sin(q[0])]]


def atwood_machine(t, q, v, m1, m2, m3, kappa, R, g):
    return [[m1 + m2 + m3 * kappa**2 / R**2]], [[m1 * g], [-m2 * g]]


def falling_stick(t, q, v, m, L, g):
    (_, theta), (_, w) = q, v
    c, s = cos(theta), sin(theta)
    M = np.diag([m, m * L**2 / 12 + 0.25 * m * L**2 * c**2])
    return M, [[0.0, 0.25 * m * L**2 * w**2 * s * c], [0.0, -0.5 * m * g * L * c]]


HAND_EQUATIONS = {
    function.__name__: function
    for function in (
        spherical_pendulum_fixed,
        spherical_pendulum_elastic,
        double_pendulum_forces,
        quadcopter,
        disk_on_moving_cart,
        two_carts_spring,
        hockey_puck,
        hockey_puck_cord,
        symmetric_plane_pendulum,
        atwood_machine,
        falling_stick,
    )
}
