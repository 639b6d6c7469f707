"""Explicit Runge-Kutta steps written out stage by stage."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax


class AbstractUnrolled(diffrax.AbstractAdaptiveSolver):
    """An explicit Runge-Kutta method without a loop over its stages.

    k_i = f(t + c_i h, y + h sum_{j<i} a_ij k_j), y1 = y + h sum_i b_i k_i; the error estimate is
    h sum_i e_i k_i. The units are those of the problem; y is any pytree of arrays.

    A stage is a sum of the stages before it with the zeros of the tableau left out, so that a
    step is straight-line code and a loop of steps over a small system one function without calls.
    Where the terms have a method `elements`, stages work on the elements of y one by one, and y
    is put together again at the end of the step.

    The last stage of a method whose last row of the tableau is its weights (FSAL) is the first
    one of the next step.

    Steps, error estimates and interpolation are those of `stock`, up to the order of sums.

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, sec. II.1.

    Attributes:
        stock: the same method with a loop over stages.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable]

    @property
    @abstractmethod
    def stock(self) -> diffrax.AbstractERK:
        """The same method with a loop over stages."""

    def order(self, terms: Any) -> int:
        """Order of the step."""
        order = self.stock.order(terms)
        assert order is not None
        return int(order)

    def error_order(self, terms: Any) -> Any:
        """Order of the local error estimate."""
        return self.stock.error_order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The first stage of the first step, where steps share one."""
        tableau: Any = self.stock.tableau
        return terms.vf(t0, y0, args) if tableau.fsal else None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """dy/dt."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, diffrax.RESULTS]:
        """One step from t0 to t1: (y1, error estimate, stages, first stage of the next, result)."""
        tableau: Any = self.stock.tableau
        if not tableau.fsal:
            first = terms.vf(t0, y0, args)
        elif made_jump is False:
            first = solver_state
        else:
            first = lax.cond(
                made_jump, lambda _: terms.vf(t0, y0, args), lambda known: known, solver_state
            )
        h = terms.contr(t0, t1)
        by_element = getattr(terms, "elements", None)
        split = by_element is not None
        apart = _elements if split else jax.tree.leaves
        y, k = apart(y0), [apart(first)]
        structure = jax.tree.structure(y0)
        for row, c in zip(tableau.a_lower, tableau.c, strict=True):
            t = t1 if c == 1.0 else t0 + c * (t1 - t0)
            stage = _advanced(y, h, row, k)
            if by_element is not None:
                k.append(list(by_element(t, stage, args)))
            else:
                k.append(jax.tree.leaves(terms.vf(t, jax.tree.unflatten(structure, stage), args)))
        # Where the last row of the tableau is the weights, the last stage was taken at y1.
        y1 = stage if tableau.fsal else _advanced(y, h, tableau.b_sol, k)
        error = _advanced(None, h, tableau.b_error, k)

        def whole(parts: Sequence[Array]) -> Any:
            return jnp.stack(parts) if split else jax.tree.unflatten(structure, parts)

        rates = [whole(stage) for stage in k]
        # diffrax's interpolation takes the stages as increments.
        stages = jax.tree.map(lambda *parts: h * jnp.stack(parts), *rates)
        dense = {"y0": y0, "y1": whole(y1), "k": stages}
        last = rates[-1] if tableau.fsal else None
        return dense["y1"], whole(error), dense, last, diffrax.RESULTS.successful


def _elements(y: Array) -> list[Array]:
    return [lax.squeeze(lax.slice_in_dim(y, i, i + 1), (0,)) for i in range(y.shape[0])]


def _advanced(
    y: Sequence[Array] | None, h: Array, weights: np.ndarray, k: Sequence[Sequence[Array]]
) -> list[Array]:
    """y + h sum_j weights_j k_j, element by element; without y the sum alone."""
    used = [(float(w), stage) for w, stage in zip(weights, k, strict=False) if w != 0.0]
    out = []
    for i in range(len(k[0])):
        total = used[0][0] * used[0][1][i]
        for w, stage in used[1:]:
            total = total + w * stage[i]
        out.append(h * total if y is None else y[i] + h * total)
    return out
