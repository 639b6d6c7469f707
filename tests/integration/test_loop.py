"""The loop: order, accuracy of saves, steps that end on knots, fixed grids, lanes, direction."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.problems import MOTIONS, driven, steps

import jaxlag as jl

PENDULUM = MOTIONS["double_pendulum"]


@pytest.fixture(scope="module")
def reference(lowering):
    """The double pendulum over 4 s, at rtol = atol = 1e-13, with 501 saves."""
    return run(np.linspace(0.0, 4.0, 501), rtol=1e-13, atol=1e-13)


def run(ts, **options):
    return jl.simulate(PENDULUM.system, PENDULUM.q0, PENDULUM.v0, ts, PENDULUM.params, **options)


def error(motion, reference):
    return np.maximum(
        np.abs(motion.q - reference.q).max(axis=1), np.abs(motion.v - reference.v).max(axis=1)
    )


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "order", "h"), [("midpoint", 2, 2e-3), ("bosh3", 3, 1e-2), ("tsit5", 5, 5e-2)]
)
def test_order_equals_the_slope_of_errors(method, order, h):
    """Error at t = 12 of a central motion for a fixed step that is halved twice.

    Order 8 has no such range in float64: its leading coefficient is so small that the error is
    rounding (1e-14) before it stops falling like h^9.
    """
    motion, ts = MOTIONS["central_motion"], np.array([0.0, 12.0])

    def end(**options):
        m = jl.simulate(
            motion.system, motion.q0, motion.v0, ts, motion.params, max_steps=30_000, **options
        )
        return np.concatenate([m.q[-1], m.v[-1]])

    truth = end(rtol=1e-14, atol=1e-14)
    errors = [np.linalg.norm(end(method=method, dt=h / 2**k) - truth) for k in range(3)]
    slope = np.log2(errors[0] / errors[2]) / 2
    assert abs(slope - order) < 0.1, (slope, errors)


@pytest.mark.full
@pytest.mark.parametrize(
    "method",
    ["dopri8", "tsit5", "bosh3", "kvaerno5"],
)
def test_saves_are_as_accurate_as_step_ends(reference, method):
    """501 saves: the largest error is at most twice the largest at the ends of the same steps.

    The ends of the steps are the saves of a solve with these save times.
    """
    tolerance = 1e-5 if method in ("bosh3", "kvaerno5") else 1e-8
    options = {"rtol": tolerance, "atol": tolerance, "method": method}
    ends = step_ends(options)
    at_ends = run(ends, **options)
    truth = run(ends, rtol=1e-13, atol=1e-13)
    assert at_ends.stats["accepted"] == len(ends) - 1
    errors_of_saves = error(run(reference.ts, **options), reference)
    assert errors_of_saves.max() <= 2 * error(at_ends, truth).max()


def step_ends(options):
    """Times of the accepted steps of an adaptive solve, from its recorded grid."""
    from jaxlag._gradient import _differentiable_solve
    from jaxlag._simulation import _simulate

    caught = []

    def catch(plan, values):
        caught.append((plan, values))
        raise StopIteration

    catch.programs = lambda: 0
    original = _simulate._simulate
    _simulate._simulate = catch
    try:
        run(np.array([0.0, 4.0]), **options)
    except StopIteration:
        plan, values = caught[0]
    finally:
        _simulate._simulate = original
    values = jax.tree.map(jnp.asarray, values)

    @jax.jit
    def record(values):
        problem = _differentiable_solve.split(_simulate.build_problem(plan, values)[2])
        return _differentiable_solve._recorded(problem).record

    recorded = record(values)
    # An iteration that was not accepted ends where the last one did; the stop has a negative
    # offset.
    ends = np.asarray(recorded.offsets)[: int(recorded.steps)]
    return np.unique([0.0, *np.where(ends < 0, 4.0, ends)])


@pytest.mark.full
def test_saves_need_no_additional_steps(reference):
    few, many = run(np.array([0.0, 4.0])), run(reference.ts)
    assert many.stats["accepted"] == few.stats["accepted"]
    assert many.stats["rejected"] == few.stats["rejected"]
    np.testing.assert_array_equal(many.last_state[0], many.q[-1])
    # Two programs round differently: 1.2e-14, below the growth of rounding in this motion.
    growth, steps = jl.lyapunov(many), int(many.stats["accepted"])
    floor = np.finfo(float).eps * float(growth.kappa[-1]) * np.sqrt(steps)
    np.testing.assert_allclose(many.q[-1], few.q[-1], rtol=floor)


@pytest.mark.full
def test_backward_motion_retraces_the_forward_one(reference):
    backward = jl.simulate(
        PENDULUM.system, reference.q[-1], reference.v[-1], reference.ts[::-1], PENDULUM.params
    )
    assert backward.last_time == 0.0
    np.testing.assert_allclose(backward.q[::-1], reference.q, rtol=0, atol=1e-7)
    traced = jax.jit(
        lambda ts: (
            jl.simulate(PENDULUM.system, reference.q[-1], reference.v[-1], ts, PENDULUM.params).q
        )
    )
    np.testing.assert_allclose(traced(reference.ts[::-1]), backward.q, rtol=0, atol=1e-9)


def torque_motion(table, ts, **options):
    """theta(t) under a torque alone: closed form for piecewise constant torque."""
    rotor = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2,
        ("theta",),
        forces=(jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["tau"][None], "motor"),),
    )
    return jl.simulate(rotor, [0.1], [0.2], ts, inputs={"tau": table}, **options)


def held_closed_form(table, t):
    """theta and theta' by summing constant accelerations."""
    theta, rate, now = 0.1, 0.2, float(table.times[0])
    for k in range(len(table.times) - 1):
        span = min(float(table.times[k + 1]), t) - now
        if span <= 0:
            break
        a = float(table.values[k])
        theta, rate, now = theta + rate * span + 0.5 * a * span**2, rate + a * span, now + span
    return theta, rate


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"dt": 0.07},
        pytest.param({"method": "tsit5"}, marks=pytest.mark.full),
        pytest.param({"dt": 0.1, "method": "heun"}, marks=pytest.mark.full),
        pytest.param({"method": "kvaerno5"}, marks=pytest.mark.full),
    ],
)
def test_zero_order_hold_is_exact(options):
    """Quadratic arcs between knots: exact for order 2 and up if no stage reads across a knot."""
    table = steps()
    ts = np.linspace(0.0, 1.55, 32)
    motion = torque_motion(table, ts, **options)
    expected = np.array([held_closed_form(table, t) for t in ts])
    # Newton iterations of the implicit method stop at 1e-2 of its tolerance of 1e-9.
    atol = 1e-10 if options.get("method") == "kvaerno5" else 1e-14
    np.testing.assert_allclose(motion.q[:, 0], expected[:, 0], rtol=0, atol=atol)
    np.testing.assert_allclose(motion.v[:, 0], expected[:, 1], rtol=0, atol=10 * atol)


def test_zero_order_hold_is_exact_backward_in_time():
    table = steps()
    theta, rate = held_closed_form(table, 1.5)
    backward = jl.simulate(
        driven_rotor := jl.System(
            lambda t, q, v, p: 0.5 * v[0] ** 2,
            ("theta",),
            forces=(jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["tau"][None], "m"),),
        ),
        [theta],
        [rate],
        [1.5, 0.5, 0.0],
        inputs={"tau": table},
    )
    assert driven_rotor.size == 1
    np.testing.assert_allclose(
        backward.q[:, 0], [theta, held_closed_form(table, 0.5)[0], 0.1], atol=1e-13
    )
    np.testing.assert_allclose(backward.v[-1], [0.2], atol=1e-13)


def test_linear_input_is_exact():
    """Cubic arcs between knots."""
    times = jnp.array([0.0, 0.3, 0.5, 1.2])
    values = jnp.array([1.0, -2.0, 0.5, 3.0])
    ts = np.linspace(0.0, 1.2, 25)
    motion = torque_motion(jl.LinearInterpolation(times, values), ts)

    def twice_integrated(t):
        theta, rate = 0.1, 0.2
        for a, b, ya, yb in zip(times, times[1:], values, values[1:], strict=False):
            s = min(float(b), t) - float(a)
            if s <= 0:
                break
            slope = float((yb - ya) / (b - a))
            theta += rate * s + 0.5 * float(ya) * s**2 + slope * s**3 / 6
            rate += float(ya) * s + 0.5 * slope * s**2
        return theta

    np.testing.assert_allclose(motion.q[:, 0], [twice_integrated(t) for t in ts], atol=1e-14)


def test_steps_end_on_knots():
    """Eight knots inside: nine steps, none of them rejected for a quadratic arc."""
    motion = torque_motion(steps(), np.array([0.0, 1.6]), method="tsit5", dt0=1.0)
    assert motion.stats["accepted"] == 9
    assert motion.stats["rejected"] == 0


@pytest.mark.parametrize("dt", [0.25, 0.3, 0.0999])
def test_fixed_steps_end_at_the_last_time(dt):
    motion = run(np.array([0.0, 1.0]), dt=dt)
    assert motion.last_time == 1.0
    assert motion.stats["accepted"] == int(np.ceil(1.0 / dt - 1e-9))


def test_fixed_grid_has_an_integer_number_of_steps():
    """10^4 steps of 1e-4 are 10^4 steps, and end at 1 exactly."""
    motion = run(np.array([0.0, 1.0]), dt=1e-4, method="heun")
    assert motion.stats["accepted"] == 10_000
    assert motion.last_time == 1.0


@pytest.mark.full
def test_float32_state_has_float64_time(reference):
    motion = jl.simulate(
        PENDULUM.system,
        PENDULUM.q0.astype(jnp.float32),
        PENDULUM.v0.astype(jnp.float32),
        jnp.linspace(0.0, 4.0, 501),
        {k: jnp.float32(x) for k, x in PENDULUM.params.items()},
    )
    assert motion.q.dtype == motion.v.dtype == motion.energy.dtype == jnp.float32
    assert motion.ts.dtype == jnp.float64
    # rtol 1e-5, atol 1e-6; measured 2026-11-21: 3e-5.
    np.testing.assert_allclose(motion.q, reference.q, rtol=0, atol=3e-4)


@pytest.mark.full
def test_motion_far_from_time_zero_is_accurate(reference):
    """t0 = 1e6: times have a resolution of 1e-10 s; saves lose no more than that."""
    motion = run(1e6 + np.asarray(reference.ts), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(motion.q, reference.q, rtol=0, atol=1e-7)


@pytest.mark.full
def test_derivatives_of_multistep_methods_are_right():
    """A two-step method: the derivative is that of the two-step recurrence."""

    def angle(q0, method):
        ts = [0.0, 0.55, 1.0]
        motion = jl.simulate(
            PENDULUM.system, q0, PENDULUM.v0, ts, PENDULUM.params, dt=0.02, method=method
        )
        return motion.q[-1, 0]

    for method in (diffrax.LeapfrogMidpoint(), diffrax.ReversibleHeun()):
        value = jax.jit(lambda q0, m=method: angle(q0, m))
        slope = jax.jit(jax.grad(lambda q0, m=method: angle(q0, m)))(PENDULUM.q0)
        h = 1e-5
        expected = [
            (value(PENDULUM.q0 + h * e) - value(PENDULUM.q0 - h * e)) / (2 * h) for e in np.eye(2)
        ]
        np.testing.assert_allclose(slope, expected, rtol=1e-8)


@pytest.mark.full
def test_driven_system_matches_scipy():
    """Another integrator and derivation: explicit theta'', restarts at knots."""
    from scipy.integrate import solve_ivp

    table, params = steps(), {"J": 0.15, "mgl": 3.0, "c": 0.02, "F": 0.1}
    motion = jl.simulate(
        driven, [0.4], [0.9], [0.0, 0.5, 1.5], params, inputs={"tau": table}, rtol=1e-12, atol=1e-12
    )
    y, marks = np.array([0.4, 0.9]), [*np.asarray(table.times[:-1]), 1.5]
    for k, (a, b) in enumerate(itertools.pairwise(marks)):
        tau = float(table.values[k])

        def rate(t, y, tau=tau):
            friction = 0.02 * y[1] + 0.1 * np.tanh(y[1] / 0.05)
            return [y[1], (tau - 3.0 * np.sin(y[0]) - friction) / 0.15]

        y = solve_ivp(rate, (a, b), y, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose([motion.q[-1, 0], motion.v[-1, 0]], y, rtol=0, atol=1e-9)


class JumpingController(diffrax.PIDController):
    """A controller that reads the state and reports a jump of the field after every step."""

    def adapt_step_size(self, t0, t1, y0, y1, *rest):
        assert y0.shape == y1.shape == (4,)
        keep, next0, next1, _, state, result = super().adapt_step_size(t0, t1, y0, y1, *rest)
        return keep, next0, next1, jnp.array(True), state, result


class RecordingDopri8(jl.solvers.Dopri8):
    """Records the jumps that are reported to it."""

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        reported_jumps.append(made_jump)
        return super().step(terms, t0, t1, y0, args, solver_state, made_jump)


reported_jumps: list = []


@pytest.mark.full
def test_custom_controller_gets_arrays_and_reports_jumps():
    """A variant of diffrax's controller gets the state as one array; its jumps are passed on."""
    method = (RecordingDopri8(), JumpingController(rtol=1e-9, atol=1e-9))
    motion = run([0.0, 0.5, 1.0], method=method)
    assert len(reported_jumps) > 0
    assert all(jump is not False for jump in reported_jumps)
    plain = run([0.0, 0.5, 1.0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(motion.q, plain.q, rtol=0, atol=1e-8)
