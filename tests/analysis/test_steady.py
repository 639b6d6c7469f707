"""Steady motions: tops, disks and bicycles on circles, trimmed crafts; what is not steady."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from bench.mechanisms._bicycle import BICYCLE
from bench.mechanisms._scenes import SCENES

EPS = np.finfo(float).eps
G = 9.81
A, C, MGL = 0.01, 0.002, 0.5  # kg m^2, N m


def top(t, q, v, p):
    """Heavy symmetric top in Euler's angles."""
    spin = v[2] + v[0] * jnp.cos(q[1])
    across = v[1] ** 2 + (jnp.sin(q[1]) * v[0]) ** 2
    return 0.5 * A * across + 0.5 * C * spin**2 - p * jnp.cos(q[1])


TOP = jl.System(top, ("phi", "theta", "psi"))
THETA, SPIN = 0.6, 300.0


def precession(mgl=MGL, guess=1.0, theta=THETA):
    return jl.steady(TOP, [0.1, theta, 0.2], [guess, 0.0, SPIN], mgl, free=("phi'",))


def rates_of_precession(mgl=MGL, theta=THETA):
    """Both roots of (C - A) cos(theta) phi'^2 + C psi' phi' = m g l."""
    a, b = (C - A) * np.cos(theta), C * SPIN
    root = np.sqrt(b * b + 4 * a * mgl)
    return 2 * mgl / (b + root), (-b - root) / (2 * a)


@pytest.mark.parametrize(("guess", "which"), [(1.0, 0), (70.0, 1)])
def test_slow_and_fast_precession_of_a_top(guess, which):
    motion, exact = precession(guess=guess), rates_of_precession()[which]
    assert motion.status == jl.Status.ok
    assert abs(motion["phi'"] - exact) <= 20 * EPS * exact
    assert motion["theta"] == THETA
    assert motion["psi'"] == SPIN
    assert np.all(np.abs(motion.residual) <= 1e-12 * motion.scale + 1e-12)
    assert motion.equations == ("rate of phi'", "rate of theta'", "rate of psi'")


@pytest.mark.full
def test_first_and_second_derivatives():
    def rate(x):
        return precession(mgl=x[0], theta=x[1]).v[0]

    x, h = jnp.array([MGL, THETA]), 1e-5
    slope = jax.jit(jax.grad(rate))
    forward = jax.jit(jax.jacfwd(rate))(x)
    np.testing.assert_allclose(slope(x), forward, rtol=1e-12)
    exact = rates_of_precession
    apart = [(exact(MGL + h)[0] - exact(MGL - h)[0]) / (2 * h)]
    apart.append((exact(MGL, THETA + h)[0] - exact(MGL, THETA - h)[0]) / (2 * h))
    np.testing.assert_allclose(forward, apart, rtol=1e-8)
    second = jax.jit(jax.jacfwd(jax.grad(rate)))(x)
    np.testing.assert_allclose(second, second.T, rtol=1e-9)
    rows = [(slope(x.at[i].add(h)) - slope(x.at[i].add(-h))) / (2 * h) for i in range(2)]
    np.testing.assert_allclose(second, np.stack(rows), rtol=1e-7)


@pytest.mark.full
def test_batch_and_failed_lanes():
    """Below a spin there is no precession at this angle; its derivative is NaN."""

    def of(spin):
        v = jnp.stack([jnp.asarray(1.0), jnp.asarray(0.0), spin])
        return jl.steady(TOP, [0.0, THETA, 0.0], v, -MGL, free=("phi'",))

    spins = jnp.array([300.0, 20.0])
    motions = jax.jit(jax.vmap(of))(spins)
    a = (C - A) * np.cos(THETA)
    assert 4 * a * MGL < (C * 20.0) ** 2
    assert [int(s) for s in motions.status] == [0, 0]
    upright = jax.jit(
        jax.vmap(
            lambda s: jl.steady(
                TOP, [0.0, THETA, 0.0], jnp.stack([1.0, 0.0, s]), MGL, free=("phi'",)
            )
        )
    )(spins)
    assert int(upright.status[0]) == jl.Status.ok
    assert int(upright.status[1]) == jl.Status.implicit_solve_failed
    assert len(upright) == 2
    assert "no steady motion was found" in upright[1].message()


RADIUS, MASS = 0.5, 2.0


def centre(q):
    """Centre of a disk that touches the ground at (x, y), with heading psi and lean theta."""
    x, y, psi, theta = q[:4]
    across = RADIUS * jnp.sin(theta)
    return jnp.stack(
        [x + across * jnp.sin(psi), y - across * jnp.cos(psi), RADIUS * jnp.cos(theta)]
    )


def disk(t, q, v, p):
    """A thin disk; I is its inertia about the axis, half of it about a diameter."""
    u, inertia = jax.jvp(centre, (q,), (v,))[1], 0.5 * MASS * RADIUS**2
    across = v[3] ** 2 + (v[2] * jnp.cos(q[3])) ** 2
    spin = (v[4] + v[2] * jnp.sin(q[3])) ** 2
    kinetic = 0.5 * MASS * (u @ u) + 0.25 * inertia * across + 0.5 * inertia * spin
    return kinetic - MASS * G * centre(q)[2]


def rolling(t, q, v, p):
    s = RADIUS * v[4]
    return jnp.stack([v[0] - s * jnp.cos(q[2]), v[1] - s * jnp.sin(q[2])])


DISK = jl.System(
    disk, ("x", "y", "psi", "theta", "phi"), constraints=(jl.Pfaffian(rolling, "rolling"),)
)


def balance_of_disk(theta, turn, spin):
    """theta'' = 0 of a thin rolling disk, by hand (Euler's equation about the contact)."""
    s, c, inertia = np.sin(theta), np.cos(theta), 0.5 * MASS * RADIUS**2
    whole = spin + turn * s
    along = (inertia + MASS * RADIUS**2) * whole * turn * c - 0.5 * inertia * turn**2 * s * c
    return along + MASS * G * RADIUS * s


@pytest.mark.full
@pytest.mark.parametrize("psi", [0.0, 0.7, 0.5 * np.pi])
@pytest.mark.parametrize("free", ["phi'", "theta", "psi'"])
def test_disk_on_a_circle(psi, free):
    """Whatever its heading, x' and y' vary, and the angular rates are constant."""
    given = {"theta": 0.4, "psi'": -2.0, "phi'": 3.6}
    guess = [0.3, 0.1, psi, given["theta"], 0.2], [0.0, 0.0, given["psi'"], 0.0, given["phi'"]]
    motion = jl.steady(DISK, *guess, free=(free,))
    theta, turn, spin = float(motion["theta"]), float(motion["psi'"]), float(motion["phi'"])
    assert abs(balance_of_disk(theta, turn, spin)) <= 100 * EPS * MASS * G * RADIUS
    assert {"psi'", "theta'", "phi'"} <= set(motion.independent)
    assert abs(motion["x'"] - RADIUS * spin * np.cos(psi)) <= 10 * EPS * abs(RADIUS * spin)
    assert all(motion[name] == given[name] for name in given.keys() - {free})


@pytest.mark.full
def test_named_velocities_that_cannot_be_constant():
    independent = ("x", "y", "psi", "theta", "phi", "x'", "psi'", "theta'")
    guess = [0.0, 0.0, 0.4, 0.4, 0.0], [3.0, 1.0, -2.0, 0.0, 7.0]
    with pytest.raises(jl.EquilibriumError, match=r"name other velocities|name the velocities"):
        jl.steady(DISK, *guess, free=("theta",), independent=independent)


def test_trimmed_craft_with_free_inputs():
    """Horizontal flight of a tilted rotor: tan(pitch) = drag / weight."""

    def lagrangian(t, q, v, p):
        return v[0] ** 2 + v[1] ** 2 + 0.05 * v[2] ** 2 - 2.0 * G * q[1]

    def rotor(t, q, v, p, inputs):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        drag = p * v[0] * jnp.abs(v[0])
        return jnp.stack([-inputs["T"] * s - drag, inputs["T"] * c, inputs["M"] - 0.02 * v[0]])

    craft = jl.System(lagrangian, ("x", "z", "pitch"), forces=[jl.GeneralizedForce(rotor, "rotor")])
    found = jl.steady(
        craft, [0.0] * 3, [5.0, 0.0, 0.0], 0.3, free=("pitch", "T", "M"), inputs=("T", "M")
    )
    weight, drag = 2.0 * G, 0.3 * 25.0
    assert abs(found["pitch"] + np.arctan2(drag, weight)) <= 4 * EPS
    assert abs(found.inputs["T"] - np.hypot(drag, weight)) <= 4 * EPS * weight
    assert abs(found.inputs["M"] - 0.1) <= 4 * EPS
    linear = jl.linearize(craft, found.q, found.v, 0.3, inputs=found.inputs)
    assert np.max(np.abs(linear.f0[3:])) <= 10 * EPS * weight


def test_states_are_steady_too():
    """A motor with drag at the speed where its current has settled."""
    rate = lambda t, q, v, x, p, inputs: (inputs["u"] - x - 0.1 * v) / 0.05  # noqa: E731
    torque = lambda t, q, v, p, inputs: 0.3 * inputs["i"] - 0.01 * v * jnp.abs(v)  # noqa: E731
    motor = jl.System(
        lambda t, q, v, p: 0.01 * (v @ v),
        ("phi",),
        forces=[jl.GeneralizedForce(torque, "torque")],
        states=jl.States(rate, ("i",)),
    )
    found = jl.steady(motor, [0.0], [1.0], free=("phi'", "i"), inputs={"u": 2.0, "i": 0.0})
    speed = (-0.03 + np.sqrt(0.03**2 + 4 * 0.01 * 0.6)) / 0.02
    assert abs(found["phi'"] - speed) <= 10 * EPS * speed
    assert abs(found.inputs["i"] - (2.0 - 0.1 * speed)) <= 10 * EPS * 2.0
    assert found.equations == ("rate of phi'", "rate of i")


def bead(t, q, v, p):
    """A bead on a turning ring, in cylindrical coordinates."""
    return 0.5 * (v[0] ** 2 + v[1] ** 2 + (q[0] * v[2]) ** 2) + 0.05 * v[2] ** 2 - G * q[1]


BEAD = jl.System(
    bead,
    ("r", "z", "phi"),
    constraints=(jl.Holonomic(lambda t, q, p: q[0] ** 2 + q[1] ** 2 - 1.0, "ring"),),
)


@pytest.mark.full
def test_dependent_coordinates_follow():
    """cos = g / w^2: from a guess off the ring, whose z follows."""
    found = jl.steady(BEAD, [0.6, -0.7, 0.0], [0.0, 0.0, 3.0], free=("phi'",))
    assert abs(found["z"] + 0.8) <= 4 * EPS
    assert abs(found["phi'"] ** 2 * 0.8 - G) <= 20 * EPS * G


@pytest.mark.full
def test_quasi_velocities_are_constant():
    """A skate on a circle, in its speed along the edge and its rate of turn."""

    def of(t, q, v, p):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        return jnp.stack([c * v[0] + s * v[1], v[2], -s * v[0] + c * v[1]])

    quasi = jl.QuasiVelocities(of, ("along", "turn", "across"), constrained=("across",))

    def lagrangian(t, q, v, p):
        ahead = v[:2] + 0.2 * v[2] * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return 0.75 * (ahead @ ahead) + 0.1 * v[2] ** 2

    skate = jl.System(lagrangian, ("x", "y", "psi"), quasi=quasi)
    v = [2.0 * np.cos(0.5), 2.0 * np.sin(0.5), 0.7]
    # With the centre ahead of the edge only straight motion is steady.
    found = jl.steady(skate, [0.0, 0.0, 0.5], v, free=("turn",))
    assert found.independent == ("x", "y", "psi", "along", "turn")
    assert np.max(np.abs(found.v - np.array([2 * np.cos(0.5), 2 * np.sin(0.5), 0.0]))) <= 1e-7
    with pytest.raises(jl.EquilibriumError, match="rate of"):
        jl.steady(skate, [0.0, 0.0, 0.5], v, free=())


CUBIC = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 0.25 * q[0] ** 4, ("x",))


def test_motion_that_is_steady_for_an_instant_only():
    """x'' = -x^3 and its first derivative vanish at x = 0; not while x moves."""
    with pytest.raises(jl.EquilibriumError, match=r"x' becomes -1 as 'x' moves. Make the velocity"):
        jl.steady(CUBIC, [0.0], [1.0], free=())
    timed = jl.System(lambda t, q, v, p: 0.5 * (v @ v) + q[0] * jnp.sin(t), ("x",))
    with pytest.raises(jl.EquilibriumError, match=r"x' becomes 0.84\d* later. It depends on time"):
        jl.steady(timed, [0.0], [1.0], free=())


HZ = 30


def shaken(t, q, v, p):
    """Shaken at a frequency of which every second has whole periods; then as a wave in space."""
    return 0.5 * (v @ v) - 0.5 * (q[0] - 1.0) ** 2 + q[0] * p * jnp.sin(2 * jnp.pi * HZ * t)


def test_no_period_hides():
    with pytest.raises(jl.EquilibriumError, match=r"later. It depends on time"):
        jl.steady(jl.System(shaken, ("x",)), [0.5], [0.0], 0.1, free=("x",))
    waves = jl.System(lambda t, q, v, p: 0.5 * (v @ v) + jnp.cos(6 * jnp.pi * q[0]), ("x",))
    with pytest.raises(jl.EquilibriumError, match="as 'x' moves"):
        jl.steady(waves, [0.0], [2.0], free=())


def test_inputs_of_time_are_followed():
    push = lambda t, q, v, p, inputs: inputs["u"] - q  # noqa: E731
    system = jl.System(
        lambda t, q, v, p: 0.5 * (v @ v), ("x",), forces=[jl.GeneralizedForce(push, "push")]
    )
    for signal in (
        jl.TimeFunction(lambda t: 1.0 + jnp.sin(t)),
        jl.LinearInterpolation([0.0, 10.0], [1.0, 1.5]),
    ):
        with pytest.raises(jl.EquilibriumError, match=r"later. It depends on time"):
            jl.steady(system, [0.5], [0.0], free=("x",), inputs={"u": signal})
        held = jl.steady(system, [0.5], [0.0], free=("u",), inputs={"u": signal})
        assert abs(held.inputs["u"] - 0.5) <= 2 * EPS  # a free input is a constant


def test_a_slow_part_beside_a_fast_one():
    """A pendulum that swings beside a fast rotor is not steady."""

    def lagrangian(t, q, v, p):
        rotor = 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2) - 1e6 * (q[0] - 0.5) ** 2
        return rotor + 0.5 * v[2] ** 2 - 0.5 * q[2] ** 2

    both = jl.System(lagrangian, ("r", "phi", "x"))
    with pytest.raises(jl.EquilibriumError, match=r"rate of x' becomes .* as 'x' moves"):
        jl.steady(both, [1.0, 0.0, 0.0], [0.0, 1e3, 1.0], free=("r",))


@pytest.mark.full
@pytest.mark.parametrize("stiffness", [1e2, 1e8])
def test_derivative_of_a_stiff_system(stiffness):
    def lagrangian(t, q, v, p):
        return 0.5 * (v @ v) - 0.5 * (q @ q) - 0.5 * stiffness * (q[0] - q[1]) ** 2 + p * q[0]

    system = jl.System(lagrangian, ("a", "b"))
    of = lambda p: jl.steady(system, [0.0, 0.0], [0.0, 0.0], p, free=("a", "b")).q  # noqa: E731
    exact = np.array([1 + stiffness, stiffness]) / (1 + 2 * stiffness)
    assert np.max(np.abs(jax.jacfwd(of)(1.0) - exact)) <= 20 * EPS * stiffness


@pytest.mark.full
def test_single_precision():
    """Small units, and both modes of derivatives."""
    with jax.enable_x64(False):
        spring = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 0.5 * (q @ q), ("x",))
        with pytest.raises(jl.EquilibriumError, match="no steady motion was found"):
            jl.steady(spring, [1e-6], [0.0], free=())

        def radial(t, q, v, p):
            return 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2) - 0.5 * p * (q[0] - 0.5) ** 2

        orbit = jl.System(radial, ("r", "phi"))

        def rate(p):
            return jl.steady(orbit, [1.0, 0.0], [0.0, 1.0], p, free=("phi'",)).v[1]

        assert abs(jax.jacfwd(rate)(2.0) - 0.25) <= 1e-6
        assert abs(jax.grad(rate)(2.0) - 0.25) <= 1e-6


def test_none_is_found():
    sinking = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - jnp.exp(-q[0]), ("x",))
    with pytest.raises(
        jl.EquilibriumError, match=r"no steady motion was found.* rate of x'"
    ) as info:
        jl.steady(sinking, [0.0], [0.0], free=("x",))
    assert isinstance(info.value.equilibrium, jl.SteadyMotion)
    lost = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - jnp.sqrt(q[0]), ("x",))
    with pytest.raises(jl.EquilibriumError, match="nonfinite: the equations are not finite"):
        jl.steady(lost, [-1.0], [0.0], free=())


@pytest.mark.full
def test_bad_input():
    with pytest.raises(ValueError, match=r"steady: `free` must be names among \['x', \"x'\"\]"):
        jl.steady(CUBIC, [0.0], [1.0], free=("y",))
    with pytest.raises(ValueError, match=r"steady: `free` must be a sequence.* free=\('x',\)"):
        jl.steady(CUBIC, [0.0], [1.0], free="x")
    with pytest.raises(ValueError, match=r"steady: `rtol` must be a positive number, less than 1"):
        jl.steady(CUBIC, [0.0], [1.0], free=(), rtol=2.0)
    with pytest.raises(ValueError, match=r"`max_steps` must be a positive integer"):
        jl.steady(CUBIC, [0.0], [1.0], free=(), max_steps=0)
    twice = jl.System(
        lambda t, q, v, p: 0.5 * (v @ v),
        ("x",),
        forces=[jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["x"] - q, "push")],
    )
    with pytest.raises(ValueError, match=r"`free` must name one quantity each, but 'x' was"):
        jl.steady(twice, [0.0], [0.0], free=("x",), inputs=("x",))
    quasi = jl.QuasiVelocities(lambda t, q, v, p: 2.0 * v, ("ur", "uz", "w"))
    half = jl.System(bead, ("r", "z", "phi"), quasi=quasi, constraints=BEAD.constraints)
    for function in (jl.linearize, functools.partial(jl.steady, free=())):
        with pytest.raises(ValueError, match=r"`system` must have quasi-velocities that satisfy"):
            function(half, [0.6, -0.8, 0.0], [0.0, 0.0, 3.0])
    with pytest.raises(ValueError, match=r"steady: `independent` must name 3 velocities"):
        jl.steady(DISK, [0.0] * 5, [0.0] * 5, free=(), independent=("x'",))
    with pytest.raises(ValueError, match=r"steady: `independent` must name the independent"):
        jax.jit(lambda q: jl.steady(BEAD, q, jnp.zeros(3), free=()).q)(jnp.zeros(3))


@functools.cache
def bicycle():
    return SCENES["bicycle"]().system()


def circling(lean, steer, speed):
    q, v = np.zeros(8), np.zeros(8)
    q[3], q[5], v[0] = lean, steer, speed
    v[6], v[7] = -speed / BICYCLE["r_rear"], -speed / BICYCLE["r_front"]
    return q, v


@pytest.mark.full
def test_bicycle_on_circles_without_hands():
    """Circles begin at the capsize speed; the motion found stays on its circle for 10 s."""
    system, free = bicycle(), ("steer", "rear'")
    upright = jl.steady(system, *circling(1e-3, 3e-4, 6.0), BICYCLE, free=free)
    # The capsize speed of Meijaard et al. (2007); circles differ from it by the square of the lean.
    assert abs(upright["rear'"] * BICYCLE["r_rear"] + 6.02426201538837) <= 1e-5
    found = jl.steady(system, *circling(0.2, 0.1, 6.3), BICYCLE, free=free)
    motion = jl.simulate(system, found.q, found.v, jnp.linspace(0.0, 10.0, 11), BICYCLE)
    for name in ("lean", "steer", "pitch"):
        assert np.max(np.abs(motion[name] - found[name])) <= 1e-7
    radius = abs(found["rear'"] * BICYCLE["r_rear"] / found["yaw'"])
    middle = np.array([0.0, radius])
    place = np.stack([motion["x"], motion["y"]], 1)
    assert np.max(np.abs(np.linalg.norm(place - middle, axis=1) - radius)) <= 1e-5
