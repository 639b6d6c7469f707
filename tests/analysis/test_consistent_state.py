"""States that do not satisfy the constraints, and places where rows become dependent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

ROD = jl.System(
    lambda t, q, v, p: 0.5 * v @ v - 9.81 * q[1],
    ("x", "y"),
    constraints=(jl.Holonomic(lambda t, q, p: q @ q - 0.49, "rod"),),
)


@pytest.mark.parametrize(
    ("q", "v", "text"),
    [
        ([0.0, -0.9], [0.0, 0.0], r"satisfy the constraints.*phi of 'rod' was 0\.09.*jl.assemble"),
        ([0.0, -0.7], [0.1, 0.2], r"satisfy the constraints.*A v \+ b of 'rod' was 0\.1"),
    ],
)
def test_states_off_the_constraints_are_refused(q, v, text):
    with pytest.raises(ValueError, match=text):
        jl.linearize(ROD, q, v)


def loop(t, q, p):
    """A four-bar linkage with cranks of length 1, a coupler and a base of length 2."""
    a, b, c = q
    return jnp.stack(
        [
            jnp.cos(a) + 2.0 * jnp.cos(b) - jnp.cos(c) - 2.0,
            jnp.sin(a) + 2.0 * jnp.sin(b) - jnp.sin(c),
        ]
    )


TURN = 2.0 * np.pi  # whose sine is rounding, not 0


@pytest.mark.full
@pytest.mark.parametrize(
    ("phi", "places"),
    [
        (loop, [[0.0, 0.0, 0.0], [0.0, TURN, 0.0], [TURN, TURN, 0.0], [np.pi, 0.0, np.pi]]),
        (lambda t, q, p: q[1] ** 2 - q[0] ** 3, [[0.0, 0.0, 0.0]]),
        (lambda t, q, p: 1.0 - jnp.cos(q[0]) - q[1] ** 2, [[0.0, 0.0, 0.3], [TURN, 0.0, 0.0]]),
    ],
    ids=["flat linkage", "cusp", "cone"],
)
def test_places_beside_which_more_rows_are_independent_are_refused(phi, places):
    row = jl.Holonomic(phi, "row")
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("a", "b", "c"), constraints=(row,))
    for q in places:
        with pytest.raises(ValueError, match=r"near which the rows have one rank.*a change point"):
            jl.linearize(system, q, np.zeros(3))


@pytest.mark.full
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_rows_that_are_rounding_everywhere_hold_nothing(angle):
    """sin^2 + cos^2 - 1 has a gradient of 1e-17 at some angles."""

    def rows(t, q, p):
        return jnp.stack([q[0] - q[1], jnp.sin(q[2]) ** 2 + jnp.cos(q[2]) ** 2 - 1.0])

    held = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - 0.5 * q[0] ** 2 - 2.0 * q[2] ** 2,
        ("a", "b", "c"),
        constraints=(jl.Holonomic(rows, "rows"),),
    )
    names = ("b", "c", "b'", "c'")
    q = np.array([0.3, 0.3, angle])
    linear = jl.linearize(held, q, np.zeros(3))
    assert linear.states == names
    traced = jax.jit(lambda q: jl.linearize(held, q, np.zeros(3), independent=names))(q)
    for found in (linear, traced):
        np.testing.assert_allclose(np.diagonal(found.A[2:, :2]), [-0.5, -4.0], rtol=1e-14)


@pytest.mark.full
def test_a_dead_point_of_one_crank_is_no_such_place():
    """Crank and coupler in line: the other crank rests, the first moves on."""
    row = jl.Holonomic(lambda t, q, p: loop(t, q, p) - jnp.array([-0.5, 0.0]), "row")
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("a", "b", "c"), constraints=(row,))
    # The tip of the coupler is 1 from the pivot of the crank, and 1 from the other one, at 1.5.
    angle = np.arccos(0.75)
    tip = np.array([np.cos(angle), -np.sin(angle)])
    crank, coupler = np.arctan2(-tip[1], -tip[0]), np.arctan2(tip[1], tip[0])
    q = np.array([crank, coupler, np.arctan2(tip[1], tip[0] - 1.5)])
    linear = jl.linearize(system, q, np.zeros(3))
    assert linear.states == ("a", "a'")
    with pytest.raises(ValueError, match=r"a did not follow from \['c'\]"):
        jl.linearize(system, q, np.zeros(3), independent=("c",))
