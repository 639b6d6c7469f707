"""Functions of named coordinates equal those of flat vectors."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

NAMES = {"r": 2, "theta": ()}


@jl.named(NAMES)
def lagrangian(t, q, v, params):
    T = 0.5 * params["m"] * (v["r"] @ v["r"]) + 0.5 * params["I"] * v["theta"] ** 2
    return T + params["I"] * jnp.cos(q["theta"]) - params["m"] * q["r"][1]


def flat(t, q, v, params):
    T = 0.5 * params["m"] * (v[:2] @ v[:2]) + 0.5 * params["I"] * v[2] ** 2
    return T + params["I"] * jnp.cos(q[2]) - params["m"] * q[1]


@jl.named(NAMES)
def drag(t, q, v, params, inputs):
    return {"theta": -inputs["c"] * v["theta"]}


@jl.named(NAMES)
def rod(t, q, params):
    return q["r"] @ q["r"] - 1.0


@jl.named(NAMES)
def speeds(t, q, v, params):
    x, y = q["r"]
    return jnp.stack([x * v["r"][1] - y * v["r"][0], v["theta"], q["r"] @ v["r"]])


PARAMS = {"m": 2.0, "I": 0.5}


@pytest.mark.full
def test_every_declared_function_accepts_names():
    """Lagrangian, force with inputs, constraint and quasi-velocities, by names and flat."""
    by_name = jl.System(
        lagrangian,
        NAMES,
        forces=(jl.GeneralizedForce(drag, "drag"),),
        constraints=(jl.Holonomic(rod, "rod"),),
        quasi=jl.QuasiVelocities(speeds, ("turn", "spin", "out")),
    )
    plain = jl.System(
        flat,
        NAMES,
        forces=(
            jl.GeneralizedForce(
                lambda t, q, v, p, inputs: jnp.stack([0.0 * v[0], 0.0 * v[0], -inputs["c"] * v[2]]),
                "drag",
            ),
        ),
        constraints=(jl.Holonomic(lambda t, q, p: q[:2] @ q[:2] - 1.0, "rod"),),
    )
    start = [0.6, -0.8, 0.3], [0.8, 0.6, -0.2], [0.0, 0.5], PARAMS
    options = {"inputs": {"c": 0.3}, "dt": 0.1, "method": "tsit5", "formulation": "multipliers"}
    one, other = (jl.simulate(system, *start, **options) for system in (by_name, plain))
    np.testing.assert_allclose(one.q, other.q, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one["out"], 0.0, atol=1e-14)


def test_named_functions_are_equal_for_equal_names():
    """Systems of equal functions compile once."""
    assert jl.named(NAMES)(flat) == jl.named(NAMES)(flat)
    assert hash(jl.named(NAMES)(flat)) == hash(jl.named(NAMES)(flat))
    assert jl.named(("x", "y", "z"))(flat) != jl.named(NAMES)(flat)


def test_a_dict_of_other_names_is_refused():
    force = jl.GeneralizedForce(jl.named(NAMES)(lambda t, q, v, p: {"phi": 1.0}), "push")
    system = jl.System(lagrangian, NAMES, forces=(force,))
    with pytest.raises(ValueError, match=r"the returned dict must name exactly .*'phi'"):
        system.acceleration([0.0] * 3, [0.0] * 3, PARAMS)
    with pytest.raises(ValueError, match="`coordinates` must have at least one name"):
        jl.named({})
