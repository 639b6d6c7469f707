"""Change points, where branches of motion meet: passed along the tangent, or stopped before.

The windows benchmark of multibody dynamics (IFToMM A02): rods of length 1 in parallelograms, which
are flat twice per revolution. The motion on the parallelogram branch is that of one pendulum.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _systems.mechanisms import four_bar, four_bar_start

import jaxlag as jl
from jaxlag._integration._tableaus import nodes_of
from jaxlag._linalg._kkt import FORMULATIONS
from jaxlag._simulation._methods import METHODS
from systems.catalogue import ENTRIES

SIDE = (0.0, 1.0)  # x of the fixed pivots
SPEEDS = jnp.linspace(0.9, 1.5, 24)
Q0 = jnp.array([0.0, 1.0, 1.0, 1.0])
ENERGY = 1.5 * 9.81


def rods(t, q, params):
    """Both sides and the rod between them."""
    ends = q.reshape(2, 2)
    side, top = ends - jnp.array([SIDE, (0.0, 0.0)], q.dtype).T, ends[1] - ends[0]
    return jnp.concatenate([jnp.sum(side**2, 1), jnp.sum(top**2)[None]]) - 1.0


def window(t, q, v, params):
    (a, b), heights = v.reshape(2, 2), q.reshape(2, 2)[:, 1]
    T = (a @ a + b @ b) / 6 + (a @ a + b @ b + a @ b) / 6
    return T - 9.81 * jnp.sum(heights)


def parallelogram(lowering="auto"):
    rows = (jl.Holonomic(rods, "rods"),)
    return jl.System(window, ("x0", "y0", "x1", "y1"), constraints=rows, lowering=lowering)


WINDOW = parallelogram()
PENDULUM = jl.System(lambda t, q, v, p: 5 / 6 * v[0] ** 2 - 2 * 9.81 * jnp.cos(q[0]), ("theta",))


def moved(speed, ts, rtol, system=WINDOW, **options):
    """The motion from upright; the tops have this speed."""
    v0 = jnp.stack([speed, 0.0 * speed, speed, 0.0 * speed])
    return jl.simulate(system, Q0, v0, ts, rtol=rtol, atol=rtol, throw=False, **options)


def exact(speed, ts):
    """x of the tops, by the pendulum."""
    tight = {"rtol": 1e-13, "atol": 1e-13, "throw": False}
    return jnp.sin(jl.simulate(PENDULUM, jnp.zeros(1), speed[None], ts, **tight).q[:, 0])


@pytest.mark.full
def test_flat_configurations_are_passed_at_every_tolerance():
    """Three revolutions, with saves along the whole motion, also near the change points."""
    ts = jnp.linspace(0.0, 4.0, 161)
    run = jax.jit(jax.vmap(moved, in_axes=(0, None, None)))
    expected = jax.vmap(exact, in_axes=(0, None))(SPEEDS, ts)
    # Measured: 1.3e-2, 2.7e-6, 1.3e-9, 9e-12 (of the pendulum itself 8e-4, 6e-6, 2e-9, 2e-11).
    for rtol, off in ((1e-4, 5e-2), (1e-7, 1e-5), (1e-10, 5e-9), (1e-12, 4e-11)):
        found = run(SPEEDS, ts, rtol)
        assert (found.status == jl.Status.ok).all()
        np.testing.assert_allclose(found.q[..., 0], expected, atol=off)
        # The branch is the same as before: the top stays level.
        np.testing.assert_allclose(found.q[..., 3], found.q[..., 1], atol=1e-12)


@pytest.mark.full
def test_flat_configurations_in_float32_are_passed_or_reported():
    ts = jnp.linspace(0.0, 2.0, 41)
    expected = jax.vmap(exact, in_axes=(0, None))(SPEEDS, ts)
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731

    def run(speed, rtol):
        v0 = jnp.stack([speed, 0 * speed, speed, 0 * speed])
        at_once = {"rtol": rtol, "atol": rtol, "throw": False}
        return jl.simulate(WINDOW, single(Q0), v0, single(ts), **at_once)

    # Measured: 24 and 23 of 24 motions pass, off by 1e-3 and 9e-4. Others end there with their
    # status. Of 384 motions 376 and 370 pass, off by 1e-2 at most and by 3e-5 in the median at
    # 1e-5: rounding.
    for rtol in (1e-4, 1e-5):
        found = jax.jit(jax.vmap(run, in_axes=(0, None)))(single(SPEEDS), rtol)
        assert found.q.dtype == jnp.float32
        passed = found.status == jl.Status.ok
        assert jnp.sum(passed) >= 22
        np.testing.assert_allclose(found.q[passed, :, 0], expected[passed], atol=5e-3)


@pytest.mark.full
def test_option_stop_ends_motions_before_change_points():
    """At every tolerance, with status rank_change; the last time is the change point within it."""
    run = jax.jit(jax.vmap(lambda s, e: moved(s, jnp.linspace(0, 2, 3), e, change_points="stop")))
    tolerances = jnp.array([1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
    found = run(jnp.ones(5), tolerances)
    assert (found.status == jl.Status.rank_change).all()
    assert found.change_points == "stop"
    # Where the sine of the angle between rows is eps^(1/3); measured: 8e-7, 7e-8, 5e-10, 3e-12.
    assert (jnp.abs(found.last_time - 0.70844878654) <= 1e-10 + tolerances).all()
    np.testing.assert_allclose(found.last_state[0][:, 0], 1.0, atol=1e-10)


@pytest.mark.full
def test_message_of_a_stop_names_the_row():
    found = moved(jnp.ones(()), [0.0, 1.0], 1e-9, change_points="stop")
    assert "rank_change ('rods[" in found.message()
    assert "change_points='stop'" in found.message()


def test_invalid_option_is_refused():
    with pytest.raises(ValueError, match=r"`change_points` must be one of 'pass', 'stop'.*'go'"):
        moved(jnp.ones(()), [0.0, 1.0], 1e-9, change_points="go")


@pytest.mark.parametrize("rtol", mostly_full([1e-6, 1e-9, 1e-12], 1e-9))
def test_a_fast_four_bar_passes_its_change_point(rtol):
    """Three times; with constant energy, and back to the start."""
    q0, v0, params = change_point_start()
    options = {"throw": False, "rtol": rtol, "atol": rtol}
    forward = jl.simulate(four_bar, q0, v0, np.linspace(0, 3, 301), params, **options)
    assert forward.status == jl.Status.ok
    # Measured: 2e-5, 1.3e-9, 3e-13 of 15 J; 4e-5, 6e-9, 1.4e-12.
    energy = {1e-6: 1e-4, 1e-9: 1e-8, 1e-12: 5e-12}[rtol]
    np.testing.assert_allclose(forward.energy, forward.energy[0], atol=energy)
    q1, v1 = forward.last_state
    backward = jl.simulate(four_bar, q1, -v1, [0.0, 3.0], params, **options)
    assert backward.status == jl.Status.ok
    np.testing.assert_allclose(backward.q[-1], q0, atol=10 * energy)


def change_point_start():
    """(q, v, params) of a four-bar with a + d = b + c, which is flat once per revolution."""
    params = {"a": 0.4, "b": 1.0, "c": 0.6, "d": 1.2}
    q0 = four_bar_start(1.0, params)
    start = jl.assemble(four_bar, q0, [5.0, 0.0, 0.0], params, hold=("crank'",))
    return start.q, start.v, params


@pytest.mark.full
def test_a_four_bar_stops_before_its_change_point():
    q0, v0, params = change_point_start()
    options = {"throw": False, "rtol": 1e-9, "atol": 1e-9}
    stopped = jl.simulate(four_bar, q0, v0, [0.0, 3.0], params, change_points="stop", **options)
    assert stopped.status == jl.Status.rank_change
    assert "('pin[" in stopped.message()
    np.testing.assert_allclose(stopped.last_state[0], [np.pi, 0.0, 0.0], atol=1e-4)


def flat_at(speed):
    """Time at which the windows are first flat, by the integral of dtheta / theta'."""
    x, w = np.polynomial.legendre.leggauss(40)
    angle = np.pi / 4 * (1 + x)
    rate = lambda a: np.sqrt(speed**2 + 2.4 * 9.81 * (1 - np.cos(a)))  # noqa: E731
    return np.pi / 4 * np.sum(w / rate(angle))


@pytest.mark.full
@pytest.mark.parametrize("method", mostly_full(["auto", "tsit5"], "auto"))
def test_states_at_and_near_a_change_point_are_accurate(method):
    """Saved there, and at the end of a motion there, at every tolerance."""
    when = np.array([flat_at(speed) for speed in SPEEDS[::4].tolist()])
    beside = np.array([-1e-2, -1e-4, -1e-7, 0.0, 1e-7, 1e-4, 1e-2])
    exact_state = lambda s, t: jl.simulate(  # noqa: E731
        PENDULUM, jnp.zeros(1), s[None], t, rtol=1e-13, atol=1e-13, throw=False
    )
    run = jax.jit(jax.vmap(lambda s, ts, e: moved(s, ts, e, method=method), in_axes=(0, 0, None)))
    saved = jnp.asarray([[0.0, *(t + beside), 1.2] for t in when])
    last = jnp.asarray([[0.0, *(t + beside[:4])] for t in when])
    ended = jnp.asarray([[0.0, t] for t in when])
    for rtol in (1e-6, 1e-9, 1e-12):
        for ts in (saved, last, ended):
            found = run(SPEEDS[::4], ts, rtol)
            assert (found.status == jl.Status.ok).all()
            right = jax.vmap(exact_state)(SPEEDS[::4], ts)
            angle, rate = right.q[..., 0], right.v[..., 0]
            off = np.max(np.abs(found.q[..., 0] - jnp.sin(angle)))
            too_fast = np.max(np.abs(jnp.hypot(found.v[..., 0], found.v[..., 1]) - jnp.abs(rate)))
            # Measured at most: 1e-5, 1.3e-9, 1e-12 and 2e-4, 5e-7, 1e-9.
            assert off < 100 * rtol
            assert too_fast < 1000 * rtol + 1e-8


def angles_of_a_parallelogram(speeds, starts, ts, rtol):
    """Angles of its links to one line: that of the coupler stays 0 up to rounding."""
    entry = ENTRIES["four_bar"]
    params = dict(entry.example.params) | {"a": 0.5, "b": 1.0, "c": 0.5, "d": 1.0, "g": 3.0}
    at_once = {"rtol": rtol, "atol": rtol, "throw": False}

    def both(speed, start):
        whole = lambda x: jnp.stack([x, 0 * x, x])  # noqa: E731
        folded = lambda x: whole(x) - jnp.array([0.0, 0.0, jnp.pi])  # noqa: E731
        reduced = jl.System(
            lambda t, q, v, p: entry.system.lagrangian(t, folded(q[0]), whole(v[0]), p), ("angle",)
        )
        q0 = folded(start)
        found = jl.simulate(entry.system, q0, whole(speed), ts, params, **at_once)
        right = jl.simulate(
            reduced, start[None], speed[None], ts, params, rtol=1e-13, atol=1e-13, throw=False
        )
        return found.status, found.q[:, 0] - right.q[:, 0], found.stats["accepted"]

    return jax.vmap(both)(speeds, starts)


@pytest.mark.full
@pytest.mark.parametrize("rtol", mostly_full([1e-6, 1e-9, 1e-11, 1e-12, 1e-13], 1e-12))
def test_rounding_does_not_shorten_the_steps(rtol):
    """One coordinate and its velocity are only the rounding of the others."""
    rng = np.random.default_rng(5)
    starts, speeds = jnp.asarray(rng.uniform(0.3, 2.8, 40)), jnp.asarray(-rng.uniform(2.5, 5, 40))
    status, off, steps = angles_of_a_parallelogram(speeds, starts, jnp.linspace(0, 2, 5), rtol)
    assert (status == jl.Status.ok).all()
    # Measured: 9e-6, 5e-9, 4e-11, 4e-12, 2e-12 in 12, 27, 50, 62, 78 steps.
    assert np.max(np.abs(off)) < 50 * rtol + 1e-11
    assert np.max(steps) < 120


@pytest.mark.full
def test_fixed_steps_that_meet_a_change_point_report_it():
    """Those with an end or a stage there; all others keep their accuracy."""
    when = flat_at(1.0)
    nodes = np.clip(np.unique(nodes_of(METHODS["dopri8"]())), 0.0, 1.0)
    steps = when / (20 + np.unique([0.0, *nodes, 1.0]))

    def run(dt):
        v0 = jnp.array([1.0, 0.0, 1.0, 0.0])
        return jl.simulate(
            WINDOW, Q0, v0, 0.8 * jnp.arange(2.0), dt=dt, method="dopri8", throw=False
        )

    found = jax.vmap(run)(jnp.asarray(steps))
    passed = found.status == jl.Status.ok
    assert ((found.status == jl.Status.rank_change) | passed).all()
    assert jnp.sum(passed) <= 1  # measured: of the first stage after the start, right to 5e-13
    shifted = jax.vmap(run)(jnp.asarray(steps) * (1 + 1e-4))
    assert (shifted.status == jl.Status.ok).all()
    expected = exact(jnp.ones(()), jnp.array([0.0, 0.8]))[-1]
    for end in (*found.q[passed, -1, 0], *shifted.q[:, -1, 0]):
        np.testing.assert_allclose(end, expected, atol=1e-8)


@pytest.mark.full
@pytest.mark.parametrize("how", [{"rtol": 1e-9, "atol": 1e-9}, {"dt": 0.02, "method": "dopri8"}])
def test_nan_force_before_a_change_point_is_reported_as_nonfinite(how):
    """NaN at x0 = 0.95, where rows have a third of their length left; they vanish at x0 = 1."""
    wrong = lambda t, q, v, p: jnp.where(q[0] > p, jnp.nan, 0.0) * jnp.ones(4)  # noqa: E731
    force, rows = jl.GeneralizedForce(wrong, "wrong"), jl.Holonomic(rods, "rods")
    system = jl.System(window, ("x0", "y0", "x1", "y1"), forces=[force], constraints=[rows])
    found = jl.simulate(system, Q0, [1.0, 0, 1.0, 0], [0.0, 2.0], 0.95, throw=False, **how)
    assert found.status == jl.Status.nonfinite
    assert 0.92 < found.last_state[0][0] < 0.9501


@pytest.mark.full
def test_saves_in_a_folded_configuration_are_accurate():
    """A parallelogram that is flat at t = 2, which is a save time."""
    entry = ENTRIES["four_bar"]
    params = dict(entry.example.params) | {"a": 0.5, "b": 1.0, "c": 0.5, "d": 1.0, "g": 0.0}
    q0, ts = np.array([2.0, 0.0, 2.0 - np.pi]), np.linspace(0.0, 4.0, 41)
    for rtol in (1e-6, 1e-9, 1e-12):
        found = jl.simulate(
            entry.system, q0, [-1.0, 0.0, -1.0], ts, params, rtol=rtol, atol=rtol, throw=False
        )
        assert found.status == jl.Status.ok
        expected = q0 - ts[:, None] * np.array([1.0, 0.0, 1.0])
        np.testing.assert_allclose(found.q, expected, atol=1e-11)
        np.testing.assert_allclose(found.v, expected * 0 + [-1.0, 0.0, -1.0], atol=1e-11)


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "formulation", "lowering"),
    [
        *itertools.product(["auto"], FORMULATIONS, ["auto", "array"]),
        ("tsit5", "null_space", "auto"),
        ("kvaerno5", "multipliers", "array"),
    ],
)
def test_change_points_are_passed_in_all_formulations(lowering, formulation, method):
    ts = jnp.linspace(0.0, 4.0, 41)
    how = {"method": method, "formulation": formulation}
    found = moved(jnp.ones(()), ts, 1e-9, parallelogram(lowering), **how)
    assert found.status == jl.Status.ok
    # Measured: 1.2e-8, 7e-8, 1.8e-6.
    allowed = {"auto": 5e-8, "tsit5": 3e-7, "kvaerno5": 1e-5}[method]
    np.testing.assert_allclose(found.q[:, 0], exact(jnp.ones(()), ts), atol=allowed)


@pytest.mark.full
@pytest.mark.parametrize("stabilization", [None, jl.Baumgarte(5.0, 5.0)])
def test_motion_without_projection_stops(stabilization):
    """Beyond the change point nothing would move the state back to its branch."""
    for rtol in (1e-6, 1e-9, 1e-12):
        found = moved(jnp.ones(()), [0.0, 1.0], rtol, stabilization=stabilization)
        assert found.status == jl.Status.rank_change
        assert abs(found.last_time - 0.7084487865) < 1e-6


@pytest.mark.full
def test_fixed_steps_keep_their_order():
    """Across the change point, anywhere in a step; without constraints the slope is 8.2."""
    ts = jnp.array([0.0, 0.6, 1.2])

    @jax.jit
    def off(dt):
        v0 = jnp.array([1.0, 0.0, 1.0, 0.0])
        found = jl.simulate(WINDOW, Q0, v0, ts, dt=dt, method="dopri8", throw=False)
        return jnp.abs(found.q[-1, 0] - exact(jnp.ones(()), ts)[-1])

    sizes = np.array([1 / 15, 1 / 20, 1 / 30])
    slope = np.polyfit(np.log(sizes), np.log([float(off(h)) for h in sizes]), 1)[0]
    assert 7.9 <= slope <= 8.8  # measured: 8.4, the change point is nearer to the middle of steps


@pytest.mark.full
def test_derivatives_across_change_points_are_accurate():
    """First derivatives in both modes, and second ones, against those of the pendulum."""
    ts = jnp.linspace(0.0, 3.0, 31)

    def all_of(end):
        slope = lambda s: jax.jvp(end, (s,), (1.0,))[1]  # noqa: E731
        each = lambda s: (end(s), slope(s), jax.grad(end)(s), jax.jvp(slope, (s,), (1.0,))[1])  # noqa: E731
        return jax.jit(jax.vmap(each))(SPEEDS)

    found = all_of(lambda s: moved(s, ts, 1e-12).q[-1, 0])
    expected = all_of(lambda s: exact(s, ts)[-1])
    # Largest errors of 1,000 starts: 1e-12, 2e-11, 1e-11, 5e-11.
    for value, right in zip(found, expected, strict=True):
        np.testing.assert_allclose(value, right, rtol=2e-10, atol=2e-12)


@pytest.mark.full
def test_derivatives_of_saves_at_change_points_are_accurate():
    """By the start and by the save times, forward and reverse, single and in lanes."""
    speeds = SPEEDS[:3]
    when = jnp.asarray([flat_at(speed) for speed in speeds.tolist()])

    def saved(s, ts):
        return moved(s, ts, 1e-12).q[:, 0]

    def lanes(derivative, motion, ts):
        return jax.jit(jax.vmap(derivative(motion, (0, 1))))(speeds, ts)

    def times(offsets):
        return jnp.concatenate([jnp.zeros((3, 1)), when[:, None] + jnp.array(offsets)], axis=1)

    # Measured: 2e-9 of 0.8, 3e-8 of 5.
    through = times([-0.1, 0.0, 1e-3, 0.1])
    expected = lanes(jax.jacfwd, exact, through)
    for mode in (jax.jacfwd, jax.jacrev):
        found = lanes(mode, saved, through)
        np.testing.assert_allclose(found[0], expected[0], atol=2e-8)
        np.testing.assert_allclose(found[1], expected[1], atol=3e-7)
    until = times([-0.1, -1e-3, 0.0])[0]
    alone = jax.jit(jax.jacrev(saved, (0, 1)))(speeds[0], until)
    expected = jax.jacfwd(exact, (0, 1))(speeds[0], until)
    np.testing.assert_allclose(alone[0], expected[0], atol=2e-8)
    np.testing.assert_allclose(alone[1], expected[1], atol=3e-7)


def free(t, q, v, units):
    return 0.5 * jnp.sum((v / units) ** 2)


TOLERANCES = jnp.array([1e-4, 1e-6, 1e-9, 1e-12])
UNITS = jnp.array([[1.0, 1.0], [1e-6, 1e-6], [1e3, 1e3], [1.0, 1e-6], [1e-3, 1e3]])


def motion_of_a_bead(curve, q0, v0):
    """A bead along a curve without forces, at every tolerance, in every unit."""
    rows = (jl.Holonomic(lambda t, q, units: curve(q / units), "wire"),)
    system, ts = jl.System(free, ("x", "y"), constraints=rows), jnp.linspace(0.0, 4.0, 9)

    def one(rtol, units):
        atol = rtol * jnp.min(units)
        start = jnp.array(q0) * units, jnp.array(v0) * units
        found = jl.simulate(system, *start, ts, units, rtol=rtol, atol=atol, throw=False)
        return found.status, found.q / units, found.last_time, found.last_state[1] / units

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(TOLERANCES, UNITS)


@pytest.mark.full
def test_bead_passes_a_node_along_its_tangent():
    """A figure eight, a quarter of which is 1.311 long: twice through its node."""
    eight = lambda q: (q @ q) ** 2 - q[0] ** 2 + q[1] ** 2  # noqa: E731
    status, q, _, _ = motion_of_a_bead(eight, [1.0, 0.0], [0.0, 1.0])
    assert (status == jl.Status.ok).all()
    s = 4.0 - 3 * 1.3110287771460600  # length beyond the node
    r = s - s**5 / 10  # the lemniscate sine, to 5e-13
    angle = np.pi / 4 - np.arcsin(r**2) / 2
    end = r * np.array([np.cos(angle), -np.sin(angle)])
    off = np.max(np.linalg.norm(q[:, :, -1] - end, axis=-1), axis=1)
    # Measured: 5e-5, 8e-7, 3e-10, 9e-14.
    assert (off <= np.array([1e-3, 1e-5, 1e-8, 5e-12])).all()
    assert (q[:, :, 3] < 0).all()


CURVES = {
    "cusp": (lambda q: q[0] ** 2 - q[1] ** 3, [1.0, 1.0], [-1.5, -1.0]),
    "osculating": (lambda q: q[1] ** 2 - q[0] ** 6, [-1.0, -1.0], [1.0, 3.0]),
    "touching": (
        lambda q: (q @ q - 2 * q[1]) * (q @ q + 2 * q[1]),
        [1.0, 1.0],
        [0.0, -1.0],
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("name", mostly_full(list(CURVES), "cusp"))
def test_bead_stops_at_cusps_and_contact_points(name):
    """At a cusp, and where two curves touch: at every tolerance, shortly before the point."""
    curve, q0, v0 = CURVES[name]
    status, _, last_time, v = motion_of_a_bead(curve, q0, v0)
    assert (status == jl.Status.rank_change).all()
    np.testing.assert_allclose(last_time, jnp.full_like(last_time, last_time[-1, 0]), rtol=0.03)
    off = np.abs(np.linalg.norm(v, axis=-1) / np.linalg.norm(v0) - 1.0)
    # Measured at most: 1.7e-2 (the last state is 3 mm beyond the cusp), 3e-7, 2e-10, 4e-12.
    assert (np.max(off, axis=1) <= np.array([5e-2, 2e-6, 1e-9, 2e-11])).all()
