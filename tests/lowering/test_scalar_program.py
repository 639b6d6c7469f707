"""The scalar program against the array program: values, derivatives, structure, omissions."""

import re
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _lowered import lowered as derived
from _scenes import MOVING, case
from numpy.linalg import cond, norm

import jaxlag as jl
from bench._problems.scenes import SCENES
from jaxlag import math
from jaxlag._lowering import find

EPS = np.finfo(float).eps
STATES = 8
QUICK = ["double_pendulum", "cart_pendulum", "spherical_pendulum_elastic", "two_link_robot_arm"]


CURVED = ("double_pendulum", "cart_pendulum", "central_motion", "quadcopter", "falling_stick")
"""Systems whose second derivatives are compared, too."""


def pair(system):
    """The same declaration under both lowerings."""
    return [
        jl.System(
            system.lagrangian,
            system.coordinates.shapes,
            forces=system.forces,
            constraints=system.constraints,
            lowering=lowering,
        )
        for lowering in ("scalar", "array")
    ]


@cache
def lowered(name):
    system, params, q0, _ = case(name)
    scalar, _ = pair(system)
    return scalar._program.lowered(jnp.asarray(q0, float), params, {})


def states(q0, v0):
    rng = np.random.default_rng(7)
    q = np.asarray(q0) + rng.uniform(-0.4, 0.4, (STATES, len(q0)))
    v = np.asarray(v0) + rng.uniform(-1.0, 1.0, (STATES, len(q0)))
    return jnp.asarray(rng.uniform(0.0, 2.0, STATES)), jnp.asarray(q), jnp.asarray(v)


# ---- Values --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", mostly_full([*MOVING, *SCENES], *QUICK, "chain_4"))
def test_accelerations_equal_those_of_the_array_program(name):
    """Within 1e-13 max(1, cond(M)/1e3) of the forces over the inertia."""
    system, params, q0, v0 = case(name)
    scalar, array = pair(system)
    t, q, v = states(q0, v0)

    def values(system, t, q, v):
        return system.acceleration(q, v, params, t=t), system.mass_matrix(q, v, params, t=t)

    found, _ = jax.jit(jax.vmap(partial(values, scalar)))(t, q, v)
    expected, M = jax.jit(jax.vmap(partial(values, array)))(t, q, v)
    assert lowered(name).equations is not None, lowered(name).reason
    for a, b, m in zip(found, expected, M, strict=True):
        scale = max(norm(b), norm(np.linalg.inv(m), 2))
        assert norm(a - b) <= 1e-13 * max(1.0, cond(m) / 1e3) * scale


# A program of all derivatives takes 10 s to compile: every third system.
@pytest.mark.parametrize(
    "name", mostly_full(dict.fromkeys([*QUICK[:2], *list(MOVING)[::3]]), QUICK[0])
)
def test_derivatives_equal_those_of_the_array_program(name):
    """jvp and vjp by state and params, batched, to 2e3 eps; for some the Hessian, to 2e5 eps."""
    system, params, q0, v0 = case(name)
    t, q, v = states(q0, v0)
    params = jax.tree.map(jnp.asarray, params)
    weights = jnp.linspace(1.0, 2.0, len(q0))

    def everything(system, t, q, v):
        def total(q, v, params):
            return weights @ system.acceleration(q, v, params, t=t)

        def tangent(q, v):
            return jax.jvp(lambda q, v: system.acceleration(q, v, params, t=t), (q, v), (v, q))[1]

        first = jax.grad(total, argnums=(0, 1, 2))(q, v, params)
        curvature = jax.hessian(total, argnums=(0, 1))(q, v, params) if name in CURVED else 0.0
        return tangent(q, v), first, curvature, cond_of(system, q, v, t)

    def cond_of(system, q, v, t):
        return jnp.linalg.cond(system.mass_matrix(q, v, params, t=t))

    scalar, array = pair(system)
    found = jax.jit(jax.vmap(partial(everything, scalar)))(t, q, v)
    expected = jax.jit(jax.vmap(partial(everything, array)))(t, q, v)
    conditions = np.asarray(expected[3])
    for k, a, b in zip((2e3, 2e3, 2e5), found[:3], expected[:3], strict=True):
        flat = [np.concatenate([np.ravel(x[i]) for x in jax.tree.leaves(b)]) for i in range(STATES)]
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            for i in range(STATES):
                bound = k * EPS * conditions[i] * (1.0 + norm(flat[i]))
                assert np.max(np.abs(x[i] - y[i]), initial=0.0) <= bound


@pytest.mark.full
def test_custom_rules_have_derivatives_of_any_order():
    """A spring of length zero has the Jacobian -k times the identity; then JAX's derivatives."""

    def lagrangian(t, q, v, params):
        r = q - jnp.array([1.0, 0.0])
        return 0.5 * v @ v - 0.5 * params["k"] * (r @ r - 2 * params["l"] * math.norm(r))

    scalar, array = pair(jl.System(lagrangian, ("x", "y")))

    def at(system, params, q):
        return system.acceleration(q, jnp.zeros(2), params)

    for length in (0.0, 0.3):
        params = {"k": 3.0, "l": length}
        for q in (jnp.array([1.0, 0.0]), jnp.array([1.2, -0.3])):
            for order in (lambda f: f, jax.jacfwd, jax.jacrev, jax.hessian):
                found = order(partial(at, scalar, params))(q)
                expected = order(partial(at, array, params))(q)
                np.testing.assert_allclose(found, expected, atol=64 * EPS * 30)
    slope = jax.jacfwd(lambda q: scalar.acceleration(q, jnp.zeros(2), {"k": 3.0, "l": 0.0}))
    np.testing.assert_array_equal(slope(jnp.array([1.0, 0.0])), -3.0 * np.eye(2))


def test_canceled_terms_stay_canceled():
    """0 x = 0 and x / x = 1 for every x, unlike the array program (NaN); sqrt(x^2) is not |x|."""

    def lagrangian(t, q, v, params):
        x = q[0]
        return 0.5 * (x / x) * v[0] ** 2 - 0.5 * x**2 + 0.0 * jnp.log(x)

    scalar, array = pair(jl.System(lagrangian, ("x",)))
    assert scalar.acceleration([0.0], [1.0]) == 0.0
    assert np.isnan(array.acceleration([0.0], [1.0]))

    def root(t, q, v, params):
        return 0.5 * v[0] ** 2 - jnp.sqrt(q[0] ** 2)

    scalar, array = pair(jl.System(root, ("x",)))
    for x, a in ((2.0, -1.0), (-2.0, 1.0)):
        assert scalar.acceleration([x], [0.0]) == array.acceleration([x], [0.0]) == a
    assert np.isnan(scalar.acceleration([0.0], [0.0]))
    assert np.isnan(array.acceleration([0.0], [0.0]))


@pytest.mark.full
@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_a_mass_matrix_that_is_not_positive_definite_gives_nan(n):
    """Singular, indefinite and negative matrices, with the wrong sign at any pivot."""
    rng = np.random.default_rng(n)
    B = rng.normal(size=(n, n))

    def lagrangian(t, q, v, params):
        return 0.5 * v @ params["M"] @ v - jnp.sum(q)

    scalar, array = pair(jl.System(lagrangian, {"q": (n,)}))
    for values in ([1.0] * n, [0.0] + [1.0] * (n - 1), [-1.0] + [1.0] * (n - 1)):
        for roll in range(n):
            Q = np.linalg.qr(B)[0]
            M = jnp.asarray(Q @ np.diag(np.roll(values, roll)) @ Q.T)
            M = 0.5 * (M + M.T)
            a = scalar.acceleration(jnp.zeros(n), jnp.zeros(n), {"M": M})
            b = array.acceleration(jnp.zeros(n), jnp.zeros(n), {"M": M})
            np.testing.assert_allclose(a, b, rtol=1e-12)
            assert np.all(np.isnan(a)) == (min(values) <= 0)


@pytest.mark.parametrize("kink", ["maximum", "where", "abs"])
def test_branches_outside_the_compared_states_are_right(kink):
    """L is linear in v up to v = 3, with a kink there, which no state of the comparison reaches."""

    def lagrangian(t, q, v, params):
        extra = {
            "maximum": lambda v: jnp.maximum(v - 3.0, 0.0),
            "where": lambda v: jnp.where(v > 3.0, v - 3.0, 0.0),
            "abs": lambda v: 0.5 * (jnp.abs(v - 3.0) + v - 3.0),
        }[kink](v[0])
        return 0.5 * params * v[0] ** 2 + extra * jnp.sin(q[0])

    scalar, array = pair(jl.System(lagrangian, ("x",)))
    for v in (1.0, 5.0):
        a = scalar.acceleration([0.5], [v], 2.0)
        np.testing.assert_allclose(a, array.acceleration([0.5], [v], 2.0), rtol=8 * EPS)
    np.testing.assert_allclose(a, -1.5 * np.cos([0.5]), rtol=8 * EPS)


@pytest.mark.full
@pytest.mark.parametrize("largest", ["maximum", "max", "minimum", "hypot"])
def test_derivatives_of_maxima_of_rounded_results_are_right(largest):
    """The derivative of max tests for equality, which a fused multiply-add may spoil."""

    def size(x):
        a, b = -0.4 * jnp.sin(x), 1 - 0.4 * jnp.cos(x)
        return {
            "maximum": lambda: jnp.maximum(a, jnp.abs(b)),
            "max": lambda: jnp.max(jnp.stack([a, jnp.abs(b), 0.1 * a, -b])),
            "minimum": lambda: -jnp.minimum(-a, -jnp.abs(b)),
            "hypot": lambda: jnp.hypot(a, b),
        }[largest]()

    def length(x):
        h = size(x)
        return h * (1 + jnp.square((1 - 0.4 * jnp.cos(x)) / jnp.where(h == 0, 1.0, h)))

    def lagrangian(t, q, v, params):
        rate = jax.jvp(lambda q: length(q[0]), (q,), (v,))[1]
        return 0.5 * (rate**2 + v[0] ** 2)

    def plain(q, v):
        """For L = g(q) v^2/2: a = -g' v^2 / (2 g), g = 1 + length'^2."""
        slope, curvature = jax.grad(length), jax.grad(jax.grad(length))
        return -slope(q) * curvature(q) * v**2 / (1 + slope(q) ** 2)

    system = jl.System(lagrangian, ("x",), lowering="scalar")
    q = np.linspace(-5.0, 6.0, 6)
    with jax.disable_jit():
        expected = [plain(x, 2.0) for x in q]
    one = jax.jit(lambda x: system.acceleration(x[None], jnp.array([2.0]))[0])
    np.testing.assert_allclose([one(x) for x in q], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.full
def test_traced_integers_use_the_array_program():
    """Among params and among inputs."""

    def lagrangian(t, q, v, params):
        n, half = (jnp.asarray(x).astype(float) for x in (params["n"], params["n"] // 2))
        return 0.5 * n * v[0] ** 2 + half * jnp.cos(q[0])

    system = jl.System(lagrangian, ("x",))

    def end(n):
        return jl.simulate(system, [0.5], [0.0], [0.0, 0.5, 1.0], {"n": n}, throw=False).q[-1, 0]

    found = jax.vmap(end)(jnp.array([2, 5]))
    np.testing.assert_allclose(found, [end(2), end(5)], rtol=1e-8)
    force = jl.GeneralizedForce(lambda t, q, v, p, u: (p * u["u"].astype(float))[None], "push")
    pushed = jl.System(lambda t, q, v, p: 0.5 * p * v @ v, ("x",), forces=(force,))
    motion = jl.simulate(pushed, [0.0], [0.0], [0.0, 1.0], 2.0, inputs={"u": jnp.array(2)})
    np.testing.assert_allclose(motion.q[-1], [1.0], rtol=1e-12)


# ---- Operations and structure --------------------------------------------------------------------

CEILINGS = {  # operations, sines and cosines, divisions
    "pendulum": (4, 1, 0),
    "double_pendulum": (30, 4, 2),
    "double_pendulum_positions": (35, 4, 2),
    "cart_pole": (20, 2, 2),
    "spherical_pendulum": (17, 2, 1),
    "elastic_pendulum": (22, 2, 1),
    "kepler": (16, 0, 2),
    "kepler_polar": (15, 0, 2),
    "symmetric_top": (39, 2, 2),
    "top": (86, 4, 4),
    "rigid_body": (85, 4, 4),
    "aircraft": (410, 6, 4),
    "chain_4": (160, 8, 4),
    "chain_8": (720, 16, 12),
}


@pytest.mark.full
@pytest.mark.parametrize(
    "name", mostly_full(CEILINGS, *(CEILINGS.keys() - {"aircraft", "chain_8"}))
)
def test_operations_of_one_evaluation_stay_below_ceilings(name):
    """Counted in the code itself, which has no custom call, product of arrays or factorization."""
    program = lowered(name).equations.program
    operations, functions, divisions = CEILINGS[name]
    assert program.operations <= operations
    assert program.count("sin", "cos") <= functions
    assert program.count("div") <= divisions
    names = [line.data.name if line.op == "call" else line.op for line in program.body]
    assert {"custom", "dot_general", "cholesky"}.isdisjoint(names)


@pytest.mark.full
def test_structure_is_found():
    """Through rotation matrices and positions, for any values of params."""

    def found(name):
        return find(lowered(name).scene, lowered(name).equations)

    assert found("kepler").cyclic == (1,)
    assert found("kepler").mass_blocks == ((0,), (1,))
    assert found("spherical_pendulum").cyclic == (1,)
    assert found("symmetric_top").cyclic == (0, 2)
    assert found("top").cyclic == (0,)
    assert lowered("top").equations.mass[2][2].fixed  # M_33 constant
    body = found("rigid_body")
    assert body.cyclic == (0, 1, 3)
    assert body.mass_blocks == body.subsystems == ((0,), (1,), (2,), (3, 4, 5))
    assert body.mass_depends == {("q", 4), ("q", 5)}
    aircraft = found("aircraft")
    assert aircraft.cyclic == (0, 1)  # not yaw: cyclic only together with a rotation of x and y
    mass = lowered("aircraft").equations.mass
    zero = lowered("aircraft").scene.graph.zero
    assert all((mass[i][j] is zero) == (i != j) for i in range(3) for j in range(3))
    assert all(mass[i][i].fixed for i in range(3))
    springs = found("two_mass_three_springs")
    assert (springs.mass_constant, springs.separable, springs.linear) == (True, True, True)
    assert not found("double_pendulum").linear
    assert found("hockey_puck_cord").bias_zero


@pytest.mark.parametrize("name", ["top", "two_mass_three_springs"])
def test_program_does_not_depend_on_values_of_params(name):
    system, params, q0, _ = case(name)
    found = []
    for factor in (0.0, 1.0):
        scaled = jax.tree.map(lambda x, f=factor: f * jnp.asarray(x, float), params)
        scalar, _ = pair(system)
        program = scalar._program.lowered(jnp.asarray(q0, float), scaled, {}).equations.program
        found.append((program.operations, len(program.prelude), program.count("div")))
    assert found[0] == found[1]


def test_a_constant_mass_matrix_is_factored_before_the_loop():
    """No division is in the body; undeclared forces add no inputs."""
    program = lowered("two_mass_three_springs").equations.program
    assert program.count("div", "gt", "select") == 0
    assert any(line.op == "div" for line in program.prelude)
    assert not any(name == "inputs" for name, _ in program.inputs)


def sines_of_differences(t, q, v, p):
    return 0.5 * v @ v - jnp.prod(jnp.sin(q[:, None] - q + 1.0))


def inertia_by_products(t, q, v, p):
    once = 2.0 * jnp.eye(6) + jnp.outer(jnp.sin(q), jnp.cos(q))
    whole = once @ once @ once @ once @ once
    return 0.5 * v @ whole.T @ whole @ v


@pytest.mark.full
@pytest.mark.parametrize(
    ("lagrangian", "n", "reason"),
    [
        (
            sines_of_differences,
            10,
            r"1775 operations, 0 more once per solve: more than 1500; h \d+",
        ),
        (inertia_by_products, 6, r"\d+ operations in the mass matrix alone, more than 1500"),
    ],
    ids=["long products", "mass"],
)
def test_long_derivations_fall_back_with_a_reason(lagrangian, n, reason):
    """All pairs of 90 factors in each of 90 products were counted repeatedly: 88 s."""
    system = jl.System(lagrangian, tuple(f"q{i}" for i in range(n)))
    found = derived(system)
    assert found.equations is None
    assert re.fullmatch(reason, found.reason)


@pytest.mark.full
def test_factors_of_products_are_shared():
    """Each product lacks one of 20 factors: 18 multiplications separately, 4 with sharing."""
    system = jl.System(sines_of_differences, ("a", "b", "c", "d", "e"))
    assert derived(system).equations.program.operations == 185
