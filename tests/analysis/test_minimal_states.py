"""Independent coordinates and velocities: by names, under tracing, dropped ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

ROD = jl.System(
    lambda t, q, v, p: 0.5 * v @ v - 9.81 * q[1],
    ("x", "y"),
    constraints=(jl.Holonomic(lambda t, q, p: q @ q - p**2, "rod"),),
)
EDGE = jl.System(
    lambda t, q, v, p: 0.5 * v @ v,
    ("x", "y"),
    constraints=(jl.Pfaffian(lambda t, q, v, p: v[1] - q[0] * v[0], "edge"),),
)
LOW = jnp.array([0.0, -0.7]), jnp.zeros(2), 0.7
SIDE = jnp.array([0.42, -0.56]), jnp.zeros(2), 0.7


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (("y", "y'"), r"determine all coordinates.*x did not follow from \['y'\].*\['x'\]"),
        (("x", "y'"), r"determine all velocities.*x' did not follow from \[\"y'\"\]"),
        (("x", "y"), r"name 1 coordinates, as the rank of the rows is 1.*For example \['x'\]"),
        (("x", "x'", "y'"), r"name 1 velocities, as the rank of the rows is 1"),
        (("x", "z'"), r"must name coordinates or.*one was \"z'\""),
        ("x", r"must be a sequence of names"),
    ],
)
def test_names_that_do_not_determine_the_others(names, text):
    with pytest.raises(ValueError, match=text):
        jl.linearize(ROD, *LOW, independent=names)


def test_names_without_rows_must_be_all_of_them():
    free = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x", "y"))
    text = r"name all coordinates, as no row determines one of them, but they were \['x'\]"
    with pytest.raises(ValueError, match=text):
        jl.linearize(free, *np.zeros((2, 2)), independent=("x",))


def test_velocities_alone_are_named_where_no_row_determines_coordinates():
    linear = jl.linearize(EDGE, [0.6, 0.5], [1.0, 0.6], independent=("x'",))
    assert linear.states == ("x", "y", "x'")
    # (1 + x^2) x'' = -x x'^2
    x, s = 0.6, 1.0
    slopes = [-(s**2) * (1.0 - x**2) / (1.0 + x**2) ** 2, 0.0, -2.0 * x * s / (1.0 + x**2)]
    np.testing.assert_allclose(linear.A[2], slopes, atol=1e-15)


def test_traced_constraints_need_names():
    text = r"must name the independent coordinates and velocities if t, q or params are traced"
    for names in (None, ("x",)):
        with pytest.raises(ValueError, match=text):
            jax.jit(lambda p, names=names: jl.linearize(ROD, *LOW[:2], p, independent=names).A)(0.7)
    with pytest.raises(ValueError, match=r"name 1 coordinates or more, as 1 rows determine"):
        jax.jit(lambda p: jl.linearize(ROD, *LOW[:2], p, independent=("x'",)).A)(0.7)


@pytest.mark.full
def test_traced_states_that_would_be_refused_give_nan():
    """Off the constraints, with too many states, and with some that do not determine the others."""

    def of(*names):
        return jax.jit(lambda q, p: jl.linearize(ROD, q, jnp.zeros(2), p, independent=names).A)

    fine = of("x", "x'")
    q, _, p = SIDE
    assert np.all(np.isfinite(fine(q, p)))
    assert np.all(np.isnan(fine(1.1 * q, p)))
    for names in (("x", "y", "x'"), ("x", "x'", "y'")):
        assert np.any(np.isnan(of(*names)(q, p))), names
    assert np.any(~np.isfinite(of("y", "y'")(LOW[0], p)))


def test_names_of_arrays():
    ball = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - q[2] ** 2,
        {"r": (2,), "z": ()},
    )
    linear = jl.linearize(ball, *np.zeros((2, 3)), drop=("r",))
    assert linear.states == ("z", "r[0]'", "r[1]'", "z'")
    assert jl.linearize(ball, *np.zeros((2, 3)), independent=("r", "z")).A.shape == (6, 6)
