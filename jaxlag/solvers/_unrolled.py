"""Explicit Runge-Kutta steps written out stage by stage."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax


class AbstractUnrolled(diffrax.AbstractAdaptiveSolver):
    """An explicit Runge-Kutta method without a loop over its stages.

    k_i = f(t + c_i h, y + h sum_{j<i} a_ij k_j), y1 = y + h sum_i b_i k_i; the error estimate is
    h sum_i e_i k_i. The units are those of the problem; y is any pytree of arrays.

    A stage is a sum of the stages before it with the zeros of the tableau left out, so that a
    step is straight-line code and a loop of steps over a small system one function without calls.

    Where the terms have an attribute `second_order` other than None, y is a tuple of scalars, the
    elements of q and w with q' = w and w' = a(t, q, w), and a step is taken as

        w_i = w + h sum_j a_ij a_j,    q_i = q + c_i h w + h^2 sum_j (A A)_ij a_j.

    This is the same method (Nystrom's form), but stages meet only through accelerations. These
    end in divisions, which XLA computes once; it would compute a velocity anew in every later
    stage that reads it. `second_order` has the methods

        split(y, args) -> (q, w),    join(q, w, args) -> y,    accelerations(t, q, w, args) -> a;

    `split` takes rates (w, a) apart as well, and `join` puts them together.

    The last stage of a method whose last row of the tableau is its weights (FSAL) is the first
    one of the next step.

    Steps, error estimates and interpolation are those of `stock`, up to the order of sums.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.1, II.14.

    Attributes:
        stock: the same method with a loop over stages.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable]

    @property
    @abstractmethod
    def stock(self) -> diffrax.AbstractERK:
        """The same method with a loop over stages."""

    def order(self, terms: Any) -> int:
        """Order of the step."""
        order = self.stock.order(terms)
        assert order is not None
        return int(order)

    def error_order(self, terms: Any) -> Any:
        """Order of the local error estimate."""
        return self.stock.error_order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The first stage of the first step, where steps share one."""
        return terms.vf(t0, y0, args) if _tableau(self.stock).fsal else None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """dy/dt."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, diffrax.RESULTS]:
        """One step from t0 to t1: (y1, error estimate, stages, first stage of the next, result)."""
        tableau = _tableau(self.stock)
        if not tableau.fsal:
            first = terms.vf(t0, y0, args)
        elif made_jump is False:
            first = solver_state
        else:
            first = lax.cond(
                made_jump, lambda _: terms.vf(t0, y0, args), lambda known: known, solver_state
            )
        second_order = getattr(terms, "second_order", None) is not None
        stages = _second_order if second_order else _first_order
        y1, error, increments, last = stages(tableau, terms, t0, t1, y0, first, args)
        # diffrax's interpolation takes the stages as increments.
        k = jax.tree.map(lambda *parts: jnp.stack(parts), *increments)
        return y1, error, {"y0": y0, "y1": y1, "k": k}, last, diffrax.RESULTS.successful


class _Tableau(NamedTuple):
    """Coefficients of stages 2, 3, ..., and what Nystrom's form needs of their products."""

    rows: list[np.ndarray]  # a_ij
    squared: list[np.ndarray]  # (A A)_ij
    c: list[float]
    b: np.ndarray
    b_squared: np.ndarray  # b A
    e: np.ndarray
    e_squared: np.ndarray  # e A
    fsal: bool


def _tableau(method: diffrax.AbstractERK) -> _Tableau:
    tableau: Any = method.tableau
    size = len(tableau.c) + 1
    A = np.zeros((size, size))
    for i, row in enumerate(tableau.a_lower, 1):
        A[i, : len(row)] = row
    b, e = np.asarray(tableau.b_sol, float), np.asarray(tableau.b_error, float)
    squares = [_product(row, A) for row in A]
    return _Tableau(
        list(A[1:]),
        squares[1:],
        [float(c) for c in tableau.c],
        b,
        _product(b, A),
        e,
        _product(e, A),
        bool(tableau.fsal),
    )


def _product(row: np.ndarray, A: np.ndarray) -> np.ndarray:
    """row A, with entries that are zero up to rounding set to zero."""
    product = row @ A
    rounding = 2 * len(row) * np.finfo(float).eps * (np.abs(row) @ np.abs(A))
    return np.where(np.abs(product) <= rounding, 0.0, product)


def _sums(weights: np.ndarray, k: Sequence[Sequence[Array]]) -> list[Array]:
    """sum_j weights_j k_j, element by element."""
    used = [(float(w), stage) for w, stage in zip(weights, k, strict=False) if w != 0.0]
    out = []
    for i in range(len(k[0])):
        total = used[0][0] * used[0][1][i]
        for w, stage in used[1:]:
            total = total + w * stage[i]
        out.append(total)
    return out


def _added(x: Sequence[Array], change: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(a + b for a, b in zip(x, change, strict=True))


def _first_order(
    tableau: _Tableau, terms: Any, t0: Any, t1: Any, y0: Any, first: Any, args: Any
) -> tuple[Any, Any, list[Any], Any]:
    """(y1, error estimate, h dy/dt at every stage, dy/dt at the last one where steps share it)."""
    structure, y = jax.tree.structure(y0), jax.tree.leaves(y0)
    per_step = lax.optimization_barrier(1.0 / terms.contr(t0, t1))

    def increments(rates: Any) -> list[Array]:
        """They are read in every later stage: they end in divisions, which XLA computes once."""
        return [x / per_step for x in jax.tree.leaves(rates)]

    k, stage, last = [increments(first)], y, None
    for row, c in zip(tableau.rows, tableau.c, strict=True):
        t = t1 if c == 1.0 else t0 + c * (t1 - t0)
        stage = _added(y, _sums(row, k))
        last = terms.vf(t, jax.tree.unflatten(structure, stage), args)
        k.append(increments(last))
    if not tableau.fsal:
        stage, last = _added(y, _sums(tableau.b, k)), None
    whole = [jax.tree.unflatten(structure, x) for x in (stage, _sums(tableau.e, k), *k)]
    return whole[0], whole[1], whole[2:], last


def _second_order(
    tableau: _Tableau, terms: Any, t0: Any, t1: Any, y0: Any, first: Any, args: Any
) -> tuple[Any, Any, list[Any], Any]:
    """The same in Nystrom's form."""
    h, form = terms.contr(t0, t1), terms.second_order
    q, w = form.split(y0, args)
    a = [form.split(first, args)[1]]
    rates = [first]
    # The step's results are read in many places: they end in divisions, which XLA computes once.
    per_step = lax.optimization_barrier(1.0 / h)

    def moves(row: np.ndarray, squared: np.ndarray, c: float) -> tuple[list, list]:
        """What q and w gain, over h."""
        drift = [rate if c == 1.0 else c * rate for rate in w]
        if np.any(squared):
            turns = _sums(squared, a)
            drift = [x + h * turn for x, turn in zip(drift, turns, strict=True)]
        return drift, _sums(row, a)

    def end() -> tuple[tuple, tuple]:
        drift, kicks = moves(tableau.b, tableau.b_squared, 1.0)
        return _added(q, [x / per_step for x in drift]), _added(w, [x / per_step for x in kicks])

    for i, (row, squared, c) in enumerate(
        zip(tableau.rows, tableau.squared, tableau.c, strict=True), 1
    ):
        t = t1 if c == 1.0 else t0 + c * (t1 - t0)
        if tableau.fsal and i == len(tableau.rows):
            at = end()
        else:
            drift, kicks = moves(row, squared, c)
            at = _added(q, [h * x for x in drift]), _added(w, [h * x for x in kicks])
        a.append(form.accelerations(t, *at, args))
        rates.append(form.join(at[1], a[-1], args))
    if not tableau.fsal:
        at = end()
    # The weights of the error estimate have the sum 0: w drops out.
    error = (
        tuple(h * x / per_step for x in _sums(tableau.e_squared, a)),
        tuple(x / per_step for x in _sums(tableau.e, a)),
    )
    k = [jax.tree.map(lambda x: h * x, rate) for rate in rates]
    last = rates[-1] if tableau.fsal else None
    return form.join(*at, args), form.join(*error, args), k, last
