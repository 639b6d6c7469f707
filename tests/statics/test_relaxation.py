"""Relaxation to rest: closed linkages, forces without potential, derivatives at the rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._core._batching import MOST
from jaxlag._core._jaxprs import equations, within

EPS = np.finfo(float).eps
GRAVITY = 9.81


def ends(q, params):
    """Ends of crank, coupler and rocker, in order from the origin."""
    links = params["l"][:, None] * jnp.stack([jnp.cos(q), jnp.sin(q)], axis=1)
    return jnp.cumsum(links, axis=0)


def potential(t, q, params):
    """Weights at the joints and a spring on the crank."""
    crank = 0.5 * params["k"] * q[0] ** 2
    return GRAVITY * params["m"] @ ends(q, params)[:, 1] + crank


def opening(t, q, params):
    return ends(q, params)[-1] - params["g"]


FOUR_BAR = jl.System(
    coordinates=("crank", "coupler", "rocker"),
    kinetic=lambda t, q, v, params: 0.5 * v @ v,
    potential=potential,
    constraints=(jl.Holonomic(opening, "loop"),),
)


def four_bars(count, dtype=float):
    """(params, q0) of four-bars in random configurations: the pivot is at the rocker's end."""
    rng = np.random.default_rng(1)
    params = {
        "l": rng.uniform(0.3, 1.5, (count, 3)),
        "m": 10 ** rng.uniform(-1, 1, (count, 3)),
        "k": rng.choice([0.0, 5.0], count),
    }
    q0 = rng.uniform(-np.pi, np.pi, (count, 3))
    params["g"] = np.asarray(jax.vmap(ends)(q0, params))[:, -1]
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), (params, q0))


@jax.jit
@jax.vmap
def rest_of(params, q0):
    return jl.equilibrium(FOUR_BAR, q0, params, throw=False)


def unbalanced(q, params):
    """Largest force along the constraints over the largest force, and the position residual."""
    F, A = jax.grad(potential, 1)(0.0, q, params), jax.jacobian(opening, 1)(0.0, q, params)
    tangent = jnp.cross(A[0], A[1])
    tangent = tangent / jnp.linalg.norm(tangent)
    return jnp.abs(tangent @ F) / jnp.max(jnp.abs(F)), jnp.max(jnp.abs(opening(0.0, q, params)))


@pytest.mark.full
def test_four_bars_come_to_rest_from_any_configuration():
    """The search for a root of the forces alone fails on 4 of 24, in minima of their norm."""
    params, q0 = four_bars(24)
    found = rest_of(params, q0)
    np.testing.assert_array_equal(found.status, 0)
    force, gap = jax.vmap(unbalanced)(found.q, params)
    np.testing.assert_allclose(force, 0, atol=1e-12)
    np.testing.assert_allclose(gap, 0, atol=16 * EPS)


@pytest.mark.full
def test_four_bars_come_to_rest_in_single_precision():
    params, q0 = four_bars(200, jnp.float32)
    found = rest_of(params, q0)
    assert found.q.dtype == jnp.float32
    np.testing.assert_array_equal(found.status, 0)
    _, gap = jax.vmap(unbalanced)(found.q, params)
    np.testing.assert_allclose(gap, 0, atol=16 * float(np.finfo(np.float32).eps))


@pytest.mark.full
def test_derivatives_at_a_relaxed_state_are_right():
    """Forward, reverse, and central differences that start at the rest, by k and the pivot."""
    params, q0 = four_bars(24)
    found = rest_of(params, q0)
    i = int(np.argmax(found.iterations))  # one whose first search failed
    assert found.iterations[i] > 60
    one = jax.tree.map(lambda x: x[i], params)

    @jax.jit
    def q(x, start):
        moved = {**one, "k": x[0], "g": x[1:]}
        return jl.equilibrium(FOUR_BAR, start, moved, throw=False).q

    x = jnp.array([one["k"] + 1.0, *one["g"]])
    rest = q(x, q0[i])
    forward, reverse = jax.jacfwd(q)(x, q0[i]), jax.jacrev(q)(x, q0[i])
    h = 1e-5
    steps = [(q(x + h * e, rest) - q(x - h * e, rest)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(forward, np.stack(steps, axis=1), rtol=1e-6, atol=1e-8)


def swirl(t, q, v, params):
    """Towards the origin and around it, of magnitude r exp(-r^2): without a potential."""
    inwards = -q * jnp.exp(-q @ q)
    return inwards + 1.5 * jnp.stack([-inwards[1], inwards[0]])


SWIRL = jl.System(
    lambda t, q, v, params: 0.5 * v @ v,
    ("x", "y"),
    forces=(jl.GeneralizedForce(swirl, "swirl"),),
)


def test_forces_without_potential_lead_to_rest():
    """From beyond the maximum of |F|, least |F| is outwards; the damped motion spirals inwards."""
    rest = jl.equilibrium(SWIRL, [1.2, 0.3])
    np.testing.assert_allclose(rest.q, 0, atol=4 * EPS)
    assert not rest.conservative
    np.testing.assert_allclose(rest.stiffness, [[1.0, -1.5], [1.5, 1.0]], atol=16 * EPS)


def test_failed_search_states_what_was_tried():
    """A bead that is pushed along a hoop, and a mass in V = -x: neither comes to rest."""
    hoop = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y"),
        forces=(jl.GeneralizedForce(lambda t, q, v, p: jnp.stack([-q[1], q[0]]), "push"),),
        constraints=(jl.Holonomic(lambda t, q, p: q @ q - 1.0, "hoop"),),
    )
    message = "Damped motion on the constraints from q0 and points around it did not"
    with pytest.raises(jl.EquilibriumError, match=message):
        jl.equilibrium(hoop, [1.0, 0.0])
    falling = jl.System(lambda t, q, v, params: 0.5 * v @ v + q[0], ("x",))
    with pytest.raises(jl.EquilibriumError, match="Damped motion from q0 and points around it did"):
        jl.equilibrium(falling, [0.3])


def test_batches_are_searched_in_chunks():
    """Loops that solve equations of thousands of systems at once could hang on CPU."""
    count = 3 * MOST + 1
    searched = jax.vmap(lambda q: jl.equilibrium(SWIRL, q, throw=False).q)
    program = jax.make_jaxpr(searched)(jnp.zeros((count, 2)))
    loops = [eqn for eqn in equations(program) if eqn.primitive.name == "while"]
    solving = [eqn for eqn in loops if any(x.primitive.name == "lu" for x in within(eqn))]
    assert solving
    for eqn in solving:
        assert all(x.aval.shape[:1] != (count,) for x in eqn.outvars)
