"""Extrapolated midpoint steps in multiprecision.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.9 (Gragg's
midpoint rule with an even number of substeps has an error expansion in h^2; Aitken, Neville).
"""

from collections.abc import Callable, Sequence
from typing import Any

from bench._multiprecision.equations import precise

SAFETY = 0.8
LEAST, MOST = 0.2, 4.0  # bounds on the ratio of successive steps
SHORTEST = 1e-7  # step over span; a motion with shorter steps is taken to be singular there


def integrated(
    rates: Callable[[Any, Sequence], list],
    y: Sequence,
    times: Sequence[float],
    tolerance: float,
    columns: int,
) -> tuple[list[list], int]:
    """(y at every time, number of steps), of order 2 `columns`; a step ends on every time.

    Args:
        rates: `rates(t, y)`, dy/dt.
        y: state at the first time.
        times: increasing, s.
        tolerance: on the difference of the last two columns, relative to 1 + |y|.
        columns: of the extrapolation table; substeps are 2, 4, ..., 2 `columns`.
    """
    gmpy2 = precise()
    times = [gmpy2.mpfr(float(t)) for t in times]
    t, y, found, steps = times[0], list(y), [list(y)], 0
    h = (times[-1] - t) / 100
    for end in times[1:]:
        while t < end:
            pieces = gmpy2.ceil((end - t) / h)
            taken = (end - t) / max(pieces, 1)
            new, error = _step(rates, t, y, taken, columns)
            factor = MOST if error == 0 else float((tolerance / error) ** (1 / (2 * columns - 1)))
            if not factor >= 0:  # not a number
                factor = LEAST
            h = taken * min(MOST, max(LEAST, SAFETY * factor))
            if h < SHORTEST * (times[-1] - times[0]):
                raise ArithmeticError(f"steps become too short at t = {float(t):g}")
            if error <= tolerance:
                t, y, steps = (end if pieces <= 1 else t + taken), new, steps + 1
        found.append(y)
    return found, steps


def _step(rates: Callable, t: Any, y: list, h: Any, columns: int) -> tuple[list, Any]:
    """(y at t + h, its estimated error relative to 1 + |y|)."""
    slope, previous = rates(t, y), []
    for j in range(1, columns + 1):
        below = _midpoint(rates, t, y, slope, h, 2 * j)
        new = [below]
        for k in range(1, j):
            weight = 1 / ((precise().mpfr(j) / (j - k)) ** 2 - 1)
            below = [b + (b - a) * weight for a, b in zip(previous[k - 1], below, strict=True)]
            new.append(below)
        previous = new
    last, before = previous[-1], previous[-2]
    differences = zip(last, before, strict=True)
    return last, max(abs(a - b) / (1 + abs(a)) for a, b in differences)


def _midpoint(rates: Callable, t: Any, y: list, slope: list, h: Any, count: int) -> list:
    step = h / count
    double = 2 * step
    old, now = y, [a + step * b for a, b in zip(y, slope, strict=True)]
    for k in range(1, count):
        slope = rates(t + k * step, now)
        old, now = now, [a + double * b for a, b in zip(old, slope, strict=True)]
    return now
