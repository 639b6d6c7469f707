"""The declared function of which a value or derivative is not finite at a state, and its line."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxlag._core._errors import invalid
from jaxlag._model._input_signals import AbstractInput
from jaxlag._model._inputs import evaluate as input_values
from jaxlag._system._declared_functions import Declared, Params, Role, declared
from jaxlag._system._nan_origins import Origin, TracedProgram, evaluate
from jaxlag._system._reactions import AbstractReactions

HINTS = {
    "sqrt": "Use jaxlag.math.norm for a length, jaxlag.math.sqrt otherwise; or x @ x if the "
    "square is enough.",
    "rsqrt": "Use jaxlag.math.unit for a direction, jaxlag.math.norm for a length.",
    "cbrt": "Its derivatives are infinite at 0: keep the argument away from it.",
    "atan2": "Use jaxlag.math.atan2.",
    "acos": "Use jaxlag.math.acos, or jaxlag.math.angle_between for two vectors.",
    "asin": "Use jaxlag.math.asin.",
    "div": "Use jaxlag.math.sinc or cosc for sin(x)/x and (1 - cos(x))/x^2 (sinc_sqrt or "
    "cosc_sqrt of a square), jaxlag.math.unit for x/|x|; or keep the divisor away from 0.",
    "pow": "At x = 0 a power x**p has finite derivatives only up to order p, unless p is an "
    "integer: use jaxlag.math.norm for a length; or smooth it, as in (x**2 + e**2)**(p/2).",
    "log": "Its derivatives are infinite at 0: keep the argument away from it.",
    "custom_jvp_call": "Its derivative rule must be finite there, too.",
    "custom_vjp_call": "Its derivative rule must be finite there, too.",
}
"""What to do about a derivative that is not finite, by the operation."""


class NonFinite(NamedTuple):
    """A declared function that is not finite at a state.

    Attributes:
        function: its name: "lagrangian", "force 'drag': Q", "constraint 'rod': phi", ...
        derivative: whether its value is finite, and a derivative in the equations is not.
        value: the value, or the derivative.
        origin: the operation at which it becomes so.
    """

    function: str
    derivative: bool
    value: np.ndarray
    origin: Origin

    def error(self) -> ValueError:
        """The refusal of such a state."""
        what = "have finite derivatives" if self.derivative else "be finite"
        was = f"{'one' if self.derivative else 'it'} was {self.value}"
        fix = f"See {self._place}.{self._hint}" if self._place else self._hint.strip()
        return invalid(self.function, f"{what} at the given state", was, fix)

    def __str__(self) -> str:
        owner, _, own = self.function.rpartition(": ")
        name = f"`{own}`" + (f" of {owner}" if owner else "")
        place = f", by {self._place}" if self._place else ""
        return f"Not finite: {'a derivative of ' * self.derivative}{name}{place}.{self._hint}"

    @property
    def _place(self) -> str:
        operation, file, line = self.origin
        return " at ".join(filter(None, (operation, f"{Path(file).name}:{line}" if file else "")))

    @property
    def _hint(self) -> str:
        hint = HINTS.get(self.origin.primitive) if self.derivative else None
        return f" {hint}" if hint else ""


def nonfinite(
    system: AbstractReactions,
    params: Any,
    inputs: Mapping[str, AbstractInput | Array],
    t: Any,
    q: Array,
    v: Array,
) -> NonFinite | None:
    """The first declared function that is not finite, of those that the equations of motion read.

    Values and those derivatives that are terms of M a + h = Q + A^T lam are computed operation by
    operation, without compilation. None if all are finite, if v does not exist there, or if they
    cannot be computed in this way, as with random keys or traced values.

    Args:
        system: the declaration.
        params: as its functions take them; with values, as all that follows.
        inputs: by name.
        t: s.
        q: coordinates, (n,).
        v: velocities, (n,).
    """
    try:
        own, kind = Params(params), q.dtype
        z: dict[str, Any] = {"t": jnp.asarray(t, jnp.result_type(float)), "q": q, "v": v}
        whole = own.join(own.leaves)
        z["params"] = own.leaves
        z["lam"] = {name: jnp.ones(shape, kind) for name, shape in system._rows(whole, kind).shapes}
        if system.quasi is not None:
            z["u"] = system.quasi.of(z["t"], q, v, whole)
        if system.states is not None:
            z["x"] = system.states.flat(input_values(inputs, z["t"], q, v, whole))
        lost = {name for name in ("t", "q", "v", "u", "x") if name in z and not _is_finite(z[name])}
        for function in declared(system, own, inputs):
            names = dict.fromkeys((*_STATE, *function.arguments))
            if lost & names.keys():
                continue
            found = _of_function(function, {name: z[name] for name in names})
            if found is not None:
                return found
    except Exception:  # it explains another failure, and must not replace it
        pass
    return None


_STATE = ("t", "q", "v", "params")


def _is_finite(x: Any) -> bool:
    return bool(np.all(np.isfinite(x)))


def _of_function(function: Declared, z: Mapping[str, Any]) -> NonFinite | None:
    program = TracedProgram(function.function, z)
    for order, term in enumerate(_terms(function, program)):
        closed = jax.make_jaxpr(term)(z)
        value = evaluate(closed, *jax.tree.leaves(z))[0]
        if not _is_finite(value):
            origins = program.origins(closed, z)
            return NonFinite(function.name, order > 0, value, (*origins, Origin(""))[0])
    return None


def _terms(function: Declared, f: Callable[[Any], Array]) -> Iterator[Callable[[Any], Any]]:
    """The function itself, then its derivatives in the equations of motion, lower orders first."""
    role, arguments = function.role, function.arguments
    speeds = next((name for name in ("u", "v") if name in arguments), "q")

    def by(name: str, g: Callable[[Any], Array]) -> Callable[[Any], Array]:
        return lambda z: jax.jacfwd(lambda x: g({**z, name: x}))(z[name])

    def in_time(g: Callable[[Any], Array]) -> Callable[[Any], Array]:
        """dg/dq v + dg/dt."""

        def rate(z: Any) -> Array:
            at = z["t"], z["q"]
            along = jnp.ones_like(at[0]), z["v"].astype(at[1].dtype)
            return jax.jvp(lambda t, q: g({**z, "t": t, "q": q}), at, along)[1]

        return rate

    yield f
    if role in (Role.energy, Role.potential):
        yield by("q", f)
    if role is Role.energy:
        momentum = by(speeds, f)
        yield from (momentum, by(speeds, momentum), in_time(momentum))
    elif role is Role.conjugate:
        yield by(speeds, f)
    elif role is Role.holonomic:
        yield from (by("q", f), in_time(in_time(f)))
    elif role in (Role.pfaffian, Role.quasi):
        yield from (by(speeds, f), in_time(f), in_time(by(speeds, f)))
