"""Rotation of a rigid body: matrices, angular velocities and three parametrizations.

Convention: R = T_I/B transforms body components to inertial ones, `r_inertial = R @ r_body`; its
columns are the body axes in inertial components. R^T = T_B/I is the direction cosines
matrix. With w the angular velocity of the body relative to the inertial frame, in rad/s,
`dR/dt = R [w_body]x = [w_space]x R` and `w_space = R @ w_body`; [a]x is `skew(a)`. Both frames
are right-handed, angles are in rad and count positive by the right-hand rule.

All functions take arrays of one rotation; use `jax.vmap` for batches.

Source: Pila, Introduction to Lagrangian Dynamics, ch. 1.
"""

from abc import abstractmethod
from typing import Any, ClassVar, final

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from jaxlag._core._arguments import former_names
from jaxlag._core._arrays import reals
from jaxlag._core._errors import invalid


def _times(A: Array, B: Array) -> Array:
    return jnp.matmul(A, B, precision="highest")  # full float32 precision on every device


def _rows(*rows: tuple[Array, ...]) -> Array:
    return jnp.stack([jnp.stack(row) for row in rows])


def _sin_cos(angles: Array) -> Array:
    return jnp.stack([jnp.sin(angles), jnp.cos(angles)], 1)


def skew(a: Any) -> Float[Array, "3 3"]:
    """Cross-product matrix [a]x: `skew(a) @ b = a x b`.

    Args:
        a: shape (3,), any unit.

    Raises:
        ValueError: wrong shape.

    Source: Pila, ch. 1, where the symbol Omega-hat is -[w]x.
    """
    ((x, y, z),) = reals(("a", a, (3,)))
    zero = jnp.zeros_like(x)
    return _rows((zero, -z, y), (z, zero, -x), (-y, x, zero))


def unskew(S: Any) -> Float[Array, "3"]:
    """The a with `skew(a) = (S - S^T)/2`: inverse of `skew`; a symmetric part is ignored.

    Args:
        S: shape (3, 3), any unit.

    Raises:
        ValueError: wrong shape.

    Source: inverse of [a]x (Pila, ch. 1).
    """
    (S,) = reals(("S", S, (3, 3)))
    return 0.5 * jnp.stack([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]])


def _about(axis: int, angle: Any) -> Array:
    (angle,) = reals(("angle", angle, ()))
    s, c = jnp.sin(angle), jnp.cos(angle)
    one, zero = jnp.ones_like(s), jnp.zeros_like(s)
    about_z = _rows((c, -s, zero), (s, c, zero), (zero, zero, one))
    return jnp.roll(about_z, axis - 2, (0, 1))


def about_x(angle: Any) -> Float[Array, "3 3"]:
    """R of a body rotated by `angle` about x: a positive angle rotates y towards z.

    Args:
        angle: scalar, rad.

    Raises:
        ValueError: not a scalar.

    Source: Pila, ch. 1, transposed (the book has the matrices T_B/I).
    """
    return _about(0, angle)


def about_y(angle: Any) -> Float[Array, "3 3"]:
    """R of a body rotated by `angle` about y: positive rotates z towards x; else as `about_x`."""
    return _about(1, angle)


def about_z(angle: Any) -> Float[Array, "3 3"]:
    """R of a body rotated by `angle` about z: positive rotates x towards y; else as `about_x`."""
    return _about(2, angle)


def compose(*rotations: Any) -> Float[Array, "3 3"]:
    """The product R1 R2 ... of rotation matrices, left to right.

    R1 R2 acts as R2 first and R1 second about fixed axes, or R1 first and R2 second about the
    axes that rotate with the body; with R1 = T_A/B and R2 = T_B/C it is T_A/C.

    Args:
        rotations: each of shape (3, 3).

    Raises:
        ValueError: none given, or one of wrong shape.

    Source: Pila, ch. 1 (successive yaw, pitch and roll).
    """
    if not rotations:
        raise invalid("rotations", "hold at least one matrix", "none was given")
    first, *others = reals(*((f"rotations[{i}]", R, (3, 3)) for i, R in enumerate(rotations)))
    for R in others:
        first = _times(first, R)
    return first


def direction_cosines(R: Any) -> Float[Array, "3 3"]:
    """T_B/I = R^T: entry (i, j) is the cosine between body axis i and inertial axis j.

    Each entry of a proper rotation equals its own cofactor (the book's nine identities).

    Args:
        R: body to inertial, shape (3, 3).

    Raises:
        ValueError: wrong shape.

    Source: Pila, ch. 1, eq. 1.15 ff.
    """
    (R,) = reals(("R", R, (3, 3)))
    return R.T


def body_rates(R: Any, R_dot: Any) -> Float[Array, "3"]:
    """Angular velocity in body components, [w]x = R^T R_dot, shape (3,), rad/s.

    Args:
        R: body to inertial, shape (3, 3), a proper rotation (not checked).
        R_dot: its time derivative, shape (3, 3), 1/s.

    Raises:
        ValueError: wrong shapes.

    Source: Pila, ch. 1: d/dt T_I/B = T_I/B [w]x.
    """
    R, R_dot = reals(("R", R, (3, 3)), ("R_dot", R_dot, (3, 3)))
    return unskew(_times(R.T, R_dot))


def space_rates(R: Any, R_dot: Any) -> Float[Array, "3"]:
    """Angular velocity in inertial components, [w]x = R_dot R^T; else as `body_rates`."""
    R, R_dot = reals(("R", R, (3, 3)), ("R_dot", R_dot, (3, 3)))
    return unskew(_times(R_dot, R.T))


class AbstractParametrization(eqx.Module):
    """Coordinates x of a rotation: `yaw_pitch_roll`, `zxz` and `quaternion`.

    The methods are smooth except where stated, and raise `ValueError` for arguments of wrong
    shape. Units are those of w = W x_dot: rad, and rad/s (quaternion: 1 and 1/s).

    Attributes:
        names: names of the coordinates, in their order.
    """

    names: eqx.AbstractClassVar[tuple[str, ...]]

    def matrix(self, x: Any) -> Float[Array, "3 3"]:
        """R(x), body to inertial.

        Args:
            x: coordinates, shape (n,).
        """
        return self._matrix(*self._read(x))

    def from_matrix(self, R: Any) -> Float[Array, " n"]:
        """x with R(x) = R, in the principal ranges of the class, shape (n,).

        R is reproduced to rounding everywhere, also at gimbal lock. Derivatives are correct along
        rotations (R_dot = R [w]x).

        Args:
            R: body to inertial, shape (3, 3), a proper rotation (not checked).
        """
        (R,) = reals(("R", R, (3, 3)))
        return self._from_matrix(R)

    def body_rate_matrix(self, x: Any) -> Float[Array, "3 n"]:
        """W(x) with w_body = W x_dot.

        By virtual work the generalized force on x of a torque with body components tau, in N m, is
        W^T tau.

        Args:
            x: coordinates, shape (n,).
        """
        return self._body_rate_matrix(*self._read(x))

    def body_rates(self, x: Any, x_dot: Any) -> Float[Array, "3"]:
        """Angular velocity in body components, rad/s.

        Args:
            x: coordinates, shape (n,).
            x_dot: their rates, shape (n,), rad/s.
        """
        x, x_dot = self._read(x, ("x_dot", x_dot, (len(self.names),)))
        return _times(self._body_rate_matrix(x), x_dot)

    def space_rates(self, x: Any, x_dot: Any) -> Float[Array, "3"]:
        """Angular velocity in inertial components, R w_body, rad/s; arguments of `body_rates`."""
        return _times(self.matrix(x), self.body_rates(x, x_dot))

    def from_body_rates(self, x: Any, w: Any) -> Float[Array, " n"]:
        """x_dot of a body rotating with w, shape (n,), rad/s.

        Not finite at gimbal lock, see the class.

        Args:
            x: coordinates, shape (n,).
            w: angular velocity in body components, shape (3,), rad/s.
        """
        return self._from_body_rates(*self._read(x, ("w", w, (3,))))

    def from_space_rates(self, x: Any, w: Any) -> Float[Array, " n"]:
        """As `from_body_rates`, w in inertial components."""
        x, w = self._read(x, ("w", w, (3,)))
        return self._from_body_rates(x, _times(self._matrix(x).T, w))

    def _read(self, x: Any, *others: tuple[str, Any, tuple[int, ...]]) -> list[Array]:
        return reals(("x", x, (len(self.names),)), *others)

    @abstractmethod
    def _matrix(self, x: Array) -> Array: ...

    @abstractmethod
    def _from_matrix(self, R: Array) -> Array: ...

    @abstractmethod
    def _body_rate_matrix(self, x: Array) -> Array: ...

    @abstractmethod
    def _from_body_rates(self, x: Array, w: Array) -> Array: ...


def _divisor(s: Array, theta: Array) -> Array:
    """The sine or cosine `s` of theta, 0 if it is within the rounding of theta itself."""
    rounding = float(jnp.finfo(s.dtype).eps) * jnp.abs(theta)
    return jnp.where(jnp.abs(s) <= rounding, jnp.zeros_like(s), s)


def _direction(y: Array, x: Array) -> Array:
    """Angle of (x, y) in [-pi, pi]; 0 for a zero vector with any signs, its derivative NaN."""
    return jnp.arctan2(y, jnp.where((x == 0) & (y == 0), jnp.zeros_like(x), x))


@final
class YawPitchRoll(AbstractParametrization):
    """x = (psi, theta, phi), in rad: R = Rz(psi) Ry(theta) Rx(phi).

    Yaw psi about Z, then pitch theta about the new y, then roll phi about the new x. The body
    rates are

        w = (phi_dot - psi_dot sin(theta),
             theta_dot cos(phi) + psi_dot cos(theta) sin(phi),
             psi_dot cos(theta) cos(phi) - theta_dot sin(phi)).

    Gimbal lock at cos(theta) = 0: det W = -cos(theta), with columns in our order (+cos(theta) in
    the book's order phi, theta, psi). There psi_dot and phi_dot from w are inf or NaN, also for
    the nearest representable theta; close to it their error grows as eps/|cos(theta)|.

    Principal ranges: psi and phi in [-pi, pi], theta in [-pi/2, pi/2]. At lock only psi - phi
    (theta = pi/2) or psi + phi (theta = -pi/2) is determined: psi = 0 where R[0, 0] = R[1, 0] = 0,
    and not differentiable.

    Source: Pila, Introduction to Lagrangian Dynamics, ch. 1.
    """

    names: ClassVar[tuple[str, ...]] = ("psi", "theta", "phi")

    def _matrix(self, x: Array) -> Array:
        (sP, cP), (sT, cT), (sF, cF) = _sin_cos(x)
        return _rows(
            (cT * cP, sF * sT * cP - cF * sP, cF * sT * cP + sF * sP),
            (cT * sP, sF * sT * sP + cF * cP, cF * sT * sP - sF * cP),
            (-sT, sF * cT, cF * cT),
        )

    def _from_matrix(self, R: Array) -> Array:
        psi = _direction(R[1, 0], R[0, 0])
        s, c = jnp.sin(psi), jnp.cos(psi)
        x_row, y_row = c * R[0] + s * R[1], c * R[1] - s * R[0]  # of Ry(theta) Rx(phi)
        return jnp.stack([psi, jnp.arctan2(-R[2, 0], x_row[0]), jnp.arctan2(-y_row[2], y_row[1])])

    def _body_rate_matrix(self, x: Array) -> Array:
        _, (sT, cT), (sF, cF) = _sin_cos(x)
        zero, one = jnp.zeros_like(sT), jnp.ones_like(sT)
        return _rows((-sT, zero, one), (cT * sF, cF, zero), (cT * cF, -sF, zero))

    def _from_body_rates(self, x: Array, w: Array) -> Array:
        _, (sT, cT), (sF, cF) = _sin_cos(x)
        psi_dot = (sF * w[1] + cF * w[2]) / _divisor(cT, x[1])
        return jnp.stack([psi_dot, cF * w[1] - sF * w[2], w[0] + sT * psi_dot])


@final
class ZXZ(AbstractParametrization):
    """x = (phi, theta, psi), in rad: R = Rz(phi) Rx(theta) Rz(psi).

    Precession phi about Z, nutation theta about the new x, spin psi about the new z. The body
    rates are

        w = (phi_dot sin(theta) sin(psi) + theta_dot cos(psi),
             phi_dot sin(theta) cos(psi) - theta_dot sin(psi),
             phi_dot cos(theta) + psi_dot).

    Gimbal lock at sin(theta) = 0, the upright body: det W = -sin(theta). There phi_dot and
    psi_dot from w are inf or NaN, also for the representable theta nearest a multiple of pi;
    close to it their error grows as eps/|sin(theta)|.

    Principal ranges: phi and psi in [-pi, pi], theta in [0, pi]. At lock only phi + psi
    (theta = 0) or phi - psi (theta = pi) is determined: phi = 0 where R[0, 2] = R[1, 2] = 0, and
    not differentiable.

    Source: Goldstein, Classical Mechanics, secs. 4.4 and 4.9.
    """

    names: ClassVar[tuple[str, ...]] = ("phi", "theta", "psi")

    def _matrix(self, x: Array) -> Array:
        (sF, cF), (sT, cT), (sP, cP) = _sin_cos(x)
        return _rows(
            (cF * cP - sF * cT * sP, -cF * sP - sF * cT * cP, sF * sT),
            (sF * cP + cF * cT * sP, -sF * sP + cF * cT * cP, -cF * sT),
            (sT * sP, sT * cP, cT),
        )

    def _from_matrix(self, R: Array) -> Array:
        phi = _direction(R[0, 2], -R[1, 2])
        s, c = jnp.sin(phi), jnp.cos(phi)
        x_row, y_row = c * R[0] + s * R[1], c * R[1] - s * R[0]  # of Rx(theta) Rz(psi)
        return jnp.stack([phi, jnp.arctan2(-y_row[2], R[2, 2]), jnp.arctan2(-x_row[1], x_row[0])])

    def _body_rate_matrix(self, x: Array) -> Array:
        _, (sT, cT), (sP, cP) = _sin_cos(x)
        zero, one = jnp.zeros_like(sT), jnp.ones_like(sT)
        return _rows((sT * sP, cP, zero), (sT * cP, -sP, zero), (cT, zero, one))

    def _from_body_rates(self, x: Array, w: Array) -> Array:
        _, (sT, cT), (sP, cP) = _sin_cos(x)
        phi_dot = (sP * w[0] + cP * w[1]) / _divisor(sT, x[1])
        return jnp.stack([phi_dot, cP * w[0] - sP * w[1], w[2] - cT * phi_dot])


@final
class Quaternion(AbstractParametrization):
    """x = (e0, e1, e2, e3), scalar first, of any norm but 0: r_inertial = e r_body e^-1.

    A rotation by alpha about the unit axis n is e = (cos(alpha/2), n sin(alpha/2)); e and every
    multiple of it give the same R. With * the conjugate, the rates are

        w_body = 2 vec(e* e_dot)/(e.e),    e_dot = e (0, w_body)/2,
        w_space = 2 vec(e_dot e*)/(e.e),   e_dot = (0, w_space) e/2;

    e_dot from w keeps e.e. There is no gimbal lock; W W^T = 4 E/(e.e). R does not depend on the
    norm, so the mass matrix of a Lagrangian in e alone is singular along e. e = 0 gives NaN.

    Principal range: unit norm and e0 >= 0; if e0 = 0 (half turns) the largest component is
    positive. Near half turns rounding determines the sign, and from_matrix jumps there.

    Source: Shepperd, J. Guidance and Control 1 (1978) 223 (from_matrix); Goldstein, Classical
    Mechanics, sec. 4.5 (Euler parameters).
    """

    names: ClassVar[tuple[str, ...]] = ("e0", "e1", "e2", "e3")

    def multiply(self, a: Any, b: Any) -> Float[Array, "4"]:
        """Product a b, of any norms: matrix(a b) = matrix(a) @ matrix(b).

        Args:
            a: shape (4,), scalar first.
            b: shape (4,), scalar first.
        """
        a, b = reals(("a", a, (4,)), ("b", b, (4,)))
        return _multiply(a, b)

    def conjugate(self, a: Any) -> Float[Array, "4"]:
        """(a0, -a1, -a2, -a3): the inverse rotation, matrix(a*) = matrix(a)^T.

        Args:
            a: shape (4,), scalar first.
        """
        (a,) = reals(("a", a, (4,)))
        return jnp.concatenate([a[:1], -a[1:]])

    def _matrix(self, x: Array) -> Array:
        e0, e1, e2, e3 = x / _largest(x)
        a, b, c, d = e0 * e0, e1 * e1, e2 * e2, e3 * e3
        return _rows(
            (a + b - c - d, 2 * (e1 * e2 - e0 * e3), 2 * (e1 * e3 + e0 * e2)),
            (2 * (e1 * e2 + e0 * e3), a - b + c - d, 2 * (e2 * e3 - e0 * e1)),
            (2 * (e1 * e3 - e0 * e2), 2 * (e2 * e3 + e0 * e1), a - b - c + d),
        ) / (a + b + c + d)

    def _from_matrix(self, R: Array) -> Array:
        x, y, z = R[0, 0], R[1, 1], R[2, 2]
        u, v, w = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        f, g, h = R[2, 1] + R[1, 2], R[0, 2] + R[2, 0], R[1, 0] + R[0, 1]
        rows = _rows(  # 4 e e^T: each row is e times a number, best the largest
            (1 + x + y + z, u, v, w),
            (u, 1 + x - y - z, h, g),
            (v, h, 1 - x + y - z, f),
            (w, g, f, 1 - x - y + z),
        )
        row = rows[jnp.argmax(jnp.diagonal(rows))]
        norm = jnp.sqrt(jnp.sum(row * row))
        return row / jnp.where(row[0] < 0, -norm, norm)

    def _body_rate_matrix(self, x: Array) -> Array:
        scale = _largest(x)
        x = x / scale
        e0, e1, e2, e3 = x
        rows = _rows((-e1, e0, e3, -e2), (-e2, -e3, e0, e1), (-e3, e2, -e1, e0))
        return 2 * rows / jnp.sum(x * x) / scale

    def _from_body_rates(self, x: Array, w: Array) -> Array:
        return 0.5 * _multiply(x, jnp.concatenate([jnp.zeros_like(w[:1]), w]))


def _largest(x: Array) -> Array:
    """max|x_i|, a scale against overflow and underflow of squares.

    R(x/s) = R(x) and W(x/s)/s = W(x) for every number s, so s is not differentiated.
    """
    return jnp.max(jnp.abs(stop_gradient(x)))


def _multiply(a: Array, b: Array) -> Array:
    scalar = a[0] * b[0] - jnp.sum(a[1:] * b[1:])
    return jnp.append(scalar, a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:]))


yaw_pitch_roll = YawPitchRoll()
zxz = ZXZ()
quaternion = Quaternion()

__getattr__ = former_names(__name__, {"AbstractParametrisation": "AbstractParametrization"})
