"""Equilibrium by virtual work: closed forms, stability, derivatives, and failed searches."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _pendulum import PARAMS, PENDULUM, pendulum_kinetic, pendulum_potential
from _user import unchecked  # noqa: F401

import jaxlag as jl

EPS = np.finfo(float).eps


def bob(t, q, params):
    return params["l"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])


def wind(t, q, v, params, inputs):
    return jnp.stack([inputs["wind"], 0.0 * t])


BLOWN = jl.System(
    coordinates=("theta",),
    kinetic=pendulum_kinetic,
    potential=pendulum_potential,
    forces=(
        jl.PointForce(bob, wind, "wind"),
        jl.Rayleigh(lambda t, q, v, params: 0.5 * v[0] ** 2, "air"),
    ),
)


def hoop(t, q, v, params):
    """Bead on a hoop of radius r that rotates about its vertical diameter at Omega."""
    r, omega = params["r"], params["Omega"]
    T = 0.5 * r**2 * (v[0] ** 2 + (omega * jnp.sin(q[0])) ** 2)
    return T + params["g"] * r * jnp.cos(q[0])


HOOP = jl.System(hoop, ("theta",))


def test_a_hanging_mass_is_stable_and_an_upright_one_is_not():
    down = jl.equilibrium(PENDULUM, [0.4], PARAMS)
    up = jl.equilibrium(PENDULUM, [3.0], PARAMS)
    np.testing.assert_allclose(down["theta"], 0, atol=4 * EPS)
    np.testing.assert_allclose(up["theta"], np.pi, rtol=4 * EPS)
    stiffness = 1.2 * 9.81 * 0.7
    np.testing.assert_allclose(down.stiffness, [[stiffness]], rtol=8 * EPS)
    np.testing.assert_allclose(up.eigenvalues, [-stiffness], rtol=8 * EPS)
    assert (bool(down.stable), bool(up.stable)) == (True, False)
    assert down.conservative
    assert up.conservative


def test_applied_forces_and_inputs_are_included():
    """In the wind W the bob hangs at tan(theta) = W/(m g); drag is zero at rest."""
    rest = jl.equilibrium(BLOWN, {"theta": 0.0}, PARAMS, inputs={"wind": 3.0})
    np.testing.assert_allclose(rest.q[0], np.arctan2(3.0, 1.2 * 9.81), rtol=8 * EPS)
    np.testing.assert_allclose(rest.stiffness[0, 0], 0.7 * np.hypot(3.0, 1.2 * 9.81), rtol=8 * EPS)
    table = {"wind": jl.LinearInterpolation([0.0, 2.0], [0.0, 6.0])}
    then = jl.equilibrium(BLOWN, [0.0], PARAMS, t=1.0, inputs=table)
    np.testing.assert_allclose(then.q, rest.q, rtol=8 * EPS)


def test_a_rotating_frame_has_relative_equilibria():
    """Fast hoop: 0 is unstable, cos(theta) = g/(r Omega^2) is stable; slow hoop: 0 is stable."""
    fast = {"r": 0.5, "Omega": 6.0, "g": 9.81}
    off = jl.equilibrium(HOOP, [0.8], fast)
    np.testing.assert_allclose(off.q[0], np.arccos(9.81 / (0.5 * 36)), rtol=8 * EPS)
    assert off.stable
    assert not jl.equilibrium(HOOP, [0.0], fast).stable
    assert jl.equilibrium(HOOP, [0.0], fast | {"Omega": 4.0}).stable


def frame_potential(t, q, params):
    """Two springs in the plane with a coupling: V with a full Hessian."""
    x, y = q
    return params["k"] * (x**4 / 4 + x**2 * y + y**2) - params["w"] * (2 * x + y)


FRAME = jl.System(
    coordinates=("x", "y"),
    kinetic=lambda t, q, v, params: 0.5 * v @ v,
    potential=frame_potential,
)


def test_the_stiffness_is_the_hessian_of_the_potential():
    params = {"k": 3.0, "w": 1.4}
    rest = jl.equilibrium(FRAME, [0.5, 0.5], params)
    gradient = jax.grad(frame_potential, argnums=1)(0.0, rest.q, params)
    np.testing.assert_allclose(gradient, 0, atol=16 * EPS * 10)
    hessian = jax.hessian(frame_potential, argnums=1)(0.0, rest.q, params)
    np.testing.assert_allclose(rest.stiffness, hessian, rtol=16 * EPS)
    assert rest.conservative
    assert rest.stable == bool(np.linalg.eigvalsh(hessian)[0] > 0)


@pytest.mark.full
def test_derivatives_equal_those_of_the_implicit_function():
    """theta = atan(W/(m g)): first and second derivatives in every mode, by closed form."""

    def theta(W, m):
        return jl.equilibrium(BLOWN, [0.1], PARAMS | {"m": m}, inputs={"wind": W})["theta"]

    W, m, g = 3.0, 1.2, 9.81
    b = m * g
    first = b / (b**2 + W**2), -W * g / (b**2 + W**2)
    for derivative in (jax.grad, jax.jacfwd, jax.jacrev):
        for i, expected in enumerate(first):
            found = derivative(theta, argnums=i)(W, m)
            np.testing.assert_allclose(found, expected, rtol=16 * EPS)
    second = -2 * b * W / (b**2 + W**2) ** 2
    for outer, inner in ((jax.jacfwd, jax.jacrev), (jax.jacrev, jax.jacfwd)):
        np.testing.assert_allclose(outer(inner(theta))(W, m), second, rtol=64 * EPS)


@pytest.mark.full
def test_batch_equals_single_searches():
    """Starts, params and a failure in one batch; the failed lane does not affect others."""
    starts = jnp.array([[0.4], [3.0], [jnp.nan]])

    def search(q0):
        return jl.equilibrium(PENDULUM, q0, PARAMS)

    many = jax.vmap(search)(starts)
    expected = [jl.Status.ok, jl.Status.ok, jl.Status.nonfinite]
    np.testing.assert_array_equal(many.status, [int(s) for s in expected])
    for i in range(2):
        np.testing.assert_allclose(many.q[i], search(starts[i]).q, atol=8 * EPS)
    np.testing.assert_array_equal(many.stable, [True, False, False])
    assert many["theta"].shape == (3,)


def test_float32_searches_stay_float32():
    single = jax.tree.map(jnp.float32, PARAMS)
    rest = jl.equilibrium(PENDULUM, jnp.array([0.4], jnp.float32), single)
    assert rest.q.dtype == jnp.float32
    np.testing.assert_allclose(rest.q, 0, atol=1e-6)


def test_search_needs_no_callback_and_no_new_compilation():
    def search(q0):
        return jl.equilibrium(PENDULUM, q0, PARAMS).q

    assert "callback" not in str(jax.make_jaxpr(search)(jnp.array([0.4])))
    traces = 0

    def counted(t, q, params):
        nonlocal traces
        traces += 1
        return pendulum_potential(t, q, params)

    system = jl.System(coordinates=("theta",), kinetic=pendulum_kinetic, potential=counted)
    jl.equilibrium(system, [0.4], PARAMS)
    first = traces
    jl.equilibrium(system, [0.1], PARAMS | {"m": 2.0}, t=3.0)
    assert traces == first


def test_cyclic_coordinates_are_unchanged():
    """A cyclic coordinate: any value is an equilibrium, none counts as stable."""
    system = jl.System(
        coordinates=("x", "y"),
        kinetic=lambda t, q, v, params: 0.5 * v @ v,
        potential=lambda t, q, params: 2.0 * (q[0] - 0.5) ** 2,
    )
    rest = jl.equilibrium(system, [3.0, 0.7])
    np.testing.assert_allclose(rest.q, [0.5, 0.7], rtol=8 * EPS)
    assert not rest.stable


@pytest.mark.full
def test_follower_forces_are_not_conservative():
    """A force that rotates with the second of two links: K is reported as not symmetric."""

    def tip(t, q, params):
        return jnp.stack([jnp.cumsum(jnp.cos(q))[-1], jnp.cumsum(jnp.sin(q))[-1]])

    def follower(t, q, v, params):
        return -params["F"] * jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])])

    column = jl.System(
        coordinates=("a", "b"),
        kinetic=lambda t, q, v, params: 0.5 * v @ v,
        potential=lambda t, q, params: 0.5 * q[0] ** 2 + 0.5 * (q[1] - q[0]) ** 2,
        forces=(jl.PointForce(tip, follower, "follower"),),
    )
    rest = jl.equilibrium(column, [0.1, 0.1], {"F": 0.5})
    np.testing.assert_allclose(rest.q, 0, atol=8 * EPS)
    assert not rest.conservative
    # By hand: Q_a = F sin(a - b), Q_b = 0.
    np.testing.assert_allclose(rest.stiffness, [[1.5, -0.5], [-1.0, 1.0]], atol=8 * EPS)


@pytest.mark.full
def test_failed_search_reports_the_nearest_point():
    """A constant force has no equilibrium, nor has sin(x) = 2, whose nearest point is pi/2."""
    pushed = jl.System(lambda t, q, v, params: 0.5 * v @ v + q[1], ("x", "y"))
    message = (
        r"status implicit_solve_failed: no equilibrium was found\. After \d+ steps the nearest "
        r"point was q = \[0\. 0\.\]; the remaining force on 'y' is 1, 1\.0e\+00 of its scale 1\."
    )
    with pytest.raises(jl.EquilibriumError, match=message):
        jl.equilibrium(pushed, [0.0, 0.0])

    twisted = jl.System(lambda t, q, v, params: 0.5 * v @ v + jnp.cos(q[0]) + 2 * q[0], ("theta",))
    with pytest.raises(jl.EquilibriumError, match="remaining force on 'theta' is 1,") as info:
        jl.equilibrium(twisted, [0.5])
    near = info.value.equilibrium
    np.testing.assert_allclose(near.q, [np.pi / 2], atol=1e-6)
    np.testing.assert_allclose(near.residual, [1.0], atol=1e-12)
    assert not near.stable
    quiet = jl.equilibrium(twisted, [0.5], throw=False)
    assert quiet.status == jl.Status.implicit_solve_failed
    assert "no equilibrium was found" in quiet.message()


def test_search_limited_by_max_steps_fails():
    with pytest.raises(jl.EquilibriumError, match="After 1 steps the nearest point was"):
        jl.equilibrium(PENDULUM, [2.0], PARAMS, max_steps=1)


def test_nonfinite_forces_are_named():
    broken = jl.System(lambda t, q, v, params: 0.5 * v @ v + jnp.log(q[0]), ("x",))
    with pytest.raises(
        jl.EquilibriumError, match=r"status nonfinite: .* the remaining force on 'x'"
    ):
        jl.equilibrium(broken, [0.0])


# ---- Arguments -----------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q0": [0.1, 0.2]}, "`q0` must have shape (1,), but its shape was (2,)."),
        ({"q0": [np.inf]}, "`q0` must be finite, but it was [inf]"),
        ({"max_steps": 0}, "`max_steps` must be a positive integer, but it was 0."),
        ({"max_steps": True}, "`max_steps` must be a positive integer, but it was True."),
        ({"rtol": -1.0}, "`rtol` must be a positive number, but it was -1.0."),
        ({"rtol": np.nan}, "`rtol` must be finite, but it was nan."),
        ({"rtol": np.inf}, "`rtol` must be finite, but it was inf."),
        ({"rtol": 1.0}, "`rtol` must be less than 1, but it was 1.0."),
        ({"rtol": "a"}, "`rtol` must be a positive number, but it was 'a'."),
        ({"rtol": [1e-3, 1e-3]}, "`rtol` must be a positive number, but its shape was (2,)."),
        ({"t": np.nan}, "`t` must be finite, but it was nan."),
        ({"t": "a"}, "`t` must be a number, but it was 'a'."),
        ({"t": [0.0, 1.0, 2.0]}, "`t` must be a number, but its shape was (3,)."),
        ({"system": "pendulum"}, "`system` must be a jl.System, but it was 'pendulum'."),
        (
            {"inputs": {"wind": 1.0}},
            "`inputs` must hold only signals that a declared function reads",
        ),
    ],
    ids=str,
)
def test_invalid_arguments_are_refused(changes, message):
    given = {"system": PENDULUM, "q0": [0.1], "params": PARAMS} | changes
    with pytest.raises(ValueError, match=re.escape(message)):
        jl.equilibrium(**given)


@pytest.mark.parametrize("name", ["t", "rtol"])
def test_traced_arguments_of_wrong_shape_are_refused(name):
    def search(x):
        return jl.equilibrium(PENDULUM, [0.1], PARAMS, **{name: x}).q

    with pytest.raises(
        ValueError, match=rf"^`{name}` must be a .*number, but its shape was \(2,\)"
    ):
        jax.jit(search)(jnp.full(2, 1e-3))
