"""Digits and range of L as written that the scalar program must preserve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _lowered import lowered

import jaxlag as jl
from jaxlag._lowering._symbolic._evaluate import evaluate

EPS = np.finfo(float).eps


def at(system, params, q, v):
    """The acceleration by the graph of the scalar program, in double precision."""
    equations = lowered(system, params).equations
    assert equations is not None
    leaves = [np.ravel(x) for x in jax.tree.leaves(params)]
    flat = np.concatenate(leaves) if leaves else []
    values = {("t", 0): 0.0, ("sense", 0): 1.0}
    values |= {("params", i): float(x) for i, x in enumerate(flat)}
    values |= {("q", i): x for i, x in enumerate(q)} | {("v", i): x for i, x in enumerate(v)}
    return np.array([float(x) for x in evaluate(equations.accelerations, values)])


@pytest.mark.parametrize("a", [1e4, 1e6, 1e8])
def test_differences_of_coordinates_and_params_keep_their_digits(a):
    """Expanded, (q - a)^4 + (q - b)^4 loses all digits; the numbers here are exact."""
    L = lambda t, q, v, p: 0.5 * v @ v - (q[0] - p["a"]) ** 4 - (q[0] - p["b"]) ** 4  # noqa: E731
    found = at(jl.System(L, ("x",)), {"a": a, "b": a + 0.25}, [a + 0.5], [0.0])
    np.testing.assert_allclose(found, [-4.0 * (0.5**3 + 0.25**3)], rtol=16 * EPS)
    L = lambda t, q, v, p: 0.5 * v @ v - p["k"] * ((q[0] - q[1]) ** 2 - p["l"]) ** 2  # noqa: E731
    found = at(jl.System(L, ("x", "y")), {"k": 3.0, "l": 0.5}, [a, a + 1.0], [0.0, 0.0])
    np.testing.assert_allclose(found, [6.0, -6.0], rtol=16 * EPS)
    L = lambda t, q, v, p: (1.0 + (q[0] - p) ** 2) * (0.5 * v @ v) - (q[0] - p) ** 2  # noqa: E731
    found = at(jl.System(L, ("x",)), a, [a + 0.5], [2.0])
    # (1 + x^2) x'' + x x'^2 = -2 x at x = 1/2, x' = 2
    np.testing.assert_allclose(found, [-3.0 / 1.25], rtol=16 * EPS)


@pytest.mark.full
@pytest.mark.parametrize("theta", [1.0, 1e-2, 1e-4, 1e-6])
def test_squares_of_small_sines_keep_their_digits(theta):
    """A bead on r = R sin(theta)^2 that rotates about the axis, by its position: M ~ sin^6.

    L = (R^2/2) [(4 c^2 s^2 + s^4) theta'^2 + s^6 phi'^2]: phi'' = -6 c/s theta' phi'.
    """

    def lagrangian(t, q, v, p):
        def position(q):
            s, c = jnp.sin(q[0]), jnp.cos(q[0])
            return s**2 * jnp.stack([s * jnp.cos(q[1]), s * jnp.sin(q[1]), c])

        velocity = jax.jvp(position, (q,), (v,))[1]
        return 0.5 * p * velocity @ velocity

    found = at(jl.System(lagrangian, ("theta", "phi")), 2.0, [theta, 0.3], [0.1 * theta, 0.5])
    expected = -6.0 / np.tan(theta) * 0.1 * theta * 0.5
    np.testing.assert_allclose(found[1], expected, rtol=100 * EPS)


def test_sin2_plus_cos2_is_one():
    def lagrangian(t, q, v, p):
        r, s, c = q[0], jnp.sin(q[1]), jnp.cos(q[1])
        velocity = jnp.stack([v[0] * s + r * c * v[1], v[0] * c - r * s * v[1]])
        return 0.5 * velocity @ velocity + 1.0 / jnp.sqrt((r * s) ** 2 + (r * c) ** 2)

    program = lowered(jl.System(lagrangian, ("r", "angle"))).equations.program
    assert program.count("sin", "cos") == 0


def test_powers_of_quotients_stay_in_range():
    """(q / a)^32, where a^32 overflows."""
    for params, L in (
        (None, lambda t, q, v, p: 0.5 * v @ v - 2e10 * (q[0] / 2e10) ** 32),
        (2e10, lambda t, q, v, p: 0.5 * v @ v - p * (q[0] / p) ** 32),
    ):
        system = jl.System(L, ("x",))
        a = system.acceleration([1.9e10], [0.0], params)
        np.testing.assert_allclose(a, [-32.0 * 0.95**31], rtol=100 * EPS)


def attraction(t, q, v, p):
    return 0.5 * p["m"] * v @ v + p["k"] * p["m"] / jnp.sqrt(q @ q)


def lennard_jones(t, q, v, p):
    x = p["s"] / jnp.sqrt((q[0] - q[2]) ** 2 + (q[1] - q[3]) ** 2)
    return 0.5 * p["m"] * v @ v - 4.0 * p["e"] * (x**12 - x**6)


def double_pendulum(t, q, v, p):
    m1, m2, l1, l2 = p["m1"], p["m2"], p["l1"], p["l2"]
    T = 0.5 * (m1 + m2) * (l1 * v[0]) ** 2 + 0.5 * m2 * (l2 * v[1]) ** 2
    T = T + m2 * l1 * l2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return T + p["g"] * ((m1 + m2) * l1 * jnp.cos(q[0]) + m2 * l2 * jnp.cos(q[1]))


def pendula(size):
    masses = {"m1": size**2.4, "m2": 2.0 * size**2.4}
    return {**masses, "l1": size, "l2": 2.0 * size, "g": 9.8}


IN_SI_UNITS = {
    "two argon atoms": (
        lennard_jones,
        [0.0, 0.0, 3.8e-10, 1e-11],
        [0.0] * 4,
        {"s": 3.4e-10, "e": 1.65e-21, "m": 6.6e-26},
    ),
    "a satellite": (attraction, [7e6, 1e5], [10.0, 7500.0], {"k": 3.986e14, "m": 1e3}),
    "small pendula": (double_pendulum, [0.3, 0.5], [1e3, 2e3], pendula(1e-5)),
    "large pendula": (double_pendulum, [0.3, 0.5], [1e-3, 2e-3], pendula(1e5)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", IN_SI_UNITS)
def test_single_precision_suffices_for_si_units(name):
    """Accelerations and their Jacobian against double precision; products would overflow."""
    lagrangian, q, v, params = IN_SI_UNITS[name]
    system = jl.System(lagrangian, {"x": (len(q),)})

    def both(dtype):
        q_, v_ = jnp.asarray(q, dtype), jnp.asarray(v, dtype)
        p = {key: jnp.asarray(x, dtype) for key, x in params.items()}
        f = lambda q: system.acceleration(q, v_, p, t=jnp.zeros((), dtype))  # noqa: E731
        return jax.jit(lambda q: (f(q), jax.jacfwd(f)(q)))(q_)

    program = system._program
    like = {key: jnp.asarray(x, jnp.float32) for key, x in params.items()}
    found = program.lowered(jnp.asarray(q, jnp.float32), like, {})
    assert found.equations is not None, found.reason
    eps = float(jnp.finfo(jnp.float32).eps)
    for single, double in zip(both(jnp.float32), both(jnp.float64), strict=True):
        # Differences of 1e-10 m have few roundings; powers are up to the 14th.
        atol = 200 * eps * float(jnp.max(jnp.abs(double)))
        np.testing.assert_allclose(np.asarray(single, float), double, rtol=0, atol=atol)
