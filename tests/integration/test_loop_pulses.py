"""Pulses and forces that begin, end or jump between steps: resolved, differentiated, reported."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _on_tables import moved

import jaxlag as jl

EPS = np.finfo(float).eps


# ---- Pulses --------------------------------------------------------------------------------------


def kicked(signal, ts, **options):
    """x'' = u(t) from rest."""
    return moved(signal, ts, (0.0, 0.0), {"k": 0.0}, **options)


START, END = 3.0, 3.001


def pulse(t):
    return jnp.where((t >= START) & (t < END), 1000.0, 0.0)


@pytest.mark.full
@pytest.mark.parametrize("time_direction", [1.0, -1.0], ids=["forwards", "backwards"])
@pytest.mark.parametrize("options", [{}, {"dt": 0.4, "method": "tsit5"}], ids=["adaptive", "fixed"])
def test_pulse_with_knots_is_resolved(options, time_direction):
    """x' = 1 after a pulse of 1 ms, to rounding: no stage reads across its edges."""
    ts = np.array([0.0, 10.0])[:: int(time_direction)]
    motion = kicked(jl.TimeFunction(pulse, knots=[START, END]), ts, **options)
    np.testing.assert_allclose(motion.v[-1, 0], time_direction, rtol=1e-12)
    distance = 10.0 - 0.5 * (START + END) if time_direction > 0 else 0.5 * (START + END)
    np.testing.assert_allclose(motion.q[-1, 0], distance, rtol=1e-12)


@pytest.mark.full
def test_derivatives_by_knots_of_a_pulse_are_exact():
    """d x/d start of a pulse of given length: minus its impulse, for any steps."""

    @jax.jit
    def end(start):
        signal = jl.TimeFunction(
            lambda t, params: jnp.where((t >= params["s"]) & (t < params["s"] + 0.5), 2.0, 0.0),
            knots=jnp.stack([start, start + 0.5]),
        )
        params = {"k": 0.0, "s": start}
        return moved(signal, [0.0, 4.0], (0.0, 0.0), params, method="tsit5").q[-1, 0]

    value, slope = jax.value_and_grad(end)(1.3)
    np.testing.assert_allclose(value, 4.0 - 1.3 - 0.25, rtol=1e-12)
    np.testing.assert_allclose(slope, -1.0, rtol=1e-10)


@pytest.mark.full
@pytest.mark.parametrize(
    # At 1e-7, largest errors of solution and derivatives: 4.3e-8 and 1.1e-7. With f constant beyond
    # its knot, and time constant beyond its end, derivatives were wrong by 1e-4.
    "method",
    ["kvaerno4", pytest.param("kvaerno5", marks=pytest.mark.full)],
)
def test_stages_beyond_a_step_do_not_affect_derivatives_by_its_end(method):
    """x'' = sin 5t up to a knot, cos 3t after it: d v/d knot and d v/d end are forces there."""

    @jax.jit
    def end(knot, stop):
        signal = jl.TimeFunction(
            lambda t, params: jnp.where(t < params["s"], jnp.sin(5 * t), jnp.cos(3 * t)),
            knots=knot[None],
        )
        motion = moved(
            signal,
            jnp.stack([jnp.zeros(()), stop]),
            (0.0, 0.0),
            {"k": 0.0, "s": knot},
            method=method,
            rtol=1e-7,
            atol=1e-7,
        )
        return motion.v[-1, 0]

    knot, stop = jnp.array(1.3), jnp.array(2.0)
    value, slopes = jax.value_and_grad(end, (0, 1))(knot, stop)
    v = (1 - np.cos(5 * knot)) / 5 + (np.sin(3 * stop) - np.sin(3 * knot)) / 3
    exact = [np.sin(5 * knot) - np.cos(3 * knot), np.cos(3 * stop)]
    np.testing.assert_allclose(value, v, atol=3e-7)
    np.testing.assert_allclose(slopes, exact, atol=3e-7)
    forwards = jax.jacfwd(end, (0, 1))(knot, stop)
    np.testing.assert_allclose(forwards, slopes, rtol=1e-12)


@pytest.mark.parametrize("derivatives", [False, True])
def test_save_at_a_singular_force_is_nan(derivatives):
    """A spike that steps miss and the step to a save meets: the save is NaN."""
    spike = jl.TimeFunction(lambda t: jnp.where(jnp.abs(t - 0.5) < 1e-9, 1e6, 0.0))
    ts = np.array([0.0, 0.5, 1.0])

    def positions(x0):
        motion = moved(spike, ts, (x0, 0.0), {"k": 1.0}, method="dopri8")
        return motion.q[:, 0], motion

    if derivatives:
        x, _, motion = jax.vjp(positions, 1.0, has_aux=True)
    else:
        x, motion = positions(1.0)
    np.testing.assert_allclose(x[np.array([0, 2])], np.cosh(ts[::2]), rtol=1e-9)
    assert np.isnan(x[1])
    assert motion.status == jl.Status.step_below_resolution


@pytest.mark.full
def test_pulse_between_steps_is_resolved_by_bounded_steps():
    """Skipped without a warning; resolved by steps no longer than the pulse."""
    wide = jl.TimeFunction(lambda t: jnp.where((t >= 3.0) & (t < 3.2), 5.0, 0.0))
    ts = np.array([0.0, 10.0])
    assert kicked(wide, ts, dt0=5.0, method="tsit5").v[-1, 0] < 0.5
    found = kicked(wide, ts, dt_max=0.1, method="tsit5")
    np.testing.assert_allclose(found.v[-1, 0], 1.0, atol=1e-6)
    assert int(found.stats["accepted"]) >= 100
    slope = jax.grad(lambda x: moved(wide, ts, (x, 0.0), {"k": 0.0}, dt_max=0.1).q[-1, 0])(0.0)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-12)


def test_force_that_becomes_nan_ends_the_motion():
    """NaN beyond x = 1 with a least step: status nonfinite after a few attempts."""
    wall = jl.System(
        lambda t, q, v, params: 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2,
        ("x",),
        forces=(jl.GeneralizedForce(lambda t, q, v, p: jnp.where(q > 1.0, jnp.nan, 1.0), "wall"),),
    )
    control = diffrax.PIDController(rtol=1e-6, atol=1e-6, dtmin=1e-3)
    motion = jl.simulate(
        wall, [0.0], [1.0], [0.0, 5.0], method=(diffrax.Tsit5(), control), throw=False
    )
    assert motion.status == jl.Status.nonfinite
    assert int(motion.stats["rejected"]) < 100
