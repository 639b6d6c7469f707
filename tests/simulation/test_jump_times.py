"""Jumps at times given by params: derivatives miss them, which is reported, except at knots.

Kinks are not reported: derivatives by interpolated tables and ramps are right.
"""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._simulation._jump_times import Jumps

TS = jnp.linspace(0.0, 3.0, 4)
TIMES, VALUES = jnp.linspace(0.0, 5.0, 21), jnp.sin(3 * jnp.linspace(0.0, 5.0, 21))
Q0 = jnp.array([0.3])
PARAMS = {"b": 1.0, "k": 2.0}


def spring(t, q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2


def pushed(law):
    return jl.System(spring, ("x",), forces=(push(law),))


def push(law):
    return jl.GeneralizedForce(lambda t, q, v, params: law(t, q[0], params["b"])[None], "push")


JUMPING = {
    "where": lambda t, x, b: jnp.where(t <= b, 1.0, 0.0),
    "a number of truth": lambda t, x, b: 2.0 * (t <= b).astype(float),
    "cond": lambda t, x, b: jax.lax.cond(t < b, lambda: 1.0, lambda: x),
    "a delayed table that holds": lambda t, x, b: VALUES[jnp.searchsorted(TIMES, t - b)],
    "sign": lambda t, x, b: jnp.sign(jnp.sin(5 * t - b)),
    "floor": lambda t, x, b: jnp.floor((t - b) * 3) % 2,
    "modulo": lambda t, x, b: jnp.mod(t, b),
    "within a loop": lambda t, x, b: jax.lax.fori_loop(
        0, 3, lambda i, c: c + jnp.where(t < b * i, 1.0, 0.0), 0.0
    ),
    "a loop that may not end": lambda t, x, b: jax.lax.while_loop(
        lambda e: jnp.abs(e - 0.3 * b * jnp.sin(e) - t) > 1e-12,
        lambda e: e - (e - 0.3 * b * jnp.sin(e) - t) / (1 - 0.3 * b * jnp.cos(e)),
        t,
    ),
    "heaviside": lambda t, x, b: jnp.heaviside(t - b, 0.0),
    "under jit": lambda t, x, b: jax.jit(lambda t: jnp.where(b < t, 1.0, 0.0))(t),
    "vmapped": lambda t, x, b: jnp.sum(jax.vmap(lambda c: (t < c * b).astype(float))(TIMES)),
    "beside a bend": lambda t, x, b: jnp.maximum(t - b, 0.0) + jnp.where(t < 2 * b, 0.0, 1e-3),
}
KINKED = {
    "ramp": lambda t, x, b: jnp.where(t < b, 0.0, 3 * (t - b)),
    "ramp that ends": lambda t, x, b: jnp.where(t < b, t / b, 1.0),
    "a delayed table": lambda t, x, b: jnp.interp(t - b, TIMES, VALUES),
    "clip": lambda t, x, b: jnp.clip(t - b, 0.0, 1.0),
    "smooth": lambda t, x, b: jnp.tanh(10 * (t - b)),
    "the state": lambda t, x, b: jnp.where(x < b, 1.0, 0.0),
    "nothing": lambda t, x, b: jnp.where(t < b, 1.0, 1.0) + 0.0 * x,
    "a time of its own": lambda t, x, b: jnp.where(t < 1.0, b, 0.0),
    "ramps in a loop": lambda t, x, b: jax.lax.scan(
        lambda c, k: (c + jnp.where(t > k * b, t - k * b, 0.0), None), 0.0, TIMES[1:4]
    )[0],
    "of a domain": lambda t, x, b: jnp.interp(t - b, TIMES, VALUES) * jnp.sqrt(0.35 - x),
    "a guard": lambda t, x, b: jnp.where(t == b, 1.0, jnp.sinc(t - b)),
}


def leaves(system, params, inputs=None, names=("params['b']",), ts=TS):
    found = Jumps(system, params, Q0, inputs or {}).in_time(set(names), ts)
    return {jump.leaf for jump in found}


def unknown(system, params):
    """The same without known values, as under jit."""
    found = []

    def look(params):
        found.append(leaves(system, params))
        return params

    jax.jit(look)(params)
    return found[0]


@pytest.mark.parametrize("name", JUMPING)
def test_jumps_are_found(name):
    system = pushed(JUMPING[name])
    assert leaves(system, PARAMS) == unknown(system, PARAMS) == {"params['b']"}


@pytest.mark.full
@pytest.mark.parametrize("name", KINKED)
def test_kinks_are_not_reported_as_jumps(name):
    system = pushed(KINKED[name])
    assert leaves(system, PARAMS) == unknown(system, PARAMS) == set()


def test_jump_after_the_last_time_does_not_count():
    system = pushed(JUMPING["where"])
    assert leaves(system, PARAMS | {"b": 4.0}) == set()
    assert unknown(system, PARAMS | {"b": 4.0}) == {"params['b']"}


def test_jumps_of_energies_and_constraints_are_found():
    """In all parts of the equations: a moving frame with a jump in its rate has one in momentum.

    A row whose second derivative has a kink causes no jump.
    """

    def carried(power):
        def lagrangian(t, q, v, params):
            w = jnp.where(t < params["b"], 0.0, (t - params["b"]) ** power)
            return 0.5 * (v[0] - w) ** 2

        return jl.System(lagrangian, ("x",))

    def moved(power):
        def row(t, q, params):
            return q[0] - jnp.where(t < params["b"], 0.0, (t - params["b"]) ** power)

        return jl.System(spring, ("x",), constraints=(jl.Holonomic(row, "slide"),))

    assert leaves(carried(1), PARAMS) == leaves(moved(2), PARAMS) == {"params['b']"}
    assert leaves(carried(2), PARAMS) == leaves(moved(3), PARAMS) == set()


def test_jumps_within_inputs_are_found():
    """Functions and constants are searched; signals with knots jump where steps end."""

    def force(t, q, v, params, inputs):
        return inputs["u"] * jnp.ones(1)

    system = jl.System(spring, ("x",), forces=(jl.GeneralizedForce(force, "drive"),))

    def step(t, params):
        return jnp.where(t < params["b"], 1.0, 0.0)

    def feedback(t, q, v, params):
        return step(t, params) * q[0]

    assert leaves(system, PARAMS, {"u": jl.TimeFunction(step)}) == {"params['b']"}
    assert leaves(system, PARAMS, {"u": jl.Feedback(feedback)}) == {"params['b']"}
    knots = jl.TimeFunction(step, knots=[PARAMS["b"]])
    assert leaves(system, PARAMS, {"u": knots}) == set()
    table = jl.ZeroOrderHold([0.0, PARAMS["b"], 3.0], [1.0, 0.0])
    names = ("params['b']", "inputs['u'].times")
    assert leaves(system, PARAMS, {"u": table}, names) == set()
    switched = pushed(lambda t, x, b: b)
    by_input = jl.GeneralizedForce(
        lambda t, q, v, params, inputs: (t < inputs["end"]).astype(float)[None], "switch"
    )
    found = leaves(switched.with_forces(by_input), PARAMS, {"end": 1.0}, ("inputs['end']",))
    assert found == {"inputs['end']"}


def test_functions_that_refuse_other_values_raise_no_error():
    """Undecided comparisons count as jumps; made-up tables are ordered, keys and flags valid."""

    def guarded(t, q, v, params):
        interpolated = jnp.interp(t - params["b"], TIMES, VALUES) * q
        return eqx.error_if(interpolated, params["l"] < 2.0, "too short")

    force = jl.GeneralizedForce(guarded, "guarded")
    system = jl.System(spring, ("x",), forces=(force,))
    assert unknown(system, PARAMS | {"l": 3.0}) == {"params['b']"}

    def table(t, q, v, params):
        read = jnp.interp(t - params["b"], params["times"], params["values"])
        return jnp.where(params["on"], read, 0.0)[None]

    system = jl.System(spring, ("x",), forces=(jl.GeneralizedForce(table, "table"),))
    params = PARAMS | {"times": TIMES, "values": VALUES, "on": jnp.array(True)}
    names = {"params['b']", "params['times']"}
    for given in (params, params | {"key": jax.random.key(0)}):
        assert leaves(system, given, names=names) == set()
    assert unknown(system, params) == set()


def last(b, k=2.0):
    system = SYSTEM
    return jl.simulate(system, Q0, [0.1], TS, {"b": b, "k": k}).q[-1, 0]


SYSTEM = pushed(JUMPING["where"])
MESSAGE = (
    r"Derivatives with respect to params\['b'\] are .* compared with t at "
    r".*test_jump_times.py:\d+"
)


@pytest.mark.full
def test_derivatives_by_a_jump_time_give_a_warning():
    with pytest.warns(UserWarning, match=MESSAGE + r".* Make that time a knot: .*ZeroOrderHold"):
        jax.grad(jax.jit(last))(1.0)
    with pytest.warns(UserWarning, match=MESSAGE):
        jax.jit(jax.vmap(jax.grad(last)))(jnp.array([1.0, 2.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(last)(1.0)
        jax.grad(last, argnums=1)(1.0, 2.0)


def test_jump_times_in_closures_give_a_warning():
    def end(b):
        law = jl.GeneralizedForce(lambda t, q, v, params: jnp.where(t < b, 1.0, 0.0)[None], "push")
        system = jl.System(spring, ("x",), forces=(law,))
        return jl.simulate(system, Q0, [0.1], TS, {"k": 2.0}).q[-1, 0]

    with pytest.warns(
        UserWarning, match="Derivatives with respect to a number that a declared function closes"
    ):
        jax.grad(end)(1.0)


def inputs(params):
    return {"push": jl.ZeroOrderHold([0.0, params["b"], 3.0], [1.0, 0.0])}


DRIVEN = jl.System(
    spring,
    ("x",),
    forces=(jl.GeneralizedForce(lambda t, q, v, params, u: u["push"] * jnp.ones(1), "push"),),
)


@pytest.mark.full
def test_a_fit_finds_the_time_of_a_jump_by_a_knot():
    """Within its standard deviations, in segments; the first guess is the end of a segment."""
    ts, true = np.linspace(0.0, 3.0, 61), {"b": 1.2, "k": 4.0}
    x = jl.simulate(DRIVEN, Q0, [0.1], ts, true, inputs=inputs(true)).q
    noise = 1e-3 * np.random.default_rng(0).normal(size=(61, 1))
    data = jl.Experiment(ts, {"x": np.asarray(x) + noise}, inputs=inputs, sigma={"x": 1e-3})
    found = jl.fit(DRIVEN, data, {"b": 1.0, "k": 3.5}, free=("b", "k"), segments=3)
    for name, value in true.items():
        assert abs(found.params[name] - value) < 3 * found.std[name]
    # 20 measurements of a position of 0.3 m to 1 mm each determine a time to some milliseconds.
    assert found.std["b"] < 5e-3
    assert found.jumps == {}
    hidden = pushed(JUMPING["where"])
    bare = jl.Experiment(ts, data.channels, sigma=data.sigma)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        found = jl.fit(hidden, bare, {"b": 1.0, "k": 3.5}, free=("b", "k"))
    texts = [str(x.message) for x in warned]
    assert any(text.startswith("Derivatives with respect to params['b'] are") for text in texts)
    assert any("b is compared at" in text and "keeps its value" in text for text in texts)
    assert not any("nothing measured depends on" in text for text in texts)
    assert found.unused == ()
    assert list(found.jumps) == ["b"]


@pytest.mark.full
def test_signals_of_one_function_may_close_over_params():
    ts = np.linspace(0.0, 1.0, 11)

    def turned(params):
        return {"push": jl.TimeFunction(lambda t: jnp.sin(params["w"] * t))}

    x = jl.simulate(DRIVEN, Q0, [0.1], ts, {"w": 1.5, "k": 2.0}, inputs=turned({"w": 1.5})).q
    channels = {"x": np.asarray(x)}
    one = jl.Experiment(ts, channels, inputs=turned, sigma={"x": 1e-3})
    found = jl.fit(DRIVEN, one, {"w": 1.4, "k": 2.0}, free=("w",))
    assert abs(found.params["w"] - 1.5) < 1e-4
    other = jl.Experiment(ts, channels, inputs=lambda p: turned(p), sigma={"x": 1e-3})
    with pytest.raises(
        ValueError, match=r"`inputs\['push'\]` must take params .* Write jl.TimeFunction"
    ):
        jl.fit(DRIVEN, [one, other], {"w": 1.4, "k": 2.0}, free=("w",))


def nothing():
    return {}


def test_inputs_of_params_are_checked():
    ts, x = np.linspace(0.0, 3.0, 4), {"x": np.arange(4.0)}
    with pytest.raises(ValueError, match=r"`inputs` must be callable as \(params\)"):
        jl.Experiment(ts, x, inputs=nothing)
    late = jl.Experiment(
        ts, x, inputs=lambda p: {"push": jl.LinearInterpolation([p["b"], 3.0], [0.0, 1.0])}
    )
    with pytest.raises(ValueError, match="`inputs` must cover ts of experiment, from 0"):
        late.inputs_at({"b": 1.0})
    wrong = jl.Experiment(ts, x, inputs=lambda p: p["b"])
    with pytest.raises(ValueError, match="`inputs` must be a dict from names to input objects"):
        wrong.inputs_at({"b": 1.0})
    assert late.part(slice(1, 3)).inputs is late.inputs
