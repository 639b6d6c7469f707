"""Equations of motion as a good engineer writes them on scalars, by the names of the scenes.

Shared subexpressions and reciprocals are computed once. Linear systems are solved in closed form.
Terms that depend on params alone are computed outside the loop. Rigid bodies use Euler's equations
in body rates (Goldstein, Classical Mechanics, sec. 5.5) instead of Lagrange's equations in angles.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

from bench.lowering._rk4 import Equations, Field, Parts


def pendulum(p: Any) -> Field:
    k = p["g"] / p["l"]

    def field(q: Parts, v: Parts) -> Parts:
        return [-k * jnp.sin(q[0])]

    return field


def double_pendulum(p: Any) -> Field:
    l1, l2, g = p["l1"], p["l2"], p["g"]
    mu = (p["m1"] + p["m2"]) / p["m2"]
    mu_g, per_l1, per_l2 = mu * g, 1.0 / l1, 1.0 / l2

    def field(q: Parts, v: Parts) -> Parts:
        between = q[0] - q[1]
        s, c = jnp.sin(between), jnp.cos(between)
        r1 = -l2 * s * v[1] * v[1] - mu_g * jnp.sin(q[0])
        r2 = l1 * s * v[0] * v[0] - g * jnp.sin(q[1])
        scale = 1.0 / (mu - c * c)
        return [per_l1 * scale * (r1 - c * r2), per_l2 * scale * (mu * r2 - c * r1)]

    return field


def cart_pole(p: Any) -> Field:
    M, m, rod, g = p["M"], p["m"], p["l"], p["g"]
    per_l = 1.0 / rod

    def field(q: Parts, v: Parts) -> Parts:
        s, c = jnp.sin(q[1]), jnp.cos(q[1])
        m_s = m * s
        a = m_s * (rod * v[1] * v[1] - g * c) / (M + m_s * s)
        return [a, per_l * (g * s - c * a)]

    return field


def spherical_pendulum(p: Any) -> Field:
    k = p["g"] / p["l"]

    def field(q: Parts, v: Parts) -> Parts:
        s, c = jnp.sin(q[0]), jnp.cos(q[0])
        return [s * (c * v[1] * v[1] - k), -2.0 * v[0] * v[1] * c / s]

    return field


def elastic_pendulum(p: Any) -> Field:
    rest, g, k = p["l"], p["g"], p["k"] / p["m"]

    def field(q: Parts, v: Parts) -> Parts:
        s, c = jnp.sin(q[1]), jnp.cos(q[1])
        r, w = q[0], v[1]
        return [r * w * w + g * c - k * (r - rest), -(2.0 * v[0] * w + g * s) / r]

    return field


def kepler(p: Any) -> Field:
    k = p["k"] / p["m"]

    def field(q: Parts, v: Parts) -> Parts:
        r, w = q[0], v[1]
        per_r = 1.0 / r
        return [r * w * w - k * per_r * per_r, -2.0 * v[0] * w * per_r]

    return field


def symmetric_top(p: Any) -> Field:
    ratio, k = p["C"] / p["A"], p["m"] * p["g"] * p["l"] / p["A"]

    def field(q: Parts, v: Parts) -> Parts:
        s, c = jnp.sin(q[1]), jnp.cos(q[1])
        precession, nutation, spin = v
        c_rate = precession * c
        axial = ratio * (spin + c_rate)
        a = nutation * (axial - 2.0 * c_rate) / s
        b = s * (precession * (c_rate - axial) + k)
        return [a, b, precession * s * nutation - a * c]

    return field


def top(p: Any) -> Field:
    I1, I2, I3 = (p["I"][i] for i in range(3))
    weight = p["m"] * p["g"] * p["l"]
    k1, k2, k3 = (I2 - I3) / I1, (I3 - I1) / I2, (I1 - I2) / I3
    gravity1, gravity2 = weight / I1, weight / I2

    def field(q: Parts, v: Parts) -> Parts:
        s, c = jnp.sin(q[1]), jnp.cos(q[1])
        sP, cP = jnp.sin(q[2]), jnp.cos(q[2])
        precession, nutation, spin = v
        level, c_rate = precession * s, precession * c
        w1 = level * sP + nutation * cP
        w2 = level * cP - nutation * sP
        w3 = c_rate + spin
        up = s * sP, s * cP  # the vertical in body axes
        d1, d2 = k1 * w2 * w3 + gravity1 * up[1], k2 * w3 * w1 - gravity2 * up[0]
        a = (sP * d1 + cP * d2 + nutation * (spin - c_rate)) / s
        b = cP * d1 - sP * d2 - spin * level
        return [a, b, k3 * w1 * w2 - a * c + level * nutation]

    return field


def _angles(q: Parts, v: Parts) -> tuple[Any, Any]:
    """Sines and cosines of pitch and roll, and body rates."""
    sT, cT, sF, cF = jnp.sin(q[4]), jnp.cos(q[4]), jnp.sin(q[5]), jnp.cos(q[5])
    yaw, pitch, roll = v[3:]
    across = cT * yaw
    rates = roll - sT * yaw, sF * across + cF * pitch, cF * across - sF * pitch
    return (sT, cT, sF, cF), rates


def _angle_accelerations(v: Parts, angles: Any, d: Sequence[Array]) -> list[Array]:
    """Second derivatives of the angles from those of the body rates."""
    sT, cT, sF, cF = angles
    yaw, pitch, roll = v[3:]
    across = cT * yaw
    a = (sF * d[1] + cF * d[2] + pitch * (roll + sT * yaw)) / cT
    return [a, cF * d[1] - sF * d[2] - roll * across, d[0] + sT * a + across * pitch]


def rigid_body(p: Any) -> Field:
    I1, I2, I3 = (p["I"][i] for i in range(3))
    k1, k2, k3 = (I2 - I3) / I1, (I3 - I1) / I2, (I1 - I2) / I3
    fall, zero = -p["g"], jnp.zeros(())

    def field(q: Parts, v: Parts) -> Parts:
        angles, (w1, w2, w3) = _angles(q, v)
        d = k1 * w2 * w3, k2 * w3 * w1, k3 * w1 * w2
        return [zero, zero, fall, *_angle_accelerations(v, angles, d)]

    return field


def aircraft(p: Any) -> Field:
    m, g, c = p["m"], p["g"], tuple(p["c"][i] for i in range(3))
    xx, yy, zz, xy, xz, yz = (p["J"][i] for i in range(6))
    # Inertia about the mass center (parallel axes), and its inverse.
    xx, yy, zz = (
        J - m * (c[i] ** 2 + c[j] ** 2)
        for J, i, j in zip((xx, yy, zz), (1, 0, 0), (2, 2, 1), strict=True)
    )
    xy, xz, yz = xy + m * c[0] * c[1], xz + m * c[0] * c[2], yz + m * c[1] * c[2]
    J = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
    adjugate = _cross(J[1], J[2]), _cross(J[2], J[0]), _cross(J[0], J[1])
    per_det = 1.0 / _dot(J[0], adjugate[0])
    inverse = [[x * per_det for x in row] for row in adjugate]

    def field(q: Parts, v: Parts) -> Parts:
        angles, w = _angles(q, v)
        sT, cT, sF, cF = angles
        sP, cP = jnp.sin(q[3]), jnp.cos(q[3])
        torque = _cross([_dot(row, w) for row in J], w)
        d = [_dot(row, torque) for row in inverse]
        x, y, z = (a + b for a, b in zip(_cross(d, c), _cross(w, _cross(w, c)), strict=True))
        # R = Rz Ry Rx, one rotation after the other.
        y, z = cF * y - sF * z, sF * y + cF * z
        x, z = cT * x + sT * z, cT * z - sT * x
        return [sP * y - cP * x, -sP * x - cP * y, -g - z, *_angle_accelerations(v, angles, d)]

    return field


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


BY_HAND: Mapping[str, Equations] = {
    "pendulum": pendulum,
    "double_pendulum": double_pendulum,
    "double_pendulum_positions": double_pendulum,
    "cart_pole": cart_pole,
    "spherical_pendulum": spherical_pendulum,
    "elastic_pendulum": elastic_pendulum,
    "kepler": kepler,
    "kepler_polar": kepler,
    "symmetric_top": symmetric_top,
    "top": top,
    "rigid_body": rigid_body,
    "aircraft": aircraft,
}
