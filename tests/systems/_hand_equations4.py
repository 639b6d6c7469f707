"""Equations of motion by hand of chapter 4 and of classics: Newton's and Euler's, or Lagrange's.

Each function returns a matrix and terms as in `_hand_equations3`, under constraints as in
`_hand_constrained`. Angles (phi, theta, psi) are roll, pitch and yaw unless stated otherwise.
"""

import numpy as np
from _hand_constrained import bordered
from numpy import cos, cross, sin


def attitude(angles):
    """T_I/B, body to inertial components."""
    (c_ph, c_th, c_ps), (s_ph, s_th, s_ps) = cos(angles), sin(angles)
    return np.array(
        [
            [c_th * c_ps, s_ph * s_th * c_ps - c_ph * s_ps, c_ph * s_th * c_ps + s_ph * s_ps],
            [c_th * s_ps, s_ph * s_th * s_ps + c_ph * c_ps, c_ph * s_th * s_ps - s_ph * c_ps],
            [-s_th, s_ph * c_th, c_ph * c_th],
        ]
    )


def body_rates(angles, rates):
    """(W, parts of W' rates), with omega = W rates along the body axes."""
    (c_ph, c_th, _), (s_ph, s_th, _) = cos(angles), sin(angles)
    phi_rate, theta_rate, psi_rate = rates
    W = np.array([[1.0, 0.0, -s_th], [0.0, c_ph, s_ph * c_th], [0.0, -s_ph, c_ph * c_th]])
    parts = np.array(
        [
            [-psi_rate * c_th * theta_rate, 0.0, 0.0],
            [
                -theta_rate * s_ph * phi_rate,
                psi_rate * c_ph * c_th * phi_rate,
                -psi_rate * s_ph * s_th * theta_rate,
            ],
            [
                -theta_rate * c_ph * phi_rate,
                -psi_rate * s_ph * c_th * phi_rate,
                -psi_rate * c_ph * s_th * theta_rate,
            ],
        ]
    )
    return W, parts.T


def space_rates(angles, rates):
    """(W, parts of W' rates), with omega = W rates along X, Y, Z."""
    (_, c_th, c_ps), (_, s_th, s_ps) = cos(angles), sin(angles)
    phi_rate, theta_rate, psi_rate = rates
    W = np.array([[c_th * c_ps, -s_ps, 0.0], [c_th * s_ps, c_ps, 0.0], [-s_th, 0.0, 1.0]])
    tilt, turn, spin = phi_rate * theta_rate, psi_rate * phi_rate, psi_rate * theta_rate
    parts = [
        [-tilt * s_th * c_ps, -tilt * s_th * s_ps, -tilt * c_th],
        [-turn * c_th * s_ps, turn * c_th * c_ps, 0.0],
        [-spin * c_ps, -spin * s_ps, 0.0],
    ]
    return W, np.array(parts)


def turning(angles, rates, inertia, torques):
    """(M, terms) of Euler's equations; `inertia` and torques are in body components."""
    W, parts = body_rates(angles, rates)
    w = W @ rates
    forces = [-inertia @ part for part in parts] + [-cross(w, inertia @ w)]
    return W.T @ inertia @ W, [force @ W for force in [*forces, *map(np.asarray, torques)]]


def rigid_body_roll_pitch_yaw(t, q, v, Ix, Iy, Iz, tau1, tau2, tau3):
    return turning(q, v, np.diag([Ix, Iy, Iz]), [[tau1, tau2, tau3]])


def torque_free_asymmetric_top(t, q, v, I1, I2, I3):
    return turning(q, v, np.diag([I1, I2, I3]), [])


def euler_rotational_equations(t, q, v, Ix, Iy, Iz, t1, t2, t3, nu, c):
    w = body_rates(q, v)[0] @ v
    applied = [t1 * sin(nu * t), t2 * cos(nu * t), t3]
    return turning(q, v, np.diag([Ix, Iy, Iz]), [applied, -c * w])


def body_axis_translation(t, q, v, m, Fx, Fy, Fz, phi0, phi1, theta0, theta1, nu, psi0, psi1):
    angles = np.array([phi0 + phi1 * t, theta0 + theta1 * sin(nu * t), psi0 + psi1 * t])
    return m * np.eye(3), list((attitude(angles) * [Fx, Fy, Fz]).T)


def rigid_aircraft(t, q, v, m, g, xc, yc, zc, Ix, Iy, Iz, Ixy, Ixz, Iyz, Fx, Fy, Fz, Mx, My, Mz):
    R, (W, parts) = attitude(q[3:]), body_rates(q[3:], v[3:])
    rc, w, k = np.array([xc, yc, zc]), W @ v[3:], R[2]
    inertia = np.array([[Ix, -Ixy, -Ixz], [-Ixy, Iy, -Iyz], [-Ixz, -Iyz, Iz]])
    lever = m * np.array([[0.0, -zc, yc], [zc, 0.0, -xc], [-yc, xc, 0.0]])
    mass = np.block([[m * np.eye(3), -lever], [lever, inertia]])
    zeros = np.zeros(3)
    wrenches = [
        *(-mass @ [*zeros, *part] for part in parts),
        [*(-m * cross(w, cross(w, rc))), *(-cross(w, inertia @ w))],
        [*(m * g * k), *(m * g * cross(rc, k))],
        [Fx, Fy, Fz, Mx, My, Mz],
    ]
    theta = np.block([[R.T, np.zeros((3, 3))], [np.zeros((3, 3)), W]])  # of (X', w)
    return theta.T @ mass @ theta, [wrench @ theta for wrench in wrenches]


def quadcopter_body_axes(t, q, v, m, g, Ix, Iy, Iz, l, k, b, Jr, omega):  # noqa: E741
    w = body_rates(q[3:], v[3:])[0] @ v[3:]
    f1, f2, f3, f4 = k * omega**2
    tau1, tau2, tau3, tau4 = b * omega**2
    H = Jr * (-omega[0] + omega[1] - omega[2] + omega[3])
    torques = [
        [(f2 - f4) * l, (f1 - f3) * l, tau1 - tau2 + tau3 - tau4],
        [-w[1] * H, w[0] * H, 0.0],
    ]
    about, terms = turning(q[3:], v[3:], np.diag([Ix, Iy, Iz]), torques)
    M = np.block([[m * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), about]])
    zeros = np.zeros(3)
    thrust = -(f1 + f2 + f3 + f4) * attitude(q[3:])[:, 2]
    terms = [np.concatenate([zeros, term]) for term in terms]
    return M, [*terms, np.array([*thrust, *zeros]), np.array([0.0, 0.0, m * g, *zeros])]


def tricycle(t, q, v, m, I_body, I_steer, l, d, F_v, tau):  # noqa: E741
    (theta, phi), (x_rate, y_rate, turn, steer) = q[2:], v
    c, s, c_w, s_w, wheel = cos(theta), sin(theta), cos(theta + phi), sin(theta + phi), turn + steer
    mass = [
        [m, 0.0, -m * d * s, 0.0],
        [0.0, m, m * d * c, 0.0],
        [-m * d * s, m * d * c, I_body + I_steer + m * d**2, I_steer],
        [0.0, 0.0, I_steer, I_steer],
    ]
    forces = [
        [m * d * turn**2 * c, m * d * turn**2 * s, 0.0, 0.0],
        [F_v * c_w, F_v * s_w, F_v * l * sin(phi), 0.0],
        [0.0, 0.0, 0.0, tau],
    ]
    A = [[-s, c, 0.0, 0.0], [-s_w, c_w, l * cos(phi), 0.0]]
    gamma = [
        [-turn * x_rate * c, -wheel * x_rate * c_w],
        [-turn * y_rate * s, -wheel * y_rate * s_w],
        [0.0, -l * turn * steer * sin(phi)],
    ]
    return bordered(mass, forces, A, gamma)


def tricycle_book_lagrangian(t, q, v, m, I_theta, I_phi, l, F_v, tau):  # noqa: E741
    """Rows r of 4.74 with their rates and the gradients of r v: d/dt (dL/dv) - dL/dq of each."""
    (theta, phi), (x_rate, y_rate, turn, steer) = q[2:], v
    c, s, c_ph, s_ph = cos(theta), sin(theta), cos(phi), sin(phi)
    tan = s_ph / c_ph
    rows = np.array(
        [[c / c_ph, s / c_ph, 0.0, 0.0], [-s, c, 0.0, 0.0], [-s_ph, 0.0, l * c * c_ph, 0.0]]
    )
    rates = np.array(
        [
            [(-s * turn + c * tan * steer) / c_ph, (c * turn + s * tan * steer) / c_ph, 0.0, 0.0],
            [-c * turn, -s * turn, 0.0, 0.0],
            [-c_ph * steer, 0.0, -l * (s * c_ph * turn + c * s_ph * steer), 0.0],
        ]
    )
    u = rows @ v
    gradients = np.array(
        [
            [0.0, 0.0, (-x_rate * s + y_rate * c) / c_ph, u[0] * tan],
            [0.0, 0.0, -x_rate * c - y_rate * s, 0.0],
            [0.0, 0.0, -l * turn * s * c_ph, -l * turn * c * s_ph - x_rate * c_ph],
        ]
    )
    mass = m * rows.T @ rows + np.diag([0.0, 0.0, I_theta, I_phi])
    forces = [
        *(-m * (rate @ v) * row for row, rate in zip(rows, rates, strict=True)),
        *(-m * ui * rate for ui, rate in zip(u, rates, strict=True)),
        *(m * ui * gradient for ui, gradient in zip(u, gradients, strict=True)),
        F_v * rows[0],
        [0.0, 0.0, 0.0, tau],
    ]
    return bordered(mass, forces, rows[1:], list((rates[1:] * v).T))


def chaplygin_sleigh(t, q, v, m, I, a):  # noqa: E741
    (x_rate, y_rate, w), c, s = v, cos(q[2]), sin(q[2])
    mass = [[m, 0.0, -m * a * s], [0.0, m, m * a * c], [-m * a * s, m * a * c, I + m * a**2]]
    forces = [[m * a * w**2 * c, m * a * w**2 * s, 0.0]]
    return bordered(mass, forces, [[-s, c, 0.0]], [[-w * x_rate * c], [-w * y_rate * s]])


def knife_edge_incline(t, q, v, m, J, g, alpha):
    (x_rate, y_rate, w), c, s = v, cos(q[2]), sin(q[2])
    forces = [[m * g * sin(alpha), 0.0, 0.0]]
    gamma = [[w * x_rate * c], [w * y_rate * s]]
    return bordered(np.diag([m, m, J]), forces, [[s, -c, 0.0]], gamma)


def nonholonomic_particle(t, q, v, m):
    return bordered(m * np.eye(3), [np.zeros(3)], [[-q[1], 0.0, 1.0]], [[-v[1] * v[0]]])


def vertical_rolling_disk(t, q, v, m, R, I, J, tau_theta, tau_phi):  # noqa: E741
    c, s, (roll, turn) = cos(q[3]), sin(q[3]), v[2:]
    A = [[1.0, 0.0, -R * c, 0.0], [0.0, 1.0, -R * s, 0.0]]
    gamma = [[R * s * turn * roll, -R * c * turn * roll]]
    return bordered(np.diag([m, m, I, J]), [[0.0, 0.0, tau_theta, tau_phi]], A, gamma)


def rolling_disk(t, q, v, m, R, I_d, I_a, g):
    (psi, theta), (turn, lean, spin) = q[2:4], v[2:]
    c, s, c_ps, s_ps = cos(theta), sin(theta), cos(psi), sin(psi)
    mass = np.diag([m, m, I_d * s**2 + I_a * c**2, I_d + m * R**2 * c**2, I_a])
    mass[2, 4] = mass[4, 2] = I_a * c
    forces = [
        [0.0, 0.0, -2 * I_d * s * c * lean * turn, I_d * s * c * turn**2, 0.0],
        [0.0, 0.0, 2 * I_a * s * c * lean * turn, -I_a * s * c * turn**2, 0.0],
        [0.0, 0.0, I_a * s * lean * spin, -I_a * s * turn * spin, I_a * s * lean * turn],
        [0.0, 0.0, 0.0, m * R**2 * s * c * lean**2, 0.0],
        [0.0, 0.0, 0.0, -m * g * R * c, 0.0],
    ]
    A = [
        [1.0, 0.0, R * c * c_ps, -R * s * s_ps, R * c_ps],
        [0.0, 1.0, R * c * s_ps, R * s * c_ps, R * s_ps],
    ]
    tangential, normal = np.array([-s_ps, c_ps]), np.array([c_ps, s_ps])
    gamma = [
        -2 * R * s * lean * turn * normal,
        R * c * turn**2 * tangential,
        R * spin * turn * tangential,
        R * c * lean**2 * tangential,
    ]
    return bordered(mass, forces, A, gamma)


def rolling(v, a, W, parts):
    """(A, gamma) of x' - a wY and y' + a wX."""
    A = np.array([[1.0, 0.0, *(-a * W[1])], [0.0, 1.0, *(a * W[0])]])
    return A, [[-a * part[1], a * part[0]] for part in parts]


def rolling_ball_turntable(t, q, v, m, a, I, Omega, g, alpha):  # noqa: E741
    W, parts = space_rates(q[2:], v[2:])
    A, gamma = rolling(v, a, W, parts)
    mass = np.zeros((5, 5))
    mass[:2, :2], mass[2:, 2:] = m * np.eye(2), I * W.T @ W
    forces = [
        *([0.0, 0.0, *(-I * part @ W)] for part in parts),
        [m * g * sin(alpha), 0.0, 0.0, 0.0, 0.0],
    ]
    return bordered(mass, forces, A, [*gamma, [Omega * v[1], -Omega * v[0]]])


def chaplygin_ball(t, q, v, m, a, I1, I2, I3):
    A, gamma = rolling(v, a, *space_rates(q[2:], v[2:]))
    about, terms = turning(q[2:], v[2:], np.diag([I1, I2, I3]), [])
    mass = np.zeros((5, 5))
    mass[:2, :2], mass[2:, 2:] = m * np.eye(2), about
    return bordered(mass, [[0.0, 0.0, *term] for term in terms], A, gamma)


def snakeboard(t, q, v, m, r, J, J_r, J_w, a_psi, w_psi, a_phi, w_phi):
    (theta, phi), (x_rate, y_rate, turn, _, steer) = (q[2], q[4]), v
    mass = np.diag([m, m, J + J_r + 2 * J_w, J_r, 2 * J_w])
    mass[2, 3] = mass[3, 2] = J_r
    forces = [[0.0, 0.0, 0.0, a_psi * sin(w_psi * t), a_phi * sin(w_phi * t)]]
    A, along, aside, lever = [], [], [], []
    for sign in (1.0, -1.0):
        c, s = cos(theta + sign * phi), sin(theta + sign * phi)
        A.append([-s, c, sign * r * cos(phi), 0.0, 0.0])
        along.append(-(turn + sign * steer) * x_rate * c)
        aside.append(-(turn + sign * steer) * y_rate * s)
        lever.append(-sign * r * turn * steer * sin(phi))
    return bordered(mass, forces, A, [along, aside, lever])


def suslov(t, q, v, I1, I2, I3, I13, I23):
    W, parts = body_rates(q, v)
    inertia = np.array([[I1, 0.0, I13], [0.0, I2, I23], [I13, I23, I3]])
    M, terms = turning(q, v, inertia, [])
    return bordered(M, terms, [W[2]], [[part[2]] for part in parts])


def heavy_symmetric_top(t, q, v, m, g, l, I1, I3):  # noqa: E741
    """z-x-z Euler angles."""
    (turn, lean, spin), c, s = v, cos(q[1]), sin(q[1])
    M = np.diag([I1 * s**2 + I3 * c**2, I1, I3])
    M[0, 2] = M[2, 0] = I3 * c
    return M, [
        [-2 * I1 * s * c * lean * turn, I1 * s * c * turn**2, 0.0],
        [2 * I3 * s * c * lean * turn, -I3 * s * c * turn**2, 0.0],
        [I3 * s * lean * spin, -I3 * s * turn * spin, I3 * s * lean * turn],
        [0.0, m * g * l * s, 0.0],
    ]


HAND_EQUATIONS = {
    function.__name__: function
    for function in (
        rigid_body_roll_pitch_yaw,
        tricycle,
        tricycle_book_lagrangian,
        body_axis_translation,
        euler_rotational_equations,
        rigid_aircraft,
        quadcopter_body_axes,
        chaplygin_sleigh,
        knife_edge_incline,
        nonholonomic_particle,
        vertical_rolling_disk,
        rolling_disk,
        rolling_ball_turntable,
        chaplygin_ball,
        snakeboard,
        suslov,
        torque_free_asymmetric_top,
        heavy_symmetric_top,
    )
}
