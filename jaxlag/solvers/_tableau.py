"""Coefficients of explicit one-step methods."""

from typing import Any, NamedTuple

import numpy as np

from jaxlag.solvers._unweighted_stages import unweighted_stages


class Tableau(NamedTuple):
    """Coefficients of stages 2, 3, ..., weights of the step and of its error estimate.

    The squared ones are those of the coordinates in Nystrom's form: of h^2 a in q, where the others
    are those of h a in v. Of a Runge-Kutta method they are products with A.

    Attributes:
        rows: a_ij, (s - 1, s); None if stages have no velocities, as accelerations do not depend
            on them.
        c: nodes of these stages, (s - 1,).
        b: weights of the step, (s,).
        e: weights of the error estimate, (s,).
        rows_squared: as `rows`, of the coordinates.
        b_squared: as `b`.
        e_squared: as `e`.
        fsal: whether the last stage is the first one of the next step.
        unweighted: stages without weight in b and e.
    """

    rows: np.ndarray | None
    c: np.ndarray
    b: np.ndarray
    e: np.ndarray
    rows_squared: np.ndarray
    b_squared: np.ndarray
    e_squared: np.ndarray
    fsal: bool
    unweighted: tuple[int, ...]

    @property
    def velocity_rows(self) -> np.ndarray:
        """a_ij of a method whose stages have velocities."""
        assert self.rows is not None
        return self.rows


def of_runge_kutta(tableau: Any) -> Tableau:
    """Those of a `diffrax.ButcherTableau`."""
    A = strictly_lower(tableau.a_lower)
    b, e = np.asarray(tableau.b_sol, float), np.asarray(tableau.b_error, float)
    c, fsal = np.asarray(tableau.c, float), bool(tableau.fsal)
    unweighted = unweighted_stages(b, e)
    return Tableau(A, c, b, e, _by(A, A), _by(b, A), _by(e, A), fsal, unweighted)


def strictly_lower(rows: Any) -> np.ndarray:
    """Stages 2, 3, ... as rows of equal length, (s - 1, s)."""
    A = np.zeros((len(rows), len(rows) + 1))
    for i, row in enumerate(rows):
        A[i, : len(row)] = row
    return A


def _by(x: np.ndarray, A: np.ndarray) -> np.ndarray:
    """x A, with zero for values of rounding size; A lacks its first row, of zeros."""
    product, size = x[..., 1:] @ A, np.abs(x[..., 1:]) @ np.abs(A)
    return np.where(np.abs(product) <= 2 * len(A) * np.finfo(float).eps * size, 0.0, product)
