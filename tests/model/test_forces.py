"""Applied forces: signatures, Rayleigh functions, names, and declarations that are refused."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _user import unchecked  # noqa: F401

import jaxlag as jl

EPS = np.finfo(float).eps
Q, V, T = jnp.array([0.4, -0.7]), jnp.array([1.5, -2.0]), jnp.array(0.3)
PARAMS = {"c": 0.8}


def free(t, q, v, params):
    return 0.5 * v @ v


def spring(t, q, v, params):
    return -params["c"] * q + t


def motor(t, q, v, params, inputs):
    return inputs["torque"] * jnp.array([1.0, 0.0]) * params["c"]


def dissipation(t, q, v, params):
    return params["c"] * (1 + t) * (1 + q[0] ** 2) * jnp.sum(jnp.abs(v) ** 3) / 3


SPRING = jl.GeneralizedForce(spring, "spring")
MOTOR = jl.GeneralizedForce(motor, "motor")
DRAG = jl.Rayleigh(dissipation, "drag")
SYSTEM = jl.System(free, ("x", "y"), forces=(SPRING, MOTOR, DRAG))

PARTS = {
    "spring": -0.8 * np.array([0.4, -0.7]) + 0.3,
    "motor": np.array([5.0, 0.0]) * 0.8,
    "drag": -0.8 * 1.3 * (1 + 0.4**2) * np.array([1.5**2, -(2.0**2)]),
}


def test_inputs_are_an_optional_argument_of_forces():
    assert (SPRING.takes_inputs, MOTOR.takes_inputs) == (False, True)
    np.testing.assert_allclose(SPRING(T, Q, V, PARAMS, {}), PARTS["spring"], rtol=8 * EPS)
    found = MOTOR(T, Q, V, PARAMS, {"torque": 5.0})
    np.testing.assert_allclose(found, PARTS["motor"], rtol=8 * EPS)


def test_a_rayleigh_force_is_the_gradient_of_its_function():
    """Also for a function that is not quadratic: R = c (1 + t)(1 + x^2) sum |v|^3/3."""
    np.testing.assert_allclose(DRAG(T, Q, V, PARAMS, {}), PARTS["drag"], rtol=8 * EPS)
    assert jl.Rayleigh(dissipation, "rayleigh").name == "rayleigh"


def test_power_of_homogeneous_dissipation_is_k_times_its_function():
    """Euler: v . Q = -k R for R homogeneous of degree k in v; here 3."""
    R = dissipation(T, Q, V, PARAMS)
    np.testing.assert_allclose(V @ DRAG(T, Q, V, PARAMS, {}), -3 * R, rtol=8 * EPS)


@pytest.mark.parametrize(
    "names", [None, (), ("spring",), ["motor"], ("drag", "spring"), ("spring", "motor", "drag")]
)
def test_forces_add_up_by_name(names):
    inputs = {"torque": jnp.array(5.0)}
    force = jax.jit(lambda: SYSTEM.generalized_force(Q, V, PARAMS, t=T, inputs=inputs, names=names))
    expected = sum((PARTS[name] for name in (PARTS if names is None else names)), np.zeros(2))
    np.testing.assert_allclose(force(), expected, rtol=16 * EPS, atol=16 * EPS)


def test_forces_enter_the_acceleration():
    """M = 1: a = Q."""
    inputs = {"torque": jnp.array(5.0)}
    a = jax.jit(lambda: SYSTEM.acceleration(Q, V, PARAMS, t=T, inputs=inputs))()
    np.testing.assert_allclose(a, sum(PARTS.values()), rtol=16 * EPS)


def test_forces_of_the_same_function_and_name_are_equal():
    assert jl.GeneralizedForce(spring, "spring") == SPRING
    assert hash(jl.GeneralizedForce(spring, "spring")) == hash(SPRING)
    assert jl.GeneralizedForce(spring, "other") != SPRING
    assert jl.Rayleigh(dissipation, "spring") != SPRING


class Law:
    """A force law as a method."""

    def law(self, t, q, v, params, inputs):
        return inputs["gain"] * q


def scaled(factor, t, q, v, params):
    return factor * q


def test_signatures_of_methods_and_partials_exclude_bound_arguments():
    assert jl.GeneralizedForce(Law().law, "law").takes_inputs
    force = jl.GeneralizedForce(partial(scaled, 3.0), "scaled")
    assert not force.takes_inputs
    np.testing.assert_array_equal(force(T, Q, V, PARAMS, {}), 3.0 * Q)


# ---- Refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jl.GeneralizedForce(lambda t, q, v: q, "f"),
            "force 'f': `Q` must be callable as (t, q, v, params, inputs), but its signature was "
            "(t, q, v). Add or drop arguments",
        ),
        (
            lambda: jl.GeneralizedForce(lambda t, q, v, params, inputs, lam: q, "f"),
            "force 'f': `Q` must be callable as (t, q, v, params, inputs), but its signature was "
            "(t, q, v, params, inputs, lam).",
        ),
        (
            lambda: jl.Rayleigh(lambda t, q, v: 0.0, "r"),
            "Rayleigh 'r': `R` must be callable as (t, q, v, params), but its signature was",
        ),
        (
            lambda: jl.GeneralizedForce(spring, ""),
            "GeneralizedForce: `name` must be a non-empty string, but it was ''.",
        ),
        (
            lambda: jl.Rayleigh(dissipation, ""),
            "Rayleigh: `name` must be a non-empty string, but it was ''.",
        ),
        (
            lambda: jl.System(free, ("x",), forces=(SPRING, MOTOR, SPRING)),
            "`forces` must have distinct names, but 'spring' occurs 2 times.",
        ),
        (
            lambda: SYSTEM.generalized_force(Q, V, PARAMS, names=("sprin",)),
            "generalized_force: `names` must be among ['spring', 'motor', 'drag'], but one was "
            "'sprin'.",
        ),
    ],
)
def test_invalid_declaration_is_refused(make, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        make()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jl.GeneralizedForce(3.0, "f"),
            "force 'f': `Q` must be a function of (t, q, v, params",
        ),
        (
            lambda: jl.Rayleigh(None, "r"),
            "Rayleigh 'r': `R` must be a function of (t, q, v, params), but it was None.",
        ),
        (
            lambda: jl.GeneralizedForce(spring, 3),
            "GeneralizedForce: `name` must be a non-empty string, but it was 3.",
        ),
        (
            lambda: jl.System(free, ("x",), forces=SPRING),
            "`forces` must be a sequence, but it was a single force. Write forces=(force,).",
        ),
        (
            lambda: jl.System(free, ("x",), forces=(spring,)),
            "`forces` must contain PointForce, Torque, GeneralizedForce and Rayleigh objects, but",
        ),
    ],
)
def test_invalid_type_is_refused(make, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        make()


def pushed_by(force):
    """A system of two coordinates under a force."""
    return jl.System(free, ("x", "y"), forces=(jl.GeneralizedForce(force, "push"),))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("force", "was"),
    [
        (lambda t, q, v, params: jnp.ones(3), "float64 of shape (3,)"),
        (lambda t, q, v, params: q[0], "float64 of shape ()"),
        (lambda t, q, v, params: q[:1], "float64 of shape (1,)"),
        (lambda t, q, v, params: jnp.zeros(2, int), "int64 of shape (2,)"),
        (lambda t, q, v, params: jax.lax.complex(q, q), "complex128 of shape (2,)"),
    ],
)
@pytest.mark.parametrize("ask", ["check", "acceleration", "generalized_force", "simulate"])
def test_a_force_must_have_one_real_component_per_coordinate(force, was, ask):
    system = pushed_by(force)
    must = "force 'push' must return 2 real components, one per coordinate, but it returned "
    asked = {
        "check": system.check,
        "acceleration": system.acceleration,
        "generalized_force": system.generalized_force,
        "simulate": lambda q, v: jl.simulate(system, q, v, [0.0, 1.0], method="euler", dt=0.5),
    }
    with pytest.raises(ValueError, match="^" + re.escape(must + was)):
        asked[ask](Q, V)


@pytest.mark.usefixtures("unchecked")
def test_a_force_must_return_an_array():
    system = pushed_by(lambda t, q, v, params: [q[0], q[1]])
    with pytest.raises(ValueError, match=r"^force 'push' must return an array, but it returned \["):
        system.check(Q, V)


@pytest.mark.usefixtures("unchecked")
def test_a_rayleigh_function_must_be_a_real_scalar():
    system = jl.System(free, ("x", "y"), forces=(jl.Rayleigh(lambda t, q, v, params: v**2, "r"),))
    with pytest.raises(ValueError, match=r"^Rayleigh 'r': `R` must return a real scalar, but "):
        system.check(Q, V)
