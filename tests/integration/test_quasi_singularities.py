"""Motions that reach a singularity of their quasi-velocities."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _jaxprs import loop, operations

import jaxlag as jl
from jaxlag._core._errors import SimulationError
from jaxlag._core._status import Status
from jaxlag._integration._quasi_singularities import resolved
from jaxlag._simulation import _problem

SINGULAR = int(Status.kinematics_singular)
DRAG = 0.1


def free(t, q, v, params):
    return 0.5 * (v @ v)


def cosine(t, q, v, params):
    return jnp.stack([jnp.cos(q[1]) * v[0], v[1]])


def drag(t, q, v, params):
    return 0.5 * DRAG * (v @ v)


def weighted(U=cosine, lagrangian=free, **options):
    """By default y moves freely past 90 degrees, where the first quasi-velocity vanishes."""
    quasi = jl.QuasiVelocities(U, ("a", "b"))
    forces = (jl.Rayleigh(drag, "drag"),)
    return jl.System(lagrangian, ("x", "y"), quasi=quasi, forces=forces, **options)


CROSSING = weighted()
Q0, V0 = np.array([0.0, 0.1]), np.array([0.9, 1.1])


def dragged(q0, v0, t):
    return q0 + v0 * (1 - np.exp(-DRAG * t)) / DRAG


def singular_at(y0, vy):
    """Time at which y reaches 90 degrees."""
    return -np.log(1 - (np.pi / 2 - y0) * DRAG / vy) / DRAG


# ---- Samples of a determinant ------------------------------------------------------------------


def accepted(determinant, count=20_000):
    samples = [jnp.broadcast_to(determinant(tau), (count,))[:, None] for tau in (0.0, 0.5, 1.0)]
    return jax.vmap(resolved)(*samples)


def test_no_zero_within_a_step_is_missed():
    """Crossed once, twice, touched, and as poles, for any growth of the determinant."""
    rng = np.random.default_rng(0)
    s, r = rng.uniform(0, 1, (2, 20_000))
    grows, fast = rng.uniform(-1, 1, 20_000), rng.uniform(0.1, 1.5, 20_000)
    for missed in (
        lambda tau: np.sin(fast * (tau - s)),
        lambda tau: np.sin(fast * (tau - s)) ** 2,
        lambda tau: (tau - s) * (tau - r) * np.exp(grows * tau),
        lambda tau: (tau - s) ** 2 * np.exp(grows * tau),
        lambda tau: -((tau - s) ** -2) * np.exp(grows * tau),
        lambda tau: (tau - s) ** 3,
    ):
        assert not np.any(accepted(missed))


def test_determinants_without_near_zeros_are_accepted():
    """Zeros a quarter step away in time, or 0.6 off the real axis; growth by a factor of 7."""
    rng = np.random.default_rng(1)
    s = rng.uniform(0, 1, 20_000)
    for sound in (
        lambda tau: 1.26 - tau,
        lambda tau: -(0.26 + tau),
        lambda tau: (tau - s) ** 2 + 0.6**2,
        lambda tau: np.sqrt((tau - s) ** 2 + 0.6**2),
        lambda tau: 7.0**tau,
        lambda tau: -(7.0**-tau),
    ):
        assert np.all(accepted(sound))


# ---- One motion --------------------------------------------------------------------------------


def test_motion_ends_just_before_a_singularity():
    """In lanes, which cannot continue with multipliers; other lanes are unaffected."""

    @jax.jit
    @jax.vmap
    def solve(y0, ts):
        q0 = jnp.stack([0.0, y0])
        motion = jl.simulate(CROSSING, q0, V0, ts, {}, method="tsit5", rtol=1e-6, atol=1e-6)
        return motion.status, motion.where, motion.last_time, motion.last_state, motion.q

    y0 = np.array([0.1, -0.5, 0.1, 0.1])
    at = singular_at(y0, V0[1])
    ends = np.array([3.0, 3.0, at[2] - 1e-3, -1.0])  # the last one goes backward in time
    ts = np.stack([0 * ends, 0.3 * ends, ends], axis=1)
    status, where, time, (q, v), saves = solve(y0, ts)
    assert status.tolist() == [SINGULAR, SINGULAR, 0, 0]
    assert where.tolist() == [0, 0, -1, -1]
    np.testing.assert_allclose(time[:2], at[:2], atol=1e-6)
    assert np.all(time[:2] < at[:2])
    np.testing.assert_allclose(q[:, 0], dragged(0.0, V0[0], time), atol=1e-5)
    np.testing.assert_allclose(v, V0 * np.exp(-DRAG * time)[:, None], atol=1e-4)
    assert np.all(np.isfinite(saves[:, 1]))
    assert np.all(np.isnan(saves[:2, 2]))


@pytest.mark.full
def test_auto_continues_with_multipliers_and_reports_it():
    """Also from u0 and with saved quasi-velocities; formulation="quasi" fails instead."""
    ts, steps = np.array([0.0, 1.0, 3.0]), {"method": "dopri5", "dt": 0.05}
    at = singular_at(Q0[1], V0[1])
    u0 = {"a": np.cos(Q0[1]) * V0[0], "b": V0[1]}
    motion = jl.simulate(CROSSING, Q0, None, u0=u0, ts=ts, save=("u",), **steps)
    assert motion.formulation == "multipliers"
    assert f"dU/dv is singular at t = {0.05 * (at // 0.05 - 1):.6g} ('a')" in motion.message()
    assert "formulation   by multipliers" in motion.explain()
    np.testing.assert_allclose(motion["x"], dragged(0.0, V0[0], ts), atol=1e-9)
    np.testing.assert_allclose(motion["a"], np.cos(motion["y"]) * motion.rate("x"), atol=1e-12)
    with pytest.raises(SimulationError, match=r"\('a'\).*formulation='multipliers'.*factor of 0.0"):
        jl.simulate(CROSSING, Q0, V0, ts, formulation="quasi", **steps)


# ---- Families ----------------------------------------------------------------------------------


def squared(t, q, v, params):
    return jnp.stack([jnp.cos(q[1]) ** 2 * v[0], v[1]])


def mixed(t, q, v, params):
    """Rows that become parallel at y = 90 degrees."""
    return jnp.stack([v[0] + v[1], jnp.sin(q[1]) * v[0] + v[1]])


def by_time(t, q, v, params):
    return jnp.stack([(1.4 - t) * v[0], v[1]])


def given(t, q, u, params):
    return jnp.stack([u[0] / jnp.cos(q[1]), u[1]])


def vanishing(t, q, u, params):
    """Here v follows from u, but u not from v."""
    return jnp.stack([u[0] * jnp.cos(q[1]), u[1]])


def of_kinematics(function, **options):
    quasi = jl.QuasiVelocities(kinematics=function, names=("a", "b"))
    forces = (jl.Rayleigh(drag, "drag"),)
    return jl.System(free, ("x", "y"), quasi=quasi, forces=forces, **options)


def in_u(t, q, u, params):
    return 0.5 * ((u[0] / jnp.cos(q[1])) ** 2 + u[1] ** 2)


SYSTEMS = {
    "a sign changes": weighted(),
    "touched": weighted(squared),
    "in line": weighted(mixed),
    "by time": weighted(by_time),
    "kinematics that grow": of_kinematics(given),
    "kinematics that vanish": of_kinematics(vanishing),
    "L in u": weighted(lagrangian=in_u, written_in="u"),
    "on arrays": weighted(lowering="array"),
    "kinematics on arrays": of_kinematics(given, lowering="array"),
}
WAYS = (
    {"rtol": 1e-12, "atol": 1e-12, "method": "prince9"},
    {"rtol": 1e-6, "atol": 1e-6},
    {"rtol": 1e-6, "atol": 1e-6, "method": "kvaerno5"},
    {"rtol": 1e-3, "atol": 1e-3, "method": "tsit5"},
    {"dt": 0.05, "method": "dopri5"},
)


# `bench stability` has every system with every method, from more starts.
FAMILY = [(WAYS[1], kind) for kind in SYSTEMS]
FAMILY += [(o, kind) for o in (WAYS[0], *WAYS[2:]) for kind in ("a sign changes", "touched")]


@pytest.mark.full
@pytest.mark.parametrize(
    ("options", "kind"), FAMILY, ids=[f"{o.get('method', 'default')}-{kind}" for o, kind in FAMILY]
)
def test_no_motion_crosses_a_singularity_unreported(kind, options):
    """From random starts, forward; saves before are those of the free motion."""
    rng = np.random.default_rng(2)
    y0, vy = rng.uniform(-1, 1, 50), rng.uniform(0.9, 2, 50)
    start = np.stack([0 * y0, y0], axis=1), np.stack([rng.uniform(0.5, 2, 50), vy], axis=1)
    at = np.full(50, 1.4) if kind == "by time" else singular_at(y0, vy)
    part = rng.uniform(0.3, 2.0, 50)  # of the time to the singularity
    part = np.where(np.abs(part - 1) < 0.2, 1.3, part)
    ts = np.stack([0 * at, part * at], axis=1)

    @jax.jit
    @jax.vmap
    def solve(q0, v0, ts):
        motion = jl.simulate(SYSTEMS[kind], q0, v0, ts, {}, formulation="quasi", **options)
        return motion.ok, motion.status, motion.q[-1]

    ok, status, q = solve(*start, ts)
    np.testing.assert_array_equal(ok, part < 1)
    # If u grows without bound, or if implicit equations are hard to solve near a zero of second
    # order, steps shrink first.
    hard = "vanish" in kind or (kind, options.get("method")) == ("in line", "kvaerno5")
    shrunk = {int(Status.step_below_resolution), int(Status.max_steps)} if hard else {}
    assert set(np.asarray(status)[part > 1].tolist()) <= {SINGULAR, *shrunk}
    right = dragged(start[0], start[1], ts[:, 1:])
    bound = 1e3 * options.get("rtol", 1e-6)
    np.testing.assert_allclose(q[part < 1], right[part < 1], atol=bound)


def skew(t, q, v, params):
    """Nearly dependent everywhere, and equally so at all times."""
    return jnp.stack([v[0] + 1e-5 * (2.0 + jnp.sin(q[1])) * v[1], v[0]])


@pytest.mark.full
def test_nearly_dependent_quasi_velocities_are_accepted():
    ts = np.array([0.0, 1.0, 20.0])
    motion = jl.simulate(weighted(skew), Q0, V0, ts, {})
    assert motion.formulation == "quasi"
    np.testing.assert_allclose(motion.q, [dragged(Q0, V0, t) for t in ts], atol=1e-5)


@pytest.mark.full
def test_motions_near_a_singularity_are_right():
    """y oscillates to within 1e-3 of 90 degrees: every motion is right, and none is refused."""

    def spring(t, q, v, params):
        return 0.5 * (v @ v) - 0.5 * q[1] ** 2

    system = jl.System(spring, ("x", "y"), quasi=jl.QuasiVelocities(cosine, ("a", "b")))

    @jax.jit
    @jax.vmap
    def solve(y0):
        motion = jl.simulate(system, jnp.stack([0.0, y0]), [0.7, 0.0], [0.0, 7.0], {})
        return motion.status, motion.q[-1]

    y0 = np.pi / 2 - np.logspace(-3, -0.3, 20)
    status, q = solve(y0)
    assert not np.any(status)
    np.testing.assert_allclose(q, np.stack([0 * y0 + 4.9, y0 * np.cos(7.0)], axis=1), atol=1e-6)
    status, _ = solve(2 * np.pi - 3 * np.pi / 2 + np.logspace(-3, -0.3, 20))  # beyond, either way
    assert set(np.asarray(status).tolist()) == {SINGULAR}


@pytest.mark.full
def test_float32_motion_ends_before_a_singularity():
    start = (jnp.asarray(x, jnp.float32) for x in (Q0, V0))
    ts = np.array([0.0, 0.8, 3.0])
    motion = jl.simulate(CROSSING, *start, ts, {}, formulation="quasi", throw=False)
    assert int(motion.status) == SINGULAR
    # The determinant is sqrt(eps / (200 tol)) there, a hundredth of a radian away.
    margin = np.cos(Q0[1]) * np.sqrt(np.finfo(np.float32).eps / 200e-5)
    assert 0 < singular_at(Q0[1], V0[1]) - motion.last_time < 1.5 * margin
    np.testing.assert_allclose(motion["x"][1], dragged(0.0, V0[0], 0.8), atol=1e-4)


@pytest.mark.full
def test_derivatives_equal_those_of_a_failed_motion():
    """Under transforms there is no continuation: NaN at the end, derivatives of saves before."""

    def x(vx, save):
        v0 = jnp.stack([vx, V0[1]])
        return jl.simulate(CROSSING, Q0, v0, [0.0, 0.8, 3.0], {}, throw=False)["x"][save]

    value, _ = jax.jvp(lambda vx: x(vx, -1), (0.9,), (1.0,))
    assert np.isnan(value)
    for slope in (jax.grad(x), lambda vx, save: jax.jvp(lambda vx: x(vx, save), (vx,), (1.0,))[1]):
        np.testing.assert_allclose(slope(0.9, 1), dragged(0.0, 1.0, 0.8), rtol=1e-8)


@pytest.mark.full
def test_l_in_u_keeps_its_status():
    system = SYSTEMS["L in u"]
    motion = jl.simulate(system, Q0, V0, [0.0, 3.0], {}, throw=False)
    assert int(motion.status) == SINGULAR
    assert motion.formulation == "quasi"


# ---- Constant determinants ---------------------------------------------------------------------


def turned(t, q, v, params):
    """dU/dv rotates; its determinant is constant."""
    c, s = jnp.cos(q[1]), jnp.sin(q[1])
    return jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0]])


def constant(t, q, v, params):
    return jnp.stack([2.0 * v[0] + params["k"] * v[1], v[1]]) + q[0]


@pytest.mark.full
@pytest.mark.parametrize(
    ("U", "lowering", "computed"),
    mostly_full(
        [
            (turned, "auto", False),
            (constant, "auto", False),
            (constant, "array", False),
            (cosine, "auto", True),
            (cosine, "array", True),
        ],
        (turned, "auto", False),
        (cosine, "auto", True),
    ),
)
def test_constant_determinants_are_not_computed(U, lowering, computed, monkeypatch):
    """The program of the steps equals that without the check."""

    def steps():
        system = weighted(partial(U), lowering=lowering)  # a new system, so that no cache is used
        solve = partial(jl.simulate, system, Q0, V0, [0.0, 1.0], method="tsit5")
        program = operations(lambda k: solve({"k": k}, dt=0.1).q, 0.3, iterations=1)
        return [(o.name, o.shapes) for o in loop(program)]

    checked = steps()
    monkeypatch.setattr(_problem, "usual", lambda *_: None)
    assert (checked != steps()) == computed
