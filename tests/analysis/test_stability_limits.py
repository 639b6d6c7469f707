"""Eigenvalues and stability limits of steady motions, against closed forms of the literature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from systems.catalogue.classics import rolling_disk
from tests.analysis._eigenvalues import check_eigenvalues, growth_rates

G = 9.81
EPS = float(np.finfo(float).eps)
BESIDE = 1e-6  # relative distance from a limit at which both sides are compared


# ---- Rolling disk --------------------------------------------------------------------------------

DISK = {
    "rows": jl.System(
        coordinates=rolling_disk.system.coordinates.names,
        kinetic=rolling_disk.kinetic,
        potential=rolling_disk.potential,
        constraints=(jl.Pfaffian(rolling_disk.contact_velocity, "contact"),),
    ),
    "quasi": rolling_disk.system,
}
FORMS = ["rows", pytest.param("quasi", marks=pytest.mark.full)]
RADIUS = 0.3
RING = {"m": 1.3, "R": RADIUS, "I_d": 0.05, "I_a": 0.09, "g": G}
THIN = {"m": 1.3, "R": RADIUS, "I_d": 1.3 * RADIUS**2 / 4, "I_a": 1.3 * RADIUS**2 / 2, "g": G}


def rolling_upright(form, speeds, params):
    """The disk rolls along its heading of 0.4 rad."""
    heading, cyclic = 0.4, ("x", "y", "psi", "phi")
    independent = (*rolling_disk.system.coordinates.names,)
    if form == "rows":
        independent += "psi'", "theta'", "phi'"
    q = jnp.array([0.2, -0.1, heading, np.pi / 2, 0.3])

    def at(speed):
        zero = jnp.zeros_like(speed)
        along = speed * jnp.cos(heading), speed * jnp.sin(heading)
        v = jnp.stack([*along, zero, zero, -speed / RADIUS])
        return jl.linearize(DISK[form], q, v, params, independent=independent)

    return jax.vmap(at)(jnp.asarray(speeds)).dropped(cyclic)


def disk_eigenvalues(speeds, m, R, I_d, I_a, g):
    rates = np.asarray(speeds) / R
    square = (m * g * R - (I_a + m * R**2) * I_a / I_d * rates**2) / (I_d + m * R**2)
    pair = np.sqrt(square + 0j)
    return np.stack([pair, -pair, 0 * pair, 0 * pair], axis=-1)


@pytest.mark.full
@pytest.mark.parametrize("form", FORMS)
def test_eigenvalues_of_an_upright_rolling_disk(form):
    """A lean mode and two zeros: changes of speed, and steady rolling in large circles.

    Source: Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972); O'Reilly, Nonlinear Dyn. 10
    (1996) 287.
    """
    speeds = np.linspace(0.0, 3.0, 5)
    check_eigenvalues(rolling_upright(form, speeds, RING), disk_eigenvalues(speeds, **RING))


@pytest.mark.full
@pytest.mark.parametrize("form", FORMS)
def test_critical_speed_of_a_thin_disk(form):
    """v^2 = g R / 3: the disk falls below it and oscillates above it.

    lambda^2 = 4 g / (5 R) (1 - 3 v^2 / (g R)).
    """
    ratios = np.array([0.0, 0.5, 1 - BESIDE, 1 + BESIDE, 2.0])
    linear = rolling_upright(form, ratios * np.sqrt(G * RADIUS / 3), THIN)
    pair = np.sqrt(4 * G / (5 * RADIUS) * (1 - ratios**2) + 0j)
    zero = np.zeros_like(pair)
    found = check_eigenvalues(linear, np.stack([pair, -pair, zero, zero], axis=-1))
    assert np.all((growth_rates(found, linear) > 0) == (ratios < 1))


# ---- Sleeping top --------------------------------------------------------------------------------

TOP = {"m": 0.6, "g": G, "l": 0.12, "I1": 0.012, "I3": 0.003}


def top_in_cardan_angles(t, q, v, p):
    """Rx(a) Ry(b) Rz(spin) from the upright position."""
    a, b, _ = q
    across = (v[0] * jnp.cos(b)) ** 2 + v[1] ** 2
    along = (v[2] + v[0] * jnp.sin(b)) ** 2
    height = p["l"] * jnp.cos(a) * jnp.cos(b)
    return 0.5 * (p["I1"] * across + p["I3"] * along) - p["m"] * p["g"] * height


def routhian_of_the_axis(t, q, v, p):
    """A unit vector along the axis, for the constant momentum p = I3 w3 of the spin."""
    turning = (q[0] * v[1] - q[1] * v[0]) / (1.0 + q[2])
    gyroscopic = p["momentum"] * turning
    return 0.5 * p["I1"] * v @ v + gyroscopic - p["m"] * p["g"] * p["l"] * q[2]


CARDAN = jl.System(top_in_cardan_angles, ("a", "b", "spin"))
AXIS = jl.System(
    routhian_of_the_axis,
    ("x", "y", "z"),
    constraints=(jl.Holonomic(lambda t, q, p: q @ q - 1.0, "unit"),),
)


def sleeping_top(form, spins):
    def cardan(spin):
        v = jnp.zeros(3).at[2].set(spin)
        return jl.linearize(CARDAN, jnp.zeros(3), v, TOP)

    def axis(spin):
        params = TOP | {"momentum": TOP["I3"] * spin}
        independent = "x", "y", "x'", "y'"
        q = jnp.array([0.0, 0.0, 1.0])
        return jl.linearize(AXIS, q, jnp.zeros(3), params, independent=independent)

    if form == "cardan":
        return jax.vmap(cardan)(jnp.asarray(spins)).dropped(("spin",))
    return jax.vmap(axis)(jnp.asarray(spins))


def top_eigenvalues(spins, m, g, l, I1, I3):  # noqa: E741
    momentum = I3 * np.asarray(spins)
    root = np.sqrt(momentum**2 - 4 * I1 * m * g * l + 0j)
    nutation, precession = 1j * (momentum + root) / (2 * I1), 1j * (momentum - root) / (2 * I1)
    return np.stack([nutation, precession, nutation.conj(), precession.conj()], axis=-1)


@pytest.mark.full
@pytest.mark.parametrize("form", ["cardan", "axis"])
def test_eigenvalues_and_stability_limit_of_the_sleeping_top(form):
    """Fast and slow precession about the vertical; stable for (I3 w)^2 > 4 I1 m g l.

    Source: Landau, Lifshitz, Mechanics, sec. 35, problem 2; Goldstein, Classical Mechanics,
    sec. 5.7.
    """
    limit = np.sqrt(4 * TOP["I1"] * TOP["m"] * G * TOP["l"]) / TOP["I3"]
    spins = limit * np.array([0.0, 0.5, 1 - BESIDE, 1 + BESIDE, 1.5, 3.0, -1.5])
    linear = sleeping_top(form, spins)
    expected = top_eigenvalues(spins, **TOP)
    if form == "cardan":  # the spin may change
        expected = np.append(expected, np.zeros((len(spins), 1)), axis=1)
    found = check_eigenvalues(linear, expected)
    assert np.all((growth_rates(found, linear) > 0) == (np.abs(spins) < limit))


# ---- Flyball governor ----------------------------------------------------------------------------

GOVERNOR = {"J": 0.4, "m": 0.9, "l": 0.25, "n": 1.5, "k": 8.0, "angle": 0.8, "g": G}


def steady(p):
    """(load, speed of the engine) at which the arms are steady at the angle."""
    cosine = np.cos(p["angle"])
    return p["k"] * cosine, np.sqrt(p["g"] / (p["l"] * cosine)) / p["n"]


LOAD, SPEED = steady(GOVERNOR)


def governor_by_angles():
    """The angle of the engine, and that of the arms from the vertical."""

    def lagrangian(t, q, v, p):
        turning = p["n"] * v[0] * jnp.sin(q[1])
        balls = 0.5 * p["m"] * p["l"] ** 2 * (v[1] ** 2 + turning**2)
        return 0.5 * p["J"] * v[0] ** 2 + balls + p["m"] * p["g"] * p["l"] * jnp.cos(q[1])

    def torque(t, q, v, p):
        return jnp.stack([p["k"] * jnp.cos(q[1]) - LOAD, -p["b"] * v[1]])

    system = jl.System(
        lagrangian, ("engine", "arm"), forces=[jl.GeneralizedForce(torque, "valve and damper")]
    )
    return system, [0.4, GOVERNOR["angle"]], [SPEED, 0.0], ("engine", "arm", "engine'", "arm'")


def governor_by_points():
    """The angle of the engine, and the position of the balls as one point, with two rows."""

    def lagrangian(t, q, v, p):
        return 0.5 * p["J"] * v[0] ** 2 + 0.5 * p["m"] * v[1:] @ v[1:] - p["m"] * p["g"] * q[3]

    def torque(t, q, v, p):
        zero = jnp.zeros_like(q[0])
        return jnp.stack([-p["k"] * q[3] / p["l"] - LOAD, zero, zero, zero])

    def damper(t, q, v, p):
        return 0.5 * p["b"] * v[3] ** 2 / (q[1] ** 2 + q[2] ** 2)  # z' = l sin(angle) angle'

    def arm(t, q, p):
        return q[1:] @ q[1:] - p["l"] ** 2

    def plane(t, q, p):
        turned = p["n"] * q[0]
        return q[1] * jnp.sin(turned) - q[2] * jnp.cos(turned)

    system = jl.System(
        lagrangian,
        ("engine", "x", "y", "z"),
        forces=[jl.GeneralizedForce(torque, "valve"), jl.Rayleigh(damper, "damper")],
        constraints=(jl.Holonomic(arm, "arm"), jl.Holonomic(plane, "plane")),
    )
    turned, radius = GOVERNOR["n"] * 0.4, GOVERNOR["l"] * np.sin(GOVERNOR["angle"])
    x, y = radius * np.cos(turned), radius * np.sin(turned)
    rate = GOVERNOR["n"] * SPEED
    q = [0.4, x, y, -GOVERNOR["l"] * np.cos(GOVERNOR["angle"])]
    return system, q, [SPEED, -rate * y, rate * x, 0.0], ("engine", "z", "engine'", "z'")


def governor_polynomial(b, J, m, l, n, k, angle, g):  # noqa: E741
    """The characteristic polynomial of deviations a of the arms and w of the speed.

    With the steady angle A and speed w0, N = (n w0)^2 = g / (l cos A), C = 2 n^2 w0 sin A cos A
    and D = J + m (n l sin A)^2:

        a'' + b / (m l^2) a' + N sin(A)^2 a = C w,   D w' = -k sin(A) a - m l^2 C a'
    """
    sine, cosine = np.sin(angle), np.cos(angle)
    square = g / (l * cosine)
    coupling = 2 * n * np.sqrt(square) * sine * cosine
    inertia = J + m * (n * l * sine) ** 2
    linear = square * sine**2 + m * (l * coupling) ** 2 / inertia
    return np.array([1.0, b / (m * l**2), linear, coupling * k * sine / inertia])


@pytest.mark.parametrize(
    "declare", [governor_by_angles, pytest.param(governor_by_points, marks=pytest.mark.full)]
)
def test_stability_limit_of_a_flyball_governor(declare):
    """A steam engine whose valve is closed by the balls: stable with sufficient damping.

    The cubic p^3 + c2 p^2 + c1 p + c0 has the roots -c2 and +-i sqrt(c1) at the limit c1 c2 = c0.

    Source: Maxwell, Proc. R. Soc. 16 (1868) 270, with the inertia of the balls; Pontryagin,
    Ordinary Differential Equations (1962), sec. 27, without it.
    """
    system, q, v, independent = declare()

    def at(b):
        params = GOVERNOR | {"b": b}
        return jl.linearize(system, q, v, params, independent=independent)

    _, _, c1, c0 = governor_polynomial(0.0, **GOVERNOR)
    limit = GOVERNOR["m"] * GOVERNOR["l"] ** 2 * c0 / c1
    dampings = limit * np.array([1.0, 0.0, 0.5, 1 - BESIDE, 1 + BESIDE, 2.0, 8.0])
    linear = jax.vmap(at)(jnp.asarray(dampings)).dropped(("engine",))
    expected = np.stack([np.roots(governor_polynomial(b, **GOVERNOR)) for b in dampings])
    expected[0] = -c0 / c1, 1j * np.sqrt(c1), -1j * np.sqrt(c1)
    growth = growth_rates(check_eigenvalues(linear, expected), linear)
    assert np.all(np.sign(growth) == [0, 1, 1, 1, -1, -1, -1])


def test_condition_of_vyshnegradsky():
    """b J / (m l^2) > 2 F / w0: friction, inertia and a fall of speed with load are necessary.

    The speed of the engine is a state beside the mechanics. The balls do not react on it.

    Source: Pontryagin, Ordinary Differential Equations (1962), sec. 27.
    """

    def speed_rate(t, q, v, x, p):
        return (p["k"] * jnp.cos(q) - LOAD) / p["J"]

    def balls(t, q, v, p, inputs):
        turning = (p["n"] * inputs["speed"]) ** 2 * jnp.sin(q[0]) * jnp.cos(q[0])
        return (p["m"] * p["l"] ** 2 * turning - p["b"] * v[0])[None]

    def lagrangian(t, q, v, p):
        return 0.5 * p["m"] * (p["l"] * v[0]) ** 2 + p["m"] * p["g"] * p["l"] * jnp.cos(q[0])

    system = jl.System(
        lagrangian,
        ("arm",),
        forces=[jl.GeneralizedForce(balls, "balls")],
        states=jl.States(speed_rate, ("speed",)),
    )
    angle, p = GOVERNOR["angle"], GOVERNOR

    def at(b):
        return jl.linearize(system, [angle], [0.0], p | {"b": b}, inputs={"speed": SPEED})

    limit = p["m"] * p["l"] ** 2 * 2 * LOAD / (SPEED * p["J"])
    dampings = limit * np.array([1.0, 0.0, 1 - BESIDE, 1 + BESIDE, 4.0])
    linear = jax.vmap(at)(jnp.asarray(dampings))
    square = G * np.sin(angle) ** 2 / (p["l"] * np.cos(angle))
    constant = 2 * p["k"] * G * np.sin(angle) ** 2 / (p["l"] * p["J"] * SPEED)
    cubics = [[1.0, b / (p["m"] * p["l"] ** 2), square, constant] for b in dampings]
    expected = np.stack([np.roots(cubic) for cubic in cubics])
    expected[0] = -2 * LOAD / (SPEED * p["J"]), 1j * np.sqrt(square), -1j * np.sqrt(square)
    growth = growth_rates(check_eigenvalues(linear, expected), linear)
    assert np.all(np.sign(growth) == [0, 1, 1, -1, -1])
