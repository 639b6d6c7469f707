"""States beside the coordinates: first-order equations x' = f(t, q, v, x, params, inputs)."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._model._coordinates import Coordinates, vector_argument
from jaxlag._tracing._input_values import InputValues
from jaxlag._tracing._signature import real_array, require_arity, takes_inputs
from jaxlag._tracing._traced_function import traced_function

_ARGUMENTS = ("t", "q", "v", "x", "params", "inputs")


class States(eqx.Module):
    """States beside the mechanics, x' = rate(t, q, v, x, params, inputs), x of shape (k,).

    Examples are the current of a motor, the integrator of a controller, a temperature, the charge
    of a battery. They are integrated together with q and v, with the same error control and
    derivatives. Functions of forces read them in `inputs`, by name: `inputs["current"]`. So do the
    methods of `System` and `jl.equilibrium`: they take the values of states among their inputs.
    `Feedback` functions do not read them: write a controller with an integrator as a force.
    Structure-preserving methods, `jl.fit` and `jl.lyapunov` do not take such systems.

    Args:
        rate: function `rate(t, q, v, x, params, inputs)` or `rate(t, q, v, x, params)`, returning
            dx/dt, shape (k,), in the units of x per s.
        names: names, or names with shapes `{"temperature": (8,), "current": ()}`. x is flat, in
            this order; `inputs` holds the named parts.

    Raises:
        ValueError: a rate that cannot be called in these forms, missing or duplicate names.

    Source: Todorov, Erez, Tassa, MuJoCo, IROS 2012, sec. III (activation states of actuators);
    Astrom, Murray, Feedback Systems, sec. 11.1 (the integrator of a PID controller).

    Example:
        A motor on a flywheel: L di/dt = u - R i - k w, J dw/dt = k i, after ten time constants:

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def current_rate(t, q, v, x, params, inputs):
        ...     return (inputs["voltage"] - params["R"] * x - params["k"] * v) / params["L"]
        >>> def torque(t, q, v, params, inputs):
        ...     return params["k"] * inputs["current"][None]
        >>> motor = jl.System(
        ...     lambda t, q, v, p: 0.5 * p["J"] * v[0] ** 2,
        ...     ("angle",),
        ...     forces=(jl.GeneralizedForce(torque, "motor"),),
        ...     states=jl.States(current_rate, ("current",)),
        ... )
        >>> params = {"R": 1.0, "k": 0.1, "L": 0.01, "J": 1e-4}
        >>> motion = jl.simulate(
        ...     motor, [0.0], [0.0], jnp.array([0.0, 0.2]), params,
        ...     x0={"current": 0.0}, inputs={"voltage": 12.0},
        ... )
        >>> print(f"{motion.rate('angle')[-1]:.3f} rad/s, {motion['current'][-1]:.3f} A")
        120.003 rad/s, -0.001 A
    """

    rate: Callable = eqx.field(static=True)
    takes_inputs: bool = eqx.field(static=True)
    layout: Coordinates = eqx.field(static=True)

    def __init__(
        self, rate: Callable, names: Sequence[str] | Mapping[str, tuple[int, ...] | int]
    ) -> None:
        self.layout = Coordinates(names, "States: names")
        takes = takes_inputs(rate, 5)
        require_arity("States: rate", rate, _ARGUMENTS if takes else _ARGUMENTS[:5])
        self.rate, self.takes_inputs = traced_function(rate), takes

    @property
    def names(self) -> tuple[str, ...]:
        """Declared names, in order."""
        return self.layout.names

    @property
    def size(self) -> int:
        """Number of entries of x."""
        return self.layout.size

    def vector(self, argument: str, x: Any) -> Any:
        """x as a flat array, from an array, a list (then of numpy) or a dict by name.

        Raises:
            ValueError: a wrong shape, missing names, a concrete value that is not finite.
        """
        x = vector_argument(self.layout, argument, x)
        if concrete(x) and not np.isfinite(x).all():
            i = int(np.argmin(np.isfinite(x)))
            was = f"{argument}[{i}] ({self.layout.labels[i]!r}) was {x[i]}"
            raise invalid(argument, "be finite", was)
        return x

    def rates(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        values: Mapping[str, Any],
    ) -> Float[Array, " k"]:
        """dx/dt; `values` are those of the inputs and of x, by name."""
        return self.rates_at(t, q, v, self.flat(values).astype(q.dtype), params, values)

    def flat(self, values: Mapping[str, Any]) -> Float[Array, " k"]:
        """x from values by name."""
        return self.layout.flatten({name: values[name] for name in self.names}, "inputs")

    def rates_at(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        x: Float[Array, " k"],
        params: Any,
        values: Mapping[str, Any],
    ) -> Float[Array, " k"]:
        """The same at x."""
        given = (t, q, v, x, params, values) if self.takes_inputs else (t, q, v, x, params)
        found = real_array("States: rate", self.rate(*given))
        if found.shape != x.shape:
            must, was = f"return an array of shape {x.shape}", f"its shape was {found.shape}"
            fix = "Write one entry for each of the states, as jnp.stack([...])."
            raise invalid("States: rate", must, was, fix)
        return found.astype(x.dtype)


OUTPUTS = (
    *("t", "status", "a", "u", "p", "energy", "kinetic", "potential", "power", "work", "Q"),
    *("multipliers", "constraint_force", "input_values", "state_rates"),
)
"""Names of outputs of a motion, which states must not have."""


def check_states(states: Any, taken: Mapping[str, str]) -> States | None:
    """`states`, if it is None or has names of its own.

    Args:
        states: argument of `System`.
        taken: names that states must not have -> their owners.
    """
    taken = dict.fromkeys(OUTPUTS, "an output of a motion") | dict(taken)
    if states is None:
        return None
    if not isinstance(states, States):
        fix = "Write states=jl.States(rate, names)."
        raise invalid("states", "be a jl.States or None", f"it was {states!r}", fix)
    for name in states.names:
        if name in taken:
            raise invalid("States: names", "differ from other names", f"{name!r} is {taken[name]}")
    return states


def named_states(states: States | None, x: Any) -> dict[str, Any]:
    """The named parts of x, (..., k); none without states."""
    return {} if states is None else states.layout.unflatten(x)


def state_names(states: States | None) -> tuple[str, ...]:
    """Declared names; none without states."""
    return () if states is None else states.names


def with_states(values: InputValues, states: States | None, x: Float[Array, " k"]) -> InputValues:
    """The values of the inputs and the named parts of x."""
    return values if states is None else values.changed(named_states(states, x))


def check_no_states(inputs: Iterable[str], states: States | None) -> None:
    """Raise if one of the inputs is a state."""
    for name in state_names(states):
        if name in inputs:
            was = f"there was {name!r}, a state"
            raise invalid("inputs", "name no states", was, "Its value at ts[0] is in x0=.")
