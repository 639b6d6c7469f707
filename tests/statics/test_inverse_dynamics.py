"""Inverse dynamics: the forces that a given motion requires."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import names, operations
from _systems.mechanics import GENERAL
from _systems.problems import MOTIONS
from _user import unchecked  # noqa: F401

import jaxlag as jl

EPS = np.finfo(float).eps


def draw(motion, rng):
    n = motion.system.size
    return (jnp.asarray(rng.uniform(-1, 1, n)) for _ in range(3))


@pytest.mark.parametrize("name", MOTIONS)
def test_inverse_dynamics_inverts_the_equations_of_motion(name):
    """M a + h - Q of any a, compared with separate terms; 0 for the free acceleration."""
    motion = MOTIONS[name]
    system, params, inputs = motion.system, motion.params, motion.inputs
    dq, v, a = draw(motion, np.random.default_rng(1))
    q, t = motion.q0 + 0.1 * dq, 0.37
    M, h = system.mass_matrix(q, v, params, t=t), system.bias(q, v, params, t=t)
    Q = system.generalized_force(q, v, params, t=t, inputs=inputs)
    needed = jl.inverse_dynamics(system, q, v, a, params, t=t, inputs=inputs)
    size = np.abs(M) @ np.abs(a) + np.abs(h) + np.abs(Q)
    assert np.all(np.abs(needed - (M @ a + h - Q)) <= 32 * EPS * size)

    free = system.acceleration(q, v, params, t=t, inputs=inputs)
    needed = jl.inverse_dynamics(system, q, v, free, params, t=t, inputs=inputs)
    size = np.abs(M) @ np.abs(free) + np.abs(h) + np.abs(Q)
    assert np.all(np.abs(needed) <= 32 * EPS * np.linalg.cond(M) * size)


def test_general_lagrangians_satisfy_the_same_identity():
    """Explicit time, terms linear in v, L not quadratic: the same identity."""
    rng = np.random.default_rng(2)
    for case in GENERAL.values():
        n = case.system.size
        q, v, a = (jnp.asarray(rng.uniform(-0.5, 0.5, n)) for _ in range(3))
        M = case.system.mass_matrix(q, v, case.params, t=0.2)
        h = case.system.bias(q, v, case.params, t=0.2)
        needed = jl.inverse_dynamics(case.system, q, v, a, case.params, t=0.2)
        assert np.all(np.abs(needed - (M @ a + h)) <= 32 * EPS * (np.abs(M) @ np.abs(a) + abs(h)))


def test_series_of_states_equal_single_instants():
    """A series of states equals single evaluations; inputs are read at each time."""
    motion = MOTIONS["driven_pendulum"]
    rng = np.random.default_rng(3)
    q, v, a = (rng.uniform(-1, 1, (5, 1)) for _ in range(3))
    ts = np.linspace(0.1, 1.5, 5)
    given = {"inputs": motion.inputs}
    series = jl.inverse_dynamics(motion.system, q, v, a, motion.params, t=ts, **given)
    for i, force in enumerate(series):
        one = jl.inverse_dynamics(motion.system, q[i], v[i], a[i], motion.params, t=ts[i], **given)
        np.testing.assert_allclose(force, one, rtol=4 * EPS)
    assert len(np.unique(series)) == 5
    fixed = jl.inverse_dynamics(motion.system, q, v, a, motion.params, t=0.1, **given)
    np.testing.assert_allclose(fixed[0], series[0], rtol=4 * EPS)
    assert abs(fixed[3] - series[3]) > 0.1


@pytest.mark.full
def test_simulated_motion_needs_no_force():
    """Inverse of forward dynamics along a whole motion, to rounding."""
    motion = MOTIONS["cart_pendulum"]
    run = jl.simulate(motion.system, motion.q0, motion.v0, jnp.linspace(0, 1, 6), motion.params)
    needed = jl.inverse_dynamics(motion.system, run.q, run.v, run.a, motion.params, t=run.ts)
    assert needed.shape == (6, 2)
    np.testing.assert_allclose(needed, 0, atol=1e-12)  # terms of about 50 N, cond(M) about 20


def test_the_mass_matrix_is_neither_formed_nor_factored():
    """20 links: no (20, 20) array; the derivative is one forward pass over the reverse pass."""
    n = 20
    case = GENERAL["chain"]
    system = jl.System(case.system.lagrangian, {"theta": (n,)})
    q = jnp.linspace(0.1, 1.0, n)

    def needed(q):
        return jl.inverse_dynamics(system, q, q, q, case.params)

    program = operations(needed, q)
    assert all(np.prod(shape) <= n for o in program for shape in o.shapes)
    assert not names(program) & {"custom_linear_solve", "cholesky", "triangular_solve", "lu"}


def test_a_massless_coordinate_is_allowed():
    system = jl.System(
        lambda t, q, v, params: 0.5 * v[0] ** 2 - 0.5 * (q[0] - q[1]) ** 2, ("x", "massless")
    )
    needed = jl.inverse_dynamics(system, [0.3, 0.1], [0.0, 0.0], [2.0, 5.0])
    np.testing.assert_allclose(needed, [2.2, -0.2], rtol=8 * EPS)


def test_derivatives_by_mass_are_those_of_a_regressor():
    """L is linear in m: so is the force, whose derivative is the force at m = 1."""
    motion = MOTIONS["double_pendulum"]
    q, v, a = draw(motion, np.random.default_rng(4))

    def needed(m1):
        return jl.inverse_dynamics(motion.system, q, v, a, motion.params | {"m1": m1})

    forward, reverse = jax.jacfwd(needed)(1.0), jax.jacrev(needed)(1.0)
    np.testing.assert_allclose(forward, reverse, rtol=32 * EPS, atol=32 * EPS)
    difference = needed(2.0) - needed(1.0)
    np.testing.assert_allclose(forward, difference, rtol=1e-13, atol=1e-13)


def test_prescribed_motion_differentiates_twice():
    """q = (sin w t, t^3): v, a by closed form, at one time and at several."""

    def motion(t):
        return jnp.stack([jnp.sin(3 * t), t**3])

    ts = jnp.array([0.2, 1.1])
    q, v, a = jl.prescribed_motion(motion, ts)
    np.testing.assert_allclose(q, np.stack([np.sin(3 * ts), ts**3], -1), rtol=8 * EPS)
    np.testing.assert_allclose(v, np.stack([3 * np.cos(3 * ts), 3 * ts**2], -1), rtol=16 * EPS)
    np.testing.assert_allclose(a, np.stack([-9 * np.sin(3 * ts), 6 * ts], -1), rtol=16 * EPS)
    for series, one in zip((q, v, a), jl.prescribed_motion(motion, ts[1]), strict=True):
        np.testing.assert_allclose(series[1], one, rtol=4 * EPS)


def test_a_constant_motion_is_at_rest():
    q, v, a = jl.prescribed_motion(lambda t: jnp.array([1, 2]), [0.0, 1.0])
    np.testing.assert_array_equal(q, [[1.0, 2.0], [1.0, 2.0]])
    np.testing.assert_array_equal(v, np.zeros((2, 2)))
    np.testing.assert_array_equal(a, np.zeros((2, 2)))


def test_carnival_ride_agrees_with_the_book():
    """Book data: torque 1200 N m, Coriolis force 240 N, centripetal acceleration 45 m/s^2."""

    def kinetic(t, q, v, params):
        return 0.5 * 100.0 * (v[0] ** 2 + (q[0] * v[1]) ** 2)

    def potential(t, q, params):
        return jnp.zeros(())

    ride = jl.System(coordinates=("r", "theta"), kinetic=kinetic, potential=potential)
    q, v, a = jl.prescribed_motion(lambda t: jnp.stack([5.0 + 0.4 * t, 3.0 * t]), 0.0)
    radial, torque = jl.inverse_dynamics(ride, q, v, a)
    np.testing.assert_allclose(torque, 1200, rtol=8 * EPS)
    np.testing.assert_allclose(torque / q[0], 240, rtol=8 * EPS)  # its lever arm is r
    np.testing.assert_allclose(-radial / 100, 45, rtol=8 * EPS)


def wrong():
    yield "q", ([0.1], [0.0, 0.0], [0.0, 0.0]), {}, "`q` must have shape (2,) or (s, 2): theta1"
    yield "v", ([0.1, 0.2], [0.0], [0.0, 0.0]), {}, "`v` must have shape (2,) or (s, 2), as q with"
    states = np.zeros((3, 2))
    yield (
        "a",
        (states, states, np.zeros((4, 2))),
        {},
        "`a` must have shape (2,) or (s, 2), as q with (3",
    )
    yield (
        "t",
        (states, states, states),
        {"t": np.zeros(4)},
        "`t` must have shape () or (3,), but its shape",
    )
    yield "ndim", (states[None],) * 3, {}, "`q` must have shape (2,) or (s, 2)"
    yield (
        "complex",
        (states, states * 1j, states),
        {},
        "`v` must be real, but its dtype was complex128",
    )
    yield "text", ("ab", states, states), {}, "`q` must be real numbers, but it was 'ab'."
    yield "none", (states, states, None), {}, "`a` must be real numbers, but it was None."
    yield (
        "empty",
        (states[:0],) * 3,
        {},
        "`q` must hold at least one instant, but its shape was (0, 2)",
    )
    yield (
        "nan",
        (states, np.array([[0.0, 0.0], [0.0, np.nan], [0.0, 0.0]]), states),
        {},
        "`v` must be finite, but v[1, 1] ('theta2') was nan. States that a motion did not reach",
    )
    yield (
        "inf",
        ([0.0, 1.0], [0.0, 1.0], [np.inf, 0.0]),
        {},
        "`a` must be finite, but a[0] ('theta1",
    )
    yield "t nan", (states, states, states), {"t": np.nan}, "`t` must be finite, but it was nan"
    yield (
        "t text",
        (states, states, states),
        {"t": "now"},
        "`t` must be real numbers, but it was 'now'",
    )
    named = {"theta1": 0.1, "theta3": 0.2}
    yield "names", (named,) * 3, {}, "`q` must name exactly ['theta1', 'theta2'], but it named ['th"


@pytest.mark.parametrize(
    ("motion", "rest", "message"), [w[1:] for w in wrong()], ids=[w[0] for w in wrong()]
)
def test_a_motion_of_wrong_shape_is_refused(motion, rest, message):
    system = MOTIONS["double_pendulum"].system
    with pytest.raises(ValueError, match=re.escape(f"inverse_dynamics: {message}")):
        jl.inverse_dynamics(system, *motion, MOTIONS["double_pendulum"].params, **rest)


def test_states_may_be_given_by_name():
    """As `simulate` takes them, in any order."""
    motion = MOTIONS["double_pendulum"]
    system, params = motion.system, motion.params
    plain = jl.inverse_dynamics(system, [0.1, 0.2], [0.3, -0.4], [0.5, 0.6], params)
    q, v = {"theta2": 0.2, "theta1": 0.1}, {"theta1": 0.3, "theta2": -0.4}
    named = jl.inverse_dynamics(system, q, v, [0.5, 0.6], params)
    np.testing.assert_array_equal(named, plain)


def test_mixed_precisions_use_the_wider_one():
    motion = MOTIONS["double_pendulum"]
    single = np.array([0.5, -0.25], np.float32)
    mixed = jl.inverse_dynamics(motion.system, single, [1, 2], np.array([0.5, 1.0]), motion.params)
    double = single.astype(float)
    same = jl.inverse_dynamics(motion.system, double, [1.0, 2.0], [0.5, 1.0], motion.params)
    assert mixed.dtype == np.float64
    np.testing.assert_array_equal(mixed, same)


@pytest.mark.usefixtures("unchecked")
def test_other_types_than_systems_are_refused():
    with pytest.raises(
        ValueError, match=r"inverse_dynamics: `system` must be a jl\.System, but it "
    ):
        jl.inverse_dynamics("S", [0.1], [0.1], [0.1])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("motion", "t", "message"),
    [
        (jnp.zeros(2), 0.0, "`motion` must be a function of (t), but it was"),
        (
            lambda t, params: t,
            0.0,
            "`motion` must be callable as (t), but its signature was (t, par",
        ),
        (
            lambda t: jax.lax.complex(t, t)[None],
            0.0,
            "`motion(t)` must be real, but its dtype",
        ),
        (lambda t: t * jnp.ones(2), "now", "`t` must be real numbers, but it was 'now'"),
        (lambda t: t * jnp.ones(2), None, "`t` must be real numbers, but it was None"),
        (lambda t: t * jnp.ones(2), 1j, "`t` must be real, but its dtype was complex128"),
        (lambda t: t * jnp.ones(2), np.ones((2, 2)), "`t` must be an instant or an array of them"),
    ],
)
def test_invalid_prescribed_motion_is_refused(motion, t, message):
    with pytest.raises(ValueError, match=re.escape(f"prescribed_motion: {message}")):
        jl.prescribed_motion(motion, t)


@pytest.mark.parametrize("motion", [lambda t: t, lambda t: jnp.zeros((2, 2)), lambda t: None])
def test_prescribed_motion_must_return_a_vector(motion):
    message = "prescribed_motion: `motion` must return all coordinates as one vector of shape"
    with pytest.raises(ValueError, match=message):
        jl.prescribed_motion(motion, 0.0)


def test_inputs_that_no_force_reads_are_refused():
    motion = MOTIONS["double_pendulum"]
    with pytest.raises(
        ValueError, match="`inputs` must hold only signals that a declared function reads"
    ):
        jl.inverse_dynamics(
            motion.system, motion.q0, motion.v0, motion.v0, motion.params, inputs={"tau": 1.0}
        )
