"""Inverse dynamics: the generalized forces of a given motion."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arrays import concrete, of_state, real
from jaxlag._core._errors import invalid
from jaxlag._model._forces import reads_lam
from jaxlag._model._inputs import check_inputs, check_range, evaluate
from jaxlag._system._inspection import check_declaration
from jaxlag._system._system import System
from jaxlag._tracing._compiled import Compiled
from jaxlag._tracing._signature import require_arity
from jaxlag._tracing._traced_function import warn_of_changes


def inverse_dynamics(
    system: System,
    q: Any,
    v: Any,
    a: Any,
    params: Any = None,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | None = None,
) -> Float[Array, "*s n"]:
    """Generalized force M a + h - Q that a motion needs in addition to the declared forces.

    It includes the generalized force of the constraints, A^T lam.

    One derivative of the momentum along the motion: d/dt(dL/dv) - dL/dq - Q. M is neither computed
    nor factored, so it may be singular (massless links). Composes with jit, vmap and every
    derivative of JAX.

    Args:
        system: the mechanical system with n coordinates.
        q: coordinates, shape (n,), or (s, n) for s instants, or at one instant a dict by name;
            m or rad.
        v: velocities dq/dt, in the same form; m/s or rad/s.
        a: accelerations dv/dt, in the same form; m/s^2 or rad/s^2.
        params: as the Lagrangian takes them.
        t: the instant in s, or the (s,) instants of the states.
        inputs: dict from names to input objects or arrays, as in `simulate`.

    Returns:
        Shape (n,) or (s, n): N if q_i is in m, N m if it is in rad; positive acts towards
        larger q_i.

    Raises:
        ValueError: q, v, a are not real numbers of shape (n,) or (s, n), have no state, or have
            nonfinite values (the coordinate is named); t is not one instant for each state;
            inputs that no force reads.

    Source: Pila, secs. 2.7, 2.8 (given motion, unknown forces) and eq. 3.53.

    Example:
        Torque of the motor of a driven pendulum, theta = 0.3 sin(2 t), at t = 0.5:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * 0.4 * v[0] ** 2 + 0.4 * 9.81 * jnp.cos(q[0])
        >>> pendulum = jl.System(lagrangian, coordinates=("theta",))
        >>> q, v, a = jl.prescribed_motion(lambda t: 0.3 * jnp.sin(2 * jnp.array([t])), 0.5)
        >>> print(f"{jl.inverse_dynamics(pendulum, q, v, a)[0]:.6f} N m")
        0.576186 N m
    """
    if not isinstance(system, System):
        raise invalid("inverse_dynamics: system", "be a jl.System", f"it was {system!r}")
    if any(map(reads_lam, system.forces)):
        was = "it has some"
        must = "be a system without forces that depend on multipliers"
        raise invalid("inverse_dynamics: system", must, was, "A motion does not determine lam.")
    q, v, a, t = _motion(system, q, v, a, t)
    inputs = check_inputs(inputs)
    check_range(inputs, t, "t")
    warn_of_changes(system, inputs)
    return _needed((system._mechanics,), params, inputs, t, q, v, a)


def prescribed_motion(
    motion: Callable, t: Any
) -> tuple[Float[Array, "*s n"], Float[Array, "*s n"], Float[Array, "*s n"]]:
    """(q, v, a) of a motion given as a function of time, by two forward derivatives.

    Args:
        motion: function `motion(t)` of a scalar time in s, returning q of shape (n,).
        t: the instant in s, or (s,) instants.

    Returns:
        q, v = dq/dt and a = d2q/dt2, each (n,) or (s, n).

    Raises:
        ValueError: `motion` is no function of t, or does not return real numbers of shape (n,);
            t is neither a number nor an array (s,).
    """
    require_arity("prescribed_motion: motion", motion, ("t",))
    t = real("prescribed_motion: t", t).astype(jnp.result_type(float))
    if t.ndim > 1:
        must, was = "be an instant or an array of them", f"its shape was {t.shape}"
        raise invalid("prescribed_motion: t", must, was)

    def coordinates(t: Array) -> Array:
        q = motion(t)
        if not eqx.is_array_like(q) or jnp.ndim(q) != 1:
            was = f"shape {jnp.shape(q)}" if eqx.is_array_like(q) else f"{q!r}"
            raise invalid(
                "prescribed_motion: motion",
                "return all coordinates as one vector of shape (n,)",
                f"it returned {was}",
                "Use jnp.stack([q1, q2]).",
            )
        return real("prescribed_motion: `motion(t)`", q)

    def rate(f: Callable, t: Array) -> Array:
        return jax.jvp(f, (t,), (jnp.ones_like(t),))[1]

    def at(t: Array) -> tuple[Array, Array, Array]:
        velocity = partial(rate, coordinates)
        return coordinates(t), velocity(t), rate(velocity, t)

    return at(t) if t.ndim == 0 else jax.vmap(at)(t)


def _motion(system: System, q: Any, v: Any, a: Any, t: Any) -> tuple[Array, Array, Array, Array]:
    """(q, v, a, t) of one shape and precision; an error names an argument of another shape."""
    vectors: list[Array] = []
    n, labels = system.size, system.coordinates.labels
    for name, x in (("q", q), ("v", v), ("a", a)):
        argument = f"inverse_dynamics: {name}"
        if isinstance(x, Mapping):
            x = system.coordinates.flatten(x, argument)
        x = real(argument, x)
        shape = vectors[0].shape if vectors else x.shape
        if x.ndim not in (1, 2) or x.shape[-1] != n or x.shape != shape:
            same = f", as q with {shape}" if vectors else ""
            must = f"have shape ({n},) or (s, {n}){same}: {', '.join(labels)}"
            raise invalid(argument, must, f"its shape was {x.shape}")
        if x.size == 0:
            raise invalid(argument, "hold at least one instant", f"its shape was {x.shape}")
        _check_finite(argument, x, labels)
        vectors.append(x)
    batch = vectors[0].shape[:-1]
    t = real("inverse_dynamics: t", t)
    if t.shape not in ((), batch):
        raise invalid(
            "inverse_dynamics: t", f"have shape () or {batch}", f"its shape was {t.shape}"
        )
    if concrete(t) and not np.all(np.isfinite(t)):
        raise invalid("inverse_dynamics: t", "be finite", f"it was {t}")
    q, v, a = of_state("q, v and a", *vectors)
    return q, v, a, jnp.broadcast_to(t, batch).astype(jnp.result_type(float))


def _check_finite(argument: str, x: Array, labels: tuple[str, ...]) -> None:
    """Raise unless all values of one or several vectors are finite."""
    if not concrete(x) or np.all(np.isfinite(x)):
        return
    values = np.asarray(x)
    *index, i = (int(k) for k in np.argwhere(~np.isfinite(values))[0])
    where = f"{argument.split()[-1]}[{', '.join(map(str, (*index, i)))}] ({labels[i]!r})"
    fix = "States that a motion did not reach are NaN: leave them out." if index else ""
    raise invalid(argument, "be finite", f"{where} was {values[(*index, i)]}", fix)


@Compiled
def _needed(
    system: System, params: Any, inputs: Mapping[str, Any], t: Array, q: Array, v: Array, a: Array
) -> Array:
    first = (t, q, v) if q.ndim == 1 else (t[0], q[0], v[0])
    check_declaration(system, params, inputs, *first)

    def at(t: Array, q: Array, v: Array, a: Array) -> Array:
        needed = system._terms.euler_lagrange(t, q, v, a, params)
        if not system.forces:
            return needed
        given = evaluate(inputs, t, q, v, params)
        return needed - system._terms.force(t, q, v, params, given)

    return at(t, q, v, a) if q.ndim == 1 else jax.vmap(at)(t, q, v, a)
