"""`fit`: parameter estimation by least squares and multiple shooting."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._arguments import by_name, positive_integer, renamed
from jaxlag._core._errors import invalid
from jaxlag._fit._descent import Descent, descend
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._fit_result import FitResult, summarized
from jaxlag._fit._free_parameters import NO_PRIOR, Unknowns, paths, prior_rows, unknowns
from jaxlag._fit._initial_guess import start_freedom
from jaxlag._fit._multiple_shooting import (
    FitVariables,
    MultipleShooting,
    SearchResult,
    judged,
    search,
)
from jaxlag._fit._residuals import LOSSES, Reader, squares
from jaxlag._fit._segments import SegmentLayout, layout
from jaxlag._fit._setup import (
    FORMER,
    OURS,
    build_shooting,
    check_known_params,
    check_search,
    estimated_noise,
    experiments_of,
    readers_of,
    with_noise,
)
from jaxlag._simulation._jump_times import Jump, Jumps, names_of, warn
from jaxlag._simulation._options._simulate_options import NO_OPTIONS, plain_options
from jaxlag._system._system import System
from jaxlag._tracing._params import check_keys
from jaxlag._tracing._traced_function import warn_of_changes

GAPS = (1e-1, 1e-2, 1e-3, 1e-5, 1e-7, 1e-9)
"""Standard deviations of the gaps between segments in each stage, over the states' ranges."""
TIGHT = 1e-2
"""The last of them, over the precision of a state from all measurements together."""
TIGHTEST = 1e-11
"""Smallest gap: below it gaps are rounding."""
UNITS = 3
"""Searches of one stage, each with improved units."""
FAR_OFF = 1e3
"""Largest error factor of an unknown's unit."""
MAX_NEWTON_DISTANCE = 0.3
"""Largest Newton step at converged estimates, in standard deviations."""
LARGEST_COVARIANCE = 200
"""Number of unknowns beyond which a covariance costs more than the descent."""
LOOSE = 1e-4
"""Tolerance of intermediate searches."""
NOISE_ROUNDS = 3
"""Largest number of noise estimates, each followed by a new fit."""


@renamed(optimiser="optimizer=", **FORMER)
def fit(
    system: System,
    experiments: Any,
    params0: Any,
    *,
    free: Sequence[str],
    channels: Mapping[str, Reader] | None = None,
    segments: int = 1,
    transforms: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    loss: str = "squares",
    optimizer: Any = None,
    rtol: float = 1e-6,
    atol: float = 1e-6,
    max_steps: int = 100,
    simulate_options: Mapping[str, Any] = NO_OPTIONS,
) -> FitResult:
    r"""Params and starts of experiments for which motions are closest to the measurements.

        min  sum (g(y_i) - m_i)^2 / sigma_i^2 + sum (theta - mean)^2 / sigma^2

    over params theta and starts; y_i is the motion at the times of the measurements, g the channel
    as a function of it. With `segments` above 1, each experiment is cut into as many segments with
    unknown starts. The same least squares joins them more tightly in each stage. From a poor
    guess, or over many Lyapunov times, this converges where one long motion does not. Segments
    are lanes of one batch, and the linear algebra is linear in their number.

    A segment whose solve fails has a constant large residual, does not affect the params, and is
    named in the result. Noise without a given sigma is estimated from the residuals, and the fit
    is repeated.

    Args:
        system: the mechanical system.
        experiments: one `Experiment` or more, of any lengths and rates; also separate pieces
            (`Experiment.windows`).
        params0: all params; the initial guess.
        free: names of leaves to estimate: "m", "link.mass", "links[0].mass"; a branch includes
            all leaves below it.
        channels: name -> function of a `Solution` to the measured quantity at its save times, (s,)
            or (s, k); in addition to the standard names.
        segments: per experiment; 1 is single shooting.
        transforms: name -> transform of a free leaf.
        priors: name -> `Prior` of a free leaf, in its own unit.
        loss: "squares"; "soft_l1", "huber", "cauchy" give outliers less weight: residuals beyond
            about one sigma. The covariance is that of least squares with weights that decrease with
            the residuals; for Gaussian noise it is too large by up to a third (cauchy, soft_l1).
        optimizer: None, Levenberg-Marquardt; a `Descent` for more than a few hundred numbers.
            There may then be more of them than measurements; no covariance is computed for more
            than 200.
        rtol: relative tolerance of unknowns and residuals, both of order one.
        atol: absolute tolerance of the same.
        max_steps: bound on the steps of Levenberg and Marquardt's method, in each stage.
        simulate_options: options of `jl.simulate`, such as `{"method": "tsit5", "rtol": 1e-7}`.

    Raises:
        ValueError: an invalid argument, named; fewer measurements than unknowns.

    Warns:
        of a parameter that starts or ends on a bound, one without effect on any measurement, a
        constant channel, segments whose solve fails, a search that did not converge, or
        stopped because solver errors exceed the effect of params, friction that supplies energy,
        each by name.

    Source: Bock (1983), see `_shooting`; Schittkowski, Numerical Data Fitting in Dynamical Systems
    (2002).

    Example:
        A mass on a spring: its motion determines k/m alone.

        >>> import jax, jax.numpy as jnp, jaxlag as jl, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * params["m"] * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2
        >>> spring = jl.System(lagrangian, coordinates=("x",))
        >>> ts = np.linspace(0.0, 3.0, 31)
        >>> noise = 1e-3 * np.sin(1e3 * ts)
        >>> data = jl.Experiment(ts, {"x": 0.3 * np.cos(2.0 * ts) + noise})
        >>> found = jl.fit(spring, data, {"m": 1.0, "k": 3.0}, free=("k",))
        >>> print(f"{found.params['k']:.2f} {found.converged}")
        4.00 True
    """
    experiments = experiments_of(experiments)
    _check(system, segments, loss, optimizer)
    check_search(rtol, atol, max_steps)
    options = plain_options(simulate_options, "jl.fit", OURS)
    own = by_name("channels", channels, "lambda motion: motion['theta']")
    check_known_params("fit", system, experiments, "params0", params0)
    transforms = by_name("transforms", transforms, "jl.transforms.Positive()")
    unknown = unknowns(params0, free, transforms)
    check_keys(own, "channels")
    warn_of_changes(system, *(each.inputs for each in experiments))
    shown = readers_of(system, experiments, own, params0)
    where = layout(experiments, segments)
    prior = prior_rows(unknown, by_name("priors", priors, "jl.Prior(mean, sigma)"))
    if optimizer is None:
        _count(experiments, len(unknown.u0), len(prior[0]), start_freedom(system, params0))
    _warn_before(experiments, unknown)
    compared = _compared(system, experiments, unknown)
    problem, noise = build_shooting(
        system, experiments, where, unknown, shown, prior, LOSSES[loss], options
    )
    costs = np.zeros(0)
    if optimizer is None:
        problem, found, iterations = _stages(problem, (rtol, atol), max_steps)
        problem, noise, found, more = _with_its_noise(
            problem, noise, found, where, (rtol, atol), max_steps
        )
        solves = (iterations + more) * len(where.owner)
    else:
        guess, costs, solves = _downhill(problem, optimizer, max_steps)
        if noise:
            seen = _judged(problem, guess, optimizer, costs, linear=False)
            noise = estimated_noise(seen, problem, where, noise)
            problem = with_noise(problem, where, noise)
        linear = len(unknown.u0) <= LARGEST_COVARIANCE
        found = _judged(problem, guess, optimizer, costs, linear)
    details = (where, noise, own, costs, solves, compared)
    result = summarized(problem, found, experiments, *details)
    _warn_after(result)
    return result


def _check(system: Any, segments: Any, loss: Any, optimizer: Any) -> None:
    if not isinstance(system, System):
        raise invalid("system", "be a jl.System", f"it was {system!r}")
    positive_integer("segments", segments)
    if optimizer is not None and not isinstance(optimizer, Descent):
        fix = "Write jl.Descent(optax.adam(1e-3))."
        raise invalid("optimizer", "be None or a jl.Descent", f"it was {optimizer!r}", fix)
    if loss not in LOSSES:
        raise invalid("loss", f"be one of {list(LOSSES)}", f"it was {loss!r}")


def _count(experiments: Sequence[Experiment], params: int, priors: int, start: int) -> None:
    """Raise if there are fewer measurements and priors than unknowns."""
    numbers = sum(int(np.isfinite(x).sum()) for each in experiments for x in each.channels.values())
    unknown = params + start * sum(each.start_sigma is None for each in experiments)
    if numbers + priors < unknown:
        must = f"hold at least as many numbers as there are unknowns, {unknown}"
        was = f"they held {numbers}"
        raise invalid("experiments", must, was, "Measure more, or free fewer parameters.")


def _warn_before(experiments: Sequence[Experiment], free: Unknowns) -> None:
    for name in free.on_bound:
        text = f"{name} starts on its bound."
        warnings.warn(text, stacklevel=3)
    for each in experiments:
        for name, x in each.channels.items():
            x = x[:, np.isfinite(x).any(axis=0)]
            if np.all(np.nanmax(x, axis=0) == np.nanmin(x, axis=0)):
                text = f"channel {name!r} of {each.name} is constant: it may be disconnected."
                warnings.warn(text, stacklevel=3)


def _compared(system: System, experiments: Sequence[Experiment], free: Unknowns) -> dict[str, str]:
    """Names of leaves that jumps depend on, and their lines; warns of jumps in time."""
    names = dict(zip(names_of(free.params0), paths(free.params0), strict=True))
    moving = {name for name, path in names.items() if path in {leaf.name for leaf in free.leaves}}
    found: dict[str, str] = {}
    to_warn_of: set[Jump] = set()
    for each in {jax.tree.structure(x.inputs_at(free.params0)): x for x in experiments}.values():
        inputs = each.inputs_at(free.params0)
        jumps = Jumps(system, free.params0, jnp.zeros(system.size), inputs)
        found |= {names[x.leaf]: x.line for x in jumps.of_leaves() if x.leaf in names}
        to_warn_of |= set(jumps.in_time(moving, jnp.asarray(each.ts)))
    warn(sorted(to_warn_of))
    return found


def _stages(
    problem: MultipleShooting, tolerances: tuple[float, float], max_steps: int
) -> tuple[MultipleShooting, SearchResult, int]:
    """(the problem in adjusted units, the result of all stages of gaps, total steps).

    Always by squares first: losses with less weight for outliers have minima where all residuals
    are outliers.
    """
    iterations = 0
    guess = FitVariables(jnp.zeros(len(problem.free.u0)), jnp.zeros(problem.segments.guess.shape))
    by_squares, loss = replace(problem, loss=squares), problem.loss
    last = last_gap(problem)
    gaps = (*(gap for gap in GAPS if gap > last), last) if problem.chained else (last,)
    for gap in gaps:
        final = gap == last and loss is squares
        rough = jnp.asarray([x if final else max(x, LOOSE) for x in tolerances])
        for again in range(UNITS):
            found = search(by_squares, guess, jnp.asarray(gap), rough, max_steps)
            guess, iterations = found.guess, iterations + int(found.steps)
            scale = _units(by_squares, found)
            if np.array_equal(scale, by_squares.free.scale) or again == UNITS - 1:
                break
            guess = guess._replace(z=guess.z * (by_squares.free.scale / scale))
            by_squares = replace(by_squares, free=by_squares.free.rescaled(scale))
    problem = replace(by_squares, loss=loss)
    if loss is not squares:
        found = search(problem, guess, jnp.asarray(last), jnp.asarray(tolerances), max_steps)
        iterations += int(found.steps)
    return problem, found, iterations


def _units(problem: MultipleShooting, found: SearchResult) -> Float[np.ndarray, " p"]:
    """Scales of the unknowns: unchanged, unless they are far from the size of the unknowns.

    The scale of an unknown should be its own size. For an unknown of about 0 it should be the
    change that moves the residuals by their own size. The initial value is a poor scale: it may be
    0, or a billionth of the true value.
    """
    free, rows = problem.free, found.rows
    assert rows is not None
    p = len(free.u0)
    columns = np.asarray(rows.measured).reshape(-1, rows.measured.shape[-1])
    moved = np.hypot(
        np.linalg.norm(columns[:, -p - 1 : -1], axis=0),
        np.linalg.norm(np.asarray(rows.prior)[:, :p], axis=0),
    )
    left = np.sqrt(2.0 * float(found.cost))
    numbers = np.abs(free.u0 + free.scale * np.asarray(found.guess.z))
    with np.errstate(divide="ignore", invalid="ignore"):
        least = free.scale * left / moved
        wanted = np.where(numbers > least, numbers, np.maximum(free.scale, least))
        off = np.abs(np.log(wanted / free.scale)) > np.log(FAR_OFF)
    return np.where(np.isinf(free.reach) & np.isfinite(wanted) & off, wanted, free.scale)


def last_gap(problem: MultipleShooting) -> float:
    """The gap of segments that are one motion within the accuracy of the measurements."""
    if not problem.chained:
        return 1.0
    weights = np.asarray(problem.segments.weights)
    precision = float(np.max(weights * np.asarray(problem.ranges)))
    known = TIGHT / max(1.0, precision * np.sqrt(np.count_nonzero(weights)))
    return float(max(TIGHTEST, min(GAPS[3], known)))


def _with_its_noise(
    problem: MultipleShooting,
    noise: dict[str, float],
    found: SearchResult,
    where: SegmentLayout,
    tolerances: tuple[float, float],
    max_steps: int,
) -> tuple[MultipleShooting, dict[str, float], SearchResult, int]:
    """The problem weighted by the noise estimated from its residuals, the noise, result, steps."""
    iterations = 0
    for _ in range(NOISE_ROUNDS if noise else 0):
        changed = estimated_noise(found, problem, where, noise)
        settled = all(abs(changed[name] / noise[name] - 1) < 0.02 for name in noise)
        noise, problem = changed, with_noise(problem, where, changed)
        join, limits = jnp.asarray(last_gap(problem)), jnp.asarray(tolerances)
        found = search(problem, found.guess, join, limits, max_steps)
        iterations += int(found.steps)
        if settled:
            break
    return problem, noise, found, iterations


def _downhill(
    problem: MultipleShooting, descent: Descent, max_steps: int
) -> tuple[FitVariables, Float[np.ndarray, " epochs"], int]:
    """(end of a descent, its costs, solves); starts by least squares before and after it."""
    z, join = jnp.zeros(len(problem.free.u0)), _join(problem, descent)
    before = _starts(problem, z, jnp.zeros(problem.segments.guess.shape), join, max_steps)
    guess, costs, unsound = descend(problem, FitVariables(z, before.guess.x), descent)
    if int(unsound):
        text = f"{int(unsound)} steps of the descent had derivatives that are not finite"
        warnings.warn(f"{text}: these were replaced by 0.", stacklevel=4)
    after = _starts(problem, guess.z, guess.x, join, max_steps)
    count = len(guess.x)
    solves = (int(before.steps) + int(after.steps)) * count + descent.solves(count)
    return FitVariables(guess.z, after.guess.x), np.asarray(costs), solves


def _join(problem: MultipleShooting, descent: Descent) -> Float[Array, ""]:
    return jnp.asarray(descent.gap if problem.chained else 1.0)


def _starts(
    problem: MultipleShooting, z: Array, x: Array, join: Array, max_steps: int
) -> SearchResult:
    """Starts by least squares, with params held at z."""
    held = replace(problem, free=problem.free.held(z), prior=NO_PRIOR)
    return search(held, FitVariables(jnp.zeros(0), x), join, jnp.full(2, LOOSE), max_steps)


def _judged(
    problem: MultipleShooting,
    guess: FitVariables,
    descent: Descent,
    costs: Float[np.ndarray, " epochs"],
    linear: bool,
) -> SearchResult:
    """The result at the end of a descent, with or without derivatives."""
    cost, rows, seen, starts = judged(problem, guess, _join(problem, descent), linear)
    fell = bool(np.all(np.isfinite(costs)) and costs[-1] <= costs[0])
    return SearchResult(guess, jnp.asarray(fell), jnp.asarray(len(costs)), cost, rows, seen, starts)


def _warn_after(result: FitResult) -> None:
    if not result.converged:
        text = f"The search did not converge in {result.iterations} iterations: raise "
        text += "max_steps, take more segments, or choose params0 closer to the solution."
        if not result.freedom:
            text = "No segment has a solution at the estimates: choose a better params0."
        elif result.costs.size:
            text = f"The descent did not reduce the cost: {result.costs[0]:.3g} at first, "
            text += f"{result.costs[-1]:.3g} at the end. Take a lower learning rate."
        warnings.warn(text, stacklevel=3)
    if result.converged and result.distance > MAX_NEWTON_DISTANCE:
        text = f"At the estimates the Newton step is {result.distance:.2g} standard deviations long"
        fix = "lower rtol and atol, or take fixed steps (dt)"
        if result.costs.size:
            fix = "take more epochs"
        warnings.warn(f"{text}: {fix}.", stacklevel=3)
    few = len(result.names) <= LARGEST_COVARIANCE
    if few and np.isnan(result.singular_values).any():
        text = (
            "Derivatives at the estimates are not finite: there is no covariance, and the "
            "estimates may be"
        )
        warnings.warn(f"{text} wrong. Look for a square root or a norm at zero.", stacklevel=3)
    for name in result.unused:
        warnings.warn(f"nothing measured depends on {name}: it keeps its value.", stacklevel=3)
    for name, line in result.jumps.items():
        text = f"{name} is compared at {line}, and affects only where the equations jump. No "
        text += "derivative shows this: it keeps its value, and other estimates may be wrong. "
        text += "Make the time of the jump a knot of a table, inputs=function of the params, or "
        warnings.warn(f"{text}smooth the jump.", stacklevel=3)
    for force, names in result.feeding.items():
        text = f"At the estimates {force!r} adds energy instead of dissipating it. It depends on "
        text += f"{', '.join(names)}. Bound these (transforms=), or look for a force that is "
        warnings.warn(f"{text}missing, or for wrong measurements.", stacklevel=3)
    for name in result.on_bound:
        at = result.values[result.names.index(name)]
        text = f"{name} ended on its bound, {at:g}: widen the bound, or leave the parameter out."
        warnings.warn(text, stacklevel=3)
    for text in result.failed:
        warnings.warn(f"{text}: it is ignored.", stacklevel=3)
