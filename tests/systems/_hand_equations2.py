"""Equations of motion by hand of chapter 2: mass matrix M and terms with M a = sum(terms)."""

import numpy as np
from numpy import cos, cross, sin


def rotating_body_on_frame(t, q, v, M, A, B, C, xb, yb, zb, theta, g, tau, **points):
    """Euler's equation about O, projected on both axes of rotation, vertical and shaft."""
    (_, phi), (_, phi_rate) = q, v
    c = np.array([xb, yb, zb])
    inertia = np.diag([A, B, C]) + M * (c @ c * np.eye(3) - np.outer(c, c))
    up = np.array([sin(theta) * sin(phi), sin(theta) * cos(phi), cos(theta)])
    axes = np.stack([up, [0.0, 0.0, 1.0]])
    axes_rate = np.stack([cross(up, [0.0, 0.0, phi_rate]), np.zeros(3)])
    omega = v @ axes
    return axes @ inertia @ axes.T, [
        -axes @ inertia @ (v @ axes_rate),
        -axes @ cross(omega, inertia @ omega),
        axes @ cross(c, -M * g * up),
        [tau, 0.0],
    ]


def disk_on_shaft(t, q, v, M, It, Ia, s, theta, tau0, Omega, c, **point):
    coupling = Ia * cos(theta)
    about_Z1 = (M * s**2 + It) * sin(theta) ** 2 + coupling * cos(theta)
    return [[about_Z1, coupling], [coupling, Ia]], [[tau0 * cos(Omega * t), -c * v[1]]]


def physical_pendulum_three_origins(t, q, v, M, Ic, r, alpha, xb, yb, g):
    along = xb * sin(alpha) + yb * cos(alpha)
    l = np.sqrt(xb**2 + yb**2 + r**2 - 2 * r * along)  # noqa: E741
    Iz = Ic + M * (xb**2 + yb**2)
    return [[M * r**2 + Iz - 2 * M * r * along]], [[-M * g * l * sin(q[0])]]


def _lamina(q, v, M, Iz, xb, yb):
    c, s, w = cos(q[2]), sin(q[2]), v[2]
    X, Y = xb * c - yb * s, xb * s + yb * c  # mass center relative to O, along x and y
    mass = [[M, 0.0, -M * Y], [0.0, M, M * X], [-M * Y, M * X, Iz]]
    return mass, [M * w**2 * X, M * w**2 * Y, 0.0]


def lamina_two_forces(t, q, v, M, Iz, xb, yb, x1, y1, x2, y2, f1x, f1y, f2x, f2y):
    mass, centrifugal = _lamina(q, v, M, Iz, xb, yb)
    return mass, [
        centrifugal,
        following_force(q, x1, y1, f1x, f1y),
        following_force(q, x2, y2, f2x, f2y),
    ]


def following_force(q, x, y, fx, fy):
    """(Q_x, Q_y, Q_theta) of a force along the body axes at the point (x, y) of the body."""
    c, s = cos(q[2]), sin(q[2])
    return [fx * c - fy * s, fx * s + fy * c, fy * x - fx * y]


def lamina_two_forces_fixed_direction(t, q, v, M, Iz, xb, yb, x1, y1, x2, y2, F1X, F1Y, F2X, F2Y):
    mass, centrifugal = _lamina(q, v, M, Iz, xb, yb)
    return mass, [
        centrifugal,
        fixed_force(q, x1, y1, F1X, F1Y),
        fixed_force(q, x2, y2, F2X, F2Y),
    ]


def fixed_force(q, x, y, FX, FY):
    """(Q_x, Q_y, Q_theta) of a force along the fixed axes at the point (x, y) of the body."""
    c, s = cos(q[2]), sin(q[2])
    return [FX, FY, FY * (x * c - y * s) - FX * (x * s + y * c)]


def lamina_double_pendulum(t, q, v, M, Iz, r, xb, yb, g):
    (theta, phi), (w, phi_rate) = q, v
    c, s = cos(phi - theta), sin(phi - theta)
    along, across = M * r * (xb * c - yb * s), M * r * (xb * s + yb * c)
    return [[M * r**2, along], [along, Iz]], [
        [across * phi_rate**2, -across * w**2],
        [-M * g * r * sin(theta), -M * g * (xb * sin(phi) + yb * cos(phi))],
    ]


def two_link_robot_arm(t, q, v, mA, m, l1, l2, g, tauO0, tauA0, Omega):
    (theta1, theta2), (w1, w2) = q, v
    c, s = m * l1 * l2 * cos(theta1 - theta2), m * l1 * l2 * sin(theta1 - theta2)
    return [[(mA + m) * l1**2, c], [c, m * l2**2]], [
        [-s * w2**2, s * w1**2],
        [-(mA + m) * g * l1 * cos(theta1), -m * g * l2 * cos(theta2)],
        *motor_forces(t, tauO0, tauA0, Omega),
    ]


def motor_forces(t, tauO0, tauA0, Omega):
    """(Q_theta1, Q_theta2) of the motors at O and at A."""
    tauO, tauA = tauO0 * cos(Omega * t), tauA0 * sin(Omega * t)
    return [[tauO, 0.0], [-tauA, tauA]]


def pendulum_bob_energy(t, q, v, W, l, g):  # noqa: E741
    return [[1.0]], [[-g / l * sin(q[0])]]


HAND_EQUATIONS = {
    function.__name__: function
    for function in (
        rotating_body_on_frame,
        disk_on_shaft,
        physical_pendulum_three_origins,
        lamina_two_forces,
        lamina_two_forces_fixed_direction,
        lamina_double_pendulum,
        two_link_robot_arm,
        pendulum_bob_energy,
    )
}
