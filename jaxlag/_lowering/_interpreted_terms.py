"""Terms of the equations by interpreted code, for use a few times in a solve.

Automatic differentiation on arrays takes several operations for each one of L, and each of them
longer to compile than the interpreter takes for all.
"""

from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arrays import elements
from jaxlag._linalg._rounding_bounds import Bounded
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._emit import _interpreter
from jaxlag._lowering._emit._code import whole_of
from jaxlag._lowering._emit._emit import fixed_inputs
from jaxlag._lowering._lower import lower_terms
from jaxlag._lowering._symbolic._program_key import Key
from jaxlag._lowering._term_codes import TermCodes
from jaxlag._lowering._terms import AbstractTerms, Solved
from jaxlag._tracing import _params

_STATE = "t", "q", "v"


def interpreted_terms(
    array: ArrayTerms, key: Key, sample: _params.Sample, alone: bool
) -> AbstractTerms | None:
    """The terms of a system with constraints by interpreted code.

    None if there is no such code, if it is short, or if the state has less digits than the time.

    Args:
        array: the same on arrays.
        key: key of the scalar program.
        sample: params for its verification.
        alone: whether they are evaluated outside of all loops of a solve.
    """
    if not array.constraints or key.dtype != jnp.result_type(float):
        return None
    codes = lower_terms(key.of_terms, sample) if _interpreter.available() else None
    if codes is None or not codes.are_long:
        return None
    return InterpretedTerms(array, codes, alone)


@final
class InterpretedTerms(AbstractTerms):
    """The terms by interpreted code.

    Attributes:
        array: the same terms on arrays.
        codes: the code.
        alone: whether they are evaluated outside of all loops of a solve.
    """

    array: ArrayTerms
    codes: TermCodes = eqx.field(static=True)
    alone: bool = eqx.field(static=True, default=True)

    @property
    def solved(self) -> Solved:
        """As the same terms on arrays."""
        return self.array.solved

    def _term(self, name: str, params: Any, changed: Sequence[str] = _STATE) -> Bounded:
        """A term as a function of (t, q, v), one row of numbers.

        Args:
            name: of the term.
            params: as the Lagrangian takes them.
            changed: which of t, q and v are rounded for its bounds.
        """
        program = self.codes.programs[name]
        code, rounded = whole_of(program), [name in changed for name, _ in program.inputs]

        def given(t: Array, q: Array, v: Array) -> list[Array]:
            fixed = fixed_inputs(program, params, q.dtype, {})
            parts = {"t": [jnp.asarray(t, q.dtype)], "q": elements(q), "v": elements(v)}
            return [
                parts[key[0]][key[1]] if key[0] in parts else fixed[key] for key in program.inputs
            ]

        def value(t: Array, q: Array, v: Array) -> Array:
            function = _interpreter.interpreted(code, q.dtype, alone=self.alone)
            return function(*given(t, q, v))

        def bounds(t: Array, q: Array, v: Array) -> tuple[Array, Array]:
            numbers = given(t, q, v)
            return _interpreter.with_changes(code, np.array(rounded, bool), numbers, q.dtype)

        return Bounded(value, bounds)

    def mass(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, "n n"]:
        """M."""
        return self._term("mass", params)(t, q, v).reshape(q.shape[0], -1)

    def bias(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """h."""
        return self._term("bias", params)(t, q, v)

    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """phi(t, q) of the holonomic rows."""
        return self._term("position", params)(t, q, jnp.zeros_like(q))

    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """A v + b."""
        return self._term("velocity", params)(t, q, v)

    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """A, and b as the residual at rest."""
        return self.rows_of(t, v, params)(q), self.velocity(t, q, jnp.zeros_like(v), params)

    def rows_of(self, t: Float[Array, ""], v: Float[Array, " n"], params: Any) -> Callable:
        """A as a function of q, with its rounding bounds."""
        return self._matrix("rows", t, params)

    def rows_of_position(self, t: Float[Array, ""], params: Any) -> Callable:
        """d phi/dq as a function of q, with its rounding bounds."""
        return self._matrix("position_rows", t, params)

    def _matrix(self, name: str, t: Array, params: Any) -> Bounded:
        """A term with one row for each constraint, as a function of q."""
        value, bounds = self._term(name, params, ("q",))

        def both(q: Array) -> tuple[Array, Array]:
            found, rounding = bounds(t, q, jnp.zeros_like(q))
            return found.reshape(-1, q.shape[0]), rounding.reshape(-1, q.shape[0])

        def matrix(q: Array) -> Array:
            return value(t, q, jnp.zeros_like(q)).reshape(-1, q.shape[0])

        return Bounded(matrix, both)

    def gamma_of(self, params: Any) -> Callable:
        """Gamma as a function of (t, q, v), with its rounding bounds.

        With Baumgarte's terms forwards in time.
        """
        return self._term("gamma", params)
