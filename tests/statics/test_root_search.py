"""Root search: no equilibrium, roots of higher order, kinks, rings, any units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _pendulum import PARAMS, PENDULUM

import jaxlag as jl
from systems import double_pendulum_static_load

EPS = np.finfo(float).eps


# ---- No equilibrium ------------------------------------------------------------------------------


def one(potential, forces=()):
    """A mass of 1 kg on a line in V(q, params)."""
    return jl.System(
        coordinates=("x",),
        kinetic=lambda t, q, v, params: 0.5 * v[0] ** 2,
        potential=lambda t, q, params: potential(q[0], params),
        forces=forces,
    )


def plane(potential, forces=(), constraints=()):
    """A mass of 1 kg in a plane in V(q, params)."""
    return jl.System(
        coordinates=("x", "y"),
        kinetic=lambda t, q, v, params: 0.5 * v @ v,
        potential=lambda t, q, params: potential(q, params),
        forces=forces,
        constraints=constraints,
    )


EXPONENTIAL = one(lambda x, params: params * jnp.exp(-x))
POWER = one(lambda x, params: x**-params)
LENNARD_JONES = one(lambda x, params: x**-12 - 2 * x**-6)
GAUSSIAN = one(lambda x, params: -1e6 * jnp.exp(-(x**2)))
VALLEY = plane(lambda q, params: jnp.exp(-q[0] - q[1]) + (q[0] - q[1]) ** 2 / 2)


@pytest.mark.parametrize(
    ("system", "q0", "params"),
    [
        pytest.param(POWER, [1e-4], 1.0, id="1/q"),
        pytest.param(POWER, [0.1], 6.0, id="q^-6", marks=pytest.mark.full),
        pytest.param(EXPONENTIAL, [0.0], 1e6, id="1e6 exp", marks=pytest.mark.full),
        pytest.param(EXPONENTIAL, [-20.0], 1.0, id="exp far", marks=pytest.mark.full),
        pytest.param(
            *(EXPONENTIAL, np.zeros(1, np.float32), np.float32(1)),
            id="exp float32",
            marks=pytest.mark.full,
        ),
        pytest.param(VALLEY, [5.0, 0.0], None, id="valley", marks=pytest.mark.full),
    ],
)
def test_decaying_forces_have_no_equilibrium(system, q0, params):
    """For any force at the start, and although it underflows in the end."""
    far = jl.equilibrium(system, jnp.asarray(q0), params, throw=False)
    assert far.status == jl.Status.implicit_solve_failed
    assert not far.stable


def test_well_is_found_from_beyond_its_inflection():
    """V = -1e6 exp(-q^2) from q = 1, where Newton's step and the least |F| lead outwards."""
    rest = jl.equilibrium(GAUSSIAN, [1.0])
    np.testing.assert_allclose(rest.q, 0, atol=EPS)
    assert rest.stable


@pytest.mark.parametrize("start", [0.01, 1e-10])
def test_root_is_found_from_immense_forces(start):
    """Lennard-Jones from 0.01 r0, 1e27 times the force unit, and 1e131 times: r0 = 1, K = 72."""
    rest = jl.equilibrium(LENNARD_JONES, [start])
    np.testing.assert_allclose(rest.q, [1.0], rtol=4 * EPS)
    # d2V/dr2 is the difference of 156 and 84; its derivative there is -1512.
    np.testing.assert_allclose(rest.stiffness, [[72.0]], atol=16 * EPS * 156 + 4 * EPS * 1512)
    assert rest.stable


# ---- Units ---------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_root_does_not_depend_on_units():
    """V times E, lengths times l: the same root relative to l, the same stability."""

    def potential(q, params):
        x, y = q / params["l"]
        return params["E"] * (3.0 * (x**4 / 4 + x**2 * y + y**2) - 1.4 * (2 * x + y))

    system = plane(potential)

    @jax.vmap
    def search(E, length):
        rest = jl.equilibrium(system, 0.5 * length * jnp.ones(2), {"E": E, "l": length})
        return rest.q / length, rest.status, rest.stable

    E, lengths = np.meshgrid([1.0, 1e-12, 1e-3, 1e12], [1.0, 1e-10, 1e3, 1e8])
    q, status, stable = search(E.ravel(), lengths.ravel())
    assert np.all(status == 0)
    assert np.all(stable == stable[0])
    # Rounding of the forces, which cancel from terms 3 times as large; the least eigenvalue of K is
    # about 3.
    np.testing.assert_allclose(q, np.broadcast_to(q[0], q.shape), rtol=32 * EPS)


@pytest.mark.full
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_weak_springs_and_small_forces_are_resolved(dtype):
    spring = one(lambda x, params: 0.5 * params["k"] * x**2 - params["F"] * x)
    for k, F in ((1e-3, 1e-10), (1e-9, 1e-12), (1e-6, 1e-12), (1e9, 1e12)):
        params = jax.tree.map(lambda x: jnp.asarray(x, dtype), {"k": k, "F": F})
        rest = jl.equilibrium(spring, jnp.zeros(1, dtype), params)
        np.testing.assert_allclose(rest.q, [F / k], rtol=4 * np.finfo(dtype).eps)
        assert rest.stable


def test_weak_gravity_and_wide_orbits_are_resolved():
    """Pendulum of 1e-8 J from 1.2 and 1.57 rad; geostationary radius; 1e11 from 1e10."""
    weak = PARAMS | {"m": 1e-8 / (0.7 * 9.81)}
    for start in (1.2, 1.57):
        np.testing.assert_allclose(jl.equilibrium(PENDULUM, [start], weak).q, 0, atol=4 * EPS)
    GM, w = 3.986e14, 7.2921e-5
    orbit = one(lambda r, params: -GM / r - 0.5 * w**2 * r**2)
    rest = jl.equilibrium(orbit, [4e7])
    np.testing.assert_allclose(rest.q, [np.cbrt(GM / w**2)], rtol=4 * EPS)
    assert not rest.stable
    wide = one(lambda x, params: 1e20 / x + 1e-2 * x)
    np.testing.assert_allclose(jl.equilibrium(wide, [1e10]).q, [1e11], rtol=4 * EPS)


# ---- Roots of higher order, kinks, rings ---------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize("order", [3, 4, 6])
def test_root_of_higher_order_is_found_and_not_stable(order):
    """V = q^n from 1: Newton's step q/(n - 1) ends below tol = 1e-10 of 1 + q."""
    rest = jl.equilibrium(one(lambda x, params: x**order), [1.0])
    assert abs(rest.q[0]) / (order - 1) <= 1e-10 * (1 + abs(rest.q[0]))
    assert not rest.stable


@pytest.mark.full
@pytest.mark.parametrize(
    "angle",
    [np.arctan2(0.8, 0.6), 0.0, 0.9],
)
def test_two_unstressed_springs_in_line_balance(angle):
    """Transverse to their line V is of order 4: F = 100 y^3, lost in rounding for y^3 < eps."""
    e = jnp.array([np.cos(angle), np.sin(angle)])
    springs = plane(
        lambda q, params: jl.energy.spring(100.0, q + e, 1.0) + jl.energy.spring(100.0, q - e, 1.0)
    )
    rest = jl.equilibrium(springs, [0.1, 0.2])
    np.testing.assert_allclose(rest.q, 0, atol=4 * np.cbrt(EPS))
    assert not rest.stable


@pytest.mark.full
def test_ring_of_equilibria_is_found_and_not_stable():
    """A single spring of length 1 about a pivot."""
    ring = plane(lambda q, params: jl.energy.spring(100.0, q, params))
    rest = jl.equilibrium(ring, [2.0, 0.1], 1.0)
    np.testing.assert_allclose(np.linalg.norm(rest.q), 1.0, rtol=4 * EPS)
    assert not rest.stable


@pytest.mark.full
def test_zero_length_is_stable_only_for_springs_without_free_length():
    """Otherwise V is the tip of a cone: the force points away in all directions."""
    pivot = plane(lambda q, params: jl.energy.spring(100.0, q, params))
    assert jl.equilibrium(pivot, [0.0, 0.0], 0.0).stable
    assert not jl.equilibrium(pivot, [0.0, 0.0], 1.0).stable


@pytest.mark.full
@pytest.mark.parametrize("factor", [1.0, 30.0, -30.0])
def test_large_loads_on_a_double_pendulum_lead_to_its_stable_branch(factor):
    """Each link hangs along the resultant of the forces at its lower end."""
    entry = double_pendulum_static_load.entry
    params = dict(entry.example.params)
    for name in ("Fx", "Fy", "Bx", "By"):
        params[name] *= factor
    rest = entry.rest(params)
    Fx, down = params["Fx"], params["m2"] * params["g"] - params["Fy"]
    theta1 = np.arctan2(Fx + params["Bx"], params["m1"] * params["g"] + down - params["By"])
    np.testing.assert_allclose(rest.q, [theta1, np.arctan2(Fx, down)], rtol=8 * EPS)
    assert rest.stable


# ---- Dependent constraint rows -------------------------------------------------------------------


@pytest.mark.full
def test_multipliers_of_dependent_rows_do_not_depend_on_the_start():
    """A rod declared twice: multipliers of least norm, as in the equations of motion."""

    def rod(t, q, params):
        r, length = jnp.sqrt(q @ q), params["l"]
        return jnp.stack([r**2 - length**2, 2.0 * (r - length)])

    system = plane(
        lambda q, params: 0.5 * params["k"] * (q[0] - 1.0) ** 2 + 9.81 * q[1],
        constraints=(jl.Holonomic(rod, "rod"),),
    )
    params = {"k": 20.0, "l": 1.3}

    @jax.jit
    def found(params, q0, direction):
        """(lam, q) and the derivative of lam along a direction of the params."""

        def lam(params):
            rest = jl.equilibrium(system, q0, params)
            return rest.multipliers["rod"], rest.q

        return jax.jvp(lam, (params,), (direction,))

    starts = [jnp.array(q0) for q0 in ((0.3, -1.2), (0.9, -0.9), (0.5, -0.4))]
    no_change = {"k": 0.0, "l": 0.0}
    (_, q), _ = found(params, starts[0], no_change)
    expected = system.multipliers(q, jnp.zeros(2), params)["rod"]
    h = 1e-5
    for q0 in starts:
        np.testing.assert_allclose(found(params, q0, no_change)[0][0], expected, rtol=1e-13)
        for name, value in params.items():
            slope = found(params, q0, {**no_change, name: 1.0})[1][0]
            moved = [{**params, name: value + s * h} for s in (1, -1)]
            ahead, behind = (found(p, q0, no_change)[0][0] for p in moved)
            np.testing.assert_allclose(slope, (ahead - behind) / (2 * h), rtol=1e-7)


# ---- Forces that depend on velocity --------------------------------------------------------------


def velocity_force(t, q, v, params):
    return -params @ v


DRIVEN = plane(
    lambda q, params: q[0] ** 2 + 0.5 * q[1] ** 2,
    (jl.GeneralizedForce(velocity_force, "driving"),),
)


@pytest.mark.parametrize(
    ("D", "stable"),
    [
        (np.zeros((2, 2)), True),
        (np.diag([2.0, 0.0]), True),
        (np.array([[0.0, 3.0], [-3.0, 0.0]]), True),
        (np.array([[1.0, 3.0], [-3.0, 0.0]]), True),
        (np.diag([-2.0, 0.0]), False),
        (np.diag([1.0, -1e-9]), False),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), False),
    ],
    ids=["none", "partial", "gyroscopic", "both", "excited", "slightly", "indefinite"],
)
def test_forces_that_feed_energy_in_make_a_minimum_unstable(D, stable):
    rest = jl.equilibrium(DRIVEN, [1.0, 0.2], jnp.asarray(D))
    np.testing.assert_allclose(rest.damping, D, rtol=4 * EPS, atol=0)
    assert bool(rest.stable) == stable
    assert rest.conservative


# ---- Derivatives for a singular K, and without a root --------------------------------------------


@pytest.mark.full
def test_cyclic_coordinate_does_not_affect_derivatives_of_others():
    cyclic = plane(lambda q, params: (q[0] - params**2) ** 2 / 2)

    def q(p):
        return jl.equilibrium(cyclic, [0.3, 0.2], p).q

    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(q)(0.7), [1.4, 0.0], rtol=8 * EPS)
    np.testing.assert_allclose(jax.hessian(q)(0.7), [2.0, 0.0], rtol=8 * EPS)


@pytest.mark.full
def test_free_carts_on_a_spring_have_the_derivative_of_least_norm():
    """Only x - y = p^2 is determined: each cart takes half of its change."""
    carts = plane(lambda q, params: (q[0] - q[1] - params**2) ** 2 / 2)

    def q(p):
        return jl.equilibrium(carts, [0.3, 0.2], p).q

    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(q)(0.7), [0.7, -0.7], rtol=16 * EPS)
    np.testing.assert_allclose(jax.hessian(q)(0.7), [1.0, -1.0], rtol=16 * EPS)


@pytest.mark.full
def test_failed_search_has_nan_derivatives():
    def q(p):
        return jl.equilibrium(EXPONENTIAL, [0.3], p, throw=False, max_steps=8).q[0]

    assert np.isfinite(q(0.7))
    assert np.isnan(jax.grad(q)(0.7))
    assert np.isnan(jax.jvp(q, (0.7,), (1.0,))[1])


@pytest.mark.full
def test_failed_lane_does_not_affect_derivatives_of_others():
    well = one(lambda x, params: jnp.exp(-x) + params * x)

    def q(p):
        return jl.equilibrium(well, [0.3], p, throw=False).q[0]

    found = jax.vmap(jax.grad(q))(jnp.array([0.5, 0.0]))  # q = -log(p), none for p = 0
    np.testing.assert_allclose(found[0], -2.0, rtol=8 * EPS)
    assert np.isnan(found[1])
