"""Advice on rows that are singular at a state: squares, lengths, dead points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._system._row_advice import advice_on_rows, is_singular, vanishing_rows

VANISHING = {
    "square": (lambda t, q, params: q[1] ** 2, [0.3, 0.0]),
    "nearly": (lambda t, q, params: q[1] ** 2, [0.3, 6e-4]),
    "root of a square": (lambda t, q, params: jnp.sqrt(q[1] ** 2), [0.3, 0.0]),
    "length": (lambda t, q, params: jl.math.norm(q), [0.0, 0.0]),
    "cosine": (lambda t, q, params: 1 - jnp.cos(q[1]), [0.3, 0.0]),
    "negative": (lambda t, q, params: jnp.cos(q[1]) - 1, [0.3, 1e-9]),
    "fourth power": (lambda t, q, params: (q[1] - q[0]) ** 4, [0.2, 0.2]),
    "circle squared": (lambda t, q, params: (q @ q - 1.0) ** 2, [0.6, 0.8]),
}
REGULAR = {
    "itself": (lambda t, q, params: q[1], [0.3, 0.0]),
    "cube": (lambda t, q, params: q[1] ** 3, [0.3, 0.0]),
    "circle": (lambda t, q, params: q @ q - 1.0, [0.6, 0.8]),
    "distance": (lambda t, q, params: jl.math.norm(q) - 1.0, [0.6, 0.8]),
    "lines that cross": (lambda t, q, params: q[0] * q[1], [0.0, 0.0]),
    "open": (lambda t, q, params: q[1] ** 2 - 1.0, [0.3, 0.0]),
    "short rod far away": (lambda t, q, params: (q[1] - q[0]) ** 2 - 0.25, [600.0, 600.5]),
    "short rod very far away": (lambda t, q, params: (q[1] - q[0]) ** 2 - 0.01, [1e4, 1e4 + 0.1]),
    "nothing": (lambda t, q, params: 0.0 * q[0], [0.3, 0.0]),
}


def system(row):
    rod = jl.Holonomic(row, "rod")
    return jl.System(lambda t, q, v, p: 0.5 * v @ v - q[1], ("x", "y"), constraints=(rod,))


@pytest.mark.parametrize("name", VANISHING)
def test_rows_without_a_gradient_on_the_constraint_are_named(name):
    row, q = VANISHING[name]
    assert vanishing_rows(system(row), None, 0.0, q) == ["rod"]


@pytest.mark.parametrize("name", REGULAR)
def test_regular_rows_are_not_named(name):
    row, q = REGULAR[name]
    assert vanishing_rows(system(row), None, 0.0, q) == []


def folding(t, q, params):
    """Two links of equal length whose end is at the origin: folded, as at (0, pi)."""
    return jnp.stack([jnp.sin(q[0]) + jnp.sin(q[1]), jnp.cos(q[0]) + jnp.cos(q[1])])


def test_dead_points_are_singular_and_redundant_rows_are_not():
    pair = system(folding)
    assert is_singular(pair, None, 0.0, [0.4, 0.4 + np.pi])
    assert "a dead point" in advice_on_rows(pair, None, 0.0, [0.4, 0.4 + np.pi])
    assert not is_singular(pair, None, 0.0, [0.4, 2.0])
    twice = system(lambda t, q, params: jnp.stack([q[1], 2.0 * q[1]]))
    assert not is_singular(twice, None, 0.0, [0.3, 0.0])
    assert advice_on_rows(twice, None, 0.0, [0.3, 0.0]) == ""


ADVICE = r"'rod' vanishes wherever the row holds, as for y\*\*2.* Write the quantity itself, y"


@pytest.mark.full
def test_all_errors_advise_on_vanishing_rows():
    row, q = VANISHING["square"]
    given = system(row)
    with pytest.raises(jl.SimulationError, match=ADVICE):
        jl.simulate(given, q, [0.0, 0.0], [0.0, 1.0], dt=0.5, method="bosh3")
    with pytest.raises(jl.EquilibriumError, match=ADVICE):
        jl.equilibrium(given, q)
    with pytest.raises(
        ValueError, match=r"constraint 'rod' must have a nonzero gradient .* Write the qu"
    ):
        given.check(q, [0.0, 0.0])
    rooted, q = VANISHING["root of a square"]
    with pytest.raises(jl.AssemblyError, match=ADVICE):
        jl.assemble(system(rooted), q, [0.0, 0.0])


def test_messages_under_derivatives_advise_on_rows():
    row, _ = VANISHING["square"]

    def end(x):
        start = jnp.stack([x, 0.0 * x])
        options = {"dt": 0.5, "method": "bosh3", "throw": False}
        motion = jl.simulate(system(row), start, [0.0, 0.0], [0.0, 1.0], **options)
        assert "Write the quantity itself" in motion.message()
        return motion.q[0, 0]

    assert jax.jvp(end, (0.3,), (1.0,))[0] == 0.3


def test_rows_of_nan_are_not_left_out():
    """The gradient of sqrt(y^2) is NaN at 0: so are all results."""
    row, q = VANISHING["root of a square"]
    a = system(row).acceleration(q, [0.0, 0.0])
    assert np.isnan(a).all()
    motion = jl.simulate(
        system(row), q, [0.0, 0.0], [0.0, 1.0], dt=0.5, method="bosh3", throw=False
    )
    assert motion.status == jl.Status.nonfinite
