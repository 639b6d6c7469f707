"""Applied generalized forces, each with a name."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float

from jaxlag._errors import accepts, bad, real_scalar, require_arity, wants


def _require_name(kind: str, name: object) -> None:
    if not isinstance(name, str) or not name:
        raise bad(f"{kind}: name", "be a non-empty string", f"it was {name!r}")


class AbstractForce(eqx.Module):
    """An applied generalized force Q(t, q, v, params, inputs), conjugate to the coordinates."""

    name: eqx.AbstractVar[str]
    takes_inputs: eqx.AbstractVar[bool]

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """Q_i such that the virtual work is sum_i Q_i dq_i (N for metres, N m for radians)."""
        raise NotImplementedError


class GeneralizedForce(AbstractForce):
    """A force given directly by its components along the coordinates.

    The virtual work is `sum_i Q_i dq_i`, so Q_i is in N where q_i is in m and in N m where q_i
    is in rad; positive Q_i pushes towards larger q_i (Pila, eq. 3.25 ff.).

    Args:
        Q: function `Q(t, q, v, params, inputs)` or `Q(t, q, v, params)` returning shape (n,).
        name: shown in `explain()` and used to select this force.

    Raises:
        ValueError: `Q` is not callable in either form, or the name is empty.
    """

    Q: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    takes_inputs: bool = eqx.field(static=True)

    def __init__(self, Q: Callable, name: str) -> None:
        _require_name("GeneralizedForce", name)
        self.takes_inputs = not (callable(Q) and accepts(Q, 4)) or wants(Q, 4, "inputs")
        names = ("t", "q", "v", "params", "inputs")
        require_arity(f"force {name!r}: Q", Q, names if self.takes_inputs else names[:4])
        self.Q, self.name = Q, name

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """Q(t, q, v, params, inputs), shape (n,)."""
        return self.Q(t, q, v, params, inputs) if self.takes_inputs else self.Q(t, q, v, params)


class Rayleigh(AbstractForce):
    """Dissipation by a Rayleigh function: `Q = -dR/dv` (Pila, sec. 3.7).

    For linear damping R = 1/2 sum c_i v_i^2 in W, half the power lost; R may depend on t and q
    and need not be quadratic.

    Args:
        R: function `R(t, q, v, params)` returning a scalar, in W.
        name: shown in `explain()` and used to select this force.

    Raises:
        ValueError: `R` is not callable in this form, or the name is empty.
    """

    R: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    takes_inputs: bool = eqx.field(static=True)

    def __init__(self, R: Callable, name: str = "rayleigh") -> None:
        _require_name("Rayleigh", name)
        require_arity(f"Rayleigh {name!r}: R", R, ("t", "q", "v", "params"))
        self.R, self.name, self.takes_inputs = R, name, False

    def __call__(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """-dR/dv, shape (n,)."""
        R = real_scalar(f"Rayleigh {self.name!r}: R", self.R)
        return -jax.grad(R, argnums=2)(t, q, v, params)
