"""The scalar program behind the terms: every element of every array its own scalar."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag import _params
from jaxlag._lowering import _emit
from jaxlag._lowering._array import ArrayTerms
from jaxlag._lowering._lower import Lowered, key_of, lower
from jaxlag._terms import Terms


class ScalarTerms(Terms):
    """Terms whose accelerations are straight-line code on scalars, derived on a graph.

    A system that has no scalar program, or one of more operations than `limit`, gets its
    accelerations from the array program. So do the other terms, which no solver evaluates in its
    loop.

    Attributes:
        array: the array program of the same system.
        limit: operations up to which the scalar program is used; None for no limit.
    """

    array: ArrayTerms
    limit: int | None = eqx.field(static=True)

    def lowered(
        self,
        q: Any,
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
    ) -> Lowered:
        """The scalar program for these shapes, or the reason why there is none.

        It is compared with the array program when it is made: with `params` where their values
        are known, else with the sample.
        """
        key = key_of(self.array, q, params, inputs, self.limit)
        return lower(key, _params.sample(_params.split(params)[0], sample))

    def prepare(
        self,
        q: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        sample: _params.Sample = _params.UNKNOWN,
    ) -> Float[Array, " k"] | None:
        """All that accelerations need of what depends on params alone."""
        equations = self.lowered(q, params, inputs, sample).equations
        if equations is None:
            return self.array.prepare(q, params, inputs, sample)
        return _emit.prelude(equations.program, params, q.dtype)

    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        prepared: Any = None,
    ) -> Float[Array, " n"]:
        """Acceleration a; NaN where M is not positive definite."""
        if self.lowered(q, params, inputs).equations is None:
            return self.array.acceleration(t, q, v, params, inputs, prepared)
        prepared = self.prepare(q, params, inputs) if prepared is None else prepared
        state = (_emit.elements(q), _emit.elements(v))
        return jnp.stack(self.elements(t, *state, q.dtype, params, inputs, prepared))

    def elements(
        self,
        t: Array,
        q: Sequence[Array],
        v: Sequence[Array],
        dtype: Any,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: Array,
    ) -> tuple[Array, ...]:
        """The acceleration, element by element, from the elements of q and v."""
        like = jax.ShapeDtypeStruct((len(q),), dtype)
        equations = self.lowered(like, params, inputs).equations
        assert equations is not None
        return _emit.body(equations.program, prepared, t, q, v, inputs, dtype)

    def momentum(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Momentum p = dL/dv."""
        return self.array.momentum(t, q, v, params)

    def mass(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, "n n"]:
        """Mass matrix M = d2L/dv2."""
        return self.array.mass(t, q, v, params)

    def bias(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " n"]:
        """Bias h."""
        return self.array.bias(t, q, v, params)

    def euler_lagrange(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        a: Float[Array, " n"],
        params: Any,
    ) -> Float[Array, " n"]:
        """M a + h; M is not formed."""
        return self.array.euler_lagrange(t, q, v, a, params)

    def force(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> Float[Array, " n"]:
        """Q, summed over the declared forces."""
        return self.array.force(t, q, v, params, inputs)

    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """No rows: (0, n) and (0,)."""
        return self.array.rows(t, q, v, params)

    def gamma(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """No rows: shape (0,)."""
        return self.array.gamma(t, q, v, params)
