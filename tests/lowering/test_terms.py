"""The array programs of the equations of motion as jaxprs: operations, counts, array sizes.

A chain of N links represents any system. Its Lagrangian may contain a mark: a reversal of arrays.
This operation is linear, so that every derivative of L repeats it and is counted.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import count, largest, loop, names, operations
from _systems.mechanics import CHAIN_PARAMS, chain_lagrangian
from _systems.mechanics import chain as any_chain

import jaxlag as jl
from jaxlag._linalg._mass_solve import LOOP_UP_TO, UNROLL_UP_TO, factor_mass, solve_mass
from jaxlag._lowering import State
from systems.catalogue import ENTRIES

SMALL, MIDDLE, LARGE = 5, 12, LOOP_UP_TO + 2
chain = partial(any_chain, lowering="array")
FACTORIZATIONS = {"cholesky", "lu", "eigh", "eig", "svd", "qr", "geqrf", "schur", "tridiagonal"}
MARK = 3  # entries of the marked array


def marked(t, q, v, params):
    """The chain's L plus a function of t, q and v in which `rev` marks one evaluation."""
    mixed = jnp.stack([jnp.sum(q * v), jnp.sum(jnp.sin(q)), t])
    return chain_lagrangian(t, q, v, params) + jnp.prod(jnp.sin(jax.lax.rev(mixed, (0,))))


def evaluations(program):
    """Evaluations of the mark, one for each reversed array of MARK entries."""
    marks = [o for o in program if o.name == "rev"]
    return sum(o.times * np.prod(o.shapes[0], dtype=int) // MARK for o in marks)


def at_rest(n):
    return jnp.linspace(0.1, 1.0, n), jnp.linspace(-1.0, 1.0, n), CHAIN_PARAMS


def gradient(function):
    """The reverse derivative of a vector function of params, weighted by its components."""

    def weighted(q, v, params):
        return jnp.sum(function(q, v, params) * jnp.arange(1.0, q.size + 1))

    return jax.grad(weighted, argnums=2)


def tangent(function):
    def moved(q, v, params):
        return jax.jvp(partial(function, params=params), (q, v), (v, q))

    return moved


# ---- One factorization -------------------------------------------------------------------------


@pytest.mark.parametrize("derivative", [None, gradient, tangent])
@pytest.mark.parametrize("n", [LOOP_UP_TO + 1, LARGE])
def test_large_systems_take_one_cholesky(n, derivative):
    acceleration = chain(n).acceleration
    program = operations(derivative(acceleration) if derivative else acceleration, *at_rest(n))
    assert count(program, "cholesky") == 1
    assert names(program) & FACTORIZATIONS == {"cholesky"}


@pytest.mark.parametrize("derivative", [None, gradient, tangent])
@pytest.mark.parametrize("n", [2, SMALL, UNROLL_UP_TO])
def test_small_systems_take_one_elimination(n, derivative):
    """The only divisions are n (n - 1)/2 of the elimination, and 2 n of each solve."""
    acceleration = chain(n).acceleration
    program = operations(derivative(acceleration) if derivative else acceleration, *at_rest(n))
    assert names(program) & FACTORIZATIONS == set()
    assert count(program, "div", without=("custom_linear_solve",)) == n * (n - 1) // 2
    solves = count(program, "custom_linear_solve")
    assert solves == (2 if derivative else 1)
    assert count(program, "div") - n * (n - 1) // 2 <= 2 * n * solves


@pytest.mark.parametrize("derivative", [None, gradient, tangent])
@pytest.mark.parametrize("n", [UNROLL_UP_TO + 1, MIDDLE])
def test_medium_systems_take_one_elimination_by_rows(n, derivative):
    """The elimination divides one row of M per iteration, each solve's loops one number."""
    acceleration = chain(n).acceleration
    program = operations(derivative(acceleration) if derivative else acceleration, *at_rest(n))
    assert names(program) & FACTORIZATIONS == set()
    assert count(program, "div", without=("custom_linear_solve",)) == n
    assert count(program, "div") == n + 2 * n * (2 if derivative else 1)


def test_counters_find_a_second_factorization():
    """The counter itself: the two forms that the tests above exclude."""

    def twice(M, r):
        return solve_mass(M, solve_mass(M, r))

    for n in (SMALL, LARGE):
        program = operations(twice, jnp.eye(n), jnp.ones(n))
        assert count(program, "cholesky") == (2 if n > LOOP_UP_TO else 0)
        if n <= UNROLL_UP_TO:
            divisions = count(program, "div", without=("custom_linear_solve",))
            assert divisions == n * (n - 1)
    assert "svd" in names(operations(jnp.linalg.pinv, jnp.eye(SMALL)))


def test_given_factor_is_used():
    def solve(M, r):
        factor = factor_mass(M)
        return solve_mass(M, r, factor), solve_mass(M, 2 * r, factor)

    assert count(operations(solve, jnp.eye(LARGE), jnp.ones(LARGE)), "cholesky") == 1


# ---- Sizes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [SMALL, LARGE])
@pytest.mark.parametrize("derivative", [None, tangent])
def test_no_array_is_larger_than_the_mass_matrix(n, derivative):
    acceleration = chain(n).acceleration
    program = operations(derivative(acceleration) if derivative else acceleration, *at_rest(n))
    assert largest(program) == n * n
    with_cubes = operations(jax.jacfwd(chain(n).mass_matrix, argnums=0), *at_rest(n))
    assert largest(with_cubes) >= n**3  # the size of a derivative of M


@pytest.mark.parametrize("n", [SMALL, LARGE])
def test_bias_has_vectors_only(n):
    assert largest(operations(chain(n).bias, *at_rest(n))) == n


# ---- Evaluations of the Lagrangian ---------------------------------------------------------------


def test_the_bias_evaluates_the_lagrangian_a_fixed_number_of_times():
    """Forward and reverse mode, each with its tangent: four for any n."""
    found = {
        n: evaluations(
            operations(jl.System(marked, {"theta": (n,)}, lowering="array").bias, *at_rest(n))
        )
        for n in (2, 10)
    }
    assert found == {2: 4, 10: 4}


def test_mass_matrix_evaluates_the_lagrangian_once_per_column():
    """The mark counts: forward and reverse mode, and the tangents of both for every column."""
    found = {
        n: evaluations(
            operations(
                jl.System(marked, {"theta": (n,)}, lowering="array").mass_matrix, *at_rest(n)
            )
        )
        for n in (2, 10)
    }
    assert found == {2: 2 + 2 * 2, 10: 2 + 2 * 10}


def test_acceleration_needs_no_more_evaluations_than_mass_and_bias():
    n = 10
    program = operations(
        jl.System(marked, {"theta": (n,)}, lowering="array").acceleration, *at_rest(n)
    )
    assert evaluations(program) <= (2 + 2 * n) + 4


# ---- Undeclared parts are absent -----------------------------------------------------------------


def push(t, q, v, params):
    return jnp.sin(jax.lax.rev(q, (0,)))


def drag(t, q, v, params):
    return jnp.sum(jnp.cosh(v))


PUSHED = (jl.GeneralizedForce(push, "push"), jl.Rayleigh(drag, "drag"))


def test_no_force_code_without_forces():
    """A free chain consists of M, h and the solve of -h, without further operations."""
    n, free = 4, chain(4)

    def bare(q, v, params):
        return solve_mass(free.mass_matrix(q, v, params), -free.bias(q, v, params))

    program = operations(free.acceleration, *at_rest(n))
    expected = operations(bare, *at_rest(n))
    assert sorted(o.name for o in program) == sorted(o.name for o in expected)
    assert names(program).isdisjoint({"rev", "sinh", "cosh"})
    pushed = operations(chain(n, PUSHED).acceleration, *at_rest(n))
    assert {"rev", "sinh"} <= names(pushed)


def test_only_named_forces_are_computed():
    force = chain(4, PUSHED).generalized_force
    found = {
        chosen: names(operations(partial(force, names=chosen), *at_rest(4))) & {"rev", "sinh"}
        for chosen in [(), ("push",), ("drag",), ("push", "drag")]
    }
    assert found == {
        (): set(),
        ("push",): {"rev"},
        ("drag",): {"sinh"},
        ("push", "drag"): {"rev", "sinh"},
    }


def test_only_systems_with_tables_search_them():
    def pulled(t, q, v, params, inputs):
        return inputs["u"] * q

    system = chain(4, (jl.GeneralizedForce(pulled, "pull"),))

    def acceleration(signal, q, v, params):
        return system.acceleration(q, v, params, inputs={"u": signal})

    table = jl.LinearInterpolation(jnp.arange(5.0), jnp.ones(5))
    free = names(operations(chain(4).acceleration, *at_rest(4)))
    with_number = names(operations(acceleration, jnp.array(2.0), *at_rest(4)))
    with_table = names(operations(acceleration, table, *at_rest(4)))
    assert with_number == free
    assert "dynamic_slice" in with_table - free


# ---- Terms of params alone -----------------------------------------------------------------------

INERTIA = {"a": jnp.array(1.3), "k": jnp.array(2.0)}
HELD = jl.GeneralizedForce(lambda t, q, v, params: params["k"] * q, "spring")


def coupled(t, q, v, params):
    """Masses coupled only by inertia, in a field g = k."""
    M = params["a"] * jnp.eye(q.size) + 0.1
    return 0.5 * v @ M @ v - params["k"] * jnp.sum(q)


def hidden(t, q, v, params):
    """The same with q in T, so that M counts as variable."""
    return coupled(t, q, v, params) + 0.0 * jnp.sum(q) * v @ v


def free(t, q, v, params):
    """The same without a field: h = 0."""
    return coupled(t, q, v, params | {"k": 0.0})


def of(lagrangian, n, forces=()):
    return jl.System(lagrangian, {"x": (n,)}, forces=forces, lowering="array")


def swung(lagrangian, n, params, t1=0.2):
    """(q, v) at t1 and q half-way, by fixed steps."""
    system, q0 = of(lagrangian, n, (HELD,)), jnp.linspace(0.1, 1.0, n)
    options = {"dt": 0.1, "method": "bosh3", "max_steps": 64, "throw": False}
    motion = jl.simulate(system, q0, -q0, [0.0, t1 / 2, t1], params, **options)
    return jnp.concatenate([motion.q[-1], motion.v[-1], motion.q[1]])


@pytest.mark.parametrize("n", [SMALL, LARGE])
def test_a_constant_mass_matrix_is_factored_before_the_loop(n):
    """The loop of a whole solve contains solves and no factorization."""

    def factorizations(program):
        if n > UNROLL_UP_TO:
            return count(program, "cholesky")
        return count(program, "div", without=("custom_linear_solve",)) // (n * (n - 1) // 2)

    found = {}
    for lagrangian in (coupled, hidden):
        solve = partial(swung, lagrangian, n)
        inside = loop(operations(lambda params, solve=solve: solve(params), INERTIA, iterations=1))
        solves = count(inside, "custom_linear_solve")
        assert solves > 0
        assert names(inside) & FACTORIZATIONS <= {"cholesky"}
        found[lagrangian] = factorizations(inside)
    assert found[coupled] == 0
    assert found[hidden] > 0


def test_mass_matrix_is_factored_in_precompute():
    """Once per solve: the columns of M and its elimination; no other evaluation of L for M."""
    n, system = SMALL, of(coupled, SMALL)
    q = v = jnp.linspace(0.1, 1.0, n)
    constants = system._program.precompute(q, INERTIA, {})

    def once(params):
        return system._program.precompute(q, params, {})

    def each(constants, q, v):
        return system._program.acceleration(State(jnp.zeros(()), q, v, INERTIA, {}), constants)

    assert count(operations(once, INERTIA), "div") == n * (n - 1) // 2
    inside = operations(each, constants, q, v)
    products = count(inside, "dot_general", without=("custom_linear_solve",))
    assert products == count(operations(system.bias, q, v, INERTIA), "dot_general")
    assert count(inside, "div") == 2 * n


def test_zero_bias_has_no_arithmetic():
    """A free body: the loop contains no derivative of L, only the solve."""
    n = SMALL
    for lagrangian, left in ((free, set()), (coupled, {"dot_general", "mul"})):
        program = of(lagrangian, n)._program
        q = v = jnp.linspace(0.1, 1.0, n)
        constants = program.precompute(q, INERTIA, {})

        def each(constants, q, v, program=program):
            return program.acceleration(State(jnp.zeros(()), q, v, INERTIA, {}), constants)

        inside = operations(each, constants, q, v)
        outside = [o for o in inside if "custom_linear_solve" not in o.inside]
        assert names(outside) & {"dot_general", "mul"} == left
        assert bool(np.any(each(constants, q, v))) == (lagrangian is coupled)


DERIVATIVES = {
    "fwd": jax.jacfwd,
    "rev": jax.jacrev,
    "fwd fwd": lambda f: jax.jacfwd(jax.jacfwd(f)),
    "fwd rev": lambda f: jax.jacfwd(jax.jacrev(f)),
    "rev rev": lambda f: jax.jacrev(jax.jacrev(f)),
}


@pytest.mark.full
@pytest.mark.parametrize("derivative", DERIVATIVES)
def test_derivatives_with_a_constant_factor_are_right(derivative):
    """Those of a whole solve agree with M factored at every state, to rounding."""
    of_order = DERIVATIVES[derivative]
    once, anew = (jax.jit(of_order(partial(swung, f, 2)))(INERTIA) for f in (coupled, hidden))
    for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(anew), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * (1 + np.abs(b).max()))
        assert np.any(b)


@pytest.mark.full
@pytest.mark.parametrize("n", [3, UNROLL_UP_TO + 1])
def test_derivatives_of_one_acceleration_with_a_factor_are_right(n):
    """To third order, reverse and forward, batched, for both kinds of factor."""
    q = jnp.linspace(0.1, 1.0, n)

    def total(lagrangian, a):
        params, system = INERTIA | {"a": a}, of(lagrangian, n, (HELD,))
        constants = system._program.precompute(q, params, {})
        return jnp.sum(
            system._program.acceleration(State(jnp.zeros(()), q, q, params, {}), constants) ** 2
        )

    def orders(f):
        first, second = jax.jacrev(f), jax.jacfwd(jax.jacrev(f))
        return lambda a: [f(a), first(a), second(a), jax.jacfwd(second)(a)]

    masses = jnp.linspace(1.3, 2.0, 4)
    once, anew = (jax.jit(jax.vmap(orders(partial(total, f))))(masses) for f in (coupled, hidden))
    for a, b in zip(once, anew, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
        assert np.all(b != 0)


@pytest.mark.parametrize("n", [3, pytest.param(UNROLL_UP_TO + 1, marks=pytest.mark.full)])
def test_indefinite_constant_mass_matrix_ends_in_mass_singular(n):
    """The factor contains the health of its pivots."""
    q0, params = jnp.linspace(0.1, 1.0, n), {"a": -0.05, "k": 1.0}
    options = {"dt": 0.1, "method": "bosh3", "max_steps": 64, "throw": False}
    motion = jl.simulate(of(coupled, n), q0, q0, [0.0, 0.1], params, **options)
    assert motion.status == jl.Status.mass_singular
    assert motion.message().startswith("mass_singular ('x[1]')")


def test_a_lagrangian_may_hold_a_traced_value():
    """Structure and program belong to this trace; a traced bias does not count as zero."""

    def acceleration(lowering, c):
        def lagrangian(t, q, v, params):
            return 0.5 * v @ v - c * q[0]

        system = jl.System(lagrangian, ("x",), lowering=lowering)
        return system.acceleration(jnp.zeros(1), jnp.zeros(1))[0]

    for lowering in ("auto", "array"):
        for transform in (lambda f: f, jax.grad):
            assert jax.jit(transform(partial(acceleration, lowering)))(2.0) in (-2.0, -1.0)


# ---- The protocol --------------------------------------------------------------------------------


@pytest.mark.parametrize("chosen", ["scalar", "array"])
def test_terms_without_constraints_have_no_rows(chosen):
    system = jl.System(ENTRIES["double_pendulum"].system.lagrangian, ("a", "b"), lowering=chosen)
    params = dict(ENTRIES["double_pendulum"].example.params)
    t, q, v = jnp.zeros(()), jnp.ones(2), jnp.ones(2)
    A, b = system._terms.rows(t, q, v, params)
    assert (A.shape, b.shape, system._terms.gamma(t, q, v, params).shape) == ((0, 2), (0,), (0,))


@pytest.mark.full
@pytest.mark.parametrize("chosen", ["scalar", "array"])
def test_terms_equal_those_of_public_methods(chosen):
    entry = ENTRIES["cart_pendulum"]
    declared, params = entry.system, dict(entry.example.params)
    system = jl.System(declared.lagrangian, ("x", "a"), forces=declared.forces, lowering=chosen)
    t, q, v = jnp.array(0.7), jnp.array([0.2, 0.9]), jnp.array([-1.0, 2.0])

    @jax.jit
    def both():
        terms = system._terms
        return [
            (terms.mass(t, q, v, params), system.mass_matrix(q, v, params, t=t)),
            (terms.bias(t, q, v, params), system.bias(q, v, params, t=t)),
            (terms.momentum(t, q, v, params), system.momentum(q, v, params, t=t)),
            (terms.force(t, q, v, params, {}), system.generalized_force(q, v, params, t=t)),
            (
                system._program.acceleration(State(t, q, v, params, {})),
                system.acceleration(q, v, params, t=t),
            ),
        ]

    for found, expected in both():
        np.testing.assert_array_equal(found, expected)
        assert np.any(found)
