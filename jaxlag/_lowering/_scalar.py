"""The scalar program behind the terms: every element of every array its own scalar."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
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
from jaxlag._rank import Choice
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
        reacting: Choice | None = None,
        sense: Array | float = 1.0,
    ) -> ScalarPrepared | Prepared:
        """All that accelerations and projections need of what depends on params alone."""
        equations = self.lowered(q, params, inputs, sample).equations
        if equations is None:
            return self.array.prepare(q, params, inputs, sample, kept, reacting, sense)

        def before(
            code: Program | None, kept: Array | None, there: Array | None = None
        ) -> Array | None:
            if code is None:
                return None
            return _emit.prelude(code, params, q.dtype, kept, there, sense)

        solving = (None, None) if reacting is None else reacting
        first = before(equations.program, *solving)
        assert first is not None
        rates = before(equations.velocity, kept)
        if equations.surface is None:
            return ScalarPrepared(first, rates=rates)
        *moving, lam = equations.surface
        others = [before(code, kept) for code in moving]
        return ScalarPrepared(first, *others, lam=before(lam, *solving), rates=rates)

    def acceleration(
        self,
        t: Float[Array, ""],
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        params: Any,
        inputs: Mapping[str, Any],
        prepared: Any = None,
        reacting: Choice | None = None,
    ) -> Float[Array, " n"]:
        """Acceleration a; NaN, whole, where M is not positive definite.

        In a solve, where `prepared` is known, of blocks of M that nothing couples the others keep
        their values: the step fails by the one that is NaN.
        """
        if self.lowered(q, params, inputs).equations is None:
            return self.array.acceleration(t, q, v, params, inputs, prepared, reacting)
        if prepared is not None:
            return self.rates(t, q, v, params, inputs, prepared)
        own: Any = self.prepare(q, params, inputs, reacting=reacting)
        a = self.rates(t, q, v, params, inputs, own)
        return jnp.where(jnp.any(jnp.isnan(a)), jnp.nan, a)

    def rates(
        self,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> Array:
        """The acceleration at (q, v); (v, u') at (q, u) of quasi-velocities."""
        program = self._equations(q, params, inputs).program
        return self._run(program, prepared.acceleration, t, q, v, inputs)

    def velocities(
        self,
        t: Array,
        q: Array,
        u: Array,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> Array:
        """v at (q, u) of quasi-velocities."""
        code = self._equations(q, params, inputs).velocity
        assert code is not None
        return self._run(code, prepared.rates, t, q, u, {})

    def _run(
        self,
        program: Program,
        carried: Array | None,
        t: Array,
        q: Array,
        v: Array,
        inputs: Mapping[str, Any],
    ) -> Array:
        assert carried is not None
        return _emit.body(program, carried, t, q, v, inputs, self.lanes, self.in_loop)

    def _equations(self, q: Array, params: Any, inputs: Mapping[str, Any]) -> Equations:
        equations = self.lowered(q, params, inputs).equations
        assert equations is not None
        return equations

    def surface(
        self,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> Surface:
        """The constraints near the state (q, v); positions alone near a (q, u)."""
        code = self._equations(q, params, inputs).surface
        assert code is not None

        def columns(program: Program, carried: Any) -> Callable:
            K = self._run(program, carried, t, q, v, {}).reshape(-1, q.shape[0])
            return lambda c: jnp.sum(c[:, None] * K, axis=0)

        def position(q: Array) -> Array:
            return self._run(code.position, prepared.position, t, q, v, {})

        def velocity(q: Array, v: Array) -> Array:
            return self._run(code.velocity, prepared.velocity, t, q, v, {})

        shift = columns(code.shift, prepared.shift)
        if self.array.quasi is not None:
            return Surface(position, None, shift, None)
        kick = shift if code.kick is None else columns(code.kick, prepared.kick)
        return Surface(position if code.position.results else None, velocity, shift, kick)

    def multipliers(
        self,
        t: Array,
        q: Array,
        v: Array,
        params: Any,
        inputs: Mapping[str, Any],
        prepared: ScalarPrepared,
    ) -> Array:
        """The multipliers that forces depend on, at (q, v)."""
        surface = self._equations(q, params, inputs).surface
        assert surface is not None
        assert surface.lam is not None
        return self._run(surface.lam, prepared.lam, t, q, v, inputs)

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
