"""Transforms reach every valid value and no other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._fit._transforms import Free

SPD = np.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 1.0]])
BODY = np.array([2.0, 0.2, -0.1, 0.4, 1.1, 1.3, 0.9, 0.05, -0.02, 0.03])
CASES = {
    "free": (Free(), np.array([1.0, -2.0])),
    "positive": (jl.transforms.Positive(), np.array([0.3, 40.0])),
    "bounded": (jl.transforms.Bounded(-1.0, 3.0), np.array([-0.9, 2.5])),
    "from below": (jl.transforms.Bounded(2.0, np.inf), np.array([2.1, 9.0])),
    "from above": (jl.transforms.Bounded(-np.inf, 2.0), np.array([1.9, -9.0])),
    "spd": (jl.transforms.SPD(), SPD),
    "inertia": (jl.transforms.Inertia(), SPD),
    "moments": (jl.transforms.Inertia(), np.array([1.0, 1.5, 2.0])),
    "body": (jl.transforms.PseudoInertia(), BODY),
}


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_start_inverts_the_transform(name):
    transform, value = CASES[name]
    u, on_bound = transform.start("x", value)
    assert not on_bound
    assert len(u) == len(transform.entries(value.shape))
    found = transform.value(jnp.asarray(u), value.shape)
    np.testing.assert_allclose(found, value, rtol=0, atol=1e-14 * np.max(np.abs(value)))
    # As many independent directions as variables.
    by_u = jax.jacfwd(lambda u: jnp.ravel(transform.value(u, value.shape)))(jnp.asarray(u))
    assert np.linalg.matrix_rank(by_u) == len(u)


@pytest.mark.parametrize("name", ["spd", "inertia", "moments", "body"])
def test_values_are_valid_for_any_variables(name):
    transform, value = CASES[name]
    count = len(transform.entries(value.shape))
    for u in np.random.default_rng(0).normal(scale=2.0, size=(50, count)):
        found = np.asarray(transform.value(jnp.asarray(u), value.shape))
        if name == "spd":
            assert np.linalg.eigvalsh(found)[0] > 0
        elif name == "body":
            matrix = np.diag(found[4:7])
            matrix[[0, 0, 1], [1, 2, 2]] = matrix[[1, 2, 2], [0, 0, 1]] = found[7:]
            c = found[1:4] / found[0]
            about_c = matrix - found[0] * (c @ c * np.eye(3) - np.outer(c, c))
            moments = np.linalg.eigvalsh(about_c)
            assert found[0] > 0
            assert moments[2] < moments[0] + moments[1]
        else:
            moments = found if found.ndim == 1 else np.linalg.eigvalsh(found)
            assert np.max(moments) < np.sum(moments) - np.max(moments)


@pytest.mark.parametrize(
    ("transform", "value", "message"),
    [
        (jl.transforms.Positive(), 0.0, r"`params0\['x'\]` must be positive"),
        (jl.transforms.Bounded(0.0, 1.0), 1.5, r"lie between its bounds 0 and 1, but it was 1\.5"),
        (
            jl.transforms.SPD(),
            np.diag([1.0, -1.0]),
            r"positive definite, but its smallest eigenvalue was -1",
        ),
        (jl.transforms.SPD(), np.ones(3), r"symmetric matrix, but its shape was \(3,\)"),
        (jl.transforms.Inertia(), np.array([1.0, 1.0, 3.0]), r"triangle inequalities"),
        (jl.transforms.Inertia(), np.ones(4), r"three principal moments"),
        (jl.transforms.PseudoInertia(), np.ones(9), r"ten numbers"),
        (jl.transforms.PseudoInertia(), np.ones(10), r"positive density"),
    ],
)
def test_an_invalid_start_is_named(transform, value, message):
    with pytest.raises(ValueError, match=message):
        transform.start("x", value)


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        (1.0, 0.0, r"in increasing order, but they were 1\.0 and 0\.0"),
        (-np.inf, np.inf, r"include a finite bound"),
    ],
)
def test_crossed_bounds_are_named(lower, upper, message):
    with pytest.raises(ValueError, match=message):
        jl.transforms.Bounded(lower, upper)


def test_start_on_a_bound_is_reported():
    u, on_bound = jl.transforms.Bounded(0.0, 2.0).start("x", 0.0)
    assert on_bound
    assert u.tolist() == [0.0]


def test_values_beyond_a_bound_are_clipped_with_a_slope_back():
    bounded = jl.transforms.Bounded(0.0, 2.0)
    value, slope = jax.value_and_grad(lambda u: bounded.value(u, (3,))[0])(jnp.array([-1.0, 0, 3]))
    assert value == 0.0
    assert slope.tolist() == [1.0, 0.0, 0.0]
    assert bounded.value(jnp.array([-1.0, 0.5, 3.0]), (3,)).tolist() == [0.0, 0.5, 2.0]
