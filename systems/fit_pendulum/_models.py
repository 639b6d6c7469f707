r"""The pendulum, models of its friction, and the choice of a model from a measured motion.

A rigid body on a fixed horizontal axis, swinging freely or driven by a motor:

      --o--
         \        L = 1/2 J q'^2 + m g l cos(q - zero)
        l \
           \      J q'' = -m g l sin(q - zero) - c q' - f tanh(q'/V_S) - k q'|q'| + u + u0
            O m

Coordinate
    q      angle of the sensor [rad], nominally 0 when hanging, positive counterclockwise

Parameters (a free swing does not identify a scale of torque: J = 1, the others are divided by J)
    J      moment of inertia about the axis [kg m^2]
    mgl    mass times gravity times distance of the center of mass from the axis [N m]
    c      viscous friction [N m s]
    f      Coulomb friction [N m], made smooth below |q'| = V_S
    k      quadratic drag [N m s^2]
    u0     torque missing from the measured one, u [N m]
    zero   angle of the sensor when the pendulum hangs [rad]
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from systems.fit_pendulum._data import Recording, data_error, split

NAMES: tuple[str, ...] = ("J", "mgl", "c", "f", "k", "u0", "zero")
V_S = 0.1  # rad/s; 0.01 to 0.5 change the friction of a free swing by at most 2 %
EARLY = 0.1  # s: the first motion in a window
NO_BETTER = 0.9  # of the deviations from straight lines: such a prediction is no fit
OPTIONS = {"method": "tsit5", "rtol": 1e-7, "atol": 1e-7}


def kinetic(t, q, v, params):
    """T = 1/2 J q'^2 [J]."""
    return 0.5 * params["J"] * v[0] ** 2


def potential(t, q, params):
    """V = -m g l cos(q - zero) [J]."""
    return -params["mgl"] * jnp.cos(q[0] - params["zero"])


def viscous(t, q, v, params):
    """R = 1/2 c q'^2 [W]."""
    return 0.5 * params["c"] * v[0] ** 2


def coulomb(t, q, v, params):
    """R = f V_S log cosh(q'/V_S) [W]."""
    x = v[0] / V_S
    return params["f"] * V_S * (jnp.logaddexp(x, -x) - jnp.log(2.0))


def quadratic(t, q, v, params):
    """R = 1/3 k |q'|^3 [W]."""
    return params["k"] * jnp.abs(v[0]) ** 3 / 3


def motor(t, q, v, params, inputs):
    """Q = u + u0 [N m]."""
    return (inputs["torque"] + params["u0"])[None]


free = jl.System(
    coordinates=("q",),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.Rayleigh(viscous, "viscous"),
        jl.Rayleigh(coulomb, "Coulomb"),
        jl.Rayleigh(quadratic, "quadratic"),
    ),
)
driven = free.with_forces(jl.GeneralizedForce(motor, "motor"))
MODELS = {"none": "", "viscous": "c", "+ Coulomb": "cf", "+ quadratic": "cfk"}
FRICTION = "cfk"
# A friction term that a model lacks is known to be 0. So all models use one program, which is
# compiled once. Compilation takes longer than all their fits.
ABSENT, PRESENT = jl.Prior(0.0, 1e-6), jl.Prior(0.0, 1e6)


class Trial(NamedTuple):
    """One model of friction, fitted to the training windows and tested on the test windows.

    Attributes:
        fit: fit to the training windows.
        test: prediction of the test windows, with starts fitted to the whole windows.
        ahead: prediction of the test windows, with starts fitted to the first 0.1 s.
    """

    fit: jl.FitResult
    test: jl.Prediction
    ahead: jl.Prediction


def try_models(
    recording: Recording, other: Recording | None = None, seconds: float = 1.0
) -> dict[str, Trial]:
    """Every model, fitted to `recording` and tested on `other`, or on a third of `recording`.

    Raises:
        DataError: the recordings are too short, only one of them has a torque, or no model predicts
            the angle.
    """
    train, test = split(recording.thinned(), other and other.thinned(), seconds)
    params0 = guess(train)
    trials = {}
    for model in MODELS:
        found = fit(train, params0, model)
        trials[model] = Trial(found, found.predict(test), found.predict(test, EARLY))
    _require_fit((other or recording).name, test, trials)
    return trials


def _require_fit(name: str, test: Sequence[jl.Experiment], trials: Mapping[str, Trial]) -> None:
    """Raise if no model predicts more than the mean and a straight line through each window do.

    A line has the free start of a window, and no equation of motion.
    """
    mean, line = (_off(test, degree) for degree in (0, 1))
    errors = [float(trial.test.rms("q")[0]) for trial in trials.values()]
    best = min((x for x in errors if np.isfinite(x)), default=np.inf)
    if not (best < NO_BETTER * line or best < 0.5 * mean):
        reach = max(float(np.max(np.abs(each.channels["q"]))) for each in test)
        raise data_error(
            f"the angle of {name}",
            "be that of a pendulum, in rad at times in s",
            f"no model predicts it: the best is off by {best:.3g}, a straight line through each "
            f"window by {line:.3g}; angles reach {reach:.3g}",
            "Convert degrees to rad and milliseconds to s.",
        )


def _off(test: Sequence[jl.Experiment], degree: int) -> float:
    """Root mean square of the deviations from a polynomial of least squares in each window."""
    found = []
    for each in test:
        t, q = each.ts - each.ts[0], each.channels["q"][:, 0]
        found.append(q - np.polyval(np.polyfit(t, q, degree), t))
    return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))


def fit_segments(recording: Recording, trials: Mapping[str, Trial]) -> dict[str, jl.FitResult]:
    """Every model, fitted to all whole segments, starting from the fit to windows."""
    whole = list(recording.thinned().segments.values())
    return {model: fit(whole, trial.fit.params, model) for model, trial in trials.items()}


def fit(
    experiments: Sequence[jl.Experiment], params0: Mapping[str, Any], model: str
) -> jl.FitResult:
    """One model of friction, fitted to windows or whole segments."""
    system = driven if experiments[0].inputs else free
    names = [name for name in params0 if system is driven or name != "J"]
    priors = {name: PRESENT if name in MODELS[model] else ABSENT for name in FRICTION}
    return jl.fit(system, experiments, params0, free=names, priors=priors, simulate_options=OPTIONS)


def estimated(fitted: jl.FitResult, model: str) -> tuple[str, ...]:
    """Names of the params that a model estimates."""
    return tuple(n for n in fitted.names if n not in FRICTION or n in MODELS[model])


def guess(windows: Sequence[jl.Experiment]) -> dict[str, float]:
    """Params, without friction, by linear regression of q'' on sin q and, if driven, on u and 1.

    Rates are differences of neighboring samples. They are rough, but their errors are in q'' alone.
    """
    regressors, q2 = [], []
    for each in windows:
        q = each.channels["q"][:, 0]
        torque = each.inputs.get("torque")
        u = () if torque is None else (np.interp(each.ts, torque.times, torque.values),)
        regressors.append(np.stack([-np.sin(q), *u, *(np.ones_like(x) for x in u)], axis=1)[2:-2])
        q2.append(np.gradient(np.gradient(q, each.ts), each.ts)[2:-2])
    found = np.linalg.lstsq(np.concatenate(regressors), np.concatenate(q2))[0].tolist()
    if len(found) == 1:
        return {"J": 1.0, "mgl": found[0], "zero": 0.0} | dict.fromkeys(FRICTION, 0.0)
    mgl, per_J, u0 = found
    params = {"J": 1 / per_J, "mgl": mgl / per_J, "u0": u0 / per_J, "zero": 0.0}
    return params | dict.fromkeys(FRICTION, 0.0)


# Statistics of the residuals.


def correlation(found: jl.FitResult) -> float:
    """Correlation of residuals one sample apart."""
    residuals = [each["q"][:, 0] for each in found.residuals]
    products = sum(float(np.nansum(r[1:] * r[:-1])) for r in residuals)
    return products / sum(float(np.nansum(r**2)) for r in residuals)


def samples_each(found: jl.FitResult) -> float:
    """Number of samples with as much information as one independent sample."""
    r = correlation(found)
    return max(1.0, (1 + r) / (1 - r))


def count(found: jl.FitResult) -> int:
    """Number of residuals."""
    return sum(int(np.isfinite(each["q"]).sum()) for each in found.residuals)


def choose(fits: Mapping[str, jl.FitResult]) -> str:
    """The model with the least Bayesian information criterion, n log(r.r) + p log n.

    Residuals of a real recording are correlated. So n is the number of independent ones, from the
    correlation with the last model, which has the most parameters.
    """
    richest = list(fits.values())[-1]
    n = count(richest) / samples_each(richest)

    def criterion(model: str) -> float:
        fitted = fits[model]
        return 2 * n * np.log(fitted.rms("q")[0]) + len(estimated(fitted, model)) * np.log(n)

    return min(fits, key=criterion)
