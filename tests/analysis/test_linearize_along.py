"""Linearization along motions: closed forms, another set of coordinates, Floquet's multipliers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.special

import jaxlag as jl

EPS = np.finfo(float).eps
TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def cart():
    """A damped mass on a spring, pulled by a force and by a motor with a state."""
    force = lambda t, q, v, p, inputs: inputs["u"] + inputs["motor"] - p["c"] * v  # noqa: E731
    rate = lambda t, q, v, x, p, inputs: inputs["u"] - 3.0 * x - 0.5 * v  # noqa: E731
    return jl.System(
        lambda t, q, v, p: 0.5 * (v @ v) - 2.0 * (q @ q),
        ("x",),
        forces=[jl.GeneralizedForce(force, "pull")],
        states=jl.States(rate, ("motor",)),
    )


CART = cart()
START = {"q0": [0.3], "v0": [-0.2], "x0": [0.1]}
TIMES = jnp.array([0.0, 0.4, 1.0])


def along_cart(outputs=("x'",), **options):
    inputs = {"u": jnp.asarray(0.7)}
    return jl.linearize_along(
        CART, ts=TIMES, params={"c": 0.4}, inputs=inputs, outputs=outputs, **START, **options
    )


def test_linear_system_has_the_matrix_exponential():
    along = along_cart(**TIGHT)
    A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.4, 1.0], [0.0, -0.5, -3.0]])
    assert along.states == ("x", "x'", "motor")
    assert np.max(np.abs(along.linear.A - A)) <= 4 * EPS
    assert np.max(np.abs(along.linear.B - np.array([[0.0], [1.0], [1.0]]))) <= 4 * EPS
    assert along.linear.C.shape == (3, 1, 3)
    assert np.all(along.linear.y0[:, 0] == along.motion.v[:, 0])
    exact = np.stack([scipy.linalg.expm(A * t) for t in TIMES])
    assert np.max(np.abs(along.transitions - exact)) <= 10 * TIGHT["rtol"]  # 3e-12
    assert np.max(np.abs(along.transitions[0] - np.eye(3))) <= EPS


def test_transitions_are_those_of_the_steps():
    """For a linear system the steps map differences of starts exactly by the transitions."""
    steps = {"dt": 0.2, "method": "tsit5"}
    along = along_cart(**steps)
    ends, inputs = along.motion, {"u": jnp.asarray(0.7)}
    for j in range(3):
        z = np.array([0.3, -0.2, 0.1]) + np.eye(3)[j]
        moved = jl.simulate(
            CART, z[:1], z[1:2], TIMES, {"c": 0.4}, x0=z[2:], inputs=inputs, **steps
        )
        parts = [(getattr(moved, k) - getattr(ends, k))[:, 0] for k in ("q", "v", "x")]
        assert np.max(np.abs(along.transitions[:, :, j] - np.stack(parts, 1))) <= 100 * EPS  # 21
    # The steps are coarse: the exact exponential is elsewhere.
    A = np.asarray(along.linear.A[0])
    assert np.max(np.abs(along.transitions[-1] - scipy.linalg.expm(A))) > 1e-7


def hill(t, q, v, a):
    """Mathieu's equation x'' + (a - 2 q cos 2t) x = 0 with q = 1.3."""
    return 0.5 * v @ v - 0.5 * (a - 2.6 * jnp.cos(2 * t)) * (q @ q)


HILL = jl.System(hill, ("x",))


@functools.partial(jax.jit, static_argnums=1)
def trace_after_period(a, mode="whole"):
    along = jl.linearize_along(HILL, [0.2], [0.1], jnp.array([0.0, jnp.pi]), a, **TIGHT)
    return jnp.trace(along.transitions[-1])


@pytest.mark.parametrize(("order", "multiplier"), [(0, 1.0), (1, -1.0), (2, 1.0)])
def test_mathieu_characteristic_values_have_floquet_multipliers_of_one(order, multiplier):
    """At the borders of stability both multipliers are 1, or both are -1."""
    a = scipy.special.mathieu_a(order, 1.3)
    assert abs(trace_after_period(a) - 2 * multiplier) <= 100 * TIGHT["rtol"]  # 5e-10 at worst


@pytest.mark.full
def test_derivative_of_a_floquet_trace():
    slope = jax.jit(jax.grad(trace_after_period))(0.9)
    forward = jax.jit(jax.jacfwd(trace_after_period))(0.9)
    assert abs(slope - forward) <= 1e-12 * abs(slope)
    h = 1e-4
    apart = (trace_after_period(0.9 + h) - trace_after_period(0.9 - h)) / (2 * h)
    assert abs(slope - apart) <= 1e-6 * abs(slope)


WIDE, FAST, LENGTH, G = 0.15, 3.0, 0.8, 9.81


def rod(t, q, p):
    x = q[0] - WIDE * jnp.sin(FAST * t)
    return jnp.stack([x * x + q[1] ** 2 - LENGTH**2, 2 * (x * x + q[1] ** 2 - LENGTH**2)])


def by_angle(t, q, v, p):
    vx = WIDE * FAST * jnp.cos(FAST * t) + LENGTH * jnp.cos(q[0]) * v[0]
    return 0.5 * (vx**2 + (LENGTH * jnp.sin(q[0]) * v[0]) ** 2) + G * LENGTH * jnp.cos(q[0])


MOVED = jl.System(
    lambda t, q, v, p: 0.5 * v @ v - G * q[1], ("x", "y"), constraints=(jl.Holonomic(rod, "rod"),)
)
ANGLE = jl.System(by_angle, ("theta",))
THETA, SPEED = 0.4, 1.1


@functools.cache
def pendulums():
    """The pendulum on a moved pivot with two dependent rows, and in its angle."""
    ts = jnp.linspace(0.0, 1.2, 4)
    s, c = np.sin(THETA), np.cos(THETA)
    v0 = [WIDE * FAST + LENGTH * c * SPEED, LENGTH * s * SPEED]
    moved = jl.linearize_along(MOVED, [LENGTH * s, -LENGTH * c], v0, ts, **TIGHT)
    return moved, jl.linearize_along(ANGLE, [THETA], [SPEED], ts, **TIGHT)


@pytest.mark.full
def test_constrained_motion_in_two_sets_of_coordinates():
    """delta x = l cos(theta) delta theta, whose rate gives delta x'; T(t) Phi T(0)^-1."""
    moved, angle = pendulums()
    assert moved.states == ("x", "x'")
    theta, rate = np.asarray(angle.motion.q[:, 0]), np.asarray(angle.motion.v[:, 0])
    zero, c = np.zeros_like(theta), LENGTH * np.cos(theta)
    T = np.stack([c, zero, -LENGTH * np.sin(theta) * rate, c], 1).reshape(-1, 2, 2)
    exact = T @ np.asarray(angle.transitions) @ np.linalg.inv(T[0])
    assert np.max(np.abs(moved.transitions - exact)) <= 50 * TIGHT["rtol"]  # 4e-11
    # x' = T' T^-1 x + T A T^-1 x: the eigenvalues at rest alone agree, these at all times.
    dT = np.stack(
        [
            -LENGTH * np.sin(theta) * rate,
            zero,
            -LENGTH * (np.cos(theta) * rate**2 + np.sin(theta) * np.asarray(angle.linear.f0[:, 1])),
            -LENGTH * np.sin(theta) * rate,
        ],
        1,
    ).reshape(-1, 2, 2)
    A = (dT + T @ np.asarray(angle.linear.A)) @ np.linalg.inv(T)
    assert np.max(np.abs(moved.linear.A - A)) <= 1e3 * TIGHT["rtol"]  # 2e-10, of the two motions


@pytest.mark.full
def test_rows_are_those_of_linearize():
    moved, _ = pendulums()
    i = 2
    q, v, t = moved.motion.q[i], moved.motion.v[i], moved.motion.ts[i]
    one = jl.linearize(MOVED, q, v, t=t, independent=("x", "x'"))
    assert np.max(np.abs(one.A - moved.linear.A[i])) <= 100 * EPS * np.max(np.abs(one.A))


def sleigh():
    """A knife edge in (x, y, psi), with quasi-velocities along it and about it."""

    def lagrangian(t, q, v, p):
        centre = v[:2] + p * v[2] * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return 0.75 * centre @ centre + 0.1 * v[2] ** 2 - 0.5 * q[0] ** 2

    def of(t, q, v, p):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        return jnp.stack([c * v[0] + s * v[1], v[2], -s * v[0] + c * v[1]])

    quasi = jl.QuasiVelocities(of, ("along", "turn", "across"), constrained=("across",))
    return jl.System(lagrangian, ("x", "y", "psi"), quasi=quasi)


@pytest.mark.full
def test_quasi_velocities_against_differences():
    system, h = sleigh(), 1e-4
    q, u, ts = np.array([0.2, -0.1, 0.5]), np.array([0.8, 0.6]), jnp.array([0.0, 0.7, 1.5])
    v = np.array([np.cos(0.5) * 0.8, np.sin(0.5) * 0.8, 0.6])
    along = jl.linearize_along(system, q, v, ts, 0.3, **TIGHT)
    assert along.states == ("x", "y", "psi", "along", "turn")

    @jax.jit
    def ends(z):
        motion = jl.simulate(
            system, z[:3], None, ts, 0.3, u0={"along": z[3], "turn": z[4]}, **TIGHT
        )
        return jnp.concatenate([motion.q, motion["along"][:, None], motion["turn"][:, None]], 1)

    for j, e in enumerate(np.eye(5)):
        z = np.concatenate([q, u])
        apart = (ends(z + h * e) - ends(z - h * e)) / (2 * h)
        # h^2 of the difference, and the tolerance over h.
        assert np.max(np.abs(along.transitions[:, :, j] - apart)) <= 1e-6


@pytest.mark.full
def test_batch_under_vmap():
    ts = jnp.array([0.0, 1.0])
    many = jax.vmap(lambda a: jl.linearize_along(HILL, [0.2], [0.1], ts, a, **TIGHT))
    found = many(jnp.array([0.5, 0.9]))
    assert len(found) == 2
    one = jl.linearize_along(HILL, [0.2], [0.1], ts, jnp.asarray(0.9), **TIGHT)
    assert np.max(np.abs(found[1].transitions - one.transitions)) <= 10 * TIGHT["rtol"]
    assert found[1].linear.A.shape == (2, 2, 2)


def test_bad_input():
    ts = jnp.array([0.0, 1.0])
    with pytest.raises(
        ValueError, match=r"`u0` of linearize_along is not supported: it has no use. Give v0"
    ):
        jl.linearize_along(HILL, [0.2], [0.1], ts, 0.5, u0=[0.1])
    with pytest.raises(ValueError, match=r"linearize_along: `options` .* 'rtool'"):
        jl.linearize_along(HILL, [0.2], [0.1], ts, 0.5, rtool=1e-9)
    with pytest.raises(ValueError, match=r"`ts` must be"):
        jl.linearize_along(HILL, [0.2], [0.1], jnp.array([0.0, 0.0]), 0.5)
    with pytest.raises(ValueError, match=r"satisfy the constraints, but phi of 'rod\[0\]' was"):
        jl.linearize_along(MOVED, [0.3, -0.3], [0.1, 0.1], ts)
    with pytest.raises(ValueError, match=r"linearize: `outputs` must hold functions and names"):
        along_cart(outputs=("z",))


def test_failed_motion_raises():
    """x'' = x^2 grows beyond all bounds at a finite time."""
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v + q[0] ** 3 / 3, ("x",))
    with pytest.raises(jl.SimulationError, match="t ="):
        jl.linearize_along(system, [3.0], [3.0], jnp.array([0.0, 5.0]))


@pytest.mark.full
def test_states_that_do_not_determine_the_others_later():
    """Of a full turn x does not determine y at the horizontal, which is saved exactly."""
    with pytest.raises(ValueError, match=r"along the whole motion, but x, x' did not at t = 0.5"):
        jl.linearize_along(TURNING, [0.0, -1.0], [jnp.pi, 0.0], jnp.array([0.0, 0.5, 0.6]))


TURNING = jl.System(
    lambda t, q, v, p: 0.5 * v @ v,
    ("x", "y"),
    constraints=(jl.Holonomic(lambda t, q, p: q @ q - 1.0, "rod"),),
)
