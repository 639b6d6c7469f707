"""Equations of motion by hand under constraints A v + b = 0, whose rate is A a + gamma = 0.

Each function returns the matrix and the terms of the bordered equations

    [ M  -(A^T + B) ] [ a   ]   [ sum of forces ]
    [ A       0     ] [ lam ] = [    -gamma     ]

where B lam is what friction adds to the reactions A^T lam.
"""

import numpy as np
from numpy import cos, sin


def bordered(M, forces, A, gamma, B=0.0):
    """(matrix, terms) from M, the forces, A and the terms of gamma."""
    A = np.asarray(A, float)
    m, n = A.shape
    matrix = np.block([[np.asarray(M, float), -(A.T + B)], [A, np.zeros((m, m))]])
    no_rows, no_forces = np.zeros(m), np.zeros(n)
    terms = [np.concatenate([force, no_rows]) for force in forces]
    return matrix, terms + [np.concatenate([no_forces, np.negative(rate)]) for rate in gamma]


def lamina_on_parabola(t, q, v, M, Iz, b, xb, yb, g):
    (x1, _, phi), (x1_rate, _, w) = q, v
    X, Y = xb * cos(phi) - yb * sin(phi), xb * sin(phi) + yb * cos(phi)
    mass = [[M, 0.0, M * X], [0.0, M, M * Y], [M * X, M * Y, Iz]]
    forces = [[M * Y * w**2, -M * X * w**2, 0.0], [0.0, -M * g, -M * g * Y]]
    return bordered(mass, forces, [[-2 * b * x1, 1.0, 0.0]], [[-2 * b * x1_rate**2]])


def spherical_pendulum_cartesian(t, q, v, m, L, g):
    return bordered(m * np.eye(3), [[0.0, 0.0, -m * g]], [2 * q], [[2 * v @ v]])


def spherical_pendulum_varying(t, q, v, m, L0, L1, Omega, g):
    (L, _, phi), (L_rate, turn, w) = q, v
    c, s = cos(phi), sin(phi)
    forces = [
        [m * L * w**2, -2 * m * L * L_rate * turn * s**2, -2 * m * L * L_rate * w],
        [m * L * turn**2 * s**2, -2 * m * L**2 * s * c * turn * w, m * L**2 * s * c * turn**2],
        [m * g * c, 0.0, -m * g * L * s],
    ]
    M = np.diag([m, m * L**2 * s**2, m * L**2])
    return bordered(M, forces, [[1.0, 0.0, 0.0]], [[L1 * Omega**2 * sin(Omega * t)]])


def particle_on_surface(t, q, v, m, a, b, c, Omega, g):
    (x, y, _), (x_rate, y_rate, _) = q, v
    gamma = [[-a * x_rate**2], [-b * y_rate**2], [c * Omega**2 * sin(Omega * t)]]
    return bordered(m * np.eye(3), [[0.0, 0.0, -m * g]], [[-a * x, -b * y, 1.0]], gamma)


def knife_edge_vehicle(t, q, v, m, I, a, g, beta, F0, tau0, Omega):  # noqa: E741
    theta, (x_rate, y_rate, w) = q[2], v
    c, s, F = cos(theta), sin(theta), F0 * cos(Omega * t)
    mass = [[m, 0.0, -m * a * s], [0.0, m, m * a * c], [-m * a * s, m * a * c, I + m * a**2]]
    forces = [
        [m * a * w**2 * c, m * a * w**2 * s, 0.0],
        [m * g * sin(beta), 0.0, -m * g * sin(beta) * a * s],
        [F * c, F * s, tau0 * sin(Omega * t)],
    ]
    return bordered(mass, forces, [[-s, c, 0.0]], [[-w * x_rate * c], [-w * y_rate * s]])


def double_pendulum_cartesian(t, q, v, m1, m2, h1, h2, g):
    (r1, r2), (v1, v2) = (q[:2], q[2:] - q[:2]), (v[:2], v[2:] - v[:2])
    A = [[*2 * r1, 0.0, 0.0], [*-2 * r2, *2 * r2]]
    gravity = [0.0, -m1 * g, 0.0, -m2 * g]
    return bordered(np.diag([m1, m1, m2, m2]), [gravity], A, [[2 * v1 @ v1, 2 * v2 @ v2]])


def rolling_ball_no_spin(t, q, v, m, R, I, Fx0, Fy0, Omega):  # noqa: E741
    (psi, theta, _), (psi_rate, theta_rate, phi_rate) = q[2:], v[2:]
    (c_ps, c_th), (s_ps, s_th) = cos([psi, theta]), sin([psi, theta])
    mass = np.diag([m, m, I, I, I])
    mass[2, 4] = mass[4, 2] = -I * s_th
    turning = [phi_rate * theta_rate, -psi_rate * phi_rate, psi_rate * theta_rate]
    forces = [
        [0.0, 0.0, *(I * c_th * np.array(turning))],
        [Fx0 * cos(Omega * t), Fy0 * sin(Omega * t), 0.0, 0.0, 0.0],
    ]
    A = [
        [1.0, 0.0, 0.0, -R * c_ps, -R * c_th * s_ps],
        [0.0, 1.0, 0.0, -R * s_ps, R * c_th * c_ps],
        [0.0, 0.0, 1.0, 0.0, -s_th],
    ]
    gamma = [
        [R * phi_rate * s_th * theta_rate * s_ps, -R * phi_rate * s_th * theta_rate * c_ps, 0.0],
        [-R * phi_rate * c_th * c_ps * psi_rate, -R * phi_rate * c_th * s_ps * psi_rate, 0.0],
        [R * theta_rate * s_ps * psi_rate, -R * theta_rate * c_ps * psi_rate, 0.0],
        [0.0, 0.0, -phi_rate * c_th * theta_rate],
    ]
    return bordered(mass, forces, A, gamma)


def rolling_wheel_curved_path(t, q, v, m, r, Iw, Id, g, beta, tau_r, tau_s, Omega):
    phi, (turn, roll) = q[2], v[2:]
    c, s = cos(phi), sin(phi)
    forces = [[m * g * sin(beta), 0.0, 0.0, 0.0], [0.0, 0.0, tau_s, tau_r * cos(Omega * t)]]
    A = [[1.0, 0.0, 0.0, -r * c], [0.0, 1.0, 0.0, -r * s]]
    gamma = [[r * s * turn * roll, -r * c * turn * roll]]
    return bordered(np.diag([m, m, Id, Iw]), forces, A, gamma)


def rotating_cylinder_disk(t, q, v, m1, m2, l, Iy, Iz, tau_z0, tau_b, nu, g):  # noqa: E741
    delta, (turn, rise, spin) = q[1], v
    c, s, across = cos(delta), sin(delta), m1 * l**2 / 3 + m2 * l**2 + Iz
    mass = [
        [across * c**2 + Iy * s**2, 0.0, Iy * s],
        [0.0, across, 0.0],
        [Iy * s, 0.0, Iy],
    ]
    forces = [
        [-2 * (Iy - across) * s * c * rise * turn, (Iy - across) * s * c * turn**2, 0.0],
        [-Iy * c * rise * spin, Iy * c * turn * spin, -Iy * c * rise * turn],
        [0.0, -(m1 / 2 + m2) * g * l * c, 0.0],
        [tau_z0 * cos(nu * t), 0.0, tau_b],
    ]
    return bordered(mass, forces, [[0.0, 1.0, 0.0]], [])


def pinned_body_reactions(t, q, v, M, IG, L, g):
    c, s, w = cos(q[2]), sin(q[2]), v[2]
    A = [[1.0, 0.0, -L * c], [0.0, 1.0, -L * s]]
    return bordered(np.diag([M, M, IG]), [[0.0, -M * g, 0.0]], A, [[L * s * w**2, -L * c * w**2]])


def atwood_multipliers(t, q, v, m1, m2, m3, kappa, R, g):
    A = [[1.0, 0.0, -R], [0.0, 1.0, R]]
    return bordered(np.diag([m1, m2, m3 * kappa**2]), [[m1 * g, m2 * g, 0.0]], A, [])


def falling_stick_multiplier(t, q, v, m, L, g):
    return falling_stick_friction(t, q, v, m, L, g, mu=0.0)


def falling_stick_friction(t, q, v, m, L, g, mu):
    c, s, w = cos(q[2]), sin(q[2]), v[2]
    friction = mu * np.array([[1.0], [0.0], [0.5 * L * s]])
    gamma = [[0.5 * L * s * w**2]]
    mass = np.diag([m, m, m * L**2 / 12])
    return bordered(mass, [[0.0, -m * g, 0.0]], [[0.0, 1.0, -0.5 * L * c]], gamma, friction)


def slider_crank(t, q, v, r, l, m1, m2, m3, g):  # noqa: E741
    links, forces, A, gamma = chain(q[:2], v[:2], np.array([m1, m2]), np.array([r, l]), g)
    mass = np.block([[links, np.zeros((2, 1))], [np.zeros((1, 2)), m3]])
    forces = [[*force, 0.0] for force in forces]
    return bordered(mass, forces, np.column_stack([A, [-1.0, 0.0]]), gamma)


def four_bar(t, q, v, a, b, c, d, m1, m2, m3, g):
    return bordered(*chain(q, v, np.array([m1, m2, m3]), np.array([a, b, c]), g))


def n_link_loop(t, q, v, m, l, d, g):  # noqa: E741
    return bordered(*chain(q, v, np.full(q.shape, m), np.full(q.shape, l), g))


def chain(q, v, masses, lengths, g):
    """(M, forces, A, gamma) of uniform links joined head to tail, A of the last head."""
    beyond = np.cumsum(masses[::-1])[::-1] - masses  # carried at the head of each link
    last = np.maximum.outer(range(len(q)), range(len(q)))
    coupling = np.outer(lengths, lengths) * (masses / 2 + beyond)[last]
    turned = q[:, None] - q
    M = coupling * cos(turned)
    M[np.diag_indices(len(q))] = lengths**2 * (masses / 3 + beyond)
    weights = -g * lengths * (masses / 2 + beyond) * cos(q)
    centrifugal = list((-coupling * sin(turned) * v**2).T)
    A = [-lengths * sin(q), lengths * cos(q)]
    gamma = list((-lengths * v**2 * np.array([cos(q), sin(q)])).T)
    return M, [weights, *centrifugal], A, gamma


HAND_EQUATIONS = {
    function.__name__: function
    for function in (
        lamina_on_parabola,
        spherical_pendulum_cartesian,
        spherical_pendulum_varying,
        particle_on_surface,
        knife_edge_vehicle,
        double_pendulum_cartesian,
        rolling_ball_no_spin,
        rolling_wheel_curved_path,
        rotating_cylinder_disk,
        pinned_body_reactions,
        atwood_multipliers,
        falling_stick_multiplier,
        falling_stick_friction,
        slider_crank,
        four_bar,
        n_link_loop,
    )
}
