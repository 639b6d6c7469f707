"""Extreme constraints: far from the origin, unequal masses, singular states, no inertia."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _systems.mechanisms import FOUR_BAR, four_bar
from numpy import cos, sin

import jaxlag as jl

G = 9.81
TIGHT = {"rtol": 1e-11, "atol": 1e-11, "throw": False}


def free(t, q, v, params):
    return 0.5 * v @ v


# ---- Rows that were left out ---------------------------------------------------------------------


def diverging(t, q, params):
    """Two rows that are equal at y = 0 and differ as y grows."""
    return jnp.stack([q[0], q[0] + q[1] ** 3])


@pytest.mark.full
@pytest.mark.parametrize(
    "stabilization", mostly_full(["projection", None, jl.Baumgarte(5.0, 5.0)], "projection")
)
def test_rows_that_become_inconsistent_are_reported(stabilization):
    system = jl.System(free, ("x", "y"), constraints=(jl.Holonomic(diverging, ("a", "b")),))
    motion = jl.simulate(
        system,
        [0.0, 0.0],
        [0.0, 1.0],
        [0.0, 1.0],
        stabilization=stabilization,
        method="tsit5",
        throw=False,
    )
    assert motion.status == jl.Status.rank_change
    assert motion.last_time < 0.05


@pytest.mark.full
@pytest.mark.parametrize("gap", mostly_full([1e-6, 1e-9, 1e-11, 1e-13], 1e-9, 1e-13))
def test_small_contradictions_are_reported(gap):
    """Two lengths of one rod; differences below rounding do not count."""
    rods = (jl.Holonomic(rod, "rod"), jl.Holonomic(lambda t, q, p: rod(t, q, p) - p, "other"))
    system = jl.System(pendulum, ("x", "y"), constraints=rods)
    motion = jl.simulate(
        system, [1.0, 0.0], [0.0, 0.0], [0.0, 1.0], gap, dt=0.1, method="tsit5", throw=False
    )
    if gap < 1e-12:
        assert motion.status == jl.Status.ok
    else:
        assert motion.status == jl.Status.contradictory_rows
        assert "('other')" in motion.message()


# ---- Backward in time ----------------------------------------------------------------------------


def pendulum(t, q, v, params):
    return 0.5 * v @ v - G * q[1]


def rod(t, q, params):
    return q @ q - 1.0


@pytest.mark.full
@pytest.mark.parametrize("traced", [False, True])
def test_baumgarte_damps_backward_in_time(traced):
    """Forward and backward: alpha has the direction of time."""
    system = jl.System(pendulum, ("x", "y"), constraints=(jl.Holonomic(rod, "rod"),))

    def end(ts):
        return jl.simulate(
            system, [1.0, 0.0], [0.0, 0.0], ts, stabilization=jl.Baumgarte(20.0, 20.0), **TIGHT
        ).q[-1]

    ahead, back = map(jax.jit(end) if traced else end, map(jnp.array, ([0.0, 2.0], [0.0, -2.0])))
    np.testing.assert_allclose(back, ahead, atol=1e-8)  # it starts at rest
    assert abs(rod(0.0, back, None)) < 1e-9


# ---- Far from the origin -------------------------------------------------------------------------


def chain(t, q, v, params):
    return 0.25 * v @ v - 0.5 * G * (q[2] + q[5])


def links(t, q, x0):
    first, second = q[:3] - jnp.array([1.0, 0.0, 0.0]) * x0, q[3:] - q[:3]
    return jnp.stack([first @ first - 1.0, second @ second - 1.0])


@pytest.mark.full
def test_motion_does_not_depend_on_the_distance_from_the_origin():
    """Two rods of 1 m that hang 100 km from the origin move as they do near it."""
    system = jl.System(
        chain, {"a": (3,), "b": (3,)}, constraints=(jl.Holonomic(links, ("upper", "lower")),)
    )

    def moved(x0, off=0.0):
        q0 = [x0 + 1.0 + off, 0.0, 0.0, x0 + 2.0, 0.0, 0.0]
        return jl.simulate(system, q0, [0.0] * 6, [0.0, 0.3], x0, throw=False)

    near, far = moved(0.0), moved(1e5)
    assert near.status == far.status == 0
    np.testing.assert_allclose(far.q[-1, [2, 5]], near.q[-1, [2, 5]], rtol=1e-6)
    assert moved(1e5, off=0.2).status == jl.Status.inconsistent_start


# ---- Unequal masses ------------------------------------------------------------------------------


def cart(t, q, v, params):
    heavy, light = params["M"], params["m"]
    return 0.5 * heavy * v[0] ** 2 + 0.5 * light * (v[1] ** 2 + v[2] ** 2) - light * G * q[2]


def hanging(t, q, params):
    return (q[1] - q[0]) ** 2 + q[2] ** 2 - 1.0


@pytest.mark.full
@pytest.mark.parametrize("formulation", ["multipliers", "null_space"])
def test_masses_of_ratio_1e12_move_accurately(formulation):
    """Compared with one coordinate; params traced: M = 1e12 m."""
    system = jl.System(cart, ("X", "x", "y"), constraints=(jl.Holonomic(hanging, "rod"),))
    angle, heavy, light = 1.0, 1e11, 0.1
    start = [0.0, sin(angle), -cos(angle)], [0.0, 0.0, 0.0]

    @jax.jit
    def run(params):
        return jl.simulate(system, *start, [0.0, 1.0], params, formulation=formulation, **TIGHT)

    motion = run({"M": heavy, "m": light})
    assert motion.status == 0
    single = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + G * jnp.cos(q[0]), ("angle",))
    expected = jl.simulate(single, [angle], [0.0], [0.0, 1.0], **TIGHT).q[-1, 0]
    np.testing.assert_allclose(motion.q[-1, 1], sin(expected), atol=1e-9)
    even = run({"M": 1.0, "m": 1.0})
    assert motion.stats["accepted"] < 3 * even.stats["accepted"]


# ---- Almost dependent rows -----------------------------------------------------------------------


def almost(t, q, angle):
    return jnp.stack([q[0], q[0] * jnp.cos(angle) + q[1] * jnp.sin(angle)])


@pytest.mark.full
@pytest.mark.parametrize("angle", [1e-2, 2e-4, 5e-5])
def test_reactions_of_almost_dependent_rows_are_accurate(angle):
    """Both rows hold x and y; sin(angle)^2 gives the lost digits."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - G * q[1] + q[0] - 3.0 * q[2],
        ("x", "y", "z"),
        constraints=(jl.Holonomic(almost, ("a", "b")),),
    )
    state = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    atol = 1e-14 / sin(angle) ** 2
    np.testing.assert_allclose(system.acceleration(*state, angle), [0, 0, -3], atol=atol)
    np.testing.assert_allclose(system.constraint_force(*state, angle), [-1, G, 0], atol=G * atol)
    lam = system.multipliers(*state, angle)
    np.testing.assert_allclose(lam["b"], G / sin(angle), rtol=1e-6)


# ---- Singular inertia ----------------------------------------------------------------------------


def polar(t, q, v, params):
    return 0.5 * params * (v[0] ** 2 + (q[0] * v[1]) ** 2) - 0.5 * q[0] ** 2


@pytest.mark.full
@pytest.mark.parametrize("traced", mostly_full([False, True], False))
def test_start_with_singular_inertia_is_solved(traced):
    """A slot through the center of polar coordinates: r = sin(t)."""
    slot = jl.Holonomic(lambda t, q, params: q[1] - 0.3, "slot")
    system = jl.System(polar, ("r", "phi"), constraints=(slot,))

    def end(params):
        return jl.simulate(system, [0.0, 0.3], [1.0, 0.0], [0.0, 1.0], params, **TIGHT).q[-1, 0]

    found = (jax.jit(end) if traced else end)(1.0)
    np.testing.assert_allclose(found, sin(1.0), atol=1e-10)


@pytest.mark.full
def test_traced_start_with_singular_inertia_is_solved():
    """A slot that rotates at rate 2: r = cosh(2 t) r0 + sinh(2 t)/2, also from the center."""
    rotation = jl.Pfaffian(lambda t, q, v, params: v[1] - 2.0, "turn")
    system = jl.System(
        lambda t, q, v, params: 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2),
        ("r", "phi"),
        constraints=(rotation,),
    )

    def end(r):
        start = jnp.stack([r, 0.0]), jnp.array([1.0, 2.0])
        return jl.simulate(system, *start, jnp.array([0.0, 1.0]), method="tsit5", **TIGHT).q[-1, 0]

    r = jnp.array([0.0, 0.3])
    expected = np.cosh(2.0) * r + 0.5 * np.sinh(2.0)
    np.testing.assert_allclose(jax.vmap(end)(r), expected, rtol=1e-9)


def spring(t, q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2


def geared(**options):
    """x drives a wheel a by rolling, and a drives b by a gear; neither wheel has inertia."""
    return jl.System(
        spring,
        ("x", "a", "b"),
        constraints=(
            jl.Holonomic(lambda t, q, params: q[1] + 2 * q[2], "gear"),
            jl.Pfaffian(lambda t, q, v, params: v[0] - params * v[1], "roll"),
        ),
        **options,
    )


@pytest.mark.parametrize("formulation", ["multipliers", "null_space"])
def test_rows_without_inertia_have_an_effective_mass(formulation):
    """That of M + A^T W A, W = (1/5, 1): otherwise their distance from dependence is 0/0."""
    terms = replace(geared()._terms, formulation=formulation, crossing=True)
    K, masses = terms.corrections(jnp.zeros(()), jnp.zeros(3), jnp.zeros(3), 0.5)
    np.testing.assert_allclose(K, [[0, 0], [0, -2], [0.5, 1]], atol=1e-15)
    np.testing.assert_allclose(masses, [0.2, 1.0], rtol=1e-14)


@pytest.mark.full
@pytest.mark.parametrize(
    ("formulation", "lowering"),
    [
        ("multipliers", "auto"),
        pytest.param("null_space", "auto", marks=pytest.mark.full),
        pytest.param("multipliers", "array", marks=pytest.mark.full),
    ],
)
def test_massless_wheels_move_with_the_body(formulation, lowering):
    """Held by one row of velocities and one of positions: x = 0.3 cos t, a = (x - 0.3)/r."""
    motion = jl.simulate(
        geared(lowering=lowering),
        [0.3, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 1.0],
        0.5,
        formulation=formulation,
        **TIGHT,
    )
    x = 0.3 * cos(1.0)
    np.testing.assert_allclose(motion.q[-1], [x, (x - 0.3) / 0.5, (0.3 - x)], atol=1e-10)


def test_massless_wheels_are_assembled():
    state = jl.assemble(geared(), [0.3, 0.1, 0.0], [0.2, 0.0, 0.0], 0.5)
    np.testing.assert_allclose(state.q[1] + 2 * state.q[2], 0.0, atol=1e-15)
    np.testing.assert_allclose(state.v[0], 0.5 * state.v[1], atol=1e-15)


def test_complete_state_may_be_held():
    """Nothing is free to move, and nothing needs to move."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * p * v @ v, ("x", "y"), constraints=(jl.Holonomic(rod, "rod"),)
    )
    hold = ("x", "y", "x'", "y'")
    state = jl.assemble(system, [0.6, -0.8], [0.8, 0.6], 30.0, hold=hold)
    np.testing.assert_array_equal(state.q, [0.6, -0.8])


# ---- Flat loops, where a row is sin(pi) --------------------------------------------------------


PARALLELOGRAM = FOUR_BAR | {"a": 0.5, "b": 1.0, "c": 0.5, "d": 1.0}


@pytest.mark.full
@pytest.mark.parametrize("crank", [0.0, np.pi])
def test_rows_of_rounding_do_not_count(crank):
    """Only y of the pin holds; no forces along x are computed from a row of 1e-16."""
    params, q, v = PARALLELOGRAM, [crank, 0.0, crank + np.pi], [0.3, 0.2, -0.7]
    found = jl.assemble(four_bar, q, v, params)
    assert int(found.rank) == 1
    A = np.array([0.5 * cos(crank), 1.0, 0.5 * cos(crank + np.pi)])
    M = four_bar.mass_matrix(q, params=params)
    direction = np.linalg.solve(M, A)
    np.testing.assert_allclose(found.v, v - direction * (A @ v) / (A @ direction), atol=1e-12)
    rest = four_bar.multipliers(q, np.zeros(3), params)["pin"]
    h = four_bar.bias(q, np.zeros(3), params)
    expected = direction @ h / (A @ direction)
    np.testing.assert_allclose(rest, [0.0, expected], rtol=1e-12, atol=1e-12)


def test_contradictory_rows_give_nan_accelerations():
    """To rotate through the flat configuration the links would have to leave the pin."""
    a = four_bar.acceleration([0.0, 0.0, np.pi], [1.0, -0.5, 0.0], PARALLELOGRAM)
    assert np.all(np.isnan(a))


def once_more(t, q, v, params):
    """One row twice, once times a factor that depends on x."""
    row = 0.7 * v[1] + 0.3 * params
    return jnp.stack([(1.5 + jnp.sin(q[0])) * row, row])


@pytest.mark.full
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_rounding_of_one_row_does_not_contradict_another(dtype):
    """The factor's rate times the rounding of the row: the row itself requires 0."""
    system = jl.System(free, ("x", "y"), constraints=(jl.Pfaffian(once_more, "rows"),))
    params = jnp.arange(0.1, 1.2, 0.1, dtype=dtype)
    q, speed = jnp.asarray([0.3, 0.1], dtype), dtype(2.0)

    def acceleration(p):
        v = jnp.stack([jnp.asarray(speed), -0.3 * p / 0.7]).astype(dtype)
        return system.acceleration(q, v, p)

    found = jax.vmap(acceleration)(params)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, np.zeros((11, 2)), atol=16 * np.finfo(dtype).eps)


# ---- Starts that cannot be solved ----------------------------------------------------------------


@pytest.mark.full
def test_a_row_that_vanishes_at_the_start_is_named():
    """The user's state is returned; it is finite."""
    system = jl.System(
        free, ("x", "y"), constraints=(jl.Holonomic(lambda t, q, params: q[0] ** 2, "flat"),)
    )
    motion = jl.simulate(system, [0.0, 1.0], [0.0, 1.0], [0.0, 1.0], throw=False)
    assert motion.status == jl.Status.rank_change
    assert "('flat')" in motion.message()
    np.testing.assert_array_equal(motion.last_state[0], [0.0, 1.0])


@pytest.mark.full
def test_residual_that_is_not_finite_is_reported_as_nonfinite():
    system = jl.System(
        free, ("x", "y"), constraints=(jl.Holonomic(lambda t, q, p: jnp.log(q[0]), "log"),)
    )
    motion = jl.simulate(system, [-1.0, 1.0], [0.0, 1.0], [0.0, 1.0], throw=False)
    assert motion.status == jl.Status.nonfinite


@pytest.mark.full
def test_lane_without_a_start_does_not_affect_derivatives():
    """Neither a NaN lane nor one off the constraint affects derivatives by shared params."""
    system = jl.System(pendulum, ("x", "y"), constraints=(jl.Holonomic(rod, "rod"),))

    def height(angle, length, g):
        q = length * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        motion = jl.simulate(
            system, q, g * jnp.zeros(2), jnp.array([0.0, 0.3]), method="tsit5", dt=0.1, throw=False
        )
        return motion.status, jnp.where(motion.ok, motion.q[-1, 1], 0.0)

    def total(angles, lengths, g):
        status, heights = jax.vmap(height, (0, 0, None))(angles, lengths, g)
        return jnp.sum(heights), status

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2), has_aux=True))
    angles, lengths = jnp.array([0.3, jnp.nan, 0.7, 1.2]), jnp.array([1.0, 1.0, 1.5, 1.0])
    found, status = slopes(angles, lengths, 1.0)
    assert [jl.Status(int(kind)).name for kind in status] == [
        *("ok", "bad_value", "inconsistent_start", "ok")
    ]
    alone, _ = slopes(angles[::3], lengths[::3], 1.0)
    assert np.all(np.isfinite(alone[0]))
    np.testing.assert_allclose(found[0][::3], alone[0], rtol=1e-12)
    np.testing.assert_array_equal(found[2], alone[2])
