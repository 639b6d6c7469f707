"""A pendulum with known parameters, and simulated measurements of it."""

import jax.numpy as jnp
import numpy as np

import jaxlag as jl

NOISE = 2e-3
TRUE = {"m": 1.0, "l": 0.7, "g": 9.81, "c": 0.05}
TS = np.linspace(0.0, 3.0, 151)
STEPS = {"method": "tsit5", "dt": 0.02}
OPTIONS = {"simulate_options": STEPS}


def tight(tolerance, **options):
    """Options of a motion with this tolerance."""
    return {"rtol": tolerance, "atol": tolerance} | options


def lagrangian(t, q, v, p):
    inertia = p["m"] * p["l"] ** 2
    return 0.5 * inertia * v[0] ** 2 + p["m"] * p["g"] * p["l"] * jnp.cos(q[0])


def drag(t, q, v, p):
    return 0.5 * p["c"] * v[0] ** 2


def motor(t, q, v, p, inputs):
    return inputs["torque"][None]


pendulum = jl.System(lagrangian, ("x",), forces=(jl.Rayleigh(drag, "air"),))
driven = jl.System(
    lagrangian, ("x",), forces=(jl.Rayleigh(drag, "air"), jl.GeneralizedForce(motor, "motor"))
)


def angles(ts=TS, q0=1.0, seed=0, noise=NOISE, **options):
    """Measured angles of the true pendulum; the simulation is far more accurate than they are."""
    system = driven if options else pendulum
    motion = jl.simulate(system, [q0], [0.0], ts, TRUE, rtol=1e-11, atol=1e-11, **options)
    return np.asarray(motion["x"]) + noise * np.random.default_rng(seed).normal(size=len(ts))


def experiment(**options):
    """One recording of the true pendulum."""
    return jl.Experiment(TS, {"x": angles()}, **options)


def fit(data, free=("l", "c"), params0=None, system=pendulum, **options):
    start = TRUE | {"l": 0.5, "c": 0.02} if params0 is None else params0
    return jl.fit(system, data, start, free=free, **(OPTIONS | options))


def within(found, names, deviations=3.5):
    """Estimates are within so many of their standard deviations of the truth."""
    for name in names:
        assert found.std[name] < 0.05 * TRUE[name]
        assert abs(found.params[name] - TRUE[name]) < deviations * found.std[name], name
