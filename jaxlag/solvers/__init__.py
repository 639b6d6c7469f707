"""Solvers of ordinary differential equations, for `simulate` and for diffrax."""

from jaxlag.solvers._dopri8 import Dopri8 as Dopri8
from jaxlag.solvers._unrolled import AbstractUnrolled as AbstractUnrolled
