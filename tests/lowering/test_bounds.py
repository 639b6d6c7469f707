"""Accuracy of the scalar program relative to L as written: bounds, 50 digits, range."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from _families import mostly_full
from _running_error import U, evaluate_with_bounds, rounded

import jaxlag as jl
from bench._problems.scenes import SCENES
from jaxlag._lowering import ArrayTerms
from jaxlag._lowering._graph._eliminate import solve
from jaxlag._lowering._symbolic._bias_forms import mass_matrix, momentum_form
from jaxlag._lowering._symbolic._derive import derivation, derive
from jaxlag._lowering._symbolic._program_key import key_of
from jaxlag._lowering._symbolic._read_system import read_scene
from systems.catalogue import ENTRIES

WORSE = 4.0  # largest ratio of the error bound of the program to that of L as written


def bead(t, q, v, p):
    """On r = R sin(theta)^2, rotating about the axis, by its position."""

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
    # Forces and constraints are the same in both.
    return jl.System(entry.system.lagrangian, {"q": (entry.system.size,)}), entry.example.params


FREE = [name for name, entry in ENTRIES.items() if entry.system.written_in == "v"]


def both(system, params, dtype=np.float64):
    """Accelerations from L as written, and from the scalar program."""
    terms, eps = ArrayTerms(system.lagrangian, ()), float(np.finfo(dtype).eps)
    params = jax.tree.map(lambda x: np.asarray(x, dtype) if is_float(x) else x, params)
    scene = read_scene(key_of(terms, jnp.zeros(system.size, dtype), params, {}, None))
    graph = scene.graph
    M = mass_matrix(graph, scene.lagrangian, scene.v)
    right = [graph.scale(x, -1.0) for x in momentum_form(scene, scene.lagrangian)]
    derived, _ = derive(scene, derivation(scene, None), eps)
    return solve(graph, M, right, eps), derived.accelerations


def is_float(x):
    return np.asarray(x).dtype.kind == "f"


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
    flat = [np.ravel(x) for x in jax.tree.leaves(params) if is_float(x)]
    given = {("t", 0): 0.3, ("sense", 0): 1.0}
    for name, vector in (("q", q), ("v", v), ("params", np.concatenate([*flat, []]))):
        given |= {(name, i): float(x) for i, x in enumerate(vector)}
    return given


def worst(written, program, params, n):
    """Largest ratios: of the bounds, error to bound, exact difference to the sum of bounds."""
    ratios, errors, apart = [0.0], [0.0], [0.0]
    for q, v in states(n):
        given = values(params, q, v)
        for left, right in zip(
            evaluate_with_bounds(written, given), evaluate_with_bounds(program, given), strict=True
        ):
            if not np.isfinite(left.value) or not mpmath.isfinite(left.exact):
                continue
            tiny = U * abs(left.value) + 1e-300
            ratios.append(right.bound / (left.bound + tiny))
            errors.append(abs(float(right.value - right.exact)) / (right.bound + 1e-300))
            apart.append(float(abs(right.exact - left.exact)) / (left.bound + right.bound + tiny))
    return max(ratios), max(errors), max(apart)


@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    mostly_full([*HARD, *SCENES, *FREE], "bead", "quartic", "top", "double_pendulum_positions"),
)
def test_error_bounds_are_not_worse_than_those_of_the_lagrangian(name):
    system, params = case(name)
    ratio, error, apart = worst(*both(system, params), params, system.size)
    assert ratio <= WORSE
    assert error <= 1.0
    assert apart <= 1.0  # literals in L are multiplied in double precision


def test_error_bounds_detect_lost_digits():
    """Expanded, (q - a)^4 loses all digits: both the bound and the error show it."""

    def multiplied(t, q, v, p):
        a = p[0]
        fourth = q[0] ** 4 - 4 * a * q[0] ** 3 + 6 * a**2 * q[0] ** 2 - 4 * a**3 * q[0] + a**4
        return 0.5 * v @ v - fourth

    def written(t, q, v, p):
        return 0.5 * v @ v - (q[0] - p[0]) ** 4

    params = np.array([1e6])
    given = values(params, [1e6 + 0.5], [0.0])
    better, worse = (
        evaluate_with_bounds(both(jl.System(L, ("x",)), params)[0], given)[0]
        for L in (written, multiplied)
    )
    assert abs(better.exact - worse.exact) < 1e-20
    assert worse.bound > 1e3 > WORSE * better.bound
    assert abs(float(worse.value - worse.exact)) > 1e-3


SLACK = 10.0  # times the change by rounding of the inputs; measured: at most 2.5
# L contains arrays of double precision: then there is no program in single precision.
MIXED = ("rotating_body_on_frame", "knife_edge_vehicle", "rotating_cylinder_disk")
SINGLE = [name for name in (*HARD, *SCENES, *FREE) if name not in MIXED]


def scaled(params, n):
    """(params, q, v) of all magnitudes, in single precision."""
    rng = np.random.default_rng(0)
    size = lambda: 10.0 ** rng.uniform(-4, 4)  # noqa: E731
    for _ in range(12):
        several = jax.tree.map(lambda x: np.asarray(x) * size() if is_float(x) else x, params)
        q, v = size() * rng.uniform(-1, 1, n), size() * rng.uniform(-1, 1, n)
        yield {key: float(np.float32(x)) for key, x in values(several, q, v).items()}


def out_of_range(written, program, given):
    """Largest difference over the change by rounding of the inputs, in single precision."""
    eps, rng = 2.0**-23, np.random.default_rng(1)
    nudged = [
        {key: x * (1 + eps * rng.uniform(-1, 1)) for key, x in given.items()} for _ in range(4)
    ]
    right = np.array([rounded(written, near, np.float32) for near in (given, *nudged)], float)
    exact = rounded(written, given, np.float64)
    found = rounded(program, given, np.float32).astype(float)
    with np.errstate(all="ignore"):
        spread = np.max(np.abs(right - exact), axis=0)
        allowed = spread + eps * np.abs(exact) + float(np.finfo(np.float32).tiny)
        off = np.abs(found - exact) / allowed
    compared = np.isfinite(spread)
    return float(np.max(np.where(np.isnan(off), np.inf, off)[compared], initial=0.0))


@pytest.mark.full
@pytest.mark.parametrize(
    "name", mostly_full(SINGLE, "lennard_jones", "kepler", "top", "double_pendulum")
)
def test_single_precision_stays_in_range(name):
    system, params = case(name)
    programs = both(system, params, np.float32)
    off = [out_of_range(*programs, given) for given in scaled(params, system.size)]
    assert max(off) <= SLACK


def test_range_check_detects_overflow():
    """A literal is factored out of a power."""

    def written(t, q, v, p):
        return 0.5 * v @ v - (q[0] / p[0]) ** 8

    def factored(t, q, v, p):
        return 0.5 * v @ v - q[0] ** 8 / p[0] ** 8

    params = np.array([2e10])
    given = values(params, [1.5e10], [0.0])
    one, two = (both(jl.System(L, ("x",)), params, np.float32)[0] for L in (written, factored))
    assert out_of_range(one, one, given) <= 1.0
    assert out_of_range(one, two, given) > 1e4 * SLACK
