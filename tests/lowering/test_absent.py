"""Operations that a program omits if there is nothing to compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import count, loop, names, operations
from _programs import (
    PACKING,
    SCALAR,
    STEP,
    Case,
    case,
    evaluation,
    floats,
    prelude,
    solve,
)
from _systems.problems import MOTIONS

import jaxlag as jl
from jaxlag._integration._step_end import StepEnd
from jaxlag._lowering import ArrayTerms, State

# ---- A constant mass matrix ----------------------------------------------------------------------


def coupled(t, q, v, params):
    """Three masses on a line, coupled by gears, each on a spring."""
    M = jnp.diag(params["m"]) + params["J"] * jnp.ones((3, 3))
    return 0.5 * v @ M @ v - 0.5 * params["k"] * (q @ q)


def geared(k=3.0, m=(1.0, 1.5, 0.7), lagrangian=coupled, forces=()):
    params = {"m": jnp.array(m), "J": jnp.array(0.4), "k": jnp.array(k)}
    return Case(jl.System(lagrangian, {"x": (3,)}, forces=forces), params, jnp.arange(1.0, 4.0), {})


@pytest.mark.parametrize("of", [geared, lambda: case("two_mass_three_springs")])
def test_a_constant_mass_matrix_is_eliminated_before_the_loop(of):
    """Divisions and signs of pivots are computed before the loop, none inside."""
    before, each = prelude(of()), evaluation(of())
    assert count(before, "div") > 0
    assert count(before, "gt") > 0
    assert count(each, "div", "gt", "select_n") == 0
    end, start = solve(of())
    step = loop(operations(end, *start, iterations=1))
    assert count(step, "div") == STEP


def test_terms_of_params_alone_are_computed_before_the_loop():
    """Functions and powers of params, in L and in forces."""

    def lagrangian(t, q, v, params):
        slope = jnp.tan(params["angle"]) * jnp.exp(params["m"])
        return 0.5 * params["m"] ** 3 * v[0] ** 2 - slope * jnp.cos(q[0])

    def push(t, q, v, params):
        return jnp.sinh(params["angle"]) * jnp.sin(q)

    system = jl.System(lagrangian, ("x",), forces=(jl.GeneralizedForce(push, "push"),))
    slanted = Case(system, floats({"m": 2.0, "angle": 0.3}), jnp.ones(1), {})
    assert names(prelude(slanted)) >= {"tan", "exp", "sinh"}
    each = evaluation(slanted)
    assert names(each) <= SCALAR | PACKING
    assert count(each, "sincos") <= 2
    assert count(each, "div") == 0


# ---- Omitted parts -------------------------------------------------------------------------------


def test_no_force_code_without_forces():
    """Every force adds to the program; params of absent forces need not exist."""

    def drag(t, q, v, params):
        return -params["c"] * jnp.tanh(v)

    def wave(t, q, v, params):
        return jnp.sin(params["w"] * t) * jnp.ones_like(q)

    both = (jl.GeneralizedForce(drag, "drag"), jl.GeneralizedForce(wave, "wave"))
    found = []
    for forces in ((), both[:1], both):
        pushed = geared(forces=forces)
        pushed.params.update({name: jnp.array(0.5) for name in "cw"} if forces else {})
        found.append(evaluation(pushed))
    bare, dragged, waved = found
    assert bare == evaluation(geared())
    assert names(bare).isdisjoint({"tanh", "sincos"})
    assert (names(dragged) & {"tanh", "sincos"}, names(waved) & {"tanh", "sincos"}) == (
        {"tanh"},
        {"tanh", "sincos"},
    )
    assert len(bare) < len(dragged) < len(waved)


def test_solves_without_tables_have_no_searches():
    """A solve with a number as input has no searches and reads of tables."""
    searches = {"dynamic_slice", "gather", "scatter", "dynamic_update_slice"}
    motion = MOTIONS["driven_pendulum"]

    def step(inputs):
        def end(q0):
            return jl.simulate(
                motion.system, q0, [0.0], [0.0, 1.0], motion.params, inputs=inputs, throw=False
            ).q

        return loop(operations(end, motion.q0, iterations=1))

    plain, table = step({"tau": jnp.array(0.3)}), step(motion.inputs)
    assert names(plain).isdisjoint(searches)
    assert names(table) & searches
    assert len(plain) < len(table)


def test_zero_bias_has_no_arithmetic():
    """Free bodies coupled by gears: zeros, or NaN for a singular M, and no arithmetic."""

    def free(t, q, v, params):
        return coupled(t, q, v, params | {"k": 0.0})

    assert names(evaluation(geared(lagrangian=free))).isdisjoint(SCALAR - {"select_n"})
    assert "mul" in names(evaluation(geared()))


def test_time_is_read_only_if_the_equations_depend_on_it():
    """No operation of the evaluation reads t."""

    def reads_time(lagrangian):
        system, params, q, _ = geared(lagrangian=lagrangian)
        constants = system._program.precompute(q, params, {})

        def acceleration(t):
            return system._program.acceleration(State(t, q, q, params, {}), constants)

        jaxpr = jax.make_jaxpr(acceleration)(jnp.zeros(())).jaxpr
        return any(jaxpr.invars[0] is x for eqn in jaxpr.eqns for x in eqn.invars)

    def rocked(t, q, v, params):
        return coupled(t, q, v, params) + jnp.cos(t) * q[0]

    def total_derivative(t, q, v, params):
        """L + d/dt sin(t): another L with the same equations."""
        return coupled(t, q, v, params) + jnp.cos(t)

    assert not reads_time(coupled)
    assert not reads_time(total_derivative)
    assert reads_time(rocked)


@pytest.mark.parametrize("chosen", ["scalar", "array"])
def test_systems_without_constraints_evaluate_no_rows(chosen, monkeypatch):
    """Rows and gamma are never evaluated; no array has the size of M with rows appended."""

    def asked(*args):
        raise AssertionError("constraint rows of a system without constraints")

    for name in ("rows", "gamma", "position", "velocity", "correction", "reactions"):
        monkeypatch.setattr(ArrayTerms, name, asked)
    monkeypatch.setattr(StepEnd, "__call__", asked)

    def fresh(t, q, v, params):
        return coupled(t, q, v, params)

    _, *rest = geared()
    system = jl.System(fresh, {"x": (3,)}, lowering=chosen)
    found = evaluation(Case(system, *rest))
    end, start = solve(Case(system, *rest))
    assert jax.eval_shape(end, *start).shape == (3,)
    assert max(np.prod(shape, dtype=int) for o in found for shape in o.shapes) <= 3 * 3


# ---- Values of params ----------------------------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize(
    "special",
    [
        pytest.param({"k": 0.0}, id="no spring", marks=pytest.mark.full),
        pytest.param({"m": (1.0, 1.0, 1.0)}, id="equal masses"),
        pytest.param({"k": 1.0, "m": (0.0, 1.0, 1.0)}, id="no mass", marks=pytest.mark.full),
        pytest.param({"k": np.nan}, id="nan"),
    ],
)
def test_values_of_params_do_not_change_the_program(special):
    """One program, operation by operation; L is declared anew, so that no cache is used."""

    def program(**values):
        def fresh(t, q, v, params):
            return coupled(t, q, v, params)

        end, start = solve(geared(lagrangian=fresh, **values))
        return operations(end, *start, iterations=1)

    assert program(**special) == program()
