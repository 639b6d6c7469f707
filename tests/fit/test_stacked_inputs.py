"""Inputs of experiments in one batch: each lane is the signal of its experiment."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxlag as jl
from jaxlag._fit._stacked_inputs import stacked
from jaxlag._model._inputs import evaluate

TS = np.linspace(0.0, 1.0, 6)
PUSH = jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["u"] * jnp.ones(1), "push")
SYSTEM = jl.System(lambda t, q, v, params: 0.5 * params["m"] * v @ v, ("x",), forces=(PUSH,))


class Wave(eqx.Module):
    rate: jax.Array

    def __call__(self, t):
        return jnp.sin(self.rate * t)


def ramp(t):
    return 1.0 + t


def scaled(t, params):
    return params["m"] * t


def held_back(t, q, v, params):
    return 1.0 - q[0]


def jump(t):
    return jnp.where(t < 0.5, 1.0, -1.0)


def two_jumps(t):
    return jnp.where(t < 0.3, 1.0, jnp.where(t < 0.6, 0.0, -2.0))


WAVES = [jl.TimeFunction(Wave(jnp.array(rate))) for rate in (3.0, 5.0)]
TABLES = [
    jl.LinearInterpolation([0.0, 1.0], [0.0, 1.0]),
    jl.LinearInterpolation([0.0, 0.4, 1.0], [1.0, 2.0, 0.0]),
]
JUMPS = [jl.TimeFunction(jump, knots=[0.5]), jl.TimeFunction(two_jumps, knots=[0.3, 0.6])]
ALIKE = {
    "functions": [jl.TimeFunction(ramp), jl.TimeFunction(jnp.sin)],
    "modules of one class": WAVES,
    "functions, modules and constants": [
        *(jl.TimeFunction(ramp), *WAVES, jl.TimeFunction(scaled)),
        *(jnp.array(2.0), jnp.array(3.0)),
    ],
    "feedback": [jl.Feedback(held_back), jl.TimeFunction(ramp), jnp.array(2.0)],
    "tables": TABLES,
    "knots": [*JUMPS, jl.TimeFunction(ramp), jnp.array(2.0)],
}


@pytest.mark.parametrize("name", ALIKE)
def test_every_lane_is_the_signal_of_its_experiment(name):
    signals = ALIKE[name]
    batch = stacked([{"u": signal} for signal in signals], [1.0] * len(signals))
    t, q, v, params = jnp.array(0.45), jnp.array([0.2]), jnp.array([0.1]), {"m": 1.5}

    def values(inputs):
        return evaluate(inputs, t, q, v, params)["u"]

    found = jax.vmap(lambda lane: values(lane.at({"m": 1.5}, jnp.asarray(TS))))(batch)
    expected = [values({"u": signal}) for signal in signals]
    np.testing.assert_allclose(found, expected, rtol=1e-15)


def test_missing_knots_lie_beyond_the_end():
    signals = ALIKE["knots"]
    batch = stacked([{"u": signal} for signal in signals], [1.0, 1.0, 2.0, 3.0])
    knots = batch.at({"m": 1.5}, jnp.asarray(TS))["u"].ends[:, 1:-1]
    np.testing.assert_array_equal(knots, [[0.5, 2.0], [0.3, 0.6], [3.0, 4.0], [4.0, 5.0]])


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (
            [{"u": jl.TimeFunction(ramp)}, {"u": TABLES[0]}],
            r"\['u'\]` must be tables .* LinearInterpolation and TimeF",
        ),
        (
            [{"u": TABLES[0]}, {"u": jl.ZeroOrderHold(TS, TS)}],
            r"LinearInterpolation and ZeroOrderHold",
        ),
        ([{"u": JUMPS[0]}, {"u": jl.Feedback(held_back)}], r"\['u'\]` must have no knots"),
        ([{"u": TABLES[0]}, {}], r"names of the inputs must be the same .* \['u'\] or \[\]"),
    ],
)
def test_inputs_that_cannot_be_stacked_are_named(inputs, message):
    with pytest.raises(ValueError, match=message):
        stacked(inputs, [1.0, 1.0])


def test_shapes_that_differ_are_named():
    lane = stacked([{"u": jl.TimeFunction(ramp)}, {"u": jnp.ones(2)}], [1.0, 1.0])
    one = jax.tree.map(lambda x: x[0], lane).at({"m": 1.5}, jnp.asarray(TS))
    with pytest.raises(ValueError, match=r"inputs\['u'\]` .* one shape .* had \[\(\), \(2,\)\]"):
        evaluate(one, jnp.array(0.5), jnp.ones(1), jnp.ones(1), {})


def recorded(signal):
    """x of mass 2, from rest at 0.1."""
    inputs = {"u": signal}
    motion = jl.simulate(SYSTEM, [0.1], [0.0], TS, {"m": 2.0}, inputs=inputs)
    start = {"q0": [0.1], "v0": [0.0], "start_sigma": 0.0}
    return jl.Experiment(TS, {"x": motion["x"]}, inputs=inputs, sigma={"x": 1e-3}, **start)


@pytest.mark.full
def test_experiments_with_separate_functions_are_fitted():
    records = [recorded(x) for x in (*JUMPS, jl.TimeFunction(ramp))]
    found = jl.fit(SYSTEM, records, {"m": 1.0}, free=("m",))
    np.testing.assert_allclose(found.params["m"], 2.0, rtol=1e-8)


@pytest.mark.full
def test_predictions_and_descents_accept_feedback():
    records = [recorded(x) for x in (jl.Feedback(held_back), jl.TimeFunction(jnp.sin))]
    np.testing.assert_allclose(jl.predict(SYSTEM, records, {"m": 2.0}).rms("x"), 0.0, atol=1e-8)
    descent = jl.Descent(optax.sgd(1e-6), epochs=2)
    with pytest.warns(UserWarning, match="take more epochs"):
        found = jl.fit(SYSTEM, records, {"m": 2.1}, free=("m",), optimizer=descent)
    assert 2.0 < found.params["m"] < 2.1
    assert found.costs[1] < found.costs[0]
