"""What measurements tell of params: precise, imprecise, or not at all, in the params' names.

From the triangular factor R of the weighted derivatives J, states eliminated: R^T R is the Fisher
information of the params. Directions are those of relative changes d(log theta), so that they do
not depend on units: a null direction (1, 1) of g and l says that both may grow by one factor and
nothing measured would change, and that g/l is all that is known.
"""

from fractions import Fraction

import numpy as np

from jaxlag._fit._free_parameters import IDLE

NEGLIGIBLE = 1e-6
"""Singular values of normed columns below it are those of derivatives that vanish: solves at a
tolerance of 1e-9 give derivatives to about 1e-8."""
LARGEST = 4
"""Exponents of products are ratios of integers up to this one."""


def reduced(rows: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Reduced row echelon form of independent rows, pivots in the first columns of `order` that do.

    Pivoting by size within what is left keeps it stable; `order` decides among equals.
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
    """By which changes are divided: the values themselves, 1 where they are 0."""
    return np.where(values == 0, 1.0, values)


def run_off(factor: np.ndarray, by_z: np.ndarray, at_first: np.ndarray) -> np.ndarray:
    """(e,) which numbers are on a bound of their transform, where no derivative moves them.

    Of a matrix, all that its transform ties to such a number.

    Args:
        factor: (e, e), a factor of the weighted derivatives by the unknowns.
        by_z: (e, e), derivatives of the numbers by the unknowns.
        at_first: (e, e), likewise where the search began.
    """
    sizes, before, moved = (np.linalg.norm(x, axis=0) for x in (by_z, at_first, factor))
    idle = (sizes <= IDLE * before) & (moved <= IDLE)
    tied = (by_z != 0) | (at_first != 0)
    tied |= tied.T
    for _ in range(len(idle)):
        idle = idle | tied[idle].any(axis=0)
    return idle


class Spectrum:
    """Singular values of the derivatives by relative changes, and what their null directions say.

    Args:
        names: of the numbers.
        values: of them.
        factor: (e, e) or of more rows, a factor of the weighted derivatives by them; columns of
            zeros of those that nothing measured depends on.

    Attributes:
        singular_values: (e,), falling; a relative change of 1 along a direction moves the weighted
            residuals by so much.
        null: orthonormal rows, relative changes that nothing measured depends on.
        unidentifiable: in words: which numbers may change together.
        determined: in words: which combinations of those are known.
    """

    def __init__(self, names: tuple[str, ...], values: np.ndarray, factor: np.ndarray) -> None:
        self.values = values
        self.singular_values = np.linalg.svd(factor * relative(values), compute_uv=False)
        # What vanishes is seen in columns of one size: a number near zero, whose relative changes
        # are small, may be known as well as any.
        norms = np.linalg.norm(factor, axis=0)
        self._norms = np.where(norms > 0, norms, 1.0)
        _, self._sizes, self._directions = np.linalg.svd(factor / self._norms, full_matrices=False)
        self._vanish = self._sizes <= NEGLIGIBLE * max(self._sizes, default=0.0)
        null = self._directions[self._vanish] / (self._norms * relative(values))
        self.null = np.linalg.qr(null.T).Q.T
        self.unidentifiable, self.determined = _in_words(names, self.null)

    def covariance(self) -> np.ndarray:
        """(R^T R)^-1; inf for numbers that take part in a null direction."""
        kept = self._directions[~self._vanish] / self._sizes[~self._vanish, None] / self._norms
        found = kept.T @ kept
        open_ended = np.any(np.abs(self.null) > 1e-3, axis=0)
        found[open_ended] = found[:, open_ended] = np.nan
        found[open_ended, open_ended] = np.inf
        return found


def _in_words(names: tuple[str, ...], null: np.ndarray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(which numbers change together, which combinations of them are known)."""
    columns = np.flatnonzero(np.any(np.abs(null) > 1e-3, axis=0))
    if not len(columns):
        return (), ()
    own, basis = tuple(names[i] for i in columns), null[:, columns]
    order = np.arange(len(columns))
    together = tuple(_together(own, row) for row in reduced(basis, order))
    # What is orthogonal to the null directions is known.
    _, sizes, rows = np.linalg.svd(basis)
    rest = rows[np.count_nonzero(sizes > 1e-9) :]
    return together, tuple(combination(own, row) for row in reduced(rest, order[::-1]))


def _together(names: tuple[str, ...], row: np.ndarray) -> str:
    """A null direction in words."""
    moved = [(n, x) for n, x in zip(names, row, strict=True) if abs(x) > 1e-3]
    if len(moved) == 1:
        return f"{moved[0][0]} is not determined at all"
    return "change together without a trace: " + ", ".join(f"{n} by {x:+.3g} %" for n, x in moved)
