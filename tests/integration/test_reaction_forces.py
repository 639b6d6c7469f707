"""Motions under forces that depend on multipliers, compared with closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from numpy import cos, sin

import jaxlag as jl
from jaxlag._core._status import Status
from jaxlag._system._inspection import contact_rows_independent
from systems import falling_stick_friction

G = 9.81
TIGHT = {"rtol": 1e-11, "atol": 1e-11}


# ---- A block on an incline -----------------------------------------------------------------------

SLOPE, M = 0.4, 2.0


def particle(t, q, v, params):
    return 0.5 * M * v @ v - M * G * q[1]


def plane(t, q, params):
    """Height above the incline, along its normal: lam is the normal force."""
    return cos(SLOPE) * q[1] - sin(SLOPE) * q[0]


def uphill(t, q, v, params):
    return cos(SLOPE) * v[0] + sin(SLOPE) * v[1]


def drag(t, q, v, params, lam):
    tangent = jnp.array([cos(SLOPE), sin(SLOPE)])
    return -params * lam["plane"] * jnp.sign(uphill(t, q, v, params)) * tangent


BLOCK = jl.System(
    particle,
    ("x", "y"),
    forces=(jl.GeneralizedForce(drag, "drag", reaction=True, contact="plane", sliding=uphill),),
    constraints=(jl.Holonomic(plane, "plane"),),
)
MU, SPEED = 0.3, 5.0
STOP = SPEED / (G * (sin(SLOPE) + MU * cos(SLOPE)))


def slid(mu, ts, speed=SPEED, **options):
    v0 = speed * np.array([cos(SLOPE), sin(SLOPE)])
    return jl.simulate(BLOCK, [0.0, 0.0], v0, ts, mu, **TIGHT, **options)


def test_block_slides_by_coulombs_law():
    ts = np.linspace(0.0, 0.9 * STOP, 4)
    motion = slid(MU, ts)
    deceleration = G * (sin(SLOPE) + MU * cos(SLOPE))
    distance = SPEED * ts - 0.5 * deceleration * ts**2
    np.testing.assert_allclose(motion.q, np.outer(distance, [cos(SLOPE), sin(SLOPE)]), atol=1e-13)
    np.testing.assert_allclose(motion.lam["plane"], M * G * cos(SLOPE), rtol=1e-13)


@pytest.mark.full
def test_derivative_of_the_distance_by_friction_is_exact():
    """d distance/d mu = -g cos(slope) t^2/2."""
    ts = np.array([0.0, 0.5 * STOP])

    def height(mu):
        return slid(mu, ts, throw=False).q[-1, 1]

    expected = -0.5 * G * cos(SLOPE) * ts[-1] ** 2 * sin(SLOPE)
    np.testing.assert_allclose(jax.grad(height)(MU), expected, rtol=1e-12)


@pytest.mark.full
def test_motion_ends_when_sliding_ends():
    """Friction would go on pushing: beyond, it is another system."""
    motion = slid(MU, np.array([0.0, 2 * STOP]), throw=False)
    assert motion.status == Status.no_reaction_solution
    np.testing.assert_allclose(motion.last_time, STOP, rtol=1e-9)  # rejected steps approach it
    with pytest.raises(jl.SimulationError, match=r"(?s)plane.*contact lifts off, its sliding"):
        slid(MU, np.array([0.0, 2 * STOP]))


def test_start_without_sliding_is_refused():
    """The direction of friction is unknown."""
    with pytest.raises(jl.SimulationError, match="contact lifts off, its sliding"):
        slid(MU, np.array([0.0, 0.1]), speed=0.0)


# ---- Off a cylinder ------------------------------------------------------------------------------


def cylinder(t, q, params):
    return jnp.sqrt(q @ q) - 1.0


def nothing(t, q, v, params, lam):
    return 0.0 * q * lam["cylinder"]


@pytest.mark.full
def test_motion_ends_when_a_particle_leaves_a_cylinder():
    """From rest near the top, where the cosine of the angle is 2/3 of that at the start."""
    contact = jl.GeneralizedForce(nothing, "none", reaction=True, contact="cylinder")
    system = jl.System(
        particle, ("x", "y"), forces=(contact,), constraints=(jl.Holonomic(cylinder, "cylinder"),)
    )
    start = np.array([sin(0.1), cos(0.1)])
    motion = jl.simulate(system, start, [0.0, 0.0], [0.0, 3.0], None, **TIGHT, throw=False)
    assert motion.status == Status.no_reaction_solution
    q, v = motion.last_state
    np.testing.assert_allclose(q[1], 2 / 3 * cos(0.1), rtol=1e-9)
    assert 0 <= system.multipliers(q, v)["cylinder"] < 1e-8 * M * G


# ---- A sledge on two runners: two rows that share the friction -----------------------------------

WIDE, HIGH, INERTIA = 0.5, 0.3, 0.4


def sledge(t, q, v, params):
    return 0.5 * (M * (v[0] ** 2 + v[1] ** 2) + INERTIA * v[2] ** 2) - M * G * q[1]


def runners(t, q, params):
    """Heights of the rear and the front runner."""
    return q[1] - HIGH * jnp.cos(q[2]) + jnp.array([-WIDE, WIDE]) * jnp.sin(q[2])


def rubbing(t, q, v, params, lam):
    F = params * (lam["rear"] + lam["front"])
    return jnp.stack([-F, jnp.zeros_like(F), -HIGH * F])


def sledge_with(rows, names):
    force = jl.GeneralizedForce(rubbing, "rubbing", reaction=True, contact="rear")
    return jl.System(
        sledge, ("x", "y", "theta"), forces=(force,), constraints=(jl.Holonomic(rows, names),)
    )


SLEDGE = sledge_with(runners, ("rear", "front"))
REST = np.array([0.0, HIGH, 0.0])


@pytest.mark.full
@pytest.mark.parametrize("mu", [0.2, 1.2])
def test_two_runners_share_the_friction(mu):
    """N_front - N_rear = mu m g h / w about the center; beyond mu = w/h it tips over."""
    v = np.array([3.0, 0.0, 0.0])
    np.testing.assert_allclose(SLEDGE.acceleration(REST, v, mu), [-mu * G, 0, 0], atol=1e-13)
    lam = SLEDGE.multipliers(REST, v, mu)
    half, more = 0.5 * M * G, 0.5 * mu * M * G * HIGH / WIDE
    np.testing.assert_allclose([lam["rear"], lam["front"]], [half - more, half + more], rtol=1e-13)
    ts = np.array([0.0, 0.1, 0.2])
    motion = jl.simulate(SLEDGE, REST, v, ts, mu, **TIGHT)
    np.testing.assert_allclose(motion.q[:, 0], 3.0 * ts - 0.5 * mu * G * ts**2, rtol=1e-12)


@pytest.mark.full
def test_motion_ends_when_a_sledge_tips_over():
    with pytest.raises(jl.SimulationError, match=r"(?s)rear.*contact lifts off"):
        jl.simulate(SLEDGE, REST, [3.0, 0.0, 0.0], [0.0, 0.1], 1.05 * WIDE / HIGH)


# ---- No solution ---------------------------------------------------------------------------------


@pytest.mark.full
def test_painleve_paradox_has_no_reaction_solution():
    """A stick pushed ahead by its lower end: no solution for mu >= (1/3 + cos^2)/(sin cos)."""
    entry = falling_stick_friction.entry
    params = dict(entry.example.params)
    theta = np.arctan(2.0)  # the minimum, 4/3
    q0 = [0.0, 0.5 * params["L"] * sin(theta), theta]
    for mu in (1.33, 1.34):
        v0, ts = [-1.0, 0.0, 0.0], [0.0, 1e-4]
        motion = jl.simulate(entry.system, q0, v0, ts, params | {"mu": mu}, throw=False)
        assert (motion.status == Status.no_reaction_solution) == (mu > 4 / 3)
        a = entry.system.acceleration(q0, v0, params | {"mu": mu})
        assert np.all(np.isfinite(a)) == (mu < 4 / 3)


# ---- Dependent rows -----------------------------------------------------------------------------


def doubled(t, q, params):
    return 2.0 * plane(t, q, params)


def rate(t, q, v, params):
    return cos(SLOPE) * v[1] - sin(SLOPE) * v[0]


def sliding_on(rows, read, lowering="auto"):
    """The block on these contacts, with friction on those in `read`."""

    def drag(t, q, v, params, lam):
        tangent = jnp.array([cos(SLOPE), sin(SLOPE)])
        normal_force = sum(share * lam[name] for name, share in read.items())
        return -params * normal_force * jnp.sign(uphill(t, q, v, params)) * tangent

    force = jl.GeneralizedForce(drag, "drag", reaction=True)
    return jl.System(particle, ("x", "y"), forces=(force,), constraints=rows, lowering=lowering)


PLANE = jl.Holonomic(plane, "plane")
AGAIN = jl.Holonomic(plane, "again")
RATE = jl.Pfaffian(rate, "rate")
TWICE = jl.Holonomic(doubled, "twice")
CONTACTS = {
    "first": ((PLANE, AGAIN), {"plane": 1.0}, {"plane": 1.0, "again": 0.0}),
    "second": ((AGAIN, PLANE), {"plane": 1.0}, {"plane": 1.0, "again": 0.0}),
    "both": ((PLANE, AGAIN), {"plane": 1.0, "again": 1.0}, {"plane": 0.5, "again": 0.5}),
    "doubled": ((PLANE, TWICE), {"twice": 2.0}, {"plane": 0.0, "twice": 0.5}),
    "with doubled": (
        (PLANE, TWICE),
        {"plane": 1.0, "twice": 2.0},
        {"plane": 0.5, "twice": 0.25},
    ),
    "rate": ((PLANE, RATE), {"rate": 1.0}, {"plane": 0.0, "rate": 1.0}),
    "three": (
        (PLANE, AGAIN, RATE),
        {"again": 1.0, "rate": 1.0},
        {"plane": 0.0, "again": 0.5, "rate": 0.5},
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("lowering", mostly_full(["scalar", "array"], "scalar"))
@pytest.mark.parametrize("kind", mostly_full(list(CONTACTS), "both", "rate"))
def test_contact_declared_twice_has_friction_once(kind, lowering):
    """Whichever row friction reads: it reads the reported multipliers; work is consistent."""
    rows, read, shares = CONTACTS[kind]
    system = sliding_on(rows, read, lowering)
    ts, tangent = np.linspace(0.0, 0.9 * STOP, 3), np.array([cos(SLOPE), sin(SLOPE)])
    start = [0.0, 0.0], SPEED * tangent
    normal, deceleration = M * G * cos(SLOPE), G * (sin(SLOPE) + MU * cos(SLOPE))
    motion = jl.simulate(system, *start, ts, MU, save=("work",), **TIGHT)
    distance = SPEED * ts - 0.5 * deceleration * ts**2
    np.testing.assert_allclose(motion.q, np.outer(distance, tangent), atol=1e-12)
    for name, share in shares.items():
        np.testing.assert_allclose(motion.lam[name], share * normal, rtol=1e-12, atol=1e-12)
    done = sum(motion.work.values())[-1]
    np.testing.assert_allclose(motion.energy[-1] - motion.energy[0], done, rtol=1e-12)
    a = system.acceleration(*start, MU)
    np.testing.assert_allclose(a, -deceleration * tangent, rtol=1e-12)
    force = system.generalized_force(*start, MU)
    np.testing.assert_allclose(force, -MU * normal * tangent, rtol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("lowering", ["scalar", "array"])
def test_derivatives_of_a_contact_declared_twice_are_those_of_one(lowering):
    """d distance/d mu, as of one contact."""
    system = sliding_on(*CONTACTS["both"][:2], lowering)
    ts, tangent = np.array([0.0, 0.5 * STOP]), np.array([cos(SLOPE), sin(SLOPE)])

    def height(mu):
        return jl.simulate(system, [0.0, 0.0], SPEED * tangent, ts, mu, **TIGHT, throw=False).q[
            -1, 1
        ]

    expected = -0.5 * G * cos(SLOPE) * ts[-1] ** 2 * sin(SLOPE)
    np.testing.assert_allclose(jax.grad(height)(MU), expected, rtol=1e-11)
    np.testing.assert_allclose(jax.jacfwd(height)(MU), expected, rtol=1e-11)


def turned(t, q, params):
    """A contact, and a row that psi removes: sin(psi) is 0, or its rounding at pi."""
    return jnp.stack([q[1], jnp.sin(q[2]) * (q[1] + 0.5 * q[0])])


def turned_drag(t, q, v, params, lam):
    return jnp.stack([-0.1 * jnp.sum(lam["c"]), 0.0 * q[1], 0.0 * q[2]])


@pytest.mark.full
@pytest.mark.parametrize(
    ("lowering", "psi"),
    mostly_full(
        [("scalar", np.pi), ("scalar", 0.0), ("array", np.pi), ("array", 0.0)], ("scalar", np.pi)
    ),
)
def test_row_of_rounding_has_no_share(lowering, psi):
    """Deceleration 0.1 g, and the derivative of the distance by the start."""
    lock = jl.Holonomic(lambda t, q, params: q[2] - params, "lock")
    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v - G * q[1],
        ("x", "y", "psi"),
        forces=(jl.GeneralizedForce(turned_drag, "drag", reaction=True),),
        constraints=(jl.Holonomic(turned, "c"), lock),
        lowering=lowering,
    )

    @jax.jit
    def distance(x):
        q = jnp.stack([x, 0.0, psi])
        start = q, jnp.array([1.0, 0.0, 0.0])
        return jl.simulate(
            system, *start, jnp.array([0.0, 0.5]), psi, dt=0.1, method="tsit5", throw=False
        ).q[-1, 0]

    value, slope = jax.value_and_grad(distance)(0.0)
    np.testing.assert_allclose(value, 0.5 - 0.5 * 0.1 * G * 0.25, rtol=1e-12)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-12)
    a = system.acceleration([0.0, 0.0, psi], [1.0, 0.0, 0.0], psi)
    np.testing.assert_allclose(a, [-0.1 * G, 0.0, 0.0], atol=1e-12)


def test_baumgarte_with_replaced_rows_is_refused():
    """A Pfaffian row that a force reads would replace the damped holonomic row: refused."""
    system = sliding_on((PLANE, RATE), {"rate": 1.0})
    with pytest.raises(
        ValueError, match=r"^`stabilization` must be 'projection' .* and a force reads 'rate'"
    ):
        jl.simulate(
            system, [0.0] * 2, [1.0, 0.0], [0.0, 1.0], MU, stabilization=jl.Baumgarte(5.0, 5.0)
        )


def test_contacts_are_independent_only_by_known_values():
    """Independent rows are known only from values; for traced values multipliers may be shared."""
    independent = sliding_on(
        (PLANE, jl.Holonomic(lambda t, q, p: q[0], "wall")), {"plane": 1, "wall": 1}
    )
    same = sliding_on((PLANE, AGAIN), {"plane": 1.0, "again": 1.0})
    given = MU, jnp.array(0.0), jnp.zeros(2), jnp.zeros(2), {}
    assert contact_rows_independent(independent, *given)
    assert not contact_rows_independent(same, *given)
    found = []
    jax.jit(
        lambda q: found.append(contact_rows_independent(independent, MU, 0.0, q, None, {})) or q
    )(jnp.zeros(2))
    assert found == [False]


def table(t, q, v, params):
    """A table of mass 1 that slides upright; q: x, y, z of its mass center, roll, pitch."""
    return 0.5 * (v @ v) - G * q[2]


FEET = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def feet(t, q, params):
    """Heights of the feet, for small angles; params: (friction, position of the mass center)."""
    arms = FEET - params[1]
    return q[2] + arms[:, 1] * q[3] - arms[:, 0] * q[4]


def feet_drag(t, q, v, params, lam):
    return jnp.zeros(5).at[0].set(-params[0] * jnp.sum(lam["feet"]) * jnp.sign(v[0]))


@pytest.mark.full
@pytest.mark.parametrize("lowering", ["scalar", "array"])
def test_four_feet_share_the_load_by_least_norm(lowering):
    """With three of them alone one might pull; with least norm all four push."""
    force = jl.GeneralizedForce(feet_drag, "drag", reaction=True, contact="feet")
    system = jl.System(
        table,
        ("x", "y", "z", "roll", "pitch"),
        forces=(force,),
        constraints=(jl.Holonomic(feet, "feet"),),
        lowering=lowering,
    )
    params = 0.3, np.array([0.2, -0.1])
    motion = jl.simulate(
        system, np.zeros(5), [2.0, 0, 0, 0, 0], [0.0, 0.5], params, dt=0.05, method="tsit5"
    )
    np.testing.assert_allclose(motion["x"][-1], 1.0 - 0.5 * 0.3 * G * 0.25, rtol=1e-13)
    balance = np.vstack([np.ones(4), (FEET - params[1]).T])
    sizes = np.sqrt(1.0 + np.sum((FEET - params[1]) ** 2, axis=1))
    expected = np.linalg.pinv(balance / sizes) @ [G, 0.0, 0.0] / sizes
    np.testing.assert_allclose(motion.lam["feet"][-1], expected, rtol=1e-12)


# ---- The solve -----------------------------------------------------------------------------------


def test_forces_that_are_not_affine_use_the_array_program():
    """mu |lam|: the same motion, by Newton's method."""

    def drag_of_size(t, q, v, params, lam):
        return drag(t, q, v, params, {"plane": jnp.abs(lam["plane"])})

    force = jl.GeneralizedForce(drag_of_size, "drag", reaction=True)
    system = jl.System(
        particle, ("x", "y"), forces=(force,), constraints=BLOCK.constraints, lowering="scalar"
    )
    v = SPEED * np.array([cos(SLOPE), sin(SLOPE)])
    a = system.acceleration([0.0, 0.0], v, MU)
    expected = -G * (sin(SLOPE) + MU * cos(SLOPE))
    np.testing.assert_allclose(a, expected * v / SPEED, rtol=1e-13)
    assert "not affine in multipliers" in str(system.explain(MU))


@pytest.mark.full
def test_uncoupled_contacts_are_checked_separately():
    """Two uncoupled sticks, each without solution: the determinant of both is positive."""
    one = falling_stick_friction.entry.system

    def both(t, q, v, params):
        return one.lagrangian(t, q[:3], v[:3], params) + one.lagrangian(t, q[3:], v[3:], params)

    def contact(part):
        return lambda t, q, params: q[part][1] - 0.5 * params["L"] * jnp.sin(q[part][2])

    def friction(part, name):
        def push(t, q, v, params, lam):
            F = params["mu"] * lam[name]
            mine = jnp.stack([F, 0.0 * F, 0.5 * params["L"] * jnp.sin(q[part][2]) * F])
            return jnp.zeros_like(q).at[part].set(mine)

        return jl.GeneralizedForce(push, f"friction of {name}", reaction=True)

    parts = {"left": slice(0, 3), "right": slice(3, 6)}
    system = jl.System(
        both,
        tuple(f"{name}{i}" for name in parts for i in range(3)),
        forces=tuple(friction(part, name) for name, part in parts.items()),
        constraints=tuple(jl.Holonomic(contact(part), name) for name, part in parts.items()),
    )
    params, theta = dict(falling_stick_friction.entry.example.params), np.arctan(2.0)
    q, v = [0.0, 0.5 * params["L"] * sin(theta), theta] * 2, [-1.0, 0.0, 0.0] * 2
    for mu in (1.3, 2.0):
        a = system.acceleration(q, v, params | {"mu": mu})
        assert np.all(np.isfinite(a)) == (mu < 4 / 3)
