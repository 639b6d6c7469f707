"""Applied generalized forces, each with a name."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._core._arguments import required
from jaxlag._core._errors import invalid
from jaxlag._tracing._dependence import outputs_depend_on
from jaxlag._tracing._signature import (
    accepts,
    gradient,
    real_array,
    require_arity,
    takes_inputs,
    wants,
)
from jaxlag._tracing._traced_function import traced_function

EXPLICIT_TIME = "explicit time"
"""Name of the power -dL/dt at fixed (q, v); no force may have it."""

_ARGUMENTS = ("t", "q", "v", "params", "inputs")


def _require_name(kind: str, name: object) -> None:
    if not isinstance(name, str) or not name:
        raise invalid(f"{kind}: name", "be a non-empty string", f"it was {name!r}")
    if name == EXPLICIT_TIME:
        raise invalid(
            f"{kind}: name", "not be the name of the power of explicit time", f"it was {name!r}"
        )


def _takes_inputs(argument: str, function: Callable) -> bool:
    """Whether a function of (t, q, v, params) also takes `inputs`; raises if neither form fits."""
    takes = takes_inputs(function, 4)
    require_arity(argument, function, _ARGUMENTS if takes else _ARGUMENTS[:4])
    return takes


class AbstractForce(eqx.Module):
    """An applied generalized force Q(t, q, v, params, inputs), conjugate to the coordinates."""

    name: eqx.AbstractVar[str]

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """Q_i such that the virtual work is sum_i Q_i dq_i (N for meters, N m for radians)."""
        raise NotImplementedError


class GeneralizedForce(AbstractForce):
    """A force given directly by its components along the coordinates.

    The virtual work is `sum_i Q_i dq_i`, so Q_i is in N if q_i is in m and in N m if q_i
    is in rad; positive Q_i acts towards larger q_i (Pila, eq. 3.25 ff.).

    With `reaction=True` the force depends on the multipliers of constraints, as friction depends on
    a normal reaction; both are solved for together. If rows are dependent, those that
    the force reads share the reaction with least norm, and the others have none of it. If no
    solution exists (Painleve's paradox), a contact lifts off, or its sliding stops or reverses, the
    motion ends with the status no_reaction_solution.

    Args:
        Q: function `Q(t, q, v, params, inputs)` or `Q(t, q, v, params)` returning shape (n,). With
            `reaction=True` its last argument is `lam`, a dict from row names to multipliers.
        name: shown in `explain()` and used to select this force.
        reaction: whether Q takes `lam`.
        contact: name of a constraint whose multipliers must not become negative.
        sliding: function `sliding(t, q, v, params)`, the velocity of the contact point (m/s) along
            the sliding direction that Q assumes: a scalar whose sign must not change.

    Raises:
        ValueError: `Q` or `sliding` cannot be called in these forms, the name is empty, or
            `contact` or `sliding` is given without `reaction=True`.

    Source: Pila, eqs. 3.173 to 3.177 (a stick sliding with friction); Lotstedt, SIAM J. Appl. Math.
    42 (1982) 281 (existence of solutions).
    """

    Q: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    takes_inputs: bool = eqx.field(static=True)
    reaction: bool = eqx.field(static=True)
    contact: str | None = eqx.field(static=True)
    sliding: Callable | None = eqx.field(static=True)

    def __init__(
        self,
        Q: Callable,
        name: str,
        *,
        reaction: bool = False,
        contact: str | None = None,
        sliding: Callable | None = None,
    ) -> None:
        _require_name("GeneralizedForce", name)
        argument = f"force {name!r}"
        if reaction:
            self.takes_inputs = not (callable(Q) and accepts(Q, 5)) or wants(Q, 5, "lam")
            arguments = _ARGUMENTS if self.takes_inputs else _ARGUMENTS[:4]
            require_arity(f"{argument}: Q", Q, (*arguments, "lam"))
        else:
            self.takes_inputs = _takes_inputs(f"{argument}: Q", Q)
            for other, value in (("contact", contact), ("sliding", sliding)):
                if value is not None:
                    fix = "Write reaction=True and let Q take lam as its last argument."
                    raise invalid(
                        f"{argument}: {other}",
                        "be given with reaction=True only",
                        "reaction was False",
                        fix,
                    )
        if contact is not None and (not isinstance(contact, str) or not contact):
            raise invalid(
                f"{argument}: contact", "be the name of a constraint", f"it was {contact!r}"
            )
        if sliding is not None:
            require_arity(f"{argument}: sliding", sliding, ("t", "q", "v", "params"))
        self.Q, self.name, self.reaction = traced_function(Q), name, reaction
        self.contact, self.sliding = contact, None if sliding is None else traced_function(sliding)

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        lam: Mapping[str, Any] | None = None,
    ) -> Float[Array, " n"]:
        """Q, shape (n,)."""
        state = (t, q, v, params, inputs) if self.takes_inputs else (t, q, v, params)
        return self.Q(*state, lam) if self.reaction else self.Q(*state)


class PointForce(AbstractForce):
    """A force F acting at a point r(t, q): `Q = (dr/dq)^T F`, by its virtual work F . dr.

    One reverse derivative of `position`; the Jacobian dr/dq is never formed. Position and force
    are components in the same axes, which must not rotate (inertial, not body axes). Transform a
    force in body components by the rotation matrix of `jaxlag.rotation`.

    Args:
        position: function `position(t, q, params)` returning the point r, in m: 1, 2 or 3
            components, shape (d,), or (k, d) for k points.
        force: function `force(t, q, v, params, inputs)` or `force(t, q, v, params)` returning F,
            in N, in the shape of the position.
        name: shown in `explain()` and used to select this force.

    Raises:
        ValueError: a function cannot be called in these forms, or the name is empty. While
            tracing: a position that does not have 1, 2 or 3 real components, a force of another
            shape than the position.

    Source: Pila, eq. 3.10 and sec. 3.10.
    """

    position: Callable = eqx.field(static=True)
    force: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    takes_inputs: bool = eqx.field(static=True)

    def __init__(self, position: Callable, force: Callable, name: str) -> None:
        _require_name("PointForce", name)
        require_arity(f"force {name!r}: position", position, ("t", "q", "params"))
        self.takes_inputs = _takes_inputs(f"force {name!r}: force", force)
        self.position, self.force, self.name = (
            traced_function(position),
            traced_function(force),
            name,
        )

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """(dr/dq)^T F, shape (n,)."""
        argument = f"force {self.name!r}: position"
        r, vjp_fn = jax.vjp(lambda q: real_array(argument, self.position(t, q, params)), q)
        if r.ndim == 0 or r.shape[-1] not in (1, 2, 3):
            raise invalid(
                argument,
                "return 1, 2 or 3 components along its last axis",
                f"it returned shape {r.shape}",
                "Return jnp.stack([x, y]), and [x] where one axis is enough.",
            )
        state = (t, q, v, params, inputs) if self.takes_inputs else (t, q, v, params)
        F = _like(f"force {self.name!r}: force", self.force(*state), r)
        return vjp_fn(F)[0]


class Torque(AbstractForce):
    """A torque tau on a body of angular velocity w(t, q, v): `Q = (dw/dv)^T tau`.

    The virtual work of a couple is tau . dw/dv dq, since dw/dv maps virtual displacements dq to
    virtual rotations of the body. One reverse derivative of `angular_velocity` in v; the matrix
    dw/dv is never formed. Angular velocity and torque are components in the same axes: both in
    body axes, or both in inertial ones.

    Args:
        angular_velocity: function `angular_velocity(t, q, v, params)` returning w, in rad/s,
            affine in v: shape (3,), () for a rotation about one fixed axis, or (k, 3).
        torque: function `torque(t, q, v, params, inputs)` or `torque(t, q, v, params)` returning
            tau, in N m, in the shape of the angular velocity; positive by the right-hand rule.
        name: shown in `explain()` and used to select this force.

    Raises:
        ValueError: a function cannot be called in these forms, or the name is empty. While
            tracing: an angular velocity that is neither a scalar nor has 3 real components,
            or is not affine in v; a torque of another shape.

    Source: Pila, sec. 3.12 (force and couple); eqs. 4.70 and 4.103 (body torques on Euler angles).
    """

    angular_velocity: Callable = eqx.field(static=True)
    torque: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    takes_inputs: bool = eqx.field(static=True)

    def __init__(self, angular_velocity: Callable, torque: Callable, name: str) -> None:
        _require_name("Torque", name)
        arguments = ("t", "q", "v", "params")
        require_arity(f"torque {name!r}: angular_velocity", angular_velocity, arguments)
        self.takes_inputs = _takes_inputs(f"torque {name!r}: torque", torque)
        self.angular_velocity, self.torque = (
            traced_function(angular_velocity),
            traced_function(torque),
        )
        self.name = name

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """(dw/dv)^T tau, shape (n,)."""
        argument = f"torque {self.name!r}: angular_velocity"

        def rate(v: Array) -> Array:
            return real_array(argument, self.angular_velocity(t, q, v, params))

        w, vjp_fn = jax.vjp(rate, v)
        if w.ndim > 0 and w.shape[-1] != 3:
            raise invalid(
                argument, "return 3 components or a scalar", f"it returned shape {w.shape}"
            )
        if not _affine(rate, v, w):
            raise invalid(
                argument,
                "be affine in v",
                "its derivative dw/dv contains v in the traced program",
                "An angular velocity is W(t, q) v + w0(t, q): drop powers and products of "
                "velocities, and branches and loops that read v, even if they cancel.",
            )
        state = (t, q, v, params, inputs) if self.takes_inputs else (t, q, v, params)
        torque = _like(f"torque {self.name!r}: torque", self.torque(*state), w)
        return vjp_fn(torque)[0]


def _affine(function: Callable, v: Array, like: Array) -> bool:
    """Whether the derivative of `function` does not depend on v, from its traced program."""
    derivative = jax.make_jaxpr(lambda v: jax.vjp(function, v)[1](jnp.ones_like(like)))(v)
    return not frozenset().union(*outputs_depend_on(derivative.jaxpr, [frozenset({"v"})]))


def _like(argument: str, value: Any, conjugate: Array) -> Array:
    """A real array in the shape and precision of its conjugate variable."""
    value = real_array(argument, value)
    if value.shape != conjugate.shape:
        raise invalid(argument, f"return shape {conjugate.shape}", f"it returned {value.shape}")
    return value.astype(conjugate.dtype)  # time is float64 with x64, for every q


class Rayleigh(AbstractForce):
    """Dissipation by a Rayleigh function: `Q = -dR/dv` (Pila, sec. 3.7).

    For linear damping R = 1/2 sum c_i v_i^2 in W, half the dissipated power; R may depend on t
    and q and need not be quadratic.

    Args:
        R: function `R(t, q, v, params)` returning a scalar, in W.
        name: shown in `explain()` and used to select this force.

    Raises:
        ValueError: `R` cannot be called in this form, or the name is empty.
    """

    R: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @required(name='Write jl.Rayleigh(R, "drag").')
    def __init__(self, R: Callable, name: str) -> None:
        _require_name("Rayleigh", name)
        require_arity(f"Rayleigh {name!r}: R", R, ("t", "q", "v", "params"))
        self.R, self.name = traced_function(R), name

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """-dR/dv, shape (n,)."""
        return -gradient(f"Rayleigh {self.name!r}: R", self.R, 2)(t, q, v, params)


def check_forces(forces: Any) -> tuple[AbstractForce, ...]:
    """Forces as a tuple; raises unless each is one of the classes here, names distinct."""
    if isinstance(forces, AbstractForce):
        raise invalid("forces", "be a sequence", "it was a single force", "Write forces=(force,).")
    if not isinstance(forces, Iterable):
        was = f"it was {forces!r}"
        raise invalid(
            "forces", "be a sequence of forces", was, "Leave it out where there are none."
        )
    forces = tuple(forces)
    names: list[str] = []
    for force in forces:
        if not isinstance(force, AbstractForce):
            raise invalid(
                "forces",
                "contain PointForce, Torque, GeneralizedForce and Rayleigh objects",
                f"one was {force!r}",
                'Write jl.PointForce(position, force, "name"), jl.Rayleigh(R, "name") and so on.',
            )
        names.append(force.name)
    for name in names:
        if names.count(name) > 1:
            raise invalid(
                "forces", "have distinct names", f"{name!r} occurs {names.count(name)} times"
            )
    return forces


def reads_lam(force: AbstractForce) -> TypeGuard[GeneralizedForce]:
    """Whether a force depends on the multipliers of constraints."""
    return isinstance(force, GeneralizedForce) and force.reaction


def sliding(forces: Iterable[AbstractForce]) -> tuple[Callable, ...]:
    """Velocities of contact points, functions of (t, q, v, params), that must keep their sign."""
    return tuple(f.sliding for f in forces if reads_lam(f) and f.sliding is not None)


def components(
    force: AbstractForce,
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
    params: Any,
    inputs: Mapping[str, Any],
    lam: Mapping[str, Any] | None = None,
) -> Float[Array, " n"]:
    """The force's components, or an error while tracing if they are not one per coordinate."""
    state = (t, q, v, params, inputs)
    Q = force(*state, lam) if isinstance(force, GeneralizedForce) else force(*state)
    must = f"return {q.shape[0]} real components, one per coordinate"
    if not eqx.is_array_like(Q):
        raise invalid(f"force {force.name!r}", "return an array", f"it returned {Q!r}")
    Q = jnp.asarray(Q)
    if Q.shape != q.shape or not jnp.issubdtype(Q.dtype, jnp.floating):
        raise invalid(f"force {force.name!r}", must, f"it returned {Q.dtype} of shape {Q.shape}")
    return Q.astype(q.dtype)  # time is float64 with x64, for every state
