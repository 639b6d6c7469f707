r"""Energies of particles, rigid bodies, gravity and springs, from positions and poses.

Vectors are components in inertial axes unless body axes are named; R takes body components to
inertial ones, as in `jaxlag.rotation`. Functions of the configuration are written once,
`position(t, q, params)` or `pose(t, q, params)`, and differentiated in time here:

    dr/dt = (dr/dq) v + dr/dt at fixed q

so moving frames and prescribed motions (explicit t) are included. The results are terms of T and
V to be added up in `System(kinetic=..., potential=...)`.

Source: Pila, Introduction to Lagrangian Dynamics, secs. 2.2 to 2.5 (eq. 2.16 for rigid bodies).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag import math, rotation
from jaxlag._errors import bad
from jaxlag._params import concrete

Pose = Callable[[Any, Any, Any], tuple[Any, Any]]
"""`pose(t, q, params)` -> (R, r_O): rotation (3, 3) of the body axes and origin O (3,), m."""


def velocity(position: Callable, t: Any, q: Any, v: Any, params: Any) -> Float[Array, "..."]:
    """dr/dt of points r(t, q) as the coordinates move at rates v, by one forward derivative.

    Args:
        position: function `position(t, q, params)` returning r, in m, of any shape.
        t: s.
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).
        params: handed to `position`.

    Returns:
        dr/dt, m/s, in the shape of r and in the same axes.
    """
    return _along(position, t, q, v, params)[1]


def body_velocity(
    pose: Pose, t: Any, q: Any, v: Any, params: Any
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """(V, w) of a rigid body in BODY components, from its pose.

    V = R^T dr_O/dt is the velocity of its origin O in m/s, w with [w]x = R^T dR/dt its angular
    velocity in rad/s.

    Args:
        pose: function `pose(t, q, params)` returning (R, r_O): R of shape (3, 3), proper
            orthogonal, body to inertial components, in any parametrisation; r_O of shape (3,), m.
        t: s.
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).
        params: handed to `pose`.

    Raises:
        ValueError: `pose` returns something else than a (3, 3) and a (3,) array.
    """
    (R, _), (R_rate, r_rate) = _along(_checked(pose), t, q, v, params)
    return R.T @ r_rate, rotation.body_rates(R, R_rate)


def particles(
    position: Callable, mass: Any, t: Any, q: Any, v: Any, params: Any
) -> Float[Array, ""]:
    """T = 1/2 sum_k m_k |dr_k/dt|^2, J.

    Args:
        position: function `position(t, q, params)` returning the particle's r, shape (d,), or
            (k, d) for k of them; m, components in inertial axes.
        mass: kg: a scalar, or shape (k,).
        t: s.
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).
        params: handed to `position`.

    Raises:
        ValueError: positions are not vectors, masses not one for each of them.
    """
    return 0.5 * _weighted(mass, jnp.sum(velocity(position, t, q, v, params) ** 2, axis=-1))


def gravity(mass: Any, r: Any, g: Any) -> Float[Array, ""]:
    """V = -sum_k m_k g . r_k, J, zero at the origin of r.

    Args:
        mass: kg: a scalar, or shape (k,).
        r: positions, m, shape (d,) or (k, d).
        g: acceleration of free fall as a vector (m/s^2), shape (d,): (0, -9.81) with y upwards.

    Raises:
        ValueError: g is not one component for each axis; masses not one for each position.
    """
    r, g = jnp.asarray(r), jnp.asarray(g)
    if g.ndim != 1 or r.ndim == 0 or r.shape[-1] != g.shape[0]:
        raise bad(
            "gravity: g",
            "be a vector with one component for each axis of r",
            f"its shape was {g.shape}, that of r {r.shape}",
            "With y upwards write jnp.array([0.0, -9.81]).",
        )
    return -_weighted(mass, r @ g.astype(r.dtype))


def spring(stiffness: Any, r: Any, length: Any = 0.0) -> Float[Array, ""]:
    """V = k/2 (r.r - 2 l0 |r| + l0^2) = k/2 (|r| - l0)^2 of a spring between two points, J.

    In this form its derivatives to any order are right at zero length with l0 = 0, where the
    Hessian is k times the identity. With l0 > 0 the force at zero length has no direction: the
    term in |r| then counts as constant (see `jaxlag.math.norm`).

    Args:
        stiffness: k, N/m.
        r: vector between the ends, m, shape (d,).
        length: unstretched length l0 >= 0, m.

    Raises:
        ValueError: r is not one vector.
    """
    r = jnp.asarray(r)
    if r.ndim != 1:
        raise bad("spring: r", "be one vector", f"its shape was {r.shape}")
    squared = jnp.sum(r**2)
    if isinstance(length, int | float) and length == 0:
        return 0.5 * stiffness * squared
    return 0.5 * stiffness * (squared - 2 * length * math.norm(r) + length**2)


def inertia_matrix(
    Ix: Any, Iy: Any, Iz: Any, Ixy: Any = 0.0, Ixz: Any = 0.0, Iyz: Any = 0.0
) -> Float[Array, "3 3"]:
    """Inertia matrix from moments and POSITIVE products of inertia, kg m^2, shape (3, 3).

    Ix = int (y^2 + z^2) dm and so on, Ixy = int x y dm and so on; off-diagonal elements are
    -Ixy, -Ixz, -Iyz (Pila, eq. 4.175 ff.).
    """
    rows = [[Ix, -Ixy, -Ixz], [-Ixy, Iy, -Iyz], [-Ixz, -Iyz, Iz]]
    return jnp.stack([jnp.stack([jnp.asarray(x) for x in row]) for row in rows])


def parallel_axis(inertia: Any, mass: Any, centre: Any) -> Float[Array, "3 3"]:
    """I_O = I_G + m (|c|^2 E - c c^T): central inertia carried to a point O, kg m^2.

    Args:
        inertia: I_G about the mass centre, shape (3, 3), or (3,) principal moments.
        mass: m, kg.
        centre: c from O to the mass centre in the same axes, m, shape (3,).
    """
    return _matrix(inertia) + _offset(mass, jnp.asarray(centre))


class RigidBody(eqx.Module):
    """Mass, inertia about the body's origin O, and mass centre: the inertia of a rigid body.

    T = 1/2 m V.V + m V.(w x c) + 1/2 w.I_O w, with V the velocity of O and w the body rates, in
    body components. O is any point fixed in the body; with c = 0 (or left out) it is the mass
    centre and the middle term is not computed.

    Args:
        mass: m, kg, not negative.
        inertia: I_O about O along the body axes, kg m^2, shape (3, 3) symmetric, or (3,) for
            principal axes. Moments may be zero: a slender rod's own axis, or the axes in the
            plane of a planar motion, which never enter.
        centre: c from O to the mass centre, body components, m, shape (3,); by default O itself.

    Raises:
        ValueError: wrong shapes. For concrete values: a negative mass, an inertia that is not
            symmetric or has a negative principal moment (named). Values traced by jit are not
            looked at: build the body, or call `System.check`, once outside.

    Source: Pila, eq. 2.16; the 6 x 6 mass matrix is [[m E, -m [c]x], [m [c]x, I_O]].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, "3 3"]
    centre: Float[Array, "3"] | None

    def __init__(self, mass: Any, inertia: Any, centre: Any = None) -> None:
        self.mass, self.inertia = jnp.asarray(mass), _matrix(inertia)
        self.centre = None if centre is None else jnp.asarray(centre)
        if self.mass.ndim != 0:
            raise bad("RigidBody: mass", "be a number", f"its shape was {self.mass.shape}")
        if self.centre is not None and self.centre.shape != (3,):
            must, was = "be a vector of 3 components", f"its shape was {self.centre.shape}"
            raise bad("RigidBody: centre", must, was, "Planar bodies: (x, y, 0).")
        if concrete(self.mass, self.inertia):
            _check_values(self.mass, self.inertia)

    def kinetic(self, pose: Pose, t: Any, q: Any, v: Any, params: Any) -> Float[Array, ""]:
        """T, J, of the body in the pose `pose(t, q, params)` moving at rates v.

        Args:
            pose: function returning (R, r_O), see `body_velocity`.
            t: s.
            q: coordinates, shape (n,).
            v: generalized velocities, shape (n,).
            params: handed to `pose`.
        """
        return self.kinetic_from_rates(*body_velocity(pose, t, q, v, params))

    def kinetic_from_rates(self, V: Any, w: Any) -> Float[Array, ""]:
        """T = 1/2 m V.V + m V.(w x c) + 1/2 w.I_O w, J.

        Args:
            V: velocity of O, body components, m/s, shape (3,).
            w: body rates, rad/s, shape (3,).
        """
        V, w = jnp.asarray(V), jnp.asarray(w)
        T = 0.5 * self.mass * (V @ V) + 0.5 * w @ (self.inertia @ w)
        return T if self.centre is None else T + self.mass * (V @ jnp.cross(w, self.centre))

    def gravity(self, pose: Pose, t: Any, q: Any, params: Any, g: Any) -> Float[Array, ""]:
        """V = -m g . (r_O + R c), J, zero where the mass centre is at the inertial origin.

        Args:
            pose: function returning (R, r_O), see `body_velocity`.
            t: s.
            q: coordinates, shape (n,).
            params: handed to `pose`.
            g: acceleration of free fall, inertial components, m/s^2, shape (3,).
        """
        R, r = _checked(pose)(t, q, params)
        return gravity(self.mass, r if self.centre is None else r + R @ self.centre, g)


def _along(function: Callable, t: Any, q: Any, v: Any, params: Any) -> tuple[Any, Any]:
    """(value, time derivative) of `function(t, q, params)` along (t', q') = (1, v)."""
    t, q, v = jnp.asarray(t, jnp.result_type(float)), jnp.asarray(q), jnp.asarray(v)
    return jax.jvp(lambda t, q: function(t, q, params), (t, q), (jnp.ones_like(t), v))


def _checked(pose: Pose) -> Pose:
    def checked(t: Any, q: Any, params: Any) -> tuple[Array, Array]:
        value = pose(t, q, params)
        if not isinstance(value, tuple | list) or len(value) != 2:
            raise bad("pose", "return the pair (R, r_O)", f"it returned {type(value).__name__}")
        R, r = map(jnp.asarray, value)
        if R.shape != (3, 3) or r.shape != (3,):
            raise bad(
                "pose",
                "return R of shape (3, 3) and r_O of shape (3,)",
                f"the shapes were {R.shape} and {r.shape}",
                "Planar bodies: rotation.about_z(theta) and (x, y, 0).",
            )
        return R, r

    return checked


def _weighted(mass: Any, values: Array) -> Array:
    mass = jnp.asarray(mass)
    if mass.shape not in ((), values.shape) or values.ndim > 1:
        raise bad(
            "mass",
            "be a number, or one for each of the positions",
            f"its shape was {mass.shape}, the positions' (..., d) with {values.shape} in front",
        )
    return jnp.sum(mass * values)


def _matrix(inertia: Any) -> Array:
    inertia = jnp.asarray(inertia)
    if inertia.shape == (3,):
        return jnp.diag(inertia)
    if inertia.shape != (3, 3):
        must, was = "be (3, 3), or (3,) principal moments", f"its shape was {inertia.shape}"
        raise bad("inertia", must, was, "Planar bodies: (0, 0, Iz).")
    return inertia


def _offset(mass: Any, c: Array) -> Array:
    return mass * (jnp.sum(c**2) * jnp.eye(3, dtype=c.dtype) - jnp.outer(c, c))


def _check_values(mass: Array, inertia: Array) -> None:
    """Raise unless T is non-negative for every rotation, up to rounding; values are concrete."""
    if not mass >= 0:
        raise bad("RigidBody: mass", "not be negative", f"it was {mass} kg")
    matrix = np.asarray(inertia)
    if not np.all(np.isfinite(matrix)):
        raise bad("RigidBody: inertia", "be finite", f"it was {matrix.tolist()}")
    slack = 8 * np.finfo(matrix.dtype).eps * np.max(np.abs(matrix))
    if not np.all(np.abs(matrix - matrix.T) <= slack):
        i, j = np.unravel_index(np.argmax(np.abs(matrix - matrix.T)), (3, 3))
        was = f"element ({i}, {j}) was {matrix[i, j]} and ({j}, {i}) was {matrix[j, i]}"
        raise bad("RigidBody: inertia", "be symmetric", was, "Use energy.inertia_matrix.")
    moments, axes = np.linalg.eigh(matrix)
    if not moments[0] >= -slack:
        axis = ", ".join(f"{x:.3g}" for x in axes[:, 0])
        raise bad(
            "RigidBody: inertia",
            "have no negative principal moment",
            f"its eigenvalue about the axis ({axis}) was {moments[0]:.6g} kg m^2",
            "Products of inertia enter with a minus sign: see energy.inertia_matrix.",
        )
