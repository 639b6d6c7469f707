"""How one step is taken, settled and followed by the next."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Bool, PyTree

from jaxlag._step import Verdict
from jaxlag._term import Term
from jaxlag.solvers import AbstractFixedStep, AbstractUnrolled, Splitting


class Scheme(eqx.Module):
    """How one step is taken and the next one chosen; with no controller steps are fixed."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    term: diffrax.AbstractTerm
    intervals: Callable = eqx.field(static=True)  # (args, tau) -> args of a step around tau
    # (tau, y, args, differentiable) -> (the end of a step as it is kept, Verdict)
    settle: Callable | None = eqx.field(static=True, default=None)
    moves: bool = eqx.field(static=True, default=False)  # whether `settle` moves the state
    longest: Array | None = None  # bound on adaptive steps

    @property
    def remembers(self) -> bool:
        """Whether the solver is a multistep method."""
        return remembers(self.solver)

    @property
    def standard(self) -> bool:
        """Whether steps are fixed or chosen by diffrax's own control, not a variant of it."""
        return self.controller is None or type(self.controller) is diffrax.PIDController

    def by_element(self, lanes: bool = False, in_loop: bool = True) -> "Scheme | None":
        """The form for states that are tuples of their elements, where there is one.

        Args:
            lanes: whether it is going to be vmapped.
            in_loop: whether it is for a loop over one trajectory or a few lanes.
        """
        term = self.term.by_element(lanes, in_loop) if isinstance(self.term, Term) else None
        # Controllers and norms that the user brings may want the state as an array.
        norm = getattr(self.controller, "norm", optimistix.rms_norm)
        if term is None or not isinstance(self.solver, AbstractUnrolled | Splitting):
            return None
        if not (self.standard and norm is optimistix.rms_norm):
            return None
        dynamics: Any = term.elementwise
        settle = None if self.settle is None else dynamics.settle
        return replace(self, term=term, settle=settle)

    def for_derivatives(self, t0: Array, y: Array, args: Any) -> "Scheme":
        """The scheme for a motion of which derivatives are taken.

        A motion that starts at rest or moves steadily, up to what error estimates do not see, takes
        steps of any length, though perturbations of it turn or grow: its steps are bounded by the
        time in which the fastest do, as their own error estimate would have it. Other motions keep
        their steps, and so do implicit methods, which need not follow what decays.
        """
        controller: Any = self.controller
        explicit = isinstance(self.solver, AbstractUnrolled | diffrax.AbstractERK)
        bounded = type(controller) is diffrax.PIDController and controller.dtmax is None
        if not explicit or not bounded:
            return self
        args = self.intervals(args, t0 + resolution(t0))
        t0, y, args = jax.lax.stop_gradient((t0, y, args))

        f, J = linearized(lambda y: self.term.vf(t0, y, args), y)
        rate = _rate(J)
        allowed = _UNSEEN * (controller.atol + controller.rtol * jnp.abs(y))
        unseen = jnp.all(jnp.abs(J @ f) < rate**2 * allowed) & jnp.isfinite(rate)
        solver: Any = self.solver
        order = float(solver.error_order(self.term))
        eps = jnp.finfo(y.dtype).eps
        part = (jnp.maximum(controller.rtol, eps) * math.gamma(order + 1)) ** (1 / order)
        longest = jnp.where(unseen, part / rate, jnp.inf).astype(t0.dtype)
        return replace(self, longest=longest)

    def begin(self, t0: Array, t1: Array, y: PyTree, args: Any) -> Any:
        """Solver state with nothing carried over from a step before."""
        return self.solver.init(self.term, t0, t1, y, self.intervals(args, t0 + resolution(t0)))

    def step(
        self, t0: Array, t1: Array, y: PyTree, args: Any, memory: Any, jump: Any
    ) -> tuple[PyTree, PyTree, Any, Bool[Array, "..."]]:
        """(y1, error estimate or None, solver state, whether implicit equations were solved)."""
        args = self.intervals(args, t0 + 0.5 * (t1 - t0))
        if self.moves:
            # The state is not the one that the last step ended in: its last stage is of no use.
            jump = jnp.array(True)
            if isinstance(self.solver, AbstractUnrolled):
                memory, jump = self.solver.init(self.term, t0, t1, y, args), False
        y1, error, _, memory, result = self.solver.step(self.term, t0, t1, y, args, memory, jump)
        return y1, error, memory, result == diffrax.RESULTS.successful

    def settled(
        self, t: Array, y: PyTree, args: Any, differentiable: bool = False
    ) -> tuple[PyTree, Verdict]:
        """The end of a step as it is kept, and what is to be said about it."""
        if self.settle is None:
            true = jnp.array(True)
            return y, Verdict(true, true, true)
        return self.settle(t, y, args, differentiable)

    def first_step(
        self, t0: Array, t1: Array, y: PyTree, args: Any, guess: Array | None
    ) -> tuple[Array, Any]:
        """Length of the first adaptive step, and the controller's state."""
        assert self.controller is not None
        args = self.intervals(args, t0 + resolution(t0))
        order = self.solver.error_order(self.term)
        dtype = jnp.result_type(*jax.tree.leaves(y))
        if dtype == t0.dtype:
            end, state = self.controller.init(
                self.term, t0, t1, y, guess, args, self.solver.func, order
            )
            return jnp.asarray(end - t0), state

        # diffrax estimates a first step only where time and state share a dtype: count from t0.
        def func(term: Any, elapsed: Any, y: PyTree, args: Any) -> PyTree:
            return self.solver.func(term, t0 + jnp.asarray(elapsed, t0.dtype), y, args)

        guess = None if guess is None else guess.astype(dtype)
        zero = jnp.zeros_like(t0, dtype)
        span = (t1 - t0).astype(dtype)
        end, state = self.controller.init(self.term, zero, span, y, guess, args, func, order)
        return jnp.asarray(end, t0.dtype), state


_UNSEEN = 1e3  # tolerances: an error estimate that sees no more says nothing of perturbations


def remembers(solver: diffrax.AbstractSolver) -> bool:
    """Whether the solver's state is more than a function of (t, y), as in multistep methods."""
    one_step = diffrax.AbstractRungeKutta | AbstractUnrolled | AbstractFixedStep
    return not isinstance(solver, one_step)


def linearized(field: Callable, y: Array) -> tuple[Array, Array]:
    """(f, df/dy) at y by differences: half the digits, and compiled in a fraction of the time."""
    beside = jnp.sqrt(jnp.finfo(y.dtype).eps) * (1.0 + jnp.abs(y))
    states = jnp.concatenate([y[None], y + jnp.diag(beside)])
    f, *others = jax.lax.map(field, states)
    return f, (jnp.stack(others, 1) - f[:, None]) / beside


def _rate(J: Array) -> Array:
    """About the spectral radius: the 16th root of the size of J^16, which units hardly matter to.

    Scaled on the way, as the power of a rate may leave the range of numbers.
    """
    power, rate = J, jnp.ones((), J.dtype)
    for k in range(5):
        power = power if k == 0 else power @ power
        size = jnp.max(jnp.abs(power))
        power = power / jnp.where(size > 0, size, 1.0)
        rate = rate * size ** (0.5**k)
    return rate


def with_stages(solver: Any, kind: str) -> Any:
    """A Runge-Kutta solver, wrapped or not, with its loop over stages of the given kind.

    "lax" for solving, "bounded" (a scan, which every derivative passes) for replaying, where
    stages written out would be compiled many times over.
    """
    if isinstance(solver, diffrax.HalfSolver):
        return eqx.tree_at(lambda s: s.solver, solver, with_stages(solver.solver, kind))
    if isinstance(solver, AbstractUnrolled):
        return solver if kind == "lax" else with_stages(solver.stock, kind)
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


def resolution(t: Array) -> Array:
    """Below this a difference of times near t means nothing: 8 eps |t|."""
    return 8 * jnp.finfo(t.dtype).eps * jnp.abs(t)
