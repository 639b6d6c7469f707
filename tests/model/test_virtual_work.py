"""Forces by their virtual work: at points, and as couples on bodies."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import operations
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag import rotation

EPS = np.finfo(float).eps
T = jnp.array(0.3)
N = 6
Q, V = jnp.array([0.4, -0.7, 0.2, 0.9, -0.3, 0.5]), jnp.array([1.5, -2.0, 0.3, 0.8, -1.1, 0.6])
PARAMS = {"F": jnp.array([2.0, -1.3, 0.7]), "arm": jnp.array([0.3, -0.5, 0.2])}


def orientation(q):
    return rotation.yaw_pitch_roll.matrix(q[3:])


def center(t, q, params):
    return q[:3]


def corner(t, q, params):
    """A point fixed in the body at `arm` from its center."""
    return q[:3] + orientation(q) @ params["arm"]


def constant(t, q, v, params):
    return params["F"]


def body_rates(t, q, v, params):
    return rotation.yaw_pitch_roll.body_rates(q[3:], v[3:])


def space_rates(t, q, v, params):
    return rotation.yaw_pitch_roll.space_rates(q[3:], v[3:])


def force_of(force, inputs=None, q=Q, v=V, t=T, params=PARAMS):
    return force(t, q, v, params, {} if inputs is None else inputs)


def two_points(t, q, params):
    """Two points in space that move with the coordinates and with time."""
    angles = jnp.cumsum(q[:3]) + t
    x, y = jnp.cumsum(jnp.cos(angles) * q[3:]), jnp.cumsum(jnp.sin(angles))
    return jnp.stack([jnp.stack([x[0], y[1], q[4] ** 2]), jnp.stack([x[2], y[2], t * q[5]])])


def test_point_force_equals_jacobian_transpose_times_force():
    """Q = (dr/dq)^T F, compared with the explicit Jacobian; two points at once."""

    def pull(t, q, v, params):
        return jnp.stack([params["F"], -0.5 * params["F"]]) * (1 + v[0])

    found = force_of(jl.PointForce(two_points, pull, "pull"))
    J = np.asarray(jax.jacfwd(two_points, argnums=1)(T, Q, PARAMS)).reshape(6, N)
    F = np.asarray(pull(T, Q, V, PARAMS)).reshape(6)
    assert np.all(np.abs(found - J.T @ F) <= 16 * EPS * (np.abs(J.T) @ np.abs(F)))


def test_the_jacobian_is_never_formed():
    """A force at the tip of a chain of 50 links: no array has 2 x 50 entries, in any order."""
    n = 50

    def tip(t, q, params):
        return jnp.stack([jnp.sum(jnp.sin(q)), -jnp.sum(jnp.cos(q))])

    force = jl.PointForce(tip, lambda t, q, v, params: jnp.array([1.0, 2.0]), "tip")
    q = jnp.linspace(0.0, 1.0, n)
    shapes = [
        shape for o in operations(lambda q: force(T, q, q, None, {}), q) for shape in o.shapes
    ]
    assert (n,) in shapes
    assert all(np.prod(shape) <= n for shape in shapes)
    np.testing.assert_allclose(force(T, q, q, None, {}), np.cos(q) + 2 * np.sin(q), rtol=8 * EPS)


def test_power_of_a_point_force_is_that_of_its_point():
    """v . Q = F . dr/dt if the point moves only with the coordinates."""
    found = V @ force_of(jl.PointForce(corner, constant, "pull"))
    rate = jax.jvp(lambda q: corner(T, q, PARAMS), (Q,), (V,))[1]
    np.testing.assert_allclose(found, PARAMS["F"] @ rate, rtol=64 * EPS)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_points_may_have_one_two_or_three_components(size):
    force = jl.PointForce(
        lambda t, q, params: q[:size] ** 2, lambda t, q, v, params: jnp.ones(size), "pull"
    )
    expected = np.where(np.arange(N) < size, 2 * np.asarray(Q), 0.0)
    np.testing.assert_array_equal(force_of(force), expected)


def test_forces_and_torques_read_inputs():
    def pull(t, q, v, params, inputs):
        return inputs["pull"] * params["F"]

    force = jl.PointForce(corner, pull, "pull")
    couple = jl.Torque(body_rates, pull, "motor")
    assert force.takes_inputs
    assert couple.takes_inputs
    for one, plain in (
        (force, jl.PointForce(corner, constant, "pull")),
        (couple, jl.Torque(body_rates, constant, "motor")),
    ):
        assert not plain.takes_inputs
        found = force_of(one, {"pull": jnp.array(3.0)})
        np.testing.assert_allclose(found, 3 * force_of(plain), rtol=16 * EPS, atol=16 * EPS)


def test_body_torques_act_on_euler_angles_by_the_transposed_rate_matrix():
    """Q = W^T tau with w = W (psi', theta', phi'); zero for the position."""
    found = force_of(jl.Torque(body_rates, constant, "motor"))
    W = np.asarray(rotation.yaw_pitch_roll.body_rate_matrix(Q[3:]))
    np.testing.assert_array_equal(found[:3], 0)
    np.testing.assert_allclose(found[3:], W.T @ np.asarray(PARAMS["F"]), atol=16 * EPS)


def test_a_torque_may_be_given_in_body_or_inertial_components():
    """One torque: components of torque and angular velocity in body or inertial axes."""

    def turned(t, q, v, params):
        return orientation(q) @ params["F"]

    body = force_of(jl.Torque(body_rates, constant, "motor"))
    space = force_of(jl.Torque(space_rates, turned, "motor"))
    np.testing.assert_allclose(body, space, atol=32 * EPS)


def test_a_plane_couple_is_a_scalar():
    couple = jl.Torque(
        lambda t, q, v, params: v[1] - v[0] + 2.0 * t, lambda t, q, v, params: params["F"][0], "m"
    )
    np.testing.assert_array_equal(force_of(couple), [-2.0, 2.0, 0, 0, 0, 0])


def test_force_equals_displaced_force_with_a_couple():
    """F at a point = F at the center + the couple (R arm) x F (Pila, sec. 3.12)."""

    def moment(t, q, v, params):
        return jnp.cross(orientation(q) @ params["arm"], params["F"])

    at_corner = force_of(jl.PointForce(corner, constant, "pull"))
    at_center = force_of(jl.PointForce(center, constant, "pull"))
    couple = force_of(jl.Torque(space_rates, moment, "moment"))
    np.testing.assert_allclose(at_corner, at_center + couple, atol=32 * EPS)
    assert np.max(np.abs(couple)) > 0.1


def test_a_moving_frame_adds_nothing_to_the_torque():
    """The part of w that does not depend on v does no virtual work."""

    def carried(t, q, v, params):
        return body_rates(t, q, v, params) + jnp.array([0.0, 0.0, 7.0]) * jnp.sin(t)

    expected = force_of(jl.Torque(body_rates, constant, "motor"))
    np.testing.assert_array_equal(force_of(jl.Torque(carried, constant, "motor")), expected)


def test_angular_velocity_may_be_a_derivative_of_a_rotation():
    """w by [w]x = R^T dR/dt, differentiated by JAX: detected as affine in v."""

    def rates(t, q, v, params):
        R, R_rate = jax.jvp(orientation, (q,), (v,))
        return rotation.body_rates(R, R_rate)

    found = force_of(jl.Torque(rates, constant, "motor"))
    np.testing.assert_allclose(found, force_of(jl.Torque(body_rates, constant, "m")), atol=32 * EPS)


@pytest.mark.parametrize(
    "rates",
    [
        lambda t, q, v, params: jax.lax.fori_loop(
            0, 3, lambda i, w: w + jnp.sin(q[i]) * v[i], jnp.zeros(())
        ),
        lambda t, q, v, params: jax.lax.scan(lambda w, x: (w + x, None), jnp.zeros(()), v)[0],
        lambda t, q, v, params: jax.lax.cond(
            q[0] > 0, lambda v: q[1] * v[:3], lambda v: 2 * v[:3], v
        ),
        lambda t, q, v, params: q[0] * v[:3] ** 1.0,
    ],
    ids=["fori_loop", "scan", "cond on q", "real power"],
)
def test_an_angular_velocity_may_come_from_loops_and_choices(rates):
    """Affine in v in any form: dw/dv is the same at two values of v."""
    tau = jnp.ones_like(rates(T, Q, V, PARAMS))
    found = force_of(jl.Torque(rates, lambda t, q, v, params: tau, "motor"))
    expected = jnp.tensordot(tau, jax.jacfwd(lambda v: rates(T, Q, v, PARAMS))(0 * V + 1), tau.ndim)
    np.testing.assert_allclose(found, expected, atol=8 * EPS)
    assert np.max(np.abs(found)) > 0.1


@pytest.mark.parametrize(
    "rates",
    [
        lambda t, q, v, params: v[:3] ** 2,
        lambda t, q, v, params: jax.lax.fori_loop(0, 3, lambda i, w: w * v[i], jnp.ones(())),
        lambda t, q, v, params: jax.lax.cond(v[0] > 0, lambda v: v[:3], lambda v: 2 * v[:3], v),
        lambda t, q, v, params: v[0] * v[1],
        lambda t, q, v, params: jnp.sin(v[:3]),
        lambda t, q, v, params: jnp.where(v[0] > 0, v[:3], 2 * v[:3]),
        lambda t, q, v, params: jnp.linalg.norm(v),
    ],
)
def test_an_angular_velocity_that_is_not_affine_is_refused(rates):
    def torque(t, q, v, params):
        return jnp.ones_like(rates(t, q, v, params))

    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        {"q": (N,)},
        forces=(jl.Torque(rates, torque, "motor"),),
    )
    message = (
        r"torque 'motor': `angular_velocity` must be affine in v, but its derivative dw/dv cont"
    )
    with pytest.raises(ValueError, match=message):
        system.acceleration(Q, V, PARAMS)
    with pytest.raises(ValueError, match=message):
        jl.simulate(system, Q, V, jnp.array([0.0, 1.0]), PARAMS)


def test_point_forces_and_torques_keep_the_precision_of_the_state():
    q, v = Q.astype(jnp.float32), V.astype(jnp.float32)

    def waving(t, q, v, params):  # float64, as time is
        return jnp.stack([jnp.cos(t), jnp.sin(t), t])

    single = {"arm": PARAMS["arm"].astype(jnp.float32)}
    for force in (jl.PointForce(corner, waving, "f"), jl.Torque(body_rates, waving, "c")):
        assert force(T, q, v, single, {}).dtype == jnp.float32


def test_derivatives_of_point_forces_and_torques_agree():
    """d Q / d params: forward, reverse and by the closed form (Q is linear in F)."""
    for force in (jl.PointForce(corner, constant, "f"), jl.Torque(space_rates, constant, "c")):

        def Q_of(F, force=force):
            return force_of(force, params=PARAMS | {"F": F})

        forward, reverse = jax.jacfwd(Q_of)(PARAMS["F"]), jax.jacrev(Q_of)(PARAMS["F"])
        np.testing.assert_allclose(forward, reverse, atol=16 * EPS)
        np.testing.assert_allclose(forward @ PARAMS["F"], Q_of(PARAMS["F"]), atol=32 * EPS)


POSITION = ("a scalar", lambda t, q, params: q[0]), ("four", lambda t, q, params: q[:4])


@pytest.mark.parametrize(("was", "position"), POSITION, ids=[was for was, _ in POSITION])
def test_a_position_of_wrong_shape_is_refused(was, position):
    force = jl.PointForce(position, constant, "pull")
    with pytest.raises(
        ValueError,
        match=r"force 'pull': `position` must return 1, 2 or 3 components along its last axis, but",
    ):
        force_of(force)


def test_an_angular_velocity_of_wrong_shape_is_refused():
    couple = jl.Torque(lambda t, q, v, params: v[:2], lambda t, q, v, params: v[:2], "motor")
    message = "torque 'motor': `angular_velocity` must return 3 components or a scalar, but it ret"
    with pytest.raises(ValueError, match=message):
        force_of(couple)


def test_shapes_of_force_and_torque_are_checked():
    def two(t, q, v, params):
        return jnp.ones(2)

    message = r"force 'pull': `force` must return shape \(3,\), but it returned \(2,\)\."
    with pytest.raises(ValueError, match=message):
        force_of(jl.PointForce(corner, two, "pull"))
    message = r"torque 'motor': `torque` must return shape \(3,\), but it returned \(2,\)\."
    with pytest.raises(ValueError, match=message):
        force_of(jl.Torque(body_rates, two, "motor"))
    message = "force 'pull': `force` must return an array, but it returned None"
    with pytest.raises(ValueError, match=message):
        force_of(jl.PointForce(corner, lambda t, q, v, params: None, "pull"))
    message = "force 'pull': `position` must return real numbers, but it returned int"
    with pytest.raises(ValueError, match=message):
        force_of(jl.PointForce(lambda t, q, params: jnp.arange(3), constant, "pull"))


def declarations():
    def short(t, q):
        return q

    yield "force 'f': position", lambda: jl.PointForce(short, constant, "f")
    yield "force 'f': force", lambda: jl.PointForce(corner, short, "f")
    yield "torque 'c': angular_velocity", lambda: jl.Torque(short, constant, "c")
    yield "torque 'c': torque", lambda: jl.Torque(body_rates, short, "c")


@pytest.mark.parametrize(("argument", "declare"), list(declarations()), ids=lambda x: str(x)[:24])
def test_functions_must_take_the_standard_arguments(argument, declare):
    owner, _, own = argument.partition(": ")
    with pytest.raises(ValueError, match=re.escape(f"{owner}: `{own}` must be callable as (t, q,")):
        declare()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ["", None, "explicit time"])
def test_invalid_names_are_refused(name):
    with pytest.raises(ValueError, match="PointForce: `name` must"):
        jl.PointForce(corner, constant, name)
    with pytest.raises(ValueError, match="Torque: `name` must"):
        jl.Torque(body_rates, constant, name)
