"""Motions in closed form: the equations hold along them; solvers and derivatives agree."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _closed_forms import TIGHT, close, close_to_exact
from _families import mostly_full

import jaxlag as jl
from jaxlag._simulation._methods import METHODS
from systems.catalogue import ENTRIES

EXACT = [name for name, entry in ENTRIES.items() if getattr(entry, "exact", None) is not None]
TIED = {"atwood_multipliers": {"R"}, "vertical_rolling_disk": {"R"}}
"""Parameters that a constraint couples to the rates of the start."""


def example(name):
    """(entry, params, q0, v0)."""
    entry = ENTRIES[name]
    params = {key: jnp.asarray(value, float) for key, value in entry.example.params.items()}
    return entry, params, *(jnp.asarray(x, float) for x in entry.start())


@pytest.mark.parametrize(
    "name", mostly_full(EXACT, "simple_pendulum", "mass_spring_dashpot", "knife_edge_incline")
)
def test_the_equations_hold_along_the_exact_motion(name):
    entry, params, q0, v0 = example(name)

    @jax.jit
    @jax.vmap
    def sides(t):
        rates = jax.jvp(lambda t: entry.exact(t, q0, v0, params), (t,), (jnp.ones_like(t),))
        (q, v), (q_rate, v_rate) = rates
        return q, v, q_rate, v_rate, entry.system.acceleration(q, v, params, t=t)

    q, v, q_rate, v_rate, a = sides(jnp.linspace(0.0, entry.example.duration, 7))
    close(q[0], q0, 1e-14)
    close(v[0], v0, 1e-14)
    close(q_rate, v, 1e-13)
    close(v_rate, a, 1e-13)  # largest error: 3e-14, of the mass with spring and dashpot


@pytest.mark.parametrize("name", mostly_full(EXACT, "simple_pendulum"))
def test_motion_agrees_with_the_exact_one(name):
    entry, params, q0, v0 = example(name)
    times = np.linspace(0.0, entry.example.duration, 7)
    motion = jl.simulate(entry.system, q0, v0, times, params, **TIGHT)
    close_to_exact(name, motion, params)


def steps(method):
    """(options of `method`, allowed error of the pendulum after 2 s)."""
    solver = METHODS[method]()
    order = solver.order(None)
    if order <= 2:
        return {"dt": 2e-4, "max_steps": 10_000}, {1: 1e-2, 2: 1e-5}[order]
    if isinstance(solver, diffrax.AbstractAdaptiveSolver):
        return {"rtol": 1e-9, "atol": 1e-9}, 1e-6
    return {"dt": 0.01}, 1e-6


@pytest.mark.full
@pytest.mark.parametrize("method", METHODS)
def test_every_method_follows_the_exact_pendulum(method):
    entry, params, q0, v0 = example("simple_pendulum")
    times = np.linspace(0.0, 2.0, 5)
    options, bound = steps(method)
    motion = jl.simulate(entry.system, q0, v0, times, params, method=method, **options)
    close_to_exact("simple_pendulum", motion, params, bound)


def ends(name, **options):
    """(end, exact end, inputs): (q, v) at the end, by params and the start if it is free."""
    entry, params, q0, v0 = example(name)
    t1 = jnp.array(entry.example.duration)
    x = {"params": {key: p for key, p in params.items() if key not in TIED.get(name, ())}}
    if not entry.constraints:
        x |= {"q0": q0, "v0": v0}

    def arguments(x):
        return x.get("q0", q0), x.get("v0", v0), params | x["params"]

    def end(x):
        q0, v0, params = arguments(x)
        motion = jl.simulate(entry.system, q0, v0, [0.0, t1], params, **(TIGHT | options))
        return jnp.concatenate([motion.q[-1], motion.v[-1]])

    def exact(x):
        return jnp.concatenate(entry.exact(t1, *arguments(x)))

    return end, exact, x


def flat(tree):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


@pytest.mark.full
@pytest.mark.parametrize("derivative", mostly_full((jax.jacrev, jax.jacfwd), jax.jacrev))
@pytest.mark.parametrize("name", mostly_full(EXACT, "simple_pendulum"))
def test_gradients_equal_those_of_the_exact_motion(name, derivative):
    end, exact, x = ends(name)
    close(flat(jax.jit(derivative(end))(x)), flat(jax.jit(jax.jacfwd(exact))(x)), 1e-9)


@pytest.mark.full
@pytest.mark.parametrize("mode", ["recorded", "checkpoints", "forward"])
def test_gradients_of_every_mode_equal_the_exact_ones(mode):
    """Damped and driven, so that params also enter the forces."""
    end, exact, x = ends("disk_on_moving_cart", gradient=mode)
    close(flat(jax.jit(jax.jacrev(end))(x)), flat(jax.jit(jax.jacfwd(exact))(x)), 1e-9)


@pytest.mark.full
def test_second_derivatives_equal_those_of_the_exact_motion():
    end, exact, x = ends("simple_pendulum")
    found = jax.jit(jax.jacfwd(jax.jacrev(end)))(x)
    close(flat(found), flat(jax.jit(jax.jacfwd(jax.jacfwd(exact)))(x)), 1e-8)
