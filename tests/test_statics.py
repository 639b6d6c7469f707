"""Equilibrium by virtual work: closed forms, stability, derivatives, and searches that fail."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _user import unchecked  # noqa: F401

import jaxlag as jl
from systems import double_pendulum_static_load

EPS = np.finfo(float).eps


def pendulum_kinetic(t, q, v, params):
    return 0.5 * params["m"] * (params["l"] * v[0]) ** 2


def pendulum_potential(t, q, params):
    return -params["m"] * params["g"] * params["l"] * jnp.cos(q[0])


def bob(t, q, params):
    return params["l"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])


def wind(t, q, v, params, inputs):
    return jnp.stack([inputs["wind"], 0.0 * t])


PENDULUM = jl.System(coordinates=("theta",), kinetic=pendulum_kinetic, potential=pendulum_potential)
BLOWN = jl.System(
    coordinates=("theta",),
    kinetic=pendulum_kinetic,
    potential=pendulum_potential,
    forces=(
        jl.PointForce(bob, wind, "wind"),
        jl.Rayleigh(lambda t, q, v, params: 0.5 * v[0] ** 2, "air"),
    ),
)
PARAMS = {"m": 1.2, "l": 0.7, "g": 9.81}


def hoop(t, q, v, params):
    """Bead on a hoop of radius r turned about its vertical diameter at Omega."""
    r, omega = params["r"], params["Omega"]
    T = 0.5 * r**2 * (v[0] ** 2 + (omega * jnp.sin(q[0])) ** 2)
    return T + params["g"] * r * jnp.cos(q[0])


HOOP = jl.System(hoop, ("theta",))


def test_a_hanging_mass_is_stable_and_an_upright_one_is_not():
    down = jl.equilibrium(PENDULUM, [0.4], PARAMS)
    up = jl.equilibrium(PENDULUM, [3.0], PARAMS)
    np.testing.assert_allclose(down["theta"], 0, atol=4 * EPS)
    np.testing.assert_allclose(up["theta"], np.pi, rtol=4 * EPS)
    stiffness = 1.2 * 9.81 * 0.7
    np.testing.assert_allclose(down.stiffness, [[stiffness]], rtol=8 * EPS)
    np.testing.assert_allclose(up.eigenvalues, [-stiffness], rtol=8 * EPS)
    assert (bool(down.stable), bool(up.stable)) == (True, False)
    assert down.conservative
    assert up.conservative


def test_applied_forces_and_inputs_take_part():
    """Blown by W the bob hangs at tan(theta) = W/(m g); drag has no say at rest."""
    rest = jl.equilibrium(BLOWN, {"theta": 0.0}, PARAMS, inputs={"wind": 3.0})
    np.testing.assert_allclose(rest.q[0], np.arctan2(3.0, 1.2 * 9.81), rtol=8 * EPS)
    np.testing.assert_allclose(rest.stiffness[0, 0], 0.7 * np.hypot(3.0, 1.2 * 9.81), rtol=8 * EPS)
    table = {"wind": jl.Linear([0.0, 2.0], [0.0, 6.0])}
    then = jl.equilibrium(BLOWN, [0.0], PARAMS, t=1.0, inputs=table)
    np.testing.assert_allclose(then.q, rest.q, rtol=8 * EPS)


def test_a_rotating_frame_has_relative_equilibria():
    """Fast hoop: theta = 0 is unstable, cos(theta) = g/(r Omega^2) stable; slow: theta = 0 is."""
    fast = {"r": 0.5, "Omega": 6.0, "g": 9.81}
    off = jl.equilibrium(HOOP, [0.8], fast)
    np.testing.assert_allclose(off.q[0], np.arccos(9.81 / (0.5 * 36)), rtol=8 * EPS)
    assert off.stable
    assert not jl.equilibrium(HOOP, [0.0], fast).stable
    assert jl.equilibrium(HOOP, [0.0], fast | {"Omega": 4.0}).stable


def frame_potential(t, q, params):
    """Two springs of the plane crossed with a coupling: V with a full Hessian."""
    x, y = q
    return params["k"] * (x**4 / 4 + x**2 * y + y**2) - params["w"] * (2 * x + y)


FRAME = jl.System(
    coordinates=("x", "y"),
    kinetic=lambda t, q, v, params: 0.5 * v @ v,
    potential=frame_potential,
)


def test_the_stiffness_is_the_hessian_of_the_potential():
    params = {"k": 3.0, "w": 1.4}
    rest = jl.equilibrium(FRAME, [0.5, 0.5], params)
    gradient = jax.grad(frame_potential, argnums=1)(0.0, rest.q, params)
    np.testing.assert_allclose(gradient, 0, atol=16 * EPS * 10)
    hessian = jax.hessian(frame_potential, argnums=1)(0.0, rest.q, params)
    np.testing.assert_allclose(rest.stiffness, hessian, rtol=16 * EPS)
    assert rest.conservative
    assert rest.stable == bool(np.linalg.eigvalsh(hessian)[0] > 0)


def test_derivatives_are_those_of_the_implicit_function():
    """theta = atan(W/(m g)): first and second derivatives, in every mode, by closed form."""

    def theta(W, m):
        return jl.equilibrium(BLOWN, [0.1], PARAMS | {"m": m}, inputs={"wind": W})["theta"]

    W, m, g = 3.0, 1.2, 9.81
    b = m * g
    first = b / (b**2 + W**2), -W * g / (b**2 + W**2)
    for derivative in (jax.grad, jax.jacfwd, jax.jacrev):
        for i, expected in enumerate(first):
            found = derivative(theta, argnums=i)(W, m)
            np.testing.assert_allclose(found, expected, rtol=16 * EPS)
    second = -2 * b * W / (b**2 + W**2) ** 2
    for outer, inner in ((jax.jacfwd, jax.jacrev), (jax.jacrev, jax.jacfwd)):
        np.testing.assert_allclose(outer(inner(theta))(W, m), second, rtol=64 * EPS)


def test_a_batch_is_one_search_after_another():
    """Starts, params and failures side by side; a bad lane does not harm another."""
    starts = jnp.array([[0.4], [3.0], [jnp.nan]])

    def search(q0):
        return jl.equilibrium(PENDULUM, q0, PARAMS)

    many = jax.vmap(search)(starts)
    expected = [jl.Status.ok, jl.Status.ok, jl.Status.nonfinite]
    np.testing.assert_array_equal(many.status, [int(s) for s in expected])
    for i in range(2):
        np.testing.assert_allclose(many.q[i], search(starts[i]).q, atol=8 * EPS)
    np.testing.assert_array_equal(many.stable, [True, False, False])
    assert many["theta"].shape == (3,)


def test_single_precision_stays_single():
    single = jax.tree.map(jnp.float32, PARAMS)
    rest = jl.equilibrium(PENDULUM, jnp.array([0.4], jnp.float32), single)
    assert rest.q.dtype == jnp.float32
    np.testing.assert_allclose(rest.q, 0, atol=1e-6)


def test_no_callback_and_no_new_compilation():
    def search(q0):
        return jl.equilibrium(PENDULUM, q0, PARAMS).q

    assert "callback" not in str(jax.make_jaxpr(search)(jnp.array([0.4])))
    traces = 0

    def counted(t, q, params):
        nonlocal traces
        traces += 1
        return pendulum_potential(t, q, params)

    system = jl.System(coordinates=("theta",), kinetic=pendulum_kinetic, potential=counted)
    jl.equilibrium(system, [0.4], PARAMS)
    first = traces
    jl.equilibrium(system, [0.1], PARAMS | {"m": 2.0}, t=3.0)
    assert traces == first


def test_indifferent_coordinates_stay_where_they_are():
    """A cyclic coordinate: any value is an equilibrium, none is shown to be stable."""
    system = jl.System(
        coordinates=("x", "y"),
        kinetic=lambda t, q, v, params: 0.5 * v @ v,
        potential=lambda t, q, params: 2.0 * (q[0] - 0.5) ** 2,
    )
    rest = jl.equilibrium(system, [3.0, 0.7])
    np.testing.assert_allclose(rest.q, [0.5, 0.7], rtol=8 * EPS)
    assert not rest.stable


@pytest.mark.full
def test_follower_forces_have_no_potential():
    """A force that turns with the second of two links: K is not symmetric, and says so."""

    def tip(t, q, params):
        return jnp.stack([jnp.cumsum(jnp.cos(q))[-1], jnp.cumsum(jnp.sin(q))[-1]])

    def follower(t, q, v, params):
        return -params["F"] * jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])])

    column = jl.System(
        coordinates=("a", "b"),
        kinetic=lambda t, q, v, params: 0.5 * v @ v,
        potential=lambda t, q, params: 0.5 * q[0] ** 2 + 0.5 * (q[1] - q[0]) ** 2,
        forces=(jl.PointForce(tip, follower, "follower"),),
    )
    rest = jl.equilibrium(column, [0.1, 0.1], {"F": 0.5})
    np.testing.assert_allclose(rest.q, 0, atol=8 * EPS)
    assert not rest.conservative
    # By hand: Q_a = F sin(a - b), Q_b = 0.
    np.testing.assert_allclose(rest.stiffness, [[1.5, -0.5], [-1.0, 1.0]], atol=8 * EPS)


def test_where_nothing_balances_it_says_how_near_it_came():
    """A constant force has no equilibrium; sin(x) = 2 has none, its nearest point is pi/2."""
    pushed = jl.System(lambda t, q, v, params: 0.5 * v @ v + q[1], ("x", "y"))
    message = (
        r"status implicit_solve_failed: no equilibrium was found\. After \d+ steps the nearest "
        r"point was q = \[0\. 0\.\]; the force on 'y' left there is 1, 1\.0e\+00 of its scale 1\."
    )
    with pytest.raises(jl.EquilibriumError, match=message):
        jl.equilibrium(pushed, [0.0, 0.0])

    twisted = jl.System(lambda t, q, v, params: 0.5 * v @ v + jnp.cos(q[0]) + 2 * q[0], ("theta",))
    with pytest.raises(jl.EquilibriumError, match="the force on 'theta' left there is 1,") as info:
        jl.equilibrium(twisted, [0.5])
    near = info.value.equilibrium
    np.testing.assert_allclose(near.q, [np.pi / 2], atol=1e-6)
    np.testing.assert_allclose(near.residual, [1.0], atol=1e-12)
    assert not near.stable
    quiet = jl.equilibrium(twisted, [0.5], throw=False)
    assert quiet.status == jl.Status.implicit_solve_failed
    assert "no equilibrium was found" in quiet.message()


def test_a_search_cut_short_is_not_a_success():
    with pytest.raises(jl.EquilibriumError, match="After 1 steps the nearest point was"):
        jl.equilibrium(PENDULUM, [2.0], PARAMS, max_steps=1)


def test_what_is_not_finite_is_named():
    broken = jl.System(lambda t, q, v, params: 0.5 * v @ v + jnp.log(q[0]), ("x",))
    with pytest.raises(jl.EquilibriumError, match=r"status nonfinite: .* the force on 'x'"):
        jl.equilibrium(broken, [0.0])


# ---- What is no equilibrium ----------------------------------------------------------------------


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
        pytest.param(GAUSSIAN, [1.0], None, id="gaussian"),
        pytest.param(LENNARD_JONES, [1e-10], None, id="r^-12", marks=pytest.mark.full),
        pytest.param(VALLEY, [5.0, 0.0], None, id="valley", marks=pytest.mark.full),
    ],
)
def test_forces_that_only_die_away_are_not_balanced(system, q0, params):
    """However large the force at the start was, and though it underflows in the end."""
    far = jl.equilibrium(system, jnp.asarray(q0), params, throw=False)
    assert far.status == jl.Status.implicit_solve_failed
    assert not far.stable


def test_a_root_is_found_from_where_the_force_is_immense():
    """Lennard-Jones from 0.01 r0, 1e27 times the force unit: r0 = 1, K = 72."""
    rest = jl.equilibrium(LENNARD_JONES, [0.01])
    np.testing.assert_allclose(rest.q, [1.0], rtol=4 * EPS)
    # d2V/dr2 is the difference of 156 and 84; its derivative there is -1512.
    np.testing.assert_allclose(rest.stiffness, [[72.0]], atol=16 * EPS * 156 + 4 * EPS * 1512)
    assert rest.stable


# ---- Units ---------------------------------------------------------------------------------------


@pytest.mark.full
def test_a_root_does_not_depend_on_units():
    """V times E, lengths times l: the same root relative to l, the same verdict."""

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
    # Rounding of the forces, which cancel from terms 3 times as large, on a K of least
    # eigenvalue about 3.
    np.testing.assert_allclose(q, np.broadcast_to(q[0], q.shape), rtol=32 * EPS)


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


# ---- Roots of higher order, edges, rings ---------------------------------------------------------


@pytest.mark.parametrize("order", [3, 4, 6])
def test_a_higher_order_is_found_and_not_called_stable(order):
    """V = q^n from 1: Newton's step is q/(n - 1), below tol = 1e-10 of 1 + q in the end."""
    rest = jl.equilibrium(one(lambda x, params: x**order), [1.0])
    assert abs(rest.q[0]) / (order - 1) <= 1e-10 * (1 + abs(rest.q[0]))
    assert not rest.stable


@pytest.mark.full
@pytest.mark.parametrize(
    "angle",
    [np.arctan2(0.8, 0.6), 0.0, 0.9],
)
def test_two_unstressed_springs_in_line_balance(angle):
    """Across their line V is of order 4, F = 100 y^3, lost in rounding where y^3 < eps."""
    e = jnp.array([np.cos(angle), np.sin(angle)])
    springs = plane(
        lambda q, params: jl.energy.spring(100.0, q + e, 1.0) + jl.energy.spring(100.0, q - e, 1.0)
    )
    rest = jl.equilibrium(springs, [0.1, 0.2])
    np.testing.assert_allclose(rest.q, 0, atol=4 * np.cbrt(EPS))
    assert not rest.stable


@pytest.mark.full
def test_a_ring_of_equilibria_is_found_and_not_called_stable():
    """A spring of length 1 about a pivot and nothing else."""
    ring = plane(lambda q, params: jl.energy.spring(100.0, q, params))
    rest = jl.equilibrium(ring, [2.0, 0.1], 1.0)
    np.testing.assert_allclose(np.linalg.norm(rest.q), 1.0, rtol=4 * EPS)
    assert not rest.stable


def test_the_zero_length_of_a_spring_is_stable_without_unstretched_length_only():
    """Else V is the tip of a cone, where the force points away in all directions."""
    pivot = plane(lambda q, params: jl.energy.spring(100.0, q, params))
    assert jl.equilibrium(pivot, [0.0, 0.0], 0.0).stable
    assert not jl.equilibrium(pivot, [0.0, 0.0], 1.0).stable


@pytest.mark.full
@pytest.mark.parametrize("factor", [1.0, 30.0, -30.0])
def test_large_loads_on_a_double_pendulum_lead_to_its_stable_branch(factor):
    """Each link hangs along the resultant of what pulls at its lower end."""
    entry = double_pendulum_static_load.entry
    params = dict(entry.example.params)
    for name in ("Fx", "Fy", "Bx", "By"):
        params[name] *= factor
    rest = entry.rest(params)
    Fx, down = params["Fx"], params["m2"] * params["g"] - params["Fy"]
    theta1 = np.arctan2(Fx + params["Bx"], params["m1"] * params["g"] + down - params["By"])
    np.testing.assert_allclose(rest.q, [theta1, np.arctan2(Fx, down)], rtol=8 * EPS)
    assert rest.stable


# ---- Constraints that depend on one another ------------------------------------------------------


@pytest.mark.full
def test_multipliers_of_dependent_rows_do_not_depend_on_the_start():
    """A rod declared twice: of least norm, as in the equations of motion, and so differentiated."""

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
            return rest.lam["rod"], rest.q

        return jax.jvp(lam, (params,), (direction,))

    starts = [jnp.array(q0) for q0 in ((0.3, -1.2), (0.9, -0.9), (0.5, -0.4))]
    still = {"k": 0.0, "l": 0.0}
    (_, q), _ = found(params, starts[0], still)
    expected = system.multipliers(params, q, jnp.zeros(2))["rod"]
    h = 1e-5
    for q0 in starts:
        np.testing.assert_allclose(found(params, q0, still)[0][0], expected, rtol=1e-13)
        for name, value in params.items():
            slope = found(params, q0, {**still, name: 1.0})[1][0]
            moved = [{**params, name: value + s * h} for s in (1, -1)]
            ahead, behind = (found(p, q0, still)[0][0] for p in moved)
            np.testing.assert_allclose(slope, (ahead - behind) / (2 * h), rtol=1e-7)


# ---- Forces of velocity --------------------------------------------------------------------------


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


# ---- Derivatives where K is singular, and where there is no root ---------------------------------


@pytest.mark.full
def test_a_cyclic_coordinate_leaves_the_derivatives_of_others_alone():
    cyclic = plane(lambda q, params: (q[0] - params**2) ** 2 / 2)

    def q(p):
        return jl.equilibrium(cyclic, [0.3, 0.2], p).q

    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(q)(0.7), [1.4, 0.0], rtol=8 * EPS)
    np.testing.assert_allclose(jax.hessian(q)(0.7), [2.0, 0.0], rtol=8 * EPS)


@pytest.mark.full
def test_free_carts_on_a_spring_have_the_derivative_of_least_norm():
    """Only x - y is determined, = p^2: each cart takes half of its change."""
    carts = plane(lambda q, params: (q[0] - q[1] - params**2) ** 2 / 2)

    def q(p):
        return jl.equilibrium(carts, [0.3, 0.2], p).q

    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(q)(0.7), [0.7, -0.7], rtol=16 * EPS)
    np.testing.assert_allclose(jax.hessian(q)(0.7), [1.0, -1.0], rtol=16 * EPS)


def test_where_no_equilibrium_was_found_there_is_no_derivative():
    def q(p):
        return jl.equilibrium(EXPONENTIAL, [0.3], p, throw=False, max_steps=8).q[0]

    assert np.isfinite(q(0.7))
    assert np.isnan(jax.grad(q)(0.7))
    assert np.isnan(jax.jvp(q, (0.7,), (1.0,))[1])


def test_a_failing_lane_does_not_spoil_the_derivative_of_another():
    well = one(lambda x, params: jnp.exp(-x) + params * x)

    def q(p):
        return jl.equilibrium(well, [0.3], p, throw=False).q[0]

    found = jax.vmap(jax.grad(q))(jnp.array([0.5, 0.0]))  # q = -log(p), none for p = 0
    np.testing.assert_allclose(found[0], -2.0, rtol=8 * EPS)
    assert np.isnan(found[1])


# ---- Arguments -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q0": [0.1, 0.2]}, "q0 must have shape (1,), but its shape was (2,)."),
        ({"q0": [np.inf]}, "q0 must be finite, but it was [inf]"),
        ({"max_steps": 0}, "max_steps must be a positive integer, but it was 0."),
        ({"max_steps": True}, "max_steps must be a positive integer, but it was True."),
        ({"tol": -1.0}, "tol must be a positive number, but it was -1.0."),
        ({"tol": np.nan}, "tol must be finite, but it was nan."),
        ({"tol": np.inf}, "tol must be finite, but it was inf."),
        ({"tol": 1.0}, "tol must be less than 1, but it was 1.0."),
        ({"tol": "a"}, "tol must be a positive number, but it was 'a'."),
        ({"tol": [1e-3, 1e-3]}, "tol must be a positive number, but its shape was (2,)."),
        ({"t": np.nan}, "t must be finite, but it was nan."),
        ({"t": "a"}, "t must be a number, but it was 'a'."),
        ({"t": [0.0, 1.0, 2.0]}, "t must be a number, but its shape was (3,)."),
        ({"system": "pendulum"}, "system must be a jl.System, but it was 'pendulum'."),
        ({"inputs": {"wind": 1.0}}, "inputs must hold only signals that a force reads"),
    ],
    ids=str,
)
def test_wrong_arguments_are_refused(changes, message):
    given = {"system": PENDULUM, "q0": [0.1], "params": PARAMS} | changes
    with pytest.raises(ValueError, match=re.escape(message)):
        jl.equilibrium(**given)


@pytest.mark.parametrize("name", ["t", "tol"])
def test_traced_arguments_of_wrong_shape_are_refused(name):
    def search(x):
        return jl.equilibrium(PENDULUM, [0.1], PARAMS, **{name: x}).q

    with pytest.raises(ValueError, match=rf"^{name} must be a .*number, but its shape was \(2,\)"):
        jax.jit(search)(jnp.full(2, 1e-3))
