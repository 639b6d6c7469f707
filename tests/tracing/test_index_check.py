"""Indices beyond the coordinates are refused, under both lowerings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


@pytest.mark.parametrize("lowering", ["auto", "array"])
@pytest.mark.parametrize(
    ("read", "named"),
    [
        (lambda q: q[1], r"q\[1\]"),
        (lambda q: q[-2], r"q\[-2\]"),
        (lambda q: q[np.array([0, 3])].sum(), r"q\[3\]"),
        (jax.jit(lambda q: q[2] * q[0]), r"q\[2\]"),
    ],
)
def test_an_index_beyond_the_coordinates_is_refused(lowering, read, named):
    """JAX would read the nearest element instead: that is another system."""
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - read(q) ** 2, ("x",), lowering=lowering)
    match = (
        rf"^`lagrangian` and `forces` must take indices from -1 to 0 of q, .* but {named} was taken"
    )
    with pytest.raises(ValueError, match=match):
        jl.simulate(system, [1.0], [0.0], [0.0, 1.0])


def test_an_index_beyond_the_velocities_is_refused():
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v + v[2] ** 2, ("x", "y"))
    with pytest.raises(ValueError, match=r"from -2 to 1 of v, which has 2 entries, but v\[2\]"):
        system.acceleration([1.0, 0.0], [0.0, 0.0])


@pytest.mark.parametrize("how", [{"mode": "clip"}, {"mode": "fill", "fill_value": 7.0}])
def test_stated_index_modes_are_accepted(how):
    read = lambda q: jnp.take(q, jnp.array([0, 5]), **how) @ q  # noqa: E731
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - read(q), ("x", "y"))
    assert jl.simulate(system, [1.0, 0.5], [0.0, 0.0], [0.0, 0.1]).ok


def kinetic(t, q, v, p):
    return 0.5 * v @ v


@pytest.mark.parametrize(
    ("declared", "match"),
    [
        (
            {"constraints": (jl.Holonomic(lambda t, q, p: q[0] + q[2] - 1.0, "rail"),)},
            r"constraint 'rail' must take indices from -2 to 1 of q.* but q\[2\] was taken",
        ),
        (
            {"constraints": (jl.Pfaffian(lambda t, q, v, p: v[0] - v[-3], ("blade",)),)},
            r"constraint \('blade',\) must take indices from -2 to 1 of v.* but v\[-3\] was taken",
        ),
        (
            {"quasi": jl.QuasiVelocities(lambda t, q, v, p: v * q[4], ("a", "b"))},
            r"`QuasiVelocities` must take indices from -2 to 1 of q.* but q\[4\] was taken",
        ),
        (
            {"quasi": jl.QuasiVelocities(kinematics=lambda t, q, u, p: u * u[3], names=("a", "b"))},
            r"`QuasiVelocities` must take indices from -2 to 1 of u.* but u\[3\] was taken",
        ),
    ],
    ids=["holonomic", "pfaffian", "U", "kinematics"],
)
def test_an_index_beyond_is_refused_in_rows_and_kinematics(declared, match):
    system = jl.System(kinetic, ("x", "y"), **declared)
    with pytest.raises(ValueError, match=match):
        system._rows(None, jnp.float64)
