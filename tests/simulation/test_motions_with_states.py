"""Motions with states beside (q, v), against diffrax on the whole equations."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

TS = jnp.linspace(0.0, 3.0, 31)
TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def by_diffrax(field, y0, params, ts=TS):
    """dy/dt = field(t, y, params) at ts, to 1e-12."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        ts[0],
        ts[-1],
        None,
        y0,
        params,
        saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
        max_steps=100_000,
    )
    return solution.ys


def whole(motion):
    return jnp.concatenate([motion.q, motion.v, motion.x], axis=-1)


# An arm driven by a motor with an electrical time constant L / R.
ARM = {"J": 0.01, "m": 0.2, "l": 0.3, "R": 1.0, "k": 0.3, "L": 0.05, "b": 0.01}


def current_rate(t, q, v, x, params, inputs):
    voltage = inputs["voltage"] - params["k"] * v - params["R"] * x
    return voltage / params["L"]


def motor(t, q, v, params, inputs):
    return params["k"] * inputs["current"][None] - params["b"] * v


arm = jl.System(
    lambda t, q, v, p: 0.5 * p["J"] * v[0] ** 2 + 9.81 * p["m"] * p["l"] * jnp.cos(q[0]),
    ("angle",),
    forces=(jl.GeneralizedForce(motor, "motor"),),
    states=jl.States(current_rate, ("current",)),
)
SINE = {"voltage": jl.TimeFunction(lambda t: 3.0 * jnp.sin(2.0 * t))}


def arm_field(t, y, p):
    angle, w, i = y
    torque = p["k"] * i - p["b"] * w - 9.81 * p["m"] * p["l"] * jnp.sin(angle)
    return jnp.stack(
        [w, torque / p["J"], (3.0 * jnp.sin(2 * t) - p["R"] * i - p["k"] * w) / p["L"]]
    )


@pytest.fixture(scope="module")
def right():
    return by_diffrax(arm_field, jnp.array([1.0, 0.0, 0.2]), ARM)


def swing(params=ARM, x0=(0.2,), **options):
    x0 = jnp.asarray(x0)
    return jl.simulate(arm, [1.0], [0.0], TS, params, x0=x0, inputs=SINE, **options)


@pytest.mark.parametrize(
    ("method", "most"),  # twice the largest error measured, in tolerances of 1e-9
    [
        ("auto", 2.1),
        pytest.param("tsit5", 5.0, marks=pytest.mark.full),
        pytest.param("prince9", 1.4, marks=pytest.mark.full),
        pytest.param("kvaerno5", 81.0, marks=pytest.mark.full),
        pytest.param("bosh3", 415.0, marks=pytest.mark.full),
    ],
)
def test_a_motor_with_an_electrical_time_constant(right, method, most):
    motion = swing(method=method)
    assert motion.message() == "ok at t = 3.0"
    assert jnp.max(jnp.abs(whole(motion) - right)) < most * 1e-9


@pytest.mark.full
def test_what_a_motion_says_of_its_states(right):
    motion = swing(save=("work", "state_rates"))
    np.testing.assert_array_equal(motion["current"], motion.x[:, 0])
    rates = jax.vmap(lambda t, y: arm_field(t, y, ARM))(TS, whole(motion))
    np.testing.assert_allclose(motion.rate("current"), rates[:, 2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(motion.a, rates[:, 1:2], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(motion.saved["state_rates"], motion.state_rates)
    np.testing.assert_array_equal(motion.last_x, motion.x[-1])
    assert set(motion.input_values) == {"voltage"}
    assert set(motion.to_dict()) >= {"angle", "angle'", "current"}
    # the work of the motor is that of its torque, by the balance of energy
    gain = motion.energy - motion.energy[0]
    np.testing.assert_allclose(motion.work["motor"], gain, rtol=0, atol=2e-9)
    between = motion.at(0.33)
    i = by_diffrax(arm_field, jnp.array([1.0, 0.0, 0.2]), ARM, jnp.array([0.0, 0.33]))[1, 2]
    assert abs(between["current"][0] - i) < 5e-9
    assert "current" in motion.explain() or "d(angle)/dt" in motion.explain()


@pytest.mark.full
def test_derivatives_in_params_and_the_start_of_states():
    """Forward, reverse, and those of diffrax through its own steps at 1e-12."""

    def loss(params, x0):
        motion = swing(params, x0, **TIGHT)
        return motion.q[-1, 0] ** 2 + motion.x[-1, 0] * motion.v[20, 0]

    def reference(params, x0):
        y = by_diffrax(arm_field, jnp.concatenate([jnp.array([1.0, 0.0]), x0]), params)
        return y[-1, 0] ** 2 + y[-1, 2] * y[20, 1]

    at = ARM, jnp.array([0.2])
    forward, reverse, right = (
        d(f, (0, 1))(*at) for d, f in ((jax.jacfwd, loss), (jax.grad, loss), (jax.grad, reference))
    )
    for a, b, c in zip(*map(jax.tree.leaves, (forward, reverse, right)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(b, c, rtol=5e-9, atol=1e-11)


@pytest.mark.full
def test_a_batch_over_the_start_of_states(right):
    starts = jnp.array([[0.0], [0.2], [1.0]])
    motions = jax.vmap(lambda x0: swing(ARM, x0))(starts)
    np.testing.assert_allclose(whole(motions[1]), whole(swing()), rtol=0, atol=2e-9)
    assert motions["current"].shape == (3, 31)
    chosen = motions[np.array([True, False, True])]
    np.testing.assert_array_equal(chosen.x, motions.x[np.array([0, 2])])
    assert motions.last_x.shape == (3, 1)


def test_a_tolerance_of_its_own():
    """A bound on the current alone takes more steps, and makes it more accurate."""
    by_name = swing(rtol=0.0, atol={"angle": 1e-4, "current": 1e-11})
    flat = swing(rtol=0.0, atol=[1e-4, 1e-11])
    loose = swing(rtol=0.0, atol=[1e-4, 1e-4])
    np.testing.assert_array_equal(by_name.x, flat.x)
    assert flat.stats["accepted"] > 2 * loose.stats["accepted"]


def test_a_rate_that_is_not_finite_is_named():
    broken = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2,
        ("x",),
        states=jl.States(lambda t, q, v, x, p: jnp.log(1.0 - t) * jnp.ones(1), ("level",)),
    )
    motion = jl.simulate(broken, [0.0], [1.0], [0.0, 2.0], x0=[0.0], throw=False)
    assert motion.status == jl.Status.nonfinite
    assert "`rate` of states, by log at test_motions_with_states.py" in motion.message()
    assert 0.9 < motion.last_time <= 1.0


def test_a_state_that_grows_beyond_bounds_is_named():
    """x' = x^2 beside an oscillator that is not concerned."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - 4.5 * q[1] ** 2,
        ("y", "z"),
        states=jl.States(lambda t, q, v, x, p: x**2, ("level",)),
    )
    motion = jl.simulate(system, [0.0, 1.0], [0.0, 0.0], [0.0, 2.0], x0=[1.0], throw=False)
    assert motion.message().startswith("step_below_resolution ('level'): last good state at t = 1")
    assert "v = [" in motion.message()
    assert ", x = [" in motion.message()


def test_errors_of_states_are_estimated(right):
    motion = swing(rtol=1e-6, atol=1e-6, estimate_error=True)
    error = jnp.abs(motion.x - right[:, 2:])
    assert motion.error[2].shape == motion.x.shape
    assert jnp.all(error <= motion.error[2] + 1e-13)
    assert jnp.max(motion.error[2]) < 100 * jnp.max(error)


# A cart on a slope held by a PID controller, whose integrator is a state.
CART = {"m": 1.5, "slope": 0.2, "kp": 40.0, "ki": 30.0, "kd": 12.0, "to": 0.7}


def control(t, q, v, params, inputs):
    error = params["to"] - q
    return params["kp"] * error + params["ki"] * inputs["integral"][None] - params["kd"] * v


cart = jl.System(
    lambda t, q, v, p: 0.5 * p["m"] * v[0] ** 2 - 9.81 * p["m"] * jnp.sin(p["slope"]) * q[0],
    ("x",),
    forces=(jl.GeneralizedForce(control, "PID"),),
    states=jl.States(lambda t, q, v, x, p: p["to"] - q, ("integral",)),
)


@pytest.mark.full
def test_a_pid_controller_with_its_integrator():
    def field(t, y, p):
        x, v, integral = y
        force = p["kp"] * (p["to"] - x) + p["ki"] * integral - p["kd"] * v
        return jnp.stack([v, force / p["m"] - 9.81 * jnp.sin(p["slope"]), p["to"] - x])

    ts = jnp.linspace(0.0, 20.0, 21)
    motion = jl.simulate(cart, [0.0], [0.0], ts, CART, x0={"integral": 0.0})
    right = by_diffrax(field, jnp.zeros(3), CART, ts)
    assert jnp.max(jnp.abs(whole(motion) - right)) < 4e-9
    # at rest the integrator alone carries the weight: no error remains
    assert abs(motion["x"][-1] - CART["to"]) < 1e-6
    weight = 9.81 * CART["m"] * np.sin(CART["slope"])
    assert abs(CART["ki"] * motion["integral"][-1] - weight) < 1e-5
    # the states are those of one control interval after the other
    q, v, x = jl.step(cart, motion.q[3], motion.v[3], 1.0, CART, x=motion.x[3], steps=400)
    np.testing.assert_allclose(jnp.concatenate([q, v, x]), right[4], rtol=0, atol=2e-9)
    # a state of rest holds the integrator at a given value
    held = jl.equilibrium(cart, [0.0], CART, inputs={"integral": weight / CART["ki"]})
    assert abs(held.q[0] - CART["to"]) < 1e-9


# A motor whose winding and housing warm up, with a resistance that depends on the temperature.
WARM = {"J": 0.02, "k": 0.4, "R": 0.8, "alpha": 0.004, "load": 0.05, "L": 0.02}


def warm_rates(t, q, v, x, params, inputs):
    i, winding, housing = x
    R = params["R"] * (1.0 + params["alpha"] * winding)
    flow = 1.5 * (winding - housing)
    return jnp.stack(
        [
            (inputs["voltage"] - R * i - params["k"] * v[0]) / params["L"],
            (R * i**2 - flow) / 3.0,
            (flow - 0.6 * housing) / 12.0,
        ]
    )


warm = jl.System(
    lambda t, q, v, p: 0.5 * p["J"] * v[0] ** 2,
    ("angle",),
    forces=(
        jl.GeneralizedForce(lambda t, q, v, p, inputs: p["k"] * inputs["i"][None], "motor"),
        jl.GeneralizedForce(lambda t, q, v, p: -p["load"] * v, "load"),
    ),
    states=jl.States(warm_rates, {"i": (), "T": 2}),
)


@pytest.mark.full
def test_a_motor_that_warms_up():
    """In a batch of one direction and the other; backwards it returns to its start."""

    def field(t, y, p):
        angle, v, *x = y
        rates = warm_rates(
            t, jnp.array([angle]), jnp.array([v]), jnp.stack(x), p, {"voltage": 12.0}
        )
        return jnp.concatenate([jnp.stack([v, (p["k"] * x[0] - p["load"] * v) / p["J"]]), rates])

    x0 = {"i": 0.0, "T": jnp.array([5.0, 2.0])}
    options = {"inputs": {"voltage": 12.0}}
    motion = jl.simulate(warm, [0.0], [0.0], TS, WARM, x0=x0, **options)
    right = by_diffrax(field, jnp.array([0.0, 0.0, 0.0, 5.0, 2.0]), WARM)
    assert jnp.max(jnp.abs(whole(motion) - right) / (1.0 + jnp.abs(right))) < 5e-9
    assert motion["T"].shape == (31, 2)
    assert motion.rate("T").shape == (31, 2)
    end = motion.q[-1], motion.v[-1]
    short = jl.simulate(warm, *end, [3.0, 2.9], WARM, x0=motion.x[-1], **options)
    assert jnp.max(jnp.abs(whole(short)[-1] - right[29])) < 1e-6  # growth by exp(0.1 R / L)


# A sleigh with a motor: constraints, quasi-velocities and states together.
sleigh = jl.System(
    lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2) + 0.05 * v[2] ** 2,
    ("x", "y", "angle"),
    forces=(
        jl.GeneralizedForce(
            lambda t, q, v, p, inputs: (
                inputs["i"] * jnp.stack([jnp.cos(q[2]), jnp.sin(q[2]), 0.02 * jnp.ones(())])
            ),
            "motor",
        ),
    ),
    quasi=jl.QuasiVelocities(
        lambda t, q, v, p: jnp.stack(
            [
                v[0] * jnp.cos(q[2]) + v[1] * jnp.sin(q[2]),
                v[2],
                -v[0] * jnp.sin(q[2]) + v[1] * jnp.cos(q[2]),
            ]
        ),
        names=("forward", "turn", "side"),
        constrained=("side",),
    ),
    states=jl.States(lambda t, q, v, x, p: 2.0 - x - 0.3 * jnp.hypot(v[0], v[1]), ("i",)),
)


@pytest.mark.full
def test_states_in_quasi_velocities_and_by_multipliers():
    def field(t, y, p):
        _, _, angle, forward, turn, i = y
        return jnp.stack(
            [
                forward * jnp.cos(angle),
                forward * jnp.sin(angle),
                turn,
                i,
                0.2 * i,
                2.0 - i - 0.3 * jnp.abs(forward),
            ]
        )

    right = by_diffrax(field, jnp.array([0.0, 0.0, 0.3, 0.5, 0.0, 0.1]), None)
    v0 = [0.5 * np.cos(0.3), 0.5 * np.sin(0.3), 0.0]
    for formulation in ("quasi", "multipliers"):
        motion = jl.simulate(sleigh, [0.0, 0.0, 0.3], v0, TS, x0=[0.1], formulation=formulation)
        assert motion.ok
        assert jnp.max(jnp.abs(motion.q - right[:, :3])) < 2e-8
        assert jnp.max(jnp.abs(motion.x[:, 0] - right[:, 5])) < 2e-8
        assert jnp.max(jnp.abs(motion.u[:, :2] - right[:, 3:5])) < 2e-8
        # the knife edge carries the centripetal force m v w
        np.testing.assert_allclose(motion.lam["side"], right[:, 3] * right[:, 4], rtol=0, atol=5e-8)


@pytest.mark.full
def test_states_in_float32():
    f32 = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)  # noqa: E731
    params, ts = f32(ARM), jnp.linspace(0.0, 3.0, 4)
    motion = jl.simulate(
        arm, f32([1.0]), f32([0.0]), ts, params, x0=f32([0.2]), inputs={"voltage": f32(1.0)}
    )
    assert motion.ok
    assert motion.x.dtype == jnp.float32


@pytest.mark.full
@pytest.mark.parametrize(
    ("rate", "most"),  # twice the largest error measured
    [(5.0, 2e-12), (50.0, 3e-9), (200.0, 2e-7)],
)
def test_states_saved_at_a_change_point_are_accurate(rate, most):
    """A parallelogram that becomes flat, beside x = sin(w t) with w far above its own rates."""

    def closed(t, q, p):
        a, c, b = q
        x = jnp.cos(a) + 2 * jnp.cos(c) - 2 - jnp.cos(b)
        return jnp.stack([x, jnp.sin(a) + 2 * jnp.sin(c) - jnp.sin(b)])

    linkage = jl.System(
        lambda t, q, v, p: 0.5 * v @ v,
        ("a", "c", "b"),
        constraints=(jl.Holonomic(closed, ("x", "y")),),
        states=jl.States(lambda t, q, v, x, p: p * jnp.cos(p * t) * jnp.ones(1), ("i",)),
    )
    flat = np.pi - 0.5
    ts = jnp.array([0.0, flat - 1e-3, flat, flat + 1e-4, 4.0])
    motion = jl.simulate(linkage, [0.5, 0.0, 0.5], [1.0, 0.0, 1.0], ts, rate, x0=[0.0])
    assert motion.ok
    np.testing.assert_allclose(motion.x[:, 0], jnp.sin(rate * ts), rtol=0, atol=most)
