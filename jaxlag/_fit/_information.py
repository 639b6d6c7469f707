"""What measurements tell where a search ended: the linear problem, states eliminated."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._status import Status
from jaxlag._fit._free_parameters import Unknowns
from jaxlag._fit._linear_least_squares import Rows, eliminate
from jaxlag._fit._multiple_shooting import Found, Shooting

FAINT = 1e-20
"""Damping, in squares of unknowns of order one, that keeps starts regular that are not observed."""
NOTHING = 1e-7
"""Singular values below this part of the largest: of directions in which no motion goes."""


@eqx.filter_jit
def linearised(free: Unknowns, found: Found) -> tuple[Array, Array, Array]:
    """(a factor of the weighted derivatives by z, derivatives of the numbers by z, those at 0)."""
    numbers, z = jax.jacfwd(free.numbers), found.guess.z
    assert found.rows is not None
    left = eliminate(_without_failed(found.rows, found), jnp.asarray(FAINT))
    return left.params[:-1, :-1], numbers(z), numbers(jnp.zeros_like(z))


@eqx.filter_jit
def distance(found: Found, moves: Bool[Array, " p"]) -> Float[Array, ""]:
    """How far params are from where their derivatives lead, in standard deviations.

    sqrt(dz . C^-1 dz), dz the step of Gauss and Newton, C the covariance, of unknowns that move.
    Where a search has converged it is small.
    """
    assert found.rows is not None
    p, rows = moves.shape[0], _without_failed(found.rows, found)

    def kept(x: Array) -> Array:
        """Columns of unknowns that may move."""
        return x.at[..., -p - 1 : -1].multiply(jnp.where(moves, 1.0, 0.0))

    joined = None if rows.joined is None else kept(rows.joined)
    moving = Rows(kept(rows.measured), joined, rows.next, kept(rows.prior))
    left = eliminate(moving, jnp.asarray(FAINT))
    return jnp.linalg.norm(left.params[:-1, -1])


def _without_failed(rows: Rows, found: Found) -> Rows:
    """The linear problem without rows of segments that failed."""
    ok = (found.seen.status == Status.ok)[:, None, None]
    joined = None if rows.joined is None else jnp.where(ok, rows.joined, 0.0)
    following = None if rows.next is None else jnp.where(ok[:, :, 0], rows.next, 0.0)
    return rows._replace(measured=jnp.where(ok, rows.measured, 0.0), joined=joined, next=following)


def spent(problem: Shooting, found: Found) -> float:
    """How many of the numbers measured went into unknowns: the trace of the hat matrix.

    As many as there are unknowns that measurements tell: not those that are held, those along which
    constraints let nothing move, and what priors tell of the others.

    Source: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., sec. 7.6.
    """
    moves = np.asarray(problem.segments.held) != 0
    first = ~np.roll(np.asarray(problem.segments.follows), 1)
    plain = len(problem.free.u0) + np.count_nonzero(moves[first])
    if found.rows is None:
        return float(plain)
    factor = np.asarray(linearised(problem.free, found)[0])
    if not np.all(np.isfinite(factor)):
        return float(plain)
    rows = jax.tree.map(np.asarray, _without_failed(found.rows, found))
    p = len(problem.free.u0)
    count = _told(factor, rows.prior[:, :p])
    d = problem.states.shape[0]
    held = np.asarray(problem.segments.held)
    known = np.where(
        np.isfinite(held) & moves, np.asarray(problem.states) / np.where(moves, held, 1), 0
    )
    for k in np.flatnonzero(first):
        own = rows.measured[k, :, :d]
        if rows.joined is not None:
            own = np.concatenate([own, rows.joined[k, :, :d]])
        count += _told(own, np.diag(known[k]))
    return count


def _told(rows: np.ndarray, prior: np.ndarray) -> float:
    """How many unknowns rows tell, less what their own part `prior` tells of these."""
    _, sizes, directions = np.linalg.svd(rows, full_matrices=False)
    kept = sizes > NOTHING * max(np.max(sizes, initial=0.0), np.finfo(float).tiny)
    share = prior @ (directions[kept] / sizes[kept, None]).T
    return float(np.count_nonzero(kept) - np.sum(share**2))
