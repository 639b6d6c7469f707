"""Singular or indefinite mass matrices in directions without forces, by all kinds of methods."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def pair(t, q, v, params):
    """Inertia of b' + c' only, and no force along either."""
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2 + 0.5 * params["m"] * (v[1] + v[2]) ** 2


def idle(t, q, v, params):
    """A coordinate that does not occur."""
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2


def negative(t, q, v, params):
    return 0.5 * params["m"] * v[0] ** 2 - 0.5 * q[0] ** 2 + 0.5 * v[1] ** 2 - 0.5 * q[1] ** 2


def turning(t, q, v, params):
    """Inertia that is negative for q > 1."""
    return 0.5 * (1 - q[0]) * v[0] ** 2 + q[0]


CASES = {
    "pair": (pair, 1.0, [1.0, 0.0, 0.0], [0.0, 0.3, 0.1], "c"),
    "idle": (idle, 1.0, [1.0, 0.0], [0.0, 0.3], "b"),
    "negative": (negative, -1.0, [1.0, 0.2], [0.0, 0.3], "a"),
    "zero": (negative, 0.0, [1.0, 0.2], [0.0, 0.3], "a"),
}
METHODS = [
    ("auto", {}),
    ("kvaerno5", {}),
    ("gauss4", {"dt": 0.01}),
    ("variational2", {"dt": 0.01}),
    ("splitting2", {"dt": 0.01}),
]


def case(name, lowering):
    lagrangian, m, q, v, where = CASES[name]
    system = jl.System(lagrangian, tuple("abc"[: len(q)]), lowering=lowering)
    return system, {"m": m}, np.array(q), np.array(v), where


@pytest.mark.parametrize("lowering", ["auto", "array"])
@pytest.mark.parametrize("name", CASES)
def test_singular_mass_gives_nan_accelerations(name, lowering):
    system, params, q, v, _ = case(name, lowering)
    assert np.all(np.isnan(system.acceleration(q, v, params)))


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "method", "options", "lowering"),
    [
        pytest.param(
            name,
            method,
            options,
            lowering,
            marks=[]
            if lowering == "auto" and (name, method) in {("pair", "auto"), ("negative", "gauss4")}
            else pytest.mark.full,
        )
        for name in CASES
        for method, options in METHODS
        for lowering in ("auto", "array")
    ],
)
def test_singular_mass_ends_motions_and_names_the_coordinate(name, method, options, lowering):
    system, params, q, v, where = case(name, lowering)
    motion = jl.simulate(system, q, v, [0.0, 0.5], params, method=method, throw=False, **options)
    assert motion.status == jl.Status.mass_singular
    assert system.coordinates.labels[int(motion.where)] == where
    assert "give this coordinate inertia" in motion.message()


@pytest.mark.full
@pytest.mark.parametrize(("method", "options"), METHODS[:4])
def test_motion_ends_when_inertia_vanishes(method, options):
    system = jl.System(turning, ("a",))
    motion = jl.simulate(
        system, [0.0], [1.0], [0.0, 2.0], {}, method=method, throw=False, **options
    )
    # The speed is unbounded: implicit equations of a step across have no solution.
    ends = jl.Status.mass_singular, jl.Status.step_below_resolution, jl.Status.implicit_solve_failed
    assert motion.status in ends
    assert float(motion.last_time) < 2.0
    assert float(motion.last_state[0][0]) < 1.0 + 1e-9


def test_regular_mass_needs_no_check_per_evaluation():
    """A positive constant inertia is not tested, one of params is tested once per solve."""
    for lagrangian, lines in (
        (lambda t, q, v, p: 0.5 * (v @ v), 0),
        (lambda t, q, v, p: 0.5 * p["m"] * (v @ v), 0),
    ):
        system, q = jl.System(lagrangian, ("x", "y")), jnp.zeros(2)
        equations = system._program.lowered(q, {"m": jnp.ones(())}, {}).equations
        assert equations.program.operations == lines
        np.testing.assert_array_equal(system.acceleration([0.0, 0.0], [1.0, 2.0], {"m": 2.0}), 0)
