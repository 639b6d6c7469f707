"""Eigenvalues and stability limits of steady motions, against closed forms of the literature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, matrix_balance
from scipy.optimize import linear_sum_assignment

import jaxlag as jl
from systems.catalogue.classics import rolling_disk

G = 9.81
EPS = float(np.finfo(float).eps)
BESIDE = 1e-6  # relative distance from a limit at which both sides are compared


def eigenvalues(linear):
    """Shape (..., k)."""
    return np.asarray(jl.modes(linear).eigenvalues)


def rounding(A):
    """Bound on the difference of the eigenvalues of A and of a closed form: Bauer and Fike.

    n eps of the size of A for each of both. The greatest difference measured here is 0.48 of it.
    The matrix is balanced first, as in LAPACK. The units of the states then do not matter.
    """
    balanced, _ = matrix_balance(A, permute=False)
    _, vectors = np.linalg.eig(balanced)
    return 2 * len(A) * EPS * np.linalg.norm(balanced, 2) * np.linalg.cond(vectors)


def check_eigenvalues(linear, expected):
    """Compare sets of eigenvalues. Pairs are chosen for the least sum of distances."""
    found = eigenvalues(linear)
    assert found.shape == np.shape(expected)
    k = found.shape[-1]
    sets = (np.reshape(x, (-1, k)) for x in (found, expected))
    for A, these, those in zip(np.reshape(linear.A, (-1, k, k)), *sets, strict=True):
        distances = np.abs(these[:, None] - those[None])
        worst = np.max(distances[linear_sum_assignment(distances)])
        assert worst <= rounding(A)
    return found


def growth_rates(found, linear):
    """Greatest real parts; 0 for those within rounding."""
    growth = np.max(found.real, axis=-1)
    allowed = np.array([rounding(A) for A in linear.A])
    return np.where(np.abs(growth) > allowed, growth, 0.0)


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


@pytest.mark.parametrize("form", FORMS)
def test_eigenvalues_of_an_upright_rolling_disk(form):
    """A lean mode and two zeros: changes of speed, and steady rolling in large circles.

    Source: Neimark, Fufaev, Dynamics of Nonholonomic Systems (1972); O'Reilly, Nonlinear Dyn. 10
    (1996) 287.
    """
    speeds = np.linspace(0.0, 3.0, 5)
    check_eigenvalues(rolling_upright(form, speeds, RING), disk_eigenvalues(speeds, **RING))


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


# ---- Rotor on two bearings -----------------------------------------------------------------------

ROTOR = {"m": 12.0, "I_t": 0.3, "I_p": 0.45}
SYMMETRIC = ROTOR | {"k1": 4e5, "k2": 4e5, "z1": -0.2, "z2": 0.2}
OVERHUNG = ROTOR | {"k1": 5e5, "k2": 3e5, "z1": -0.35, "z2": -0.1}
SPINS = np.linspace(0.0, 1200.0, 9)


def rotor_lagrangian(t, q, v, p):
    """Rx(a) Ry(b) Rz(spin) of a rigid rotor; z1, z2 are the places of the springs on the axis."""
    a, b = q[2], q[3]
    across = (v[2] * jnp.cos(b)) ** 2 + v[3] ** 2
    along = (v[4] + v[2] * jnp.sin(b)) ** 2
    kinetic = p["m"] * v[:2] @ v[:2] + p["I_t"] * across + p["I_p"] * along
    axis = jnp.stack([jnp.sin(b), -jnp.sin(a) * jnp.cos(b)])
    first, second = q[:2] + p["z1"] * axis, q[:2] + p["z2"] * axis
    return 0.5 * (kinetic - p["k1"] * first @ first - p["k2"] * second @ second)


ROTATING = jl.System(rotor_lagrangian, ("x", "y", "a", "b", "spin"))


def campbell(params):
    """The linearized rotor at every spin."""

    def at(spin):
        v = jnp.zeros(5).at[4].set(spin)
        return jl.linearize(ROTATING, jnp.zeros(5), v, params, drop=("spin",))

    return jax.vmap(at)(jnp.asarray(SPINS))


def test_campbell_diagram_of_a_rotor_on_equal_bearings():
    """Cylindrical modes, and conical modes whose forward whirl rises with the spin.

    Source: Friswell, Penny, Garvey, Lees, Dynamics of Rotating Machines (2010), ch. 3.
    """
    linear, p = campbell(SYMMETRIC), SYMMETRIC
    stiffness = p["k1"] + p["k2"]
    gyroscopic = p["I_p"] * SPINS / (2 * p["I_t"])
    root = np.sqrt(gyroscopic**2 + stiffness * p["z2"] ** 2 / p["I_t"])
    cylindrical = np.full_like(SPINS, np.sqrt(stiffness / p["m"]))
    whirl = np.stack([root + gyroscopic, root - gyroscopic, cylindrical, cylindrical], axis=-1)
    zero = np.zeros((len(SPINS), 1))
    check_eigenvalues(linear, np.concatenate([1j * whirl, -1j * whirl, zero], axis=-1))

    # The end of the axis is at (b, -a). In forward whirl b - i a = c exp(i w t): a = i b.
    A, names = linear.A[5], linear.states
    values, vectors = np.linalg.eig(A)
    for place, sign in ((0, 1.0), (1, -1.0)):
        shape = vectors[:, np.argmin(np.abs(values - 1j * whirl[5, place]))]
        a, b = shape[names.index("a")], shape[names.index("b")]
        assert abs(a / b - sign * 1j) <= rounding(A) / whirl[5, place]  # relative


def test_campbell_diagram_of_an_overhung_rotor():
    """Four whirl frequencies of one complex equation, (x + i y, b - i a) = c exp(i w t).

    (K_T - m w^2) (K_R + I_p Omega w - I_t w^2) = K_C^2, with w < 0 for backward whirl.

    Source: Friswell, Penny, Garvey, Lees, Dynamics of Rotating Machines (2010), ch. 3.
    """
    linear, p = campbell(OVERHUNG), OVERHUNG
    k, z = np.array([p["k1"], p["k2"]]), np.array([p["z1"], p["z2"]])
    expected = []
    for spin in SPINS:
        moving = np.array([-p["m"], 0.0, np.sum(k)])
        leaning = np.array([-p["I_t"], p["I_p"] * spin, k @ z**2])
        quartic = np.polymul(moving, leaning) - np.array([0.0, 0.0, 0.0, 0.0, (k @ z) ** 2])
        whirl = np.roots(quartic)
        assert np.sum(whirl.real > 0) == np.sum(whirl.real < 0) == 2
        expected.append([*(1j * whirl), *(-1j * whirl), 0.0])
    check_eigenvalues(linear, np.array(expected))


# ---- Furuta's pendulum ---------------------------------------------------------------------------

FURUTA = {"J": 0.004, "m": 0.12, "r": 0.18, "l": 0.15, "I": 0.0009, "g": G}


def furuta_lagrangian(t, q, v, p):
    """Arm and a slender pendulum; its angle is counted from the upright position."""
    about = p["I"] + p["m"] * p["l"] ** 2
    turning = p["J"] + p["m"] * p["r"] ** 2 + about * jnp.sin(q[1]) ** 2
    both = p["m"] * p["r"] * p["l"] * jnp.cos(q[1]) * v[0] * v[1]
    kinetic = 0.5 * turning * v[0] ** 2 + both + 0.5 * about * v[1] ** 2
    return kinetic - p["m"] * p["g"] * p["l"] * jnp.cos(q[1])


def motor(t, q, v, p, inputs):
    return jnp.stack([inputs["torque"], jnp.zeros_like(q[1])])


PENDULUM = jl.System(
    furuta_lagrangian, ("arm", "pendulum"), forces=[jl.GeneralizedForce(motor, "motor")]
)


@pytest.fixture(scope="module")
def upright():
    return jl.linearize(PENDULUM, [0.0, 0.0], [0.0, 0.0], FURUTA, inputs=("torque",))


def test_matrices_of_the_upright_furuta_pendulum(upright):
    """Source: Cazzolato, Prime, J. Control Sci. Eng. 2011, 528341."""
    p = FURUTA
    arm, about = p["J"] + p["m"] * p["r"] ** 2, p["I"] + p["m"] * p["l"] ** 2
    both, weight = p["m"] * p["r"] * p["l"], p["m"] * p["g"] * p["l"]
    size = arm * about - both**2
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2, 1], A[3, 1] = -both * weight / size, arm * weight / size
    np.testing.assert_allclose(upright.A, A, rtol=8 * EPS, atol=0.0)
    np.testing.assert_allclose(upright.B[:, 0], [0, 0, about / size, -both / size], rtol=8 * EPS)


def test_stabilized_furuta_pendulum(upright):
    """Feedback of a linear-quadratic regulator moves the nonlinear pendulum upright."""
    control = pytest.importorskip("control")
    A, B = np.asarray(upright.A), np.asarray(upright.B)
    K, _, poles = control.lqr(A, B, np.diag([1.0, 1.0, 0.1, 0.1]), np.array([[10.0]]))
    gain = jnp.asarray(K[0])
    torque = jl.Feedback(lambda t, q, v, p: -gain @ jnp.concatenate([q, v]))
    inputs = {"torque": torque}
    closed = jl.linearize(PENDULUM, [0.0, 0.0], [0.0, 0.0], FURUTA, inputs=inputs)
    of_products = np.abs(A) + np.abs(B) @ np.abs(K)  # their differences are rounded
    assert np.all(np.abs(closed.A - (A - B @ K)) <= 4 * EPS * of_products)  # measured: 0.8 EPS
    check_eigenvalues(closed, np.linalg.eigvals(A - B @ K))
    check_eigenvalues(closed, poles)

    ts, rtol = np.linspace(0.0, 6.0, 13), 1e-12
    motion = jl.simulate(
        PENDULUM, [0.5, 0.3], [0.0, 0.0], ts, FURUTA, inputs=inputs, rtol=rtol, atol=1e-16
    )
    x = np.concatenate([motion.q, motion.v], axis=1)
    sizes, along = np.linalg.norm(x, axis=1), expm(np.asarray(closed.A) * ts[1])
    left = np.linalg.norm(x[1:] - x[:-1] @ along.T, axis=1)

    # The equations are odd in the state. What is left is cubic, measured as 3.01e-3 |x|^3.
    near = slice(4, len(left))
    assert np.all(left[near] <= 3.1e-3 * sizes[near] ** 3 + rtol * sizes[near])
    order = np.polyfit(np.log(sizes[4:8]), np.log(left[4:8]), 1)[0]
    assert order == pytest.approx(3.0, abs=2e-3)  # measured: 2.9990
    # The slowest pole remains: the others have fallen by exp(-gap t) relative to it.
    slowest, second = np.sort(-poles.real)[:2]
    rate = np.log(sizes[-2] / sizes[-1]) / ts[1]
    share = np.exp((slowest - second) * ts[-2])
    assert rate == pytest.approx(slowest, abs=2 * share / ts[1])  # measured: 1.5e-5 of 3.4e-5 1/s
