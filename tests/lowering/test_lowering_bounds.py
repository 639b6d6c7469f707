"""What the scalar program loses of L as it is written: by error bounds, and against 50 digits."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from _families import mostly_full
from _running_error import U, carried

import jaxlag as jl
from bench._scenes import SCENES
from jaxlag._lowering import ArrayTerms
from jaxlag._lowering._derive import derive
from jaxlag._lowering._forms import mass_matrix, momentum_form
from jaxlag._lowering._key import key_of
from jaxlag._lowering._read import read_scene
from jaxlag._lowering._solve import solve
from systems._catalogue import ENTRIES

WORSE = 4.0  # the bound of the program may be so many times that of L as it is written


def bead(t, q, v, p):
    """On r = R sin(theta)^2, turning about the axis, from its position."""

    def position(q):
        s, c = jnp.sin(q[0]), jnp.cos(q[0])
        return s**2 * jnp.stack([s * jnp.cos(q[1]), s * jnp.sin(q[1]), c])

    velocity = jax.jvp(position, (q,), (v,))[1]
    return 0.5 * p * velocity @ velocity


def quartic(t, q, v, p):
    return 0.5 * v @ v - (q[0] - p[0]) ** 4 - (q[0] - p[1]) ** 4 - (q[1] - q[0] - p[0]) ** 4


def lennard_jones(t, q, v, p):
    r = jnp.sqrt((q[1] - q[0]) ** 2)
    return 0.5 * p[0] * v @ v - 4.0 * p[1] * ((p[0] / r) ** 12 - (p[0] / r) ** 6)


HARD = {
    "bead": (bead, 2, 2.0),
    "quartic": (quartic, 2, np.array([1e6, 1e6 + 0.25])),
    "lennard_jones": (lennard_jones, 2, np.array([0.7, 3.0])),
}


def case(name):
    if name in HARD:
        L, n, params = HARD[name]
        return jl.System(L, {"q": (n,)}), params
    if name in SCENES:
        scene = SCENES[name]
        return jl.System(scene.lagrangian, {"q": (len(scene.q0),)}), scene.params
    entry = ENTRIES[name]
    # What stands beside L is the same in both.
    return jl.System(entry.system.lagrangian, {"q": (entry.system.size,)}), entry.example.params


FREE = [name for name, entry in ENTRIES.items() if entry.system.written_in == "v"]


def both(system, params):
    """Accelerations from L as it is written, and as the scalar program has them."""
    terms = ArrayTerms(system.lagrangian, ())
    scene = read_scene(key_of(terms, jnp.zeros(system.size), params, {}, None))
    graph = scene.graph
    M = mass_matrix(graph, scene.lagrangian, scene.v)
    right = [graph.scale(x, -1.0) for x in momentum_form(scene, scene.lagrangian)]
    return solve(graph, M, right, 2 * U), derive(scene, 2 * U, None).accelerations


def states(n):
    """(q, v): anywhere, small, far, nearly aligned, fast."""
    rng = np.random.default_rng(0)
    anywhere = lambda: rng.uniform(-1.5, 1.5, n)  # noqa: E731
    yield anywhere(), anywhere()
    for size in (1e-2, 1e-4, 1e-6):
        yield size * rng.uniform(0.5, 1.5, n), size * anywhere()
        yield size * rng.uniform(0.5, 1.5, n), anywhere()
    for size in (1e3, 1e6, 1e8):
        yield size * rng.uniform(0.5, 1.5, n), anywhere()
    for size in (1e-3, 1e-6):
        yield 0.7 + size * rng.uniform(-1, 1, n), anywhere()
    yield anywhere(), 1e6 * anywhere()


def values(params, q, v):
    flat = [np.ravel(x) for x in jax.tree.leaves(params) if np.asarray(x).dtype.kind == "f"]
    given = {("t", 0): 0.3, ("sense", 0): 1.0}
    for name, row in (("q", q), ("v", v), ("params", np.concatenate([*flat, []]))):
        given |= {(name, i): float(x) for i, x in enumerate(row)}
    return given


def worst(written, program, params, n):
    """(bound over bound, error over bound, difference of exact values over both), the largest."""
    ratios, errors, apart = [0.0], [0.0], [0.0]
    for q, v in states(n):
        given = values(params, q, v)
        for left, right in zip(carried(written, given), carried(program, given), strict=True):
            if not np.isfinite(left.value) or not mpmath.isfinite(left.exact):
                continue
            tiny = U * abs(left.value) + 1e-300
            ratios.append(right.bound / (left.bound + tiny))
            errors.append(abs(float(right.value - right.exact)) / (right.bound + 1e-300))
            apart.append(float(abs(right.exact - left.exact)) / (left.bound + right.bound + tiny))
    return max(ratios), max(errors), max(apart)


@pytest.mark.parametrize(
    "name",
    mostly_full([*HARD, *SCENES, *FREE], "bead", "quartic", "top", "double_pendulum_positions"),
)
def test_no_form_is_worse_than_the_lagrangian_as_it_is_written(name):
    system, params = case(name)
    ratio, error, apart = worst(*both(system, params), params, system.size)
    assert ratio <= WORSE
    assert error <= 1.0
    assert apart <= 1.0  # numbers written in L are multiplied in double precision


def test_what_loses_digits_is_found():
    """Multiplied out, (q - a)^4 loses all of them: the bound says so, and so does the error."""

    def multiplied(t, q, v, p):
        a = p[0]
        fourth = q[0] ** 4 - 4 * a * q[0] ** 3 + 6 * a**2 * q[0] ** 2 - 4 * a**3 * q[0] + a**4
        return 0.5 * v @ v - fourth

    def written(t, q, v, p):
        return 0.5 * v @ v - (q[0] - p[0]) ** 4

    params = np.array([1e6])
    given = values(params, [1e6 + 0.5], [0.0])
    good, bad = (
        carried(both(jl.System(L, ("x",)), params)[0], given)[0] for L in (written, multiplied)
    )
    assert abs(good.exact - bad.exact) < 1e-20
    assert bad.bound > 1e3 > WORSE * good.bound
    assert abs(float(bad.value - bad.exact)) > 1e-3
