"""Mechanisms beyond the book, against one coordinate, other coordinates and Newton's law."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _consistent import onto_constraints
from numpy import cos, sin

import jaxlag as jl
from systems import four_bar, n_link_loop, slider_crank
from systems.catalogue import Chart

TIGHT = {"method": "tsit5", "rtol": 1e-12, "atol": 1e-12}
"""Of low order, which compiles less."""

TIMES = np.linspace(0.0, 1.0, 6)
AGREEMENT = 1e-9
"""Between two motions whose local errors of 1e-12 accumulate over some hundred steps."""


# ---- In one coordinate, with the loop closed by hand ---------------------------------------------


def slider_crank_closed(t, q, params):
    """The rod from the heights of its ends."""
    (theta,) = q
    phi = -jnp.arcsin(params["r"] * jnp.sin(theta) / params["l"])
    x = params["r"] * jnp.cos(theta) + params["l"] * jnp.cos(phi)
    return jnp.stack([theta, phi, x])


def four_bar_closed(t, q, params):
    """Coupler and rocker by the law of cosines, with C above the line B-D."""
    (theta1,) = q
    a, b, c, d = (params[name] for name in "abcd")
    x, y = d - a * jnp.cos(theta1), -a * jnp.sin(theta1)  # from B to D
    side, direction = jnp.hypot(x, y), jnp.arctan2(y, x)
    at_B = jnp.arccos((b**2 + side**2 - c**2) / (2 * b * side))
    at_D = jnp.arccos((c**2 + side**2 - b**2) / (2 * c * side))
    return jnp.stack([theta1, direction + at_B, direction - at_D])


CLOSED = {
    "slider_crank": (
        slider_crank,
        Chart(coordinates=("theta",), configuration=slider_crank_closed),
    ),
    "four_bar": (four_bar, Chart(coordinates=("theta1",), configuration=four_bar_closed)),
}


@pytest.mark.full
@pytest.mark.parametrize("name", CLOSED)
def test_motion_equals_that_in_one_coordinate(name):
    """L of the crank alone; angle of the crank, q and v of all links, and the reactions."""
    module, chart = CLOSED[name]
    entry = module.entry
    params, (q0, v0) = dict(entry.example.params), entry.start()

    def lagrangian(t, q, v, params):
        return entry.system.lagrangian(t, *chart.state(t, q, v, params), params)

    crank = jl.System(lagrangian, chart.coordinates)
    whole = jl.simulate(entry.system, q0, v0, TIMES, params, **TIGHT)
    alone = jl.simulate(crank, q0[:1], v0[:1], TIMES, params, **TIGHT)
    assert abs(alone.q[-1, 0] - alone.q[0, 0]) > 2 * np.pi
    q, v = jax.vmap(lambda t, q, v: chart.state(t, q, v, params))(TIMES, alone.q, alone.v)
    np.testing.assert_allclose(whole.q, q, rtol=0, atol=AGREEMENT)
    np.testing.assert_allclose(whole.v, v, rtol=0, atol=AGREEMENT * np.max(np.abs(v)))
    np.testing.assert_allclose(whole.energy, whole.energy[0], rtol=AGREEMENT)

    def rates(t, q, v):
        return chart.state(t, q, v, params)[1]

    def accelerations(t, q, v, a):
        return jax.jvp(rates, (t, q, v), (jnp.ones_like(t), v, a))[1]

    a = jax.vmap(accelerations)(jnp.asarray(TIMES), alone.q, alone.v, alone.a)
    lam = np.stack([whole.lam[row] for row in entry.constraints], axis=1)
    for i, found in enumerate(lam):
        force = force_on_last_head(module, params, *(np.asarray(x[i]) for x in (q, v, a)))
        np.testing.assert_allclose(found, force, rtol=0, atol=AGREEMENT * np.max(np.abs(lam)))
    if name == "slider_crank":
        size = AGREEMENT * np.max(np.abs(lam))
        np.testing.assert_allclose(lam[:, 0], -params["m3"] * a[:, 2], rtol=0, atol=size)


def force_on_last_head(module, params, q, v, a):
    """By the moments of all links about the first tail, and of the last link about its tail."""
    if module is n_link_loop:
        masses, lengths = np.full(q.shape, params["m"]), np.full(q.shape, params["l"])
    else:
        masses, lengths = module.masses(params), module.lengths(params)
    return pin_force(np.asarray(masses), np.asarray(lengths), params["g"], q, v, a)


def pin_force(masses, lengths, g, q, v, a):
    q, v, a = (x[: len(masses)] for x in (q, v, a))
    links = (lengths * np.array([cos(q), sin(q)])).T
    normals = (lengths * np.array([-sin(q), cos(q)])).T
    pulls = normals * a[:, None] - links * v[:, None] ** 2  # second derivatives of the links
    heads, accelerations = np.cumsum(links, axis=0), np.cumsum(pulls, axis=0)
    forces = masses[:, None] * (accelerations - 0.5 * pulls + [0.0, g])
    spins = masses * lengths**2 / 12 * a
    arms, moments = [], []
    for first in (0, len(q) - 1):
        tail = heads[first] - links[first]
        arm = (heads - 0.5 * links - tail)[first:]
        moments.append(np.sum(cross(arm, forces[first:])) + np.sum(spins[first:]))
        x, y = heads[-1] - tail
        arms.append([-y, x])
    return np.linalg.solve(arms, moments)


def cross(r, F):
    return r[:, 0] * F[:, 1] - r[:, 1] * F[:, 0]


# ---- Assembly ------------------------------------------------------------------------------------


@pytest.mark.full
def test_the_four_bar_is_assembled_from_a_guess_that_is_20_percent_wrong():
    """Compared with the law of cosines; the crank is held; errors of either sign."""
    module, chart = CLOSED["four_bar"]
    entry = module.entry
    params = dict(entry.example.params)
    q, v = chart.state(0.0, entry.example.q0[:1], entry.example.v0[:1], params)
    guess = np.array(entry.example.q0[1:])
    np.testing.assert_allclose(np.abs(guess / q[1:] - 1), 0.2, atol=0.01)
    for signs in itertools.product([0.8, 1.2], repeat=4):
        wrong = jnp.array(signs)
        guess = q.at[1:].multiply(wrong[:2]), v.at[1:].multiply(wrong[2:])
        found = jl.assemble(entry.system, *guess, params, hold=entry.example.hold)
        np.testing.assert_allclose(found.q, q, rtol=0, atol=1e-13)
        np.testing.assert_allclose(found.v, v, rtol=0, atol=1e-12)
    for x, expected in zip(entry.start(), (q, v), strict=True):
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-12)


# ---- The loop of links ---------------------------------------------------------------------------

LINKS = 5
ANGLES = n_link_loop.declare(LINKS)
LOOP = dict(n_link_loop.entry.example.params)


def nodes(q, ends):
    """All joints from pin to pin, shape (LINKS + 1, 2), from x and y of those between."""
    first, last = ends
    return jnp.concatenate([first[None], q.reshape(-1, 2), last[None]])


def rods(t, q, v, params):
    """Slender rods by the rates of their ends: T = m (v1^2 + v1 . v2 + v2^2)/6 each."""
    zeros = jnp.zeros((2, 2))
    r, rate = nodes(q, zeros), nodes(v, zeros)
    T = params["m"] / 6 * jnp.sum(rate[1:] ** 2 + rate[1:] * rate[:-1] + rate[:-1] ** 2)
    return T - params["m"] * params["g"] * jnp.sum(r[:, 1])  # each rod is half at either end


def stretches(t, q, params):
    """Squared distances between joints less squared lengths [m^2]."""
    pins = jnp.stack([jnp.zeros(2), params["d"] * jnp.array([1.0, 0.0])])
    between = jnp.diff(nodes(q, pins), axis=0)
    return jnp.sum(between**2, axis=1) - params["l"] ** 2


NAMES = tuple(f"{axis}{i}" for i in range(1, LINKS) for axis in "xy")
JOINTS = jl.System(
    rods,
    NAMES,
    constraints=(jl.Holonomic(stretches, tuple(f"rod{i}" for i in range(1, LINKS + 1))),),
)


def joints(t, angles, params):
    """Coordinates of the joints between the links, from the angles."""
    links = params["l"] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    return jnp.ravel(jnp.cumsum(links, axis=0)[:-1])


TO_JOINTS = Chart(coordinates=(), configuration=joints)


def loop_states(count):
    """(q, v) of the loop in angles."""
    rng = np.random.default_rng(8)
    move = jax.jit(partial(onto_constraints, ANGLES))
    hung = np.linspace(-1.0, 1.0, LINKS)
    for _ in range(count):
        q = hung + rng.uniform(-0.3, 0.3, LINKS)
        yield move(LOOP, 0.0, q, rng.uniform(-3.0, 3.0, LINKS))


@pytest.mark.full
def test_acceleration_of_the_loop_equals_the_cartesian_one():
    """The force on its pin is that of Newton's law for the links."""

    @jax.jit
    def both(q, v):
        a = ANGLES.acceleration(q, v, LOOP)
        t, one = jnp.zeros(()), jnp.ones(())
        rate = jax.jvp(lambda *s: TO_JOINTS.state(*s, LOOP)[1], (t, q, v), (one, v, a))[1]
        other = JOINTS.acceleration(*TO_JOINTS.state(t, q, v, LOOP), LOOP)
        return a, ANGLES.multipliers(q, v, LOOP), rate, other

    for q, v in loop_states(8):
        a, lam, rate, other = both(q, v)
        np.testing.assert_allclose(other, rate, rtol=0, atol=1e-11 * np.max(np.abs(rate)))
        force = force_on_last_head(n_link_loop, LOOP, *map(np.asarray, (q, v, a)))
        found = [lam["pin_x"], lam["pin_y"]]
        np.testing.assert_allclose(found, force, rtol=0, atol=1e-11 * np.max(np.abs(force)))


@pytest.mark.full
def test_equilibrium_of_the_loop_is_a_catenary_of_links():
    """tan(theta_k) = (k - (n + 1)/2) m g/H with tension H; each pin carries half the weight."""
    guess = np.linspace(-0.9, 1.0, LINKS)
    rest = jl.equilibrium(ANGLES, guess, LOOP)
    weight, H = LOOP["m"] * LOOP["g"], rest.multipliers["pin_x"]
    slopes = (np.arange(1, LINKS + 1) - (LINKS + 1) / 2) * weight / H
    np.testing.assert_allclose(np.tan(rest.q), slopes, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rest.multipliers["pin_y"], 0.5 * LINKS * weight, rtol=1e-12)
    assert rest.stable


@pytest.mark.full
def test_motion_of_the_loop_equals_the_cartesian_one():
    (q, v), times = next(loop_states(1)), np.linspace(0.0, 2.0, 9)
    angles = jl.simulate(ANGLES, q, v, times, LOOP, **TIGHT)
    start = TO_JOINTS.state(0.0, q, v, LOOP)
    cartesian = jl.simulate(JOINTS, *start, times, LOOP, **TIGHT)
    state = jax.vmap(lambda t, q, v: TO_JOINTS.state(t, q, v, LOOP))
    q, v = state(times, angles.q, angles.v)
    np.testing.assert_allclose(cartesian.q, q, rtol=0, atol=AGREEMENT)
    np.testing.assert_allclose(cartesian.v, v, rtol=0, atol=AGREEMENT * np.max(np.abs(v)))
    for motion in (angles, cartesian):
        np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=AGREEMENT)
