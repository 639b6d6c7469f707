"""Motion under constraints: minimal coordinates, formulations, redundancy, dead points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.mechanisms import (
    BOBS,
    LED,
    NAMES,
    OMEGA,
    SKATE,
    SLIDER,
    THETA,
    bobs,
    double_pendulum,
    led_pendulum,
    led_start,
    minimal,
    rods,
    skate,
    slider_crank,
    slider_start,
    to_cartesian,
)

import jaxlag as jl

EPS = np.finfo(float).eps
TS = np.linspace(0.0, 1.5, 7)
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.fixture(scope="module")
def motion(lowering):
    """The double pendulum in Cartesian coordinates, to tight tolerances, by formulation."""
    found = {}

    def of(formulation="multipliers", **options):
        key = (formulation, *options.items())
        if key not in found:
            system, q0, v0, params = double_pendulum()
            found[key] = jl.simulate(
                system, q0, v0, TS, params, formulation=formulation, **TIGHT, **options
            )
        return found[key]

    return of


def largest_residuals(motion):
    position, velocity = jax.vmap(
        lambda t, q, v: motion.system.residuals(q, v, motion.params, t=t)
    )(motion.ts, motion.q, motion.v)
    largest = [jnp.max(jnp.abs(x)) for x in jax.tree.leaves((position, velocity))]
    return float(jnp.max(jnp.stack(largest)))


# ---- Independent solutions of one motion ---------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize("formulation", ["multipliers", "null_space"])
def test_motion_equals_that_in_minimal_coordinates(motion, formulation):
    """q, v, a and energy are mapped from the angles; tensions follow from their accelerations."""
    found = motion(formulation)
    angles = jl.simulate(minimal, THETA, OMEGA, TS, BOBS, **TIGHT)
    q, v = jax.vmap(to_cartesian)(angles.q, angles.v)
    np.testing.assert_allclose(found.q, q, atol=1e-10)
    np.testing.assert_allclose(found.v, v, atol=1e-9)

    def acceleration(q, v, a):
        return jax.jvp(lambda q, v: to_cartesian(q, v)[1], (q, v), (v, a))[1]

    a = jax.vmap(acceleration)(angles.q, angles.v, angles.a)
    np.testing.assert_allclose(found.a, a, atol=1e-9)
    np.testing.assert_allclose(found.energy, angles.energy[0], atol=1e-9)
    # The lower rod acts on its bob along itself: m2 (a2 - g) = 2 lam (r2 - r1).
    rod = found.q[:, 2:] - found.q[:, :2]
    force = BOBS["m2"] * (a[:, 2:] + jnp.array([0.0, 9.81]))
    np.testing.assert_allclose(2 * found.lam["rod2"][:, None] * rod, force, atol=1e-8)


@pytest.mark.full
def test_formulations_agree(motion):
    one, other = motion("multipliers"), motion("null_space")
    np.testing.assert_allclose(one.q, other.q, atol=1e-10)
    for name in ("rod1", "rod2"):
        np.testing.assert_allclose(one.lam[name], other.lam[name], atol=1e-8)


@pytest.mark.full
@pytest.mark.parametrize("formulation", ["multipliers", "null_space"])
def test_constraints_hold_at_every_save(motion, formulation):
    """To rounding."""
    assert largest_residuals(motion(formulation)) <= 1e-13


@pytest.mark.full
def test_constraints_hold_only_with_projection():
    """To rounding with projection; without it the drift is visible."""
    system, q0, v0, params = double_pendulum()
    loose = {"rtol": 1e-6, "atol": 1e-6, "method": "bosh3"}
    drifted = jl.simulate(system, q0, v0, TS, params, stabilization=None, **loose)
    assert largest_residuals(drifted) > 1e-8
    projected = jl.simulate(system, q0, v0, TS, params, **loose)
    assert largest_residuals(projected) <= 1e-13


@pytest.mark.full
def test_baumgarte_damps_initial_residuals():
    """(d/dt + 20/s)^2 phi = 0: an initial residual decays; without damping it stays."""
    system, q0, v0, params = double_pendulum()
    residuals = []
    for stabilization in (None, jl.Baumgarte(20.0, 20.0)):
        found = jl.simulate(
            system, q0 * (1 + 3e-9), v0, TS, params, stabilization=stabilization, **TIGHT
        )
        phi = rods(0.0, found.q[-1], params)
        residuals.append(float(jnp.max(jnp.abs(phi))))
    assert residuals[0] > 1e-9
    assert residuals[1] < 1e-11


def test_knife_edge_moves_on_a_circle():
    """Constant speed u along the edge and turning rate w: a circle of radius u / w; closed form."""
    u, w = 0.8, 1.3
    found = jl.simulate(skate, [0, 0, 0], [u, 0, w], np.linspace(0, 3, 7), SKATE, **TIGHT)
    t = found.ts
    radius = u / w
    expected = jnp.stack([radius * jnp.sin(w * t), radius * (1 - jnp.cos(w * t)), w * t], -1)
    np.testing.assert_allclose(found.q, expected, atol=1e-10)
    np.testing.assert_allclose(found.lam["edge"], SKATE["m"] * u * w, rtol=1e-9)
    assert largest_residuals(found) <= 1e-14


@pytest.mark.full
def test_work_of_a_moving_pin_is_the_change_of_energy():
    """Rheonomic rows: their work, -b . lam, is the change of energy."""
    q0, v0 = led_start()
    ts = np.linspace(0, 1.5, 5)
    found = jl.simulate(led_pendulum, q0, v0, ts, LED, save=("work",), **TIGHT)
    assert list(found.work) == ["pin"]
    np.testing.assert_allclose(found.energy - found.energy[0], found.work["pin"], atol=1e-9)
    assert np.ptp(found.energy) > 0.1
    # The same by hand: an angle about a pin with the acceleration X'' along x.
    J = LED["m"] + LED["I"]

    def lagrangian(t, q, v, params):
        rate = params["X"] * params["Omega"] * jnp.cos(params["Omega"] * t)
        T = 0.5 * params["I"] * v[0] ** 2
        T += 0.5 * params["m"] * ((rate + jnp.cos(q[0]) * v[0]) ** 2 + (jnp.sin(q[0]) * v[0]) ** 2)
        return T + params["m"] * 9.81 * jnp.cos(q[0])

    angle = jl.System(lagrangian, ("theta",))
    hand = jl.simulate(angle, q0[2:], v0[2:], ts, LED, **TIGHT)
    np.testing.assert_allclose(found["theta"], hand["theta"], atol=1e-10)
    assert J > 0


# ---- Dependent rows ------------------------------------------------------------------------------


def repeated(t, q, params):
    two = rods(t, q, params)
    return jnp.concatenate([two, 3.0 * two[:1], jnp.sum(two)[None]])


redundant = jl.System(bobs, NAMES, constraints=(jl.Holonomic(repeated, ("a", "b", "3a", "a+b")),))


@pytest.mark.full
def test_redundant_rows_change_nothing(motion):
    system, q0, v0, params = double_pendulum(redundant)
    alone = motion()
    found = jl.simulate(system, q0, v0, TS, params, **TIGHT)
    np.testing.assert_allclose(found.q, alone.q, atol=1e-9)
    np.testing.assert_allclose(found.a, alone.a, atol=1e-9)
    np.testing.assert_allclose(found.constraint_force, alone.constraint_force, atol=1e-9)


@pytest.mark.full
def test_derivatives_along_consistent_starts_agree():
    """fwd = rev = central differences in angles, with redundant rows and projection."""

    def end(x):
        params = {**BOBS, "l1": x["l1"], "m2": x["m2"]}
        q0, v0 = to_cartesian(x["theta"], x["omega"], params)
        options = {"dt": 0.05, "method": "heun", "change_points": "stop"}
        found = jl.simulate(redundant, q0, v0, [0.0, 0.3, 0.7], params, **options)
        return jnp.concatenate([found.q[-1], found.v[1]])

    x = {"theta": THETA, "omega": OMEGA, "l1": jnp.array(0.9), "m2": jnp.array(0.6)}
    dx = {"theta": jnp.array([0.7, -0.4]), "omega": jnp.array([0.2, 0.9])}
    dx |= {"l1": jnp.array(0.3), "m2": jnp.array(-0.5)}
    weights = jnp.arange(1.0, 9.0)

    @jax.jit
    def both(x, dx):
        _, dy = jax.jvp(end, (x,), (dx,))
        return dy, jax.vjp(end, x)[1](weights)[0]

    dy, back = both(x, dx)
    total = sum(jnp.sum(back[name] * dx[name]) for name in x)
    np.testing.assert_allclose(total, weights @ dy, rtol=1e-12)
    value, h = jax.jit(end), 1e-5
    ahead, behind = (value({k: x[k] + s * h * dx[k] for k in x}) for s in (1, -1))
    # h^2 and eps / h, times derivatives of order 1 to 10.
    np.testing.assert_allclose(dy, (ahead - behind) / (2 * h), atol=2e-8)


@pytest.mark.full
@pytest.mark.parametrize(
    ("rows", "row"),
    [
        (lambda t, q, params: jnp.append(rods(t, q, params), rods(t, q, params)[0] + 0.1), "c"),
        (lambda t, q, params: jnp.append(rods(t, q, params), rods(t, q, params)[0] + t), "c"),
        (lambda t, q, params: jnp.append(rods(t, q, params), rods(t, q, params)[0] + t**2), "c"),
    ],
    ids=["position", "velocity", "acceleration"],
)
def test_contradictory_rows_are_named(rows, row):
    system = jl.System(bobs, NAMES, constraints=(jl.Holonomic(rows, ("a", "b", "c")),))
    _, q0, v0, params = double_pendulum()
    with pytest.raises(jl.SimulationError, match="contradictory_rows") as caught:
        jl.simulate(system, q0, v0, TS, params, dt=0.1, method="tsit5")
    assert caught.value.motion.status == jl.Status.contradictory_rows
    labels = system._rows(params, jnp.dtype(float)).labels
    assert labels[int(caught.value.motion.where)] in ("a", row)


# ---- Starts --------------------------------------------------------------------------------------


@pytest.mark.full
def test_inconsistent_starts_are_refused_or_assembled():
    """Refused by name, or moved to the nearest consistent state."""
    system, q0, v0, params = double_pendulum()
    wrong = q0.at[3].add(0.05)
    ts, fixed = [0.0, 0.2], {"dt": 0.1, "method": "heun"}
    with pytest.raises(jl.SimulationError, match=r"inconsistent_start \('rod2'\).*assemble=True"):
        jl.simulate(system, wrong, v0, ts, params, **fixed)
    found = jl.simulate(system, wrong, v0, ts, params, assemble=True, **fixed)
    nearest = jl.assemble(system, wrong, v0, params)
    np.testing.assert_allclose(found.q[0], nearest.q, atol=1e-14)
    np.testing.assert_allclose(found.v[0], nearest.v, atol=1e-13)


@pytest.mark.full
def test_inconsistent_starts_in_a_batch_have_a_status():
    """Traced starts get a status."""
    system, q0, v0, params = double_pendulum()

    def status(q0, v0):
        ts = [0.0, 0.2]
        return jl.simulate(system, q0, v0, ts, params, dt=0.1, method="heun").status

    states = jnp.stack([q0, q0.at[3].add(0.05), q0]), jnp.stack([v0, v0, v0 + 0.1])
    inconsistent = int(jl.Status.inconsistent_start)
    assert jax.vmap(status)(*states).tolist() == [0, inconsistent, inconsistent]


@pytest.mark.full
def test_small_errors_of_a_start_are_projected_away():
    system, q0, v0, params = double_pendulum()
    found = jl.simulate(system, q0 + 1e-10, v0, TS, params, dt=0.1, method="tsit5")
    assert largest_residuals(found) <= 1e-13


# ---- Singular configurations ---------------------------------------------------------------------


@pytest.mark.full
def test_a_dead_point_is_passed():
    """r = l: rows lose rank at every quarter turn; the crank continues as in closed form."""
    equal = {**SLIDER, "r": 1.0}
    q0, v0 = slider_start(0.9, 3.0, equal)
    found = jl.simulate(slider_crank, q0, v0, np.linspace(0, 1, 9), equal, rtol=1e-9, atol=1e-9)

    # rod = -crank throughout, x = 2 cos(crank): one coordinate, no gravity.
    def lagrangian(t, q, v, p):
        inertia = p["J"] + p["Jr"] + p["m"] * (2 * jnp.sin(q[0])) ** 2
        return 0.5 * inertia * v[0] ** 2

    one = jl.simulate(jl.System(lagrangian, ("crank",)), [0.9], [3.0], found.ts, equal, **TIGHT)
    assert float(found["crank"].max()) > np.pi / 2 + 1
    np.testing.assert_allclose(found["crank"], one["crank"], atol=1e-6)
    np.testing.assert_allclose(found["rod"], -one["crank"], atol=1e-6)


@pytest.mark.full
def test_start_at_a_dead_point_follows_a_branch():
    """One row vanishes there: a branch is followed; between branches a failure is reported.

    With crank = pi/2 + a, rod = -pi/2 + b the row y is cos(a) - cos(b): a = b or a = -b.
    """
    equal = {**SLIDER, "r": 1.0}
    q0 = jnp.array([np.pi / 2, -np.pi / 2, 0.0])

    def run(rates):
        v0 = jnp.array([*rates, rates[1] - rates[0]])
        options = {"throw": False, "rtol": 1e-9, "atol": 1e-9}
        return jl.simulate(slider_crank, q0, v0, [0.0, 0.5, 1.0], equal, **options)

    folded = run((1.0, 1.0))
    assert folded.status == jl.Status.ok
    np.testing.assert_allclose(
        folded.q, q0 + folded.ts[:, None] * jnp.array([1.0, 1, 0]), atol=1e-8
    )
    between = run((1.0, 0.3))
    assert between.status in (jl.Status.rank_change, jl.Status.contradictory_rows)
    assert between.last_time < 0.01
    assert "('y')" in between.message()


@pytest.mark.full
def test_dead_points_are_passed_at_high_speed():
    """At high speed, with the null-space formulation."""
    equal = {**SLIDER, "r": 1.0}
    q0, v0 = slider_start(0.5, 10.0, equal)
    options = {"throw": False, "rtol": 1e-9, "atol": 1e-9}
    found = jl.simulate(
        slider_crank, q0, v0, np.linspace(0, 3, 31), equal, formulation="null_space", **options
    )
    assert found.status == jl.Status.ok


# ---- Massless links ------------------------------------------------------------------------------


def bob(t, q, v, params):
    """A bob on a link that may be massless."""
    T = 0.5 * params["m"] * (v[0] ** 2 + v[1] ** 2) + 0.5 * params["I"] * v[2] ** 2
    return T - params["m"] * 9.81 * q[1]


def pin(t, q, params):
    return jnp.stack([q[0] - jnp.sin(q[2]), q[1] + jnp.cos(q[2])])


@pytest.mark.full
@pytest.mark.parametrize("formulation", ["multipliers", "null_space"])
def test_massless_links_are_solved(formulation):
    """M is singular; with params traced or not, also if L does not contain the rate at all."""
    ts = [0.0, 1.0]
    pendulum = jl.System(
        lambda t, q, v, p: p["m"] * (0.5 * v[0] ** 2 + 9.81 * jnp.cos(q[0])), ("theta",)
    )
    params = {"m": 2.0, "I": 0.0}
    expected = jl.simulate(pendulum, [1.0], [0.0], ts, params, **TIGHT).q[-1, 0]
    heavy = jl.System(bob, ("x", "y", "theta"), constraints=(jl.Holonomic(pin, "pin"),))
    light = jl.System(
        lambda t, q, v, p: bob(t, q, v * jnp.array([1.0, 1.0, 0.0]), p),
        ("x", "y", "theta"),
        constraints=(jl.Holonomic(pin, "pin"),),
    )
    q0, v0 = [np.sin(1.0), -np.cos(1.0), 1.0], [0.0, 0.0, 0.0]

    def angle(system, params, **options):
        options = {"formulation": formulation, "change_points": "stop", **TIGHT, **options}
        return jl.simulate(system, q0, v0, ts, params, **options).q[-1, 2]

    for system in (heavy, light):
        np.testing.assert_allclose(angle(system, params), expected, atol=1e-10)
    traced = jax.jit(angle, static_argnums=0)(heavy, params)
    np.testing.assert_allclose(traced, expected, atol=1e-10)

    @jax.jit
    def swings(inertias):
        """Final angles for several inertias of the link, and their derivatives."""
        of = lambda inertia: angle(heavy, {"m": 2.0, "I": inertia}, method="tsit5")  # noqa: E731
        return jax.vmap(jax.value_and_grad(of))(inertias)

    values, slopes = swings(jnp.array([0.0, 1e-4, 0.1]))
    np.testing.assert_allclose(values[0], expected, atol=1e-10)
    np.testing.assert_allclose(slopes[0], (values[1] - values[0]) / 1e-4, rtol=1e-3)
    alone = swings(jnp.array([0.1, 0.1, 0.1]))  # M is definite in all of them
    np.testing.assert_allclose(alone[0], values[2], atol=1e-10)
    np.testing.assert_allclose(alone[1], slopes[2], atol=1e-8)


# ---- Batches -------------------------------------------------------------------------------------


@pytest.mark.full
def test_batches_equal_single_runs(motion):
    """21 starts in lanes."""
    system, _, _, params = double_pendulum()
    omegas = OMEGA + jnp.linspace(0, 1, 21)[:, None]

    def run(omega):
        q0, v0 = to_cartesian(THETA, omega)
        return jl.simulate(system, q0, v0, [0.0, 0.5, 1.0], params)

    batch = jax.vmap(run)(omegas)
    assert (np.asarray(batch.status) == 0).all()
    for k in (0, 20):
        one = run(omegas[k])
        np.testing.assert_allclose(batch.q[k], one.q, atol=1e-11)
    assert largest_residuals(run(omegas[0])) <= 1e-13
