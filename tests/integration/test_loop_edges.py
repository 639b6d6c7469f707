"""Edge cases of the loop: knots at the start, saves near step ends, times far from zero."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import loop, operations
from _on_tables import moved

import jaxlag as jl

EPS = np.finfo(float).eps


KINDS = {"hold": jl.ZeroOrderHold, "line": jl.LinearInterpolation}


def closed_form(kind, times, values, ts, start=(0.1, 0.2)):
    """(x, x') of x'' = u at ts, by the polynomials between knots."""

    def to(t):
        x, v, now = *start, float(ts[0])
        sign = 1.0 if t >= now else -1.0
        inner = sorted((k for k in times if min(now, t) < k < max(now, t)), reverse=sign < 0)
        for end in [*inner, t]:
            h, middle = end - now, 0.5 * (now + end)
            i = int(np.clip(np.searchsorted(times, middle, side="right") - 1, 0, len(times) - 2))
            u, slope = values[i], 0.0
            if kind == "line":
                slope = (values[i + 1] - values[i]) / (times[i + 1] - times[i])
                u = values[i] + slope * (now - times[i])
            x, v = x + v * h + u * h**2 / 2 + slope * h**3 / 6, v + u * h + slope * h**2 / 2
            now = end
        return x, v

    return np.array([to(float(t)) for t in ts]).T


TIMES = np.array([-1.0, -0.4, 0.0, 0.25, 1.0])
VALUES = np.array([1.0, -2.0, 5.0, 3.0, -4.0])
OPTIONS = [
    pytest.param({}, id="adaptive"),
    pytest.param({"dt": 0.3}, id="fixed"),
    pytest.param({"method": "bosh3", "dt": 0.07}, id="bosh3", marks=pytest.mark.full),
]


@pytest.mark.full
@pytest.mark.parametrize("time_direction", [1.0, -1.0], ids=["forwards", "backwards"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("options", OPTIONS)
def test_a_knot_at_the_start_is_read_from_the_side_of_the_step(kind, options, time_direction):
    """From t = 0, which is a knot, in either direction: plain, and with a gradient by the table.

    x is linear in the values: its derivative is the motion from rest under a table with one value
    of 1. Methods of order 3 and more are exact for it, up to some rounding of each of 15 steps.
    """
    ts = time_direction * np.array([0.0, 0.1, 0.25, 0.6, 1.0])

    @jax.jit
    def end(values):
        motion = moved(KINDS[kind](jnp.array(TIMES), values), ts, **options)
        return motion.q[-1, 0], (motion.q[:, 0], motion.v[:, 0])

    expected = closed_form(kind, TIMES, VALUES, ts)
    (_, again), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(jnp.array(VALUES))
    for found in (end(jnp.array(VALUES))[1], again):
        np.testing.assert_allclose(found, expected, rtol=0, atol=64 * EPS)
    units = [closed_form(kind, TIMES, unit, ts, (0.0, 0.0))[0, -1] for unit in np.eye(5)]
    np.testing.assert_allclose(slope, units, rtol=0, atol=64 * EPS)
    assert np.abs(units).max() > 0.01


def test_steps_cut_by_a_knot_do_not_affect_the_controller():
    """Below its least step a controller accepts any error, but not after a step cut by a knot.

    x'' = 100 x from rest at 1: cosh(10 t), 11013 at t = 1, with two knots 1e-7 apart.
    """
    table = jl.ZeroOrderHold([0.0, 0.5, 0.5 + 1e-7, 1.0], [0.0, 0.0, 0.0, 0.0])
    control = diffrax.PIDController(rtol=1e-8, atol=1e-8, dtmin=1e-5)
    ts = np.linspace(0.0, 1.0, 6)
    method = (jl.solvers.Tsit5(), control)
    motion = moved(table, ts, (1.0, 0.0), {"k": 100.0}, method=method)
    assert motion.status == jl.Status.ok
    np.testing.assert_allclose(motion.q[:, 0], np.cosh(10 * ts), rtol=1e-5)


def test_failure_of_a_controller_is_reported():
    """Errors too large for its least step, which it may not accept (force_dtmin=False)."""
    control = diffrax.PIDController(rtol=1e-10, atol=1e-10, dtmin=0.3, force_dtmin=False)
    table = jl.ZeroOrderHold([0.0, 1.0], [0.0, 0.0])
    method = (jl.solvers.Tsit5(), control)
    motion = moved(table, [0.0, 1.0], (1.0, 0.0), {"k": 100.0}, method=method)
    assert motion.status == jl.Status.step_below_resolution
    assert motion.last_time < 1.0
    assert np.isnan(motion.q[-1, 0])


@pytest.mark.full
@pytest.mark.parametrize("time_direction", [1.0, -1.0], ids=["forwards", "backwards"])
@pytest.mark.parametrize(
    "options",
    [{}, pytest.param({"dt": 0.125}, marks=pytest.mark.full)],
    ids=["adaptive", "fixed"],
)
def test_saves_have_derivatives_by_their_own_time(options, time_direction):
    """Near a knot and on it, where steps end: d x / d its time is x', in both modes."""
    knot = 0.5
    saves = [np.nextafter(knot, 0), knot, np.nextafter(knot, 1), knot + 4 * EPS, knot + 1e-9]
    ts = jnp.array(time_direction * np.array([0.0, 0.2, *saves, 1.0]))
    times = jnp.sort(time_direction * jnp.array([-1.0, 0.5, 1.0]))
    table = jl.ZeroOrderHold(times, jnp.array([2.0, -7.0, 1.0]))

    def x(ts):
        return moved(table, ts, **options).q[:, 0]

    v = moved(table, ts, **options).v[:, 0]
    for jacobian in (jax.jacfwd(x), jax.jacrev(x)):
        found = np.asarray(jax.jit(jacobian)(ts))
        # x(ts[0]) is given; all other saves depend on ts[0], because the table is fixed in time.
        np.testing.assert_allclose(np.diag(found)[1:], v[1:], rtol=0, atol=1e-12)
        others = found - np.diag(np.diag(found))
        np.testing.assert_allclose(others[:, 1:], 0.0, atol=1e-12)


@pytest.mark.parametrize("solver", [diffrax.ReversibleHeun(), diffrax.LeapfrogMidpoint()])
def test_saves_after_a_knot_include_the_jump(solver):
    """Also of multistep solvers: a save inside a step equals the end of that step.

    The first save lies inside the step that starts at the knot. In a solve that ends at this save
    it is the end of a step.
    """
    table = jl.ZeroOrderHold([0.0, 0.5, 1.0], [0.0, 8.0, 0.0])
    options = {"method": solver, "dt": 0.1}
    motion = moved(table, [0.0, 0.53, 1.0], **options)
    alone = moved(table, [0.0, 0.53], **options)
    np.testing.assert_allclose(motion.q[1], alone.q[-1], rtol=0, atol=8 * EPS)
    np.testing.assert_allclose(motion.v[1], alone.v[-1], rtol=0, atol=8 * EPS)
    expected = closed_form("hold", np.array([0.0, 0.5, 1.0]), np.array([0.0, 8.0, 0.0]), [0, 0.53])
    np.testing.assert_allclose(motion.v[1], expected[1, -1], rtol=0, atol=0.03)


@pytest.mark.parametrize(
    "times", [[0.0, 0.7, 0.3, 1.0], [0.0, 0.3, 0.3, 1.0], [0.0, np.nan, 0.3, 1.0]]
)
def test_unordered_traced_tables_have_status_bad_value(times):
    """Tables with known values raise an error; see test_inputs."""

    @jax.jit
    def status(times):
        return moved(jl.LinearInterpolation(times, jnp.ones(4)), [0.0, 1.0]).status

    assert status(jnp.array([0.0, 0.3, 0.7, 1.0])) == jl.Status.ok
    assert status(jnp.array(times)) == jl.Status.bad_value


@pytest.mark.parametrize("options", [{}, {"dt": 0.01}], ids=["adaptive", "fixed"])
def test_saves_far_from_time_zero_stay_distinct(options):
    """Seconds since 1970, saves some ulp (2.4e-7 s) apart: x = x0 + v (t - t0).

    Bound: rounding of the span.
    """
    start = 1.7e9
    steps = np.array([0.0, 5e-7, 1e-6, 3e-6, 1e-2, 1e-2 + 1e-6, 1.0])
    ts = start + steps
    table = jl.LinearInterpolation([start, start + 0.5, start + 1.0], [0.0, 0.0, 0.0])
    motion = moved(table, ts, **options)
    np.testing.assert_allclose(motion.q[:, 0], 0.1 + 0.2 * (ts - ts[0]), rtol=0, atol=8 * EPS)
    assert np.all(np.diff(motion.q[:, 0]) > 0)
    np.testing.assert_array_equal(motion.last_time, ts[-1])


@pytest.mark.full
@pytest.mark.parametrize(
    "options",
    [{"gradient": "checkpoints", "max_steps": 256}, {"max_steps": 1024}],
    ids=["checkpoints", "auto"],
)
def test_save_in_the_last_step_of_a_full_record_has_derivatives(options):
    """As many steps as allowed, all checkpoints in use: reverse equals forward."""
    count, h = options["max_steps"], 1 / 128
    ts = np.array([0.0, (count - 0.5) * h, count * h])

    def x(k):
        table = jl.LinearInterpolation([0.0, 10.0], [0.3, 0.0])
        motion = moved(table, ts, params={"k": k}, method="dopri5", dt=h, **options)
        return motion.q[1, 0] + motion.q[2, 0], motion.stats["accepted"]

    (forward, steps), (reverse, _) = (
        jax.jit(of(x, has_aux=True))(-4.0) for of in (jax.jacfwd, jax.jacrev)
    )
    assert steps == count
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)


def test_adjacent_knots_and_saves_far_from_the_start_are_distinct():
    """Two knots, and two saves, whose distance from ts[0] is the same number."""
    pair = [0.5, np.nextafter(0.5, 1)]
    assert pair[0] + 10.0 == pair[1] + 10.0
    jump = jl.LinearInterpolation([-10.0, *pair, 2.0], [0.0, 0.0, 1.0, 1.0])
    motion = moved(jump, [-10.0, *pair, 1.0], dt=0.25)
    assert motion.status == jl.Status.ok
    x, v = 0.1 + 0.2 * 10.5, 0.2
    np.testing.assert_allclose(motion.q[1:3, 0], x, rtol=8 * EPS)
    np.testing.assert_allclose(motion.v[-1, 0], v + 0.5, rtol=8 * EPS)


@pytest.mark.full
@pytest.mark.parametrize("options", [{}, {"dt": 0.1}], ids=["adaptive", "fixed"])
@pytest.mark.parametrize("ts", [[-2.0, 0.6], [0.3, 0.1], [0.1, 0.7]])
def test_no_time_beyond_the_last_is_evaluated(ts, options):
    """t0 + (t1 - t0) may exceed t1, where this force is NaN."""
    time_direction, end = np.sign(ts[1] - ts[0]), ts[1]
    falling = jl.TimeFunction(lambda t: jnp.sqrt(time_direction * (end - t)))
    for of in (lambda f: f, jax.jit):
        motion = of(lambda ts: moved(falling, ts, **options))(jnp.array(ts))
        assert motion.status == jl.Status.ok
        assert motion.last_time == end


@pytest.mark.parametrize("dtmin", [1e-3, 0.2])
def test_short_step_to_a_knot_is_not_a_controller_failure(dtmin):
    """The short step to the last time is no failure, either."""
    control = diffrax.PIDController(rtol=1e-8, atol=1e-8, dtmin=dtmin, force_dtmin=False)
    table = jl.ZeroOrderHold([0.0, 0.5, 0.5 + 1e-5, 1.0], [1.0, 2.0, 3.0, 0.0])
    motion = moved(table, [0.0, 0.9, 0.9 + 1e-5], method=(jl.solvers.Tsit5(), control))
    assert motion.status == jl.Status.ok
    times, values = (np.asarray(x) for x in (table.times, table.values))
    expected = closed_form("hold", times, values, [0.0, 0.9 + 1e-5])[0, -1]
    np.testing.assert_allclose(motion.q[-1, 0], expected, rtol=64 * EPS)


def test_first_step_respects_the_controller():
    """At most 0.1 s: 10 steps to 1 s, as by the same method of diffrax."""
    control = diffrax.PIDController(rtol=0.1, atol=0.1, dtmax=0.1)
    table = jl.ZeroOrderHold([0.0, 1.0], [0.0, 0.0])
    for solver in (jl.solvers.Tsit5(), diffrax.Tsit5()):
        motion = moved(table, [0.0, 1.0], params={"k": -1.0}, method=(solver, control))
        assert motion.stats["accepted"] == 10


@pytest.mark.full
def test_stiff_motion_backward_in_time_is_detected():
    """x'' = -x + 1e4 x' from 0 to -10 s."""
    damped = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2,
        ("x",),
        forces=(jl.GeneralizedForce(lambda t, q, v, p: 1e4 * v, "push"),),
    )
    motion = jl.simulate(damped, [1.0], [0.0], [0.0, -10.0], max_steps=300)
    assert motion.method == "kvaerno5"
    np.testing.assert_allclose(motion.q[-1, 0], np.exp(-10.0 / 1e4), rtol=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("method", ["dopri5", "gauss4"])
def test_tables_far_from_time_zero_are_read_accurately(method):
    """A slope of 1e9 N/s over a millisecond; times in seconds since 1901."""
    start, length = 2.0**31, 2.0**-10
    table = jl.LinearInterpolation([start, start + length], [0.0, 1e6])
    motion = moved(table, [start, start + length], method=method, dt=1e-6, max_steps=2000)
    np.testing.assert_allclose(motion.v[-1, 0], 0.2 + 0.5e6 * length, rtol=1e-12)


def test_motion_that_cannot_start_has_nan_saves():
    table = jl.ZeroOrderHold([-1.0, 1.0], [0.0, 0.0])
    motion = jax.jit(lambda ts: moved(table, ts))(jnp.array([0.0, -0.5, 1.0]))
    assert motion.status == jl.Status.bad_value
    assert np.isnan(motion.q[1:]).all()


@pytest.mark.full
def test_steps_of_a_gradient_by_a_table_do_not_depend_on_its_size():
    """Its loops compute no array of the size of the table; they only write into one."""
    size = 777

    def end(values):
        table = jl.LinearInterpolation(jnp.linspace(0.0, 1.0, size), values)
        return moved(table, [0.0, 0.5, 1.0]).q[-1, 0]

    program = loop(operations(jax.grad(end), jnp.zeros(size), iterations=1))
    written = {"dynamic_update_slice", "while", "cond", "jit", "scan"}
    written |= {"custom_jvp_call", "custom_vmap_call"}
    large = {o.name for o in program if any(size <= k <= size + 3 for x in o.shapes for k in x)}
    assert large <= written
    assert "dynamic_update_slice" in large
