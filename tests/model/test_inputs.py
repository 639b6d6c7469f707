"""Inputs: tables, functions of time, feedback and constants; reading, and invalid inputs."""

import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag._model._inputs import (
    all_knots,
    at_interval,
    check_inputs,
    common_range,
    evaluate,
    locate,
)

EPS = np.finfo(float).eps
TIMES = [0.0, 0.5, 2.0, 2.25]
VALUES = [3.0, -1.0, 4.0, 10.0]
HOLD, LINE = jl.ZeroOrderHold(TIMES, VALUES), jl.LinearInterpolation(TIMES, VALUES)
Q, V, PARAMS = jnp.array([0.4, -0.7]), jnp.array([1.5, -2.0]), {"w": 3.0}


@eqx.filter_jit
def read(signal, t):
    return evaluate({"u": signal}, t, Q, V, PARAMS)["u"]


def at(signal, times):
    """The signal at many times as a numpy array, each time separately."""
    return np.array([read(signal, jnp.array(t)) for t in times])


# ---- Tables --------------------------------------------------------------------------------------


def test_zero_order_hold_keeps_each_value_up_to_the_next_time():
    np.testing.assert_array_equal(at(HOLD, TIMES), VALUES)  # from the right, the last value, too
    before = np.nextafter(TIMES[1:], -np.inf)
    np.testing.assert_array_equal(at(HOLD, before), VALUES[:-1])
    np.testing.assert_array_equal(at(HOLD, [0.1, 0.7, 1.9, 2.1]), [3.0, -1.0, -1.0, 4.0])


def test_linear_interpolation_equals_numpy_interp():
    np.testing.assert_array_equal(at(LINE, TIMES), VALUES)
    times = np.array([0.1, 0.25, 0.6, 1.25, 2.1])
    expected = np.interp(times, TIMES, VALUES)
    np.testing.assert_allclose(at(LINE, times), expected, rtol=8 * EPS)


def test_linear_interpolation_has_the_slope_of_its_interval():
    """At a knot the slope to the right; at the last knot the slope to the left."""
    slope = jax.jit(jax.vmap(jax.grad(partial(read, LINE))))
    slopes = np.diff(VALUES) / np.diff(TIMES)
    before, after = np.nextafter(TIMES, -np.inf), np.nextafter(TIMES, np.inf)
    np.testing.assert_allclose(slope(after[:-1]), slopes, rtol=4 * EPS)
    np.testing.assert_allclose(slope(before[1:]), slopes, rtol=4 * EPS)
    np.testing.assert_allclose(slope(np.array(TIMES)), [*slopes, slopes[-1]], rtol=4 * EPS)
    hold = jax.jit(jax.vmap(jax.grad(partial(read, HOLD))))
    np.testing.assert_array_equal(hold(np.array(TIMES)), np.zeros(4))


def test_tables_differentiate_with_respect_to_their_values_and_times():
    """u = a + (b - a) s with s = (t - t0)/(t1 - t0)."""
    t, (t0, t1), (a, b) = 1.25, TIMES[1:3], VALUES[1:3]
    slope = jax.jit(jax.grad(read))(LINE, jnp.array(t))
    s, rate = (t - t0) / (t1 - t0), (b - a) / (t1 - t0)
    np.testing.assert_allclose(slope.values, [0, 1 - s, s, 0], rtol=4 * EPS)
    np.testing.assert_allclose(slope.times, [0, -rate * (1 - s), -rate * s, 0], rtol=8 * EPS)
    slope = jax.jit(jax.grad(read))(HOLD, jnp.array(t))
    np.testing.assert_array_equal(slope.values, [0, 1, 0, 0])


def test_steps_read_the_given_interval():
    """For any time: no stage of a step reads across a jump."""
    for t in (0.4, 0.5, 0.6):
        for i, value in enumerate(VALUES):
            found = evaluate({"u": HOLD}, jnp.array(t), Q, V, PARAMS, {"u": jnp.array(i)})
            assert float(found["u"]) == value
        first = evaluate({"u": LINE}, jnp.array(t), Q, V, PARAMS, {"u": jnp.array(0)})
        np.testing.assert_allclose(first["u"], 3.0 - 8.0 * t, rtol=0, atol=16 * EPS)


def test_locate_finds_the_interval_that_begins_at_or_before():
    times = [0.0, 0.25, 0.5, 1.0, 2.0, 2.25]
    signals = {"hold": HOLD, "line": LINE, "wave": jl.TimeFunction(jnp.sin), "gain": jnp.array(1.0)}
    found = [locate(signals, jnp.array(t)) for t in times]
    assert [int(intervals["hold"]) for intervals in found] == [0, 0, 1, 1, 2, 3]
    assert [int(intervals["line"]) for intervals in found] == [0, 0, 1, 1, 2, 2]
    assert [(intervals["wave"], intervals["gain"]) for intervals in found] == [(None, None)] * 6


def test_tables_may_hold_vectors_and_whole_numbers():
    table = jl.LinearInterpolation([0, 1, 2], [[0, 10], [2, 20], [4, 0]])
    np.testing.assert_allclose(at(table, [0.5, 1.5]), [[1.0, 15.0], [3.0, 10.0]], rtol=4 * EPS)
    assert table.times.dtype == table.values.dtype == jnp.float64


def test_float32_tables_stay_float32():
    table = jl.LinearInterpolation([0.0, 1.0], np.array([1.0, 2.0], np.float32))
    assert read(table, jnp.array(0.5)).dtype == jnp.float32


def test_knots_and_range_cover_all_tables():
    late = jl.ZeroOrderHold([0.25, 1.0, 3.0], [1.0, 2.0, 3.0])
    signals = {"a": HOLD, "f": jl.TimeFunction(jnp.sin), "b": late, "gain": jnp.array(1.0)}
    np.testing.assert_array_equal(all_knots(signals), [*TIMES, 0.25, 1.0, 3.0])
    assert [float(x) for x in common_range(signals)] == [0.25, 2.25]
    for without in ({}, {"f": jl.TimeFunction(jnp.sin), "gain": jnp.array(1.0)}):
        assert all_knots(without) is None
        assert common_range(without) is None


# ---- Functions, feedback, constants --------------------------------------------------------------


class Wave(eqx.Module):
    amplitude: jax.Array

    def __call__(self, t):
        return self.amplitude * jnp.sin(t)


class Controller(eqx.Module):
    gain: jax.Array

    def __call__(self, t, q, v, params):
        return -self.gain * (q[0] + params["w"] * v[1]) + t


def test_a_function_takes_time_or_time_and_params():
    t = jnp.array(0.7)
    np.testing.assert_allclose(read(jl.TimeFunction(lambda t: t**2), t), 0.49, rtol=4 * EPS)
    wave = jl.TimeFunction(lambda t, params: jnp.sin(params["w"] * t))
    np.testing.assert_allclose(read(wave, t), np.sin(2.1), rtol=4 * EPS)
    np.testing.assert_allclose(read(jl.TimeFunction(jnp.sin), t), np.sin(0.7), rtol=4 * EPS)
    assert read(jl.TimeFunction(lambda t: 2.0), t) == 2.0


def test_default_of_a_function_does_not_receive_params():
    """The usual way to bind a value at definition."""
    signals = [jl.TimeFunction(lambda t, w=w: w * t) for w in (2.0, 3.0)]
    assert [float(read(signal, jnp.array(0.5))) for signal in signals] == [1.0, 1.5]


def test_zero_order_hold_accepts_one_value_per_interval():
    """As controls between grid edges; the last value also holds at the end."""
    hold = jl.ZeroOrderHold([0.0, 1.0, 3.0], [2.0, 5.0])
    np.testing.assert_array_equal(hold.values, [2.0, 5.0, 5.0])
    pairs = jl.ZeroOrderHold([0, 1, 3], [[1, 2], [3, 4]])
    np.testing.assert_array_equal(pairs.values, [[1.0, 2.0], [3.0, 4.0], [3.0, 4.0]])
    assert jnp.issubdtype(pairs.values.dtype, jnp.floating)


def around(signal, t):
    """The signal as read by a step from t."""
    return at_interval({"u": signal}, jnp.array(t))[0]["u"]


def test_functions_are_read_on_the_side_of_the_knot_of_the_step():
    """Up to the knot, and from it on; the time derivative is that of the function."""
    step = jl.TimeFunction(lambda t: jnp.where(t < 1.0, 2.0 * t, 5.0 * t), knots=[1.0, 2.0])
    np.testing.assert_array_equal(step.knots(), [1.0, 2.0])
    before, after = around(step, 0.3), around(step, 1.0)
    knot = jnp.array(1.0)
    np.testing.assert_allclose(read(before, knot), 2.0, rtol=1e-15)
    assert read(after, knot) == read(step, knot) == 5.0
    assert jax.grad(lambda t: read(before, t))(knot) == 2.0
    late, early = knot + 2 * EPS, knot - EPS  # rounding of a step's ends does not cross the knot
    np.testing.assert_allclose([read(before, late), read(after, early)], [2.0, 5.0], rtol=4 * EPS)
    assert jax.grad(lambda t: read(before, t))(late) == 2.0
    assert jax.grad(lambda t: read(after, t))(early) == 5.0
    beyond = around(step, 2.5)
    assert read(beyond, jnp.array(9.0)) == 45.0


@pytest.mark.parametrize(
    ("knots", "message"),
    [
        ([2.0, 1.0], r"increase strictly, but knots\[0\] = 2.0"),
        (1.0, "be an array of at least 1 times"),
        ([], "be an array of at least 1 times"),
    ],
)
def test_invalid_knots_of_a_function_are_refused(knots, message):
    with pytest.raises(ValueError, match=f"^TimeFunction: `knots` must {message}"):
        jl.TimeFunction(lambda t: t, knots=knots)


def test_feedback_reads_the_state():
    found = read(jl.Feedback(lambda t, q, v, params: q[0] * v[1] + params["w"] * t), jnp.array(2.0))
    np.testing.assert_allclose(found, 0.4 * -2.0 + 3.0 * 2.0, rtol=4 * EPS)


def test_modules_inside_signals_are_traced_and_differentiable():
    t = jnp.array(0.7)
    slope = jax.jit(jax.grad(read))(jl.TimeFunction(Wave(jnp.array(2.0))), t)
    np.testing.assert_allclose(slope.f.amplitude, np.sin(0.7), rtol=4 * EPS)
    slope = jax.jit(jax.grad(read))(jl.Feedback(Controller(jnp.array(2.0))), t)
    np.testing.assert_allclose(slope.f.gain, -(0.4 + 3.0 * -2.0), rtol=4 * EPS)


def test_arrays_and_numbers_are_constants():
    found = check_inputs({"gain": 2.0, "load": [1, 2], "array": np.eye(2), "table": HOLD})
    assert {name: np.shape(x) for name, x in found.items() if name != "table"} == {
        "gain": (),
        "load": (2,),
        "array": (2, 2),
    }
    assert found["table"] is HOLD
    values = evaluate(found, jnp.array(9.0), Q, V, PARAMS)
    np.testing.assert_array_equal(values["load"], [1, 2])
    assert check_inputs(None) == {}


# ---- Reading -------------------------------------------------------------------------------------


def pushed(reading):
    """Two coordinates of unit mass under the force `reading(inputs)`."""

    def push(t, q, v, params, inputs):
        return jnp.stack([reading(inputs), 0.0 * t])

    return jl.System(
        lambda t, q, v, params: 0.5 * v @ v, ("x", "y"), forces=(jl.GeneralizedForce(push, "push"),)
    )


def run(system, inputs):
    ts = jnp.array([0.0, 1.0])
    return jl.simulate(system, Q, V, ts, inputs=inputs, method="euler", dt=1.0)


PUSHED = pushed(lambda inputs: inputs["u"])


def test_a_missing_input_is_named():
    message = (
        r"^`inputs` must have an entry 'u', which a declared function reads, but its names were "
        r"\['w'\]\. Pass inputs="
    )
    other = {"w": jnp.array(1.0)}
    for ask in (
        lambda: run(PUSHED, other),
        lambda: PUSHED.acceleration(Q, V, inputs=other),
        lambda: PUSHED.generalized_force(Q, V, inputs=other),
        lambda: PUSHED.check(Q, V, inputs=other),
    ):
        with pytest.raises(ValueError, match=message):
            ask()
    with pytest.raises(ValueError, match=r"which a declared function reads, .* were \[\]"):
        run(PUSHED, None)


def test_an_input_that_nothing_reads_is_refused():
    signals = {"u": HOLD, "torque": LINE}
    message = (
        r"^`inputs` must hold only signals that a declared function reads, but none read 'torque'"
        r"\. Drop"
    )
    with pytest.raises(ValueError, match=message):
        run(PUSHED, signals)
    free = jl.System(lambda t, q, v, params: 0.5 * v @ v, ("x", "y"))
    with pytest.raises(ValueError, match=r"but none read 'u'\."):
        run(free, {"u": HOLD})


@pytest.mark.parametrize(
    "reading",
    [
        lambda inputs: inputs["u"],
        lambda inputs: inputs.get("u"),
        lambda inputs: sum(inputs.values()),
        lambda inputs: dict(inputs)["u"],
        lambda inputs: dict(**inputs)["u"],
        lambda inputs: next(value for name, value in inputs.items() if name == "u"),
    ],
    ids=["item", "get", "values", "dict", "unpacked", "items"],
)
def test_every_way_of_reading_a_dict_counts_as_reading(reading):
    """x' = v, v' = u = 3 held: one Euler step of 1 s."""
    motion = run(pushed(reading), {"u": jl.ZeroOrderHold([0.0, 1.0], [3.0, 0.0])})
    np.testing.assert_allclose(motion.v[-1], V + jnp.array([3.0, 0.0]), rtol=8 * EPS)


@pytest.mark.parametrize("t", [-0.5, 2.5])
def test_evaluation_outside_a_table_is_refused(t):
    for ask in (PUSHED.acceleration, PUSHED.generalized_force, PUSHED.check):
        with pytest.raises(ValueError, match=r"^`inputs`.*cover.* 0\.0 to 2\.25"):
            ask(Q, V, t=t, inputs={"u": LINE})


@pytest.mark.parametrize(
    ("ts", "cover"),
    [([-1.0, 1.0], "-1.0 to 1.0 s"), ([0.0, 3.0], "0.0 to 3.0 s"), ([1.0, -0.1], "-0.1 to 1.0 s")],
)
def test_solve_beyond_its_tables_is_refused(ts, cover):
    message = (
        rf"^`inputs` must cover ts, from {cover}, but their tables cover 0\.0 to 2\.25 s\. Ext"
    )
    with pytest.raises(ValueError, match=message):
        jl.simulate(PUSHED, Q, V, ts, inputs={"u": LINE})


# ---- Refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [jl.ZeroOrderHold, jl.LinearInterpolation])
@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        ([0.0], [1.0], "`times` must be an array of at least 2 times, but its shape was (1,)."),
        (0.0, [1.0], "`times` must be an array of at least 2 times, but its shape was ()."),
        (
            [[0.0, 1.0]],
            [1.0],
            "`times` must be an array of at least 2 times, but its shape was (1, 2)",
        ),
        (
            [0.0, 1.0, 2.0],
            [1.0],
            "`values` must have one entry per time, 3, but its shape was (1,)",
        ),
        ([0.0, 1.0], 3.0, "`values` must have one entry per time, 2, but its shape was ()."),
        (
            [0.0, 1.0, 1.0, 2.0],
            [0.0] * 4,
            "`times` must increase strictly, but times[1] = 1.0 and times[2] = 1.0. Sort the times",
        ),
        (
            [0.0, 2.0, 1.0],
            [0.0] * 3,
            "`times` must increase strictly, but times[1] = 2.0 and times[2]",
        ),
        (
            [0.0, np.nan],
            [0.0] * 2,
            "`times` must increase strictly, but times[0] = 0.0 and times[1]",
        ),
        ([0.0, 1.0], [0.0, np.nan], "`values` must be finite, but some were nan or inf."),
        ([0.0, 1.0], [0.0, np.inf], "`values` must be finite, but some were nan or inf."),
    ],
)
def test_invalid_table_is_refused(kind, times, values, message):
    with pytest.raises(ValueError, match=f"^{kind.__name__}: {re.escape(message)}"):
        kind(times, values)


@pytest.mark.parametrize("kind", [jl.ZeroOrderHold, jl.LinearInterpolation])
@pytest.mark.parametrize("array", [list, np.array, jnp.array])
def test_known_tables_are_checked_under_a_transform(kind, array):
    """Built of constant arrays while JAX traces the function around them."""
    times, values, worse = array(TIMES), array(VALUES), array([3.0, np.nan, 4.0, 10.0])
    found = jax.jit(lambda t: read(kind(times, values), t))(1.25)
    assert found == read(kind(TIMES, VALUES), jnp.array(1.25))
    with pytest.raises(ValueError, match="`values` must be finite, but some were nan or inf"):
        jax.jit(lambda t: read(kind(times, worse), t))(1.25)
    with pytest.raises(ValueError, match="`times` must increase strictly"):
        jax.jit(lambda t: read(kind(values, values), t))(1.25)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jl.TimeFunction(lambda: 1.0),
            "TimeFunction: `f` must be callable as (t), but its signature was (). Add or drop ",
        ),
        (
            lambda: jl.TimeFunction(lambda t, q, v: 1.0),
            "TimeFunction: `f` must be callable as (t), but its signature was (t, q, v).",
        ),
        (
            lambda: jl.Feedback(lambda t: 1.0),
            "Feedback: `f` must be callable as (t, q, v, params), but its signature was (t).",
        ),
        (
            lambda: check_inputs({"u": lambda t: t}),
            "`inputs['u']` must be an input object or an array, but it was the function <function",
        ),
        (
            lambda: check_inputs([1.0]),
            "`inputs` must be a dict from names to input objects or arrays, but it was [1.0].",
        ),
        (
            lambda: check_inputs({1: 2.0}),
            "`inputs` must be a dict from names to input objects or arrays, but it was {1: 2.0}.",
        ),
    ],
)
def test_invalid_signal_is_refused(make, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        make()


def test_unwrapped_function_gets_advice_to_wrap_it():
    with pytest.raises(
        ValueError, match=r"Wrap it in jl\.TimeFunction \(of time\) or jl\.Feedback"
    ):
        run(PUSHED, {"u": jnp.sin})


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: jl.TimeFunction(3.0),
            "TimeFunction: `f` must be a function of (t), but it was 3.0.",
        ),
        (
            lambda: jl.Feedback("u"),
            "Feedback: `f` must be a function of (t, q, v, params), but it was 'u'.",
        ),
        (lambda: run(PUSHED, [HOLD]), "`inputs` must be a dict from names to input objects or arr"),
        (
            lambda: run(PUSHED, {"u": "on"}),
            "`inputs['u']` must be an input object or an array, but",
        ),
        (
            lambda: run(PUSHED, {"u": None}),
            "`inputs['u']` must be an input object or an array, but",
        ),
    ],
)
def test_invalid_type_is_refused(make, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        make()


def test_tables_may_be_written_as_lists_of_traced_numbers():
    @jax.jit
    def read(end, value):
        table = jl.ZeroOrderHold([0.0, end, 3.0], [value, 0.0])
        line = jl.LinearInterpolation([0.0, end], [value, 0.0])
        knots = jl.TimeFunction(lambda t: t, knots=[end]).knots()
        return table.times, table.values, line.times, line.values, knots

    found = read(1.0, 2.0)
    expected = [0.0, 1.0, 3.0], [2.0, 0.0, 0.0], [0.0, 1.0], [2.0, 0.0], [1.0]
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, y)
