"""Pendulums of one, two and three arms that swing freely (Kaheman et al., HardwareX 15, 2023).

Angles are absolute, 0 upright. A free swing identifies ratios only. Let c_k be the lever arms of
mass k about the joints, S = sum m_k c_k c_k^T + diag(I) and G = g sum m_k c_k. Then

    L = 1/2 sum S_ij w_i w_j cos(theta_i - theta_j) - sum G_i cos(theta_i),   S_11 = 1.

Friction acts at the joints and depends on relative rates. Air drag acts on the arms. The model of
both is chosen among candidates: each is fitted to two thirds of the training segments and predicts
the other third. Segments whose number is divisible by 3 are used for the test only.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._harness.timing import Reference, Target
from bench.fits._data import pieces, table, windows
from bench.fits._report import Figure, Part, errors, estimates, missed, timed

NAMES = {1: "single", 2: "double", 3: "triple"}
EVERY = 10  # ms: samples for fits and comparisons
EVERY_EARLY = 2  # ms: samples for starts that are fitted to 0.1 s
SETTLE = 0.1  # s
PIECES = 4  # segments of multiple shooting, for recordings of one arm
OPTIONS = {"simulate_options": {"method": "tsit5", "rtol": 1e-9, "atol": 1e-9}}
SLIP = 0.05  # rad/s, width of the sign change of dry friction
ANGLE = 0.05  # rad, width of the sign change of the restoring moment
QUICK = "viscous, falling, drag, restoring"  # the friction model of one arm in a quick run
# Errors of a fit to all segments, mrad, for comparison (single: whole segments; else 1 s).
REFITTED = {1: (2.05,), 2: (1.1, 1.5), 3: (1.2, 1.2, 1.1)}
MARGIN = 1.1
BOUNDS = {"u": jl.transforms.Bounded(0.3, 30.0)}  # rad/s
LOSS = jl.transforms.Bounded(0.0, np.inf)  # friction dissipates energy
# Published estimates, SI units: of the arms a (joint to mass center), L (joint to joint), I (about
# the mass center), m; of the joints k.
PUBLISHED: Mapping[int, dict[str, float]] = {
    1: {"m1": 0.147585, "a1": 0.147755, "I1": 1.09119e-4, "k1": 2.2394e-4, "g": 9.81},
    2: {"m1": 0.0938440, "a1": 0.108565, "L1": 0.172719, "I1": 4.37529e-4, "k1": 2.37143e-4}
    | {"m2": 0.137596, "a2": 0.116779, "I2": 1.26883e-3, "k2": 1.0e-5, "g": 9.80858},
    3: {"m1": 0.258172, "a1": 0.16, "L1": 0.1728, "I1": 1.00043e-4, "k1": 1.4771e-3}
    | {"m2": 0.279428, "a2": 0.202939, "L2": 0.2287, "I2": 3.1416e-4, "k2": 2.59577e-4}
    | {"m3": 0.118624, "a3": 0.183709, "I3": 1.68739e-4, "k3": 1.0e-5, "g": 9.80834},
}


def matrices(p: Mapping[str, Any], arms: int) -> tuple[Array, Array]:
    """(S, G) of masses, lever arms and inertias."""
    S, G = jnp.zeros((arms, arms)), jnp.zeros(arms)
    for k in range(1, arms + 1):
        levers = [p[f"L{j}"] for j in range(1, k)] + [p[f"a{k}"]] + [0.0] * (arms - k)
        c = jnp.stack([jnp.asarray(x, float) for x in levers])
        S = S + p[f"m{k}"] * jnp.outer(c, c)
        G = G + p["g"] * p[f"m{k}"] * c
    return S + jnp.diag(jnp.stack([p[f"I{k}"] for k in range(1, arms + 1)])), G


def base(arms: int) -> dict[str, float]:
    """Published estimates as the parameters that a free swing identifies."""
    S, G = matrices(PUBLISHED[arms], arms)
    found = {f"S{i + 1}{j + 1}": float(S[i, j] / S[0, 0]) for i, j in _entries(arms)}
    return found | {f"G{i + 1}": float(G[i] / S[0, 0]) for i in range(arms)}


def _entries(arms: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(arms) for j in range(i, arms) if j > 0]


def _swing(S: Array, G: Array, angles: Array, rates: Array) -> Array:
    """L of chained arms."""
    between = jnp.cos(angles[:, None] - angles)
    return 0.5 * rates @ (S * between) @ rates - G @ jnp.cos(angles)


def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L with base parameters; `zero` holds the encoder angles of upright arms."""
    arms = q.shape[0]
    S = jnp.zeros((arms, arms)).at[0, 0].set(1.0)
    for i, j in _entries(arms):
        S = S.at[i, j].set(p[f"S{i + 1}{j + 1}"]).at[j, i].set(p[f"S{i + 1}{j + 1}"])
    G = jnp.stack([p[f"G{i + 1}"] for i in range(arms)])
    return _swing(S, G, q - p["zero"], v)


def published_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L with masses, lever arms and inertias."""
    return _swing(*matrices(p, q.shape[0]), q, v)


def published_friction(t: Any, q: Array, v: Array, p: Any) -> Array:
    """R = 1/2 sum k_i (w_i - w_(i-1))^2."""
    k = jnp.stack([p[f"k{i + 1}"] for i in range(q.shape[0])])
    return 0.5 * k @ _relative(v) ** 2


def _relative(v: Array) -> Array:
    return v - jnp.concatenate([jnp.zeros(1), v[:-1]])


def _joints(moment: Callable[[Array, Any], Array], name: str) -> jl.GeneralizedForce:
    """Torques on the arms from joint torques between them, which oppose relative rates."""

    def force(t: Any, q: Array, v: Array, p: Any) -> Array:
        each = moment(_relative(v), p)
        return jnp.concatenate([each[1:], jnp.zeros(1)]) - each

    return jl.GeneralizedForce(force, name)


def _restoring(t: Any, q: Array, v: Array, p: Any) -> Array:
    return -p["r"] * jnp.tanh((q - jnp.pi - p["zero"]) / ANGLE)


VISCOUS = _joints(lambda r, p: p["k"] * r, "viscous")
COULOMB = _joints(lambda r, p: p["f"] * jnp.tanh(r / SLIP), "Coulomb")
FALLING = _joints(
    lambda r, p: p["f"] * jnp.tanh(r / SLIP) * jnp.exp(-jnp.abs(r) / p["u"]), "falling"
)
DRAG = jl.GeneralizedForce(lambda t, q, v, p: -p["d"] * v * jnp.abs(v), "drag")
SLOW_DRAG = jl.GeneralizedForce(lambda t, q, v, p: -p["b"] * v, "slow drag")
RESTORING = jl.GeneralizedForce(_restoring, "restoring")


def candidates(arms: int) -> dict[str, jl.Candidate]:
    """Models of friction: moments per S_11, 1/s^2, 1/s, 1, and rad/s of u."""
    start = {"k": 0.02, "f": 0.3, "d": 0.004, "u": 3.0, "r": 0.03, "b": 0.001}

    def candidate(names: str, *forces: Any) -> jl.Candidate:
        params0 = {name: np.full(arms, start[name]) for name in names}
        transforms = {name: BOUNDS.get(name, LOSS) for name in names}
        return jl.Candidate(*forces, params0=params0, transforms=transforms)

    found = {
        "viscous": candidate("k", VISCOUS),
        "viscous, Coulomb": candidate("kf", VISCOUS, COULOMB),
        "viscous, Coulomb, drag": candidate("kfd", VISCOUS, COULOMB, DRAG),
        "viscous, falling, drag": candidate("kfud", VISCOUS, FALLING, DRAG),
    }
    if arms == 1:
        more = candidate("kfudr", VISCOUS, FALLING, DRAG, RESTORING)
        return found | {"viscous, falling, drag, restoring": more}
    more = candidate("kfudb", VISCOUS, FALLING, DRAG, SLOW_DRAG)
    return found | {"viscous, falling, both drags": more}


def recordings(path: Path, arms: int, every: int) -> dict[int, jl.Experiment]:
    """Segments by number, sampled every `every` milliseconds."""
    columns = table(path / "multiarm_pendulum" / f"{NAMES[arms]}.csv.gz")
    found = {}
    for number, samples in pieces(columns, "seg").items():
        angles = np.stack([samples[f"theta{i + 1}"] for i in range(arms)], axis=1)
        t = samples["t"][::every] - samples["t"][0]
        name = f"segment {number}"
        found[number] = jl.Experiment(t, {"theta": angles[::every]}, name=name)
    return found


def measured(path: Path, arms: int) -> Part:
    """The choice of a friction model, its fit, and the errors of its predictions."""
    train, test = _divided(path, arms)
    best, figures = _chosen(arms, train)
    found, part = _tested(arms, best.name, best.fit.params, train, test)
    figures += part.figures + _ahead(path, arms, best.name, found)
    return Part(figures, part.targets, _unidentifiable(arms, train))


def tested(path: Path, arms: int, model: str) -> Part:
    """The fit of one of the friction models, and the errors of its predictions."""
    params0 = _frictionless(arms) | candidates(arms)[model].params0
    return _tested(arms, model, params0, *_divided(path, arms))[1]


def _divided(path: Path, arms: int) -> tuple[list[jl.Experiment], list[jl.Experiment]]:
    """(segments for training, segments for the test)."""
    segments = recordings(path, arms, EVERY)
    train = [x for number, x in segments.items() if number % 3]
    return train, [x for number, x in segments.items() if number % 3 == 0]


def fitted(segments: list[jl.Experiment], arms: int) -> list[jl.Experiment]:
    """Data for fits: whole segments of one arm, which is not chaotic; windows of several arms."""
    return segments if arms == 1 else windows(segments, 1.0)


def _name(arms: int) -> str:
    return f"{NAMES[arms]} pendulum"


def _system(arms: int) -> jl.System:
    return jl.System(lagrangian, {"theta": (arms,)})


def _frictionless(arms: int) -> dict[str, Any]:
    """Initial values without those of friction."""
    return base(arms) | {"zero": np.zeros(arms)}


def _options(arms: int) -> dict[str, Any]:
    # Single shooting over whole recordings of one arm ends in local minima.
    return {"segments": PIECES if arms == 1 else 1} | OPTIONS


def _chosen(arms: int, train: list[jl.Experiment]) -> tuple[Any, list[Figure]]:
    """(friction model with the best predictions, fitted to a part; errors of all models)."""
    recording, params0 = _name(arms), _frictionless(arms)
    held_out = fitted(train[1::3], arms)
    rest = fitted([x for i, x in enumerate(train) if i % 3 != 1], arms)
    begun = perf_counter()
    compared = jl.select_model(
        _system(arms),
        rest,
        params0,
        candidates(arms),
        held_out=held_out,
        free=tuple(params0),
        fit_options=_options(arms),
    )
    spent = perf_counter() - begun
    figures = []
    for model in compared.models:
        rms = model.prediction.rms("theta")
        figures += errors(recording, model.name, "chosen by: rms of a third of training", rms)
    solves = float(sum(model.fit.solves for model in compared.models))
    figures += [
        Figure(recording, "all of them", "run time of the comparison", "s", spent),
        Figure(recording, "all of them", "motions with derivatives", "1", solves),
    ]
    return compared.best, figures


def _tested(
    arms: int, model: str, params0: Any, train: list[jl.Experiment], test: list[jl.Experiment]
) -> tuple[jl.FitResult, Part]:
    """(fit to all segments for training, its estimates and errors)."""
    recording, system, free = _name(arms), _system(arms), tuple(_frictionless(arms))
    options, term = _options(arms), candidates(arms).get(model)  # None: without friction
    if term is not None:
        system = system.with_forces(*term.forces)
        free, options = (*free, *term.params0), options | {"transforms": term.transforms}
    fit = partial(jl.fit, system, fitted(train, arms), params0, free=free, **options)
    found, figures = timed(recording, model, fit)
    figures += estimates(recording, model, found, base(arms), "published")
    figures += errors(recording, model, "rms of training", found.rms("theta"))
    lengths = (
        {"9.17 s": test, "1 s": windows(test, 1.0)} if arms == 1 else {"1 s": windows(test, 1.0)}
    )
    shown = {x: missed(found.predict(data), "theta") for x, data in lengths.items()}
    length, best = next(iter(shown.items()))
    refitted = {length: (REFITTED[arms], "refitted to all")}
    for x, rms in shown.items():
        figures += errors(recording, model, f"rms of test, {x}", rms, *refitted.get(x, ()))
    claims = [f"mrad: rms of test, {length}, angle {i + 1} of the {recording}" for i in range(arms)]
    targets = [
        Target(claim, 1e3 * float(own), "<=", MARGIN * other)
        for claim, own, other in zip(claims, best, REFITTED[arms], strict=True)
    ]
    return found, Part(figures, targets, [])


def _published(arms: int) -> jl.System:
    friction = jl.Rayleigh(published_friction, "friction")
    return jl.System(published_lagrangian, {"theta": (arms,)}, forces=(friction,))


def _ahead(path: Path, arms: int, model: str, found: jl.FitResult) -> list[Figure]:
    """Predictions 1 s ahead of starts fitted to 0.1 s, compared with published params."""
    finer = recordings(path, arms, EVERY_EARLY)
    test = windows([x for n, x in finer.items() if n % 3 == 0], 1.1)
    own = found.predict(test, settle=SETTLE)
    theirs = jl.predict(_published(arms), test, PUBLISHED[arms], settle=SETTLE, **OPTIONS)
    return errors(
        _name(arms),
        model,
        "rms 1 s ahead of 0.1 s",
        missed(own, "theta"),
        1e3 * missed(theirs, "theta"),
        "published params",
    )


def _unidentifiable(arms: int, train: list[jl.Experiment]) -> list[Reference]:
    """Null directions of the model with masses, lever arms and inertias."""
    params = PUBLISHED[arms]
    found = jl.fit(_published(arms), fitted(train, arms), params, free=tuple(params), **OPTIONS)
    head = f"{_name(arms)}, {len(params)} params"
    return [Reference(head, f"unknown: {text}") for text in found.unidentifiable] + [
        Reference(head, f"known: {text}") for text in found.determined
    ]
