"""Forms of the equations in quasi-velocities: rigid bodies by d'Alembert's principle."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._lowering import ArrayProgram, ScalarProgram, State, _term_codes
from jaxlag._lowering._emit import _emit
from jaxlag._lowering._symbolic import _derive_quasi

NAMES = ("ahead", "aside", "turning", "rolling", "swinging")
PARAMS = {"m": 1.7, "l": 0.6, "w": 0.4}


def frame(t, q, p):
    """A sledge that turns and leans."""
    R = jl.rotation.about_z(q[2]) @ jl.rotation.about_x(q[3])
    return R, jnp.stack([q[0], q[1], 0.0 * q[0]])


def arm(t, q, p):
    """Hinged on it."""
    R, r = frame(t, q, p)
    return R @ jl.rotation.about_y(q[4]), r + R @ jnp.array([0.3, 0.0, 0.8])


BODIES = (
    (frame, jl.energy.RigidBody(2.0, [0.9, 0.9, 0.4], [0.1, 0.0, 0.4])),
    (arm, jl.energy.RigidBody(0.7, [0.4, 0.42, 0.1], [0.0, 0.0, -0.5])),
)


def lagrangian(t, q, v, p):
    g = jnp.array([0.0, 0.0, -9.81])
    T = sum(body.kinetic(pose, t, q, v, p) for pose, body in BODIES)
    return p["m"] * T - sum(body.gravity(pose, t, q, p, g) for pose, body in BODIES)


def speeds(t, q, v, p):
    """Of the blade; with an affine part, and a rate that depends on time."""
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    ahead, aside = c * v[0] + s * v[1], -s * v[0] + c * v[1] + 0.2 * jnp.sin(t) * v[3]
    return jnp.stack([ahead, aside + p["w"] * q[3] * t, v[2] + 0.3 * q[4] * v[3], v[3], v[4]])


def sledge():
    """With a Lagrangian of its own, so that no program exists."""

    def fresh(t, q, v, p):
        return lagrangian(t, q, v, p)

    quasi = jl.QuasiVelocities(speeds, NAMES, ("aside",))
    return jl.System(fresh, ("x", "y", "heading", "lean", "swing"), quasi=quasi)


STATE = jnp.array([0.3, -0.2, 0.7, 0.2, -0.5]), jnp.array([0.8, 0.4, -0.3, 0.6])


def lowered(system, limit=None):
    array = replace(system._terms, quasi=system.quasi, in_u=system._in_u)
    program = ScalarProgram(array, limit)
    return array, program, program.lowered(STATE[0], PARAMS, {})


@pytest.mark.full
def test_projection_of_dalembert_is_that_of_arrays(monkeypatch):
    """v and u', where no other form exists. U depends on time and has an affine part."""
    monkeypatch.setattr(_derive_quasi, "_written", lambda *_: [])
    array, program, found = lowered(sledge())
    assert found.equations is not None
    assert found.equations.form == "projected, d'Alembert's principle"
    state = State(jnp.array(0.4), *STATE, PARAMS, {})
    rates = [
        x.quasi_rates(state, x.precompute(STATE[0], PARAMS, {}))
        for x in (program, ArrayProgram(array))
    ]
    np.testing.assert_allclose(*rates, rtol=1e-12, atol=1e-12)


@pytest.mark.full
def test_wrong_projection_is_refused(monkeypatch):
    right = _derive_quasi.principle_of_dalembert

    def wrong(scene, *args):
        M, h = right(scene, *args)
        return M, [scene.graph.scale(x, 0.999) for x in h]

    monkeypatch.setattr(_derive_quasi, "_written", lambda *_: [])
    monkeypatch.setattr(_derive_quasi, "principle_of_dalembert", wrong)
    _, _, found = lowered(sledge())
    assert found.equations is None
    assert found.reason.startswith("differs from the array program")


@pytest.mark.full
def test_a_start_does_not_depend_on_interpreted_terms(monkeypatch):
    """Rows and M of a system in quasi-velocities are those of the same one in v."""
    ts, options = np.linspace(0.4, 0.9, 3), {"rtol": 1e-10, "atol": 1e-10}
    q, w = STATE
    u = dict(zip(("ahead", "turning", "rolling", "swinging"), map(float, w), strict=True))

    def go():
        return jl.simulate(sledge(), q, None, ts, PARAMS, u0=u, **options)

    expected = go()
    monkeypatch.setattr(_term_codes, "LONG", -1)
    monkeypatch.setattr(_emit, "INTERPRET_FROM", -1)
    found = go()
    assert found.status == expected.status == 0
    np.testing.assert_allclose(found.q, expected.q, rtol=0, atol=1e-9)
    multipliers = jl.simulate(
        sledge(), q, expected.v[0], ts, PARAMS, formulation="multipliers", **options
    )
    np.testing.assert_allclose(found.q, multipliers.q, rtol=0, atol=1e-8)
