"""How one step is taken, settled and followed by the next."""

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

SINGULAR = 1e3  # tolerances that no part of an accepted step is off by in a smooth field


class Estimate(NamedTuple):
    """What a step says of its error.

    Attributes:
        error: its estimate; None of methods that have none.
        unseen: what that takes no notice of; None where there is nothing.
        turn: h dy/dt at the start less that at the end; None where nobody asks, or it is not known.
    """

    error: PyTree
    unseen: PyTree | None = None
    turn: PyTree | None = None
    near: Bool[Array, ""] | None = None


class Stepper(eqx.Module):
    """How one step is taken and the next one chosen; with no controller steps are fixed."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    term: diffrax.AbstractTerm
    # (args, tau) -> (args of a step from tau, where entries of tables begin in them)
    windows: Callable = eqx.field(static=True)
    # (tau, y, args, differentiable) -> (the end of a step as it is kept, StepChecks)
    step_end: Callable | None = eqx.field(static=True, default=None)
    moves: bool = eqx.field(static=True, default=False)  # whether `step_end` moves the state
    longest: Array | None = None  # bound on adaptive steps
    # whether steps in which a comparison comes out otherwise are held to what derivatives need
    across: bool = eqx.field(static=True, default=False)
    # whether quasi-velocities may become singular on the way
    passes: bool = eqx.field(static=True, default=False)
    # whether steps end before places where rows depend on one another
    stops: bool = eqx.field(static=True, default=False)

    @property
    def implicit(self) -> bool:
        """Whether equations may be solved in a step."""
        return not isinstance(self.solver, AbstractExplicit | Splitting | diffrax.AbstractERK)

    @property
    def gap(self) -> float:
        """Where in a step a change point is far from all stages."""
        return widest_gap(nodes_of(self.solver))

    @property
    def standard(self) -> bool:
        """Whether steps are fixed or chosen by diffrax's own control, not a variant of it."""
        return self.controller is None or type(self.controller) is diffrax.PIDController

    def on_scalars(self, lanes: bool = False, in_loop: bool = True) -> "Stepper | None":
        """The form for loops that are one native function, where there is one.

        Args:
            lanes: whether it is going to be vmapped.
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
        """Whether the first stage is finite, where that is what is carried from step to step."""
        explicit = isinstance(self.solver, AbstractExplicit)
        return all_finite(memory) if explicit and memory is not None else jnp.array(True)

    def for_derivatives(self, y: Array, args: Any) -> "Stepper":
        """The stepper for a motion of which derivatives are taken.

        A motion that starts at rest or moves steadily, up to what error estimates do not see, takes
        steps of any length, though perturbations of it turn or grow; and so does one whose fastest
        motions are at rest, beside slower ones. Its steps are bounded by the time in which the
        fastest perturbations turn or grow, as their own error estimate would have it. Other motions
        keep their steps. Implicit methods need not follow what decays: theirs are bounded, on CPU,
        at rest alone and by what turns or grows.

        Where forces may bend, perturbations jump: steps are held to more (`held_to`).
        """
        controller: Any = self.controller
        if type(controller) is not diffrax.PIDController:
            return self
        zero = jnp.zeros_like(args.origin)
        compares = isinstance(self.term, Term) and self._compares(zero, y, args)
        stepper = replace(self, across=True) if compares else self
        return stepper._bounded_at_rest(y, args)

    def _bounded_at_rest(self, y: Array, args: Any) -> "Stepper":
        """With steps bounded where error estimates do not see what perturbations do."""
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
        """Solver state with nothing carried over from a step before."""
        return self.solver.init(self.term, t0, t1, y, self.within(args, t0))

    def afresh(self, t0: Array, t1: Array, y: PyTree, args: Any) -> tuple[Any, Any]:
        """(solver state, whether there was a jump) for a step that takes nothing over."""
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

        Near a change point stages are moved onto the constraints, too.
        """
        step = t0, t1, y, args, memory, jump
        if args.lengths is None:
            return self._step(*step)
        step_end = cast(StepEnd, self.step_end)
        apart = step_end.apart(t0, y, args) if crossing is None else crossing.apart
        near = apart < (AHEAD if self.controller is None else SHORT)
        held = self._held(near)
        if not isinstance(self.solver, AbstractExplicit) or self.solver.looped:
            return held._step(*step)
        # Another copy of every stage would take long to compile.
        held = replace(held, solver=replace(self.solver, looped=True))
        plain = self._step(*step)

        def chosen() -> Any:
            return jax.tree.map(partial(jnp.where, near), held._step(*step), plain)

        return jax.lax.cond(eqxi.unvmap_any(near), chosen, lambda: plain)

    def _held(self, near: Array) -> "Stepper":
        """The stepper with stages on the constraints in a step that is near a change point."""
        step_end, term = cast(StepEnd, self.step_end), cast(Term, self.term)
        refuses = self.controller is None and not self.implicit

        @jax.checkpoint  # what transposes keep of a branch is copied in all steps
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
            # The state is not the one that the last step ended in: its last stage is of no use.
            jump = True if isinstance(self.solver, AbstractExplicit) else jnp.array(True)
        if remembers(self.solver) and jump is not False:
            # What was remembered is of the other side.
            fresh = self.solver.init(self.term, t0, t1, y, args)
            memory = jax.tree.map(partial(jnp.where, jump), fresh, memory)
        if isinstance(self.solver, AbstractExplicit) and self.solver.steps_as_declared:
            y1, error, beside, k, memory = self.solver.attempt(
                self.term, t0, t1, y, args, memory, jump
            )
            return y1, Estimate(error, beside, self._turn(k)), memory, jnp.array(True)
        y1, error, dense, memory, result = self.solver.step(
            self.term, t0, t1, y, args, memory, jump
        )
        solved = result == diffrax.RESULTS.successful
        tableau = explicit_tableau(self.solver)
        if self.controller is None or tableau is None:
            return y1, Estimate(error), memory, solved
        stages = unweighted_stages(tableau.b_sol, tableau.b_error)
        beside = unseen(unstacked(dense["k"]), stages) if stages else None
        return y1, Estimate(error, beside, self._turn(dense["k"])), memory, solved

    def _turn(self, k: PyTree) -> PyTree:
        """h dy/dt at the start less that at the end, where it is asked for."""
        return k[0] - k[-1] if self.across or self.passes else None

    def _compares(self, tau: Array, y: Array, args: Any) -> bool:
        """Whether there are comparisons in what is declared; nothing is computed for that."""
        found: Any = jax.eval_shape(lambda: self._branches(tau, y, args))
        return found is not None

    def _branches(self, tau: Array, y: Array, args: Any) -> Array | None:
        """Outcomes of the comparisons in what is declared."""
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
        """The error that the controller bounds; `across` a bend, that of the derivative, too.

        Where a force bends, its derivative jumps by J. A step of h across leaves an error of order
        h^2 J in the state, and one of order h J in perturbations of it: the former over the length
        of the step. So in a step in which a comparison comes out otherwise at its end than at its
        start, or in its middle, the error is bounded by a part of the change over the step,

            |error| <= rtol |y1 - y0| / 100     in the controller's norm;

        a hundredth, as the estimate is a small part of the error there: it is that of rules for
        functions without a bend. Steps near what times can resolve, and all of them where there are
        none to `spare`, are bounded by their own error.
        """
        error = at_least(estimate.error, estimate.unseen)
        if not self.across:
            return error
        controller: Any = self.controller
        allowed = controller.atol + controller.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
        part = _ACROSS * controller.rtol * controller.norm((y1 - y0) / allowed)
        places = (t0, y0), midway(t0, t1, y0, y1, estimate.turn), (t1, y1)
        before, between, after = (self._branches(tau, y, args) for tau, y in places)
        crossed = jnp.any(before != between) | jnp.any(between != after)
        span = jnp.abs(args.end - args.origin)
        told = (
            spare & crossed & (part > 0) & (t1 - t0 > _FINE * (resolution(span) + resolution(t1)))
        )
        return error / jnp.where(told, jnp.minimum(part, 1.0), 1.0)

    def is_small(
        self, y0: PyTree, y1: PyTree, error: PyTree | None, tolerances: float
    ) -> Bool[Array, ""]:
        """Whether the error of a step to a save time, which no control rejects, is below so many.

        It is part of one that was accepted: an error estimate of `SINGULAR` times what is allowed
        is that of a field which is singular, or jumps, at the save time.
        """
        controller = self.controller
        if error is None or not isinstance(controller, diffrax.PIDController):
            return jnp.array(True)

        def small(y0: Array, y1: Array, error: Array) -> Array:
            allowed = controller.atol + controller.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
            return jnp.all(jnp.abs(error) <= tolerances * allowed)

        return jax.tree.reduce(jnp.logical_and, jax.tree.map(small, y0, y1, error))

    def through(self, t0: Array, y0: Array, t1: Array, y1: Array, t: Array, args: Any) -> Array:
        """The state at t by a polynomial through two others."""
        ends = jnp.stack([t0, t1]), jnp.stack([y0, y1])
        # A loop, as another copy of the vector field would take long to compile.
        f0, f1 = jax.lax.map(lambda end: cast(Array, self.term.vf(end[0], end[1], args)), ends)
        n = cast(Term, self.term).dynamics.system.size
        return hermite(t0, y0, f0, t1, y1, f1, t, n)

    def reached(
        self, t0: Array, y0: Array, t1: Array, y1: Array, t: Array, far: Array, args: Any
    ) -> Array:
        """The state at t, by a step from t0 to t1, where that is `far`: else the one at t1."""
        through = lambda: jnp.where(far, self.through(t0, y0, t1, y1, t, args), y1)  # noqa: E731
        return jax.lax.cond(eqxi.unvmap_any(far), through, lambda: y1)

    def determinants(self, tau: Array, y: Array, args: Any) -> Array | None:
        """What tells singular quasi-velocities; None where they never are."""
        if not self.passes:
            return None
        dynamics = cast(Term, self.term).dynamics
        return determinants(dynamics, tau, dynamics.parts(y)[0], self.within(args, tau))

    def passage(self, *step: Any) -> Passage | None:
        """What becomes of v and u along a step: `_quasi_singularities.passage`; None where nothing.

        Args:
            step: (t0, t1, y0, y1, args, turn, determinants at its start).
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
        """Whether a step passes no change point, where it is not to.

        Args:
            step: (t0, t1, y0, y1, args, turn).
        """
        return same_sense(cast(Term, self.term).dynamics, *step) if self.stops else jnp.array(True)

    def settled(
        self, t: Array, y: PyTree, args: Any, differentiable: bool = False
    ) -> tuple[PyTree, StepChecks]:
        """The end of a step as it is kept, and what is to be said about it."""
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
        """The same, the error of the state that is kept, and what is known of change points there.

        Rounding of what is projected near such a place is not made less by shorter steps. A step
        that need not end beside it is taken again, shorter.

        Args:
            t0: start of the step.
            t: its end.
            y0: state at its start.
            y: state at its end.
            args: arguments of the step.
            estimate: the error of y.
            crossing: what is known at the start of the step.
            bound: whether it has to end there.
        """
        if crossing is None:
            return *self.settled(t, y, args), estimate, None
        step_end, error, unseen = cast(StepEnd, self.step_end), estimate.error, estimate.unseen
        if error is None:
            y, checks = step_end(t, y, args)
        else:
            y, checks, error = step_end.with_error(t, y, args, cast(Array, error), crossing.is_near)
        assert checks.apart is not None
        parts = cast(Term, self.term).dynamics.parts
        (q0, _), (q, v) = parts(y0), parts(y)
        ends = crossing.onwards(t0, t, checks.apart, (q - q0) / args.units)
        if error is None:
            return y, checks, estimate, ends
        assert checks.columns is not None
        beyond = jnp.zeros_like(y[2 * q.size :])
        rounding = jnp.concatenate([*ends.rounding(q, v, checks.columns, args), beyond])
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

        def field(t: Array, y: Array) -> Array:
            return self.term.vf(t, y, inside)

        slope, h = slope_and_step(field, t0, y, controller, float(order))
        at = jnp.asarray(t0, y.dtype)
        end, state = controller.init(
            self.term, at, t1.astype(y.dtype), y, h, inside, self.solver.func, order
        )
        memory = slope if self.solver.shares_stages else None
        return memory, all_finite(slope), jnp.asarray(end - at, t0.dtype), state


_FINE = 64.0  # resolutions of time
_ACROSS = 0.01  # of the change that an error across a bend may be, in tolerances


def all_finite(y: PyTree) -> Bool[Array, ""]:
    """Whether all numbers of a state are finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(y)]))


def resolution(t: Array) -> Array:
    """Below this a difference of times near t means nothing: 8 eps |t|."""
    return 8 * jnp.finfo(t.dtype).eps * jnp.abs(t)
