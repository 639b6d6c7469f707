"""States that do not satisfy the constraints, and places where rows become dependent."""

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


@pytest.mark.parametrize(
    "phi",
    [
        loop,
        lambda t, q, p: q[1] ** 2 - q[0] ** 3,
        lambda t, q, p: q[0] ** 2 + q[1] ** 2 - q[2] ** 2,
    ],
    ids=["flat linkage", "cusp", "cone"],
)
def test_places_beside_which_more_rows_are_independent_are_refused(phi):
    row = jl.Holonomic(phi, "row")
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("a", "b", "c"), constraints=(row,))
    with pytest.raises(ValueError, match=r"near which the rows have one rank.*a change point"):
        jl.linearize(system, np.zeros(3), np.zeros(3))


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
