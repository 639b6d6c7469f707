"""Linear maps: which of their forms is used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._core._linear_map import LinearMap, Many, linear

USED = []  # names of the programs that were traced, in their order


def product(name):
    """x -> r x, which is its own transpose."""

    def of(r, x):
        USED.append(name)
        return r * x

    return of


def form(name, **more):
    program = product(name)
    return LinearMap(program, program, product(f"{name}, plain"), **more)


MAP = form(
    "alone",
    in_lanes=form("lanes"),
    many=Many(form("many", at_once=4), lambda count: count >= 6, work=lambda r: -r),
)


def used(function, *args):
    USED.clear()
    return function(*args), set(USED)


def both(r, x):
    """r x and its gradient in x."""
    y, transposed = jax.vjp(lambda x: linear(MAP, r, x), x)
    return y, transposed(jnp.ones_like(y))[0]


@pytest.mark.parametrize(("count", "name"), [(5, "lanes"), (6, "many"), (9, "many")])
def test_many_have_their_own_form(count, name):
    """Also where the program is transposed, and where the derivative in x is the map again."""
    r, x = jnp.arange(1.0, 1.0 + count), jnp.linspace(0.0, 1.0, count)
    (y, bar), names = used(jax.jit(jax.vmap(both)), r, x)
    np.testing.assert_array_equal(y, r * x)
    np.testing.assert_array_equal(bar, r)
    assert name in names
    assert not names & ({"lanes", "many"} - {name})
    # Several x for one r are not many r.
    assert "many" not in used(jax.vmap(lambda x: linear(MAP, 2.0, x)), x)[1]


def test_derivatives_of_the_matrix_do_not_use_the_form_for_many():
    """Of a batch, and of the transpose of a batch; forward and reverse."""
    r, x = jnp.arange(1.0, 8.0), jnp.linspace(0.0, 1.0, 7)
    batch = jax.vmap(lambda r, x: linear(MAP, r, x))
    (y, dot), names = used(lambda r: jax.jvp(lambda r: batch(r, x), (r,), (r,)), r)
    np.testing.assert_array_equal(y, r * x)
    np.testing.assert_array_equal(dot, r * x)
    assert "lanes" in names
    gradient = jax.grad(lambda x, r: jnp.sum(batch(r, x)))
    mixed = jax.jit(jax.jacfwd(gradient, 1))(x, r)
    np.testing.assert_array_equal(mixed, np.eye(7))
    np.testing.assert_array_equal(jax.jacrev(gradient, 1)(x, r), np.eye(7))
