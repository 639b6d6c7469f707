"""Equations of implicit stages are solved relative to dy/dt."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import jaxlag as jl
from jaxlag.solvers import _stage_chord
from jaxlag.solvers._stage_chord import StageChord
from systems.catalogue import find


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_large_rates_converge_to_their_rounding(dtype):
    """Residuals of 1e6 are rounded by 0.06 in float32, far above an absolute bound of 1e-6."""
    bound = 10 * float(jnp.finfo(dtype).eps)

    def residual(f, _):
        return f - 1e6 * jnp.cos(jnp.array([1.0, 2.0, 3.0], dtype) + 1e-7 * f)

    guess = jnp.full(3, 1e5, dtype)
    found = optimistix.root_find(residual, StageChord(bound, bound), guess, max_steps=16)
    assert found.result == optimistix.RESULTS.successful
    exact = np.array([1.0, 2.0, 3.0])
    f = np.zeros(3)
    for _ in range(60):
        f = 1e6 * np.cos(exact + 1e-7 * f)
    np.testing.assert_allclose(found.value, f, rtol=4 * bound)
    stock = optimistix.Chord(bound, bound, optimistix.rms_norm)
    found = optimistix.root_find(residual, stock, guess, max_steps=16, throw=False)
    assert found.result != optimistix.RESULTS.successful


def test_small_components_are_not_lost_beside_large_ones():
    """10 eps of 1e6 is 1 in float32; the equation of the second component is its own."""

    def residual(f, _):
        return f - jnp.stack([jnp.float32(1e6), jnp.float32(0.9) * jnp.cos(f[1])])

    guess = jnp.array([1e6, 0.0], jnp.float32)
    found = optimistix.root_find(residual, StageChord(1e-6, 1e-6), guess, max_steps=64)
    root = found.value[1]
    np.testing.assert_allclose(root, 0.9 * np.cos(root), rtol=4e-6)


def test_roots_near_zero_are_held_to_the_absolute_bound():
    def residual(f, _):
        return 1e-3 * jnp.sin(f) + f - 2e-5

    finder = StageChord(1e-10, 1e-10)
    found = optimistix.root_find(residual, finder, jnp.array([1.0]), max_steps=16)
    np.testing.assert_allclose(found.value, 2e-5 / 1.001, atol=1e-10)


def state_at(finder, residual, guess):
    """The state that diffrax passes to the next stages of a step."""
    like = jax.eval_shape(lambda: guess)
    function = lambda y, args: (residual(y, args), None)  # noqa: E731
    return finder.init(function, guess, None, {}, like, None, frozenset())


def counted(function, slope):
    """(the function, a list that gets an entry with every derivative of it)."""
    evaluated = []

    @jax.custom_jvp
    def call(x):
        return function(x)

    @call.defjvp
    def _(primals, tangents):
        jax.debug.callback(lambda: evaluated.append(1))
        return function(*primals), slope(*primals) * tangents[0]

    return call, evaluated


def test_the_jacobian_of_a_step_is_kept_until_it_converges_slowly():
    """f = 3 cos f near 1.17. The slope at 1.1 serves; that at 0.5 is replaced."""
    finder = StageChord(1e-9, 1e-9, per_step=True)
    cos, evaluated = counted(jnp.cos, lambda x: -jnp.sin(x))

    def residual(f, _):
        return f - 3.0 * cos(f)

    guess = jnp.array([1.0])
    for elsewhere, jacobians in ((1.1, 0), (0.5, 1)):
        state = state_at(finder, residual, jnp.array([elsewhere]))
        jax.effects_barrier()
        evaluated.clear()
        options = {"init_state": state}
        found = optimistix.root_find(residual, finder, guess, options=options, max_steps=16)
        jax.effects_barrier()
        np.testing.assert_allclose(found.value, 3.0 * np.cos(found.value), rtol=1e-9)
        assert len(evaluated) == jacobians


@pytest.mark.parametrize(
    ("solver", "per_step", "jacobians"),
    [
        (diffrax.Kvaerno5, True, 1),
        (diffrax.Kvaerno5, False, 7),  # diffrax solves for the explicit stage of a first step, too
        (diffrax.ImplicitEuler, True, 1),
        (diffrax.ImplicitEuler, False, 1),
    ],
)
@pytest.mark.parametrize("start", [0.0, 1.0])
def test_jacobians_of_the_first_step(solver, per_step, jacobians, start):
    """At rest, where the first guess is 0, as elsewhere."""
    function, evaluated = counted(lambda y: -200.0 * y, lambda y: -200.0)
    finder = StageChord(1e-10, 1e-10, per_step=per_step)
    solver, y = solver(root_finder=finder), jnp.array([start])
    term = diffrax.ODETerm(lambda t, y, args: function(y) + jnp.where(t > 0.05, 3.0, 0.0))
    ends = jnp.array(0.0), jnp.array(0.1)
    memory = solver.init(term, *ends, y, None)
    *_, result = solver.step(term, *ends, y, None, memory, False)
    jax.effects_barrier()
    assert result == diffrax.RESULTS.successful
    assert len(evaluated) == jacobians


@pytest.mark.parametrize("method", ["implicit_euler", "kvaerno5"])
def test_a_stiff_system_at_rest_is_moved_by_a_later_force(method, monkeypatch):
    """V = k (cosh x - 1) with k = 1e6, and F = 1e3 from t = 0.05: x = asinh(F / k) at the end."""
    monkeypatch.setattr(_stage_chord, "LONG", 0)
    force = jl.GeneralizedForce(
        lambda t, q, v, p: jnp.where(t > 0.05, p["F"], 0.0) - 10.0 * v, "push"
    )
    stiff = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - p["k"] * jnp.sum(jnp.cosh(q) - 1.0),
        ("x",),
        forces=(force,),
    )
    motion = jl.simulate(
        stiff, [0.0], [0.0], [0.0, 1.0], {"k": 1e6, "F": 1e3}, method=method, dt=0.1
    )
    # kvaerno5 leaves 0.2 % of the oscillation.
    np.testing.assert_allclose(motion.q[-1], np.arcsinh(1e-3), rtol=0.01)


def test_a_lane_does_not_depend_on_slow_ones_beside_it():
    finder = StageChord(1e-9, 1e-9, per_step=True)

    def residual(f, _):
        return f - 3.0 * jnp.cos(f)

    def root(elsewhere):
        options = {"init_state": state_at(finder, residual, elsewhere)}
        guess = jnp.array([1.0])
        found = optimistix.root_find(residual, finder, guess, options=options, max_steps=16)
        return found.value, found.stats["num_steps"]

    points = jnp.array([[1.1], [0.5], [0.7]])
    together = jax.vmap(root)(points)
    for i, point in enumerate(points):
        jax.tree.map(np.testing.assert_array_equal, [x[i] for x in together], list(root(point)))


def test_nonfinite_increments_end_the_iterations():
    finder, guess = StageChord(1e-9, 1e-9), jnp.array([2.0])
    residual = lambda f, _: f - jnp.log(1.0 - f)  # noqa: E731
    found = optimistix.root_find(residual, finder, guess, max_steps=50, throw=False)
    assert found.result == optimistix.RESULTS.nonlinear_divergence
    assert found.stats["num_steps"] <= 2


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "method"),
    [("double_pendulum", "kvaerno4"), ("double_pendulum_cartesian", "kvaerno5")],
)
def test_implicit_methods_save_every_state_in_float32(name, method):
    system, example = find(name).system, find(name).example
    q0, v0 = jnp.asarray(example.q0, jnp.float32), jnp.asarray(example.v0, jnp.float32)
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), dict(example.params))
    if system.constraints:
        start = jl.assemble(system, q0, v0, params)
        q0, v0 = start.q, start.v
    ts = np.linspace(0.0, 1.5, 61)
    motion = jl.simulate(system, q0, v0, ts, params, method=method)
    wide = jax.tree.map(lambda x: x.astype(float), (q0, v0, params))
    exact = jl.simulate(system, *wide[:2], ts, wide[2], assemble=True)
    np.testing.assert_allclose(motion.q, exact.q, atol=1e-3)


def test_the_message_names_the_save_time_of_a_failed_step():
    """A force that is NaN within 2e-4 s of a save time, which no accepted step meets."""

    def hole(t, q, v, p):
        return jnp.where(jnp.abs(t - 0.3) < 1e-4, jnp.nan, 0.0) * v

    free = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(jl.GeneralizedForce(hole, "hole"),)
    )
    motion = jl.simulate(free, [0.0], [1.0], [0.0, 0.3, 1.0], dt=1.0, method="heun", throw=False)
    assert motion.status != jl.Status.ok
    assert np.isfinite(motion.q[:, 0]).tolist() == [True, False, True]
    assert "in the step to ts[1] = 0.3" in motion.message()
