"""The equations of motion in first-order form, as solvers see them."""

from dataclasses import replace
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag import _params
from jaxlag._constraints import NO_ROWS, Baumgarte, Layout
from jaxlag._forces import reads_lam
from jaxlag._inputs import evaluate, locate, reads_state
from jaxlag._kkt import dependence_floor, independent_rows
from jaxlag._lowering import ArrayTerms, Moving, ScalarPrepared, ScalarTerms, elements
from jaxlag._power import Power
from jaxlag._projection import Surface, of_arrays, project
from jaxlag._quasi import QuasiVelocities
from jaxlag._step import Arguments, RowChoice, Verdict
from jaxlag._system import System
from jaxlag._terms import Terms

Elements = tuple[Array, ...]


class Dynamics(eqx.Module):
    """dy/dtau = sigma (v, a), y = (q, v), tau = sigma t, M a + h = Q + A^T lam, A a + gamma = 0.

    In the quasi-velocity formulation y = (q, w) and dy/dtau = sigma (v, w') with w the free
    quasi-velocities. Where work is asked for, y has one more component for each term of dH/dt.

    Attributes:
        system: what moves.
        params: static half of the params.
        inputs: static half of the inputs.
        direction: sigma, +1 or -1, where known while tracing; else None.
        power: terms of dH/dt to integrate along; None for none.
        sample: values of the params, where known.
        lanes: whether all this is vmapped, so that elements are rows of numbers.
        in_loop: whether it is evaluated in a loop over one trajectory or a few lanes.
        rows: the constraint rows.
        formulation: how accelerations are solved for under constraints; "quasi" for a state of
            quasi-velocities.
        stabilization: "projection", a `Baumgarte`, or None.
        regular: whether M is known to be positive definite without the constraints.
    """

    system: System
    params: _params.Static = eqx.field(static=True)
    inputs: _params.Static = eqx.field(static=True)
    direction: int | None = eqx.field(static=True)
    power: Power | None
    sample: _params.Sample = eqx.field(static=True)
    lanes: bool = eqx.field(static=True, default=False)
    in_loop: bool = eqx.field(static=True, default=False)
    rows: Layout = eqx.field(static=True, default=NO_ROWS)
    formulation: str = eqx.field(static=True, default="multipliers")
    stabilization: str | Baumgarte | None = eqx.field(static=True, default=None)
    regular: bool = eqx.field(static=True, default=False)

    @property
    def terms(self) -> Terms:
        """The lowered terms of the system."""
        terms = self.system.terms
        if isinstance(terms, ScalarTerms):
            array = self._solved(terms.array)
            return replace(terms, array=array, lanes=self.lanes, in_loop=self.in_loop)
        assert isinstance(terms, ArrayTerms)
        return self._solved(terms)

    @property
    def quasi(self) -> QuasiVelocities | None:
        """The quasi-velocities that the state is made of, if any."""
        return self.system.quasi if self.formulation == "quasi" else None

    @property
    def speeds(self) -> int:
        """Number of velocities, or of quasi-velocities, in the state."""
        return self.system.size if self.quasi is None else len(self.quasi.free)

    def _solved(self, terms: ArrayTerms) -> ArrayTerms:
        """The terms with constraints solved for as asked."""
        if self.quasi is not None:
            in_u = self.system.in_u
            return replace(terms, quasi=self.quasi, in_u=in_u, regular=self.regular)
        if not self.rows.size:
            return terms
        baumgarte = self.stabilization if isinstance(self.stabilization, Baumgarte) else None
        return replace(
            terms, formulation=self.formulation, baumgarte=baumgarte, regular=self.regular
        )

    @property
    def projects(self) -> bool:
        """Whether states are projected onto constraints."""
        rows = self.rows.size if self.quasi is None else sum(self.rows.holonomic)
        return rows > 0 and self.stabilization == "projection"

    def arguments(self, params: Any, inputs: Any, ts: Float[Array, " s"]) -> Arguments:
        """Arguments outside any step, from the traced halves of params and inputs."""
        if self.direction is not None:
            return Arguments(params, inputs, None, None, None)
        sigma = jnp.where(ts[-1] >= ts[0], 1.0, -1.0).astype(ts.dtype)
        return Arguments(params, inputs, sigma, None, None)

    def prepare(self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments) -> Arguments:
        """The arguments with all that accelerations need of what depends on params alone."""
        t, q, v, params, values = self._at(tau, y, args)
        args = args._replace(rows=self._choice(t, q, v, params))
        if self._sliding:
            speeds = [slide(t, q, v, params) for slide in self._sliding]
            senses = jnp.stack([jnp.sign(jnp.asarray(s, q.dtype)) for s in speeds])
            args = args._replace(senses=jax.lax.stop_gradient(senses))
        sense = self.mirror(jnp.ones_like(tau), args)
        prepared = self.terms.prepare(q, params, values, self.sample, args.kept, sense)
        return args._replace(prepared=prepared)

    def _choice(self, t: Array, q: Array, v: Array, params: Any) -> RowChoice | None:
        """The rows to solve with; None where there are not several."""
        if self.rows.size < 2 or (self.quasi is not None and not self.projects):
            return None
        t, q, v, params = _still((t, q, v, params))
        M, (A, _) = self.terms.mass(t, q, v, params), self.terms.rows(t, q, v, params)
        # A row that vanishes, as at a dead point, is rounding; its size is how fast it grows.
        eps = float(jnp.finfo(q.dtype).eps)
        small = eps**0.25
        signs = jnp.asarray((-1.0) ** np.arange(q.shape[0]), q.dtype)
        beside, _ = self.terms.rows(t, q + small * signs * (1.0 + jnp.abs(q)), v, params)
        norms, growth = (jnp.sqrt(jnp.sum(x**2, axis=1)) for x in (A, (beside - A) / small))
        there = norms > 1e3 * eps * growth
        kept = independent_rows(M, A, self.rows.holonomic, there=there)
        size = jnp.where(there, norms, growth)
        return RowChoice(kept, jnp.where(size > 0, size, 1.0))

    def mirror(self, time: Array, args: Arguments) -> Array:
        """Tau from t, and t from tau; the sense of time from 1."""
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
        """Acceleration a, or w' of quasi-velocities, at (tau, y)."""
        t, q, v, params, values = self._at(tau, y, args)
        if self.quasi is not None:
            w = self.parts(y)[1]
            return self._quasi_rates(t, q, w, params, values, args)[self.system.size :]
        return self.terms.acceleration(t, q, v, params, values, args.prepared, args.kept)

    def _quasi_rates(
        self, t: Array, q: Array, w: Array, params: Any, values: Any, args: Arguments
    ) -> Array:
        """(v, w') of a state of quasi-velocities."""
        terms = self.terms
        if isinstance(terms, ScalarTerms):
            if isinstance(args.prepared, ScalarPrepared):
                state = elements(q), elements(w), q.dtype
                return jnp.stack(terms.elements(t, *state, params, values, args.prepared))
            terms = terms.array
        assert isinstance(terms, ArrayTerms)
        moving = Moving(terms, t, q, w, params, values)
        return jnp.concatenate([moving.v, moving.accelerations()])

    def effort(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " n"]:
        """Q - h at (tau, y): what M a is equal to."""
        t, q, v, params, values = self._at(tau, y, args)
        terms = self.terms
        return terms.force(t, q, v, params, values) - terms.bias(t, q, v, params)

    def state(self, tau: Array, y: Array, args: Arguments) -> tuple[Array, Array, Array, Any]:
        """(t, q, v, params) at (tau, y)."""
        t, (q, w), (params, _) = self.mirror(tau, args), self.parts(y), self.given(args)
        return t, q, self.velocities(t, q, w, params), params

    def velocities(self, t: Array, q: Array, w: Array, params: Any) -> Array:
        """The velocities of a state."""
        if self.quasi is None:
            return w
        return self.quasi.velocities(t, q, self.quasi.full(w), params)

    def velocities_of(self, t: Array, q: Array, w: Array, args: Arguments) -> Array:
        """The same, by the scalar program where there is one."""
        if self.quasi is None or not isinstance(args.prepared, ScalarPrepared):
            return self.velocities(t, q, w, self.given(args)[0])
        return self._by_program(t, elements(q), elements(w), args)

    def _by_program(self, t: Array, q: Any, w: Any, args: Arguments) -> Array:
        """Velocities from elements of a state of quasi-velocities, which no input changes."""
        terms, (params, inputs), state = self.terms, self.given(args), jnp.stack(q)
        assert isinstance(terms, ScalarTerms)
        values = evaluate(inputs, t, state, jnp.zeros_like(state), params, args.intervals)
        v = terms.velocities(t, q, w, state.dtype, params, values, args.prepared)
        return jnp.stack(v)

    def _at(self, tau: Array, y: Array, args: Arguments) -> tuple[Array, Array, Array, Any, Any]:
        t, q, v, params = self.state(tau, y, args)
        return t, q, v, params, evaluate(self.given(args)[1], t, q, v, params, args.intervals)

    def mass(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, "n n"]:
        """M at (tau, y)."""
        return self.terms.mass(*self.state(tau, y, args))

    def __call__(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " m"]:
        """dy/dtau."""
        t, q, v, params, values = self._at(tau, y, args)
        if self.quasi is not None:
            rates = [self._quasi_rates(t, q, self.parts(y)[1], params, values, args)]
        else:
            rates = [v, self.terms.acceleration(t, q, v, params, values, args.prepared, args.kept)]
        if self.power is not None and self.power.names:
            rates.append(jnp.stack(list(self.power(t, q, v, params, values).values())))
        return self._turned((jnp.concatenate(rates),), args)[0]

    def surface(self, tau: Array, y: Any, args: Arguments) -> Surface:
        """The constraints near a predicted state, an array or the tuple of its elements."""
        t, (q, v), terms = self.mirror(tau, args), self.parts(y), self.terms
        params, inputs = self.given(args)
        if isinstance(args.prepared, ScalarPrepared):
            assert isinstance(terms, ScalarTerms)
            single = not isinstance(y, tuple)
            if single:
                q, v = tuple(elements(q)), tuple(elements(v))
            values = self._values(inputs, t, q, v, params, args)
            found = terms.surface(t, q, v, q[0].dtype, params, values, args.prepared)
            return of_arrays(found) if single else found
        v = self.velocities(t, q, v, params)
        holonomic = np.flatnonzero(self.rows.holonomic).tolist()

        def corrections(chosen: list[int] | None) -> Array:
            array = terms.array if isinstance(terms, ScalarTerms) else terms
            assert isinstance(array, ArrayTerms)
            return array.correction(t, q, v, params, args.prepared, args.kept, chosen)

        def position(q: Array) -> Array:
            return terms.position(t, q, params)

        if self.quasi is not None:
            near = corrections(holonomic)
            return Surface(position, None, lambda c: near @ c, None)
        K = K_of_position = terms.correction(t, q, v, params, args.prepared, args.kept)
        if 0 < len(holonomic) < self.rows.size:
            K_of_position = corrections(holonomic)
        return Surface(
            position if holonomic else None,
            lambda q, v: terms.velocity(t, q, v, params),
            lambda c: K_of_position @ c,
            lambda c: K @ c,
        )

    def _values(self, inputs: Any, t: Array, q: Any, w: Any, params: Any, args: Arguments) -> Any:
        """Values of the inputs at elements of a state."""
        state = jnp.stack(q)
        if self.quasi is None:
            v = jnp.stack(w)
        elif reads_state(inputs):
            v = self._by_program(t, q, w, args)
        else:
            v = jnp.zeros_like(state)
        return evaluate(inputs, t, state, v, params, args.intervals)

    @property
    def _sliding(self) -> tuple[Any, ...]:
        """Velocities of contact points that must not change their sign."""
        return tuple(f.sliding for f in filter(reads_lam, self.system.forces) if f.sliding)

    @property
    def _contacts(self) -> list[int]:
        """Rows whose multipliers must not become negative."""
        names = {f.contact for f in filter(reads_lam, self.system.forces)}
        rows, start = [], 0
        for name, shape in self.rows.shapes:
            stop = start + int(np.prod(shape))
            rows += range(start, stop) if name in names else ()
            start = stop
        return rows

    @property
    def contact_row(self) -> int:
        """The first row that friction depends on, as far as it is declared; else row 0."""
        return self._contacts[0] if self._contacts else 0

    @property
    def settles(self) -> bool:
        """Whether a step's end is moved, or looked at beyond its being finite."""
        if self.quasi is not None:
            return self.projects
        several = self.rows.size > 1  # some of which may have been left out
        return self.projects or several or bool(self._contacts) or bool(self._sliding)

    def settle(
        self, tau: Array, y: Any, args: Arguments, differentiable: bool = False
    ) -> tuple[Any, Verdict]:
        """The state at the end of a step as it is kept, and what is to be said about it."""
        true = jnp.array(True)
        verdict = Verdict(true, true, true)
        if self.projects:
            y, found, closed = self.project(tau, y, args, differentiable)
            verdict = Verdict(found, closed, true)
        elif args.rows is not None:
            surface, (q, v) = self.surface(*_still((tau, y, args))), self.parts(_still(y))
            verdict = Verdict(true, self._closed(surface, q, v, args), true)
        return y, verdict._replace(pressed=self.pressed(tau, y, args))

    def pressed(self, tau: Array, y: Any, args: Arguments) -> Bool[Array, ""]:
        """Whether contacts press and slide as their friction takes them to."""
        if not self._contacts and not self._sliding:
            return jnp.array(True)
        tau, y, args = _still((tau, jnp.stack(y) if isinstance(y, tuple) else y, args))
        t, q, v, params, values = self._at(tau, y, args)
        right, terms = [], self.terms
        if self._contacts:
            if isinstance(args.prepared, ScalarPrepared) and isinstance(terms, ScalarTerms):
                state = tuple(elements(q)), tuple(elements(v)), q.dtype
                lam = terms.multipliers(t, *state, params, values, args.prepared)
            else:
                lam = terms.reactions(t, q, v, params, values)[1]
            right += [lam[row] >= 0 for row in self._contacts]
        for k, slide in enumerate(self._sliding):
            assert args.senses is not None
            right.append(slide(t, q, v, params) * args.senses[k] > 0)
        return jnp.all(jnp.stack(right))

    def project(
        self, tau: Array, y: Any, args: Arguments, differentiable: bool = False
    ) -> tuple[Any, Bool[Array, ""], Bool[Array, ""]]:
        """(state on the constraints nearest to y, whether found, whether all rows hold there)."""
        frozen = None
        if differentiable:
            frozen = self.surface(*_still((tau, y, args)))
        surface, (q, v) = self.surface(tau, y, args), self.parts(y)
        q, v, found = project(surface, q, v, frozen)
        rest = self.system.size + self.speeds
        whole = (*q, *v) if isinstance(y, tuple) else jnp.concatenate([q, v, y[rest:]])
        return whole, found, self._closed(surface, q, v, args)

    def _closed(self, surface: Surface, q: Any, v: Any, args: Arguments) -> Bool[Array, ""]:
        """Whether rows that were left out hold as well, to half the digits.

        Where nothing holds the others, these may drift as they do.
        """
        if args.rows is None:
            return jnp.array(True)
        kept, size = args.rows
        holonomic = np.flatnonzero(self.rows.holonomic).tolist()
        floor = dependence_floor(jax.tree.leaves(q)[0].dtype)

        def holds(c: Any, x: Any, rows: list[int]) -> Array:
            largest = jax.tree.reduce(jnp.maximum, jax.tree.map(lambda x: jnp.max(jnp.abs(x)), x))
            off = [jnp.abs(c[i]) / size[row] for i, row in enumerate(rows)]
            drift = [jnp.where(kept[row], x, 0.0) for row, x in zip(rows, off, strict=True)]
            allowed = floor * (1.0 + largest) + 100.0 * reduce(jnp.maximum, drift)
            found = [kept[row] | (x <= allowed) for row, x in zip(rows, off, strict=True)]
            return jnp.all(jnp.stack(found))

        closed = jnp.array(True)
        if surface.velocity is not None:
            closed = holds(surface.velocity(q, v), v, list(range(self.rows.size)))
        if surface.position is not None:
            closed = closed & holds(surface.position(q), q, holonomic)
        return closed

    def rates(self, tau: Array, y: Elements, args: Arguments) -> Elements:
        """dy/dtau from y element by element, by the scalar program."""
        if self.quasi is not None:
            q, w = self.parts(y)
            return self._turned(self._elements(self.mirror(tau, args), q, w, args), args)
        q, w = self.split(y, args)
        return self.join(w, self.accelerations(tau, q, w, args), args)

    def split(self, y: Elements, args: Arguments) -> tuple[Elements, Elements]:
        """(q, w) of y, w = dq/dtau = sigma v; (w, a) of dy/dtau."""
        n = self.system.size
        return y[:n], self._turned(y[n:], args)

    def join(self, q: Elements, w: Elements, args: Arguments) -> Elements:
        """The inverse of `split`."""
        return (*q, *self._turned(w, args))

    def accelerations(self, tau: Array, q: Elements, w: Elements, args: Arguments) -> Elements:
        """d2q/dtau2 = a by the scalar program."""
        return self._elements(self.mirror(tau, args), q, self._turned(w, args), args)

    def _elements(self, t: Array, q: Elements, w: Elements, args: Arguments) -> Elements:
        """What the scalar program gives."""
        terms, (params, inputs) = self.terms, self.given(args)
        assert isinstance(terms, ScalarTerms)
        values = self._values(inputs, t, q, w, params, args)
        return terms.elements(t, q, w, q[0].dtype, params, values, args.prepared)

    def _turned(self, x: Elements, args: Arguments) -> Elements:
        """Sigma x."""
        if self.direction == 1:
            return tuple(x)
        return tuple(-a if args.sigma is None else a * args.sigma.astype(a.dtype) for a in x)

    def parts(self, y: Any) -> tuple[Any, Any]:
        """(q, v), or (q, w), of y, (..., m) or the tuple of its elements."""
        n, rest = self.system.size, self.system.size + self.speeds
        if isinstance(y, tuple):
            return y[:n], y[n:rest]
        return y[..., :n], y[..., n:rest]

    def start(self, q0: Float[Array, " n"], w0: Float[Array, " k"]) -> Float[Array, " m"]:
        """y at the start, no work done yet."""
        terms = 0 if self.power is None else len(self.power.names)
        return jnp.concatenate([q0, w0, jnp.zeros((terms,), q0.dtype)])

    def work(self, y: Float[Array, "*s m"]) -> dict[str, Float[Array, "*s"]]:
        """Work done since the start by every term of dH/dt, by name."""
        assert self.power is not None
        columns = jnp.moveaxis(y[..., self.system.size + self.speeds :], -1, 0)
        return dict(zip(self.power.names, columns, strict=True))

    def is_scalar(self, tau: Array, y: Array, args: Arguments) -> bool:
        """Whether there is a scalar program for states and arguments like these."""
        _, q, _, params, values = self._at(tau, y, args)
        terms = self.terms
        if not isinstance(terms, ScalarTerms) or self.power is not None:
            return False
        return terms.lowered(q, params, values).equations is not None


def _still(tree: Any) -> Any:
    """Without derivatives."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)
