"""Models of a pendulum's friction beside each other, tried on motion they were not fitted to."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from systems._pendulum_data import Recording, Windows, bad, cut, held_out
from systems._pendulum_fit import EARLY, MRAD, NAMES, Fit, fit, rms, simulate

MODELS = {"viscous": ("c",), "+ Coulomb": ("c", "f"), "+ quadratic": ("c", "f", "k")}
# Hz, of the residuals of a free swing: all samples of a recording at 1 kHz moved its parameters by
# 0.2 of the standard errors found at 100 Hz. The rms of a trial is over all samples.
FIT_RATE = 100.0


class Trial(NamedTuple):
    """One model fitted to the training windows and tried on the test windows.

    Attributes:
        fit: to the training windows, at `FIT_RATE` if the swing is free.
        train: residuals of the training windows at all samples, mrad.
        test: of the test windows, their starts fitted to all of them.
        predicted: of the test windows, their starts fitted to the first 0.1 s.
        tested: the test windows.
    """

    fit: Fit
    train: Float[np.ndarray, "w s"]
    test: Float[np.ndarray, "x y"]
    predicted: Float[np.ndarray, "x y"]
    tested: Windows


def mean_rms(x: Float[np.ndarray, "w s"]) -> float:
    """Mean over the windows of each window's own rms."""
    return float(np.mean(np.sqrt(np.mean(np.square(x), axis=1))))


def thinned(windows: Windows) -> Windows:
    """A free swing at FIT_RATE; all samples of a driven one, whose torque changes with each."""
    stride = max(1, round(1 / (FIT_RATE * windows.t[0, 1])))
    return windows.every(stride) if windows.tau is None else windows


def parameters(model: str, windows: Windows) -> tuple[str, ...]:
    """Names of the parameters that a model of friction estimates."""
    names = {"mgl", "zero", *MODELS[model]} | (set() if windows.tau is None else {"J", "u0"})
    return tuple(name for name in NAMES if name in names)


@jax.jit
def _residuals_at(values: Any, starts: Float[Array, "w 2"], windows: Windows) -> Array:
    angle = jax.vmap(simulate, in_axes=(None, 0, 0))(values, starts, windows)
    return (angle - windows.q) / MRAD


def residuals_at(
    values: Mapping[str, float], starts: Float[np.ndarray, "w 2"], windows: Windows
) -> Float[np.ndarray, "w s"]:
    """Simulated minus measured angle at all samples, mrad."""
    return np.asarray(_residuals_at(*jax.tree.map(jnp.asarray, (dict(values), starts, windows))))


def try_model(
    model: str, train: Windows, held: Bool[np.ndarray, " w"], test: Windows | None = None
) -> Trial:
    """Fit one model and try it.

    Args:
        model: a key of MODELS.
        train: windows of the training recording.
        held: which of them are not fitted; they are the test where there is no `test`.
        test: windows of another recording.
    """
    few = thinned(train)
    fitted = fit(few, parameters(model, few), used=~held[:, None])
    at_train = residuals_at(fitted.values, fitted.starts, train)[~held]
    if test is None:
        test = train
    else:
        held = np.ones(len(test.t), bool)
    few = thinned(test)
    starts = fit(few, (), fitted.values).starts
    early = fit(few, (), fitted.values, used=few.t < EARLY).starts
    at_test, predicted = (residuals_at(fitted.values, s, test)[held] for s in (starts, early))
    return Trial(fitted, at_train, at_test, predicted, jax.tree.map(lambda x: x[held], test))


def try_models(
    recording: Recording, other: Recording | None = None, seconds: float = 1.0
) -> dict[str, Trial]:
    """Every model, fitted to `recording` and tried on `other`, or on a third of `recording`.

    Raises:
        DataError: the recordings are too short, or only one of them has a torque.
    """
    train, numbers = cut(recording, seconds)
    if other is None:
        held = held_out(recording, numbers)
        return {model: try_model(model, train, held) for model in MODELS}
    if other.driven != recording.driven:
        raise bad(
            "--test",
            f"name a recording {'with' if recording.driven else 'without'} tau_meas, "
            f"like {recording.name}",
            f"{other.name} is one {'with' if other.driven else 'without'} it",
            "Train and test on one kind.",
        )
    test, _ = cut(other, seconds)
    return {model: try_model(model, train, np.zeros(len(train.t), bool), test) for model in MODELS}


def fit_segments(recording: Recording) -> dict[str, Fit]:
    """Every model, fitted to all segments whole."""
    windows = thinned(cut(recording)[0])
    return {model: fit(windows, parameters(model, windows)) for model in MODELS}


def choose(fits: Mapping[str, Fit]) -> str:
    """The model of least Bayesian information criterion, n log(r.r) + p log n.

    A real recording's residuals are correlated: n counts independent ones, by the correlation
    under the last and richest model.
    """
    richest = list(fits.values())[-1]
    n = np.count_nonzero(richest.used) / richest.samples_each

    def criterion(model: str) -> float:
        fitted = fits[model]
        return n * np.log(rms(fitted.residuals[fitted.used]) ** 2) + len(fitted.errors) * np.log(n)

    return min(fits, key=criterion)
