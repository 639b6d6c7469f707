"""Growth of perturbations: closed forms, independent computations, and messages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _growths import TIGHT, product, states
from _silence import no_warning
from _systems.mechanisms import (
    BOBS,
    G,
    minimal,
)
from _systems.problems import MOTIONS
from _user import unchecked  # noqa: F401
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import jaxlag as jl
from systems.catalogue.chapter3.quadcopter import entry as quadcopter

# ---- Linear: x'' = -k x - c v, Phi by the matrix exponential ------------------------------------


def damping(t, q, v, params):
    return -params["c"] * v


linear = jl.System(
    lambda t, q, v, params: 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2,
    ("x",),
    forces=(jl.GeneralizedForce(damping, "damping"),),
)
OSCILLATING, FREE, INVERTED, DAMPED = (
    {"k": k, "c": c} for k, c in ((4.0, 0.0), (0.0, 0.0), (-G, 0.0), (4.0, 0.4))
)
RATE = np.sqrt(G)  # of the inverted pendulum


def linear_motion(params, start, ts):
    return jl.simulate(linear, start[:1], start[1:], ts, params, **TIGHT)


def norm_of_exponential(t, rate=RATE):
    """|[[cosh, sinh / rate], [rate sinh, cosh]]| of determinant 1, from its Frobenius norm."""
    square = 2 * np.cosh(rate * t) ** 2 + np.sinh(rate * t) ** 2 * (rate**2 + rate**-2)
    return np.sqrt(square / 2 + np.sqrt(square**2 / 4 - 1))


@pytest.mark.full
@pytest.mark.parametrize(
    ("params", "start", "span"),
    [
        (OSCILLATING, [0.7, -0.3], 20.0),
        (FREE, [0.2, 1.0], 50.0),
        (INVERTED, [1e-3, 0.0], 5.0),
        (DAMPED, [0.7, -0.3], 20.0),
    ],
)
def test_kappa_is_the_largest_scaled_norm(params, start, span):
    """The largest scaled norm over all pairs of save times, Phi by scipy's matrix exponential."""
    rtol, atol = 1e-3, 2e-4
    ts = span * np.linspace(0.0, 1.0, 41) ** 1.5
    motion = linear_motion(params, start, ts)
    growth = jl.lyapunov(motion, rtol=rtol, atol=atol)
    f = np.array([[0.0, 1.0], [-params["k"], -params["c"]]])
    w = atol + rtol * np.abs(states(motion))
    i, j = np.triu_indices(len(ts))
    norms = np.zeros((len(ts), len(ts)))
    Phi = expm(f * (ts[j] - ts[i])[:, None, None])
    norms[i, j] = np.linalg.norm(Phi * w[i][:, None, :] / w[j][:, :, None], 2, axis=(1, 2))
    # Steps of 1e-10; measured 2026-11-22: at most 2e-10 of kappa and log_norm, 7e-12 of a part.
    np.testing.assert_allclose(growth.kappa, norms.max(axis=0), rtol=2e-9)
    np.testing.assert_allclose(growth.log_norm, np.log(norms[0]), rtol=0, atol=2e-9)
    exact = expm(f * np.diff(ts)[:, None, None])
    np.testing.assert_allclose(growth.transition, exact, rtol=0, atol=1e-10 * np.abs(exact).max())
    # At s = t nothing has grown.
    assert (growth.kappa >= 1.0).all()
    ratio = jl.lyapunov(motion, rtol=10 * rtol, atol=10 * atol)
    np.testing.assert_allclose(ratio.kappa, growth.kappa, rtol=1e-12)


@pytest.mark.full
def test_rotation_has_no_growth():
    """x'' = -x in fixed units: Phi is a rotation."""
    motion = linear_motion({"k": 1.0, "c": 0.0}, [0.7, -0.3], np.linspace(0.0, 20.0, 41))
    growth = jl.lyapunov(motion, rtol=0.0)
    np.testing.assert_allclose(growth.kappa, 1.0, rtol=1e-8)
    np.testing.assert_allclose(growth.log_norm, 0.0, rtol=0, atol=1e-8)
    assert abs(growth.exponent) < 1e-8
    assert not growth.exponential
    assert growth.horizon == np.inf


def test_growth_as_a_power_of_time_is_not_exponential():
    """A free particle: Phi = [[1, t], [0, 1]]."""
    for start in ([0.0, 0.0], [0.2, 1.0]):
        growth = jl.lyapunov(linear_motion(FREE, start, np.linspace(0.0, 1e4, 41)))
        assert 0 < growth.exponent <= growth.exponent_error
        assert growth.horizon == np.inf
        assert "at most like a power of time" in str(growth)
    growth = jl.lyapunov(linear_motion(FREE, [0.0, 0.0], np.linspace(0.0, 1e4, 41)))
    t = growth.ts
    np.testing.assert_allclose(growth.kappa, t / 2 + np.sqrt(1 + t**2 / 4), rtol=1e-8)


def test_inverted_pendulum_has_its_exponent_and_horizon():
    """Phi at the unstable equilibrium, where the motion alone needs no steps."""
    ts = np.linspace(0.0, 10.0, 41)
    growth = jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], ts))
    np.testing.assert_allclose(growth.kappa, norm_of_exponential(ts), rtol=1e-7)
    # The other exponential after a quarter of the motion: exp(-2 RATE 2.5) = 2e-7.
    np.testing.assert_allclose(growth.exponent, RATE, rtol=1e-6)
    assert growth.exponential
    horizon = np.log(2e9 / (RATE + 1 / RATE)) / RATE
    np.testing.assert_allclose(growth.horizon, horizon, rtol=1e-7)
    assert f"{horizon:.4g} s after its start an error of 1e-09" in growth.message()
    assert "multiple shooting" in growth.message()
    loose = jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], ts), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(loose.horizon, horizon - np.log(1e4) / RATE, rtol=1e-6)
    early = jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], 0.4 * ts))
    np.testing.assert_allclose(early.horizon, horizon, rtol=1e-3)  # extrapolated
    assert "beyond its end (extrapolated)" in str(early)
    backward = jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], -ts))
    np.testing.assert_allclose(backward.kappa, growth.kappa, rtol=1e-7)
    np.testing.assert_allclose(backward.horizon, growth.horizon, rtol=1e-7)


@pytest.mark.full
def test_a_motion_beyond_its_horizon_warns():
    """exp(RATE t) reaches 1e9 after 6.4 s."""
    beyond = linear_motion(INVERTED, [0.0, 0.0], np.linspace(0.0, 10.0, 41))
    with pytest.warns(UserWarning, match=r"From 6\.\d+ s after its start an error of 1e-09"):
        growth = jl.lyapunov(beyond)
    assert growth.horizon < 10.0
    with no_warning():
        jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], np.linspace(0.0, 5.0, 41)))
        jax.jit(jl.lyapunov)(beyond)  # no values, no warning
    several = jax.vmap(lambda q: linear_motion(INVERTED, q, np.linspace(0.0, 10.0, 41)))
    with pytest.warns(UserWarning, match="2 of 2 motions end beyond the horizon"):
        jl.lyapunov(several(jnp.zeros((2, 2))))


def test_large_growth_does_not_overflow():
    """Growth of e^940, in segments of e^23."""
    growth = jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], np.linspace(0.0, 300.0, 41)))
    expected = 300 * RATE + np.log((RATE + 1 / RATE) / 2)
    np.testing.assert_allclose(growth.log_norm[-1], expected, rtol=1e-8)
    np.testing.assert_allclose(growth.log_kappa[-1], expected, rtol=1e-8)
    np.testing.assert_allclose(growth.exponent, RATE, rtol=1e-8)
    assert growth.kappa[-1] == np.inf
    assert "at most 10^408 times" in growth.message()


def test_decay_has_a_negative_exponent():
    growth = jl.lyapunov(linear_motion(DAMPED, [0.7, -0.3], np.linspace(0.0, 50.0, 41)))
    assert abs(growth.exponent + DAMPED["c"] / 2) < growth.exponent_error
    assert growth.exponent < -3 * growth.exponent_error
    assert growth.horizon == np.inf
    assert "The error decays" in str(growth)


# ---- Double pendulum -----------------------------------------------------------------------------


def regular():
    motion = MOTIONS["double_pendulum"]
    return jl.simulate(minimal, motion.q0, motion.v0, np.linspace(0.0, 1.5, 201), BOBS, **TIGHT)


def hand_written(t, y):
    """Equations of motion of the double pendulum, both angles from the downward vertical."""
    m1, m2, l1, l2 = (BOBS[name] for name in ("m1", "m2", "l1", "l2"))
    a, b, u, v = y
    c, s = m2 * l1 * l2 * np.cos(a - b), m2 * l1 * l2 * np.sin(a - b)
    M = (m1 + m2) * l1**2, c, m2 * l2**2
    Q = -s * v**2 - (m1 + m2) * G * l1 * np.sin(a), s * u**2 - m2 * G * l2 * np.sin(b)
    det = M[0] * M[2] - M[1] ** 2
    return [u, v, (M[2] * Q[0] - M[1] * Q[1]) / det, (M[0] * Q[1] - M[1] * Q[0]) / det]


@pytest.mark.full
def test_exponent_of_chaos_by_two_nearby_trajectories():
    """Benettin's method with scipy: the distance is reset to 1e-6 after each second."""
    start, span, distance = np.array([2.0, 2.0, 0.0, 0.0]), 160.0, 1e-6
    motion = jl.simulate(minimal, start[:2], start[2:], np.linspace(0.0, span, 201), BOBS)
    growth = jl.lyapunov(motion)
    # Measured 2026-11-22, 1/s: 1.05 +- 0.10, by scipy 1.21 +- 0.11; over 8 starts and 1000 s
    # 1.122 +- 0.009, over 4 starts and 800 s by scipy 1.136 +- 0.012.
    near, far, rates = start, start + distance * np.eye(4)[0], []
    for _ in range(int(span)):
        near, far = (
            solve_ivp(hand_written, (0.0, 1.0), y, method="DOP853", rtol=1e-10, atol=1e-10).y[:, -1]
            for y in (near, far)
        )
        separation = np.linalg.norm(far - near)
        rates.append(np.log(separation / distance))
        far = near + (far - near) * distance / separation
    blocks = np.mean(np.reshape(rates[40:], (8, 15)), axis=1)
    error = np.std(blocks, ddof=1) / np.sqrt(8)
    # Two samples of one chaotic region: they differ by at most three times the combined error.
    assert abs(growth.exponent - np.mean(blocks)) < 3 * np.hypot(growth.exponent_error, error)
    assert growth.exponential
    assert growth.exponent_error < 0.2 * growth.exponent
    assert 0 < growth.horizon < span


@pytest.mark.full
def test_product_of_parts_is_the_derivative_of_the_whole():
    """The variational equation against the derivative of one solve."""
    motion = regular()

    @jax.jit
    @jax.jacfwd
    def whole(y):
        end = jl.simulate(minimal, y[:2], y[2:], [0.0, 1.5], BOBS, **TIGHT)
        return jnp.concatenate([end.q[-1], end.v[-1]])

    expected = whole(jnp.concatenate([motion.q[0], motion.v[0]]))
    growth = jl.lyapunov(motion)
    np.testing.assert_allclose(
        product(growth), expected, rtol=0, atol=1e-8 * np.abs(expected).max()
    )
    w0, w1 = (1e-9 * (1 + np.abs(np.concatenate([motion.q[i], motion.v[i]]))) for i in (0, -1))
    norm = np.linalg.norm(expected * w0 / w1[:, None], 2)
    np.testing.assert_allclose(growth.log_norm[-1], np.log(norm), rtol=0, atol=1e-8)


@pytest.mark.full
def test_conservative_growth_is_symplectic():
    """Phi^T J Phi = J in (q, p), p = dL/dv."""
    motion = regular()

    def canonical(q, v):
        p = minimal.momentum(q, v, BOBS)
        return jnp.concatenate([q, p])

    parts = jax.vmap(jax.jacfwd(canonical, argnums=(0, 1)))(motion.q, motion.v)
    chart = jnp.concatenate(parts, -1)
    growth = jl.lyapunov(motion)
    Phi = chart[1:] @ growth.transition @ jnp.linalg.inv(chart[:-1])
    # Measured 2026-11-22: at most 5e-14.
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    np.testing.assert_allclose(
        jnp.swapaxes(Phi, 1, 2) @ J @ Phi, np.tile(J, (200, 1, 1)), atol=1e-9
    )


# ---- Inputs --------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_table_is_read_on_both_sides_of_its_knots():
    """Against the derivative of one solve, save times on knots and between them."""
    q0, v0, params, _, inputs = MOTIONS["driven_pendulum"][1:]
    system, knots = MOTIONS["driven_pendulum"].system, inputs["tau"].times

    @jax.jit
    def solved(y, ts):
        motion = jl.simulate(system, y[:1], y[1:], ts, params, inputs=inputs, **TIGHT)
        return jnp.concatenate([motion.q[-1], motion.v[-1]]), motion

    solved = jax.jit(jax.jacfwd(solved, has_aux=True))
    for ts in (knots, jnp.linspace(0.0, 1.5, len(knots))):
        expected, motion = solved(jnp.concatenate([q0, v0]), ts)
        np.testing.assert_allclose(product(jl.lyapunov(motion)), expected, rtol=0, atol=1e-8)


# ---- Batches, and unsupported arguments ----------------------------------------------------------


@pytest.mark.full
def test_batch_equals_single_motions():
    """Equal to single motions, under vmap and jit; a failed lane is NaN with its status."""
    ts = np.linspace(0.0, 10.0, 41)
    k = jnp.array([4.0, -G, jnp.nan])

    @jax.vmap
    def swing(k):
        return jl.simulate(linear, [0.1], [0.2], ts, {"k": k, "c": 0.0}, throw=False)

    motions = swing(k)
    batch = jax.jit(jax.vmap(jl.lyapunov))(motions)
    for i in range(2):
        single = jl.lyapunov(jax.tree.map(lambda x, i=i: x[i], motions))
        for name in ("kappa", "log_norm", "exponent", "exponent_error", "horizon", "transition"):
            np.testing.assert_allclose(getattr(batch, name)[i], getattr(single, name), rtol=1e-9)
    direct = jax.eval_shape(jl.lyapunov, motions)
    assert jax.tree.map(jnp.shape, direct) == jax.tree.map(jnp.shape, batch)
    assert list(batch.exponential) == [False, True, False]
    assert np.isnan(batch.kappa[2]).all()
    assert batch.status[2] == motions.status[2] != jl.Status.ok
    with pytest.raises(ValueError, match=r"^`message` of a batch is not supported: its shape is"):
        batch.message()
    assert "PerturbationGrowth(" in str(batch)


@pytest.mark.full
def test_float32_has_separate_default_tolerances():
    """A state in float32, time in float64."""
    params = {"k": np.float32(-G), "c": np.float32(0.0)}
    start = np.float32([0.0]), np.float32([0.0])
    motion = jl.simulate(linear, *start, np.linspace(0.0, 2.5, 41), params)
    growth = jl.lyapunov(motion)
    assert growth.kappa.dtype == growth.horizon.dtype == jnp.float32
    assert "an error of 1e-05 is as large" in str(growth)
    np.testing.assert_allclose(growth.kappa, norm_of_exponential(motion.ts), rtol=1e-4)
    expected = np.log(2e5 / (RATE + 1 / RATE)) / RATE
    np.testing.assert_allclose(growth.horizon, expected, rtol=1e-2)  # extrapolated


@pytest.mark.full
def test_unsupported_arguments_are_refused(unchecked):  # noqa: F811
    ts = np.linspace(0.0, 10.0, 41)
    motion = linear_motion(INVERTED, [0.0, 0.0], ts)
    with pytest.raises(ValueError, match=r"lyapunov: `motion` must be a jl.Solution, but it was"):
        jl.lyapunov(motion.q)
    with pytest.raises(ValueError, match="must have at least 3 save times, but it had 2"):
        jl.lyapunov(linear_motion(INVERTED, [0.0, 0.0], [0.0, 1.0]))
    short = jl.simulate(linear, [0.1], [0.0], ts, INVERTED, max_steps=3, throw=False)
    with pytest.raises(ValueError, match=r"status max_steps: last good state at t = \d.* of 10"):
        jl.lyapunov(short)
    with pytest.raises(ValueError, match=r"from t = 0.0 to 0.25 the status was max_steps. Save"):
        jl.lyapunov(motion, max_steps=1)
    for name, value in (
        ("rtol", -1.0),
        ("atol", 0.0),
        ("step_rtol", jnp.inf),
        ("step_atol", [1.0, 2.0]),
    ):
        with pytest.raises(ValueError, match=f"lyapunov: `{name}` must be"):
            jl.lyapunov(motion, **{name: value})
    with pytest.raises(ValueError, match="`max_steps` must be a positive integer, but it was 0"):
        jl.lyapunov(motion, max_steps=0)

    def exponent(x):
        return jl.lyapunov(linear_motion(INVERTED, jnp.stack([x, 0.0]), ts)).exponent

    for slope in (jax.grad, jax.jacfwd):
        with pytest.raises(ValueError, match=r"^A derivative of `lyapunov` is not supported"):
            slope(exponent)(0.0)


@pytest.mark.full
def test_many_coordinates_and_segments_agree_with_few_segments():
    """12 coordinates and 32 segments: more at once exceeds what XLA compiles in one loop."""
    motion = jl.simulate(
        quadcopter.system, *quadcopter.start(), np.linspace(0, 2, 33), quadcopter.example.params
    )
    growth = jl.lyapunov(motion)
    assert growth.status == jl.Status.ok
    one = jl.lyapunov(
        jl.simulate(
            quadcopter.system, *quadcopter.start(), np.linspace(0, 2, 3), quadcopter.example.params
        )
    )
    np.testing.assert_allclose(growth.log_norm[-1], one.log_norm[-1], rtol=1e-6)
