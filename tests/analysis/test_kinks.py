"""Kinks and jumps: one-sided derivatives of functions, names of declared functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._analysis._kinks import bends


def guarded_sine(limit):
    """sin(x)/x with 1 in its place near 0, whose second derivative is then 0 in place of -1/3."""

    def of(x):
        small = jnp.abs(x) <= limit
        safe = jnp.where(small, 1.0, x)
        return jnp.where(small, 1.0, jnp.sin(safe) / safe)

    return of


def slope(potential):
    return lambda z: -jax.grad(lambda z: jnp.sum(potential(z)))(z)


SMOOTH = {
    "quadratic drag": (lambda z: -jnp.abs(z) * z, [0.0]),
    "onset with its slope": (lambda z: -(jnp.maximum(z - 0.1, 0.0) ** 2), [0.1]),
    "contact at rest": (lambda z: 1e7 * jnp.maximum(0.0, -z), [-1e-6]),
    "gap": (lambda z: jnp.maximum(0.0, z[0] - z[1] - 5e-4), [1000.0, 1000.0]),
    "cancellation": (lambda z: 1e6 * (z[0] - z[1] - 0.3) - z[1] * jnp.abs(z[1]), [100.3, 100.0]),
    "sine over angle, by code that is kept": (slope(jl.math.sinc), [0.0]),
    "sine over angle, rounded beside 0": (slope(jnp.sinc), [0.0]),
    "equal branches": (
        lambda z: jnp.where(z > 1.0, -jnp.sin(z) * jnp.cos(z), -jnp.sin(2.0 * z) / 2.0),
        [1.0],
    ),
    "maximum of smooth functions away from ties": (slope(lambda z: jnp.max(z) ** 2), [0.3, 0.1]),
}
BENT = {
    "jump beside a large load": (lambda z: 1e6 - 0.3 * jnp.sign(z), [0.0]),
    "domain that ends nearby": (
        lambda z: jnp.stack([jnp.sign(z[0]), -jnp.sqrt(z[1])]),
        [0.0, 1e-6],
    ),
    "cut of an angle": (lambda z: jnp.arctan2(z[1], z[0]), [-1.0, 0.0]),
    "Coulomb friction": (lambda z: -0.3 * jnp.sign(z), [0.0]),
    "stop": (lambda z: -jnp.maximum(z - 0.1, 0.0), [0.1]),
    "jump": (lambda z: 2.0 + jnp.sign(z - 1.0), [1.0]),
    "stiff neighbour": (lambda z: 1e12 * z[0] - jnp.maximum(z[1], 0.0), [0.0, 0.0]),
    "quadrant": (lambda z: jnp.where(z[0] * z[1] > 0.0, z[0] + z[1], 0.0), [0.0, 0.0]),
    "guard of one point": (slope(guarded_sine(0.0)), [0.0]),
    "guard of an interval": (slope(guarded_sine(1e-8)), [0.0]),
    "ties of code that is smooth": (slope(lambda z: jnp.max(z) * jnp.min(z)), [0.1, 0.1]),
    "two springs": (slope(lambda z: jax.nn.relu(z) ** 2 + jax.nn.relu(-z) ** 2), [0.0]),
}


def bent(function, z, dtype=float):
    """Whether the function has a kink at z along an axis, or along random directions."""
    size = len(z)
    mixed = np.random.default_rng(0).uniform(-1.0, 1.0, (size, 2))
    directions = jnp.asarray(np.concatenate([np.eye(size), mixed], axis=1), dtype)
    program = jax.jit(lambda z: bends(lambda z: jnp.atleast_1d(function(z)), z, directions))
    return bool(np.any(program(jnp.array(z, dtype))))


@pytest.mark.parametrize("name", SMOOTH)
def test_derivatives_that_exist_are_not_refused(name):
    function, z = SMOOTH[name]
    assert not bent(function, z)


@pytest.mark.parametrize("name", BENT)
def test_kinks_jumps_and_guards_of_single_points_are_found(name):
    function, z = BENT[name]
    assert bent(function, z)


@pytest.mark.parametrize(
    ("cases", "name"), [(SMOOTH, "onset with its slope"), (BENT, "stop"), (BENT, "jump")]
)
def test_in_single_precision(cases, name):
    function, z = cases[name]
    assert bent(function, z, np.float32) == (cases is BENT)


def force(function):
    return {"forces": [jl.GeneralizedForce(function, "bump")]}


@pytest.mark.full
@pytest.mark.parametrize(
    ("kinds", "change", "named"),
    [
        (force(lambda t, q, v, p: -0.3 * jnp.sign(v)), {}, r"force 'bump' \(.*test_kinks.py"),
        (
            force(lambda t, q, v, p, i: jnp.abs(i["u"]) * jnp.ones(2)),
            {"inputs": ("u",)},
            r"force 'bump' \(.*test_kinks.py",
        ),
        (
            force(lambda t, q, v, p, i: i["u"] * jnp.ones(2)),
            {"inputs": {"u": jl.Feedback(lambda t, q, v, p: jnp.clip(q[0], 0.0, 1.0))}},
            r"force 'bump', input 'u'",
        ),
        (
            force(lambda t, q, v, p: v * jnp.arctan2(q[1], q[0] - 1.0)),
            {"v": [0.5, 0.0]},
            "force 'bump'",
        ),
        (
            force(lambda t, q, v, p: (q + 1.0).astype(int).astype(float)),
            {},
            r"force 'bump' \(.*test_kinks.py",
        ),
        (force(lambda t, q, v, p: jax.lax.top_k(q, 2)[0]), {}, "force 'bump'"),
        ({}, {"outputs": {"gap": lambda t, q, v, p: jnp.abs(q[0])}}, r"output 'gap' \(.*test_kin"),
        (
            {
                "constraints": (
                    jl.Holonomic(lambda t, q, p: q[1] - jnp.maximum(q[0], 0.0) ** 2, "wire"),
                ),
            },
            {},
            r"constraint 'wire' \(.*test_kinks.py",
        ),
        ({"L": lambda t, q, v, p: (1.0 + jnp.abs(q[0])) * v @ v - q[0]}, {}, "the Lagrangian"),
    ],
)
def test_the_function_and_its_line_are_named(kinds, change, named):
    """Kinks of forces in inputs, of rows and inertia at rest: none shows in the values there."""
    kinds = dict(kinds)
    lagrangian = kinds.pop("L", lambda t, q, v, p: 0.5 * v @ v - q[1])
    system = jl.System(lagrangian, ("x", "y"), **kinds)
    at = {"q": [0.0, 0.0], "v": [0.0, 0.0]} | change
    with pytest.raises(ValueError, match=rf"have derivatives.*a kink or jump of {named}"):
        jl.linearize(system, **at)


def test_a_kink_across_the_constraints_is_none():
    """The state cannot leave the row on which |y| has its kink."""
    lagrangian = lambda t, q, v, p: 0.5 * v @ v - jnp.abs(q[1]) - q[0] ** 2  # noqa: E731
    row = jl.Holonomic(lambda t, q, p: q[1], "floor")
    linear = jl.linearize(jl.System(lagrangian, ("x", "y"), constraints=(row,)), *np.zeros((2, 2)))
    np.testing.assert_allclose(linear.A, [[0.0, 1.0], [-2.0, 0.0]])


@pytest.mark.full
def test_friction_by_a_multiplier_at_rest():
    """The force is 0 wherever the multiplier is."""

    def friction(t, q, v, p, lam):
        return jnp.stack([-0.3 * lam["floor"] * jnp.sign(v[0]), 0.0 * q[0]])

    row = jl.Holonomic(lambda t, q, p: q[1], "floor")
    forces = [jl.GeneralizedForce(friction, "friction", reaction=True)]
    block = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - q[1], ("x", "y"), forces=forces, constraints=(row,)
    )
    with pytest.raises(ValueError, match=r"a kink or jump of force 'friction' \(.*test_kinks"):
        jl.linearize(block, [0.0, 0.0], [0.0, 0.0])
    assert np.all(np.isfinite(jl.linearize(block, [0.0, 0.0], [1.0, 0.0]).A))


@pytest.mark.full
def test_rounding_of_the_solve_is_no_kink():
    """Links of unlike masses with quadratic drag at rest: M has a condition number of 1e7."""
    masses = np.array([1e-3, 1e-3, 1e-3, 1e3])

    def lagrangian(t, q, v, p):
        angles, rates = jnp.cumsum(q), jnp.cumsum(v)
        x = jnp.cumsum(rates * jnp.cos(angles)), jnp.cumsum(rates * jnp.sin(angles))
        height = -jnp.cumsum(jnp.cos(angles))
        return 0.5 * masses @ (x[0] ** 2 + x[1] ** 2) - 9.81 * masses @ height

    drag = force(lambda t, q, v, p: -0.1 * v * jnp.abs(v))
    chain = jl.System(lagrangian, {"angle": (4,)}, lowering="array", **drag)
    assert np.all(np.isfinite(jl.linearize(chain, np.zeros(4), np.zeros(4)).A))
