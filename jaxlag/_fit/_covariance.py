"""Identifiability of params: precise, imprecise or unidentifiable directions, by name.

R is the triangular factor of the weighted derivatives J with the states eliminated: R^T R is the
Fisher information of the params. Directions are relative changes d(log theta), which do not
depend on units. Example: for a null direction (1, 1) of g and l both may grow by one factor
without any change of the measurements. Only g/l is identifiable.
"""

from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._status import Status
from jaxlag._fit._free_parameters import SATURATED, Unknowns
from jaxlag._fit._linear_least_squares import LinearRows, eliminate
from jaxlag._fit._multiple_shooting import MultipleShooting, SearchResult

NEGLIGIBLE = 1e-6
"""Smaller singular values of normalized columns count as zero: solves at a tolerance of 1e-9 give
derivatives to about 1e-8."""
LARGEST = 4
"""Exponents of products are ratios of integers up to this one."""


def reduced(rows: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Reduced row echelon form of independent rows, pivots in the first possible of `order`.

    Pivoting by size within the remaining rows keeps it stable; `order` decides between columns.
    """
    rows = rows[:, order].copy()
    pivot = 0
    for column in range(rows.shape[1]):
        if pivot == len(rows):
            break
        best = pivot + int(np.argmax(np.abs(rows[pivot:, column])))
        if abs(rows[best, column]) < 1e-4:
            continue
        rows[[pivot, best]] = rows[[best, pivot]]
        rows[pivot] /= rows[pivot, column]
        for other in range(len(rows)):
            if other != pivot:
                rows[other] -= rows[other, column] * rows[pivot]
        pivot += 1
    back = np.empty_like(rows)
    back[:, order] = rows
    return back


def combination(names: tuple[str, ...], exponents: np.ndarray) -> str:
    """A row of exponents as a product, "g/l"; or else as the sum of relative changes."""
    exact = [Fraction(float(x)).limit_denominator(LARGEST) for x in exponents]
    if all(abs(float(a) - b) < 1e-3 for a, b in zip(exact, exponents, strict=True)):
        above = [_power(n, x) for n, x in zip(names, exact, strict=True) if x > 0]
        below = [_power(n, -x) for n, x in zip(names, exact, strict=True) if x < 0]
        if not above:
            above, below = below, above
        top = " ".join(above)
        if not below:
            return top
        return f"{top}/{below[0]}" if len(below) == 1 else f"{top}/({' '.join(below)})"
    terms = [
        f"{x:+.3g} d{name}/{name}"
        for name, x in zip(names, exponents, strict=True)
        if abs(x) > 1e-3 * np.max(np.abs(exponents))
    ]
    return " ".join(terms).removeprefix("+")


def _power(name: str, exponent: Fraction) -> str:
    if exponent == 1:
        return name
    text = str(exponent)
    return f"{name}^{text}" if exponent.denominator == 1 else f"{name}^({text})"


def relative(values: np.ndarray) -> np.ndarray:
    """Divisors of relative changes: the values themselves, 1 if they are 0."""
    return np.where(values == 0, 1.0, values)


def saturated(factor: np.ndarray, by_z: np.ndarray, at_first: np.ndarray) -> np.ndarray:
    """(e,) which numbers are saturated at a bound of their transform.

    For a matrix, also all numbers that its transform connects with such a number.

    Args:
        factor: (e, e), a factor of the weighted derivatives by the unknowns.
        by_z: (e, e), derivatives of the numbers by the unknowns.
        at_first: (e, e), likewise at the start of the search.
    """
    sizes, before, moved = (np.linalg.norm(x, axis=0) for x in (by_z, at_first, factor))
    idle = (sizes <= SATURATED * before) & (moved <= SATURATED)
    tied = (by_z != 0) | (at_first != 0)
    tied |= tied.T
    for _ in range(len(idle)):
        idle = idle | tied[idle].any(axis=0)
    return idle


class Spectrum:
    """Singular values of the derivatives by relative changes, and their null directions.

    Args:
        names: names of the numbers.
        values: the numbers.
        factor: (e, e) or with more rows, a factor of the weighted derivatives by them; zero
            columns for numbers without effect on any measurement.

    Attributes:
        singular_values: (e,), descending; a relative change of 1 along a direction changes the
            weighted residuals by its singular value.
        null: orthonormal rows, relative changes without effect on any measurement.
        unidentifiable: as text: numbers that may change together.
        determined: as text: identifiable combinations of those.
    """

    def __init__(self, names: tuple[str, ...], values: np.ndarray, factor: np.ndarray) -> None:
        self.values = values
        self.singular_values = np.linalg.svd(factor * relative(values), compute_uv=False)
        # Zero singular values are found with normalized columns: a number near zero, with small
        # relative changes, may be as precise as any.
        norms = np.linalg.norm(factor, axis=0)
        self._norms = np.where(norms > 0, norms, 1.0)
        _, self._sizes, self._directions = np.linalg.svd(factor / self._norms, full_matrices=False)
        self._vanish = self._sizes <= NEGLIGIBLE * max(self._sizes, default=0.0)
        null = self._directions[self._vanish] / (self._norms * relative(values))
        self.null = np.linalg.qr(null.T).Q.T
        self.unidentifiable, self.determined = _as_text(names, self.null)

    def covariance(self) -> np.ndarray:
        """(R^T R)^-1; inf for numbers in a null direction."""
        root = self._directions[~self._vanish] / self._sizes[~self._vanish, None] / self._norms
        covariance = root.T @ root
        open_ended = np.any(np.abs(self.null) > 1e-3, axis=0)
        covariance[open_ended] = covariance[:, open_ended] = np.nan
        covariance[open_ended, open_ended] = np.inf
        return covariance


def _as_text(names: tuple[str, ...], null: np.ndarray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(numbers that change together, identifiable combinations of them)."""
    columns = np.flatnonzero(np.any(np.abs(null) > 1e-3, axis=0))
    if not len(columns):
        return (), ()
    own, basis = tuple(names[i] for i in columns), null[:, columns]
    order = np.arange(len(columns))
    together = tuple(_together(own, row) for row in reduced(basis, order))
    # Directions orthogonal to the null directions are identifiable.
    _, sizes, rows = np.linalg.svd(basis)
    rest = rows[np.count_nonzero(sizes > 1e-9) :]
    return together, tuple(combination(own, row) for row in reduced(rest, order[::-1]))


def _together(names: tuple[str, ...], row: np.ndarray) -> str:
    """A null direction as text."""
    moved = [(n, x) for n, x in zip(names, row, strict=True) if abs(x) > 1e-3]
    if len(moved) == 1:
        return f"{moved[0][0]} is not determined at all"
    return "change together without effect on the channels: " + ", ".join(
        f"{n} by {x:+.3g} %" for n, x in moved
    )


# ---- The linear problem at the end of a search, states eliminated --------------------------------


REGULARIZATION = 1e-20
"""Damping, in squares of unknowns of order one, that keeps unobserved starts regular."""
NOTHING = 1e-7
"""Singular values below this part of the largest belong to directions without any motion."""


@eqx.filter_jit
def linearized(free: Unknowns, found: SearchResult) -> tuple[Array, Array, Array]:
    """(a factor of the weighted derivatives by z, derivatives of the numbers by z, those at 0)."""
    numbers, z = jax.jacfwd(free.numbers), found.guess.z
    assert found.rows is not None
    left = eliminate(_without_failed(found.rows, found), jnp.asarray(REGULARIZATION))
    return left.params[:-1, :-1], numbers(z), numbers(jnp.zeros_like(z))


@eqx.filter_jit
def distance(found: SearchResult, moves: Bool[Array, " p"]) -> Float[Array, ""]:
    """Length of the Gauss-Newton step of the params, in standard deviations.

    sqrt(dz . C^-1 dz), dz the Gauss-Newton step, C the covariance, for unknowns that move.
    It is small for a converged search.
    """
    assert found.rows is not None
    p, rows = moves.shape[0], _without_failed(found.rows, found)

    def moving_columns(x: Array) -> Array:
        """Columns of unknowns that may move."""
        return x.at[..., -p - 1 : -1].multiply(jnp.where(moves, 1.0, 0.0))

    joined = None if rows.joined is None else moving_columns(rows.joined)
    moving = LinearRows(
        moving_columns(rows.measured), joined, rows.next, moving_columns(rows.prior)
    )
    left = eliminate(moving, jnp.asarray(REGULARIZATION))
    return jnp.linalg.norm(left.params[:-1, -1])


def _without_failed(rows: LinearRows, found: SearchResult) -> LinearRows:
    """The linear problem without rows of failed segments."""
    ok = (found.seen.status == Status.ok)[:, None, None]
    joined = None if rows.joined is None else jnp.where(ok, rows.joined, 0.0)
    following = None if rows.next is None else jnp.where(ok[:, :, 0], rows.next, 0.0)
    return rows._replace(measured=jnp.where(ok, rows.measured, 0.0), joined=joined, next=following)


def effective_parameters(problem: MultipleShooting, found: SearchResult) -> float:
    """Effective number of unknowns: the trace of the hat matrix.

    Unknowns determined by measurements: without held ones, without directions in which
    constraints allow no motion, and without the part that priors determine.

    Source: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., sec. 7.6.
    """
    moves = np.asarray(problem.segments.held) != 0
    first = ~np.roll(np.asarray(problem.segments.follows), 1)
    plain = len(problem.free.u0) + np.count_nonzero(moves[first])
    if found.rows is None:
        return float(plain)
    factor = np.asarray(linearized(problem.free, found)[0])
    if not np.all(np.isfinite(factor)):
        return float(plain)
    rows = jax.tree.map(np.asarray, _without_failed(found.rows, found))
    p = len(problem.free.u0)
    count = _determined(factor, rows.prior[:, :p])
    d = problem.states.shape[0]
    held = np.asarray(problem.segments.held)
    known = np.where(
        np.isfinite(held) & moves, np.asarray(problem.states) / np.where(moves, held, 1), 0
    )
    for k in np.flatnonzero(first):
        own = rows.measured[k, :, :d]
        if rows.joined is not None:
            own = np.concatenate([own, rows.joined[k, :, :d]])
        count += _determined(own, np.diag(known[k]))
    return count


def _determined(rows: np.ndarray, prior: np.ndarray) -> float:
    """Number of unknowns determined by rows, minus the part that the rows `prior` determine."""
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    determined = sizes > NOTHING * max(np.max(sizes, initial=0.0), np.finfo(float).tiny)
    share = prior @ (directions[determined] / sizes[determined, None]).T
    return float(np.count_nonzero(determined) - np.sum(share**2))
