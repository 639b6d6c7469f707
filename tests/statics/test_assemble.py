"""Assembly: the nearest consistent state, held coordinates, and impossible requests."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.mechanisms import (
    BOBS,
    FOUR_BAR,
    NAMES,
    SKATE,
    THETA,
    bobs,
    cartesian,
    four_bar,
    four_bar_start,
    rods,
    skate,
    to_cartesian,
)
from _user import unchecked  # noqa: F401

import jaxlag as jl

EPS = np.finfo(float).eps
GUESS = (jnp.array([0.5, -0.7, 1.1, -1.0]), jnp.array([0.3, 0.0, 0.0, 0.1]))


@pytest.mark.parametrize("weights", [None, [1.0, 2.0, 3.0, 4.0]])
def test_assembled_state_is_the_nearest(weights):
    """W (q* - q) and W (v* - v) are combinations of rows: the conditions of a minimum."""
    state = jl.assemble(cartesian, *GUESS, BOBS, weights=weights)
    position, velocity = cartesian.residuals(state.q, state.v, BOBS)
    for residual in (*position.values(), *velocity.values()):
        assert abs(residual) <= 10 * EPS
    W = (
        cartesian.mass_matrix(state.q, params=BOBS)
        if weights is None
        else jnp.diag(jnp.array(weights))
    )
    A, _ = cartesian._terms.rows(jnp.array(0.0), state.q, state.v, BOBS)
    tangent = np.linalg.svd(A)[2][2:]
    for moved in (state.q - GUESS[0], state.v - GUESS[1]):
        assert np.linalg.norm(moved) > 0.01
        np.testing.assert_allclose(tangent @ W @ moved, 0, atol=1e-14)
    assert int(state.rank) == 2
    assert state.dependent == ()


def test_consistent_states_are_unchanged():
    q, v = to_cartesian(THETA, jnp.array([0.3, -0.4]))
    state = jl.assemble(cartesian, q, v, BOBS)
    np.testing.assert_allclose(state.q, q, atol=4 * EPS)
    np.testing.assert_allclose(state.v, v, atol=4 * EPS)


@pytest.mark.full
@pytest.mark.parametrize("wrong", [(1.0, 1.2, 0.8), (1.0, 0.8, 1.2), (1.0, 1.2, 1.2)])
def test_four_bar_is_assembled_from_a_wrong_guess(wrong):
    """20 % off in two angles, with the crank held; compared with the law of cosines."""
    q = four_bar_start()
    state = jl.assemble(
        four_bar, q * jnp.array(wrong), [1.0, 0, 0], FOUR_BAR, hold=("crank", "crank'")
    )
    np.testing.assert_allclose(state.q, q, atol=1e-14)
    h = 1e-6
    rate = (four_bar_start(1.0 + h) - four_bar_start(1.0 - h)) / (2 * h)
    np.testing.assert_allclose(state.v, rate, atol=1e-9)


def test_nonholonomic_assembly_changes_velocities_only():
    """Only v changes: there is no position residual."""
    state = jl.assemble(skate, [1.0, 2.0, 0.3], [1.0, 1.0, 0.5], SKATE, hold=("theta'",))
    np.testing.assert_array_equal(state.q, [1.0, 2.0, 0.3])
    speed = np.cos(0.3) + np.sin(0.3)
    np.testing.assert_allclose(state.v, [speed * np.cos(0.3), speed * np.sin(0.3), 0.5], rtol=1e-14)


def test_rheonomic_rows_are_assembled_at_the_given_time():
    led = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y"),
        constraints=(jl.Holonomic(lambda t, q, params: q[0] - jnp.sin(3 * t), "led"),),
    )
    state = jl.assemble(led, [0.0, 1.0], [0.0, 2.0], t=0.2)
    np.testing.assert_allclose(state.q, [np.sin(0.6), 1.0], rtol=1e-14)
    np.testing.assert_allclose(state.v, [3 * np.cos(0.6), 2.0], rtol=1e-14)


@pytest.mark.full
def test_rows_that_follow_from_others_are_named():
    def more(t, q, params):
        return jnp.append(rods(t, q, params), jnp.sum(rods(t, q, params)))

    system = jl.System(bobs, NAMES, constraints=(jl.Holonomic(more, ("a", "b", "sum")),))
    state = jl.assemble(system, *GUESS, BOBS)
    alone = jl.assemble(cartesian, *GUESS, BOBS)
    np.testing.assert_allclose(state.q, alone.q, atol=1e-9)
    np.testing.assert_allclose(state.v, alone.v, atol=1e-9)
    assert int(state.rank) == 2
    assert len(state.dependent) == 1
    assert "dependent rows" in state.message()


@pytest.mark.full
def test_derivative_equals_that_of_the_implicit_function():
    """Forward, reverse and central differences, by the guess and by a length."""

    def assembled(x):
        params = {**BOBS, "l1": x["l1"]}
        state = jl.assemble(cartesian, x["q"], x["v"], params)
        return jnp.concatenate([state.q, state.v])

    x = {"q": GUESS[0], "v": GUESS[1], "l1": jnp.array(0.9)}
    dx = {"q": jnp.array([0.3, -0.2, 0.1, 0.5]), "v": jnp.ones(4), "l1": jnp.array(0.7)}
    y, dy = jax.jvp(assembled, (x,), (dx,))
    weights = jnp.arange(1.0, 9.0)
    back = jax.vjp(assembled, x)[1](weights)[0]
    assert np.isclose(weights @ dy, sum(jnp.sum(back[k] * dx[k]) for k in x), rtol=1e-12)
    h = 1e-5
    ahead, behind = (assembled({k: x[k] + s * h * dx[k] for k in x}) for s in (1, -1))
    np.testing.assert_allclose(dy, (ahead - behind) / (2 * h), atol=1e-8)
    assert np.linalg.norm(y) > 1


@pytest.mark.full
def test_batches_equal_single_assemblies():
    states = jax.vmap(lambda s: jl.assemble(cartesian, s * GUESS[0], GUESS[1], BOBS))(
        jnp.array([0.9, 1.0, 1.1])
    )
    assert (np.asarray(states.status) == 0).all()
    one = jl.assemble(cartesian, 1.1 * GUESS[0], GUESS[1], BOBS)
    np.testing.assert_allclose(states.q[2], one.q, atol=1e-14)


# ---- Impossible requests -------------------------------------------------------------------------


@pytest.mark.full
def test_held_coordinates_that_prevent_assembly_are_named():
    """A crank angle that the four-bar cannot reach: the links are too short."""
    short = {"a": 0.4, "b": 0.5, "c": 0.4, "d": 1.0}
    with pytest.raises(jl.AssemblyError, match="release crank") as caught:
        jl.assemble(four_bar, [2.5, 0.3, -0.5], [0, 0, 0], short, hold=("crank",))
    assert caught.value.assembly.status == jl.Status.contradictory_rows
    assert "'pin[" in str(caught.value)


@pytest.mark.full
def test_more_rows_than_coordinates_must_be_consistent():
    """A point in the plane on three lines: fixed at a common intersection, else impossible."""

    def lines(t, q, params):
        return jnp.stack([q[0] - 1.0, q[1] - 2.0, q[0] + q[1] - params])

    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y"),
        constraints=(jl.Holonomic(lines, ("a", "b", "c")),),
    )
    fixed = jl.assemble(system, [0.9, 2.2], [0.1, 0.0], 3.0)
    np.testing.assert_allclose(fixed.q, [1.0, 2.0], atol=1e-14)
    assert fixed.rank == 2
    motion = jl.simulate(system, fixed.q, fixed.v, [0.0, 1.0], 3.0)
    np.testing.assert_allclose(motion.q[-1], [1.0, 2.0], atol=1e-14)
    match = "There are 3 rows for 2 coordinates: rows beyond that number must follow"
    with pytest.raises(jl.AssemblyError, match=match):
        jl.assemble(system, [0.9, 2.2], [0.1, 0.0], 4.0)
    with pytest.raises(jl.SimulationError, match=f"(?s)contradictory_rows.*{match}"):
        jl.simulate(system, [1.0, 2.0], [0.0, 0.0], [0.0, 1.0], 4.0)


@pytest.mark.full
def test_impossible_assembly_without_held_coordinates_is_reported():
    short = {"a": 0.1, "b": 0.1, "c": 0.1, "d": 1.0}
    with pytest.raises(jl.AssemblyError, match="contradictory_rows"):
        jl.assemble(four_bar, [0.5, 0.3, -0.5], [0, 0, 0], short)
    with pytest.raises(jl.AssemblyError, match="Without hold= it cannot"):
        jl.assemble(four_bar, [0.5, 0.3, -0.5], [0, 0, 0], short, hold=("crank",))
    state = jl.assemble(four_bar, [0.5, 0.3, -0.5], [0, 0, 0], short, throw=False)
    assert state.status == jl.Status.contradictory_rows
    assert state.where >= 0


@pytest.mark.full
def test_a_velocity_that_cannot_be_held_is_named():
    with pytest.raises(jl.AssemblyError, match="release x' or y'"):
        jl.assemble(skate, [0, 0, 0.3], [1.0, 0.0, 0.0], SKATE, hold=("x'", "y'"))


@pytest.mark.full
def test_assembled_state_is_a_local_minimum_of_distance():
    """Four-bars from distant guesses: first and second order conditions of a local minimum."""
    rng = np.random.default_rng(3)
    guesses = four_bar_start(0.7) + rng.standard_normal((100, 3))

    @jax.jit
    @jax.vmap
    def conditions(guess):
        weights = jnp.ones_like(guess)
        state = jl.assemble(four_bar, guess, 0 * guess, FOUR_BAR, weights=weights, throw=False)

        def phi(q):
            return four_bar._terms.position(jnp.array(0.0), q, FOUR_BAR)

        A, moved = jax.jacobian(phi)(state.q), state.q - guess
        tangent = jnp.linalg.svd(A)[2][A.shape[0] :]
        lam = jnp.linalg.lstsq(A.T, moved)[0]
        hessian = jnp.eye(len(guess)) - jnp.tensordot(lam, jax.hessian(phi)(state.q), 1)
        curvature = jnp.linalg.eigvalsh(tangent @ hessian @ tangent.T)[0]
        return state.status, jnp.linalg.norm(tangent @ moved), curvature

    status, slope, curvature = conditions(guesses)
    np.testing.assert_array_equal(status, 0)
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    assert np.all(curvature > 0)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (([0, 0], [0, 0, 0, 0]), {}, r"`q` must have shape \(4,\)"),
        (([0, np.nan, 0, 0], [0, 0, 0, 0]), {}, "assemble: `q` must be finite"),
        (GUESS, {"hold": ("z",)}, "assemble: `hold` must name coordinates among"),
        (GUESS, {"hold": "x1"}, "assemble: `hold` must be a sequence of names"),
        (GUESS, {"weights": [1.0, 1.0]}, r"assemble: `weights` must have shape \(4,\)"),
        (GUESS, {"weights": [1.0, 0.0, 1.0, 1.0]}, "assemble: `weights` must be positive"),
        (GUESS, {"weights": [1.0, np.inf, 1.0, 1.0]}, "`weights` must be positive and finite"),
        (GUESS, {"t": [1.0, 2.0]}, r"assemble: `t` must be a number, but its shape was \(2,\)"),
        (GUESS, {"t": np.nan}, "assemble: `t` must be finite, but it was nan"),
        (GUESS, {"t": "now"}, "assemble: `t` must be a number, but it was 'now'"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_arguments_are_refused(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        jl.assemble(cartesian, *arguments, BOBS, **options)


@pytest.mark.usefixtures("unchecked")
def test_other_types_than_systems_are_refused():
    with pytest.raises(ValueError, match=r"assemble: `system` must be a jl\.System"):
        jl.assemble(None, [0.0], [0.0])
