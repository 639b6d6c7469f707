"""Motions from hand-written equations, solved by SciPy, as references for the cases."""

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

G = 9.81
IMAGINARY = 1e-30  # complex step of the start for derivatives: no difference, no cancellation


def double_pendulum(
    q0: Any, t: float, mass: float = 1.0, along: Any = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """(angles at t, their derivative by the start along `along`), released at rest at q0.

    Rods of 1 m, the upper bob of 1 kg, the lower of `mass`, whose equation is divided by it:

        (1 + m s^2) a1 = -m s (w2^2 + c w1^2) - (1 + m) g sin q1 + m c g sin q2,
        a2 = s w1^2 - g sin q2 - c a1,        s, c = sin, cos(q1 - q2).

    Solved by SciPy's method of order 8 to 1e-13. The derivative is a complex-step derivative: the
    start has a tiny imaginary part.
    """
    m = mass

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        (q1, q2), (w1, w2) = y[:2], y[2:]
        s, c = np.sin(q1 - q2), np.cos(q1 - q2)
        torque = m * s * (w2**2 + c * w1**2) + (1.0 + m) * G * np.sin(q1) - m * c * G * np.sin(q2)
        a1 = -torque / (1.0 + m * s**2)
        return np.array([w1, w2, a1, s * w1**2 - G * np.sin(q2) - c * a1])

    start = np.zeros(4, complex)
    start[:2] = np.asarray(q0) + 1j * IMAGINARY * np.asarray(along)
    end = solve_ivp(rate, (0.0, t), start, method="DOP853", rtol=1e-13, atol=1e-13)
    if not end.success:
        raise ArithmeticError(end.message)
    return end.y[:2, -1].real, end.y[:2, -1].imag / IMAGINARY
