"""Invalid input of `simulate` and `System`: refused by name, with the condition and the value.

Traced values cannot raise errors: a status reports them.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _refused import PARAMS, Q0, TS, V0, kinetic, potential, refused, run
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag import Status

EPS = np.finfo(float).eps


def single(*x):
    return np.array(x, np.float32)


# ---- The Lagrangian ------------------------------------------------------------------------------

NOT_SCALAR = [
    (lambda t, q, v, params: 0.5 * v**2, "float64 of shape (2,)"),
    (lambda t, q, v, params: 0.5 * (v @ v)[None], "float64 of shape (1,)"),
    (lambda t, q, v, params: jax.lax.complex(v @ v, 1.0), "complex128 of shape ()"),
    (lambda t, q, v, params: jnp.array(3), "int64 of shape ()"),
    (lambda t, q, v, params: v[0] > 0, "bool of shape ()"),
]


@pytest.mark.parametrize(("lagrangian", "was"), NOT_SCALAR)
def test_the_lagrangian_must_be_a_real_scalar(lagrangian, was):
    system = jl.System(lagrangian, ("x", "y"))
    message = f"`lagrangian` must return a real scalar, but it returned {was}. Sum with"
    refused(message, system=system)
    for ask in (system.check, lambda *state: system.explain(state[2])):
        with pytest.raises(ValueError, match="^" + re.escape(message)):
            ask(Q0, V0, PARAMS)


@pytest.mark.parametrize("method", ["acceleration", "bias", "mass_matrix", "momentum", "energy"])
def test_every_method_refuses_a_vector_valued_lagrangian(method):
    system = jl.System(NOT_SCALAR[0][0], ("x", "y"))
    with pytest.raises(
        ValueError, match=r"^`lagrangian` must return a real scalar, but it returned "
    ):
        getattr(system, method)(Q0, V0, PARAMS)


def test_the_lagrangian_must_be_an_array():
    system = jl.System(lambda t, q, v, params: [v @ v], ("x", "y"))
    refused("`lagrangian` must return an array, but it returned [", system=system)
    system = jl.System(lambda t, q, v, params: None, ("x", "y"))
    refused("`lagrangian` must return an array, but it returned None", system=system)


EITHER = "`System` must get either lagrangian, or both kinetic and potential, but it got "


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"lagrangian": lambda q, v: v @ v},
            "`lagrangian` must be callable as (t, q, v, params), but its signature was (q, v). Add "
            "or drop arguments so that it takes exactly these, in this order.",
        ),
        (
            {"lagrangian": lambda t, q, v, params, inputs: v @ v},
            "`lagrangian` must be callable as (t, q, v, params), but its signature was (t, q, v, p",
        ),
        (
            {"kinetic": lambda q, v, params: v @ v, "potential": potential},
            "`kinetic` must be callable as (t, q, v, params), but its signature was (q, v, params)",
        ),
        (
            {"kinetic": kinetic, "potential": kinetic},
            "`potential` must be callable as (t, q, params), but its signature was (t, q, v, ",
        ),
        (
            {},
            "`System` must get either lagrangian, or both kinetic and potential, but it got none",
        ),
        (
            {"kinetic": kinetic},
            "`System` must get either lagrangian, or both kinetic and potential, but",
        ),
        (
            {"potential": potential},
            "`System` must get either lagrangian, or both kinetic and potential",
        ),
        (
            {"lagrangian": kinetic, "kinetic": kinetic, "potential": potential},
            EITHER + "lagrangian and kinetic and potential.",
        ),
        ({"lagrangian": kinetic, "potential": potential}, EITHER + "lagrangian and potential."),
    ],
)
def test_the_functions_must_take_their_arguments(parts, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        jl.System(**(parts | {"coordinates": ("x", "y")}))


@pytest.mark.usefixtures("unchecked")
def test_the_lagrangian_must_be_a_function():
    message = r"^`lagrangian` must be a function of \(t, q, v, params\), but it was 3\.0\.$"
    with pytest.raises(ValueError, match=message):
        jl.System(3.0, ("x",))


def test_coordinates_must_have_distinct_names():
    with pytest.raises(
        ValueError, match=r"^`coordinates` must be distinct, but 'x' occurs 2 times"
    ):
        jl.System(kinetic, ("x", "y", "x"))
    with pytest.raises(ValueError, match=r"^`coordinates` must have at least one name, but"):
        jl.System(kinetic)


# ---- At the start: not finite, without inertia ---------------------------------------------------


def logarithmic(t, q, v, params):
    """A valley that ends at x = 0."""
    return 0.5 * params["m"] * v @ v + jnp.log(q[0]) - q[1]


def massless(t, q, v, params):
    """Inertia for the given coordinates only, without couplings."""
    return 0.5 * jnp.sum(jnp.asarray(params["m"]) * v**2) - 0.5 * q @ q


EULER = {"method": "euler", "dt": 0.5}


def test_a_lagrangian_that_is_nan_at_the_start_is_refused():
    system = jl.System(logarithmic, ("x", "y"))
    with pytest.raises(
        ValueError, match=r"^`lagrangian` must be finite at the given state, but it was"
    ):
        system.check([-1.0, 2.0], V0, PARAMS)
    with pytest.raises(
        jl.SimulationError,
        match=r"status nonfinite.*last good state at t = 0\.0 .*A declared function",
    ) as caught:
        run(system, q0=[-1.0, 2.0], **EULER)
    motion = caught.value.motion
    assert int(motion.status) == Status.nonfinite
    np.testing.assert_array_equal(motion.last_state[0], [-1.0, 2.0])
    assert run(system, **EULER).status == Status.ok


@pytest.mark.parametrize("n", [3, 9])
def test_a_coordinate_without_inertia_is_named_by_check(n):
    system = jl.System(massless, {"s": (n,)})
    for index in (0, 1, n - 1):
        params = {"m": np.where(np.arange(n) == index, 0.0, 2.0)}
        message = (
            rf"^coordinate 's\[{index}\]' must have inertia: d2L/dv2 positive definite, but its "
            r"pivot was not positive at q = .*, v = .* Add its kinetic energy to L"
        )
        with pytest.raises(ValueError, match=message):
            system.check(np.ones(n), np.zeros(n), params)


@pytest.mark.parametrize("n", [3, 9])
def test_a_coordinate_without_inertia_is_named_by_simulate(n):
    """One program per n: the masses are values."""
    system = jl.System(massless, {"s": (n,)})
    for index, mass in ((0, 0.0), (1, 0.0), (n - 1, -2.0)):
        params = {"m": np.where(np.arange(n) == index, mass, 2.0)}
        with pytest.raises(
            jl.SimulationError,
            match=rf"status mass_singular \('s\[{index}\]'\): .*give this coordinate",
        ) as caught:
            run(system, q0=np.ones(n), v0=np.zeros(n), params=params, **EULER)
        motion = caught.value.motion
        assert (int(motion.status), int(motion.where)) == (Status.mass_singular, index)
        assert np.all(np.isnan(motion.q[1:]))


# ---- Start, times, tolerances, steps -------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"q0": [1.0]},
            "`q0` must have shape (2,), but its shape was (1,). Give one entry for each, ",
        ),
        (
            {"v0": [0.0] * 3},
            "`v0` must have shape (2,), but its shape was (3,). Give one entry for each, ",
        ),
        ({"q0": [[1.0, 2.0]]}, "`q0` must have shape (2,), but its shape was (1, 2)."),
        ({"q0": {"x": 1.0}}, "`q0` must name exactly ['x', 'y'], but it named ['x']."),
        ({"v0": {"x": [1.0], "y": 0.0}}, "`v0['x']` must have shape (), but it was (1,)."),
        ({"v0": {"x": "one", "y": 0.0}}, "`v0['x']` must "),
        ({"q0": None}, "`q0` must be 2 numbers, but it was None."),
        ({"q0": ["one", "two"]}, "`q0` must be 2 numbers, but it was ['one', 'two']."),
        ({"v0": [1.0, 2.0j]}, "`v0` must be real, but its dtype was complex128."),
        ({"q0": [1.0, np.nan]}, "`q0` must be finite, but q0[1] ('y') was nan."),
        ({"v0": [np.inf, np.nan]}, "`v0` must be finite, but v0[0] ('x') was inf."),
        (
            {"v0": None},
            "exactly one of `v0` and `u0` must be given, but neither was given. Pass v0=, the",
        ),
        ({"u0": V0}, "exactly one of `v0` and `u0` must be given, but both were given."),
        (
            {"v0": None, "u0": V0},
            "`u0` must be given for a system with quasi-velocities only, but this system has none. "
            "Pass v0= instead.",
        ),
        (
            {"ts": None},
            "`ts` must be given, but it was None. Pass ts=jnp.linspace(0, 10, 501).",
        ),
        ({"ts": [0.0]}, "`ts` must be an array of at least 2 times, but its shape was (1,)."),
        ({"ts": []}, "`ts` must be an array of at least 2 times, but its shape was (0,)."),
        ({"ts": 1.0}, "`ts` must be an array of at least 2 times, but its shape was ()."),
        ({"ts": [TS]}, "`ts` must be an array of at least 2 times, but its shape was (1, 2)."),
        (
            {"ts": [0.0, 1.0, 1.0]},
            "`ts` must be strictly monotone, but ts[1] = 1.0, ts[2] = 1.0. Sort the times and drop",
        ),
        ({"ts": [0.0, 2.0, 1.0]}, "`ts` must be strictly monotone, but ts[1] = 2.0, ts[2] = 1.0."),
        ({"ts": [1.0, 2.0, 0.0]}, "`ts` must be strictly monotone, but ts[0] = 1.0, ts[1] = 2.0."),
        ({"ts": [0.0, 0.0]}, "`ts` must be strictly monotone, but ts[0] = 0.0, ts[1] = 0.0."),
        ({"ts": [0.0, np.nan, 1.0]}, "`ts` must be finite, but ts[1] was not."),
        ({"ts": [0.0, np.inf]}, "`ts` must be finite, but ts[1] was not."),
        ({"rtol": -1e-6}, "`rtol` must be finite and not negative, but it was -1e-06."),
        ({"atol": -1e-6}, "`atol` must be finite and not negative, but it was -1e-06."),
        ({"rtol": np.nan}, "`rtol` must be finite and not negative, but it was nan."),
        ({"atol": np.inf}, "`atol` must be finite and not negative, but it was inf."),
        (
            {"atol": [1e-6, 1e-3, 1e-3]},
            "`atol` must be a number, or one for each of 2 coordinates, but its shape was (3,).",
        ),
        ({"atol": [1e-6, -1e-3]}, "`atol` must be finite and not negative, but it was [ 1.e-06"),
        ({"atol": {"x": 1e-6}}, "`atol` must name exactly ['x', 'y'], but it named ['x']."),
        ({"rtol": [1e-6, 1e-6]}, "`rtol` must be a number, but its shape was (2,)."),
        ({"rtol": "tight"}, "`rtol` must be a number, but it was 'tight'."),
        ({"rtol": 0.0, "atol": 0}, "`rtol` and `atol` must not both be zero, but both were."),
        (
            {"rtol": 9 * EPS},
            "`rtol` must be 0 or at least 2.2e-15, ten roundings of float64, but it was 1.99",
        ),
        (
            {"rtol": 1e-7, "q0": single(1, 2), "v0": single(0, 1)},
            "`rtol` must be 0 or at least 1.2e-06, ten roundings of float32, but it was 1e-07. "
            'Loosen it, or compute in float64: jax.config.update("jax_enable_x64", True)',
        ),
        (
            {"dt": 0.1, "rtol": 1e-6},
            "`rtol` and `atol` must be left out with fixed steps, but dt was given too.",
        ),
        (
            {"dt": 0.1, "atol": 1e-6},
            "`rtol` and `atol` must be left out with fixed steps, but dt was",
        ),
        ({"dt": -0.1}, "`dt` must be positive, even if ts decreases, but it was -0.1."),
        ({"dt": 0.0}, "`dt` must be positive, even if ts decreases, but it was 0.0."),
        ({"dt": np.nan}, "`dt` must be positive, even if ts decreases, but it was nan."),
        ({"dt": [0.1, 0.2]}, "`dt` must be a number, but its shape was (2,)."),
        ({"dt": "small"}, "`dt` must be a number, but it was 'small'."),
        ({"dt0": -0.1}, "`dt0` must be positive, even if ts decreases, but it was -0.1."),
        (
            {"dt": 0.1, "dt0": 0.1},
            "`dt` and `dt0` must not both be given, but both were given.",
        ),
        ({"ts": [0.0, 1.0j]}, "`ts` must be an array of times, but it was [0.0, 1j]. Give real"),
        (
            {"rtol": "1e-6"},
            "`rtol` must be a number, but it was '1e-6'. Give real numbers.",
        ),
        ({"rtol": 1e-6j}, "`rtol` must be a number, but it was 1e-06j. Give real numbers."),
        ({"dt_max": 0.0}, "`dt_max` must be positive, even if ts decreases, but it was 0.0."),
        (
            {"dt": 0.1, "dt_max": 0.1},
            "`dt_max` must be left out with fixed steps, but dt was given",
        ),
    ],
)
def test_invalid_value_is_refused(changes, message):
    refused(message, **changes)


def test_values_at_the_bounds_are_accepted():
    """Traced, not run: values just inside a bound are accepted."""
    for changes in (
        {"rtol": 10 * EPS},
        {"rtol": 0.0, "atol": 1e-9},
        {"rtol": 1e-6, "atol": 0},
        {"ts": [1.0, 0.5, -3.0]},
        {"ts": [0, 1]},
        {"dt0": 1e-3},
        {"q0": {"y": 2, "x": 1.0}},
    ):
        shapes = jax.eval_shape(lambda changes=changes: run(**changes).q)
        assert shapes.shape == (len(changes.get("ts", TS)), 2)


# ---- Traced values -------------------------------------------------------------------------------

NAN, INF = np.nan, np.inf
TRACED = {
    "good": ({}, Status.ok),
    "q0 nan": ({"q0": [1.0, NAN]}, Status.bad_value),
    "v0 inf": ({"v0": [INF, 0.0]}, Status.bad_value),
    "ts nan": ({"ts": [0.0, NAN, 1.0]}, Status.bad_value),
    "ts repeated": ({"ts": [0.0, 1.0, 1.0]}, Status.bad_value),
    "ts turning": ({"ts": [0.0, 2.0, 1.0]}, Status.bad_value),
    "ts all one": ({"ts": [0.0, 0.0, 0.0]}, Status.bad_value),
    "ts falling": ({"ts": [1.0, 0.5, 0.0]}, Status.ok),
    "rtol negative": ({"rtol": -1e-6}, Status.bad_value),
    "rtol nan": ({"rtol": NAN}, Status.bad_value),
    "rtol tiny": ({"rtol": EPS}, Status.bad_value),
    "atol negative": ({"atol": -1e-6}, Status.bad_value),
    "rtol infinite": ({"rtol": INF}, Status.bad_value),
    "atol infinite": ({"atol": INF}, Status.bad_value),
    "both zero": ({"rtol": 0.0, "atol": 0.0}, Status.bad_value),
    "one zero": ({"rtol": 0.0}, Status.ok),
    "dt0 negative": ({"dt0": -0.1}, Status.bad_value),
    "dt0 nan": ({"dt0": NAN}, Status.bad_value),
    "dt_max zero": ({"dt_max": 0.0}, Status.bad_value),
    "dt_max short": ({"dt_max": 0.01}, Status.ok),
    "L nan": ({"q0": [-1.0, 0.0]}, Status.nonfinite),
    "no inertia": ({"m": 0.0}, Status.mass_singular),
    "m nan": ({"m": NAN}, Status.nonfinite),
}


def test_traced_invalid_values_end_in_a_status():
    """All in one batch, so that they must not affect a valid one."""
    system = jl.System(logarithmic, ("x", "y"))
    good = {
        "q0": Q0,
        "v0": V0,
        "ts": [0.0, 0.1, 0.2],
        "rtol": 1e-6,
        "atol": 1e-6,
        "dt0": 0.1,
        "dt_max": 1.0,
        "m": 2.0,
    }
    lanes = [good | changes for changes, _ in TRACED.values()]
    stacked = {name: jnp.array([lane[name] for lane in lanes]) for name in good}

    @jax.jit
    @jax.vmap
    def motions(q0, v0, ts, rtol, atol, dt0, dt_max, m):
        steps = {"rtol": rtol, "atol": atol, "dt0": dt0, "dt_max": dt_max}
        return jl.simulate(system, q0, v0, ts, {"m": m}, method="bosh3", **steps)

    found = motions(*stacked.values())
    names = [Status(int(status)).name for status in found.status]
    assert dict(zip(TRACED, names, strict=True)) == {
        name: status.name for name, (_, status) in TRACED.items()
    }
    for i, (_, status) in enumerate(TRACED.values()):
        finite = np.all(np.isfinite(found.q[i])) and np.all(np.isfinite(found.v[i]))
        assert finite == (status is Status.ok)
    lane_names = list(TRACED)
    np.testing.assert_array_equal(found.where[np.array([lane_names.index("q0 nan")])], [1])
    np.testing.assert_array_equal(found.where[np.array([lane_names.index("v0 inf")])], [0])


def growing(t, q, v, params):
    grown = jax.lax.while_loop(lambda c: c < 2.0, lambda c: c * (1.0 + q[0]), 1.0)
    return 0.5 * v @ v - grown


@pytest.mark.parametrize("lowering", ["auto", "array"])
def test_loops_without_a_number_of_iterations_are_named_by_line(lowering):
    system = jl.System(growing, ("x",), lowering=lowering)
    line = growing.__code__.co_firstlineno + 1
    message = (
        rf"^`lagrangian` must have reverse derivatives.*test_arguments.py:{line}:.*\(growing\)"
    )
    for ask in (jl.equilibrium, lambda system, q: jl.simulate(system, q, [0.0], [0.0, 1.0])):
        with pytest.raises(ValueError, match=message):
            ask(system, [1.0])


@pytest.mark.parametrize("unread", [np.inf, np.array([1.0, np.nan])])
def test_unread_params_may_have_any_value(unread):
    def lagrangian(t, q, v, params):
        return 0.5 * params["m"] * v @ v

    system = jl.System(lagrangian, ("x",), constraints=())
    options = {"method": "euler", "dt": 0.5}
    motion = jl.simulate(system, [0.0], [1.0], [0.0, 1.0], {"m": 1.0, "limit": unread}, **options)
    assert motion.q[-1] == 1.0
    with pytest.raises(ValueError, match=r"^`params\['m'\]` must be finite, but it was inf\."):
        jl.simulate(system, [0.0], [1.0], [0.0, 1.0], {"m": np.inf, "limit": unread}, **options)
