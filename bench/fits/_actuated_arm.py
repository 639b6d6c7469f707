"""Pendulums whose joints are driven (Wiebe et al., JOSS 7(74) 3884, 2022, and IEEE Robotics &
Automation Magazine 31(2), 2024): one arm, and two arms of two designs.

Angles are 0 for hanging arms; the second angle is relative to the first arm. Torques are measured
at the output shaft. Friction at a joint is b v + cf 2/pi atan(100 v), as in the published models.

One arm: J q'' = -g ml sin q + s tau + u0 - friction. The torque scale s, J and ml cannot all be
identified: either s = 1, or J and ml are those of the documented masses.

Two arms, of gear ratio 6, with the inertia Ir of each rotor before the gear:

    M11 = A + I2 + 2 C cos q2 + 37 Ir,   M12 = I2 + C cos q2 - 6 Ir,   M22 = I2 + 36 Ir
    V   = -g (P1 cos q1 + P2 cos(q1 + q2))

A = I1 + m2 l1^2, C = m2 l1 r2, P1 = m1 r1 + m2 l1, P2 = m2 r2, I1 and I2 about the joints.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._harness.timing import Reference
from bench.fits._data import table, windows
from bench.fits._report import Part, errors, estimates, missed, timed

G = 9.81  # m/s^2
GEAR = 6.0
EVERY = 5  # samples of 2 ms
OPTIONS = {"simulate_options": {"method": "tsit5", "rtol": 1e-6, "atol": 1e-6, "max_steps": 4096}}
STEEP = 100.0  # s/rad, steepness of dry friction at zero rate
LOSS = jl.transforms.Bounded(0.0, np.inf)  # friction dissipates energy

# ---- One arm -------------------------------------------------------------------------------------

# Of the documented masses: J about the axis with the rotor's inertia, kg m^2; m l, kg m.
DOCUMENTED = {"J": 0.1485, "ml": 0.305}
ARM_START = {"J": 0.15, "ml": 0.3, "u0": 0.0, "s": 1.0}
ARM_START |= {"b": np.array([0.01]), "cf": np.array([0.1])}
QUICK = ("torque as measured",)
# Free params and fixed ones.
MODELS: Mapping[str, tuple[tuple[str, ...], Mapping[str, float]]] = {
    "torque as measured": (("J", "ml", "b", "cf", "u0"), {}),
    "documented masses": (("s", "b", "cf", "u0"), DOCUMENTED),
}


def arm_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L = 1/2 J q'^2 + g ml cos q."""
    return 0.5 * p["J"] * v[0] ** 2 + G * p["ml"] * jnp.cos(q[0])


def friction(t: Any, q: Array, v: Array, p: Any) -> Array:
    """Friction torques, which oppose the rates."""
    return -p["b"] * v - p["cf"] * (2 / jnp.pi) * jnp.arctan(STEEP * v)


def arm_motor(t: Any, q: Array, v: Array, p: Any, inputs: Any) -> Array:
    """s tau + u0."""
    return p["s"] * inputs["torque"] + p["u0"]


# ---- Two arms ------------------------------------------------------------------------------------

# Published: m1, m2, l1, r1, r2, I1, I2, Ir, then b and cf of both joints.
DESIGNS: Mapping[str, Mapping[str, Any]] = {
    "A": {
        "published": (0.5594, 0.6043, 0.3, 0.3, 0.18378, 0.05347, 0.02392, 7.66e-5),
        "cf": (0.093, 0.078),
        "train": ("A_traj00", "A_traj01", "A_traj05", "A_traj11"),
        "test": ("A_traj03", "A_traj12"),
    },
    "C.1": {
        "published": (0.5235, 0.6256, 0.2, 0.2, 0.25569, 0.03189, 0.05087, 6.287e-5),
        "cf": (0.16, 0.12),
        "train": ("C1_143339", "C1_143601", "C1_154220"),
        "test": ("C1_143524", "C1_143747"),
    },
}


def published(design: str) -> dict[str, Any]:
    """Params of the published model."""
    m1, m2, l1, r1, r2, I1, I2, Ir = DESIGNS[design]["published"]
    found = {"A": I1 + m2 * l1**2, "I2": I2, "C": m2 * l1 * r2, "P1": m1 * r1 + m2 * l1}
    found |= {"P2": m2 * r2, "Ir": Ir}
    return found | {"b": np.full(2, 1e-3), "cf": np.array(DESIGNS[design]["cf"])}


def arms_lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L of the module docstring."""
    c, Ir = p["C"] * jnp.cos(q[1]), p["Ir"]
    m11 = p["A"] + p["I2"] + 2 * c + (GEAR**2 + 1) * Ir
    m12 = p["I2"] + c - GEAR * Ir
    m22 = p["I2"] + GEAR**2 * Ir
    T = 0.5 * m11 * v[0] ** 2 + m12 * v[0] * v[1] + 0.5 * m22 * v[1] ** 2
    return T + G * (p["P1"] * jnp.cos(q[0]) + p["P2"] * jnp.cos(q[0] + q[1]))


def arms_motor(t: Any, q: Array, v: Array, p: Any, inputs: Any) -> Array:
    """Both torques."""
    return inputs["torque"]


FRICTION = jl.GeneralizedForce(friction, "friction")
ARM = jl.System(
    arm_lagrangian, {"q": (1,)}, forces=(FRICTION, jl.GeneralizedForce(arm_motor, "motor"))
)
ARMS = jl.System(
    arms_lagrangian, {"q": (2,)}, forces=(FRICTION, jl.GeneralizedForce(arms_motor, "motor"))
)


def recording(path: Path, columns: tuple[str, ...], torques: tuple[str, ...], every: int) -> Any:
    """One run: angles at every `every`-th sample, torques at all samples."""
    samples = table(path)
    t = samples["t"]
    angles, torque = (np.stack([samples[x] for x in names], axis=1) for names in (columns, torques))
    return jl.Experiment(
        t[::every],
        {"q": angles[::every]},
        inputs={"torque": jl.LinearInterpolation(t, torque)},
        name=path.name.removesuffix(".csv.gz"),
    )


def arm(path: Path, models: Sequence[str] = tuple(MODELS)) -> Part:
    """Fit to the run at 500 Hz, test on the run at 50 Hz, in windows of 1 s."""
    name = "one driven arm"
    folder = path / "dfki_simple_pendulum"
    train = windows([recording(folder / "ddp.csv.gz", ("q",), ("tau_meas",), EVERY)], 1.0)
    test = windows([recording(folder / "ilqr.csv.gz", ("q",), ("tau_meas",), 1)], 1.0)
    figures = []
    for model in models:
        free, fixed = MODELS[model]
        losses = dict.fromkeys(("b", "cf"), LOSS)
        fit = partial(jl.fit, ARM, train, {**ARM_START, **fixed}, free=free, transforms=losses)
        found, cost = timed(name, model, partial(fit, **OPTIONS))
        figures += cost + estimates(name, model, found, DOCUMENTED, "documented")
        figures += errors(name, model, "rms of training, 1 s", found.rms("q"))
        figures += errors(name, model, "rms of test, 1 s", missed(found.predict(test), "q"))
    return Part(figures, [], [])


def arms(path: Path, design: str) -> Part:
    """Fit and test in windows of 0.5 s."""
    name = f"two driven arms, design {design}"
    folder = path / "dfki_double_pendulum"
    angles, torques = ("q1", "q2"), ("tau_meas1", "tau_meas2")

    def read(which: str) -> list[jl.Experiment]:
        files = [folder / f"design{run}.csv.gz" for run in DESIGNS[design][which]]
        return windows([recording(file, angles, torques, EVERY) for file in files], 0.5)

    train, test = read("train"), read("test")
    theirs = published(design)
    model = "viscous, Coulomb"
    losses = dict.fromkeys(("b", "cf", "Ir"), LOSS)
    fit = partial(jl.fit, ARMS, train, theirs, free=tuple(theirs), transforms=losses)
    found, figures = timed(name, model, partial(fit, **OPTIONS))
    flat = {x: y for x, y in theirs.items() if np.ndim(y) == 0}
    flat |= {f"{x}[{i}]": theirs[x][i] for x in ("b", "cf") for i in range(2)}
    figures += estimates(name, model, found, flat, "published")
    figures += errors(name, model, "rms of training, 0.5 s", found.rms("q"))
    own = missed(found.predict(test), "q")
    other = 1e3 * missed(jl.predict(ARMS, test, theirs, **OPTIONS), "q")
    figures += errors(name, model, "rms of test, 0.5 s", own, other, "published params")
    references = [Reference(name, f"unknown: {text}") for text in found.unidentifiable]
    return Part(figures, [], references)
