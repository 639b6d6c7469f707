"""Tall kinematics, which satisfy Pfaffian rows by themselves."""

import jax.numpy as jnp
import numpy as np
import pytest
from _systems.quasi_systems import BLADE, TALL, sleigh, sleighs
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag._core._errors import SimulationError
from jaxlag._core._status import Status

EPS = np.finfo(float).eps
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.mark.full
def test_tall_kinematics_equal_constrained_square_ones():
    tall, square = sleighs()
    motions = [
        jl.simulate(
            s, [0, 0, 0.3], None, u0={"v": 1.0, "omega": 0.4}, ts=np.linspace(0, 1, 3), **TIGHT
        )
        for s in (tall, square)
    ]
    for name in ("q", "v", "a"):
        one, other = (np.asarray(getattr(m, name)) for m in motions)
        np.testing.assert_allclose(one, other, atol=1e-11)
    np.testing.assert_allclose(motions[0].lam["v_n"], motions[1].lam["v_n"], atol=1e-11)
    v, omega = motions[1]["v"], motions[1]["omega"]
    J, m, a = 0.2 + 1.3 * 0.16, 1.3, 0.4
    slowing = -m * a * v * omega / J
    np.testing.assert_allclose(motions[1].lam["v_n"], m * (v * omega + a * slowing), atol=1e-10)


@pytest.mark.full
def test_motion_does_not_depend_on_the_heading():
    """Rotated by 90 degrees the motion is the same; a fixed pivot cos(theta) would be 0 there."""
    _, square = sleighs()
    start = {"v0": None, "u0": {"v": 1.0, "omega": 0.4}, "ts": np.linspace(0, 1, 3)}
    ahead, aside = (
        np.asarray(jl.simulate(square, [0, 0, heading], dt=0.02, **start).q)
        for heading in (0.0, np.pi / 2)
    )
    turned = np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2] + np.pi / 2], axis=1)
    np.testing.assert_allclose(aside, turned, atol=1e-14)


def offset(t, q, v, params):
    """A sleigh whose mass center is params ahead of the blade."""
    x = v[0] - params * jnp.sin(q[2]) * v[2]
    y = v[1] + params * jnp.cos(q[2]) * v[2]
    return 0.65 * (x * x + y * y) + 0.1 * v[2] ** 2


@pytest.mark.full
def test_momenta_normal_to_the_rows_are_included():
    """L with the rows inserted gives other equations, except for one value of params."""
    system = jl.System(offset, ("x", "y", "theta"), quasi=TALL, constraints=(BLADE,))
    for ahead in (0.0, 0.4):
        q = np.array([0.2, -0.1, 0.3])
        v = system.velocities(q, [1.0, 0.4], ahead)
        start = {"v0": None, "u0": [1.0, 0.4], "ts": [0.0, 1.0], "params": ahead}
        one, other = (
            jl.simulate(system, q, formulation=f, **start, **TIGHT)
            for f in ("quasi", "multipliers")
        )
        np.testing.assert_allclose(one.q, other.q, atol=1e-10)
        found = system._quasi_reactions(q, v, ahead)["a"]
        np.testing.assert_allclose(found, system.acceleration(q, v, ahead), atol=1e-12)
    with pytest.raises(
        ValueError, match=r"`written_in` must be 'v'.*it was 'u', .* the Pfaffian row 'v_n'"
    ):
        jl.System(offset, ("x", "y", "theta"), quasi=TALL, constraints=(BLADE,), written_in="u")


def along_x(t, q, u, params):
    return jnp.stack([u[0], 0.0 * u[0], u[1]])


@pytest.mark.full
def test_kinematics_that_violate_a_row_later_are_reported():
    """At theta = 0 the x axis is along the blade; as the sleigh rotates it no longer is."""
    astray = jl.QuasiVelocities(kinematics=along_x, names=("v", "omega"))
    system = jl.System(sleigh, ("x", "y", "theta"), quasi=astray, constraints=(BLADE,))
    with pytest.raises(SimulationError, match=r"contradictory_rows.*v_n.*kinematics.*do not"):
        jl.simulate(system, [0.0, 0.0, 0.0], None, u0=[1.0, 0.4], ts=[0.0, 2.0])


@pytest.mark.full
def test_quasi_velocities_that_omit_a_freedom_are_reported():
    """Two equivalent rows leave two freedoms, one of which has no quasi-velocity."""

    def twice(t, q, v, params):
        return jnp.stack([v[2], 2.0 * v[2]])

    def only_x(t, q, u, params):
        return jnp.stack([u[0], 0.0 * u[0], 0.0 * u[0]])

    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y", "z"),
        quasi=jl.QuasiVelocities(kinematics=only_x, names=("a",)),
        constraints=(jl.Pfaffian(twice, ("r1", "r2")),),
    )
    with pytest.raises(
        SimulationError, match=r"kinematics_singular: .*fewer quasi-velocities than"
    ):
        jl.simulate(system, [0.0] * 3, [0.3, 0.7, 0.0], [0.0, 1.0])


def test_kinematics_that_violate_a_row_are_refused():
    slanted = jl.QuasiVelocities(
        kinematics=lambda t, q, u, params: jnp.stack([u[0], 0.0 * u[0], u[1]]),
        names=("v", "omega"),
    )
    system = jl.System(sleigh, ("x", "y", "theta"), quasi=slanted, constraints=(BLADE,))
    with pytest.raises(SimulationError, match=r"contradictory_rows.*v_n.*kinematics.*do not"):
        jl.simulate(system, [0, 0, 0.3], None, u0=[0.0, 0.4], ts=[0.0, 1.0])


@pytest.mark.full
def test_a_start_off_the_row_is_refused_or_assembled():
    _, square = sleighs()
    for start in ({"v0": None, "u0": [1.0, 0.2, 0.4]}, {"v0": [1.0, 0.2, 0.4]}):
        with pytest.raises(SimulationError, match=r"inconsistent_start.*v_n"):
            jl.simulate(square, [0, 0, 0.3], ts=[0.0, 1.0], **start)
        motion = jl.simulate(square, [0, 0, 0.3], ts=[0.0, 1.0], assemble=True, **start)
        assert motion.status == Status.ok
        assert np.max(np.abs(motion["v_n"])) <= 64 * EPS
