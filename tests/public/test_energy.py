"""Energies from positions and poses, against sums over the particles of a body and by hand."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import energy, rotation

EPS = np.finfo(float).eps
T = jnp.array(0.4)
RNG = np.random.default_rng(7)

# A body of six particles: masses and positions along the body axes from its origin.
MASSES = jnp.asarray(RNG.uniform(0.2, 1.0, 6))
PLACES = jnp.asarray(RNG.uniform(-0.5, 0.5, (6, 3)))
MASS = jnp.sum(MASSES)
CENTER = MASSES @ PLACES / MASS
INERTIA = jnp.sum(
    MASSES[:, None, None]
    * (
        jnp.sum(PLACES**2, axis=1)[:, None, None] * jnp.eye(3)
        - PLACES[:, :, None] * PLACES[:, None, :]
    ),
    axis=0,
)
BODY = energy.RigidBody(MASS, INERTIA, CENTER)
G = jnp.array([0.3, -0.2, -9.81])

PARAMETRIZATIONS = {
    "yaw_pitch_roll": (rotation.yaw_pitch_roll, 3),
    "zxz": (rotation.zxz, 3),
    "quaternion": (rotation.quaternion, 4),
}


def pose_of(parametrization):
    def pose(t, q, params):
        """Rotated by the coordinates, on a table that rotates and rises with time."""
        table = rotation.about_z(0.7 * t)
        return table @ parametrization.matrix(q[3:]), table @ q[:3] + jnp.stack(
            [0 * t, 0 * t, t**2]
        )

    return pose


def points_of(pose):
    def points(t, q, params):
        R, r = pose(t, q, params)
        return r + PLACES @ R.T

    return points


@pytest.fixture(params=PARAMETRIZATIONS)
def moving(request):
    parametrization, size = PARAMETRIZATIONS[request.param]
    rng = np.random.default_rng(11)
    q, v = jnp.asarray(rng.uniform(0.2, 1.0, 3 + size)), jnp.asarray(rng.uniform(-2, 2, 3 + size))
    return pose_of(parametrization), q, v


def test_kinetic_energy_of_a_body_is_that_of_its_particles(moving):
    """Eq. 2.16 with an offset mass center against sum 1/2 m_k v_k^2, in any parametrization."""
    pose, q, v = moving
    body = BODY.kinetic(pose, T, q, v, None)
    particles = energy.particles(points_of(pose), MASSES, T, q, v, None)
    np.testing.assert_allclose(body, particles, rtol=64 * EPS)


def test_gravity_acts_on_the_mass_center(moving):
    pose, q, _ = moving
    body = BODY.gravity(pose, T, q, None, G)
    particles = energy.gravity(MASSES, points_of(pose)(T, q, None), G)
    np.testing.assert_allclose(body, particles, rtol=64 * EPS)


def test_body_velocity_is_that_of_the_axes(moving):
    """V = R^T dr/dt; a body-fixed point moves at R (V + w x c)."""
    pose, q, v = moving
    V, w = energy.body_velocity(pose, T, q, v, None)
    R, _ = pose(T, q, None)
    rates = energy.velocity(points_of(pose), T, q, v, None)
    expected = (V + jnp.cross(w, PLACES)) @ R.T
    np.testing.assert_allclose(rates, expected, atol=64 * EPS * np.max(np.abs(rates)))


def test_energies_do_not_depend_on_the_origin_of_a_body():
    """The same body about its mass center: the same T and V, by the parallel axis theorem."""
    pose = pose_of(rotation.yaw_pitch_roll)
    rng = np.random.default_rng(3)
    q, v = jnp.asarray(rng.uniform(0.2, 1, 6)), jnp.asarray(rng.uniform(-2, 2, 6))

    def central_pose(t, q, params):
        R, r = pose(t, q, params)
        return R, r + R @ CENTER

    central = INERTIA - energy.parallel_axis(np.zeros((3, 3)), MASS, CENTER)
    body = energy.RigidBody(MASS, central)
    args = (T, q, v, None)
    np.testing.assert_allclose(
        body.kinetic(central_pose, *args), BODY.kinetic(pose, *args), rtol=64 * EPS
    )
    np.testing.assert_allclose(
        body.gravity(central_pose, T, q, None, G), BODY.gravity(pose, T, q, None, G), rtol=64 * EPS
    )
    shifted = energy.parallel_axis(central, MASS, CENTER)
    np.testing.assert_allclose(shifted, INERTIA, atol=8 * EPS)


def test_rates_may_be_given_directly():
    V, w = jnp.array([0.4, -1.0, 2.0]), jnp.array([0.3, 0.7, -0.5])
    point_rates = V + jnp.cross(w, PLACES)
    expected = 0.5 * jnp.sum(MASSES * jnp.sum(point_rates**2, axis=1))
    np.testing.assert_allclose(BODY.kinetic_from_rates(V, w), expected, rtol=32 * EPS)


def test_mass_matrix_of_a_free_body_equals_that_of_the_book():
    """d2T/d(V, w)2 = [[m E, -m [c]x], [m [c]x, I_O]] (eq. 2.16)."""

    def kinetic(Vw):
        return BODY.kinetic_from_rates(Vw[:3], Vw[3:])

    m, c = MASS, rotation.skew(CENTER)
    expected = jnp.block([[m * jnp.eye(3), -m * c], [m * c, INERTIA]])
    np.testing.assert_allclose(jax.hessian(kinetic)(jnp.ones(6)), expected, atol=16 * EPS)


def test_products_of_inertia_enter_with_a_minus():
    """I_xy = int x y dm positive: off-diagonals are minus the products."""
    x, y, z = PLACES.T
    products = [jnp.sum(MASSES * a * b) for a, b in ((x, y), (x, z), (y, z))]
    moments = [jnp.sum(MASSES * (a**2 + b**2)) for a, b in ((y, z), (x, z), (x, y))]
    found = energy.inertia_matrix(*moments, *products)
    np.testing.assert_allclose(found, INERTIA, atol=8 * EPS)
    np.testing.assert_array_equal(energy.inertia_matrix(1.0, 2.0, 3.0), np.diag([1.0, 2.0, 3.0]))


def test_particles_may_be_one_or_many_in_any_dimension():
    """1/2 m v^2 of one particle on a line and in the plane, by hand; moving frames included."""

    def circle(t, q, params):
        return params * jnp.stack([jnp.cos(q[0] + t), jnp.sin(q[0] + t)])

    q, v = jnp.array([0.3]), jnp.array([1.4])
    one = energy.particles(circle, 2.0, T, q, v, 0.5)
    np.testing.assert_allclose(one, 0.5 * 2.0 * (0.5 * 2.4) ** 2, rtol=8 * EPS)
    line = energy.particles(lambda t, q, params: q**2, 3.0, T, q, v, None)
    np.testing.assert_allclose(line, 0.5 * 3.0 * (2 * 0.3 * 1.4) ** 2, rtol=8 * EPS)

    def both(t, q, params):
        return jnp.stack([circle(t, q, 0.5), circle(t, q, 1.0)])

    two = energy.particles(both, jnp.array([2.0, 1.0]), T, q, v, None)
    np.testing.assert_allclose(two, one + 0.5 * 2.4**2, rtol=8 * EPS)
    same = energy.particles(both, 2.0, T, q, v, None)
    np.testing.assert_allclose(same, one + 2.4**2, rtol=8 * EPS)


def test_gravity_has_the_given_direction():
    """V = m g y with y upward."""
    V = energy.gravity(2.0, jnp.array([5.0, 3.0]), jnp.array([0.0, -9.81]))
    np.testing.assert_allclose(V, 2 * 9.81 * 3, rtol=4 * EPS)


def test_spring_has_derivatives_at_zero_length():
    """V = k/2 (|r| - l0)^2; Hessian k E at r = 0 with l0 = 0, and for l0 > 0 by convention."""
    k, r = 5.0, jnp.array([0.3, -0.4, 1.2])
    np.testing.assert_allclose(energy.spring(k, r, 0.9), 0.5 * k * 0.4**2, rtol=16 * EPS)
    np.testing.assert_allclose(energy.spring(k, r), 0.5 * k * 1.3**2, rtol=8 * EPS)
    zero = jnp.zeros(3)
    for length in (0.0, 0, jnp.array(0.0), 0.7):
        V, gradient, hessian = (
            f(energy.spring, argnums=1)(k, zero, length) if f else energy.spring(k, zero, length)
            for f in (None, jax.grad, jax.hessian)
        )
        np.testing.assert_allclose(V, 0.5 * k * float(length) ** 2, rtol=4 * EPS)
        np.testing.assert_array_equal(gradient, 0)
        np.testing.assert_array_equal(hessian, k * np.eye(3))
        third = jax.jacfwd(jax.hessian(energy.spring, argnums=1), argnums=1)(k, zero, length)
        np.testing.assert_array_equal(third, 0)
    # Stretched: k along the spring, k (1 - l0/|r|) across it.
    across = jax.hessian(energy.spring, argnums=1)(k, jnp.array([2.0, 0.0]), 0.5)
    np.testing.assert_allclose(across, np.diag([k, k * (1 - 0.5 / 2)]), atol=8 * EPS)


def test_system_of_these_energies_equals_that_by_hand():
    """A spherical pendulum by its position: the motion equals that of T and V by hand."""

    def position(t, q, params):
        theta, phi = q
        s = jnp.sin(phi)
        up = -jnp.cos(phi)
        return params["L"] * jnp.stack([jnp.cos(theta) * s, jnp.sin(theta) * s, up])

    def kinetic(t, q, v, params):
        return energy.particles(position, params["m"], t, q, v, params)

    def potential(t, q, params):
        g = params["g"] * jnp.array([0.0, 0.0, -1.0])
        return energy.gravity(params["m"], position(t, q, params), g)

    def by_hand(t, q, v, params):
        m, L = params["m"], params["L"]
        T = 0.5 * m * L**2 * (v[1] ** 2 + (v[0] * jnp.sin(q[1])) ** 2)
        return T + m * params["g"] * L * jnp.cos(q[1])

    built = jl.System(coordinates=("theta", "phi"), kinetic=kinetic, potential=potential)
    hand = jl.System(by_hand, ("theta", "phi"))
    params = {"m": 0.8, "L": 1.1, "g": 9.81}
    state = ([0.3, 0.9], [1.2, -0.4], params)
    np.testing.assert_allclose(built.acceleration(*state), hand.acceleration(*state), rtol=64 * EPS)
    assert built._structure(params, jnp.float64) == hand._structure(params, jnp.float64)


def test_bodies_may_be_params_with_derivatives():
    """A body in params: its leaves are traced, and derivatives of T by them are right."""

    def kinetic(body, V, w):
        return body.kinetic_from_rates(V, w)

    V, w = jnp.array([0.4, -1.0, 2.0]), jnp.array([0.3, 0.7, -0.5])
    gradient = jax.jit(jax.grad(kinetic))(BODY, V, w)
    np.testing.assert_allclose(gradient.inertia, 0.5 * np.outer(w, w), rtol=8 * EPS)
    expected = 0.5 * V @ V + V @ jnp.cross(w, CENTER)
    np.testing.assert_allclose(gradient.mass, expected, rtol=16 * EPS)
    np.testing.assert_allclose(gradient.center, MASS * jnp.cross(V, w), rtol=16 * EPS)


def test_coordinates_and_velocities_are_promoted_to_one_precision():
    """Integers and mixed precisions, for any promotion of dtypes in JAX."""

    def point(t, q, params):
        return q**2

    exact = energy.velocity(point, T, np.array([1.0, 2.0]), np.array([3.0, 4.0]), None)
    np.testing.assert_array_equal(exact, [6.0, 16.0])
    for q, v in [
        ([1, 2], [3, 4]),
        (np.array([1, 2], np.float32), np.array([3.0, 4.0])),
        (np.array([1.0, 2.0]), np.array([3, 4])),
    ]:
        np.testing.assert_array_equal(energy.velocity(point, 0, q, v, None), exact)
    np.testing.assert_array_equal(
        energy.velocity(lambda t, q, params: jnp.arange(3), T, [1.0], [1.0], None), np.zeros(3)
    )


def test_energies_keep_the_precision_of_the_state():
    """Bodies, masses, stiffnesses and g in float64, as Python lists are, the state in float32."""
    q, v = (jnp.asarray(x, jnp.float32) for x in (np.ones(3), np.arange(3)))

    def pose(t, q, params):
        return jnp.eye(3, dtype=q.dtype), q

    body, g = energy.RigidBody(1.0, [1.0, 2.0, 2.0], [0.1, 0.0, 0.0]), [0.0, 0.0, -9.81]
    for found in (
        body.kinetic(pose, T, q, v, None),
        body.gravity(pose, T, q, None, g),
        energy.particles(lambda t, q, params: q, np.array(2.0), T, q, v, None),
        energy.gravity(np.array(2.0), q, g),
        energy.spring(np.array(2.0), q, np.array(0.5)),
    ):
        assert found.dtype == jnp.float32


def wrong():
    unit, zero = np.eye(3), jnp.zeros(3)

    def flat(t, q, params):
        return rotation.about_z(q[0]), q[:2]

    yield (
        "mass",
        lambda: energy.RigidBody(-1.0, unit),
        "`mass` must not be negative, but it was -1.0",
    )
    yield (
        "masses",
        lambda: energy.RigidBody(np.ones(2), unit),
        "`mass` must be a number, but its sh",
    )
    yield (
        "center",
        lambda: energy.RigidBody(1.0, unit, [0.1, 0.2]),
        "`center` must be a vector of 3",
    )
    yield (
        "g",
        lambda: energy.gravity(1.0, zero, 9.81),
        "gravity: `g` must be a vector with one comp",
    )
    yield "g2", lambda: energy.gravity(1.0, zero, jnp.ones(2)), "gravity: `g` must be a vector with"
    yield (
        "spring",
        lambda: energy.spring(1.0, jnp.eye(2)),
        "spring: `r` must be one vector, but its",
    )
    yield (
        "particles",
        lambda: energy.particles(lambda t, q, p: q, jnp.ones(2), T, zero, zero, None),
        "`mass` must be a number, or one for each of the positions",
    )
    yield (
        "pose",
        lambda: energy.body_velocity(flat, T, zero, zero, None),
        "`pose` must return R of shape (3, 3) and r_O of shape (3,), but the shapes were (3, 3)",
    )
    yield (
        "pair",
        lambda: energy.body_velocity(lambda t, q, p: q, T, zero, zero, None),
        "`pose` must return the pair (R, r_O), but it returned JVPTracer",
    )
    yield (
        "pose numbers",
        lambda: energy.body_velocity(lambda t, q, p: ("R", q), T, zero, zero, None),
        "pose: `R` must be real numbers, but it was 'R'",
    )
    yield (
        "pose arity",
        lambda: energy.body_velocity(lambda t, q: (unit, q), T, zero, zero, None),
        "`pose` must be callable as (t, q, params), but its signature was (t, q)",
    )

    def particles_of(position, q=zero, v=zero, t=T):
        return lambda: energy.particles(position, 1.0, t, q, v, None)

    yield (
        "scalar",
        particles_of(lambda t, q, p: q[0]),
        "`position` must return a vector of shape (d,), or (k, d) for k particles, but it returned "
        "shape (). Return jnp.stack([x, y])",
    )
    yield (
        "list",
        particles_of(lambda t, q, p: [q[0], q[1]]),
        "`position` must return an array, but it returned list. Return jnp.stack([x, y])",
    )
    yield (
        "none",
        particles_of(lambda t, q, p: None),
        "`position` must return an array, but it returned None",
    )
    yield (
        "complex",
        particles_of(lambda t, q, p: jax.lax.complex(q, q)),
        "`position` must be real, but its dtype was compl",
    )
    yield (
        "arity",
        particles_of(lambda t, q: q),
        "`position` must be callable as (t, q, params), but its sig",
    )
    unequal_shapes = particles_of(lambda t, q, p: q, v=[1.0, 2.0])
    yield (
        "v",
        unequal_shapes,
        "`v` must have the shape of q, but their shapes were (2,) and (3,). Give one",
    )
    yield (
        "q",
        particles_of(lambda t, q, p: q, q="abc"),
        "`q` must be real numbers, but it was 'abc'.",
    )
    yield (
        "t",
        particles_of(lambda t, q, p: q, t=zero),
        "`t` must be a number, but its shape was (3,).",
    )
    body = energy.RigidBody(1.0, unit)
    yield "V", lambda: body.kinetic_from_rates(1.0, zero), "`V` must have shape (3,), but its shape"
    yield (
        "w",
        lambda: body.kinetic_from_rates(zero, None),
        "`w` must be real numbers, but it was No",
    )
    yield "nan", lambda: energy.RigidBody(np.nan, unit), "RigidBody: `mass` must be finite, but it"
    yield "text", lambda: energy.RigidBody("1", unit), "RigidBody: `mass` must be real numbers, but"
    yield "1j", lambda: energy.RigidBody(1j, unit), "RigidBody: `mass` must be real, but its dtype"
    yield (
        "infinite",
        lambda: energy.RigidBody(1.0, unit, [0, np.inf, 0]),
        "RigidBody: `center` must be finite, but it was [0.0, inf, 0.0]",
    )
    yield (
        "axis center",
        lambda: energy.parallel_axis(unit, 1.0, [1.0, 2.0]),
        "parallel_axis: `center` must be a vector of 3 components, but its shape was (2,)",
    )
    yield (
        "axis mass",
        lambda: energy.parallel_axis(unit, -1.0, zero),
        "parallel_axis: `mass` must not be negative, but it was -1.0 kg",
    )
    yield (
        "axis masses",
        lambda: energy.parallel_axis(unit, np.ones(3), zero),
        "parallel_axis: `mass` must be a number, but its shape was (3,)",
    )
    yield (
        "products",
        lambda: energy.inertia_matrix(1.0, 2.0, 3.0, Ixz=[0.1]),
        "inertia_matrix: `Ixz` must be a number, but its shape was (1,)",
    )
    yield (
        "stiffness",
        lambda: energy.spring(np.ones(3), zero),
        "spring: `stiffness` must be a number, but its shape was (3,)",
    )
    yield (
        "length",
        lambda: energy.spring(1.0, zero, np.ones(3)),
        "spring: `length` must be a number, but its shape was (3,)",
    )
    yield (
        "negative",
        lambda: energy.spring(1.0, zero, -0.1),
        "spring: `length` must not be negative, but it was -0.1 m",
    )
    yield "gravity r", lambda: energy.gravity(1.0, None, zero), "gravity: `r` must be real numbers"


@pytest.mark.parametrize(("call", "message"), [w[1:] for w in wrong()], ids=[w[0] for w in wrong()])
def test_invalid_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


def test_kinetic_energy_of_a_pose_is_that_of_its_rates(moving):
    """About the center of mass in inertial components, and about the origin in body components."""
    pose, q, v = moving
    by_pose = BODY.kinetic(pose, T, q, v, None)
    by_rates = BODY.kinetic_from_rates(*energy.body_velocity(pose, T, q, v, None))
    assert abs(by_pose - by_rates) < 64 * EPS * by_rates
