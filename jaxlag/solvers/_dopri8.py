"""Dormand and Prince's method of order 8."""

from collections.abc import Callable
from typing import ClassVar

import diffrax

from jaxlag.solvers._explicit import AbstractRungeKutta


class Dopri8(AbstractRungeKutta):
    """Order 8 with an embedded method of order 7, 14 stages of which two steps share one.

    `diffrax` interpolates between steps with order 5: in the middle of a step of 0.8 s on a driven
    pendulum it is 1.9e-7 off, while the step is 5.6e-9 off (output of order 7, as of DOP853: 7.4e-8
    and 8.8e-9). `simulate` takes a step to each saved time instead, which has the accuracy of the
    method: 1e-11 there.

    Hairer's 8(5,3), whose estimate combines those of orders 5 and 3, takes 0.9 to 1.3 times as many
    evaluations to equal errors (pendulums, Henon and Heiles, Kepler orbits, two coupled rates;
    errors 1e-4 to 1e-10). On twelve sharp potentials of 1,000 starts it leaves 1 to 80 motions of
    each more than 1 % off in energy at 1e-6. This method leaves 0 or 1, with the error of
    unweighted stages in its estimate, see `AbstractExplicit`. Without that it passed
    through walls in up to 10 % of the motions.

    Source: Prince, Dormand, High order embedded Runge-Kutta formulae, J. Comp. Appl. Math. 7
    (1981), with the coefficients of `diffrax.Dopri8`.
    """

    interpolation_cls: ClassVar[Callable] = diffrax.Dopri8.interpolation_cls

    @property
    def stock(self) -> diffrax.Dopri8:
        """`diffrax.Dopri8`."""
        return diffrax.Dopri8()
