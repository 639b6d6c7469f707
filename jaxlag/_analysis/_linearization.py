"""The linearized equations of motion, with names."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arguments import name_sequence
from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._core._result import AbstractResult


class Linearization(AbstractResult):
    """x' = f0 + A x + B u, y = y0 + C x + D u: deviations from one point, in minimal coordinates.

    x are the deviations of the states in `states`, u those of the inputs, y the outputs. The units
    are those of the named quantities, per s for x'. Shapes are those of one point. After `jax.vmap`
    every array has the batch axes in front.

    Attributes:
        A: shape (k, k).
        B: shape (k, p).
        C: shape (r, k).
        D: shape (r, p).
        f0: rates of the states at the point, shape (k,); 0 at rest and in a steady motion.
        y0: outputs at the point, shape (r,).
        basis: deviations of (q, v, states) for a unit of each state, shape (2 n + s, k): columns of
            the tangent space of the constraints. With quasi-velocities their free ones in place of
            v. Shape (n + f + s, k) with f free quasi-velocities.
        states: names of x: coordinates `"theta"`, velocities `"theta'"`, quasi-velocities, states.
        inputs: names of u.
        outputs: names of y.
    """

    A: Float[Array, "*batch k k"]
    B: Float[Array, "*batch k p"]
    C: Float[Array, "*batch r k"]
    D: Float[Array, "*batch r p"]
    f0: Float[Array, "*batch k"]
    y0: Float[Array, "*batch r"]
    basis: Float[Array, "*batch s k"]
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single point."""
        return self.A.shape[:-2]

    def __getitem__(self, index: Any) -> Any:
        """Linearizations of a batch by an index."""
        return self._select(index)

    def dropped(self, names: Sequence[str]) -> "Linearization":
        """The same without these states, on which no other rate and no output may depend.

        Raises:
            ValueError: a name that is no state; a kept state or an output that reads one of them.
        """
        names = name_sequence("linearize: drop", names)
        for name in names:
            if name not in self.states:
                must = f"name states among {list(self.states)}"
                raise invalid("linearize: drop", must, f"one was {name!r}")
        gone = np.array([name in names for name in self.states], bool)
        outputs = tuple(f"output {name}" for name in self.outputs)
        readers = (("A", self.states, ~gone), ("C", outputs, np.ones(len(outputs), bool)))
        for field, labels, kept in readers:
            matrix = getattr(self, field)
            if concrete(matrix):
                _check_unread(np.asarray(matrix), labels, kept, gone, self.states)
        left = np.flatnonzero(~gone)
        return Linearization(
            self.A[..., left, :][..., left],
            self.B[..., left, :],
            self.C[..., left],
            self.D,
            self.f0[..., left],
            self.y0,
            self.basis[..., left],
            tuple(self.states[i] for i in left),
            self.inputs,
            self.outputs,
        )


def _check_unread(
    matrix: np.ndarray,
    labels: tuple[str, ...],
    kept: np.ndarray,
    gone: np.ndarray,
    states: tuple[str, ...],
) -> None:
    """Refuse nonzero entries of kept rows in columns that are dropped."""
    size = np.max(np.abs(matrix), axis=tuple(range(matrix.ndim - 2)), initial=0.0)
    floor = float(np.finfo(matrix.dtype).eps) ** 0.75 * np.max(size, axis=1, keepdims=True)
    bad = (size > floor) & kept[:, None] & gone[None]
    if np.any(bad):
        row, column = np.argwhere(bad)[0]
        raise invalid(
            "linearize: drop",
            "leave the others unaffected",
            f"{labels[row]!r} depends on {states[column]!r} by {size[row, column]:.3g}",
            f"Keep {states[column]!r}, or drop {labels[row]!r}, too.",
        )
