"""Model selection: candidate forces compared by predictions on data not used in the fit."""

import warnings
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxlag._core._arguments import by_name, name_sequence, renamed
from jaxlag._core._errors import invalid
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._fit import fit
from jaxlag._fit._fit_result import FitResult
from jaxlag._fit._free_parameters import Prior
from jaxlag._fit._predict import Prediction
from jaxlag._fit._setup import FORMER, experiments_of, spreads
from jaxlag._fit._transforms import AbstractTransform
from jaxlag._model._forces import AbstractForce
from jaxlag._simulation._options._simulate_options import NO_OPTIONS
from jaxlag._system._system import System


@final
class Candidate(eqx.Module):
    """A term that a system may need: one force or more, with its params.

    Args:
        forces: `Rayleigh`, `GeneralizedForce`, `PointForce`, `Torque`.
        params0: entries for the dict of params; all are estimated.
        transforms: as for `jl.fit`, of these entries.
        priors: likewise.

    Raises:
        ValueError: no force, or an object that is no force.
    """

    forces: tuple[AbstractForce, ...]
    params0: dict[str, Any]
    transforms: dict[str, Any]
    priors: dict[str, Prior]

    def __init__(
        self,
        *forces: Any,
        params0: Mapping[str, Any] | None = None,
        transforms: Mapping[str, Any] | None = None,
        priors: Mapping[str, Any] | None = None,
    ) -> None:
        if not forces or not all(isinstance(x, AbstractForce) for x in forces):
            fix = 'Write jl.Candidate(jl.Rayleigh(R, "friction"), params0={"k": 0.1}).'
            raise invalid("Candidate: forces", "be one force or more", f"they were {forces!r}", fix)
        self.forces = forces
        self.params0 = dict(params0 or {})
        self.transforms = by_name("Candidate: transforms", transforms, "jl.transforms.Positive()")
        self.priors = by_name("Candidate: priors", priors, "jl.Prior(mean, sigma)")


class Ranked(NamedTuple):
    """One model of a comparison.

    Attributes:
        name: names of its terms, "none" or "viscous + Coulomb".
        error: root mean square of the prediction errors over all channels, each over the range of
            that channel in the held-out data; inf if a motion or the search for a
            start failed.
        fit: result of the fit to the experiments.
        prediction: predictions of the held-out experiments.
        squares: mean square of the error in each block of the held-out data, ten for each
            experiment; neighboring samples are not independent, blocks nearly are.
    """

    name: str
    error: float
    fit: FitResult
    prediction: Prediction
    squares: Float[np.ndarray, " b"]

    @property
    def std(self) -> float:
        """Standard error of `error`, from the scatter of the blocks; nan if it is inf."""
        if not np.isfinite(self.error) or self.error == 0:
            return 0.0 if self.error == 0 else float("nan")
        return _standard_error(self.squares) / (2 * self.error)


@final
class ModelSelection(eqx.Module):
    """Models, the best first, ranked by predictions of held-out experiments.

    Models that predict as well as the one with the smallest error come first, those with the
    fewest parameters before the others: their mean square exceeds its by at most one standard
    error of the difference. The others follow by their error.

    Attributes:
        models: ranked.

    Source: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., sec. 7.10
    (the rule of one standard error).
    """

    models: tuple[Ranked, ...]

    @property
    def best(self) -> Ranked:
        """The smallest of the models that predict best."""
        return self.models[0]

    def __getitem__(self, name: str) -> Ranked:
        for model in self.models:
            if model.name == name:
                return model
        names = [model.name for model in self.models]
        raise invalid("model", f"be one of {names}", f"it was {name!r}")

    def __str__(self) -> str:
        channels = self.best.prediction.channels
        head = ["model", "params", "error", *(f"rms of {name}" for name in channels)]
        lines = [head]
        for model in self.models:
            shown = [_numbers(model.prediction.rms(name)) for name in channels]
            error = f"{model.error:.4g} +- {model.std:.1g}"
            lines.append([model.name, str(len(model.fit.names)), error, *shown])
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
            for line in lines
        ]
        return "\n".join(lines)


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{x:.3g}" for x in values)


_OF_FIT = ("segments", "channels", "loss", "optimizer", "rtol", "atol", "max_steps")


_FORMER = {name: f"fit_options={{{name!r}: ...}}" for name in (*_OF_FIT, "simulate_options")} | {
    name: f"fit_options={{'simulate_options': {{{name!r}: ...}}}}"
    for name in FORMER
    if name not in ("tolerance", "max_iterations", "project")
}


@renamed(
    tolerance="fit_options={'rtol': ..., 'atol': ...}",
    max_iterations="fit_options={'max_steps': ...}",
    optimiser="fit_options={'optimizer': ...}",
    **_FORMER,
)
def select_model(
    system: System,
    experiments: Any,
    params0: Mapping[str, Any],
    candidates: Mapping[str, Any],
    *,
    held_out: Any,
    free: Sequence[str],
    most: int = 1,
    settle: float | int | None = None,
    transforms: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    fit_options: Mapping[str, Any] = NO_OPTIONS,
) -> ModelSelection:
    """Fit a system with and without candidate terms, and rank the models by their predictions.

    Every combination of up to `most` candidates is added to the system and fitted to the
    experiments. The error is that of its predictions of held-out experiments, for which only the
    starts are fitted (`jl.predict`). More terms always fit better, but may predict worse. Of models
    that predict as well as the best within the standard error, the smallest is the first.

    If candidates share params, or are combined, the search starts from the
    estimates of an earlier model that has most of them: name the simple candidates first.

    Args:
        system: without the candidates.
        experiments: experiments for the fit.
        params0: of the system, a dict.
        candidates: name -> `Candidate`.
        held_out: experiments to predict.
        free: as for `jl.fit`; the candidates' params are also free.
        most: largest number of candidates in one model.
        settle: s, as for `jl.predict`.
        transforms: as for `jl.fit`.
        priors: as for `jl.fit`.
        fit_options: further arguments of `jl.fit`, such as segments and simulate_options.

    Raises:
        ValueError: an invalid argument, named; params of a candidate that the system
            has, or another candidate in the same model.

    Warns:
        as `jl.fit` and `jl.predict`, and if no model predicts all held-out experiments.

    Source: Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., sec. 7.2.
    """
    experiments, held_out = experiments_of(experiments), experiments_of(held_out)
    _check(system, params0, candidates, most, free)
    _check_fit_options(fit_options)
    given = by_name("transforms", transforms, "jl.transforms.Positive()")
    known = by_name("priors", priors, "jl.Prior(mean, sigma)")
    models = []
    for count in range(most + 1):
        for names in combinations(candidates, count):
            terms = [candidates[name] for name in names]
            params, transform, prior = dict(params0), dict(given), dict(known)
            for term in terms:
                params |= term.params0
                transform |= term.transforms
                prior |= term.priors
            found = fit(
                system.with_forces(*(force for term in terms for force in term.forces)),
                experiments,
                params | _estimates(params, set(params0), models, transform),
                free=(*free, *(name for term in terms for name in term.params0)),
                transforms=transform,
                priors=prior,
                **fit_options,
            )
            predicted = found.predict(held_out, settle)
            judged = _error(predicted, held_out), found, predicted, _squares(predicted, held_out)
            models.append(Ranked(" + ".join(names) or "none", *judged))
    ranked = _in_order(models)
    if np.isinf(ranked[0].error):
        text = "No model predicts all of held_out: motions or searches for initial states failed."
        warnings.warn(f"{text} See `prediction.failed` of each model.", stacklevel=2)
    return ModelSelection(ranked)


def _estimates(
    params: Mapping[str, Any],
    common: set[str],
    models: Sequence[Ranked],
    transforms: Mapping[str, AbstractTransform],
) -> dict[str, Any]:
    """Estimates of the model with most of these params, and of several the one that fits best.

    Empty if none has more than the params common to all, whose estimates may be far off then. An
    estimate of another structure, or not allowed by a transform, is left out.
    """
    able = [model for model in models if model.error < float("inf") and model.fit.converged]
    shared = [len(params.keys() & model.fit.params.keys()) for model in able]
    if max(shared, default=0) <= len(common):
        return {}
    near = min(
        zip(able, shared, strict=True),
        key=lambda x: (-x[1], _error(x[0].fit, x[0].fit.experiments)),
    )[0].fit
    # A logarithm that has diverged does not return.
    held = {name.partition("[")[0].partition(".")[0] for name in near.on_bound}
    return {
        name: near.params[name]
        for name in params.keys() & near.params.keys() - held
        if _alike(near.params[name], params[name])
        and _allowed(transforms.get(name), name, near.params[name])
    }


def _alike(one: Any, other: Any) -> bool:
    """Whether two params have one structure and shapes."""
    (a, of_a), (b, of_b) = jax.tree.flatten(one), jax.tree.flatten(other)
    return of_a == of_b and all(np.shape(x) == np.shape(y) for x, y in zip(a, b, strict=True))


def _allowed(transform: AbstractTransform | None, name: str, value: Any) -> bool:
    """Whether a search may start there."""
    if transform is None:
        return True
    try:
        _, on_bound = transform.start(name, np.asarray(value))
    except ValueError:
        return False
    return not on_bound


def _check_fit_options(options: Any) -> None:
    """Raise unless they are arguments of `fit` that `select_model` does not decide."""
    if not isinstance(options, Mapping):
        raise invalid("fit_options", "be a dict of arguments of jl.fit", f"it was {options!r}")
    for name in options:
        if name not in (*_OF_FIT, "simulate_options"):
            known = [*_OF_FIT, "simulate_options"]
            raise invalid("fit_options", f"be among {known}", f"one was {name!r}")


def _check(system: Any, params0: Any, candidates: Any, most: Any, free: Any) -> None:
    name_sequence("free", free)
    if not isinstance(system, System):
        raise invalid("system", "be a jl.System", f"it was {system!r}")
    if not isinstance(params0, Mapping):
        must = "be a dict, to which candidates add their own"
        raise invalid("params0", must, f"it was {type(params0).__name__}")
    if not isinstance(candidates, Mapping) or not candidates:
        raise invalid("candidates", "be a dict of jl.Candidate by name", f"it was {candidates!r}")
    taken = dict.fromkeys(params0, "the system")
    for name, candidate in candidates.items():
        if not isinstance(candidate, Candidate):
            raise invalid(f"candidates[{name!r}]", "be a jl.Candidate", f"it was {candidate!r}")
        for key in candidate.params0:
            if key in taken:
                must = "have params with other names"
                raise invalid(f"candidates[{name!r}]", must, f"{taken[key]} also has {key!r}")
            if most != 1:  # else candidates never meet
                taken[key] = f"candidate {name!r}"
    if isinstance(most, bool) or not isinstance(most, int) or not 1 <= most <= len(candidates):
        must = f"be an integer from 1 to the {len(candidates)} candidates"
        raise invalid("most", must, f"it was {most!r}")


def _in_order(models: Sequence[Ranked]) -> tuple[Ranked, ...]:
    """Those that predict as well as the best, the smallest first; then the others by error."""
    best = min(models, key=lambda model: model.error)

    def key(model: Ranked) -> tuple[bool, int, float]:
        worse = bool(np.isinf(model.error))
        if not worse:
            more = model.squares - best.squares
            worse = bool(np.mean(more) > _standard_error(more))
        return worse, 0 if worse else len(model.fit.names), model.error

    return tuple(sorted(models, key=key))


def _standard_error(x: np.ndarray) -> float:
    """Standard error of the mean; 0 of less than two numbers."""
    return float(np.std(x, ddof=1) / np.sqrt(len(x))) if len(x) > 1 else 0.0


BLOCKS = 10
"""Blocks of consecutive samples of an experiment."""


def _squares(predicted: Prediction, experiments: Sequence[Experiment]) -> np.ndarray:
    """Mean square of the error in each block, over all channels, each over its range.

    Blocks without measurements are left out; of failed motions the mean square is inf.
    """
    ranges = {
        name: spreads(np.concatenate([x.channels[name] for x in experiments if name in x.channels]))
        for name in predicted.channels
    }
    found = []
    given = predicted.residuals, predicted.predicted, experiments
    for residuals, samples, each in zip(*given, strict=True):
        parts = [(residuals[name] / ranges[name]) ** 2 for name in residuals]
        known = np.hstack([np.isfinite(each.channels[name]) for name in residuals])[samples]
        squares = np.hstack(parts)[samples]
        squares = np.where(known & ~np.isfinite(squares), np.inf, squares)
        for block in np.array_split(np.arange(len(squares)), BLOCKS):
            if known[block].any():
                found.append(np.mean(squares[block][known[block]]))
    return np.array(found)


def _error(predicted: Any, experiments: Sequence[Experiment]) -> float:
    """Error over all channels, each over its range; inf if a motion or a start failed."""
    if predicted.failed or not predicted.converged:
        return float("inf")
    shares = []
    for name in predicted.channels:
        values = np.concatenate([x.channels[name] for x in experiments if name in x.channels])
        shares.append(predicted.rms(name) / spreads(values))
    # A channel may have no number in the predicted samples.
    known = np.concatenate(shares)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("inf")
