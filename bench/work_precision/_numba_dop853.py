"""Dormand and Prince's method of order 8(5,3) in numba, loop and equations compiled together.

Coefficients are those of scipy. Step control and first step are as in Hairer, Norsett, Wanner,
Solving Ordinary Differential Equations I, ch. II.4 and II.10 (their DOP853, and scipy's). The sums
over stages are written out, without the terms that are zero.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from bench._problems.motions import Motion
from bench.work_precision._straight_line import source


class Solve(NamedTuple):
    """`run(y0, t1, rtol, atol)`: (state at t1, accepted steps, all steps); 0 steps if it failed."""

    run: Callable[[np.ndarray, float, float, float], tuple[np.ndarray, int, int]]


def build(motion: Motion) -> Solve:
    """Compile for one motion, with its parameters as constants."""
    njit = import_module("numba").njit
    space: dict[str, Any] = {"sin": np.sin, "cos": np.cos, "sqrt": np.sqrt, "np": np}
    size = motion.start().shape[-1]
    exec(source(motion.rates, motion.params, size), space)
    space["rates"] = njit(fastmath=True)(space["rates"])
    exec(_step_source(size), space)
    step = njit(fastmath=True)(space["step"])
    rates = space["rates"]

    @njit
    def first_step(y, f0, rtol, atol, y1, f1):
        n = y.size
        d0 = d1 = 0.0
        for i in range(n):
            scale = atol + rtol * abs(y[i])
            d0 += (y[i] / scale) ** 2
            d1 += (f0[i] / scale) ** 2
        d0, d1 = np.sqrt(d0 / n), np.sqrt(d1 / n)
        h0 = 1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1
        for i in range(n):
            y1[i] = y[i] + h0 * f0[i]
        rates(0.0, y1, f1)
        d2 = 0.0
        for i in range(n):
            d2 += ((f1[i] - f0[i]) / (atol + rtol * abs(y[i]))) ** 2
        d2 = np.sqrt(d2 / n) / h0
        largest = max(d1, d2)
        h1 = max(1e-6, h0 * 1e-3) if largest <= 1e-15 else (0.01 / largest) ** (1.0 / 8.0)
        return min(100.0 * h0, h1)

    @njit
    def run(y0, t1, rtol, atol):
        n = y0.size
        y, y_new, z, k = y0.copy(), np.empty(n), np.empty(n), np.empty((13, n))
        rates(0.0, y, k[0])
        h = min(first_step(y, k[0], rtol, atol, z, k[1]), t1)
        t, accepted, attempts, rejected = 0.0, 0, 0, False
        while t < t1:
            attempts += 1
            last = t + h >= t1
            if last:
                h = t1 - t
            error = step(y, h, k, z, y_new, rtol, atol)
            if attempts > 10_000_000 or not error < np.inf:
                return np.full(n, np.nan), 0, 0
            if error < 1.0:
                factor = 10.0 if error == 0.0 else min(10.0, 0.9 * error ** (-1.0 / 8.0))
                if rejected:
                    factor = min(1.0, factor)
                t = t1 if last else t + h
                for i in range(n):
                    y[i], k[0, i] = y_new[i], k[12, i]
                accepted, rejected = accepted + 1, False
            else:
                factor, rejected = max(0.2, 0.9 * error ** (-1.0 / 8.0)), True
            h *= factor
        return y, accepted, attempts

    return Solve(run)


def _step_source(size: int) -> str:
    """`step(y, h, k, z, y_new, rtol, atol)`: new state and k[12], the norm of the error."""
    from scipy.integrate._ivp import dop853_coefficients as table

    def total(coefficients: np.ndarray) -> str:
        return " + ".join(f"{float(a)!r} * k[{j}, i]" for j, a in enumerate(coefficients) if a)

    lines = ["def step(y, h, k, z, y_new, rtol, atol):"]
    for s in range(1, table.N_STAGES):
        lines += [f"    for i in range({size}):"]
        lines += [f"        z[i] = y[i] + h * ({total(table.A[s, :s])})"]
        lines += [f"    rates(0.0, z, k[{s}])"]
    lines += [
        f"    for i in range({size}):",
        f"        y_new[i] = y[i] + h * ({total(table.B)})",
        "    rates(0.0, y_new, k[12])",
        "    e5 = e3 = 0.0",
        f"    for i in range({size}):",
        "        scale = atol + rtol * max(abs(y[i]), abs(y_new[i]))",
        f"        e5 += (({total(table.E5)}) / scale) ** 2",
        f"        e3 += (({total(table.E3)}) / scale) ** 2",
        "    if e5 == 0.0 and e3 == 0.0:",
        "        return 0.0",
        f"    return abs(h) * e5 / np.sqrt((e5 + 0.01 * e3) * {size})",
    ]
    return "\n".join(lines) + "\n"
