"""Natural modes of linearized equations: eigenvalues, shapes, participation, stability."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from jaxlag._analysis._eigenpairs import Eigenpairs, eigenpairs, left_vectors
from jaxlag._analysis._linearization import Linearization, require_values
from jaxlag._analysis._mode_table import ModeNumbers, mode_table, shape_of, without_noise
from jaxlag._analysis._plots import plotted_loci, plotted_modes
from jaxlag._core._arrays import as_complex, concrete
from jaxlag._core._by_name import ByName
from jaxlag._core._errors import invalid
from jaxlag._core._result import AbstractResult

ALIKE = 1e-3
"""Relative difference of amplitudes that count as equal, of which the first is scaled to 1."""
NEITHER = "Neither stable nor unstable."


class Modes(AbstractResult):
    """Motions x(t) = vector exp(eigenvalue t) of the linearized equations.

    They are ordered by ascending |eigenvalue|. Conjugate ones are adjacent, that with the positive
    imaginary part first. Every vector is scaled so that the coordinate with the most kinetic
    energy, by its own inertia, has the amplitude 1; so a simple mode without damping and gyroscopic
    terms has a real shape. If no coordinate moves, the largest number of a state is 1. Vectors of
    repeated eigenvalues are any of their eigenspace. `print(modes)` shows a table.

    Derivatives of simple eigenvalues and of their vectors are exact, in every mode and order, if
    others are repeated, too. Those of repeated ones are NaN.

    Attributes:
        eigenvalues: 1/s, shape (k,).
        vectors: amplitudes of the states, one column per mode, shape (k, k); in their units.
        deviations: amplitudes of all coordinates, velocities and states, the rows of
            `linear.basis`, shape (s, k). NaN where a dropped coordinate drifts without bound.
        errors: estimated errors of the eigenvalues by rounding in their computation, 1/s. Errors
            of A are not contained: those by a mass matrix that is nearly singular, or by terms that
            cancel. A stiffness of 1e-17 that should be 0 counts as a stiffness.
        simple: whether rounding cannot merge it with another eigenvalue.
        linear: the linearized equations.
    """

    eigenvalues: Complex[Array, "*batch k"]
    vectors: Complex[Array, "*batch k k"]
    deviations: Complex[Array, "*batch s k"]
    errors: Float[Array, "*batch k"]
    simple: Bool[Array, "*batch k"]
    linear: Linearization

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for the modes of a single point."""
        return self.eigenvalues.shape[:-1]

    def __getitem__(self, index: Any) -> Any:
        """Modes of a batch by an index."""
        return self._select(index)

    @property
    def angular_frequencies(self) -> Float[Array, "*batch k"]:
        """|Im lambda|, rad/s: of the damped oscillation; 0 if there is none."""
        return jnp.abs(jnp.imag(self.eigenvalues))

    @property
    def frequencies(self) -> Float[Array, "*batch k"]:
        """|Im lambda| / (2 pi), Hz."""
        return self.angular_frequencies / (2.0 * np.pi)

    @property
    def natural_frequencies(self) -> Float[Array, "*batch k"]:
        """|lambda|, rad/s: of an oscillation, the frequency without its damping."""
        return _size(self.eigenvalues)

    @property
    def damping_ratios(self) -> Float[Array, "*batch k"]:
        """-Re lambda / |lambda|: below 0 of growing modes; NaN if lambda is 0."""
        size = _size(self.eigenvalues)
        some = size > 0
        ratio = -jnp.real(self.eigenvalues) / jnp.where(some, size, 1.0)
        return jnp.where(some, ratio, jnp.nan)

    @property
    def stable(self) -> Bool[Array, "*batch"]:
        """Whether all modes decay, Re lambda < 0 by more than the errors: asymptotic stability."""
        return jnp.all(jnp.real(self.eigenvalues) < -self.errors, -1)

    @property
    def unstable(self) -> Bool[Array, "*batch"]:
        """Whether a mode grows, Re lambda > 0 by more than its error.

        Modes that neither decay nor grow, as those without damping, leave both False.
        """
        return jnp.any(jnp.real(self.eigenvalues) > self.errors, -1)

    @property
    def shapes(self) -> dict[str, Complex[Array, "..."]]:
        """Amplitudes by name of the coordinate, velocity `"theta'"`, quasi-velocity or state.

        The phase of a number, by `jnp.angle`, is that relative to the largest amplitude.
        """
        return self._by_name(self.deviations)

    @property
    def mass_normalized_shapes(self) -> dict[str, Complex[Array, "..."]]:
        """The same, scaled so that u* M u = 1 for the amplitudes u of the coordinates.

        M is the mass matrix of all coordinates; u* is the conjugate transpose. NaN for modes in
        which no coordinate moves.
        """
        energy = self._energies()
        some = energy > 0
        scale = as_complex(jax.lax.rsqrt(jnp.where(some, energy, 1.0)))
        scaled = _scaled(self.deviations, scale[..., None, :])
        return self._by_name(jnp.where(some[..., None, :], scaled, jnp.nan))

    @property
    def participation(self) -> Complex[Array, "*batch k k"]:
        """Participation factors w_ij x_ji, of state j (row) in mode i (column).

        w are the left eigenvectors with w x = 1. Sums over the states and over the modes are 1.
        They do not depend on units. NaN for repeated eigenvalues.

        Source: Perez-Arriaga, Verghese, Schweppe, IEEE Trans. PAS 101 (1982) 3117.
        """

        def of(modes: "Modes") -> Array:
            pairs = Eigenpairs(modes.eigenvalues, modes.vectors, modes.errors, modes.simple)
            factors = left_vectors(modes.linear.A, pairs).T * modes.vectors
            return jnp.where(modes.simple, factors, jnp.nan)

        return _over(self.batch_shape, of)(self)

    def mac(self, other: Any) -> Float[Array, "*batch k j"]:
        """Modal assurance criterion |u* M w|^2 / (u* M u w* M w), of own modes u and others w.

        1 for shapes that are proportional, 0 for shapes that are orthogonal by M. u and w are the
        amplitudes of all coordinates, M is the own mass matrix. NaN for modes in which no
        coordinate moves.

        Args:
            other: modes of a system with the same coordinates, and of the same batch shape.

        Source: Allemang, Sound and Vibration 37(8) (2003) 14.
        """
        if not isinstance(other, Modes):
            raise invalid("mac: other", "be modes", f"it was {_kind(other)}")
        mine, others = self.linear.coordinates, other.linear.coordinates
        if mine != others:
            raise invalid("mac: other", f"have the coordinates {[*mine]}", f"it had {[*others]}")
        if self.batch_shape != other.batch_shape:
            must, was = f"have batch shape {self.batch_shape}", f"it had {other.batch_shape}"
            raise invalid("mac: other", must, was)
        M = self.linear.mass
        scale = self._energies()[..., :, None] * other._energies(M)[..., None, :]
        some = scale > 0
        u, w = (_finite(x.deviations[..., : M.shape[-1], :]) for x in (self, other))
        across = jnp.swapaxes(jnp.conj(u), -1, -2) @ as_complex(M) @ w
        found = (jnp.real(across) ** 2 + jnp.imag(across) ** 2) / jnp.where(some, scale, 1.0)
        return jnp.where(some, found, jnp.nan)

    def plot(self) -> Any:
        """Eigenvalues in the complex plane, beside them the shapes of a single point.

        A batch is a root locus: one colour from the first point to the last. Shapes are the
        amplitudes and phases of coordinates, times the roots of their inertias.

        Needs matplotlib, from the extra "plot".

        Returns:
            A `matplotlib.figure.Figure`.
        """
        require_values("plot", self)
        if self.batch_shape:
            return plotted_loci(np.asarray(self.eigenvalues))
        return plotted_modes(self._numbers())

    def __str__(self) -> str:
        k = self.eigenvalues.shape[-1]
        if self.batch_shape:
            return f"{k} modes of each of a batch of shape {self.batch_shape}"
        return mode_table(self._numbers()) if concrete(self) else f"{k} modes, traced"

    def _numbers(self) -> ModeNumbers:
        names, states = self.linear.coordinates, self.linear.states
        inertias = np.diagonal(np.asarray(self.linear.mass))
        moved = np.asarray(self.deviations)[: len(names)]
        vectors, values = np.asarray(self.vectors), np.asarray(self.eigenvalues)
        columns = range(values.shape[0])
        verdict = "Stable." if self.stable else "Unstable." if self.unstable else NEITHER
        if np.any(np.isnan(values)):
            verdict = "The eigenvalues are NaN."
        return ModeNumbers(
            without_noise(values, np.asarray(self.errors)),
            np.asarray(self.damping_ratios),
            np.asarray(self.simple),
            [shape_of(names, inertias, moved[:, i], states, vectors[:, i]) for i in columns],
            [[names[j] for j in np.flatnonzero(np.isnan(moved[:, i]))] for i in columns],
            verdict,
        )

    def _by_name(self, deviations: Array) -> dict[str, Array]:
        found, start, batch = ByName(), 0, self.batch_shape
        for name, shape in self.linear.layout:
            stop = start + int(np.prod(shape, dtype=int))
            rows = jnp.swapaxes(deviations[..., start:stop, :], -1, -2)
            found.setdefault(name, rows.reshape(*batch, -1, *shape))
            start = stop
        return found

    def _energies(self, M: Array | None = None) -> Float[Array, "*batch k"]:
        """u* M u of the coordinates, mode by mode; 0 where one is NaN."""
        M = self.linear.mass if M is None else M
        u = self.deviations[..., : M.shape[-1], :]
        known, u = ~jnp.any(jnp.isnan(u), -2), _finite(u)
        energies = jnp.real(jnp.sum(jnp.conj(u) * (as_complex(M) @ u), -2))
        return jnp.where(known, energies, 0.0)


def modes(linear: Any) -> Modes:
    """Natural modes of linearized equations: A x = lambda x.

    Of equations with damping or gyroscopic terms shapes are complex: coordinates pass their
    extremes one after the other. The equations may be those about a steady motion. About a state
    that is none, the modes are those of constant coefficients.

    Args:
        linear: of `jl.linearize`; of a batch of it, modes of each.

    Returns:
        `Modes`.

    Raises:
        ValueError: no linearization; one without states.

    Source: Meirovitch, Fundamentals of Vibrations, McGraw-Hill 2001, sec. 7.

    Example:
        Two equal masses between three equal springs:

        >>> import jax, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> system = jl.System(
        ...     lambda t, q, v, params: (
        ...         0.5 * v @ v - 0.5 * (q[0] ** 2 + (q[1] - q[0]) ** 2 + q[1] ** 2)
        ...     ),
        ...     ("x", "y"),
        ... )
        >>> modes = jl.modes(jl.linearize(system, [0.0, 0.0], [0.0, 0.0]))
        >>> print(modes)
        mode  eigenvalue  rad/s  Hz      damping ratio  shape
        1, 2  0 ± 1i      1      0.1592  0              x 1, y 1
        3, 4  0 ± 1.732i  1.732  0.2757  0              x 1, y -1
        Neither stable nor unstable.
    """
    if not isinstance(linear, Linearization):
        fix = "Write jl.modes(jl.linearize(system, q, v, params))."
        raise invalid("modes: linear", "be linearized equations", f"it was {_kind(linear)}", fix)
    if not linear.states:
        raise invalid("modes: linear", "have states", "all were dropped, or none was free")
    return _over(linear.batch_shape, _modes)(linear)


def _kind(x: Any) -> str:
    """A number as it is, other things by their type."""
    return repr(x) if isinstance(x, int | float) else f"of type {type(x).__name__}"


def _over(batch: tuple[int, ...], function: Any) -> Any:
    """The function of one point, batched over all leading axes."""
    for _ in batch:
        function = jax.vmap(function)
    return function


@jax.jit
def _modes(linear: Linearization) -> Modes:
    pairs = eigenpairs(linear.A)
    deviations = _deviations(linear, pairs)
    size = _finite(jax.lax.stop_gradient(deviations))
    inertias = jnp.diagonal(linear.mass)
    weights = jnp.sqrt(jnp.maximum(jax.lax.stop_gradient(inertias), 0.0))
    weights = jnp.concatenate([weights, jnp.zeros_like(size[weights.size :, 0].real)])
    moved = jnp.abs(size) * weights[:, None]
    moved = jnp.where(jnp.any(moved > 0, 0), moved, jnp.abs(size))
    largest = jnp.argmax(moved >= (1.0 - ALIKE) * jnp.max(moved, 0), 0)  # the first of equal ones
    scale = jnp.take_along_axis(deviations, largest[None], 0)
    return Modes(
        pairs.values,
        pairs.vectors / scale,
        _scaled(deviations, 1.0 / scale),
        pairs.errors,
        pairs.simple,
        linear,
    )


def _deviations(linear: Linearization, pairs: Eigenpairs) -> Complex[Array, "s k"]:
    """Amplitudes of all deviations; NaN where a dropped state x_d grows with t.

    (lambda - A_dd) x_d = A_d x for dropped states.
    """
    x, whole = pairs.vectors, linear.whole
    if whole is None:
        return as_complex(linear.basis) @ x
    kept = np.array([name in linear.states for name in whole.states], bool)
    rates = whole.A[~kept]
    own, driven = rates[:, ~kept], as_complex(rates[:, kept]) @ x
    poles = jnp.linalg.eigvals(jax.lax.stop_gradient(own))
    apart = jnp.min(jnp.abs(pairs.values[:, None] - poles), 1)
    pole = apart <= jax.lax.stop_gradient(pairs.errors)
    beside = as_complex(1.0 + 2.0 * jnp.linalg.norm(jax.lax.stop_gradient(own)))
    values = jnp.where(pole, beside, pairs.values)
    one = jnp.eye(own.shape[0], dtype=x.dtype)
    dropped = jax.vmap(partial(_resolved, as_complex(own), one), (0, 1), 1)(values, driven)
    moving = driven != 0
    for _ in range(own.shape[0] - 1):  # those that others of them drive
        moving |= (own != 0).astype(own.dtype) @ moving.astype(own.dtype) > 0
    along = as_complex(whole.basis[:, ~kept])
    drifts = pole & ((along != 0).astype(own.dtype) @ moving.astype(own.dtype) > 0)
    found = as_complex(whole.basis[:, kept]) @ x + along @ dropped
    return jnp.where(drifts, jnp.nan, found)


def _resolved(A: Array, one: Array, value: Array, b: Array) -> Array:
    return jnp.linalg.solve(value * one - A, b)


def _size(x: Complex[Array, "*k"]) -> Float[Array, "*k"]:
    """|x|, with derivative 0 at 0."""
    some = x != 0
    return jnp.where(some, jnp.abs(jnp.where(some, x, jnp.ones_like(x))), 0.0)


def _scaled(x: Array, factor: Array) -> Array:
    """x times the factor; NaN stays NaN, and leaves derivatives of the factor as they are."""
    return jnp.where(jnp.isnan(x), x, _finite(x) * factor)


def _finite(x: Array) -> Array:
    """0 in place of NaN, without derivative there."""
    return jnp.where(jnp.isnan(x), jnp.zeros_like(x), x)
