"""A system in use: forms of coordinates and params, transforms, precision, equality."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.mechanics import GENERAL

import jaxlag as jl
from systems.catalogue import ENTRIES

K = 32  # roundings of the summands
EPS = np.finfo(float).eps


# ---- Forms of coordinates and params ---------------------------------------------------------


def springs(t, q, v, params):
    """Three bodies in the plane, each on a spring from a separate anchor, and a wheel theta."""
    at, rate = NET.unflatten(q), NET.unflatten(v)
    m, k = params["m"], params["k"]
    T = 0.5 * jnp.sum(m[:, None] * rate["x"] ** 2) + 0.5 * params["J"] * rate["theta"] ** 2
    return T - 0.5 * jnp.sum(k[:, None] * at["x"] ** 2) - params["J"] * at["theta"]


NET = jl.System(springs, {"x": (3, 2), "theta": ()})


def test_coordinates_may_be_arrays():
    m, k = np.array([1.0, 2.0, 3.0]), np.array([4.0, 10.0, 18.0])
    params = {"m": m, "k": k, "J": 0.5}
    x, v = np.arange(6.0).reshape(3, 2) / 4, np.ones((3, 2))
    q, rate = {"x": x, "theta": 0.3}, {"x": v, "theta": 0.1}

    @jax.jit
    def both(q, rate, flat_q, flat_rate):
        named = NET.acceleration(q, rate, params)
        return named, NET.acceleration(flat_q, flat_rate, params), NET.mass_matrix(q, params=params)

    named, flat, M = both(q, rate, NET.flatten(q), NET.flatten(rate))
    np.testing.assert_array_equal(named, flat)
    a = NET.unflatten(named)
    np.testing.assert_allclose(a["x"], -(k / m)[:, None] * x, rtol=K * EPS)
    np.testing.assert_allclose(a["theta"], -1.0, rtol=K * EPS)
    np.testing.assert_array_equal(M, np.diag([1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 0.5]))


class Spring(eqx.Module):
    stiffness: jax.Array
    law: object = eqx.field(static=True)

    def __call__(self, x):
        return self.stiffness * self.law(x)


def test_params_may_be_a_module():
    def lagrangian(t, q, v, params):
        spring, m = params
        return 0.5 * m * v[0] ** 2 - spring(q[0])

    system = jl.System(lagrangian, ("x",))
    params = (Spring(jnp.array(3.0), lambda x: x**4 / 4), 2.0)
    q, v = jnp.array([2.0]), jnp.zeros(1)
    a, slope = jax.jit(jax.value_and_grad(lambda p: system.acceleration(q, v, p)[0]))(params)
    np.testing.assert_allclose(a, -3 * 8 / 2, rtol=K * EPS)
    np.testing.assert_allclose(slope[0].stiffness, -8 / 2, rtol=K * EPS)
    np.testing.assert_allclose(slope[1], 3 * 8 / 2**2, rtol=K * EPS)


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        ({"power": 2}, -6.0),
        ({"power": 4}, -108.0),
        ({"law": "cubic"}, -27.0),
        ({"law": lambda x: x**2 + x}, -7.0),
        ({"exponents": (1, 3)}, -28.0),
        ({"exponents": [2, 2]}, -12.0),
        ({"power": 2, "law": None, "exact": True}, -6.0),
    ],
)
def test_params_may_hold_other_values_than_real_numbers(extra, expected):
    """Integers, lists of them, strings, functions, None: Python receives them unchanged."""

    def potential(t, q, params):
        x, law = q[0], params.get("law")
        if law == "cubic":
            return x**3
        if callable(law):
            return law(x)
        return sum(x ** int(n) for n in params.get("exponents", [params.get("power")]))

    def kinetic(t, q, v, params):
        return 0.5 * params["m"] * v[0] ** 2

    system = jl.System(coordinates=("x",), kinetic=kinetic, potential=potential)
    params = {"m": 1.0} | extra
    a = jax.jit(lambda q: system.acceleration(q, jnp.zeros(1), params))(jnp.array([3.0]))
    np.testing.assert_allclose(a, [expected], rtol=K * EPS)


def test_params_may_be_none():
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v - q[0], ("x", "y"))
    a = jax.jit(system.acceleration)(jnp.zeros(2), jnp.ones(2), None)
    np.testing.assert_array_equal(a, [-1.0, 0.0])


# ---- Use ---------------------------------------------------------------------------------------


def test_methods_work_under_every_transform():
    """d(theta'')/dg = -sin(theta)/l and its derivative by theta, batched and compiled."""
    entry = ENTRIES["simple_pendulum"]
    params = dict(entry.example.params)

    def acceleration(g, theta):
        return entry.system.acceleration(theta[None], jnp.zeros(1), params | {"g": g})[0]

    theta = jnp.linspace(-2.0, 2.0, 5)
    slope, mixed = jax.jit(jax.vmap(jax.jvp, in_axes=(None, 0, 0)), static_argnums=0)(
        lambda theta: jax.grad(acceleration)(9.0, theta), (theta,), (jnp.ones(5),)
    )
    np.testing.assert_allclose(slope, -jnp.sin(theta) / params["h1"], rtol=K * EPS)
    np.testing.assert_allclose(mixed, -jnp.cos(theta) / params["h1"], rtol=K * EPS)


def test_states_may_be_lists_arrays_or_named():
    entry = ENTRIES["two_mass_three_springs"]
    bias = partial(entry.system.bias, params=entry.example.params)
    expected = bias(jnp.array([3.0, 5.0]), jnp.array([1.0, -1.0]))
    for q in ([3.0, 5.0], (3, 5), np.array([3, 5]), {"x2": 5.0, "x1": 3}):
        np.testing.assert_array_equal(bias(q, [1.0, -1.0]), expected)
        np.testing.assert_array_equal(bias(q, {"x1": 1, "x2": -1}), expected)


def test_the_state_keeps_its_precision():
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v - q @ q, ("x",))
    q, v = jnp.ones(1, jnp.float32), jnp.zeros(1, jnp.float32)
    assert jax.eval_shape(system.mass_matrix, q).dtype == jnp.float32
    for method in (system.bias, system.acceleration, system.momentum, system.energy):
        assert jax.eval_shape(method, q, v).dtype == jnp.float32
        assert jax.eval_shape(lambda m=method: m([1], [0.0])).dtype == jnp.float64


def test_kinetic_and_potential_exist_only_if_declared():
    entry = ENTRIES["mass_spring"]
    params = {"m": 2.0, "k": 8.0}
    assert float(entry.system.kinetic([1.0], [3.0], params)) == 9.0
    assert float(entry.system.potential([0.5], params=params)) == 1.0
    assert float(entry.system.potential([0.5], [7.0], params)) == 1.0
    whole = jl.System(entry.system.lagrangian, ("x",))
    assert float(whole.energy([0.5], [3.0], params)) == 10.0
    for name in ("kinetic", "potential"):
        with pytest.raises(
            ValueError, match=rf"^`System\.{name}` of a Lagrangian alone is not supported: it is"
        ):
            getattr(whole, name)([0.5], [3.0], params)


def test_systems_of_the_same_functions_are_equal():
    L, Q = (lambda t, q, v, params: 0.5 * v @ v), (lambda t, q, v, params: q)

    def declare(**changes):
        parts = {"lagrangian": L, "coordinates": ("x",), "forces": (jl.GeneralizedForce(Q, "f"),)}
        return jl.System(**(parts | changes))

    assert declare() == declare()
    assert hash(declare()) == hash(declare())
    different = [
        declare(lagrangian=lambda t, q, v, params: 0.5 * v @ v),
        declare(coordinates=("y",)),
        declare(coordinates={"x": (1,)}),
        declare(forces=()),
        declare(forces=(jl.GeneralizedForce(Q, "g"),)),
        declare(forces=(jl.GeneralizedForce(lambda t, q, v, params: q, "f"),)),
        declare(forces=(jl.Rayleigh(Q, "f"),)),
    ]
    assert all(system != declare() for system in different)


def test_check_returns_none_for_valid_systems():
    case = GENERAL["bead"]
    assert case.system.check(case.q0, [0.1], case.params, t=0.3) is None
