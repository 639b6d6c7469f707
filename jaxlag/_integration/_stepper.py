"""Stepper: one step, its post-processing, and the choice of the next one."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxlag._integration._active_branches import branches
from jaxlag._integration._change_points import AGAIN, AHEAD, SHORT, Crossing, same_sense, widest_gap
from jaxlag._integration._first_step import first_step, slope_and_step
from jaxlag._integration._linearized_rates import longest_step
from jaxlag._integration._quasi_singularities import Passage, determinants, passage
from jaxlag._integration._quintic_hermite import hermite
from jaxlag._integration._step_arguments import StepChecks, midway
from jaxlag._integration._step_end import StepEnd
from jaxlag._integration._tableaus import explicit_tableau, nodes_of, remembers
from jaxlag._integration._term import Term
from jaxlag.solvers import AbstractExplicit, Splitting
from jaxlag.solvers._unweighted_stages import at_least, unseen, unstacked, unweighted_stages

SINGULAR = 1e3  # tolerances: bound on the error of a part of an accepted step in a smooth field


class Estimate(NamedTuple):
    """The error estimate of a step.

    Attributes:
        error: the estimate; None for methods without one.
        unseen: error of stages without weight in it; None if there are none.
        slope_drop: h dy/dt at the start minus that at the end; None if it is not needed or unknown.
    """

    error: PyTree
    unseen: PyTree | None = None
    slope_drop: PyTree | None = None
    near: Bool[Array, ""] | None = None


class Stepper(eqx.Module):
    """Takes one step and chooses the next one; without a controller steps are fixed."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    term: diffrax.AbstractTerm
    # (args, tau) -> (args of a step from tau, start of the table entries in them)
    windows: Callable = eqx.field(static=True)
    # (tau, y, args, differentiable) -> (accepted state at the end of a step, StepChecks)
    step_end: Callable | None = eqx.field(static=True, default=None)
    moves: bool = eqx.field(static=True, default=False)  # whether `step_end` moves the state
    longest: Array | None = None  # bound on adaptive steps
    # whether steps across a change of a comparison are held to the accuracy of derivatives
    across: bool = eqx.field(static=True, default=False)
    # whether quasi-velocities may become singular during the motion
    passes: bool = eqx.field(static=True, default=False)
    # whether steps end before change points
    stops: bool = eqx.field(static=True, default=False)

    @property
    def implicit(self) -> bool:
        """Whether a step may solve implicit equations."""
        return not isinstance(self.solver, AbstractExplicit | Splitting | diffrax.AbstractERK)

    @property
    def gap(self) -> float:
        """The position in a step that is farthest from all stages, see `widest_gap`."""
        return widest_gap(nodes_of(self.solver))

    @property
    def standard(self) -> bool:
        """Whether steps are fixed or chosen by diffrax's PID controller itself."""
        return self.controller is None or type(self.controller) is diffrax.PIDController

    def on_scalars(self, lanes: bool = False, in_loop: bool = True) -> "Stepper | None":
        """The form for loops that are one native function; None if there is none.

        Args:
            lanes: whether it will be vmapped.
            in_loop: whether it is for a loop over one trajectory or a few lanes.
        """
        if not isinstance(self.term, Term) or self.term.lines is None:
            return None
        if not isinstance(self.solver, AbstractExplicit | Splitting):
            return None
        term = self.term.compiled_for(lanes, in_loop)
        step_end = None if self.step_end is None else StepEnd(term.dynamics)
        return replace(self, term=term, step_end=step_end)

    def within(self, args: Any, tau: Array) -> Any:
        """The arguments of a step from tau."""
        return self.windows(args, tau)[0]

    def is_sound(self, memory: Any) -> Bool[Array, ""]:
        """Whether the first stage is finite, if it is the state carried from step to step."""
        explicit = isinstance(self.solver, AbstractExplicit)
        return all_finite(memory) if explicit and memory is not None else jnp.array(True)

    def for_derivatives(self, y: Array, args: Any) -> "Stepper":
        """The stepper for a motion of which derivatives are taken.

        At rest or in steady motion, to the accuracy of the error estimates, steps have any length,
        although perturbations turn or grow. The same holds if the fastest modes are at rest beside
        slower ones. Steps are then bounded by the time in which the fastest perturbations turn or
        grow by an amount that their own error estimate would detect. Other motions keep their
        steps. Implicit methods need not resolve decay: their steps are bounded only on CPU, at
        rest, and for perturbations that turn or grow.

        At kinks of forces perturbations jump: steps have a tighter bound (`held_to`).
        """
        controller: Any = self.controller
        if type(controller) is not diffrax.PIDController:
            return self
        zero = jnp.zeros_like(args.origin)
        compares = isinstance(self.term, Term) and self._compares(zero, y, args)
        stepper = replace(self, across=True) if compares else self
        return stepper._bounded_at_rest(y, args)

    def _bounded_at_rest(self, y: Array, args: Any) -> "Stepper":
        """Bound the steps if error estimates do not detect the growth of perturbations."""
        controller: Any = self.controller
        explicit = not self.implicit
        if controller.dtmax is not None or not (explicit or jax.default_backend() == "cpu"):
            return self
        zero = jnp.zeros_like(args.origin)
        y, args = jax.lax.stop_gradient((y, self.within(args, zero)))

        def field(y: Array) -> Array:
            rates = self.term.vf(zero, y, args)
            outcomes = self._branches(zero, y, args) if self.across else None
            return rates if outcomes is None else jnp.append(rates, outcomes.astype(rates.dtype))

        solver: Any = self.solver
        order = float(solver.error_order(self.term))
        longest = longest_step(field, y, controller, order, explicit).astype(zero.dtype)
        longest = longest if self.longest is None else jnp.minimum(longest, self.longest)
        return replace(self, longest=longest)

    def begin(self, t0: Array, t1: Array, y: PyTree, args: Any) -> Any:
        """Solver state with nothing carried over from the step before."""
        return self.solver.init(self.term, t0, t1, y, self.within(args, t0))

    def afresh(self, t0: Array, t1: Array, y: PyTree, args: Any) -> tuple[Any, Any]:
        """(solver state, whether there was a jump) for a step without carried-over state."""
        if isinstance(self.solver, AbstractExplicit):
            return None, True
        return self.begin(t0, t1, y, args), jnp.array(True)

    def step(
        self,
        t0: Array,
        t1: Array,
        y: PyTree,
        args: Any,
        memory: Any,
        jump: Any,
        crossing: Crossing | None = None,
    ) -> tuple[PyTree, Estimate, Any, Bool[Array, "..."]]:
        """(y1, its error, solver state, whether implicit equations were solved).

        Near a change point the stages are moved onto the constraints, too.
        """
        step = t0, t1, y, args, memory, jump
        if args.lengths is None:
            return self._step(*step)
        step_end = cast(StepEnd, self.step_end)
        independence = (
            step_end.independence(t0, y, args) if crossing is None else crossing.independence
        )
        near = independence < (AHEAD if self.controller is None else SHORT)
        held = self._held(near)
        if not isinstance(self.solver, AbstractExplicit) or self.solver.looped:
            return held._step(*step)
        # A second unrolled copy of every stage would take long to compile.
        held = replace(held, solver=replace(self.solver, looped=True))
        plain = self._step(*step)

        def chosen() -> Any:
            return jax.tree.map(partial(jnp.where, near), held._step(*step), plain)

        return jax.lax.cond(eqxi.unvmap_any(near), chosen, lambda: plain)

    def _held(self, near: Array) -> "Stepper":
        """The stepper with stages moved onto the constraints in a step near a change point."""
        term = cast(Term, self.term)
        step_end = StepEnd(term.seldom.dynamics)
        refuses = self.controller is None and not self.implicit

        @jax.checkpoint  # residuals of a branch would be stored for all steps
        def closer(t: Array, y: Array, args: Any) -> Array:
            return jnp.where(near, step_end.stage(t, y, args, refuses), y)

        def field(t: Any, y: Any, args: Any) -> Array:
            y = jax.lax.cond(eqxi.unvmap_any(near), closer, lambda t, y, args: y, t, y, args)
            return term.vf(t, y, args)

        return replace(self, term=Term(field, term.dynamics, term.lines, term.dtype))

    def _step(
        self, t0: Array, t1: Array, y: PyTree, args: Any, memory: Any, jump: Any
    ) -> tuple[PyTree, Estimate, Any, Bool[Array, "..."]]:
        """(y1, its error, solver state, whether implicit equations were solved)."""
        if self.moves:
            # The projection has changed the state: the last stage cannot be reused.
            jump = True if isinstance(self.solver, AbstractExplicit) else jnp.array(True)
        if remembers(self.solver) and jump is not False:
            # The remembered values are from before the jump.
            fresh = self.solver.init(self.term, t0, t1, y, args)
            memory = jax.tree.map(partial(jnp.where, jump), fresh, memory)
        if isinstance(self.solver, AbstractExplicit) and self.solver.steps_as_declared:
            y1, error, beside, k, memory = self.solver.attempt(
                self.term, t0, t1, y, args, memory, jump
            )
            return y1, Estimate(error, beside, self._slope_drop(k)), memory, jnp.array(True)
        y1, error, dense, memory, result = self.solver.step(
            self.term, t0, t1, y, args, memory, jump
        )
        solved = result == diffrax.RESULTS.successful
        tableau = explicit_tableau(self.solver)
        if self.controller is None or tableau is None:
            return y1, Estimate(error), memory, solved
        stages = unweighted_stages(tableau.b_sol, tableau.b_error)
        beside = unseen(unstacked(dense["k"]), stages) if stages else None
        return y1, Estimate(error, beside, self._slope_drop(dense["k"])), memory, solved

    def _slope_drop(self, k: PyTree) -> PyTree:
        """h dy/dt at the start minus that at the end; None if it is not needed."""
        return k[0] - k[-1] if self.across or self.passes else None

    def _compares(self, tau: Array, y: Array, args: Any) -> bool:
        """Whether the declaration contains comparisons; found without computing them."""
        found: Any = jax.eval_shape(lambda: self._branches(tau, y, args))
        return found is not None

    def _branches(self, tau: Array, y: Array, args: Any) -> Array | None:
        """Outcomes of the comparisons in the declaration."""
        term: Any = self.term
        return branches(term.dynamics, tau, y, self.within(args, tau))

    def held_to(
        self,
        t0: Array,
        t1: Array,
        y0: Array,
        y1: Array,
        args: Any,
        estimate: Estimate,
        spare: Array,
    ) -> PyTree:
        """The error that the controller bounds; `across` a kink, also that of the derivative.

        At a kink of a force its derivative jumps by J. A step of h across it has an error of order
        h^2 J in the state and of order h J in perturbations: the former over the length of the
        step. If the outcome of a comparison in the middle or at the end of a step differs from that
        at its start, the error is therefore bounded by a part of the change over the step,

            |error| <= rtol |y1 - y0| / 100     in the controller's norm.

        The factor is a hundredth because the estimate, made for smooth functions, is a small part
        of the error there. Steps near the resolution of time are bounded by their own error; so are
        all steps if there are none to `spare`.
        """
        error = at_least(estimate.error, estimate.unseen)
        if not self.across:
            return error
        controller: Any = self.controller
        allowed = controller.atol + controller.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
        part = _ACROSS * controller.rtol * controller.norm((y1 - y0) / allowed)
        places = (t0, y0), midway(t0, t1, y0, y1, estimate.slope_drop), (t1, y1)
        before, between, after = (self._branches(tau, y, args) for tau, y in places)
        crossed = jnp.any(before != between) | jnp.any(between != after)
        span = jnp.abs(args.end - args.origin)
        bounded = (
            spare & crossed & (part > 0) & (t1 - t0 > _FINE * (resolution(span) + resolution(t1)))
        )
        return error / jnp.where(bounded, jnp.minimum(part, 1.0), 1.0)

    def is_small(
        self, y0: PyTree, y1: PyTree, error: PyTree | None, tolerances: float
    ) -> Bool[Array, ""]:
        """Whether the error of a step to a save time, which no control rejects, is small.

        The step is part of an accepted one. If its error estimate is `SINGULAR` tolerances, the
        field is singular or jumps at the save time.
        """
        controller = self.controller
        if error is None or not isinstance(controller, diffrax.PIDController):
            return jnp.array(True)

        def small(y0: Array, y1: Array, error: Array) -> Array:
            allowed = controller.atol + controller.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
            return jnp.all(jnp.abs(error) <= tolerances * allowed)

        return jax.tree.reduce(jnp.logical_and, jax.tree.map(small, y0, y1, error))

    def through(self, t0: Array, y0: Array, t1: Array, y1: Array, t: Array, args: Any) -> Array:
        """The state at t by the Hermite polynomial through two others."""
        ends, term = (jnp.stack([t0, t1]), jnp.stack([y0, y1])), cast(Term, self.term).seldom
        dynamics = term.dynamics

        def at(end: tuple[Array, Array]) -> tuple[Array, Array | None]:
            f = cast(Array, term.vf(*end, args))
            return f, dynamics.curvature_of_states(*end, f, args)

        (f0, f1), curved = jax.lax.map(at, ends)  # one copy of the vector field to compile
        return hermite(t0, y0, f0, t1, y1, f1, t, dynamics.system.size, curved)

    def reached(
        self, t0: Array, y0: Array, t1: Array, y1: Array, t: Array, far: Array, args: Any
    ) -> Array:
        """The state at t by the polynomial from t0 to t1 if `far`; else the state at t1."""
        through = lambda: jnp.where(far, self.through(t0, y0, t1, y1, t, args), y1)  # noqa: E731
        return jax.lax.cond(eqxi.unvmap_any(far), through, lambda: y1)

    def determinants(self, tau: Array, y: Array, args: Any) -> Array | None:
        """Determinants that detect singular quasi-velocities; None if these are always regular."""
        if not self.passes:
            return None
        dynamics = cast(Term, self.term).dynamics
        return determinants(dynamics, tau, dynamics.parts(y)[0], self.within(args, tau))

    def passage(self, *step: Any) -> Passage | None:
        """Check of quasi-velocities along a step; None if they are always regular.

        Args:
            step: (t0, t1, y0, y1, args, slope_drop, determinants at its start).
        """
        if not self.passes:
            return None
        controller, dtype, tolerance = self.controller, step[3].dtype, None
        if isinstance(controller, diffrax.PIDController):
            bounds: Any = controller.rtol, controller.atol
            tolerance = jnp.maximum(*(jnp.max(jnp.asarray(x, dtype)) for x in bounds))
        elif controller is not None:
            tolerance = jnp.ones((), dtype)
        return passage(cast(Term, self.term).dynamics, tolerance, *step)

    def same_sense(self, *step: Any) -> Bool[Array, ""]:
        """Whether a step passes no change point; True if it may pass one.

        Args:
            step: (t0, t1, y0, y1, args, slope_drop).
        """
        return same_sense(cast(Term, self.term).dynamics, *step) if self.stops else jnp.array(True)

    def settled(
        self, t: Array, y: PyTree, args: Any, differentiable: bool = False
    ) -> tuple[PyTree, StepChecks]:
        """The accepted state at the end of a step, and its checks."""
        if self.step_end is None:
            true = jnp.array(True)
            return y, StepChecks(true, true, true)
        return self.step_end(t, y, args, differentiable)

    def settled_with_error(
        self,
        t0: Array,
        t: Array,
        y0: PyTree,
        y: PyTree,
        args: Any,
        estimate: Estimate,
        crossing: Crossing | None,
        bound: Array,
    ) -> tuple[PyTree, StepChecks, Estimate, Crossing | None]:
        """The same, with the error of the accepted state and the detection of change points.

        Near a change point shorter steps do not reduce the rounding of projected states. A step
        that need not end close to it is repeated with a shorter length.

        Args:
            t0: start of the step.
            t: its end.
            y0: state at its start.
            y: state at its end.
            args: arguments of the step.
            estimate: the error of y.
            crossing: detection at the start of the step.
            bound: whether the step has to end at t.
        """
        if crossing is None:
            return *self.settled(t, y, args), estimate, None
        step_end, error, unseen = cast(StepEnd, self.step_end), estimate.error, estimate.unseen
        if error is None:
            y, checks = step_end(t, y, args)
        else:
            y, checks, error, surface = step_end.with_error(
                t, y, args, cast(Array, error), crossing.is_near
            )
        assert checks.independence is not None
        parts = cast(Term, self.term).dynamics.parts
        (q0, _), (q, v) = parts(y0), parts(y)
        ends = crossing.onwards(t0, t, checks.independence, (q - q0) / args.units)
        if error is None:
            return y, checks, estimate, ends
        beyond = jnp.zeros_like(y[2 * q.size :])
        rounding = jnp.concatenate([*ends.rounding(q, v, surface, args), beyond])
        error = jnp.where(jnp.abs(error) <= rounding, 0.0, error)
        if unseen is not None:
            noise = jnp.concatenate([*ends.noise(v, args), beyond])
            unseen = jnp.where(unseen <= noise, 0.0, unseen)
        controller = self.controller
        if isinstance(controller, diffrax.PIDController):
            again = ends.is_beside(crossing) & ~bound
            least = AGAIN * (controller.atol + controller.rtol * jnp.abs(y))
            error = jnp.where(again, jnp.maximum(jnp.abs(error), least), error)
        return y, checks, estimate._replace(error=error, unseen=unseen), ends

    def start(
        self, t0: Array, t1: Array, y: PyTree, args: Any, guess: Array | None
    ) -> tuple[Any, Array, Array, Any]:
        """(solver state, whether it is finite, first adaptive step, the controller's state)."""
        inside = self.within(args, t0)
        controller: Any = self.controller
        estimated = guess is None and type(controller) is diffrax.PIDController
        if not estimated or not isinstance(self.solver, AbstractExplicit):
            memory = self.begin(t0, t1, y, args)
            return (
                memory,
                self.is_sound(memory),
                *first_step(self.solver, controller, self.term, t0, t1, y, inside, guess),
            )
        order = controller.error_order or self.solver.error_order(self.term)
        term = self.term.seldom if isinstance(self.term, Term) else self.term

        def field(t: Array, y: Array) -> Array:
            return term.vf(t, y, inside)

        slope, h = slope_and_step(field, t0, y, controller, float(order))
        at = jnp.asarray(t0, y.dtype)
        end, state = controller.init(
            self.term, at, t1.astype(y.dtype), y, h, inside, self.solver.func, order
        )
        memory = slope if self.solver.shares_stages else None
        return memory, all_finite(slope), jnp.asarray(end - at, t0.dtype), state


_FINE = 64.0  # resolutions of time
_ACROSS = 0.01  # bound on the error across a kink over the change in the step, in tolerances


def all_finite(y: PyTree) -> Bool[Array, ""]:
    """Whether all numbers of a state are finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]))


def resolution(t: Array) -> Array:
    """8 eps |t|: differences of times near t below this are only rounding."""
    return 8 * jnp.finfo(t.dtype).eps * jnp.abs(t)
