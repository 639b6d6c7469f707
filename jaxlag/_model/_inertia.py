"""Mass, inertia matrix and center of mass of a rigid body: input, transformation, validity."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arrays import common, concrete, real
from jaxlag._core._errors import invalid


def stated(*values: Any) -> AbstractContextManager:
    """A context in which arrays of values stay values, also under a trace of JAX.

    Without it `jnp.asarray` makes a tracer of a constant inside a traced Lagrangian, and errors in
    the constant cannot be detected. No effect if one of the values is traced.
    """
    return jax.ensure_compile_time_eval() if concrete(values) else nullcontext()


def number(argument: str, x: Any) -> Array:
    """A real number of shape ()."""
    with stated(x):
        x = real(argument, x)
    if x.ndim != 0:
        raise invalid(argument, "be a number", f"its shape was {x.shape}")
    return x


def place(argument: str, x: Any) -> Array:
    """A real vector of shape (3,)."""
    with stated(x):
        x = real(argument, x)
    if x.shape != (3,):
        must, was = "be a vector of 3 components", f"its shape was {x.shape}"
        raise invalid(argument, must, was, "Planar bodies: (x, y, 0).")
    return x


def matrix(argument: str, inertia: Any) -> Array:
    """An inertia matrix, shape (3, 3), from a matrix or from (3,) principal moments."""
    with stated(inertia):
        x = real(argument, inertia)
        if x.shape == (3,):
            xp, (x,) = _numbers(x)
            return jnp.asarray(xp.diag(x))
    if x.shape != (3, 3):
        must, was = "be (3, 3), or (3,) principal moments", f"its shape was {x.shape}"
        raise invalid(argument, must, was, "Planar bodies: (0, 0, Iz).")
    return x


def of_products(moments: list[Array], products: list[Array]) -> Array:
    """The matrix of (Ix, Iy, Iz) and of the positive products (Ixy, Ixz, Iyz)."""
    with stated(moments, products):
        xp, given = _numbers(*common(*moments, *products))
        Ix, Iy, Iz, Ixy, Ixz, Iyz = given
        rows = [[Ix, -Ixy, -Ixz], [-Ixy, Iy, -Iyz], [-Ixz, -Iyz, Iz]]
        return jnp.asarray(xp.stack([xp.stack(row) for row in rows]))


def carried(inertia: Array, mass: Array, center: Array) -> Array:
    """I_G + m (|c|^2 E - c c^T)."""
    with stated(inertia, mass, center):
        xp, given = _numbers(*common(inertia, mass, center))
        inertia, mass, center = given
        return jnp.asarray(inertia + _offset(xp, mass, center))


def central(inertia: Array, mass: Array, center: Array) -> Array:
    """I_G = I_O - m (|c|^2 E - c c^T)."""
    with stated(inertia, mass, center):
        return carried(inertia, -mass, center)


def check_mass(argument: str, mass: Array) -> None:
    """Raise unless a mass with a value is finite and not negative."""
    if not concrete(mass):
        return
    if not np.isfinite(float(mass)):
        raise invalid(argument, "be finite", f"it was {mass} kg")
    if float(mass) < 0:  # a float, for comparing arrays is traced
        raise invalid(argument, "not be negative", f"it was {mass} kg")


def check_finite(argument: str, x: Array) -> None:
    """Raise unless an array with values is finite."""
    if concrete(x) and not np.all(np.isfinite(x)):
        raise invalid(argument, "be finite", f"it was {np.asarray(x).tolist()}")


def check_inertia(argument: str, inertia: Float[Array, "3 3"]) -> None:
    """Raise unless an inertia with values is symmetric without negative moments, up to rounding."""
    check_finite(argument, inertia)
    if not concrete(inertia):
        return
    J = np.asarray(inertia, np.float64)
    slack = 8 * float(jnp.finfo(inertia.dtype).eps) * np.max(np.abs(J))
    if not np.all(np.abs(J - J.T) <= slack):
        i, j = np.unravel_index(np.argmax(np.abs(J - J.T)), (3, 3))
        was = f"element ({i}, {j}) was {J[i, j]} and ({j}, {i}) was {J[j, i]}"
        raise invalid(argument, "be symmetric", was, "Use energy.inertia_matrix.")
    moments, axes = np.linalg.eigh(J)
    if not moments[0] >= -slack:
        raise invalid(
            argument,
            "have no negative principal moment",
            f"its eigenvalue about the axis {_axis(axes[:, 0])} was {moments[0]:.6g} kg m^2",
            "Products of inertia enter with a minus sign: see energy.inertia_matrix.",
        )


def check_about_origin(argument: str, inertia: Array, mass: Array, center: Array) -> None:
    """Raise unless I_O - m (|c|^2 E - c c^T), the central inertia, has no negative eigenvalue.

    Only on the axes whose row of I_O is not zero: the other axes of a planar body or of a slender
    rod do not rotate. The slack is some roundings of the terms of the difference.
    """
    if not concrete(inertia, mass, center):
        return
    J, c = np.asarray(inertia, np.float64), np.asarray(center, np.float64)
    turning = np.flatnonzero(np.any(J != 0, axis=1))
    if turning.size == 0:
        return
    at_center = _offset(np, float(mass), c)
    moments, axes = np.linalg.eigh((J - at_center)[turning][:, turning])
    eps = max(float(jnp.finfo(x.dtype).eps) for x in (inertia, mass, center))
    if moments[0] >= -64 * eps * max(np.max(np.abs(J)), np.max(np.abs(at_center))):
        return
    axis = np.zeros(3)
    axis[turning] = axes[:, 0]
    raise invalid(
        argument,
        "be at least that of a point mass at the center, m (|c|^2 E - c c^T)",
        f"the difference, the inertia about the mass center, has the eigenvalue {moments[0]:.6g} "
        f"kg m^2 about the axis {_axis(axis)}",
        "Give the inertia about the body's origin: use energy.parallel_axis.",
    )


def _axis(axis: np.ndarray) -> str:
    return f"({', '.join(f'{x:.3g}' for x in axis)})"


def _numbers(*arrays: Array) -> tuple[Any, list[Any]]:
    """numpy and its arrays if all have values, without dispatch; else jax.numpy."""
    return (np, [np.asarray(x) for x in arrays]) if concrete(arrays) else (jnp, list(arrays))


def _offset(xp: Any, mass: Any, c: Any) -> Any:
    return mass * (xp.sum(c**2) * xp.eye(3, dtype=c.dtype) - xp.outer(c, c))
