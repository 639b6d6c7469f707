"""The linearized equations of motion, with names."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxlag._analysis._plots import plotted_responses
from jaxlag._core._arguments import name_sequence
from jaxlag._core._arrays import as_complex, concrete, real
from jaxlag._core._errors import invalid, unsupported
from jaxlag._core._result import AbstractResult

STEADY = 1e-6
"""Largest accelerations, and their rates, of a steady motion, over the entries of rows of A."""
LEAST = 1e-6
"""Eigenvalues below this part of the largest are 0 for a diagram."""


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
        mass: mass matrix M of all coordinates at the point, shape (n, n).
        whole: the same before states were dropped; None if all are kept.
        states: names of x: coordinates `"theta"`, velocities `"theta'"`, quasi-velocities, states.
        inputs: names of u.
        outputs: names of y.
        coordinates: labels of all n coordinates.
        layout: name and shape of what the rows of `basis` are, in order.
    """

    A: Float[Array, "*batch k k"]
    B: Float[Array, "*batch k p"]
    C: Float[Array, "*batch r k"]
    D: Float[Array, "*batch r p"]
    f0: Float[Array, "*batch k"]
    y0: Float[Array, "*batch r"]
    basis: Float[Array, "*batch s k"]
    mass: Float[Array, "*batch n n"]
    whole: "Linearization | None"
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    coordinates: tuple[str, ...] = eqx.field(static=True)
    layout: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)

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
        if not names:
            return self
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
            self.mass,
            self if self.whole is None else self.whole,
            tuple(self.states[i] for i in left),
            self.inputs,
            self.outputs,
            self.coordinates,
            self.layout,
        )

    def frequency_response(
        self, w: Any, *, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None
    ) -> Complex[Array, "... r p"]:
        """G(iw) = C (iw - A)^-1 B + D: amplitudes of the outputs for inputs exp(iwt).

        It is that of the forced oscillation, which is reached if the point is stable. Where iw is
        an eigenvalue, it is infinite or NaN.

        Args:
            w: angular frequencies, any shape; rad/s.
            inputs: names of the columns; all in place of None.
            outputs: names of the rows; all in place of None.

        Returns:
            Complex amplitudes in units of the outputs over those of the inputs, of shape (*batch,
            *w.shape, r, p). Their phase is positive where an output leads.

        Raises:
            ValueError: an unknown name; w that is not real.
        """
        w = real("frequency_response: w", w)
        columns = _places("frequency_response: inputs", inputs, self.inputs)
        rows = _places("frequency_response: outputs", outputs, self.outputs)
        A, B, C, D = self.A, self.B[..., columns], self.C[..., rows, :], self.D[..., rows, :]
        s = jax.lax.complex(jnp.zeros_like(w, A.dtype), w.astype(A.dtype))
        one = jnp.eye(A.shape[-1], dtype=s.dtype)

        def of(A: Array, B: Array, C: Array, D: Array) -> Array:
            each = jax.vmap(lambda s: C @ jnp.linalg.solve(s * one - A, B) + D)
            return each(s.reshape(-1)).reshape(*s.shape, *D.shape)

        for _ in self.batch_shape:
            of = jax.vmap(of)
        return of(*map(as_complex, (A, B, C, D[..., columns])))

    def plot(self, w: Any = None) -> Any:
        """Bode diagram: amplitudes and phases of the outputs over those of the inputs.

        Needs matplotlib, from the extra "plot".

        Args:
            w: angular frequencies in rad/s, positive and ascending; None for those from a tenth of
                the smallest to ten times the largest eigenvalue.

        Returns:
            A `matplotlib.figure.Figure`.

        Raises:
            ValueError: a batch; no inputs or no outputs; other w; matplotlib is not installed.
        """
        self.require_single("plot")
        require_values("plot", self)
        for name, what in (("inputs", self.inputs), ("outputs", self.outputs)):
            if not what:
                fix = f"Write jl.linearize(..., {name}=...)."
                raise unsupported("`plot`", f"there are no {name}", fix)
        if not np.all(np.isfinite(self.A)):
            raise unsupported("`plot`", "A is not finite", "See jl.linearize for the point.")
        w = self._range() if w is None else _ascending(w)
        response = np.asarray(self.frequency_response(w))
        return plotted_responses(w, response, self.outputs, self.inputs)

    def _range(self) -> np.ndarray:
        """Angular frequencies around the eigenvalues."""
        sizes = np.abs(np.linalg.eigvals(np.asarray(self.A)))
        sizes = sizes[sizes > LEAST * np.max(sizes, initial=0.0)]
        low, high = (np.min(sizes), np.max(sizes)) if sizes.size else (1.0, 1.0)
        return np.geomspace(low / 10, high * 10, 500)

    def to_control(self) -> Any:
        """As a `control.StateSpace` of python-control, with names.

        Without outputs all states are outputs. Deviations are those from the motion through the
        point: it must be a state of rest or a steady motion, as f0 has no place there.

        Needs python-control, from the extra "control".

        Raises:
            ValueError: a batch; a motion that is not steady; a name with "."; python-control is not
                installed.
        """
        self.require_single("to_control")
        try:
            import control
        except ImportError as error:
            raise unsupported(
                "`to_control`", "python-control is not installed", 'pip install "jaxlag[control]"'
            ) from error
        require_values("to_control", self)
        A, B, C, D, f0 = (np.asarray(x) for x in (self.A, self.B, self.C, self.D, self.f0))
        moving = np.array([name not in self.coordinates for name in self.states], bool)
        sizes = np.sum(np.abs(A), 1)
        speed = np.max(np.abs(f0), initial=0.0)
        tests = ("the rate of", f0 * moving, 1.0), ("the rate of f0 of", A @ f0, speed)
        for what, rates, allowed in tests:
            fast = np.flatnonzero(~(np.abs(rates) <= STEADY * np.maximum(sizes, 1.0) * allowed))
            if fast.size:
                must = "be a state of rest or a steady motion"
                was = f"{what} {self.states[fast[0]]!r} was {rates[fast[0]]:.3g}"
                fix = "Take a state of rest from jl.equilibrium."
                raise invalid("to_control: the point", must, was, fix)
        outputs = self.outputs
        if not outputs:
            C, D, outputs = np.eye(len(A)), np.zeros_like(B), self.states
        for name in (*self.states, *self.inputs, *outputs):
            if "." in name:
                fix = "Rename it, or give outputs as a dict."
                raise unsupported("`to_control`", f"its names have no '.', as {name!r} has", fix)
        return control.ss(
            A, B, C, D, states=[*self.states], inputs=[*self.inputs], outputs=[*outputs]
        )


def require_values(what: str, result: Any) -> None:
    """Refuse `what` for traced numbers.

    Raises:
        ValueError: an array is traced.
    """
    if not concrete(result):
        raise unsupported(f"`{what}`", "numbers are traced", "Call it outside of jax.jit.")


def _ascending(w: Any) -> np.ndarray:
    """Angular frequencies of a diagram."""
    w = np.asarray(real("plot: w", w))
    if w.ndim != 1 or not w.size or not np.all(np.diff(w, prepend=0.0) > 0):
        must = "be positive and ascending, along one axis"
        raise invalid("plot: w", must, f"it was {w}", "Write np.geomspace(0.1, 100.0, 500).")
    return w


def _places(argument: str, names: Sequence[str] | None, known: tuple[str, ...]) -> np.ndarray:
    """Indices of names; of all without names."""
    if names is None:
        return np.arange(len(known))
    for name in name_sequence(argument, names):
        if name not in known:
            raise invalid(argument, f"be names among {[*known]}", f"one was {name!r}")
    return np.array([known.index(name) for name in names], int)


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
