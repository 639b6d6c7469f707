r"""Identify a pendulum from measured motion: `python -m systems fit-pendulum [CSV.gz]`.

A rigid body swings about a fixed horizontal axis, freely or driven by a motor:

        o====== torque u
         \
          \ l          L = 1/2 J q'^2 + m g l cos(q - zero)
           \
            O  m       J q'' = -m g l sin(q - zero) - c q' - f tanh(q'/V_S) - k q'|q'| + u + u0

Coordinate
    q      measured angle [rad], 0 where the sensor says hanging, positive counterclockwise

Parameters (torque known, else all but `zero` divided by J, which a free swing cannot tell)
    J      moment of inertia about the axis [kg m^2]
    mgl    mass x gravity x distance of the centre of mass from the axis [N m]
    c      viscous friction [N m s]
    f      Coulomb friction [N m], smoothed below |q'| = V_S
    k      quadratic drag [N m s^2]
    u0     constant error of the torque sensor [N m]
    zero   angle that the sensor shows where the pendulum really hangs [rad]

The recording is cut in windows, 1 s long; each has a free start (q, q') of its own, the
parameters are common to all. Levenberg-Marquardt minimises the sum of squares of simulated minus
measured angle; measured velocities are not used, being filtered in one way or another. The models
differ in their friction: viscous, + Coulomb, + quadratic. Their parameters come from the training
windows alone; on test windows only the starts are fitted anew.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import jaxlag as jl
from systems._pendulum_data import DataError, Recording, Segment, Windows, bad, cut, read, split

NAMES = ("J", "mgl", "c", "f", "k", "u0", "zero")
MODELS = {"viscous": ("c",), "+ Coulomb": ("c", "f"), "+ quadratic": ("c", "f", "k")}
V_S = 0.1  # rad/s; between 0.01 and 0.5 the fits of a free swing stay the same
MRAD = 1e-3
FIT_RATE = 100.0  # Hz, of a free swing's residuals; the table's rms are over all samples
PREDICT_FROM = 0.1  # s
# mrad, noted with these recordings: of whole segments, of 1 s windows for the last two.
NOTED_RMS = {
    "single.csv.gz": {"viscous": 7.8, "+ Coulomb": 6.7, "+ quadratic": 2.05},
    "ddp.csv.gz": {"+ Coulomb": 3.3},
    "ilqr.csv.gz": {"+ Coulomb": 26.0},
}


# The system.


def kinetic(t, q, v, params):
    """T = 1/2 J q'^2 [J]."""
    return 0.5 * params["J"] * v[0] ** 2


def potential(t, q, params):
    """V = -m g l cos(q - zero) [J]."""
    return -params["mgl"] * jnp.cos(q[0] - params["zero"])


def dissipation(t, q, v, params):
    """R = 1/2 c q'^2 + f V_S log cosh(q'/V_S) + 1/3 k |q'|^3 [W]."""
    x = v[0] / V_S
    log_cosh = jnp.logaddexp(x, -x) - jnp.log(2.0)
    speed = jnp.abs(v[0])
    return 0.5 * params["c"] * speed**2 + params["f"] * V_S * log_cosh + params["k"] * speed**3 / 3


def motor(t, q, v, params, inputs):
    """Q = u + u0 [N m]."""
    return (inputs["torque"] + params["u0"])[None]


friction = jl.Rayleigh(dissipation, "friction")
free = jl.System(
    coordinates=("theta",), kinetic=kinetic, potential=potential, forces=(friction,)
)
driven = jl.System(
    coordinates=("theta",),
    kinetic=kinetic,
    potential=potential,
    forces=(friction, jl.GeneralizedForce(motor, "motor")),
)


def simulated_angle(
    params: Mapping[str, Array | float], start: Float[Array, " 2"], window: Windows
) -> Float[Array, " s"]:
    """Angle (rad) at the times of one window, from `start` = (q, q').

    Steps of order 5 are fixed, one per sample of a free swing, one per pair of torque samples of a
    driven one. At 100 Hz they differ from a solution at tolerance 1e-10 by less than 1e-6 rad.

    The torque between samples is interpolated linearly: the recording holds samples of a motor
    current, which is continuous, not the commands that were held.
    """
    if window.tau is None:
        system, inputs, step = free, None, window.t[1]
    else:
        # A step as long as the window is always cut short by the torque's next sample.
        system, inputs, step = driven, {"torque": jl.Linear(window.t, window.tau)}, window.t[-1]
    motion = jl.simulate(
        system,
        start[:1],
        start[1:],
        window.t,
        params,
        inputs=inputs,
        method="tsit5",
        dt=step,
        max_steps=2 * window.t.shape[0],
        throw=False,
    )
    return motion["theta"]


# The fit.


class Fit(NamedTuple):
    """Parameters and starts at the least sum of squares.

    Attributes:
        values: all parameters, by name.
        errors: standard errors of the estimated ones, if the residuals were independent.
        starts: (q, q') at the start of every window (w, 2), rad, rad/s.
        residuals: simulated minus measured angle (w, s), mrad, at the samples fitted.
        converged: whether the optimiser met its tolerance.
    """

    values: dict[str, float]
    errors: dict[str, float]
    starts: Float[np.ndarray, "w 2"]
    residuals: Float[np.ndarray, "w s"]
    converged: bool

    @property
    def correlation(self) -> float:
        """Correlation of successive residuals."""
        r = self.residuals
        return float(np.sum(r[:, 1:] * r[:, :-1]) / np.sum(r**2))


class _Problem(NamedTuple):
    """Parameters are `guess + scale z`: a scale of 0 holds one."""

    guess: Float[Array, " p"]
    scale: Float[Array, " p"]
    windows: Windows


def _residual(
    z: Float[Array, " p"], start: Float[Array, " 2"], problem: _Problem
) -> Float[Array, " s"]:
    params = dict(zip(NAMES, problem.guess + problem.scale * z, strict=True))
    return (simulated_angle(params, start, problem.windows) - problem.windows.q) / MRAD


def _per_window(function):
    """`function` of (z, start, problem), mapped over the windows."""
    return jax.vmap(function, in_axes=(None, 0, _Problem(None, None, 0)))


def _value_and_derivatives(z, start, problem):
    def twice(z, start):
        residual = _residual(z, start, problem)
        return residual, residual

    derivatives, residual = jax.jacfwd(twice, argnums=(0, 1), has_aux=True)(z, start)
    return residual, derivatives


@jax.custom_jvp
def _residuals(
    z: Float[Array, " p"], starts: Float[Array, "w 2"], problem: _Problem
) -> Float[Array, "w s"]:
    """Residuals of all windows, mrad."""
    return _per_window(_residual)(z, starts, problem)


@_residuals.defjvp
def _residuals_jvp(primals, tangents):
    """Each window is differentiated by its own start only: p + 2 directions, not p + 2 w."""
    residuals, (by_z, by_start) = _per_window(_value_and_derivatives)(*primals)
    dz, dstarts, _ = tangents
    return residuals, by_z @ dz + jnp.einsum("wsi,wi->ws", by_start, dstarts)


@jax.jit
def _solve(starts: Float[Array, "w 2"], problem: _Problem):
    solution = optx.least_squares(
        lambda unknowns, problem: _residuals(*unknowns, problem).ravel(),
        optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8),
        (jnp.zeros(len(NAMES)), starts),
        args=problem,
        options={"jac": "fwd"},
        max_steps=100,
        throw=False,
    )
    z, starts = solution.value
    residuals, derivatives = _per_window(_value_and_derivatives)(z, starts, problem)
    converged = solution.result == optx.RESULTS.successful
    return problem.guess + problem.scale * z, starts, residuals, derivatives, converged


@jax.jit
def residuals_at(
    values: Mapping[str, float], starts: Float[Array, "w 2"], windows: Windows
) -> Float[Array, "w s"]:
    """Simulated minus measured angle (w, s), mrad."""
    guess = jnp.array([values[name] for name in NAMES])
    problem = _Problem(guess, jnp.zeros_like(guess), windows)
    return _residuals(jnp.zeros_like(guess), starts, problem)


def parameters(model: str, driven: bool) -> tuple[str, ...]:
    """Names of what is estimated under a model of friction."""
    terms = ("mgl", *MODELS[model], "zero")
    return ("J", "u0", *terms) if driven else terms


def fit(
    windows: Windows, estimate: Sequence[str], held: Mapping[str, float] | None = None
) -> Fit:
    """Least squares for the parameters named in `estimate` and the start of every window.

    Args:
        windows: measured motion.
        estimate: names of NAMES; none to fit the starts alone.
        held: values of the other parameters; by default J = 1 and the rest 0.
    """
    held = dict.fromkeys(NAMES, 0.0) | {"J": 1.0} | dict(held or {})
    guess, scale = _guess(windows, estimate, held)
    problem = _Problem(jnp.asarray(guess), jnp.asarray(scale), jax.tree.map(jnp.asarray, windows))
    values, starts, residuals, derivatives, converged = jax.tree.map(
        np.asarray, _solve(jnp.asarray(_guess_starts(windows)), problem)
    )
    errors = np.full(len(NAMES), np.nan)
    chosen = scale != 0
    errors[chosen] = scale[chosen] * _standard_errors(residuals, *derivatives, chosen)
    return Fit(
        dict(zip(NAMES, values.tolist(), strict=True)),
        {name: float(errors[NAMES.index(name)]) for name in estimate},
        starts,
        residuals,
        bool(converged),
    )


def _standard_errors(
    residuals: Float[np.ndarray, "w s"],
    by_z: Float[np.ndarray, "w s p"],
    by_start: Float[np.ndarray, "w s 2"],
    chosen: np.ndarray,
) -> np.ndarray:
    """Square roots of the diagonal of s^2 (J^T J)^-1, J with all starts, s^2 = r.r / (n - unknowns).

    The starts are eliminated window by window: what is left of each parameter's derivative is its
    part orthogonal to the derivatives by the window's own start.
    """
    basis = np.linalg.qr(by_start).Q
    by_z = by_z[..., chosen]
    rest = by_z - basis @ (np.swapaxes(basis, 1, 2) @ by_z)
    normal = np.einsum("wsi,wsj->ij", rest, rest)
    unknowns = by_z.shape[-1] + by_start.shape[0] * by_start.shape[2]
    variance = np.sum(residuals**2) / (residuals.size - unknowns)
    return np.sqrt(variance * np.diag(np.linalg.inv(normal)))


def _guess_starts(windows: Windows) -> np.ndarray:
    """(q, q') at every start, from a parabola through the window's first 0.1 s."""
    first = windows.first(PREDICT_FROM)
    fits = [np.polyfit(t, q, 2) for t, q in zip(first.t, first.q, strict=True)]
    return np.stack(fits)[:, :0:-1]


def _guess(
    windows: Windows, estimate: Sequence[str], held: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """(guess, scale) of all parameters, from a linear regression of the equation of motion.

    Rates are differences over 0.05 s. A parameter's scale makes its term as large as the sum of
    all; `zero`, which is not linear, starts from the value held and has scale 1.
    """
    h = max(1, round(0.05 / windows.t[0, 1]))
    q, step = windows.q[:, h:-h], h * windows.t[0, 1]
    before, after = windows.q[:, : -2 * h], windows.q[:, 2 * h :]
    v, a = (after - before) / (2 * step), (after - 2 * q + before) / step**2
    terms = {
        "J": a,
        "mgl": np.sin(q),
        "c": v,
        "f": np.tanh(v / V_S),
        "k": v * np.abs(v),
        "u0": -np.ones_like(q),
    }
    torque = np.zeros_like(q) if windows.tau is None else windows.tau[:, h:-h]
    linear = [name for name in estimate if name in terms]
    target = torque - sum(held[name] * terms[name] for name in terms if name not in linear)
    values, scale = dict(held), dict.fromkeys(NAMES, 0.0)
    if linear:
        columns = np.stack([terms[name].ravel() for name in linear], axis=1)
        solution = np.linalg.lstsq(columns, target.ravel())[0]
        values |= dict(zip(linear, solution, strict=True))
        scale |= {name: _rms(target) / _rms(terms[name]) for name in linear}
    if "zero" in estimate:
        scale["zero"] = 1.0
    return np.array([values[n] for n in NAMES]), np.array([scale[n] for n in NAMES])


# What the fits say.


class Report(NamedTuple):
    """One model: its fit, and residuals (mrad, at all samples) of what it was tried on.

    Attributes:
        fit: to the training windows.
        train: residuals of the training windows.
        test: of the test windows, only their starts fitted.
        predicted: of the test windows, their starts fitted to the first 0.1 s only.
        test_starts: (q, q') at the start of every test window, from all of it.
    """

    fit: Fit
    train: Float[np.ndarray, "w s"]
    test: Float[np.ndarray, "x s"]
    predicted: Float[np.ndarray, "x s"]
    test_starts: Float[np.ndarray, "x 2"]


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def rms_of_windows(residuals: Float[np.ndarray, "w s"]) -> tuple[float, float]:
    """(rms over all samples, mean of the windows' own rms), mrad."""
    return _rms(residuals), float(np.mean(np.sqrt(np.mean(residuals**2, axis=1))))


def thinned(windows: Windows) -> Windows:
    """A free swing at FIT_RATE, which loses nothing; all samples where there is torque."""
    if windows.tau is not None:
        return windows
    return windows.every(max(1, round(1 / (FIT_RATE * windows.t[0, 1]))))


def fit_models(train: Windows, test: Windows) -> dict[str, Report]:
    """Every model fitted to `train` and tried on `test`."""
    reports = {}
    for model in MODELS:
        fitted = fit(thinned(train), parameters(model, train.tau is not None))
        starts = fit(thinned(test), (), fitted.values).starts
        early = fit(test.first(PREDICT_FROM), (), fitted.values).starts
        reports[model] = Report(
            fitted,
            np.asarray(residuals_at(fitted.values, fitted.starts, train)),
            np.asarray(residuals_at(fitted.values, starts, test)),
            np.asarray(residuals_at(fitted.values, early, test)),
            starts,
        )
    return reports


def choose(fits: Mapping[str, Fit]) -> str:
    """The model with the least Bayesian information criterion n log(r.r) + p log n.

    Residuals of a real recording are correlated: n is the number of independent ones that carry
    as much, by their correlation under the last, richest model. Starts are common to all models.
    """
    richest = list(fits.values())[-1]
    n = richest.residuals.size * (1 - richest.correlation) / (1 + richest.correlation)

    def criterion(model: str) -> float:
        fitted = fits[model]
        return n * np.log(np.sum(fitted.residuals**2)) + len(fitted.errors) * np.log(n)

    return min(fits, key=criterion)


def synthetic(
    values: Mapping[str, float], torque: bool, noise: float, segments: int = 5, seed: int = 0
) -> Recording:
    """A simulated pendulum with Gaussian noise on its angle.

    Segments of 5 s at 100 Hz start at rest, each closer to hanging than the one before; with
    `torque` they are driven by two sines.

    Args:
        values: parameters by name, J and mgl at least.
        torque: whether the shaft is driven and the torque recorded.
        noise: rms of the noise, rad.
        segments: number of segments, numbered from 0.
        seed: of the noise.
    """
    t = np.arange(500) / 100.0
    tau = 0.4 * values["mgl"] * (np.sin(2.1 * t) + np.sin(5.3 * t)) if torque else None
    params = dict.fromkeys(NAMES, 0.0) | dict(values)
    generator = np.random.default_rng(seed)
    pieces = []
    for number in range(segments):
        start = jnp.array([2.4 - 2.0 * number / segments, 0.0])
        clean = np.asarray(_synthetic_angle(params, start, Windows(t, t, tau)))
        pieces.append(Segment(number, t, clean + noise * generator.standard_normal(t.size), tau))
    return Recording("synthetic pendulum", tuple(pieces))


_synthetic_angle = jax.jit(simulated_angle)
