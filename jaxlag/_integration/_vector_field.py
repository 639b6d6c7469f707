"""The vector field: the equations of motion in first-order form."""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._arrays import stop_gradient
from jaxlag._integration._row_selection import selected_rows
from jaxlag._integration._step_arguments import Arguments, KnotIntervals
from jaxlag._linalg._mass_solve import clearly_definite
from jaxlag._linalg._projection import ConstraintProjector
from jaxlag._lowering import (
    AbstractTerms,
    AccelerationProgram,
    ArrayTerms,
    Choices,
    ScalarProgram,
    State,
)
from jaxlag._model._constraints import NO_ROWS, Baumgarte, ConstraintRows
from jaxlag._model._forces import sliding
from jaxlag._model._inputs import (
    all_knots,
    at_interval,
    counted_from,
    evaluate,
    marked,
    reads_state,
)
from jaxlag._model._quasi_velocities import QuasiVelocities
from jaxlag._model._states import with_states
from jaxlag._system._power import Power
from jaxlag._system._system import System
from jaxlag._tracing import _params


class VectorField(eqx.Module):
    """dy/dtau = sigma (v, a), y = (q, v), M a + h = Q + A^T lam, A a + gamma = 0.

    tau = sigma (t - t0) with t0 the start and sigma the direction of time.

    In the quasi-velocity formulation y = (q, w) and dy/dtau = sigma (v, w') with w the free
    quasi-velocities. States x of the system follow, y = (q, v, x). With work, y has one more
    component for each term of dH/dt.

    Attributes:
        system: the mechanical system.
        params: static half of the params.
        inputs: static half of the inputs.
        time_direction: sigma, +1 or -1, if known while tracing; else None.
        power: terms of dH/dt to integrate; None for none.
        sample: values of the params, if known.
        lanes: whether it is vmapped, so that elements are arrays of numbers.
        in_loop: whether it is evaluated in a loop over one trajectory or a few lanes.
        rows: the constraint rows.
        formulation: how accelerations are solved for with constraints; "quasi" for a state of
            quasi-velocities.
        stabilization: "projection", a `Baumgarte`, or None.
        regular: whether M is positive definite without the constraints; None if that is found only
            at the start of a solve.
        blocks_definite: the same of the blocks of a sparse M, with the rows inside of them.
        contact_rows_independent: whether rows whose multipliers forces read are known to be
            independent.
        extrapolates: whether the method has stages beyond the end of a step.
        crossing: whether rows that become dependent during the motion are left out there.
        seldom: whether it is evaluated a few times in a solve.
        jacobians: whether its derivatives are Jacobians of implicit methods.
    """

    system: System
    params: _params.Static = eqx.field(static=True)
    inputs: _params.Static = eqx.field(static=True)
    time_direction: int | None = eqx.field(static=True)
    power: Power | None
    sample: _params.Sample = eqx.field(static=True)
    lanes: bool = eqx.field(static=True, default=False)
    in_loop: bool = eqx.field(static=True, default=False)
    rows: ConstraintRows = eqx.field(static=True, default=NO_ROWS)
    formulation: str = eqx.field(static=True, default="multipliers")
    stabilization: str | Baumgarte | None = eqx.field(static=True, default=None)
    regular: bool | None = eqx.field(static=True, default=False)
    blocks_definite: bool | None = eqx.field(static=True, default=None)
    contact_rows_independent: bool = eqx.field(static=True, default=False)
    extrapolates: bool = eqx.field(static=True, default=False)
    crossing: bool = eqx.field(static=True, default=False)
    seldom: bool = eqx.field(static=True, default=False)
    jacobians: bool = eqx.field(static=True, default=False)

    @property
    def terms(self) -> ArrayTerms:
        """The terms of the equations, on arrays."""
        return self._solved(self.system._terms)

    @property
    def program(self) -> AccelerationProgram:
        """The program of the accelerations."""
        program = self.system._program
        if isinstance(program, ScalarProgram):
            program = replace(
                program,
                lanes=self.lanes,
                in_loop=self.in_loop,
                seldom=self.seldom,
                jacobians=self.jacobians,
            )
        return replace(program, array=self.terms)

    @property
    def quasi(self) -> QuasiVelocities | None:
        """The quasi-velocities of the state, if any."""
        return self.system.quasi if self.formulation == "quasi" else None

    @property
    def speeds(self) -> int:
        """Number of velocities, or of quasi-velocities, in the state."""
        return self.system.size if self.quasi is None else len(self.quasi.free)

    @property
    def state_count(self) -> int:
        """Number of states beside the coordinates and velocities."""
        return 0 if self.system.states is None else self.system.states.size

    def _solved(self, terms: ArrayTerms) -> ArrayTerms:
        """The terms with the selected solve for constraints."""
        if self.quasi is not None:
            in_u = self.system._in_u
            return replace(terms, quasi=self.quasi, in_u=in_u, regular=bool(self.regular))
        if not self.rows.size:
            return terms
        baumgarte = self.stabilization if isinstance(self.stabilization, Baumgarte) else None
        known = {
            "regular": bool(self.regular),
            "blocks_definite": self.blocks_definite,
            "contact_rows_independent": self.contact_rows_independent,
            "crossing": self.crossing,
        }
        return replace(terms, formulation=self.formulation, baumgarte=baumgarte, **known)

    @property
    def projects(self) -> bool:
        """Whether states are projected onto constraints."""
        rows = self.rows.size if self.quasi is None else sum(self.rows.holonomic)
        return rows > 0 and self.stabilization == "projection"

    def arguments(self, params: Any, inputs: Any, ts: Float[Array, " s"]) -> Arguments:
        """Arguments outside any step, from the traced halves of params and inputs."""
        time_direction = None
        if self.time_direction is None:
            time_direction = jnp.where(ts[-1] >= ts[0], 1.0, -1.0).astype(ts.dtype)
        args = Arguments(params, inputs, time_direction, ts[0], ts[-1], None, None)
        knots = all_knots(eqx.combine(inputs, self.inputs.tree))
        if knots is None:
            return args
        # Knots only select table rows: no derivative passes through them.
        knots = jnp.sort(jax.lax.stop_gradient(knots.astype(ts.dtype)))
        never = jnp.full((1,), jnp.finfo(ts.dtype).min, ts.dtype)
        ahead = KnotIntervals(self.tau(knots, args), jnp.concatenate([never, knots]))
        back = KnotIntervals(ahead.knots[::-1], jnp.concatenate([knots[::-1], never]))
        onwards = self.signed(jnp.ones_like(ts[0]), args) > 0
        gaps = jax.tree.map(partial(jnp.where, onwards), ahead, back)
        return args._replace(gaps=stop_gradient(gaps))

    def _traced(self, inputs: Any) -> Any:
        return eqx.filter(inputs, _params.is_array)

    def precompute(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Arguments:
        """Add to the arguments the values for accelerations that depend on params alone."""
        t, q, v, params, values = self.at(tau, y, args)
        if self.rows.chooses and (self.quasi is None or self.projects):
            state = State(t, q, v, params, values)
            given = self.program, self.terms, self.rows, self.stabilization, self.sample
            args = args._replace(rows=selected_rows(*given, state))
        if slides := sliding(self.system.forces):
            speeds = [slide(t, q, v, params) for slide in slides]
            senses = jnp.stack([jnp.sign(jnp.asarray(s, q.dtype)) for s in speeds])
            args = args._replace(senses=jax.lax.stop_gradient(senses))
        time_direction = self.signed(jnp.ones_like(tau), args)
        definite = None
        if self.regular is None and self.formulation != "null_space":
            definite = partial(self._definite, t, q, v, params)
        choices = Choices(
            self.sample, args.active_rows, args.multiplier_rows, time_direction, definite
        )
        return args._replace(constants=self.program.precompute(q, params, values, choices))

    def _definite(self, t: Array, q: Array, v: Array, params: Any) -> Bool[Array, ""]:
        """Whether M is positive definite without the constraints, in all lanes.

        Tested as in `mass_definite`. A lane with nonfinite values does not count.
        """
        t, q, v, params = stop_gradient((t, q, v, params))
        elsewhere = np.random.default_rng(0).uniform(-1.5, 1.5, (2, self.system.size))
        found = []
        for at, rates in ((q, v), tuple(jnp.asarray(elsewhere, q.dtype))):
            M = self.program.terms(q, params, self.sample).mass(t, at, rates, params)
            found.append(clearly_definite(M) | ~jnp.all(jnp.isfinite(M)))
        return eqxi.unvmap_all(jnp.stack(found))

    def clock(self, tau: Array, args: Arguments) -> Array:
        """The user's time t = t0 + sigma tau, bounded by the end in spite of rounding."""
        t, end = args.origin + self.signed(tau, args), args.end
        if self.time_direction is not None:
            bounded = (jnp.minimum if self.time_direction == 1 else jnp.maximum)(t, end)
        else:
            bounded = jnp.clip(t, *(f(args.origin, end) for f in (jnp.minimum, jnp.maximum)))
        if not self.extrapolates:
            return bounded
        rounding = 4 * jnp.finfo(t.dtype).eps * (jnp.abs(args.origin) + jnp.abs(end))
        return jnp.where(jnp.abs(t - end) > rounding, t, bounded)

    def tau(self, t: Array, args: Arguments) -> Array:
        """Tau = sigma (t - t0)."""
        return self.signed(t - args.origin, args)

    def signed(self, x: Array, args: Arguments) -> Array:
        """Sigma x."""
        if self.time_direction == 1:
            return x
        return -x if args.time_direction is None else x * args.time_direction.astype(x.dtype)

    def given(self, args: Arguments) -> tuple[Any, dict[str, Any]]:
        """(params, inputs) as the user passed them; within a step two entries of each table."""
        return (
            _params.join(args.params, self.params.tree),
            eqx.combine(args.inputs, self.inputs.tree),
        )

    def within(self, args: Arguments, tau: Float[Array, ""]) -> Arguments:
        """Arguments for a step that starts at tau: of every table the entries of one interval."""
        return self.windows(args, tau)[0]

    def windows(
        self, args: Arguments, tau: Float[Array, ""]
    ) -> tuple[Arguments, list[Array | None]]:
        """The same, and for each leaf of the arguments the start of its entries; None for all."""
        _, inputs = self.given(args)
        starts: dict[str, Array] = {}
        located = args
        if args.gaps is not None and args.gaps.knots.size:
            gap = jnp.searchsorted(args.gaps.knots, tau, side="right")
            inputs, starts = at_interval(inputs, args.gaps.lower[gap])
            none = KnotIntervals(args.gaps.knots[:0], args.gaps.lower[:0])
            located = args._replace(inputs=self._traced(inputs), gaps=none)

        nowhere = jax.tree.map(lambda _: None, args)
        here = {name: marked(args.inputs[name], start) for name, start in starts.items()}
        marks = nowhere._replace(inputs=nowhere.inputs | here)
        return located, jax.tree.leaves(marks, is_leaf=lambda x: x is None)

    def acceleration(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " n"]:
        """Acceleration a, or w' of quasi-velocities, at (tau, y)."""
        if self.quasi is not None:
            return self._quasi_rates(tau, y, args)[self.system.size :]
        state = State(*self.at(tau, y, args))
        return self.program.acceleration(state, args.constants, args.multiplier_rows)

    def _quasi_rates(self, tau: Array, y: Array, args: Arguments) -> Array:
        """(v, w') of a state of quasi-velocities."""
        return self.program.quasi_rates(self.state_at(tau, y, args), args.constants)

    def effort(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " n"]:
        """Q - h at (tau, y)."""
        return self.terms.effort(*self.at(tau, y, args))

    def state_of(self, t: Array, q: Array, v: Array, x: Array | None, params: Any) -> Array:
        """The state of a motion from (q, v, x), with zero work."""
        w = v if self.quasi is None else self.quasi.of(t, q, v, params)[self.quasi.free]
        return self.start(q, w, x)

    def state(self, tau: Array, y: Array, args: Arguments) -> tuple[Array, Array, Array, Any]:
        """(t, q, v, params) at (tau, y)."""
        t, (q, w), (params, _) = self.clock(tau, args), self.parts(y), self.given(args)
        return t, q, self.velocities(t, q, w, params), params

    def velocities(self, t: Array, q: Array, w: Array, params: Any) -> Array:
        """The velocities of a state."""
        if self.quasi is None:
            return w
        return self.quasi.velocities(t, q, self.quasi.full(w), params)

    def velocities_of(self, t: Array, q: Array, w: Array, args: Arguments) -> Array:
        """The same by the program; it does not depend on inputs."""
        if self.quasi is None:
            return w
        state = State(t, q, w, self.given(args)[0], self.shapes_of_inputs(q, args))
        return self.program.velocities(state, args.constants)

    def at(self, tau: Array, y: Array, args: Arguments) -> tuple[Array, Array, Array, Any, Any]:
        """(t, q, v, params, values of the inputs) at (tau, y)."""
        t, q, v, params = self.state(tau, y, args)
        return t, q, v, params, self.inputs_at(tau, q, v, self.x(y), args)

    def inputs_at(self, tau: Array, q: Array, v: Array, x: Array, args: Arguments) -> Any:
        """Values of inputs and states within a step, or in the interval that starts at tau."""
        args = self.within(args, tau)
        (params, inputs), since = self.given(args), self.signed(tau, args)
        first, inputs = dict.fromkeys(inputs, 0), counted_from(args.origin, inputs)
        values = evaluate(
            inputs, self.clock(tau, args), q, v, params, first, since, self.extrapolates
        )
        return with_states(values, self.system.states, x)

    def mass(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, "n n"]:
        """M at (tau, y)."""
        return self.terms.mass(*self.state(tau, y, args))

    def __call__(
        self, tau: Float[Array, ""], y: Float[Array, " m"], args: Arguments
    ) -> Float[Array, " m"]:
        """dy/dtau."""
        if self.quasi is not None:
            rates = [self._quasi_rates(tau, y, args)]
        else:
            rates = [self.parts(y)[1], self.acceleration(tau, y, args)]
        if self.system.states is not None:
            rates.append(self.system.states.rates(*self.at(tau, y, args)))
        if self.power is not None and self.power.names:
            t, q, v, params, values = self.at(tau, y, args)
            rates.append(jnp.stack(list(self.power(t, q, v, params, values).values())))
        return self.signed(jnp.concatenate(rates), args)

    def curvature_of_states(self, tau: Array, y: Array, f: Array, args: Arguments) -> Array | None:
        """d2x/dtau2 of states x beside (q, v), f = dy/dtau; None without states."""
        states = self.system.states
        if states is None:
            return None

        def rates(tau: Array, y: Array) -> Array:
            return self.signed(states.rates(*self.at(tau, y, args)), args)

        return jax.jvp(rates, (tau, y), (jnp.ones_like(tau), f))[1]

    def projector(self, tau: Array, y: Array, args: Arguments) -> ConstraintProjector:
        """The projection onto the constraints near a predicted state."""
        t, (q, w), (params, _) = self.clock(tau, args), self.parts(y), self.given(args)
        state = State(t, q, w, params, self.shapes_of_inputs(q, args))
        return self.program.projector(state, args.constants, self.rows, args.active_rows)

    def shapes_of_inputs(self, q: Array, args: Arguments) -> Any:
        """Values of the inputs anywhere, for programs keyed by their shapes; else none."""
        if not self.program.keyed_by_inputs(args.constants):
            return {}
        x = jnp.zeros((self.state_count,), q.dtype)
        return self.inputs_at(jnp.zeros_like(args.origin), q, jnp.zeros_like(q), x, args)

    def terms_at(self, q: Array, args: Arguments) -> AbstractTerms:
        """The terms, without forces, for use a few times in a solve, for such coordinates."""
        params, _ = self.given(args)
        return self.program.terms(q, params, self.sample)

    def state_at(self, tau: Array, y: Array, args: Arguments) -> State:
        """The state as programs take it, with quasi-velocities if it has them."""
        t, (q, w), (params, inputs) = self.clock(tau, args), self.parts(y), self.given(args)
        v = w
        if self.quasi is not None:
            v = self.velocities_of(t, q, w, args) if reads_state(inputs) else jnp.zeros_like(q)
        return State(t, q, w, params, self.inputs_at(tau, q, v, self.x(y), args))

    def parts(self, y: Any) -> tuple[Any, Any]:
        """(q, v), or (q, w), of y, (..., m)."""
        n, rest = self.system.size, self.system.size + self.speeds
        return y[..., :n], y[..., n:rest]

    def x(self, y: Float[Array, "*s m"]) -> Float[Array, "*s k"]:
        """The states beside (q, v) in y."""
        start = self.system.size + self.speeds
        return y[..., start : start + self.state_count]

    def start(
        self, q0: Float[Array, " n"], w0: Float[Array, " k"], x0: Float[Array, " j"] | None
    ) -> Float[Array, " m"]:
        """y at the start, with zero work."""
        terms = 0 if self.power is None else len(self.power.names)
        beside = [] if x0 is None else [x0]
        return jnp.concatenate([q0, w0, *beside, jnp.zeros((terms,), q0.dtype)])

    def idle(self, y: Float[Array, "*s m"]) -> Float[Array, "*s k"]:
        """y without the work done."""
        return y[..., : self.system.size + self.speeds + self.state_count]

    def work(self, y: Float[Array, "*s m"]) -> dict[str, Float[Array, "*s"]]:
        """Work done since the start by every term of dH/dt, by name."""
        assert self.power is not None
        columns = jnp.moveaxis(y[..., self.system.size + self.speeds + self.state_count :], -1, 0)
        return dict(zip(self.power.names, columns, strict=True))

    def lines(self, tau: Array, y: Array, args: Arguments) -> int | None:
        """Number of lines of the scalar program for such states; None if there is none."""
        return None if self.power is not None else self.acceleration_lines(tau, y, args)

    def acceleration_lines(self, tau: Array, y: Array, args: Arguments) -> int | None:
        """The same of the accelerations, whatever else is integrated."""
        _, q, _, params, values = self.at(tau, y, args)
        return self.program.lines(q, params, values)

    def variables(self, tau: Array, y: Array, args: Arguments) -> frozenset[str] | None:
        """Those of (t, q, v) that accelerations read; None if that is not known."""
        if self.rows.size or self.quasi is not None or self.system.states is not None:
            return None
        _, q, _, params, values = self.at(tau, y, args)
        return self.program.variables(q, params, values, self.sample)

    def is_analytic(self, tau: Array, y: Array, args: Arguments) -> bool:
        """Whether the scalar program of accelerations has no comparisons or unusual functions."""
        _, q, _, params, values = self.at(tau, y, args)
        return self.program.is_analytic(q, params, values, self.sample)

    def why_on_arrays(self, tau: Array, y: Array, args: Arguments) -> str | None:
        """Why there is no scalar program; None if there is one, or none is wanted."""
        _, q, _, params, values = self.at(tau, y, args)
        return self.program.why_on_arrays(q, params, values, self.sample)
