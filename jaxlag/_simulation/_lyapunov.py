"""Lyapunov exponents: growth of perturbations along a motion, and the validity of its gradients."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._core._arguments import positive_integer, renamed
from jaxlag._core._arrays import concrete, number
from jaxlag._core._batching import in_batches
from jaxlag._core._custom_jvp import CustomJVP
from jaxlag._core._errors import invalid, unsupported
from jaxlag._core._status import ADVICE, Status
from jaxlag._linalg._mass_solve import rank_floor
from jaxlag._model._inputs import all_knots
from jaxlag._simulation._methods import default_tolerances
from jaxlag._simulation._perturbation_growth import SURE, PerturbationGrowth, effective_rtol
from jaxlag._simulation._solution import Solution
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._traced_function import warn_of_changes

SEGMENTS_AT_ONCE = 64  # in one loop, at most
# Bytes of their stages from which XLA (0.10) splits operations between threads. It has no code for
# that inside a small loop: compilation would end in "Failed to materialize symbols".
STAGES_IN_BYTES = 2**18
TRANSIENT = 0.25  # part of the motion left out of the exponent
BLOCKS = 8  # of the rest, at most


@renamed(tol="step_rtol= and step_atol=")
def lyapunov(
    motion: Solution,
    *,
    rtol: Any = None,
    atol: Any = None,
    step_rtol: Any = None,
    step_atol: Any = None,
    max_steps: int = 1024,
) -> PerturbationGrowth:
    """Growth of perturbations along a motion: condition number, Lyapunov exponent, horizon.

    With y = (q, v), y' = f(t, y) and Phi(t, s) = dy(t)/dy(s), that is Phi' = df/dy Phi,
    Phi(s, s) = 1, and weights w(t) = atol + rtol |y(t)|, W = diag(w), the condition number is

        kappa(t) = max over save times s up to t of |W(t)^-1 Phi(t, s) W(s)|  (2-norm):

    Errors of size rtol and atol made by a solver during the motion are up to kappa(t) times as
    large at t. Phi is the product of its parts between neighboring save times. Each part is
    integrated together with y from the saved state, with the same error control as y. Products are
    rescaled and stored with their logarithms, so that they do not overflow.

    With constraints only perturbations dy that satisfy them count: the null space of the Jacobian
    of (phi, A v + b) in (q, v), with phi of the holonomic rows alone. Then
    kappa(t) = max over s and dy of |W(t)^-1 Phi(t, s) dy| / |W(s)^-1 dy|. The state is (q, v) also
    for motions in quasi-velocities.

    The largest Lyapunov exponent is the growth rate of log |Phi(t, ts[0])| after the first quarter
    of the motion, in a norm with constant weights. Its error combines the standard error of the
    mean over eight blocks of the rest with the effect of growth proportional to time, as of regular
    motions: log 4 / (3/4 span).

    The horizon is where max(rtol, eps) kappa(t) reaches 1, with eps the rounding of the dtype: an
    error of the tolerance is then as large as the state, and the gradient is that of another
    motion. It is extrapolated by the exponent if that is positive by more than three standard
    errors; otherwise it is inf.

    Args:
        motion: from `simulate`, at s >= 3 times. Its system, params and inputs are used. If it has
            batch axes, all results have them.
        rtol: of the weights, not negative; by default that of `simulate`, 1e-9 in float64, 1e-5 in
            float32. kappa depends on atol / rtol alone, the horizon on rtol.
        atol: of the weights, positive, m or rad and m/s or rad/s; by default 1e-9 and 1e-6.
        step_rtol: relative tolerance of the steps between save times; by default 1e-10, 1e-5 in
            float32. The error of each part of Phi is about this times its size, or times 1 if that
            is larger; errors of products are the sum over their parts. In addition Phi follows the
            saved states, which have errors of their own.
        step_atol: absolute tolerance of the same steps, m or rad and m/s or rad/s; by default
            1e-10, 1e-5 in float32.
        max_steps: bound on steps from one save time to the next.

    Raises:
        ValueError: not a Solution; fewer than 3 save times; a single motion that did not succeed,
            or has a segment that cannot be solved again; tolerances out of range; a derivative of
            the results.

    Warns if a motion continues beyond its horizon and its values are known.

    Cost: s integrations of 2n + 4n^2 numbers, and s^2 norms of (2n, 2n) matrices, 2 us each.

    Limits: the numbers cannot be differentiated. If f jumps with the state, as with dry friction,
    Phi does not contain the effect of the jump itself. A finite motion gives a finite-time
    exponent.

    Source: Benettin, Galgani, Giorgilli, Strelcyn, Meccanica 15 (1980) 9 and 21; Hairer, Norsett,
    Wanner, Solving Ordinary Differential Equations I, sec. I.14 (variational equation).

    Example:
        A pendulum upside down, theta'' = theta at small angles, falls as exp(t):

        >>> import jax, jax.numpy as jnp, jaxlag as jl
        >>> jax.config.update("jax_enable_x64", True)
        >>> def lagrangian(t, q, v, params):
        ...     return 0.5 * v[0] ** 2 - jnp.cos(q[0])
        >>> pendulum = jl.System(lagrangian, coordinates=("theta",))
        >>> motion = jl.simulate(pendulum, [0.0], [0.0], jnp.linspace(0.0, 10.0, 21))
        >>> growth = jl.lyapunov(motion)
        >>> print(f"{growth.exponent:.4f} 1/s, kappa {growth.kappa[-1]:.1f}")
        1.0000 1/s, kappa 22026.5
        >>> print(f"horizon {growth.horizon:.3f} s")
        horizon 20.723 s
    """
    if not isinstance(motion, Solution):
        fix = "Pass what jl.simulate returns."
        raise invalid("lyapunov: motion", "be a jl.Solution", f"it was {motion!r}", fix)
    if motion.system.states is not None:
        was = f"it had the states {list(motion.system.states.names)}"
        raise invalid("lyapunov: motion", "be of a system without states=", was)
    if motion.ts.shape[-1] < 3:
        must, was = "have at least 3 save times", f"it had {motion.ts.shape[-1]}"
        fix = "Simulate it with ts=jnp.linspace(t0, t1, 101)."
        raise invalid("lyapunov: motion", must, was, fix)
    single = motion.ts.ndim == 1 and concrete(motion.status)
    if single and int(motion.status) != int(Status.ok):
        was = f"it ended with status {motion.message()}"
        raise invalid("lyapunov: motion", "have reached its last time", was)
    max_steps = positive_integer("lyapunov: max_steps", max_steps)
    dtype = motion.q.dtype
    defaults = default_tolerances(dtype)
    finest = 1e-10 if jnp.finfo(dtype).bits == 64 else defaults[0]
    rtol = _not_negative("rtol", rtol, defaults[0], dtype)
    atol = _not_negative("atol", atol, defaults[1], dtype, zero=False)
    step_rtol = _not_negative("step_rtol", step_rtol, finest, dtype, zero=False)
    step_atol = _not_negative("step_atol", step_atol, finest, dtype, zero=False)

    warn_of_changes(motion.system, motion.inputs)
    static = motion._params_static, motion._inputs_static
    key = motion.system, *static, motion.formulation, max_steps, motion.ts.ndim - 1
    given = (motion.ts, motion.q, motion.v, motion._params_traced, motion._inputs_traced)
    traced = _not_differentiated(given)
    growth, statuses = _growth(key, traced, motion.status, (rtol, atol, step_rtol, step_atol))
    if single and int(growth.status) != int(Status.ok):
        i = int(np.argmax(np.asarray(statuses) != int(Status.ok)))
        status = Status(int(statuses[i]))
        was = f"from t = {motion.ts[i]} to {motion.ts[i + 1]} the status was {status.name}"
        raise invalid(
            "lyapunov: motion", "be solvable from each of its save times", was, _fix(status)
        )
    if concrete(growth.horizon):
        _warn_beyond(growth)
    return growth


@CustomJVP
def _not_differentiated(x: Any) -> Any:
    """The same; an error is raised if a derivative is requested."""
    return x


@partial(_not_differentiated.defjvp, symbolic_zeros=True)
def _refused(primals: tuple, tangents: tuple) -> Any:
    if jax.tree.leaves(tangents):
        fix = "Pass jax.lax.stop_gradient of the motion's start and params."
        raise unsupported("A derivative of `lyapunov`", "its results are not differentiable", fix)
    return primals[0], None


def _warn_beyond(growth: PerturbationGrowth) -> None:
    """Warn if motions continue beyond their horizon; Python shows it once for each caller."""
    span, horizon = np.abs(growth.ts[..., -1] - growth.ts[..., 0]), np.asarray(growth.horizon)
    beyond = np.asarray(span) > horizon
    if beyond.ndim == 0 and beyond:
        warnings.warn(growth.message(), stacklevel=3)
    elif beyond.any():
        text = f"{np.sum(beyond)} of {beyond.size} motions end beyond the horizon of their growth"
        warnings.warn(f"{text}: gradients at their ends are meaningless.", stacklevel=3)


def _not_negative(name: str, x: Any, default: float, dtype: Any, zero: bool = True) -> Array:
    must = "be a number that is not negative" if zero else "be a positive number"
    x = number(f"lyapunov: {name}", must, default if x is None else x, dtype)
    if concrete(x) and not (x >= 0 if zero else x > 0):
        raise invalid(f"lyapunov: {name}", must, f"it was {x}")
    return x


def _fix(status: Status) -> str:
    if status is Status.max_steps:
        return "Save the motion at more times, raise max_steps, or loosen step_rtol and step_atol."
    return ADVICE.get(status, "")


@partial(jax.jit, static_argnums=0)
def _growth(key: Any, traced: Any, status: Array, tolerances: Any) -> Any:
    system, params_static, inputs_static, formulation, max_steps, batch = key
    rtol, atol, *of_steps = tolerances

    def one(traced: Any, status: Array) -> tuple[PerturbationGrowth, Array]:
        ts, q, v, params, inputs = traced
        params = _params.join(params, params_static.tree)
        inputs = eqx.combine(inputs, inputs_static.tree)
        y = jnp.concatenate([q, v], -1)
        y = jnp.where(status == int(Status.ok), y, y[:1])  # NaN at times that were not reached

        rate = partial(_rate, system, formulation, params, inputs)
        tangent = jax.vmap(partial(_tangent, system, params))
        knots, allowed = all_knots(inputs), tangent(ts, y, jnp.ones_like(y))
        Phi, statuses = _transitions(rate, ts, y, allowed, knots, of_steps, max_steps)

        w = atol + rtol * jnp.abs(y)
        projectors = tangent(ts, y, w)
        steps = projectors[1:] @ (Phi * w[:-1, None, :] / w[1:, :, None]) @ projectors[:-1]
        # Constant weights: the exponent is that of the motion alone.
        scale = w / (atol + rtol * jnp.max(jnp.abs(y), axis=0))[None]
        log_kappa, log_norm, log_size = _products(steps, projectors, scale)

        tau = jnp.abs(ts - ts[0]).astype(y.dtype)
        exponent, error = _exponent(tau, log_size)
        horizon = _horizon(tau, log_kappa, exponent, error, -jnp.log(effective_rtol(rtol)))

        status = jnp.where(status == int(Status.ok), jnp.max(statuses), status)
        found = (Phi, log_kappa, log_norm, exponent, error, horizon)
        found = [jnp.where(status == int(Status.ok), x, jnp.nan) for x in found]
        return PerturbationGrowth(ts, *found, rtol=rtol, atol=atol, status=status), statuses

    for _ in range(batch):
        one = jax.vmap(one)
    return one(traced, status)


def _rate(system: System, formulation: str, params: Any, inputs: Any, t: Array, y: Array) -> Array:
    """f(t, y) = (v, a)."""
    q, v = jnp.split(y, 2)
    if formulation == "quasi":
        a = system._quasi_reactions(q, v, params, t=t, inputs=inputs)["a"]
    else:
        a = system.acceleration(q, v, params, t=t, inputs=inputs)
    return jnp.concatenate([v, a])


def _tangent(system: System, params: Any, t: Array, y: Array, w: Array) -> Array:
    """Orthogonal projector onto the perturbations dy / w with phi = 0 and A v + b = 0."""
    n, one = system.size, jnp.eye(y.shape[0], dtype=y.dtype)
    if not system.constraints:
        return one

    def conditions(y: Array) -> Array:
        phi = system._terms.position(t, y[:n], params)
        return jnp.concatenate([phi, system._terms.velocity(t, y[:n], y[n:], params)])

    C = jax.jacfwd(conditions)(y) * w
    size = jnp.linalg.norm(C, axis=1, keepdims=True)
    _, sizes, normals = jnp.linalg.svd(C / jnp.where(size > 0, size, 1.0), full_matrices=False)
    independent = sizes > rank_floor(y.dtype) ** 0.5
    normals = jnp.where(independent[:, None], normals, 0.0)
    return one - normals.T @ normals


def _transitions(
    rate: Callable[[Array, Array], Array],
    ts: Array,
    y: Array,
    directions: Array,
    knots: Array | None,
    tolerances: Sequence[Array],
    max_steps: int,
) -> tuple[Array, Array]:
    """(Phi(ts[i + 1], ts[i]) directions[i], status) of every segment: y' = f, Y' = df/dy Y.

    Y determines the steps: at an equilibrium y alone would not bound them.
    """
    # The solver uses the dtype of time for its state; the system uses its own.
    inside, outside = y.dtype, ts.dtype

    def rates(t: Any, state: tuple[Array, Array], _: None) -> tuple[Array, Array]:
        y, Y = (x.astype(inside) for x in state)
        f, along = jax.linearize(partial(rate, t), y)
        return f.astype(outside), jax.vmap(along, in_axes=1, out_axes=1)(Y).astype(outside)

    rtol, atol = (x.astype(outside) for x in tolerances)
    controller = diffrax.PIDController(rtol=rtol, atol=atol)
    if knots is not None:
        controller = diffrax.ClipStepSizeController(controller, jump_ts=knots.astype(outside))
    solver, term = diffrax.Dopri8(), diffrax.ODETerm(rates)

    def segment(part: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        begin, end, *state = part
        state = tuple(x.astype(outside) for x in state)
        found = diffrax.diffeqsolve(
            term,
            solver,
            begin,
            end,
            None,
            state,
            stepsize_controller=controller,
            max_steps=max_steps,
            throw=False,
        )
        assert found.ys is not None
        Y = found.ys[1][0].astype(inside)
        many = found.result == diffrax.RESULTS.max_steps_reached
        failure = jnp.where(many, int(Status.max_steps), int(Status.nonfinite))
        good = (found.result == diffrax.RESULTS.successful) & jnp.all(jnp.isfinite(Y))
        return Y, jnp.where(good, int(Status.ok), failure).astype(jnp.int32)

    parts = (ts[:-1], ts[1:], y[:-1], directions[:-1])
    stages = len(solver.tableau.b_sol) * y.shape[1] * (y.shape[1] + 1) * ts.dtype.itemsize
    at_once = min(SEGMENTS_AT_ONCE, max(1, STAGES_IN_BYTES // stages))
    return in_batches(segment, parts, ts.shape[0] - 1, at_once)


def _products(steps: Array, starts: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Logarithms at every save time: the largest product, the product from ts[0], and its size.

    All products steps[j - 1] ... steps[i] starts[i] are updated and rescaled to norm 1.
    """

    def body_fun(carry: tuple[Array, Array], part: tuple) -> tuple[tuple[Array, Array], Any]:
        (products, logs), (j, step, start, scale) = carry, part
        products = (step @ products).at[j].set(start)
        norms = jnp.linalg.norm(products, ord=2, axis=(-2, -1))
        started = jnp.arange(len(norms)) <= j
        logs = jnp.where(started, logs + jnp.log(norms), 0.0)
        products = products / jnp.where(norms > 0, norms, 1.0)[:, None, None]
        size = logs[0] + jnp.log(jnp.linalg.norm(scale[:, None] * products[0], ord=2))
        return (products, logs), (jnp.max(jnp.where(started, logs, -jnp.inf)), logs[0], size)

    count = starts.shape[0]
    init = jnp.zeros_like(starts), jnp.zeros((count,), starts.dtype)
    into = jnp.concatenate([starts[:1], steps])  # no product starts before the first save time
    parts = (jnp.arange(count), into, starts, scale)
    return jax.lax.scan(body_fun, init, parts)[1]


def _exponent(tau: Array, log_size: Array) -> tuple[Array, Array]:
    """Rate of log_size after the transient, and its standard error."""
    begin, end = TRANSIENT * tau[-1], tau[-1]
    count = int(np.clip((1 - TRANSIENT) * (tau.shape[0] - 1), 2, BLOCKS))
    logs = jnp.interp(jnp.linspace(begin, end, count + 1), tau, log_size)
    rates = jnp.diff(logs) * count / (end - begin)
    by_chance = jnp.std(rates, ddof=1) / count**0.5
    by_power = -float(np.log(TRANSIENT)) / (end - begin)  # of growth proportional to t
    return jnp.mean(rates), jnp.hypot(by_chance, by_power)


def _horizon(tau: Array, log_kappa: Array, exponent: Array, error: Array, level: Array) -> Array:
    """The time at which log_kappa reaches the level, between save times or beyond the last."""
    over = log_kappa >= level
    i = jnp.maximum(jnp.argmax(over), 1)
    slope = (log_kappa[i] - log_kappa[i - 1]) / (tau[i] - tau[i - 1])
    within = tau[i - 1] + (level - log_kappa[i - 1]) / slope
    sure = exponent > SURE * error
    after = tau[-1] + (level - log_kappa[-1]) / jnp.where(sure, exponent, 1.0)
    after = jnp.where(sure, after, jnp.inf)
    return jnp.where(over[0], 0.0, jnp.where(jnp.any(over), within, after))
