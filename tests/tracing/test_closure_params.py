"""Traced values in the closure of a declaration are treated like params."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._system import _closure_tracers

TS = jnp.array([0.0, 0.5, 1.0])


def swing(k):
    """End of a motion whose Lagrangian, force and input close over k."""
    drag = jl.GeneralizedForce(
        lambda t, q, v, params, inputs: (inputs["u"] - 0.1 * k) * v + inputs["w"] * params["one"],
        "drag",
    )
    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v - 0.5 * k * params["one"] * q @ q,
        ("x",),
        forces=(drag,),
    )
    inputs = {
        "u": jl.TimeFunction(lambda t: k * t),
        "w": jl.Feedback(lambda t, q, v, params: -k * params["one"] * q),
    }
    motion = jl.simulate(system, [1.0], [0.0], TS, {"one": 1.0}, inputs=inputs)
    assert set(motion.params) == {"one"}
    return motion.q[-1, 0] + motion.energy[-1]


def by_params(k):
    drag = jl.GeneralizedForce(lambda t, q, v, params: params["k"] * ((t - 0.1) * v - q), "drag")
    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v - 0.5 * params["k"] * q @ q, ("x",), forces=(drag,)
    )
    motion = jl.simulate(system, [1.0], [0.0], TS, {"k": k})
    return motion.q[-1, 0] + motion.energy[-1]


TRANSFORMS = {
    "jit": jax.jit,
    "vmap": lambda f: lambda k: jax.vmap(f)(k * jnp.arange(1.0, 3.0)),
    "grad": jax.grad,
    "jit of grad": lambda f: jax.jit(jax.grad(f)),
    "grad of jit": lambda f: jax.grad(jax.jit(f)),
    "jvp": lambda f: lambda k: jax.jvp(f, (k,), (1.0,))[1],
}


@pytest.mark.full
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_traced_closure_values_act_like_params(transform):
    by_closure, expected = (TRANSFORMS[transform](f)(2.0) for f in (swing, by_params))
    np.testing.assert_allclose(by_closure, expected, rtol=1e-9)


def test_equilibrium_has_derivatives_by_closure_values():
    def rest(k):
        system = jl.System(lambda t, q, v, p: 0.5 * v @ v - 0.5 * k * (q[0] - k) ** 2, ("x",))
        return jl.equilibrium(system, [0.1], {}).q[0]

    np.testing.assert_allclose(jax.grad(rest)(2.0), 1.0, rtol=1e-9)


def test_assembled_states_have_derivatives_by_closure_values():
    def height(length):
        rod = jl.Holonomic(lambda t, q, params: q @ q - length**2, "rod")
        system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), constraints=(rod,))
        return jl.assemble(system, [0.6, 0.8], [0.0, 0.0], {}).q[1]

    np.testing.assert_allclose(jax.grad(height)(1.0), 0.8, rtol=1e-9)


def test_inverse_dynamics_has_derivatives_by_closure_values():
    def force(m):
        system = jl.System(lambda t, q, v, p: 0.5 * m * v @ v, ("x",))
        return jl.inverse_dynamics(system, [0.0], [0.0], [3.0], {})[0]

    np.testing.assert_allclose(jax.jit(jax.grad(force))(2.0), 3.0, rtol=1e-12)


def test_traced_values_of_inputs_are_not_closure_values():
    """Table values stay inputs: their derivatives are written only where a step reads them."""
    force = jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["u"] * v, "push")
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v, ("x",), forces=(force,))

    def check(times, values):
        inputs = {"u": jl.LinearInterpolation(times, values)}
        assert _closure_tracers.lift_closure_tracers(system, {}, jnp.zeros(1), inputs) == {}
        return jl.simulate(system, [0.0], [1.0], TS, {}, inputs=inputs).q[-1, 0]

    jax.make_jaxpr(jax.grad(check, (0, 1)))(jnp.array([0.0, 2.0]), jnp.array([1.0, 3.0]))


@pytest.mark.parametrize("formulation", ["multipliers", "quasi"])
def test_closures_need_no_second_trace(monkeypatch, formulation):
    """Not even for a declared function that the motion does not use."""
    quasi = jl.QuasiVelocities(lambda t, q, v, params: 2.0 * v, ("u",))
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v, ("x",), quasi=quasi)
    run = partial(jl.simulate, system, [0.0], [1.0], TS, {}, formulation=formulation)
    run()
    monkeypatch.setattr(_closure_tracers, "_consts", None)
    run()


def test_closure_value_that_becomes_traced_later_is_named():
    k = 2.0
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v - 0.5 * k * q @ q, ("x",))

    def end(x):
        nonlocal k
        k = x
        return jl.simulate(system, [1.0], [0.0], TS, {}).q[-1, 0]

    end(2.0)
    with pytest.warns(UserWarning, match="^k, which .* was 2.0 .* and is a traced value now"):
        assert jax.grad(end)(3.0) == 0.0


def test_a_driven_system_is_assembled_without_its_inputs():
    rod = jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod")
    push = jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["u"] * q, "push")
    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), forces=(push,), constraints=(rod,)
    )
    np.testing.assert_allclose(jl.assemble(system, [1.2, 1.6], [0.0, 0.0], {}).q, [0.6, 0.8])


def test_reverse_derivatives_do_not_trace_again():
    """The closure values belong to a transform that has ended by then."""
    traced = []

    def end(k):
        def lagrangian(t, q, v, params):
            traced.append("lagrangian")
            return 0.5 * v @ v - 0.5 * k * q @ q

        def ramp(t):
            traced.append("ramp")
            return k * t

        drag = jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["u"] * v, "drag")
        system = jl.System(lagrangian, ("x",), forces=(drag,))
        return jl.simulate(system, [1.0], [0.0], TS, {}, inputs={"u": jl.TimeFunction(ramp)}).q[
            -1, 0
        ]

    _, vjp_fn = jax.vjp(end, 2.0)
    # Once to find the closure values, once for the motion.
    assert sorted(traced) == ["lagrangian"] * 2 + ["ramp"] * 2
    vjp_fn(1.0)
    assert len(traced) == 4
