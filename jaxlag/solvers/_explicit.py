"""Explicit methods, unrolled stage by stage or in a loop over their stages."""

from abc import abstractmethod
from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar

import diffrax
import equinox as eqx

from jaxlag.solvers._stages import Attempt, in_loop, nystrom, written_out
from jaxlag.solvers._tableau import Tableau, of_runge_kutta
from jaxlag.solvers._unweighted_stages import at_least

# Lines of dy/dt times stages up to which steps are unrolled. Measured with order 8, seconds of
# tracing and compiling and microseconds per step, unrolled | in a loop: elastic pendulum (21
# lines) 0.9, 0.25 | 0.6, 0.37; heavy top (39) 1.2, 0.44 | 1.1, 0.87; 3 links (85) 1.7, 1.2 | 0.7,
# 1.8; 4 links (156) 2.0, 1.5 | 0.8, 1.6; 15 coordinates of 5 bodies (223) 2.4, 2.2 | 0.8, 2.0;
# double pendulum with constraints (242) 4.9, 0.7 | 3.1, 1.3; aircraft (366) 5.4, 4.7 | 2.9, 5.5; 6
# links (375) 4.8, 2.6 | 1.5, 2.3.
WRITTEN_OUT = 1600


def in_loop_over_stages(lines: int | None, stages: int) -> bool:
    """Whether a step is a loop over its stages: the program then contains dy/dt once.

    Args:
        lines: number of lines of straight-line code for dy/dt; None for a program on arrays.
        stages: number of stages of the method.
    """
    return lines is None or lines * stages > WRITTEN_OUT


class AbstractExplicit(diffrax.AbstractAdaptiveSolver):
    """An explicit one-step method: stages, each from those before it, and weighted sums of them.

    Unrolled, a stage is a sum of the stages before it without the zeros of the tableau. A step is
    then straight-line code, and a loop of steps over a small system is one function
    without calls. In a loop over stages the program contains dy/dt once: it compiles in a fraction
    of the time, and runs as fast if dy/dt is long. If terms are compiled to be used `in_lanes`,
    every number of the state is a row of lanes, and sums are of such rows, not of tables.

    If stages without weight meet a force that the others miss, the error estimate is larger, see
    `unseen`: no step passes through a wall that one of its stages met. With a
    loop over stages, reverse derivatives need `made_jump` to be known while tracing.

    Attributes:
        looped: whether there is a loop over stages. None: the faster choice in `simulate`, and
            unrolled elsewhere.
    """

    looped: bool | None = eqx.field(static=True, default=None)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable]

    @property
    @abstractmethod
    def coefficients(self) -> Tableau:
        """The coefficients; `tableau_of` computes them once."""

    @abstractmethod
    def error_order(self, terms: Any) -> Any:
        """Order of the local error estimate."""

    @property
    def stages(self) -> int:
        """Number of stages that a step evaluates."""
        tableau = tableau_of(type(self))
        return len(tableau.c) + (0 if tableau.fsal else 1)

    @property
    def shares_stages(self) -> bool:
        """Whether the last stage of a step is the first one of the next."""
        return tableau_of(type(self)).fsal

    @property
    def steps_as_declared(self) -> bool:
        """Whether a step is that of the coefficients, and no subclass overrides it."""
        return type(self).step is AbstractExplicit.step

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The first stage of the first step, if steps share a stage."""
        return terms.vf(t0, y0, args) if tableau_of(type(self)).fsal else None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """dy/dt."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, diffrax.RESULTS]:
        """One step from t0 to t1: (y1, error estimate, stages, first stage of the next, result).

        If `made_jump` is the constant True, `solver_state` is not read.
        """
        y1, error, beside, k, last = self.attempt(terms, t0, t1, y0, args, solver_state, made_jump)
        # diffrax's interpolation takes the stages as increments.
        dense = {"y0": y0, "y1": y1, "k": k}
        return y1, at_least(error, beside), dense, last, diffrax.RESULTS.successful

    @abstractmethod
    def attempt(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Attempt:
        """The same, with the two parts of its error estimate separate."""


class AbstractRungeKutta(AbstractExplicit):
    """An explicit Runge-Kutta method.

    k_i = f(t + c_i h, y + h sum_{j<i} a_ij k_j), y1 = y + h sum_i b_i k_i; the error estimate is
    h sum_i e_i k_i. The units are those of the problem; y is any pytree of arrays.

    If the terms are of `second_order`, y = (q, v) with dq/dtau = sigma v, dv/dtau
    = sigma a, sigma = -1 if time runs backwards, an unrolled step has
    Nystrom's form with k_i = sigma a_i,

        v_i = v + h sum_j a_ij k_j,    q_i = q + h sigma (c_i v + h sum_j (A A)_ij k_j).

    This is the same method, but stages are coupled only by accelerations, and q_i does not depend
    on the previous stage: its sines and cosines can be computed earlier.

    The last stage of a method whose last row of the tableau is its weights (FSAL) is the first
    one of the next step.

    Steps, error estimates and interpolation are those of `stock`, up to the order of sums and the
    error of unweighted stages.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.1, II.14.
    """

    @property
    @abstractmethod
    def stock(self) -> diffrax.AbstractERK:
        """The same method as a class of diffrax."""

    @property
    def coefficients(self) -> Tableau:
        """Those of `stock`."""
        return of_runge_kutta(self.stock.tableau)

    def order(self, terms: Any) -> int:
        """Order of the step."""
        order = self.stock.order(terms)
        assert order is not None
        return int(order)

    def error_order(self, terms: Any) -> Any:
        """Order of the local error estimate."""
        return self.stock.error_order(terms)

    def attempt(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Attempt:
        """One step in Nystrom's form if it has one, else of first-order equations."""
        tableau = tableau_of(type(self))
        fresh = True if not tableau.fsal else made_jump
        unrolled = nystrom if getattr(terms, "second_order", False) else written_out
        stages = in_loop if self.looped else unrolled
        return stages(tableau, terms, t0, t1, y0, solver_state, fresh, args)


@lru_cache
def tableau_of(method: type[AbstractExplicit]) -> Tableau:
    """The coefficients of a method."""
    return method().coefficients
