"""The scalar program behind the terms: every element of every array its own scalar."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxlag import _params
from jaxlag._lowering import _emit
from jaxlag._lowering._array import ArrayTerms, Prepared
from jaxlag._lowering._key import key_of
from jaxlag._lowering._lower import Lowered, lower
from jaxlag._lowering._program import Program
from jaxlag._lowering._scene import Equations
from jaxlag._projection import Surface
from jaxlag._terms import Terms


class ScalarPrepared(NamedTuple):
    """What each program needs of what does not change during a solve."""

    acceleration: Array
    position: Array | None = None
    velocity: Array | None = None
    shift: Array | None = None
    kick: Array | None = None
    lam: Array | None = None
    rates: Array | None = None


class ScalarTerms(Terms):
    """Terms whose accelerations are straight-line code on scalars, derived on a graph.

    A system that has no scalar program, or one of more operations than `limit`, gets its
    accelerations from the array program. So do the other terms, which no solver evaluates in its
    loop.

    Attributes:
        array: the array program of the same system.
        limit: operations up to which the scalar program is used; None for no limit.
        lanes: whether terms are vmapped, so that every scalar is a row of numbers.
        in_loop: whether they are evaluated in a loop over one trajectory or a few lanes.
    """

    array: ArrayTerms
    limit: int | None = eqx.field(static=True)
    lanes: bool = eqx.field(static=True, default=False)
    in_loop: bool = eqx.field(static=True, default=False)

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
        kept: Bool[Array, " m"] | None = None,
        sense: Array | float = 1.0,
    ) -> ScalarPrepared | Prepared:
        """All that accelerations and projections need of what depends on params alone."""
        equations = self.lowered(q, params, inputs, sample).equations
        if equations is None:
            return self.array.prepare(q, params, inputs, sample, kept, sense)
        first = _emit.prelude(equations.program, params, q.dtype, kept, sense)
        others = [
            None if code is None else _emit.prelude(code, params, q.dtype, kept, sense)
            for code in equations.surface or ()
        ]
        rates = None
        if equations.velocity is not None:
            rates = _emit.prelude(equations.velocity, params, q.dtype, kept, sense)
        return ScalarPrepared(first, *others)._replace(rates=rates)

    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        prepared: Any = None,
        kept: Bool[Array, " m"] | None = None,
    ) -> Float[Array, " n"]:
        """Acceleration a; NaN where M is not positive definite."""
        if self.lowered(q, params, inputs).equations is None:
            return self.array.acceleration(t, q, v, params, inputs, prepared, kept)
        if prepared is None:
            prepared = self.prepare(q, params, inputs, kept=kept)
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
        prepared: ScalarPrepared,
    ) -> tuple[Array, ...]:
        """The acceleration, element by element, from those of q and v; (v, u') from q and u."""
        program = self._equations(q, dtype, params, inputs).program
        mode = self.lanes, self.in_loop
        return _emit.body(program, prepared.acceleration, t, q, v, inputs, dtype, *mode)

    def velocities(
        self,
        t: Array,
        q: Sequence[Array],
        u: Sequence[Array],
        dtype: Any,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> tuple[Array, ...]:
        """v, element by element, from the elements of q and of quasi-velocities u."""
        code = self._equations(q, dtype, params, inputs).velocity
        assert code is not None
        assert prepared.rates is not None
        return _emit.body(code, prepared.rates, t, q, u, {}, dtype, self.lanes, self.in_loop)

    def _equations(
        self, q: Sequence[Array], dtype: Any, params: Any, inputs: Mapping[str, Any]
    ) -> Equations:
        like = jax.ShapeDtypeStruct((len(q),), dtype)
        equations = self.lowered(like, params, inputs).equations
        assert equations is not None
        return equations

    def surface(
        self,
        t: Array,
        q: Sequence[Array],
        v: Sequence[Array],
        dtype: Any,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> Surface:
        """The constraints near the state (q, v), on elements; positions alone near a (q, u)."""
        code = self._equations(q, dtype, params, inputs).surface
        assert code is not None

        def run(program: Program, carried: Any, q: Sequence[Array], v: Sequence[Array]) -> tuple:
            mode = self.lanes, self.in_loop
            return _emit.body(program, carried, t, q, v, {}, dtype, *mode)

        def columns(program: Program, carried: Any) -> Callable:
            flat, n = run(program, carried, q, v), len(q)

            def apply(c: tuple) -> tuple:
                used = [(flat[k * n : (k + 1) * n], x) for k, x in enumerate(c)]
                return tuple(sum(column[i] * x for column, x in used) for i in range(n))

            return apply

        shift = columns(code.shift, prepared.shift)
        if self.array.quasi is not None:
            return Surface(lambda q: run(code.position, prepared.position, q, v), None, shift, None)
        kick = shift if code.kick is None else columns(code.kick, prepared.kick)
        return Surface(
            (lambda q: run(code.position, prepared.position, q, v))
            if code.position.results
            else None,
            lambda q, v: run(code.velocity, prepared.velocity, q, v),
            shift,
            kick,
        )

    def multipliers(
        self,
        t: Array,
        q: Sequence[Array],
        v: Sequence[Array],
        dtype: Any,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> tuple[Array, ...]:
        """The multipliers that forces depend on, from the elements of q and v."""
        surface, mode = (
            self._equations(q, dtype, params, inputs).surface,
            (self.lanes, self.in_loop),
        )
        assert surface is not None
        assert surface.lam is not None
        assert prepared.lam is not None
        return _emit.body(surface.lam, prepared.lam, t, q, v, inputs, dtype, *mode)

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

    def position(
        self, t: Float[Array, ""], q: Float[Array, " n"], params: Any
    ) -> Float[Array, " k"]:
        """phi(t, q) of the holonomic rows."""
        return self.array.position(t, q, params)

    def velocity(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """A v + b."""
        return self.array.velocity(t, q, v, params)

    def rows(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
        """(A, b)."""
        return self.array.rows(t, q, v, params)

    def gamma(
        self, t: Float[Array, ""], q: Float[Array, " n"], v: Float[Array, " n"], params: Any
    ) -> Float[Array, " m"]:
        """A' v + b'."""
        return self.array.gamma(t, q, v, params)

    def reactions(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(a, lam)."""
        return self.array.reactions(t, q, v, params, inputs)

    def correction(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        prepared: Any = None,
        kept: Bool[Array, " m"] | None = None,
    ) -> Float[Array, "n m"]:
        """M^-1 A^T (A M^-1 A^T)^-1."""
        return self.array.correction(t, q, v, params, None, kept)
