"""simulate and Solution in use: statuses, shapes, caching, saved quantities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.problems import MOTIONS, driven, steps

import jaxlag as jl
from jaxlag import SimulationError, Status
from jaxlag._simulation._simulate import _simulate
from systems import mass_spring

PENDULUM = MOTIONS["double_pendulum"]


def run(**changes):
    arguments = {
        "q0": PENDULUM.q0,
        "v0": PENDULUM.v0,
        "ts": jnp.linspace(0.0, 1.0, 5),
        "params": PENDULUM.params,
    } | changes
    return jl.simulate(PENDULUM.system, **arguments)


def test_small_oscillation_has_its_closed_form():
    """To the default tolerance of 1e-9."""
    spring, params = mass_spring.entry, {"m": 1.3, "k": 20.0}
    ts = np.linspace(0.0, 3.0, 31)
    motion = jl.simulate(spring.system, {"x": 0.4}, [0.5], ts, params)
    x, x_rate = spring.exact(ts, 0.4, 0.5, params)
    np.testing.assert_allclose(motion["x"], x, atol=2e-8)
    np.testing.assert_allclose(motion.rate("x"), x_rate, atol=1e-7)
    np.testing.assert_allclose(motion.a[:, 0], -20.0 / 1.3 * motion["x"], rtol=1e-13)


@pytest.mark.full
def test_saved_quantities_equal_those_on_demand():
    names = ("a", "p", "energy", "kinetic", "potential", "Q")
    plain, saved = run(), run(save=names)
    assert set(saved.saved) == set(names)
    for name in names:
        np.testing.assert_allclose(saved.saved[name], getattr(plain, name), rtol=1e-12, atol=1e-12)


def test_unrequested_quantities_are_not_computed():
    """save=("potential",) evaluates the marker in V at saves; without it there are fewer."""

    def count(save):
        jaxpr = jax.make_jaxpr(lambda q0: run(q0=q0, save=save, throw=False).q)(PENDULUM.q0)
        return str(jaxpr).count("cos ")

    assert count(("potential",)) > count(())


@pytest.mark.full
def test_array_coordinates():
    """Two masses in the plane on springs to the origin: names return arrays of their shapes."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 0.5 * p * jnp.sum(q**2),
        {"x": (2, 2), "theta": ()},
    )
    motion = jl.simulate(system, {"x": np.eye(2), "theta": 0.3}, np.zeros(5), [0.0, 0.5, 1.0], 4.0)
    assert motion["x"].shape == (3, 2, 2)
    np.testing.assert_allclose(motion["x"][-1], np.cos(2.0) * np.eye(2), atol=1e-8)
    with pytest.raises(ValueError, match=r"`name` must be one of \['x', 'theta'\], but it was 'y'"):
        motion["y"]


def test_new_values_do_not_recompile():
    compiled = _simulate.programs

    def lagrangian(t, q, v, p):
        return 0.5 * p["m"] * v[0] ** 2 - p["V"](q[0]) * p["k"]

    system = jl.System(lagrangian, ("x",))
    shape = lambda x: x**4  # noqa: E731

    def go(m=1.0, q=0.5, v=0.0, t0=0.0, t1=1.0, **options):
        ts = np.linspace(t0, t1, 4)
        return jl.simulate(system, [q], [v], ts, {"m": m, "k": 2.0, "V": shape}, **options)

    go(rtol=1e-6)
    first = compiled()
    for changes in ({"m": 2.0}, {"q": 0.7}, {"v": 1.0}, {"t0": 0.1}, {"t1": 3.0}):
        go(rtol=1e-6, **changes)
    go(rtol=1e-7, atol=9e-5)  # from 1e-8 downwards "auto" chooses another method
    assert compiled() == first
    go(dt=0.1)
    fixed = compiled()
    go(dt=0.2)
    assert compiled() == fixed == first + 1


def test_no_host_callback_in_any_program():
    def everything(q0):
        loss = lambda q0: jnp.sum(run(q0=q0, save=("energy",)).saved["energy"])  # noqa: E731
        return jax.value_and_grad(loss)(q0)

    for f in (
        everything,
        lambda q0: run(q0=q0, method="kvaerno5").q,
        lambda q0: run(q0=q0, dt=0.1).q,
    ):
        assert "callback" not in str(jax.make_jaxpr(f)(PENDULUM.q0))


def test_max_steps_reports_the_last_time():
    with pytest.raises(
        SimulationError, match=r"max_steps: last good state at t = 0\.\d+ of 1"
    ) as e:
        run(max_steps=3)
    motion = e.value.motion
    assert motion.stats["accepted"] + motion.stats["rejected"] == 3
    reached = np.asarray(motion.ts) <= motion.last_time
    assert np.isfinite(motion.q[reached]).all()
    assert np.isnan(motion.q[~reached]).all()


def test_force_that_becomes_nan_ends_the_motion():
    """The last good time is just before the force ends, and the coordinate is named."""
    force = jl.GeneralizedForce(lambda t, q, v, p: jnp.stack([0.0 * t, jnp.sqrt(p - t)]), "burn")
    system = jl.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2), ("x", "y"), forces=(force,))
    with pytest.raises(
        SimulationError, match=r"nonfinite \('y'\): last good state at t = 0\.\d+"
    ) as e:
        jl.simulate(system, [0.0, 0.0], [1.0, 0.0], np.linspace(0.0, 2.0, 9), 0.7)
    motion = e.value.motion
    assert abs(motion.last_time - 0.7) < 1e-6
    np.testing.assert_allclose(motion.last_state[0][0], motion.last_time, rtol=1e-12)
    with pytest.raises(SimulationError, match=r"nonfinite \('y'\)"):
        jl.simulate(system, [0.0, 0.0], [1.0, 0.0], [0.0, 2.0], 0.7, dt=0.1)


def fades(t, q, v):
    return jnp.sqrt(0.8 - v[1])


def flickers(t, q, v):
    return jnp.where((t > 1.04) & (t < 1.06), jnp.nan, 1.0)


def ends(t, q, v):
    return jnp.sqrt(0.8 - q[1])


@pytest.mark.full
@pytest.mark.parametrize(
    ("law", "options"),
    [
        (fades, {}),
        (fades, {"method": "tsit5", "dt": 0.1}),
        (flickers, {"method": "dopri8", "dt": 0.1}),
        (flickers, {"method": "variational4", "dt": 0.1}),
        (ends, {"method": "kvaerno5"}),
    ],
)
def test_force_that_fails_inside_a_step_is_named(law, options):
    """A force of velocity, time or position may fail between the ends of a step.

    Another coordinate has the larger acceleration.
    """
    force = jl.GeneralizedForce(
        lambda t, q, v, p: jnp.stack([0.0 * t, 0.3 + 1e-3 * law(t, q, v)]), "law"
    )
    system = jl.System(
        lambda t, q, v, p: 0.5 * (v @ v) - 50.0 * q[0] ** 2, ("x", "y"), forces=(force,)
    )
    start = [1.0, 0.0], [0.0, 0.5]
    motion = jl.simulate(system, *start, [0.0, 3.0], {}, throw=False, **options)
    assert motion.status == Status.nonfinite
    assert motion.where == 1
    assert "nonfinite ('y')" in motion.message()


def test_overflow_does_not_name_an_unrelated_coordinate():
    """The coordinate whose steps are unstable, or none: all that depends on it overflows, too."""
    system = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 5e5 * q[0] ** 2 - q[0] * q[1], ("x", "y"))
    motion = jl.simulate(
        system, [1.0, 0.0], [0.0, 0.0], [0.0, 9.0], {}, method="tsit5", dt=0.05, throw=False
    )
    assert motion.status == Status.nonfinite
    assert motion.where in (-1, 0)


def test_vanishing_mass_ends_the_motion():
    """A mass m(x) that reaches zero at x = 1, approached at unit rate."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 + 0.5 * (1 - q[0]) * v[1] ** 2, ("x", "y")
    )
    motion = jl.simulate(system, [0.0, 0.0], [1.0, 0.0], [0.0, 0.5, 2.0], dt=0.03, throw=False)
    assert motion.status == Status.mass_singular
    assert motion.where == 1
    assert 0.9 < motion.last_time <= 1.0


def test_collision_is_a_status_with_a_time():
    """Kepler fall from r = 1 at rest: r = 0 at pi / (2 sqrt 2)."""
    fall = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + p / q[0], ("r",))
    motion = jl.simulate(fall, [1.0], [0.0], [0.0, 1.0, 2.0], 1.0, throw=False)
    assert motion.status in (Status.step_below_resolution, Status.nonfinite, Status.max_steps)
    assert abs(motion.last_time - np.pi / (2 * np.sqrt(2))) < 1e-6
    assert np.isfinite(motion.q[1]).all()
    assert np.isnan(motion.q[2]).all()


@pytest.mark.full
def test_traced_invalid_values_become_statuses():
    def status(q0=PENDULUM.q0, ts=(0.0, 1.0), **options):
        go = jax.jit(lambda q0, ts, o: run(q0=q0, ts=ts, **o).status)
        return go(q0, jnp.asarray(ts), options)

    assert status() == Status.ok
    assert status(q0=jnp.array([jnp.nan, 0.0])) == Status.bad_value
    assert status(ts=(1.0, 1.0)) == Status.bad_value
    assert status(ts=(0.0, jnp.inf)) == Status.bad_value
    assert status(rtol=-1.0) == Status.bad_value
    assert status(rtol=1e-16) == Status.bad_value
    assert status(rtol=0.0, atol=0.0) == Status.bad_value
    assert status(dt=-0.1) == Status.bad_value
    invalid = jax.jit(lambda q0: run(q0=q0, throw=False))(jnp.array([0.1, jnp.nan]))
    assert invalid.where == 1
    assert np.isnan(invalid.q[1:]).all()


def test_times_beyond_tables_are_refused_or_get_a_status():
    arguments = (driven, [0.4], [0.9])
    params = {"J": 0.15, "mgl": 3.0, "c": 0.02, "F": 0.1}
    inputs = {"tau": steps()}
    with pytest.raises(
        ValueError,
        match=r"`inputs` must cover ts, from 0.0 to 2.0 s, but their tables cover 0.0 to 1.6",
    ):
        jl.simulate(*arguments, [0.0, 2.0], params, inputs=inputs)
    late = jax.jit(lambda ts: jl.simulate(*arguments, ts, params, inputs=inputs))
    motion = late(jnp.array([0.0, 1.0, 2.0]))
    assert motion.status == Status.input_range
    np.testing.assert_allclose(motion.last_time, 1.6, rtol=1e-15)
    assert np.isfinite(motion.q[1]).all()
    early = late(jnp.array([-1.0, 1.0, 1.5]))
    assert early.status == Status.input_range
    assert early.last_time == -1.0
    with pytest.raises(ValueError, match="have an entry 'tau', which a declared function reads"):
        jl.simulate(*arguments, [0.0, 1.0], params)


@pytest.mark.parametrize(
    ("signal", "x", "a"),
    [
        pytest.param(
            jl.TimeFunction(lambda t: jnp.cos(t)),
            2 - np.cos(1.0),
            np.cos(1.0),
            marks=pytest.mark.full,
        ),
        pytest.param(
            jl.TimeFunction(lambda t, params: params * jnp.cos(t)),
            3 - 2 * np.cos(1.0),
            2 * np.cos(1.0),
            marks=pytest.mark.full,
        ),
        pytest.param(
            jl.Feedback(lambda t, q, v, params: -q[0]),
            np.cos(1.0),
            -np.cos(1.0),
            marks=pytest.mark.full,
        ),
        (0.5, 1.25, 0.5),
    ],
)
def test_signals_other_than_tables_are_integrated(signal, x, a):
    """Unit mass from x = 1 at rest over 1 s under cos t, 2 cos t, -x and 1/2."""
    push = jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["u"][None], "push")
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(push,))

    def go(q0):
        return jl.simulate(system, q0, [0.0], [0.0, 0.3, 1.0], 2.0, inputs={"u": signal})

    motion = go(jnp.array([1.0]))
    np.testing.assert_allclose(motion.q[-1], [x], rtol=1e-8)
    np.testing.assert_allclose(motion.a[-1], [a], rtol=1e-8)
    np.testing.assert_array_equal(motion.Q, motion.a)
    batch = jax.jit(jax.vmap(go))(jnp.ones((2, 1)))
    np.testing.assert_allclose(batch.a[:, -1], [[a], [a]], rtol=1e-8)
    assert set(motion.inputs) == {"u"}


def test_float32_state_under_a_force_of_time_stays_float32():
    """Time is float64; the force is cast to the state, adaptive and fixed."""
    push = jl.GeneralizedForce(lambda t, q, v, p: jnp.cos(t)[None], "push")
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(push,))
    start = np.float32([1.0]), np.float32([0.0])
    for options in ({}, {"dt": 0.05}):
        motion = jl.simulate(system, *start, [0.0, 0.5, 1.0], **options)
        assert motion.q.dtype == jnp.float32
        np.testing.assert_allclose(motion.q[-1], [2 - np.cos(1.0)], rtol=1e-5)


def test_wrapped_solver_agrees():
    import diffrax

    motion = run(method=diffrax.HalfSolver(diffrax.Tsit5()), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(motion.q, run().q, rtol=0, atol=1e-5)


@pytest.mark.full
def test_batched_solution_equals_single_ones():
    starts = PENDULUM.q0 + jnp.linspace(0.0, 0.1, 3)[:, None]
    motions = jax.jit(jax.vmap(lambda q0: run(q0=q0)))(starts)
    assert motions.q.shape == (3, 5, 2)
    assert motions["theta1"].shape == (3, 5)
    assert motions.energy.shape == (3, 5)
    for i, q0 in enumerate(starts):
        one = run(q0=q0)
        np.testing.assert_allclose(motions.energy[i], one.energy, rtol=1e-7)
        np.testing.assert_allclose(motions.a[i], one.a, rtol=1e-6, atol=1e-6)


def test_explicit_controller_is_used_and_checked():
    import diffrax

    controller = diffrax.PIDController(rtol=1e-7, atol=1e-7, pcoeff=0.3, icoeff=0.4)
    motion = run(method=(diffrax.Dopri5(), controller))
    np.testing.assert_allclose(motion.q, run().q, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="`dt` must be left out when method has a controller"):
        run(method=(diffrax.Dopri5(), controller), dt=0.1)
    with pytest.raises(ValueError, match="`rtol` and `atol` must be left out when method has"):
        run(method=(diffrax.Dopri5(), controller), rtol=1e-3)
    negative = diffrax.PIDController(rtol=-1.0, atol=1e-6)
    with pytest.raises(
        ValueError, match=r"`rtol` must be finite and not negative, but it was -1\.0"
    ):
        run(method=(diffrax.Dopri5(), negative))
    clipped = diffrax.ClipStepSizeController(controller, jump_ts=jnp.array([0.5]))
    with pytest.raises(ValueError, match=r"`method\[1\]` must have no times"):
        run(method=(diffrax.Dopri5(), clipped))


@pytest.mark.full
def test_solvers_agree_to_the_tolerance():
    """Five solvers agree within a hundred times the tolerance over a second."""
    truth = run(rtol=1e-13, atol=1e-13)
    for method in ("bosh3", "tsit5", "dopri5", "dopri8", "kvaerno4"):
        motion = run(method=method, rtol=1e-6, atol=1e-6)
        # Measured 2026-11-21: at most 2e-5, bosh3.
        np.testing.assert_allclose(motion.q, truth.q, rtol=0, atol=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_failure_under_an_eager_derivative_raises_an_error(mode):
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2, ("x",))

    def end(k):
        options = {"max_steps": 20, "method": "dopri8"}
        return jl.simulate(system, [1.0], [0.0], [0.0, 10.0], {"k": k}, **options)["x"][-1]

    with pytest.raises(SimulationError, match=r"max_steps: last good state at t = 4\.\d+ of 10"):
        mode(end)(4.0)
