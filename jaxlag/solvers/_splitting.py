"""Splitting methods: drifts and kicks in turn."""

from collections.abc import Callable
from itertools import pairwise, zip_longest
from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jaxlag._core._errors import invalid
from jaxlag.solvers._fixed import AbstractFixedStep


class Splitting(AbstractFixedStep):
    """Composition of drifts q += h a_i v and kicks v += h b_i M^-1 F(t, q), explicit, symplectic.

    For systems with constant M and accelerations that do not depend on v: L = T(v) - V(t, q)
    with T quadratic, and forces Q(t, q). Both parts are solved exactly. So every composition
    keeps the symplectic form and the momenta of symmetries of T and V. It is symmetric and
    therefore reversible. A drift comes first, with order 6 a kick; drifts advance the time. The
    work is that of every kick. With order 6, whose composition requires accelerations that depend
    on q alone, the work is of order 4.

    In `diffrax.diffeqsolve` y is a pair (q, v) of pytrees, `vf(t, y, args)` the pair (v, M^-1 F).
    The terms of `simulate` have `sections(y) -> (q, v, work)`, its inverse
    `joined(q, v, work)`, and `works`, whether there is work.

    Args:
        order: 2 (Stormer's and Verlet's), 4 (6 kicks), 6 (12 kicks) or 8 (17 kicks).

    Source: order 2: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. I.1.4; orders
    4 and 6: Blanes, Moan, Practical symplectic partitioned Runge-Kutta and Runge-Kutta-Nystrom
    methods, J. Comp. Appl. Math. 142 (2002), S6 of order 4 and SRKN11b of order 6; order 8:
    Kahan, Li, Composition constants for raising the orders of unconventional schemes, Math. Comp.
    66 (1997).
    """

    accuracy: int = eqx.field(static=True)

    def __init__(self, order: int = 2) -> None:
        if not isinstance(order, int | np.integer) or order not in _COEFFICIENTS:
            must = f"be one of {', '.join(map(str, _COEFFICIENTS))}"
            raise invalid("Splitting: order", must, f"it was {order!r}")
        self.accuracy = int(order)

    def order(self, terms: Any) -> int:
        """Order of the step."""
        return self.accuracy

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, None, dict[str, Any], None, diffrax.RESULTS]:
        """One step from t0 to t1; there is no error estimate."""
        drifts, kicks = _COEFFICIENTS[self.accuracy]
        h, t, gone = terms.contr(t0, t1), t0, 0.0
        sections, joined, works = _form(terms)
        q, v, work = sections(y0)

        def rates(q: Any, v: Any) -> Any:
            """(v, a, rates of work) at time t."""
            return sections(terms.vf(t, joined(q, v, work), args))

        for drift, kick in zip_longest(drifts, kicks):
            if drift:
                q = _moved(q, drift * h, rates(q, v)[0])
                gone += drift
                t = t0 + gone * (t1 - t0)
            if kick is not None:
                before, v = v, _moved(v, kick * h, rates(q, v)[1])
                if works:
                    middle = jax.tree.map(lambda a, b: 0.5 * (a + b), before, v)
                    work = _moved(work, kick * h, rates(q, middle)[2])
        y1 = joined(q, v, work)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful


def _form(terms: Any) -> tuple[Callable, Callable, bool]:
    """The functions that split and join a state, and whether it has work."""
    if hasattr(terms, "sections"):
        return terms.sections, terms.joined, terms.works
    return lambda y: (*y, ()), lambda q, v, work: (q, v), False


def _moved(x: Any, h: Array, rate: Any) -> Any:
    return jax.tree.map(lambda x, rate: x + h * rate, x, rate)


def _mirrored(half: list[float], middle: list[float]) -> list[float]:
    return [*half, *middle, *reversed(half)]


def _of_verlet_steps(gammas: list[float]) -> tuple[list[float], list[float]]:
    """Drifts and kicks of a composition of Verlet steps of these lengths."""
    ends = [0.0, *gammas, 0.0]
    return [0.5 * (a + b) for a, b in pairwise(ends)], gammas


_S6_DRIFTS = [0.0792036964311957, 0.353172906049774, -0.0420650803577195]
_S6_KICKS = [0.209515106613362, -0.143851773179818]
_SRKN_DRIFTS = [
    0.123229775946271,
    0.290553797799558,
    -0.127049212625417,
    -0.246331761062075,
    0.357208872795928,
]
_SRKN_KICKS = [
    0.0414649985182624,
    0.198128671918067,
    -0.0400061921041533,
    0.0752539843015807,
    -0.0115113874206879,
]
_GAMMAS = [
    0.13020248308889008088,
    0.56116298177510838456,
    -0.38947496264484728641,
    0.15884190655515560090,
    -0.39590389413323757734,
    0.18453964097831570709,
    0.25837438768632204729,
    0.29501172360931029887,
]


# Drifts and kicks of each order, a drift first; zeros are skipped.
_COEFFICIENTS = {
    2: _of_verlet_steps([1.0]),
    4: (
        _mirrored(_S6_DRIFTS, [1.0 - 2.0 * sum(_S6_DRIFTS)]),
        _mirrored(_S6_KICKS, 2 * [0.5 - sum(_S6_KICKS)]),
    ),
    6: (
        _mirrored([0.0, *_SRKN_DRIFTS], [1.0 - 2.0 * sum(_SRKN_DRIFTS)]),
        _mirrored(_SRKN_KICKS, 2 * [0.5 - sum(_SRKN_KICKS)]),
    ),
    8: _of_verlet_steps(_mirrored(_GAMMAS, [1.0 - 2.0 * sum(_GAMMAS)])),
}
