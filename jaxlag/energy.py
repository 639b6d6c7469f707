r"""Energies of particles, rigid bodies, gravity and springs, from positions and poses.

Vectors are components in inertial axes unless body axes are named; R takes body components to
inertial ones, as in `jaxlag.rotation`. Functions of the configuration are written once,
`position(t, q, params)` or `pose(t, q, params)`, and differentiated in time here:

    dr/dt = (dr/dq) v + dr/dt at fixed q

so moving frames and prescribed motions (explicit t) are included. The results are terms of T and
V to be added up in `System(kinetic=..., potential=...)`, in the precision of the positions and
velocities: masses, inertias, stiffnesses and g are converted to it.

Source: Pila, Introduction to Lagrangian Dynamics, secs. 2.2 to 2.5 (eq. 2.16 for rigid bodies).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag import math, rotation
from jaxlag._core._arguments import renamed
from jaxlag._core._arrays import common, concrete, real, reals
from jaxlag._core._errors import invalid
from jaxlag._model import _inertia
from jaxlag._tracing._signature import require_arity

Pose = Callable[[Any, Any, Any], tuple[Any, Any]]
"""`pose(t, q, params)` -> (R, r_O): rotation (3, 3) of the body axes and origin O (3,), m."""


def velocity(position: Callable, t: Any, q: Any, v: Any, params: Any) -> Float[Array, "..."]:
    """dr/dt of points r(t, q) for coordinate rates v, by one forward derivative.

    Args:
        position: function `position(t, q, params)` returning r, in m, of any shape.
        t: s.
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).
        params: passed to `position`.

    Returns:
        dr/dt, m/s, in the shape of r and in the same axes.

    Raises:
        ValueError: `position` is no function of (t, q, params) or does not return an array of
            real numbers; q and v of different shapes; t no number.
    """
    return _along(_located(position), t, q, v, params)[1]


def body_velocity(
    pose: Pose, t: Any, q: Any, v: Any, params: Any
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """(V, w) of a rigid body in BODY components, from its pose.

    V = R^T dr_O/dt is the velocity of its origin O in m/s, w with [w]x = R^T dR/dt its angular
    velocity in rad/s.

    Args:
        pose: function `pose(t, q, params)` returning (R, r_O): R of shape (3, 3), proper
            orthogonal, body to inertial components, in any parametrization; r_O of shape (3,), m.
        t: s.
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).
        params: passed to `pose`.

    Raises:
        ValueError: `pose` is no function of (t, q, params) or does not return a (3, 3) and a
            (3,) array of real numbers; q and v of different shapes; t no number.
    """
    (R, _), (R_rate, r_rate) = _along(_placed(pose), t, q, v, params)
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
        params: passed to `position`.

    Raises:
        ValueError: positions are not vectors, or the number of masses differs; as `velocity`.
    """
    rates = velocity(position, t, q, v, params)
    if rates.ndim not in (1, 2):
        raise invalid(
            "position",
            "return a vector of shape (d,), or (k, d) for k particles",
            f"it returned shape {rates.shape}",
            "Return jnp.stack([x, y]), and jnp.stack([x]) where one axis is enough.",
        )
    return 0.5 * _weighted(mass, jnp.sum(rates**2, axis=-1))


def gravity(mass: Any, r: Any, g: Any) -> Float[Array, ""]:
    """V = -sum_k m_k g . r_k, J, zero at the origin of r.

    Args:
        mass: kg: a scalar, or shape (k,).
        r: positions, m, shape (d,) or (k, d).
        g: acceleration of free fall as a vector (m/s^2), shape (d,): (0, -9.81) with y upwards.

    Raises:
        ValueError: g is not one component for each axis; masses not one for each position.
    """
    r, g = real("gravity: r", r), real("gravity: g", g)
    if g.ndim != 1 or r.ndim == 0 or r.shape[-1] != g.shape[0]:
        raise invalid(
            "gravity: g",
            "be a vector with one component for each axis of r",
            f"its shape was {g.shape}, that of r {r.shape}",
            "With y upwards write jnp.array([0.0, -9.81]).",
        )
    return -_weighted(mass, r @ g.astype(r.dtype))


def spring(stiffness: Any, r: Any, length: Any = 0.0) -> Float[Array, ""]:
    """V = k/2 (r.r - 2 l0 |r| + l0^2) = k/2 (|r| - l0)^2 of a spring between two points, J.

    In this form its derivatives of any order are correct at zero length with l0 = 0: the
    Hessian is k times the identity. With l0 > 0 the force at zero length has no direction: the
    term in |r| then counts as constant (see `jaxlag.math.norm`).

    Args:
        stiffness: k, N/m.
        r: vector between the ends, m, shape (d,).
        length: unstretched length l0 >= 0, m.

    Raises:
        ValueError: r is not one vector, stiffness or length not one number; a negative length
            (if its value is known).
    """
    r = real("spring: r", r)
    if r.ndim != 1:
        was = f"its shape was {r.shape}"
        raise invalid("spring: r", "be one vector", was, "Several springs: sum over jax.vmap.")
    k = _inertia.number("spring: stiffness", stiffness).astype(r.dtype)
    l0 = _inertia.number("spring: length", length)
    if concrete(l0) and not float(l0) >= 0:
        raise invalid("spring: length", "not be negative", f"it was {l0} m")
    squared = jnp.sum(r**2)
    if isinstance(length, int | float) and length == 0:
        return 0.5 * k * squared
    l0 = l0.astype(r.dtype)
    return 0.5 * k * (squared - 2 * l0 * math.norm(r) + l0**2)


def inertia_matrix(
    Ix: Any, Iy: Any, Iz: Any, Ixy: Any = 0.0, Ixz: Any = 0.0, Iyz: Any = 0.0
) -> Float[Array, "3 3"]:
    """Inertia matrix from moments and POSITIVE products of inertia, kg m^2, shape (3, 3).

    Ix = int (y^2 + z^2) dm and so on, Ixy = int x y dm and so on; off-diagonal elements are
    -Ixy, -Ixz, -Iyz (Pila, eq. 4.175 ff.).

    Raises:
        ValueError: one of them is not a real number.
    """
    given = {"Ix": Ix, "Iy": Iy, "Iz": Iz, "Ixy": Ixy, "Ixz": Ixz, "Iyz": Iyz}
    values = [_inertia.number(f"inertia_matrix: {name}", x) for name, x in given.items()]
    return _inertia.of_products(values[:3], values[3:])


@renamed(centre="center=")
def parallel_axis(inertia: Any, mass: Any, center: Any) -> Float[Array, "3 3"]:
    """I_O = I_G + m (|c|^2 E - c c^T): central inertia transferred to a point O, kg m^2.

    Args:
        inertia: I_G about the center of mass, shape (3, 3), or (3,) principal moments.
        mass: m, kg.
        center: c from O to the center of mass in the same axes, m, shape (3,).

    Raises:
        ValueError: wrong shapes; a negative or nonfinite mass (if its value is known).
    """
    inertia = _inertia.matrix("parallel_axis: inertia", inertia)
    mass = _inertia.number("parallel_axis: mass", mass)
    _inertia.check_mass("parallel_axis: mass", mass)
    return _inertia.carried(inertia, mass, _inertia.place("parallel_axis: center", center))


class RigidBody(eqx.Module):
    """Mass, inertia about the body's origin O, and center of mass of a rigid body.

    T = 1/2 m V.V + m V.(w x c) + 1/2 w.I_O w, with V the velocity of O and w the body rates, in
    body components. O is any point fixed in the body. With c = 0 (or left out) it is the center of
    mass and the middle term is not computed.

    Args:
        mass: m, kg, not negative.
        inertia: I_O about O along the body axes, kg m^2, shape (3, 3) symmetric, or (3,) for
            principal axes. Moments may be zero: a slender rod's own axis, or the axes in the
            plane of a planar motion, which are not used.
        center: c from O to the center of mass, body components, m, shape (3,); by default O itself.

    Raises:
        ValueError: wrong shapes, or not real numbers. For known values: a negative mass, nonfinite
            numbers, an inertia that is not symmetric, has a negative principal moment, or gives a
            negative one about the center of mass (it is then not about O; the axis is named).
            Values traced by jit are not checked, but numbers inside a traced Lagrangian are: build
            the body, or call `System.check`, once outside.

    Source: Pila, eq. 2.16; the 6 x 6 mass matrix is [[m E, -m [c]x], [m [c]x, I_O]].
    """

    mass: Float[Array, ""]
    inertia: Float[Array, "3 3"]
    center: Float[Array, "3"] | None

    @renamed(centre="center=")
    def __init__(self, mass: Any, inertia: Any, center: Any = None) -> None:
        self.mass = _inertia.number("RigidBody: mass", mass)
        self.inertia = _inertia.matrix("RigidBody: inertia", inertia)
        self.center = None if center is None else _inertia.place("RigidBody: center", center)
        _inertia.check_mass("RigidBody: mass", self.mass)
        _inertia.check_inertia("RigidBody: inertia", self.inertia)
        if self.center is not None:
            _inertia.check_finite("RigidBody: center", self.center)
            body = (self.inertia, self.mass, self.center)
            _inertia.check_about_origin("RigidBody: inertia", *body)

    def kinetic(self, pose: Pose, t: Any, q: Any, v: Any, params: Any) -> Float[Array, ""]:
        """T, J, of the body in the pose `pose(t, q, params)` with the rates v.

        T = 1/2 m v_G.v_G + 1/2 w.I_G w (König): the velocity of the center of mass is the rate of
        its position in inertial components, and need not be turned into body axes.

        Args:
            pose: function returning (R, r_O), see `body_velocity`.
            t: s.
            q: coordinates, shape (n,).
            v: generalized velocities, shape (n,).
            params: passed to `pose`.
        """
        (R, _), (R_rate, velocity) = _along(_placed(pose), t, q, v, params)
        inertia = self.inertia
        if self.center is not None:
            velocity = velocity + R_rate @ self.center.astype(R.dtype)
            inertia = _inertia.central(inertia, self.mass, self.center)
        return _kinetic(self.mass, inertia, velocity, rotation.body_rates(R, R_rate))

    def kinetic_from_rates(self, V: Any, w: Any) -> Float[Array, ""]:
        """T = 1/2 m V.V + m V.(w x c) + 1/2 w.I_O w, J.

        Args:
            V: velocity of O, body components, m/s, shape (3,).
            w: body rates, rad/s, shape (3,).

        Raises:
            ValueError: V or w not of shape (3,).
        """
        V, w = reals(("V", V, (3,)), ("w", w, (3,)))
        T = _kinetic(self.mass, self.inertia, V, w)
        if self.center is None:
            return T
        mass, center = self.mass.astype(V.dtype), self.center.astype(V.dtype)
        return T + mass * (V @ jnp.cross(w, center))

    def gravity(self, pose: Pose, t: Any, q: Any, params: Any, g: Any) -> Float[Array, ""]:
        """V = -m g . (r_O + R c), J, zero if the center of mass is at the inertial origin.

        Args:
            pose: function returning (R, r_O), see `body_velocity`.
            t: s.
            q: coordinates, shape (n,).
            params: passed to `pose`.
            g: acceleration of free fall, inertial components, m/s^2, shape (3,).
        """
        R, r = _placed(pose)(t, q, params)
        if self.center is not None:
            r = r + R @ self.center.astype(R.dtype)
        return gravity(self.mass, r, g)


def _kinetic(mass: Array, inertia: Array, V: Array, w: Array) -> Array:
    """m V.V / 2 + w.I w / 2; a traced I is made symmetric, which its use in M and h relies on."""
    mass, inertia = mass.astype(V.dtype), inertia.astype(V.dtype)
    inertia = 0.5 * (inertia + inertia.T)
    return 0.5 * mass * (V @ V) + 0.5 * w @ (inertia @ w)


def _along(function: Callable, t: Any, q: Any, v: Any, params: Any) -> tuple[Any, Any]:
    """(value, time derivative) of `function(t, q, params)` along (t', q') = (1, v)."""
    t = _inertia.number("t", t).astype(jnp.result_type(float))
    q, v = common(real("q", q), real("v", v))
    if v.shape != q.shape:
        was = f"their shapes were {v.shape} and {q.shape}"
        raise invalid("v", "have the shape of q", was, "Give one velocity for each coordinate.")
    return jax.jvp(lambda t, q: function(t, q, params), (t, q), (jnp.ones_like(t), v))


def _located(position: Callable) -> Callable:
    """`position`, with an error in our form while tracing unless it returns a real array."""
    require_arity("position", position, ("t", "q", "params"))

    def located(t: Any, q: Any, params: Any) -> Array:
        value = position(t, q, params)
        if not eqx.is_array_like(value):
            fix = "Return jnp.stack([x, y]), several points as jnp.stack([r1, r2])."
            raise invalid("position", "return an array", f"it returned {type(value).__name__}", fix)
        return real("position", value)

    return located


def _placed(pose: Pose) -> Pose:
    """`pose`, with an error in our form unless it returns (R, r_O); both of one dtype."""
    require_arity("pose", pose, ("t", "q", "params"))

    def placed(t: Any, q: Any, params: Any) -> tuple[Array, Array]:
        value = pose(t, q, params)
        if not isinstance(value, tuple | list) or len(value) != 2:
            raise invalid("pose", "return the pair (R, r_O)", f"it returned {type(value).__name__}")
        R, r = common(real("pose: R", value[0]), real("pose: r_O", value[1]))
        if R.shape != (3, 3) or r.shape != (3,):
            raise invalid(
                "pose",
                "return R of shape (3, 3) and r_O of shape (3,)",
                f"the shapes were {R.shape} and {r.shape}",
                "Planar bodies: rotation.about_z(theta) and (x, y, 0).",
            )
        return R, r

    return placed


def _weighted(mass: Any, values: Array) -> Array:
    mass = real("mass", mass)
    if mass.shape not in ((), values.shape) or values.ndim > 1:
        raise invalid(
            "mass",
            "be a number, or one for each of the positions",
            f"its shape was {mass.shape}, and that of the positions was {values.shape} without the "
            "last axis",
        )
    return jnp.sum(mass.astype(values.dtype) * values)
