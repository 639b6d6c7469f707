"""Equations of motion y' = f(y) as a good engineer writes them, for any library of functions.

Each function takes the elementary functions to call, the parameters and the numbers y. It returns
the rates as plain sums, products and quotients. So the same lines work for JAX, numba, CasADi,
heyoka and Python numbers. y starts with the coordinates. Terms that depend on parameters alone are
computed first. Linear systems are solved in closed form or by Cholesky factors.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

Numbers = Sequence[Any]


class Functions(NamedTuple):
    """Elementary functions that the equations call.

    Attributes:
        over_cube: x^(-3/2), in the form best for the library.
    """

    sin: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    sqrt: Callable[[Any], Any]
    over_cube: Callable[[Any], Any]


def functions(module: Any) -> Functions:
    """The functions of a module with the usual names."""
    sqrt = module.sqrt
    return Functions(module.sin, module.cos, sqrt, lambda x: 1.0 / (x * sqrt(x)))


def of_expressions(module: Any) -> Functions:
    """The functions of a module for expressions; roots of plain numbers stay plain numbers."""

    def sqrt(x: Any) -> Any:
        return math.sqrt(x) if isinstance(x, float) else module.sqrt(x)

    return Functions(module.sin, module.cos, sqrt, lambda x: x**-1.5)


PLAIN = functions(math)
Rates = Callable[[Functions, Mapping[str, Any], Numbers], list[Any]]


def double_pendulum(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: both angles from the downward vertical, their rates."""
    mu = (p["m1"] + p["m2"]) / p["m2"]
    mu_g, per_h1, per_h2 = mu * p["g"], 1.0 / p["h1"], 1.0 / p["h2"]
    between = y[0] - y[1]
    s, c = f.sin(between), f.cos(between)
    r1 = -p["h2"] * (s * (y[3] * y[3])) - mu_g * f.sin(y[0])
    r2 = p["h1"] * (s * (y[2] * y[2])) - p["g"] * f.sin(y[1])
    scale = 1.0 / (mu - c * c)
    return [y[2], y[3], per_h1 * (scale * (r1 - c * r2)), per_h2 * (scale * (mu * r2 - c * r1))]


def kepler(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: position from the center, velocity."""
    attraction = p["mu"] * f.over_cube(y[0] * y[0] + y[1] * y[1])
    return [y[2], y[3], -(attraction * y[0]), -(attraction * y[1])]


def heavy_top(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: precession, inclination, spin; rates w along e1, e2, e3 of the catalogue's top."""
    ratio, k = p["I3"] / p["I1"], p["m"] * p["g"] * p["l"] / p["I1"]
    _, theta, _, w1, w2, w3 = y
    s, c = f.sin(theta), f.cos(theta)
    precession = w2 / s
    axial = c * precession - ratio * w3
    return [precession, w1, w3 - c * precession, axial * w2 + k * s, -(axial * w1), 0.0 * w3]


def rigid_aircraft(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: position, roll, pitch, yaw; velocity of the origin, angular velocity, in body axes."""
    m, g = p["m"], p["g"]
    c = (p["xc"], p["yc"], p["zc"])
    specific_force = (p["Fx"] / m, p["Fy"] / m, p["Fz"] / m)
    # Inertia and moment about the mass center (parallel axes).
    xx, yy, zz = (
        p[name] - m * (c[i] * c[i] + c[j] * c[j])
        for name, i, j in (("Ix", 1, 2), ("Iy", 0, 2), ("Iz", 0, 1))
    )
    xy, xz, yz = (
        m * c[i] * c[j] - p[name] for name, i, j in (("Ixy", 0, 1), ("Ixz", 0, 2), ("Iyz", 1, 2))
    )
    J = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
    adjugate = _cross(J[1], J[2]), _cross(J[2], J[0]), _cross(J[0], J[1])
    per_det = 1.0 / _dot(J[0], adjugate[0])
    arm = _cross(c, [m * x for x in specific_force])
    moment = [p[name] - x for name, x in zip(("Mx", "My", "Mz"), arm, strict=True)]

    _, _, _, phi, theta, psi, *state = y
    V, w = state[:3], state[3:]
    s_phi, c_phi, s_theta, c_theta = f.sin(phi), f.cos(phi), f.sin(theta), f.cos(theta)
    s_psi, c_psi = f.sin(psi), f.cos(psi)
    spun = [_dot(row, w) for row in J]
    torque = [a - b for a, b in zip(moment, _cross(w, spun), strict=True)]
    w_rate = [per_det * _dot(row, torque) for row in adjugate]
    weight = (-g * s_theta, g * (s_phi * c_theta), g * (c_phi * c_theta))
    swung = [a + b for a, b in zip(V, _cross(w, c), strict=True)]  # velocity of the mass center
    V_rate = [
        force + fall - a - b
        for force, fall, a, b in zip(
            specific_force, weight, _cross(w_rate, c), _cross(w, swung), strict=True
        )
    ]
    # R = Rz Ry Rx, one rotation after the other.
    level, down = c_phi * V[1] - s_phi * V[2], s_phi * V[1] + c_phi * V[2]
    ahead, sink = c_theta * V[0] + s_theta * down, c_theta * down - s_theta * V[0]
    yaw_rate = (s_phi * w[1] + c_phi * w[2]) / c_theta
    return [
        c_psi * ahead - s_psi * level,
        s_psi * ahead + c_psi * level,
        sink,
        w[0] + s_theta * yaw_rate,
        c_phi * w[1] - s_phi * w[2],
        yaw_rate,
        *V_rate,
        *w_rate,
    ]


def cartesian_pendulum(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: positions of both bobs, velocities; tensions from phi'' = 0."""
    g, per_m1, per_m2 = p["g"], 1.0 / p["m1"], 1.0 / p["m2"]
    x1, y1, x2, y2, u1, v1, u2, v2 = y
    dx, dy, du, dv = x2 - x1, y2 - y1, u2 - u1, v2 - v1
    # [a11 -a12; -a12 a22] (tension over length) = right sides
    a11 = per_m1 * (x1 * x1 + y1 * y1)
    a12 = per_m1 * (x1 * dx + y1 * dy)
    a22 = (per_m1 + per_m2) * (dx * dx + dy * dy)
    r1 = u1 * u1 + v1 * v1 - g * y1
    r2 = du * du + dv * dv
    per_det = 1.0 / (a11 * a22 - a12 * a12)
    k1, k2 = per_det * (a22 * r1 + a12 * r2), per_det * (a12 * r1 + a11 * r2)
    return [
        *(u1, v1, u2, v2),
        per_m1 * (k2 * dx - k1 * x1),
        per_m1 * (k2 * dy - k1 * y1) - g,
        -(per_m2 * (k2 * dx)),
        -(per_m2 * (k2 * dy)) - g,
    ]


def rolling_disk(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: center, heading, inclination, spin; rates w along e1, e2, e3 of the catalogue's disk.

    The equations of its docstring; the rolling constraints are solved for the center's velocity.
    """
    R, I_d, I_a = p["R"], p["I_d"], p["I_a"]
    edge = p["m"] * R * R
    per_lean, per_spin = 1.0 / (I_d + edge), edge / (I_a + edge)
    k2, k3, gravity, per_d = I_a / I_d, (I_a + edge) * per_lean, p["m"] * p["g"] * R * per_lean, I_d
    _, _, psi, theta, _, w1, w2, w3 = y
    s, c, s_psi, c_psi = f.sin(theta), f.cos(theta), f.sin(psi), f.cos(psi)
    heading_rate = w2 / s
    swing = c * heading_rate
    along, across = R * w3, R * (w1 * s)
    return [
        across * s_psi - along * c_psi,
        -(along * s_psi) - across * c_psi,
        heading_rate,
        w1,
        w3 - swing,
        (per_d * per_lean) * (swing * w2) - k3 * (w2 * w3) - gravity * c,
        k2 * (w1 * w3) - swing * w1,
        per_spin * (w1 * w2),
    ]


def elastic_pendulum(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: length of the spring, angle from the downward vertical, their rates."""
    g, k = p["g"], p["k"] / p["m"]
    r, angle, r_rate, w = y
    a = r * (w * w) + g * f.cos(angle) - k * (r - p["l"])
    return [r_rate, w, a, -(2.0 * (r_rate * w) + g * f.sin(angle)) / r]


def chain(f: Functions, p: Mapping[str, Any], y: Numbers) -> list[Any]:
    """y: absolute angles of the links, their rates; masses at the ends, M by Cholesky factors."""
    n = len(y) // 2
    A, gravity = chain_constants(p, n)
    q, v = y[:n], y[n:]
    s, c, w = [f.sin(x) for x in q], [f.cos(x) for x in q], [x * x for x in v]
    a = [-(gravity[i] * s[i]) for i in range(n)]
    L: list[list[Any]] = [[None] * n for _ in range(n)]
    for i in range(n):
        for j in range(i):
            coupling = A[i][j] * (s[i] * c[j] - c[i] * s[j])
            a[i], a[j] = a[i] - coupling * w[j], a[j] + coupling * w[i]
            L[i][j] = A[i][j] * (c[i] * c[j] + s[i] * s[j])
    per_diagonal: list[Any] = [None] * n  # 1 / L_ii
    for i in range(n):
        rest = A[i][i]
        for j in range(i):
            for k in range(j):
                L[i][j] = L[i][j] - L[i][k] * L[j][k]
            L[i][j] = L[i][j] * per_diagonal[j]
            rest = rest - L[i][j] * L[i][j]
            a[i] = a[i] - L[i][j] * a[j]
        per_diagonal[i] = 1.0 / f.sqrt(rest)
        a[i] = a[i] * per_diagonal[i]
    for i in reversed(range(n)):
        a[i] = a[i] * per_diagonal[i]
        for k in range(i):
            a[k] = a[k] - L[i][k] * a[i]
    return [*v, *a]


def chain_constants(p: Mapping[str, Any], n: int) -> tuple[list[list[Any]], list[Any]]:
    """(A, b) of a chain, for M_ij = A_ij cos(q_i - q_j) and gravity torques -b_i sin(q_i).

    A_ij = l_i l_j times the sum of the masses from max(i, j) on, b_i = g l_i times that from i on.
    """
    m, rods = p["m"], p["l"]
    carried = [sum(m[j] for j in range(i, n)) for i in range(n)]
    A = [[rods[i] * rods[j] * carried[max(i, j)] for j in range(n)] for i in range(n)]
    return A, [p["g"] * rods[i] * carried[i] for i in range(n)]


def _dot(a: Numbers, b: Numbers) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Numbers, b: Numbers) -> list[Any]:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
