"""Explicit Runge-Kutta methods, unrolled stage by stage or in a loop over their stages."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache, reduce
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxlag._core._arrays import elements
from jaxlag._core._xla import opaque_one
from jaxlag.solvers._unweighted_stages import at_least, unseen, unstacked, unweighted_stages

# Lines of dy/dt times stages up to which steps are unrolled. Measured with order 8, seconds of
# tracing and compiling and microseconds per step, unrolled | in a loop: elastic pendulum (21
# lines) 0.9, 0.25 | 0.6, 0.37; heavy top (39) 1.2, 0.44 | 1.1, 0.87; 3 links (85) 1.7, 1.2 | 0.7,
# 1.8; 4 links (156) 2.0, 1.5 | 0.8, 1.6; 15 coordinates of 5 bodies (223) 2.4, 2.2 | 0.8, 2.0;
# double pendulum with constraints (242) 4.9, 0.7 | 3.1, 1.3; aircraft (366) 5.4, 4.7 | 2.9, 5.5; 6
# links (375) 4.8, 2.6 | 1.5, 2.3.
WRITTEN_OUT = 1600


def in_loop_over_stages(lines: int | None, stages: int) -> bool:
    """Whether a step is a loop over its stages: the program then contains dy/dt once.

    Args:
        lines: number of lines of straight-line code for dy/dt; None for a program on arrays.
        stages: number of stages of the method.
    """
    return lines is None or lines * stages > WRITTEN_OUT


class AbstractExplicit(diffrax.AbstractAdaptiveSolver):
    """An explicit Runge-Kutta method.

    k_i = f(t + c_i h, y + h sum_{j<i} a_ij k_j), y1 = y + h sum_i b_i k_i; the error estimate is
    h sum_i e_i k_i. The units are those of the problem; y is any pytree of arrays.

    Unrolled, a stage is a sum of the stages before it without the zeros of the tableau. A step is
    then straight-line code, and a loop of steps over a small system is one function
    without calls. In a loop over stages the program contains f once: it compiles in a fraction of
    the time, and runs as fast if f is long.

    If the terms are of `second_order`, y = (q, v) with dq/dtau = sigma v, dv/dtau
    = sigma a, sigma = -1 if time runs backwards, an unrolled step has
    Nystrom's form with k_i = sigma a_i,

        v_i = v + h sum_j a_ij k_j,    q_i = q + h sigma (c_i v + h sum_j (A A)_ij k_j).

    This is the same method, but stages are coupled only by accelerations, and q_i does not depend
    on the previous stage: its sines and cosines can be computed earlier. If terms are compiled to
    be used `in_lanes`, every number of the state is a row of lanes, and sums are of such rows, not
    of tables.

    The last stage of a method whose last row of the tableau is its weights (FSAL) is the first
    one of the next step.

    Steps, error estimates and interpolation are those of `stock`, up to the order of sums. But if
    stages without weight meet a force that the others miss, the estimate is larger, see
    `unseen`: no step passes through a wall that one of its stages met. With a
    loop over stages, reverse derivatives need `made_jump` to be known while tracing.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.1, II.14.

    Attributes:
        looped: whether there is a loop over stages. None: the faster choice in `simulate`, and
            unrolled elsewhere.
    """

    looped: bool | None = eqx.field(static=True, default=None)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable]

    @property
    @abstractmethod
    def stock(self) -> diffrax.AbstractERK:
        """The same method as a class of diffrax."""

    @property
    def stages(self) -> int:
        """Number of stages that a step evaluates."""
        tableau = tableau_of(type(self))
        return len(tableau.rows) + (0 if tableau.fsal else 1)

    @property
    def shares_stages(self) -> bool:
        """Whether the last stage of a step is the first one of the next."""
        return tableau_of(type(self)).fsal

    @property
    def steps_as_declared(self) -> bool:
        """Whether a step is that of the coefficients, and no subclass overrides it."""
        return type(self).step is AbstractExplicit.step

    def order(self, terms: Any) -> int:
        """Order of the step."""
        order = self.stock.order(terms)
        assert order is not None
        return int(order)

    def error_order(self, terms: Any) -> Any:
        """Order of the local error estimate."""
        return self.stock.error_order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The first stage of the first step, if steps share a stage."""
        return terms.vf(t0, y0, args) if tableau_of(type(self)).fsal else None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """dy/dt."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, diffrax.RESULTS]:
        """One step from t0 to t1: (y1, error estimate, stages, first stage of the next, result).

        If `made_jump` is the constant True, `solver_state` is not read.
        """
        y1, error, beside, k, last = self.attempt(terms, t0, t1, y0, args, solver_state, made_jump)
        # diffrax's interpolation takes the stages as increments.
        dense = {"y0": y0, "y1": y1, "k": k}
        return y1, at_least(error, beside), dense, last, diffrax.RESULTS.successful

    def attempt(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> "Attempt":
        """The same, with the two parts of its error estimate separate."""
        tableau = tableau_of(type(self))
        fresh = True if not tableau.fsal else made_jump
        written_out = _nystrom if getattr(terms, "second_order", False) else _written_out
        stages = _in_loop if self.looped else written_out
        return stages(tableau, terms, t0, t1, y0, solver_state, fresh, args)


class Attempt(NamedTuple):
    """One step.

    Attributes:
        y1: the state at its end.
        error: h sum_i e_i k_i.
        unseen: error of unweighted stages; None for methods without such stages.
        k: h dy/dt at every stage.
        last: dy/dt at the last stage, if steps share it.
    """

    y1: Any
    error: Any
    unseen: Any
    k: Any
    last: Any


class Tableau(NamedTuple):
    """Coefficients of stages 2, 3, ...; weights of the step and of its error estimate.

    Also the products of all three with A, for Nystrom's form.
    """

    rows: np.ndarray  # a_ij, (s - 1, s)
    c: np.ndarray
    b: np.ndarray
    e: np.ndarray
    rows_squared: np.ndarray
    b_squared: np.ndarray
    e_squared: np.ndarray
    fsal: bool
    unweighted: tuple[int, ...]  # stages without weight in b and e


@lru_cache
def tableau_of(method: type[AbstractExplicit]) -> Tableau:
    """The coefficients of a method."""
    tableau: Any = method().stock.tableau
    A = np.zeros((len(tableau.c), len(tableau.c) + 1))
    for i, row in enumerate(tableau.a_lower):
        A[i, : len(row)] = row
    b, e = np.asarray(tableau.b_sol, float), np.asarray(tableau.b_error, float)
    c, fsal = np.asarray(tableau.c, float), bool(tableau.fsal)
    unweighted = unweighted_stages(b, e)
    return Tableau(A, c, b, e, _by(A, A), _by(b, A), _by(e, A), fsal, unweighted)


def _by(x: np.ndarray, A: np.ndarray) -> np.ndarray:
    """x A, with zero for values of rounding size; A lacks its first row, of zeros."""
    product, size = x[..., 1:] @ A, np.abs(x[..., 1:]) @ np.abs(A)
    return np.where(np.abs(product) <= 2 * len(A) * np.finfo(float).eps * size, 0.0, product)


def _added(y: Any, change: Any) -> Any:
    return jax.tree.map(jnp.add, y, change)


def _scaled(factor: Any, x: Any) -> Any:
    if isinstance(factor, float) and factor == 1.0:
        return x
    return jax.tree.map(lambda x: factor * x, x)


def _sum(weights: np.ndarray, k: Sequence[Any]) -> Any:
    """sum_j weights_j k_j."""
    used = [(float(w), stage) for w, stage in zip(weights, k, strict=False) if w != 0.0]

    def total(*parts: Array) -> Array:
        out = used[0][0] * parts[0]
        for (w, _), part in zip(used[1:], parts[1:], strict=True):
            out = out + w * part
        return out

    return jax.tree.map(total, *(stage for _, stage in used))


def _first(terms: Any, t0: Any, y0: Any, known: Any, fresh: Any, args: Any) -> Any:
    """dy/dt at the first stage."""
    if fresh is True:
        return terms.vf(t0, y0, args)
    if fresh is False:
        return known
    return lax.cond(fresh, lambda _: terms.vf(t0, y0, args), lambda k: k, known)


def _kept(x: list[Array]) -> list[Array]:
    """The same numbers, each loaded from its array once."""
    one = opaque_one(x[0].dtype)
    return [number / one for number in x]


def _written_out(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """An unrolled step."""
    per_step = lax.optimization_barrier(1.0 / terms.contr(t0, t1))
    lanes = getattr(terms, "in_lanes", False)

    def parts(y: Any) -> Any:
        return elements(y) if lanes else y

    def joined(y: Any) -> Any:
        return jnp.stack(y) if lanes else y

    def increments(rates: Any) -> Any:
        """All later stages read them: they end in divisions, which XLA computes once."""
        return jax.tree.map(lambda x: x / per_step, parts(rates))

    first = _first(terms, t0, y0, known, fresh, args)
    y = parts(y0)
    k, stage, last = [increments(first)], y, None
    for row, c in zip(tableau.rows, tableau.c, strict=True):
        t = t1 if c == 1.0 else t0 + float(c) * (t1 - t0)
        stage = _added(y, _sum(row, k))
        last = terms.vf(t, joined(stage), args)
        k.append(increments(last))
    if not tableau.fsal:
        stage, last = _added(y, _sum(tableau.b, k)), None
    beside = joined(unseen(k, tableau.unweighted)) if tableau.unweighted else None
    stages = jax.tree.map(lambda *x: jnp.stack(x), *map(joined, k))
    return Attempt(joined(stage), joined(_sum(tableau.e, k)), beside, stages, last)


def _nystrom(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """The same of second-order equations, y = (q, v)."""
    h = terms.contr(t0, t1)
    per_step = lax.optimization_barrier(1.0 / h)

    def parts(y: Array) -> Any:
        q, v, _ = terms.sections(y)
        return (elements(q), elements(v)) if terms.in_lanes else (q, v)

    def joined(q: Any, v: Any) -> Array:
        return jnp.stack([*q, *v]) if terms.in_lanes else jnp.concatenate([q, v])

    first = _first(terms, t0, y0, known, fresh, args)
    y, kick = parts(y0), parts(first)[1]
    if terms.in_lanes:
        y, kick = tuple(map(_kept, y)), _kept(kick)
    kicks, rates, last = [kick], [first], None

    def per_time(row: np.ndarray, squared: np.ndarray, c: float) -> Any:
        """The changes of q and v, over h."""
        drifts = [] if c == 0.0 else [_scaled(c, y[1])]
        if np.any(squared):
            drifts.append(_scaled(h, _sum(squared, kicks)))
        return terms.signed(reduce(_added, drifts), args), _sum(row, kicks)

    def whole(gain: Any) -> Any:
        """h times it. The results of a step have many uses: XLA computes divisions once."""
        return jax.tree.map(lambda x: x / per_step, gain)

    def end(row: np.ndarray, squared: np.ndarray) -> Any:
        return _added(y, whole(per_time(row, squared, 1.0)))

    for i, (row, squared, c) in enumerate(
        zip(tableau.rows, tableau.rows_squared, tableau.c, strict=True), 1
    ):
        t = t1 if c == 1.0 else t0 + float(c) * (t1 - t0)
        if tableau.fsal and i == len(tableau.c):
            stage = end(row, squared)
        else:
            stage = _added(y, _scaled(h, per_time(row, squared, float(c))))
        last = terms.vf(t, joined(*stage), args)
        kicks.append(parts(last)[1])
        rates.append(last)
    if not tableau.fsal:
        stage, last = end(tableau.b, tableau.b_squared), None
    # The weights of the error estimate have the sum 0: the velocity at the start drops out.
    error, beside = whole(per_time(tableau.e, tableau.e_squared, 0.0)), None
    if tableau.unweighted:
        nothing = jax.tree.map(jnp.zeros_like, y[0])
        beside = joined(nothing, whole(unseen(kicks, tableau.unweighted)))
    return Attempt(joined(*stage), joined(*error), beside, h * jnp.stack(rates), last)


def _in_loop(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """The same, with dy/dt once in the program."""
    h, size = terms.contr(t0, t1), len(tableau.c) + 1
    rows = np.concatenate([np.zeros((1, size)), tableau.rows])
    nodes = np.concatenate([[0.0], tableau.c])
    traced = not isinstance(fresh, bool)

    def sums(weights: Array, k: Any) -> Any:
        def total(x: Array) -> Array:
            wide = weights.reshape((-1,) + (1,) * (x.ndim - 1)).astype(x.dtype)
            return h * jnp.sum(wide * x, axis=0)

        return jax.tree.map(total, k)

    def stage(i: Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        k, _ = carry
        at = lambda x: lax.dynamic_index_in_dim(jnp.asarray(x), i, keepdims=False)  # noqa: E731
        y = _added(y0, sums(at(rows), k))
        rates = terms.vf(t0 + at(nodes).astype(t0.dtype) * (t1 - t0), y, args)
        if traced:
            rates = jax.tree.map(lambda x, k: jnp.where((i > 0) | fresh, x, k), rates, known)
        put = lambda k, x: lax.dynamic_update_index_in_dim(k, x, i, 0)  # noqa: E731
        return jax.tree.map(put, k, rates), y

    k = jax.tree.map(lambda y: jnp.zeros((size, *y.shape), y.dtype), y0)
    begin: Any = 0
    if fresh is not True:
        k = jax.tree.map(lambda k, x: k.at[0].set(x), k, known)
        # One bound for all lanes.
        begin = jnp.where(eqxi.unvmap_any(fresh), 0, 1) if traced else 1
    k, last_stage = lax.fori_loop(begin, size, stage, (k, y0))
    if tableau.fsal:
        y1, last = last_stage, jax.tree.map(lambda x: x[-1], k)
    else:
        y1, last = _added(y0, sums(jnp.asarray(tableau.b), k)), None
    increments = jax.tree.map(lambda x: h * x, k)
    beside = unseen(unstacked(increments), tableau.unweighted) if tableau.unweighted else None
    return Attempt(y1, sums(jnp.asarray(tableau.e), k), beside, increments, last)
