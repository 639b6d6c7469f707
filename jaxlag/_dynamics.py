"""The equations of motion in first-order form, as solvers see them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag import _params
from jaxlag._inputs import evaluate, locate
from jaxlag._lowering import ScalarTerms
from jaxlag._power import Power
from jaxlag._system import System


class Arguments(NamedTuple):
    """What the vector field depends on besides time and state; all leaves are arrays."""

    params: Any
    inputs: Any
    sigma: Float[Array, ""] | None  # direction of time where it is traced
    intervals: Any  # table interval of every input, fixed throughout a step
    prepared: Any  # what accelerations need of what depends on params alone


class Dynamics(eqx.Module):
    """dy/dtau = sigma (v, a) with y = (q, v), tau = sigma t, M a + h = Q.

    Where work is asked for, y = (q, v, W) with one more component for each term of dH/dt.

    Attributes:
        system: what moves.
        params: static half of the params.
        inputs: static half of the inputs.
        direction: sigma, +1 or -1, where known while tracing; else None.
        power: terms of dH/dt to integrate along; None for none.
        sample: values of the params, where known.
    """

    system: System
    params: _params.Static = eqx.field(static=True)
    inputs: _params.Static = eqx.field(static=True)
    direction: int | None = eqx.field(static=True)
    power: Power | None
    sample: _params.Sample = eqx.field(static=True)

    def arguments(self, params: Any, inputs: Any, ts: Float[Array, " s"]) -> Arguments:
        """Arguments outside any step, from the traced halves of params and inputs."""
        if self.direction is not None:
            return Arguments(params, inputs, None, None, None)
        sigma = jnp.where(ts[-1] >= ts[0], 1.0, -1.0).astype(ts.dtype)
        return Arguments(params, inputs, sigma, None, None)

    def prepare(self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments) -> Arguments:
        """The arguments with all that accelerations need of what depends on params alone."""
        _, q, _, params, values = self._at(tau, y, args)
        return args._replace(prepared=self.system.terms.prepare(q, params, values, self.sample))

    def mirror(self, time: Array, args: Arguments) -> Array:
        """Tau from t, and t from tau."""
        if self.direction == 1:
            return time
        return -time if args.sigma is None else time * args.sigma

    def given(self, args: Arguments) -> tuple[Any, dict[str, Any]]:
        """(params, inputs) as the user passed them."""
        return (
            _params.join(args.params, self.params.tree),
            eqx.combine(args.inputs, self.inputs.tree),
        )

    def within(self, args: Arguments, tau: Float[Array, ""]) -> Arguments:
        """Arguments for a step around tau: every table read in the interval that holds tau."""
        _, inputs = self.given(args)
        return args._replace(intervals=locate(inputs, self.mirror(tau, args)))

    def acceleration(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " n"]:
        """Acceleration a at (tau, y)."""
        t, q, v, params, values = self._at(tau, y, args)
        return self.system.terms.acceleration(t, q, v, params, values, args.prepared)

    def effort(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " n"]:
        """Q - h at (tau, y): what M a is equal to."""
        t, q, v, params, values = self._at(tau, y, args)
        terms = self.system.terms
        return terms.force(t, q, v, params, values) - terms.bias(t, q, v, params)

    def _at(self, tau: Array, y: Array, args: Arguments) -> tuple[Array, Array, Array, Any, Any]:
        t, (q, v), (params, inputs) = self.mirror(tau, args), self.parts(y), self.given(args)
        return t, q, v, params, evaluate(inputs, t, q, v, params, args.intervals)

    def mass(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, "n n"]:
        """M at (tau, y)."""
        q, v = self.parts(y)
        return self.system.terms.mass(self.mirror(tau, args), q, v, self.given(args)[0])

    def __call__(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " m"]:
        """dy/dtau."""
        t, q, v, params, values = self._at(tau, y, args)
        rates = [v, self.system.terms.acceleration(t, q, v, params, values, args.prepared)]
        if self.power is not None and self.power.names:
            rates.append(jnp.stack(list(self.power(t, q, v, params, values).values())))
        rate = jnp.concatenate(rates)
        if self.direction == 1:
            return rate
        return -rate if args.sigma is None else rate * args.sigma.astype(rate.dtype)

    def elements(self, tau: Array, y: Sequence[Array], args: Arguments) -> tuple[Array, ...]:
        """dy/dtau from the elements of y, one by one; where there is a scalar program."""
        n, terms = self.system.size, self.system.terms
        assert isinstance(terms, ScalarTerms)
        q, v = y[:n], y[n:]
        t, (params, inputs) = self.mirror(tau, args), self.given(args)
        values = evaluate(inputs, t, jnp.stack(q), jnp.stack(v), params, args.intervals)
        a = terms.elements(t, q, v, q[0].dtype, params, values, args.prepared)
        if self.direction == 1:
            return (*v, *a)
        sigma = -1.0 if args.sigma is None else args.sigma.astype(q[0].dtype)
        return tuple(sigma * x for x in (*v, *a))

    def parts(self, y: Float[Array, "*s m"]) -> tuple[Array, Array]:
        """(q, v) of y."""
        n = self.system.size
        return y[..., :n], y[..., n : 2 * n]

    def start(self, q0: Float[Array, " n"], v0: Float[Array, " n"]) -> Float[Array, " m"]:
        """y at the start, no work done yet."""
        terms = 0 if self.power is None else len(self.power.names)
        return jnp.concatenate([q0, v0, jnp.zeros((terms,), q0.dtype)])

    def work(self, y: Float[Array, "*s m"]) -> dict[str, Float[Array, "*s"]]:
        """Work done since the start by every term of dH/dt, by name."""
        assert self.power is not None
        columns = jnp.moveaxis(y[..., 2 * self.system.size :], -1, 0)
        return dict(zip(self.power.names, columns, strict=True))

    def term(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> diffrax.ODETerm:
        """The vector field as diffrax takes it, for states and arguments like these."""
        field: Any = self.__call__
        elements: Any = self.elements if self._is_scalar(tau, y, args) else None
        return _Term(field, elements, y.dtype)

    def _is_scalar(self, tau: Array, y: Array, args: Arguments) -> bool:
        _, q, _, params, values = self._at(tau, y, args)
        terms = self.system.terms
        if not isinstance(terms, ScalarTerms) or self.power is not None:
            return False
        return terms.lowered(q, params, values).equations is not None


class _Term(diffrax.ODETerm):
    """Increments keep the state's dtype where time has another."""

    elements: Callable | None
    dtype: Any = eqx.field(static=True)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return (t1 - t0).astype(self.dtype)
