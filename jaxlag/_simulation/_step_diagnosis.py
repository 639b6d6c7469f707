"""Diagnosis of short steps: `Solution.explain`."""

from collections import Counter
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import unsupported
from jaxlag._core._status import Status
from jaxlag._integration._linearized_rates import linearized
from jaxlag._integration._term import term_of
from jaxlag._linalg._projection import iterations_needed
from jaxlag._simulation._abstract_solution import AbstractSolution
from jaxlag._simulation._failure import MotionKey, dynamics_of
from jaxlag._simulation._methods import of_components

LOOKED_AT = 8  # states examined, evenly along the motion
STIFF = (1.5, 10.0)  # products of step and decay rate near the limits of stability (3 to 6)
FOLLOWED = (1.5, 25.0)  # steps per period of an oscillation that they resolve
OFTEN = 1000  # periods within ts from which on resolving each makes a solve slow
REJECTED = 0.3  # part of the attempts
UNEVEN = 0.1  # part of the attempts from which on the sharpest places determine the steps
ITERATIONS = 3  # iterations of the projection, after one step


class Look(NamedTuple):
    """One state of the motion, and the step of mean length from there.

    Attributes:
        rates: d(dy/dt)/dy, (m, m).
        mass: M, (n, n).
        error: local error of a step of order 8 over the tolerance, (m,); over 1 without tolerances.
        iterations: of the projection at the end of this step.
    """

    rates: Float[Array, "m m"]
    mass: Float[Array, "n n"]
    error: Float[Array, " m"]
    iterations: Int[Array, ""]


class Rates(NamedTuple):
    """The fastest rate of the linearized equations along a motion.

    Attributes:
        fastest: largest |lambda|, 1/s.
        kind: its kind: "oscillates", "grows" or "decays".
    """

    fastest: float
    kind: str


def is_stiff(motion: AbstractSolution) -> bool:
    """Whether the stability limit of the fastest decay determines the length of explicit steps."""
    return stiffness(motion) is not None


def stiffness(motion: AbstractSolution) -> Rates | None:
    """The decay that limits explicit steps by stability; None if there is none."""
    h = _mean_step(motion)
    if h is None or motion.scene.implicit:
        return None
    rates = _rates(_look(motion, h, last=True))
    if rates is None or rates.kind != "decays" or not _within(h * rates.fastest, STIFF):
        return None
    return rates


def explain(motion: AbstractSolution) -> str:
    """The steps of one motion, the reasons for their length, and advice.

    Raises:
        ValueError: a batch of motions, or a traced one.
    """
    motion.require_single("explain")
    if not concrete(motion.status, motion.q, motion.last_time, motion.ts):
        raise unsupported(
            "`explain` inside jit or vmap", "it needs concrete values, and the motion is traced"
        )
    accepted, rejected = counts(motion)
    how = "fixed steps"
    if motion.tolerances is not None:
        rtol, atol = map(np.asarray, motion.tolerances)
        least, most = np.min(atol), np.max(atol)
        how = f"rtol {rtol:.3g}, atol {least:.3g}" + f" to {most:.3g}" * bool(most > least)
    lines = [
        f"method        {motion.method}, {how}, {motion.formulation}",
        f"status        {motion.message()}",
    ]
    if motion.fallback:
        lines.append(f"formulation   {motion.fallback}")
    h, advice = _mean_step(motion), []
    attempts = accepted + rejected
    lines.append(
        f"steps         {attempts} attempted, {rejected} rejected"
        + (f" ({rejected / attempts:.0%})" if attempts else "")
        + ("" if h is None else f", {h:.3g} s on average")
    )
    if h is None:
        return "\n".join(lines)
    if int(motion.status) == Status.max_steps:
        elapsed = abs(float(motion.last_time - motion.ts[0]))
        span = abs(float(motion.ts[-1] - motion.ts[0]))
        advice.append(
            f"The solve reached {elapsed / span:.1%} of ts: the whole of ts takes about "
            f"{attempts * span / elapsed:.2g} steps at this rate."
        )
    if attempts >= 20 and rejected > REJECTED * attempts:
        advice.append(
            "Many steps were rejected: the step shrinks at every jump, kink or steep rise of a "
            "force. If its times are known, let the force read an input with knots at these times: "
            "steps end there. If it depends on the position, these steps are needed."
        )
    fixed = motion.tolerances is None
    if coarse := about_time(motion):
        advice.append(coarse)
    looks = _look(motion, h)
    lines += _about_rates(motion, h, _rates(looks), advice)
    lines += _about_mass(motion, looks, advice)
    if not motion.scene.implicit:  # these are measured in an explicit step
        lines += [] if fixed else _about_errors(motion, looks)
        lines += _about_projection(motion, looks, advice)
    if not advice and fixed:
        advice.append(
            "dt alone sets the number of steps, and no other cause was found. "
            "estimate_error=True shows whether a longer dt is accurate enough."
        )
    elif not advice and rejected > UNEVEN * attempts:
        advice.append("Accuracy limits the step, most of all where forces change fast.")
    elif not advice:
        advice.append(
            "Accuracy limits the step, and no other cause was found: loosen rtol and atol."
        )
    heads = ["advice        ", *["              "] * (len(advice) - 1)]
    return "\n".join(lines + [head + line for head, line in zip(heads, advice, strict=True)])


def counts(motion: AbstractSolution) -> tuple[int, int]:
    """Steps (accepted, rejected)."""
    return int(motion.stats["accepted"]), int(motion.stats["rejected"])


def _mean_step(motion: AbstractSolution) -> float | None:
    accepted = int(motion.stats["accepted"])
    elapsed = abs(float(motion.last_time - motion.ts[0]))
    return elapsed / accepted if accepted and elapsed > 0 else None


def about_time(motion: AbstractSolution) -> str:
    """Advice on times so far from 0 that their rounding exceeds the tolerance."""
    h = _mean_step(motion)
    if h is None or motion.tolerances is None:
        return ""
    farthest = float(jnp.max(jnp.abs(motion.ts)))
    digit = float(jnp.finfo(motion.ts.dtype).eps) * farthest
    if digit <= 10 * float(np.max(np.asarray(motion.tolerances[0]))) * h:
        return ""
    return (
        f"Times near {farthest:.3g} s are {digit:.2g} s apart: in steps this short, functions of "
        "time change in jumps. Measure time from the start, and make the start a parameter."
    )


def _within(x: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] < x < bounds[1]


def _about_rates(
    motion: AbstractSolution, h: float, rates: Rates | None, advice: list[str]
) -> list[str]:
    if rates is None or rates.fastest == 0:
        return []
    product, time = h * rates.fastest, 1 / rates.fastest
    if rates.kind == "grows":
        return [f"rates         fastest growth e-fold in {time:.3g} s, {1 / product:.2g} steps"]
    if rates.kind == "decays":
        if _within(product, STIFF) and not motion.scene.implicit:
            advice.append(
                f"It is stiff: a component decays in {time:.3g} s, and explicit steps must stay "
                "about as short after its decay. Steps of method='kvaerno5' may be longer."
            )
        return [f"rates         fastest decay 1/e in {time:.3g} s, {1 / product:.2g} steps"]
    period = 2 * np.pi * time
    periods = abs(float(motion.ts[-1] - motion.ts[0])) / period
    if _within(period / h, FOLLOWED) and periods > OFTEN and not motion.scene.implicit:
        advice.append(
            f"The steps follow an oscillation of period {period:.3g} s, {periods:.2g} periods in "
            "ts: if it does not matter, replace the stiff part with a constraint."
        )
    return [
        f"rates         fastest oscillation of period {period:.3g} s, {period / h:.3g} steps each"
    ]


def _about_errors(motion: AbstractSolution, looks: Look) -> list[str]:
    error = np.asarray(looks.error)
    sound = np.all(np.isfinite(error), axis=1) & (np.max(error, axis=1) > 0)
    if not sound.any():
        return []
    labels, system = list(motion.system.coordinates.labels), motion.system
    if motion.formulation == "quasi" and system.quasi is not None:
        names = labels + [system.quasi.names[i] for i in system.quasi.free]
    else:
        names = labels + [f"d({label})/dt" for label in labels]
    names += [] if system.states is None else system.states.layout.labels
    (index, often), *_ = Counter(np.argmax(error[sound], axis=1).tolist()).most_common(1)
    share = f"in {often} of {int(sound.sum())} states"
    return [f"error         largest, relative to its tolerance, in {names[index]} ({share})"]


def _about_mass(motion: AbstractSolution, looks: Look, advice: list[str]) -> list[str]:
    """About M with its diagonal scaled to 1: units do not matter."""
    worst, label = 1.0, ""
    for M in np.asarray(looks.mass):
        size = np.sqrt(np.abs(np.diag(M)))
        if not np.all(np.isfinite(M)):
            continue
        if np.min(size) == 0:
            label = motion.system.coordinates.labels[int(np.argmin(size))]
            return [f"mass matrix   no inertia of its own along {label!r}"]
        values, axes = np.linalg.eigh(M / np.outer(size, size))
        condition = values[-1] / max(values[0], np.finfo(M.dtype).tiny)
        if condition > worst:
            label = motion.system.coordinates.labels[int(np.argmax(np.abs(axes[:, 0])))]
            worst = condition
    eps = float(np.finfo(np.asarray(looks.mass).dtype).eps)
    if worst * eps > 1:
        return [f"mass matrix   singular by itself, as along {label!r}"]
    if worst > 1 / np.sqrt(eps):
        advice.append(
            f"M is nearly singular, as along {label!r}: accelerations are accurate to about "
            f"{-np.log10(worst * eps):.0f} digits. Choose coordinates with inertias of their own."
        )
    return [f"mass matrix   cond(M) up to {worst:.2g} with its diagonal scaled to 1"]


def _about_projection(motion: AbstractSolution, looks: Look, advice: list[str]) -> list[str]:
    most = int(np.max(looks.iterations))
    if most == 0:
        return []
    if most > ITERATIONS:
        advice.append(
            f"The projection of a step onto the constraints takes up to {most} iterations: steps "
            "are long for the curvature of the constraints. A tighter tolerance may be faster."
        )
    return [f"projection    up to {most} iteration{'s' if most > 1 else ''} per step"]


def _rates(looks: Look) -> Rates | None:
    """The fastest rate of all examined states; None if none is finite."""
    found = [J for J in np.asarray(looks.rates) if np.all(np.isfinite(J))]
    if not found:
        return None
    rates: Any = np.concatenate([np.linalg.eigvals(J) for J in found])
    size = np.abs(rates)
    # Pairs of a saddle differ only by the error of the differences: the growth counts.
    largest = rates[size > 0.99 * np.max(size)] if np.max(size) > 0 else rates
    kind = "decays"
    if np.any(np.abs(largest.imag) > np.abs(largest.real)):
        kind = "oscillates"
    elif np.any(largest.real > 0):
        kind = "grows"
    return Rates(float(np.max(size)), kind)


def _look(motion: AbstractSolution, h: float, last: bool = False) -> Look:
    reached = np.flatnonzero(np.all(np.isfinite(np.asarray(motion.q)), axis=1))
    chosen = reached[np.unique(np.linspace(0, len(reached) - 1, LOOKED_AT).round().astype(int))]
    along = motion.ts, motion.q, motion.v, motion.x
    places = jax.tree.map(lambda y: np.asarray(y)[chosen], along)
    end = motion.last_time, *motion.last_state, motion.last_x
    end = jax.tree.map(lambda y: np.asarray(y)[None], end)
    if last:
        places = end
    elif int(motion.status) != Status.ok:
        places = jax.tree.map(lambda *pair: np.concatenate(pair), places, end)
    tolerances = motion.tolerances or (jnp.ones(()), jnp.ones(()))
    given = motion._params_traced, motion._inputs_traced
    return _looks(motion.scene, (motion.ts[jnp.array([0, -1])], places, h, *given, tolerances))


@partial(jax.jit, static_argnums=0)
def _looks(scene: MotionKey, traced: Any) -> Look:
    span, places, h, params, inputs, (rtol, atol) = traced
    first = jax.tree.map(lambda y: y[0], places)
    dynamics, args = dynamics_of(scene, span, first, params, inputs)
    given, _ = dynamics.given(args)
    solver = diffrax.Dopri8(scan_kind="lax")

    def at(place: tuple[Array, Array, Array, Array | None]) -> Look:
        tau, y = dynamics.tau(place[0], args), dynamics.state_of(*place, given)
        here = dynamics.within(args, tau)
        term = term_of(dynamics, tau, y, here)
        _, rates = linearized(lambda y: dynamics(tau, y, here), y)
        memory = solver.init(term, tau, tau + h, y, here)
        y1, error, *_ = solver.step(term, tau, tau + h, y, here, memory, made_jump=False)
        iterations = jnp.zeros((), jnp.int32)
        if dynamics.projects:
            iterations = iterations_needed(
                dynamics.projector(tau + h, y1, here), *dynamics.parts(y1)
            )
        allowed = atol if atol.ndim == 0 else of_components(atol, dynamics.system.size)
        scaled = jnp.abs(jnp.asarray(error)) / (allowed + rtol * jnp.abs(y))
        return Look(rates, dynamics.mass(tau, y, here), scaled, iterations)

    return jax.lax.map(at, places)
