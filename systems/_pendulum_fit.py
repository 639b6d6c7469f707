r"""The pendulum, and its parameters by least squares from windows of measured motion.

A rigid body on a fixed horizontal axis, swinging freely or driven by a motor:

      --o--
         \        L = 1/2 J q'^2 + m g l cos(q - zero)
        l \
           \      J q'' = -m g l sin(q - zero) - c q' - f tanh(q'/V_S) - k q'|q'| + u + u0
            O m

Coordinate
    q      angle of the sensor [rad], 0 where it says hanging, positive counterclockwise

Parameters (of a free swing, which cannot tell a scale of torque: J = 1, the others are over J)
    J      moment of inertia about the axis [kg m^2]
    mgl    mass times gravity times distance of the centre of mass from the axis [N m]
    c      viscous friction [N m s]
    f      Coulomb friction [N m], made smooth below |q'| = V_S
    k      quadratic drag [N m s^2]
    u0     torque missing from the measured one, u [N m]
    zero   what the sensor shows where the pendulum really hangs [rad]
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import jaxlag as jl
from systems._pendulum_data import Windows

NAMES: tuple[str, ...] = ("J", "mgl", "c", "f", "k", "u0", "zero")
V_S = 0.1  # rad/s; any from 0.01 to 0.5 moves the friction of a free swing by 2 % at most
MRAD = 1e-3  # rad
EARLY = 0.1  # s: the first motion in a window


def kinetic(t, q, v, params):
    """T = 1/2 J q'^2 [J]."""
    return 0.5 * params["J"] * v[0] ** 2


def potential(t, q, params):
    """V = -m g l cos(q - zero) [J]."""
    return -params["mgl"] * jnp.cos(q[0] - params["zero"])


def dissipation(t, q, v, params):
    """R = 1/2 c q'^2 + f V_S log cosh(q'/V_S) + 1/3 k |q'|^3 [W]."""
    x, speed = v[0] / V_S, jnp.abs(v[0])
    log_cosh = jnp.logaddexp(x, -x) - jnp.log(2.0)
    return 0.5 * params["c"] * speed**2 + params["f"] * V_S * log_cosh + params["k"] * speed**3 / 3


def motor(t, q, v, params, inputs):
    """Q = u + u0 [N m]."""
    return (inputs["torque"] + params["u0"])[None]


pendulum = partial(jl.System, coordinates=("q",), kinetic=kinetic, potential=potential)
friction = jl.Rayleigh(dissipation, "friction")
free = pendulum(forces=(friction,))
driven = pendulum(forces=(friction, jl.GeneralizedForce(motor, "motor")))


def simulate(
    params: Mapping[str, Any], start: Float[Array, " 2"], window: Windows, **steps: Any
) -> Float[Array, " s"]:
    """Angle (rad) at the times of one window, from `start` = (q, q').

    The torque is interpolated linearly between its samples: they are those of a motor current,
    which is continuous, and not commands, which would be held. (Held instead, they made the rms
    larger by 1 % in a recording at 500 Hz, by 4 % in one at 50 Hz.)

    Args:
        params: by name, all of NAMES.
        start: rad, rad/s.
        window: its times, and its torques if it is driven.
        steps: for `jl.simulate`; by default steps of fixed length and order 5, one per sample.
            At 100 Hz they come within 5e-5 rad of a solution at tolerance 1e-10; what is left
            is where they step across |q'| < V_S.
    """
    t, torque = window.t, window.tau
    if not steps:
        # Steps end on the samples of the torque whatever their length: make it no limit.
        steps = {"method": "tsit5", "dt": t[1] if torque is None else t[-1]}
    return jl.simulate(
        free if torque is None else driven,
        start[:1],
        start[1:],
        t,
        params,
        inputs=None if torque is None else {"torque": jl.Linear(t, torque)},
        max_steps=4 * t.shape[0],
        throw=False,
        **steps,
    )["q"]


# Least squares.


class Fit(NamedTuple):
    """Parameters and starts at the least sum of squares.

    Attributes:
        values: all parameters, by name.
        errors: standard errors of those estimated, by name: of independent, equally noisy samples.
        starts: (q, q') at the start of every window (w, 2), rad and rad/s.
        residuals: simulated minus measured angle (w, s), mrad.
        used: which samples were fitted (w, s).
        converged: whether the optimiser met its tolerance.
    """

    values: dict[str, float]
    errors: dict[str, float]
    starts: Float[np.ndarray, "w 2"]
    residuals: Float[np.ndarray, "w s"]
    used: Bool[np.ndarray, "w s"]
    converged: bool

    @property
    def correlation(self) -> float:
        """Correlation of residuals one sample apart."""
        r = np.where(self.used, self.residuals, 0.0)
        return float(np.sum(r[:, 1:] * r[:, :-1]) / np.sum(r**2))

    @property
    def samples_each(self) -> float:
        """Number of samples that tell as much as one independent one."""
        return max(1.0, (1 + self.correlation) / (1 - self.correlation))


class _Problem(NamedTuple):
    """Parameters are `guess + scale z`: a scale of 0 holds one."""

    guess: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, " p"]
    windows: Windows
    used: Bool[np.ndarray, "w s"]


@jax.jit  # traced once, however often the optimiser asks
def _residuals(z: Array, starts: Array, problem: _Problem) -> tuple[Array, tuple[Array, Array]]:
    """Residuals (w, s), and their derivatives by z (w, s, p) and by the window's start (w, s, 2).

    A residual is simulated minus measured angle, in mrad.
    """

    def twice(z: Array, start: Array, window: Windows) -> tuple[Array, Array]:
        params = dict(zip(NAMES, problem.guess + problem.scale * z, strict=True))
        residual = (simulate(params, start, window) - window.q) / MRAD
        return residual, residual

    derivatives = jax.jacfwd(twice, argnums=(0, 1), has_aux=True)
    by_both, residuals = jax.vmap(derivatives, (None, 0, 0))(z, starts, problem.windows)
    return residuals, by_both


def _used(unknowns: Any, problem: _Problem) -> Any:
    """Residuals of the samples used, with (residuals, derivatives) of all beside them.

    Written as its own first-order expansion about the point where it stands, so that a window is
    differentiated by its own start only: in p + 2 directions instead of p + 2 w.
    """
    z0, starts0 = jax.lax.stop_gradient(unknowns)
    residuals, (by_z, by_start) = found = _residuals(z0, starts0, problem)
    dz, dstarts = unknowns[0] - z0, unknowns[1] - starts0
    expansion = residuals + by_z @ dz + jnp.einsum("wsi,wi->ws", by_start, dstarts)
    return jnp.where(problem.used, expansion, 0.0).ravel(), found


@jax.jit
def _solve(starts: Float[Array, "w 2"], problem: _Problem) -> Any:
    """(parameters, starts, whether converged, residuals, derivatives).

    The last two are those before the last step, which moved them by less than the tolerance.
    """
    solution = optx.least_squares(
        _used,
        # Damping keeps the normal equations regular where a parameter is held or a window unused.
        optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5, linear_solver=lx.Normal(lx.Cholesky())),
        (jnp.zeros(len(NAMES)), starts),
        args=problem,
        options={"jac": "fwd"},
        has_aux=True,
        max_steps=100,
        throw=False,
    )
    z, starts = solution.value
    converged = solution.result == optx.RESULTS.successful
    return problem.guess + problem.scale * z, starts, converged, *solution.aux


def fit(
    windows: Windows,
    estimate: Sequence[str],
    values: Mapping[str, float] | None = None,
    used: Bool[np.ndarray, "#w #s"] | None = None,
) -> Fit:
    """Least squares for the parameters named in `estimate` and for the start of every window.

    Args:
        windows: measured motion.
        estimate: names among NAMES; none to fit the starts alone.
        values: of the other parameters; by default J is 1 and the rest 0.
        used: which samples to fit, by default all; a window without any keeps its guessed start.
    """
    values = dict.fromkeys(NAMES, 0.0) | {"J": 1.0} | dict(values or {})
    used = np.broadcast_to(np.array(True) if used is None else used, windows.q.shape)
    guess, scale = _guess(windows, estimate, values, np.any(used, axis=1))
    problem = _Problem(guess, scale, windows, used)
    solution = _solve(*jax.tree.map(jnp.asarray, (_guess_starts(windows), problem)))
    found, starts, converged, residuals, (by_z, by_start) = jax.tree.map(np.asarray, solution)
    estimated = [i for i, name in enumerate(NAMES) if name in estimate]
    errors = []
    if estimated:
        errors = _standard_errors(residuals, by_z[..., estimated], by_start, used)
        errors = (scale[estimated] * errors).tolist()
    return Fit(
        dict(zip(NAMES, found.tolist(), strict=True)),
        dict(zip([NAMES[i] for i in estimated], errors, strict=True)),
        starts,
        residuals,
        used,
        bool(converged),
    )


def _standard_errors(
    residuals: Float[np.ndarray, "w s"],
    by_z: Float[np.ndarray, "w s p"],
    by_start: Float[np.ndarray, "w s 2"],
    used: Bool[np.ndarray, "w s"],
) -> Float[np.ndarray, " p"]:
    """Roots of the diagonal of s^2 (J^T J)^-1, s^2 = r.r / (samples - unknowns), starts included.

    The starts are eliminated window by window: what is left of the derivatives by z is their part
    orthogonal to those by the window's start.
    """
    basis = np.linalg.qr(by_start * used[..., None]).Q
    by_z = by_z * used[..., None]
    left = by_z - basis @ (np.swapaxes(basis, 1, 2) @ by_z)
    normal = np.einsum("wsi,wsj->ij", left, left)
    unknowns = by_z.shape[2] + by_start.shape[2] * np.count_nonzero(used.any(axis=1))
    variance = np.sum(residuals[used] ** 2) / (np.count_nonzero(used) - unknowns)
    return np.sqrt(variance * np.diag(np.linalg.inv(normal)))


def _guess_starts(windows: Windows) -> Float[np.ndarray, "w 2"]:
    """(q, q') at every start, from a parabola through the first 0.1 s."""
    count = max(5, round(EARLY / windows.t[0, 1]))
    parabolas = [np.polyfit(t[:count], q[:count], 2) for t, q in zip(*windows[:2], strict=True)]
    return np.stack(parabolas)[:, :0:-1]


def _guess(
    windows: Windows,
    estimate: Sequence[str],
    values: Mapping[str, float],
    which: Bool[np.ndarray, " w"],
) -> tuple[np.ndarray, np.ndarray]:
    """(guess, scale) of all parameters, by linear regression of the equation of motion.

    Rates are differences over 0.05 s in the windows chosen by `which`. A scale makes the
    parameter's term as large as the sum of all. `zero` is not linear: its guess is the value
    given, its scale 1.
    """
    h = max(1, min(round(0.05 / windows.t[0, 1]), windows.t.shape[1] // 4))
    step = h * windows.t[0, 1]
    before, q, after = (windows.q[which, i : i - 2 * h or None] for i in (0, h, 2 * h))
    v, a = (after - before) / (2 * step), (after - 2 * q + before) / step**2
    terms = {
        "J": a,
        "mgl": np.sin(q),
        "c": v,
        "f": np.tanh(v / V_S),
        "k": v * np.abs(v),
        "u0": -np.ones_like(q),
    }
    linear = [name for name in terms if name in estimate]
    torque = np.zeros_like(q) if windows.tau is None else windows.tau[which, h:-h]
    target = torque - sum(values[name] * terms[name] for name in terms if name not in linear)
    guess, scale = dict(values), dict.fromkeys(NAMES, 0.0)
    if linear:
        columns = np.stack([terms[name].ravel() for name in linear], axis=1)
        guess |= zip(linear, np.linalg.lstsq(columns, target.ravel())[0], strict=True)
        scale |= {name: rms(target) / rms(terms[name]) for name in linear}
    if "zero" in estimate:
        scale["zero"] = 1.0
    return np.array([guess[name] for name in NAMES]), np.array([scale[name] for name in NAMES])


def rms(x: np.ndarray) -> float:
    """Root of the mean square over everything."""
    return float(np.sqrt(np.mean(np.square(x))))
