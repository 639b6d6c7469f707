"""method="auto" by tolerance, structure and stiffness, and how a solution reports it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._simulation._methods import METHODS, choose, name_of
from systems.catalogue import ENTRIES

TS = np.linspace(0.0, 1.0, 3)
FIXED = [
    name for name, make in METHODS.items() if not isinstance(make(), diffrax.AbstractAdaptiveSolver)
]
HEAVY = 1e5


def duffing(t, q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2 - 0.25 * q[0] ** 4


def warped(t, q, v, params):
    return 0.5 * (1 + q[0] ** 2) * v[0] ** 2 - 0.5 * q[0] ** 2


def two(t, q, v, params):
    return 0.5 * (v @ v) - 0.5 * q[0] ** 2 - 0.5 * params["k"] * q[1] ** 2


def oil(t, q, v, params, inputs):
    return jnp.stack([0.0 * v[0], -params["c"] * v[1]])


PLAIN, WARPED = jl.System(duffing, ("x",)), jl.System(warped, ("x",))
OILED = jl.System(two, ("slow", "fast"), forces=(jl.GeneralizedForce(oil, name="oil"),))


@pytest.mark.parametrize(
    ("rtol", "atol", "name"),
    [
        (None, None, "dopri8"),
        (1e-3, 1e-8, "tsit5"),
        (1e-3, 1e-3, "tsit5"),
        (1e-4, 1e-4, "dopri8"),
        (9e-5, 1e-5, "dopri8"),
        (1e-11, 2e-12, "dopri8"),
        (1e-12, 1e-12, "prince9"),
        (1e-13, 0.0, "prince9"),
        (1e-12, 1e-4, "prince9"),  # atol has the unit of the coordinates
        (0.0, 1e-3, "tsit5"),
    ],
)
def test_auto_chooses_the_method_by_relative_tolerance(rtol, atol, name):
    motion = jl.simulate(WARPED, [1.0], [0.0], TS, {}, rtol=rtol, atol=atol)
    assert motion.method == name
    assert motion.tolerances is not None
    given = [1e-9 if x is None else x for x in (rtol, atol)]
    np.testing.assert_array_equal(motion.tolerances, given)


def test_traced_tolerance_does_not_affect_the_method():
    def solve(tol):
        return jl.simulate(PLAIN, [1.0], [0.0], TS, {}, rtol=tol, atol=tol)

    assert jax.jit(solve)(1e-3).method == "dopri8"


@pytest.mark.full
@pytest.mark.parametrize(
    ("system", "options", "name"),
    [
        (PLAIN, {}, "splitting8"),
        (PLAIN, {"save": ("work",)}, "dopri8"),  # splitting8 integrates work with order 4 only
        (WARPED, {}, "dopri8"),
        (PLAIN, {"method": "dopri8"}, "dopri8"),
        (PLAIN, {"method": diffrax.Dopri8()}, "dopri8"),
        (PLAIN, {"method": diffrax.Midpoint()}, "midpoint"),
        (PLAIN, {"method": diffrax.LeapfrogMidpoint()}, "LeapfrogMidpoint"),
        (PLAIN, {"method": diffrax.Kvaerno5()}, "Kvaerno5"),  # solves its equations its own way
    ],
)
def test_auto_chooses_fixed_step_methods_by_structure(system, options, name):
    motion = jl.simulate(system, [1.0], [0.0], TS, {}, dt=0.01, **options)
    assert motion.method == name
    assert motion.tolerances is None


def test_fixed_steps_with_forces_are_not_split():
    motion = jl.simulate(OILED, [1.0, 0.0], [0.0, 0.0], TS, {"k": 1.0, "c": 0.1}, dt=0.01)
    assert motion.method == "dopri8"


def test_motions_by_different_methods_have_equal_structure():
    motions = [jl.simulate(PLAIN, [1.0], [0.0], TS, {}, rtol=x, atol=x) for x in (1e-3, 1e-12)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *motions)
    assert both.q.shape == (2, 3, 1)
    assert [m.method for m in motions] == ["tsit5", "nystrom12"]
    with pytest.raises(ValueError, match=r"^`method` inside jit or vmap is not supported"):
        jax.jit(lambda q: jl.simulate(PLAIN, q, [0.0], TS, {}).method)(jnp.ones(1))


@pytest.mark.full
def test_tolerances_in_large_units_choose_a_high_order():
    """An orbit in meters for a day, to 0.1 mm, by a method of high order."""

    def earth(t, q, v, params):
        return 0.5 * (v @ v) + 3.986004418e14 / jnp.sqrt(q @ q)

    r, speed = 7e6, np.sqrt(3.986004418e14 / 7e6)
    orbit = jl.System(earth, ("x", "y"))
    motion = jl.simulate(orbit, [r, 0.0], [0.0, speed], [0.0, 86400.0], {}, rtol=1e-12, atol=1e-4)
    assert motion.method == "nystrom12"
    assert int(motion.stats["accepted"]) < 1000  # order 5 would need more than 3000
    turned = speed / r * 86400.0
    # 15 revolutions with tolerances of 1e-4 m and 1e-4 m/s a step; phase errors grow with time.
    expected = r * np.array([np.cos(turned), np.sin(turned)])
    np.testing.assert_allclose(motion.q[-1], expected, atol=10.0)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_its_name(name):
    assert name_of(choose(name, name not in FIXED, 1e-6, 1e-6)[0]) == name


def run_out(**options):
    """The fast coordinate decays within 1e-5 s, then slowly: 30 s need 5e5 explicit steps."""
    return jl.simulate(
        OILED,
        [1.0, 0.1],
        [0.0, 0.0],
        np.linspace(0.0, 30.0, 4),
        {"k": 1e4, "c": HEAVY},
        rtol=1e-6,
        atol=1e-6,
        throw=False,
        max_steps=2000,
        **options,
    )


@pytest.mark.full
def test_auto_uses_implicit_steps_if_explicit_ones_run_out():
    motion = run_out()
    assert motion.status == jl.Status.ok
    assert motion.method == "kvaerno5"
    t, c = motion.ts, HEAVY
    rates = np.roots([1.0, c, 1e4])
    slow = 0.1 * (rates[0] * np.exp(rates[1] * t) - rates[1] * np.exp(rates[0] * t))
    slow = slow / (rates[0] - rates[1])
    # Errors of 100 steps with a local bound of 1e-6.
    np.testing.assert_allclose(motion["slow"], np.cos(t), atol=1e-4)
    np.testing.assert_allclose(motion["fast"], slow, atol=1e-6)

    explicit = run_out(method="dopri8")
    assert explicit.status == jl.Status.max_steps
    text = explicit.explain()
    assert "It is stiff" in text
    assert "method='kvaerno5'" in text
    assert "steps at this rate" in text
    assert jax.jit(lambda: run_out())().status == jl.Status.max_steps


@pytest.mark.full
def test_auto_does_not_use_implicit_steps_for_oscillations():
    motion = jl.simulate(
        OILED,
        [1.0, 0.1],
        [0.0, 0.0],
        [0.0, 30.0],
        {"k": 1e10, "c": 0.0},
        throw=False,
        max_steps=500,
    )
    assert motion.status == jl.Status.max_steps
    assert motion.method == "dopri8"
    assert "replace the stiff part with a constraint" in motion.explain()


def elastic(t, q, v, params):
    r = jnp.sqrt(q @ q)
    return 0.5 * (v @ v) - 9.81 * q[1] - 0.5 * params["k"] * (r - 1.0) ** 2


def test_implicit_steps_are_as_long_as_accuracy_allows():
    """Measured 299 and 27 steps; with the chord iteration of diffrax's default 5659 and 7900."""
    motion = jl.simulate(
        jl.System(elastic, ("x", "y")),
        [np.sin(1.0), -np.cos(1.0) - 1e-5],
        [0.0, 0.0],
        [0.0, 1.0],
        {"k": 1e6},
        method="kvaerno5",
        rtol=1e-6,
        atol=1e-6,
    )
    assert int(motion.stats["accepted"]) < 600
    assert int(motion.stats["rejected"]) < 0.2 * int(motion.stats["accepted"])


@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    [
        "double_pendulum_cartesian",  # projected
        "knife_edge_vehicle",  # rolling
        "chaplygin_sleigh",  # quasi-velocities
        "rigid_aircraft",
        "falling_stick_friction",
        "sleeve_pendulum",
    ],
)
def test_implicit_methods_solve_every_kind_of_system(name):
    entry = ENTRIES[name]
    example, ts = entry.example, [0.0, min(entry.example.duration, 1.0)]
    params = dict(example.params)
    q0, v0 = example.q0, example.v0
    if example.hold is not None:
        start = jl.assemble(entry.system, q0, v0, params=params, hold=example.hold)
        q0, v0 = start.q, start.v
    found = jl.simulate(entry.system, q0, v0, ts, params, method="kvaerno5", rtol=1e-7, atol=1e-7)
    explicit = jl.simulate(entry.system, q0, v0, ts, params)
    assert int(found.stats["accepted"]) < 200
    for a, b in ((found.q, explicit.q), (found.v, explicit.v)):
        # Global errors of some tens of steps with a local bound of 1e-7: measured up to 4e-6.
        np.testing.assert_allclose(a[-1], b[-1], rtol=2e-5, atol=2e-5)


# ---- Tolerances of coordinates -------------------------------------------------------------------


@pytest.mark.full
def test_coordinates_may_have_separate_tolerances():
    """Of two uncoupled springs only the one with a tight tolerance limits the step."""

    def uncoupled(t, q, v, params):
        return 0.5 * v @ v - 0.5 * (q[0] ** 2 + 100.0 * q[1] ** 2)

    system = jl.System(uncoupled, ("slow", "quick"))

    def steps(atol, method="tsit5"):
        motion = jl.simulate(
            system, [1.0, 1e-3], [0.0, 0.0], [0.0, 5.0], rtol=0.0, atol=atol, method=method
        )
        assert float(jnp.abs(motion["slow"][-1] - jnp.cos(5.0))) < 1e-5
        return int(motion.stats["accepted"]), motion

    close, _ = steps(1e-9)
    same, _ = steps([1e-9, 1e-9])
    assert close == same
    loose, motion = steps({"slow": 1e-9, "quick": 1e-2})
    assert loose < 0.5 * close
    assert "atol 1e-09 to 0.01" in motion.explain()
    implicit, _ = steps([1e-7, 1.0], "kvaerno5")
    assert implicit < steps(1e-7, "kvaerno5")[0]
