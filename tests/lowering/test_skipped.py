"""Programs omit what the equations do not need: read from jaxprs and HLO.

One evaluation is the acceleration as computed by the stages of a solve; terms of params alone are
computed before the loop. Operations are counted in JAX's program, not in the lowering's.
"""

import re
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _jaxprs import count, loop, names, operations
from _programs import PACKING, SCALAR, STEP, Case, case, evaluation, solve

import jaxlag as jl
from jaxlag._lowering import State
from jaxlag._system._inspection import mass_definite
from jaxlag._tracing import _params
from systems.catalogue import ENTRIES

STAGES = 14  # evaluations in a step of order 8: 13, and the first one again if the field jumps

CEILINGS = {  # angles of sines and cosines, divisions
    "pendulum": (1, 0),
    "double_pendulum": (3, 2),
    "cart_pole": (1, 2),
    "spherical_pendulum": (1, 1),
    "elastic_pendulum": (1, 1),
    "kepler": (0, 2),
    "symmetric_top": (1, 2),
    "top": (2, 4),
    "rigid_body": (2, 4),
    "aircraft": (3, 4 + 6),  # long programs also divide sines, to store them: see _execute.py
    "chain_8": (8, 12 + 16),
    # With forces:
    "double_pendulum_rayleigh": (3, 2),
    "cart_pendulum": (2, 2),
    "mass_spring_dashpot": (1, 0),
    "rotating_slender_rod": (2, 1),
    "sleeve_pendulum": (2, 1),
    "driven_pendulum": (1, 0),
}


CONSTRAINED = {  # the same, with multipliers eliminated
    "spherical_pendulum_cartesian": (0, 1),
    "double_pendulum_cartesian": (0, 2),
    "atwood_multipliers": (0, 0),  # M, A and Q are constant: solved before the first step
    "knife_edge_vehicle": (2, 3),
    "falling_stick_friction": (1, 1),
    "slider_crank": (2, 4),
}


QUASI = {  # the same in quasi-velocities: v and u', no rows; a constant or diagonal inertia
    "chaplygin_sleigh": (1, 0),
    "knife_edge_incline": (1, 0),
    "vertical_rolling_disk": (1, 0),
    "nonholonomic_particle": (0, 1),
    "rigid_body_roll_pitch_yaw": (2, 2),
    "rolling_disk": (2, 2),
    "rolling_ball_turntable": (2, 2),
    "suslov": (2, 2),
    "heavy_symmetric_top": (1, 1),
}


# ---- Ceilings ------------------------------------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    mostly_full(CEILINGS, *(CEILINGS.keys() - {"aircraft", "chain_8"})),  # long to derive
)
def test_an_evaluation_stays_below_its_ceilings(name):
    """Only scalar arithmetic: no product of arrays, no factorization, no matrix."""
    program = evaluation(case(name))
    functions, divisions = CEILINGS[name]
    assert count(program, "sincos") <= functions
    assert count(program, "div") <= divisions
    assert names(program) <= SCALAR | PACKING
    assert max(len(shape) for o in program for shape in o.shapes) <= 1


@pytest.mark.full
@pytest.mark.parametrize("name", CONSTRAINED)
def test_an_evaluation_with_constraints_stays_below_its_ceilings(name):
    """Every row costs one division if M is known to be regular."""
    whole = case(name)
    start, known = (whole.q0, jnp.zeros_like(whole.q0)), dict(ENTRIES[name].example.params)

    def definite(*state):
        return mass_definite(whole.system, known, 0.0, *state, _params.UNKNOWN).alone

    assert definite(*start)
    traced = []  # for a traced state other states are tested
    jax.eval_shape(lambda *z: traced.append(definite(*z)), *start)
    assert traced == [True]
    program = evaluation(whole, regular=True)
    functions, divisions = CONSTRAINED[name]
    assert count(program, "sincos") <= functions
    assert count(program, "div") <= divisions
    assert names(program) <= SCALAR | PACKING | {"ne"}  # `ne` for the mask of active rows
    assert max(len(shape) for o in program for shape in o.shapes) <= 1


@pytest.mark.parametrize("definite", [True, False])
def test_traced_params_use_the_shorter_program_for_definite_mass(definite):
    """The constants of the other program are NaN: they are not read."""
    system, params, q, _ = case("double_pendulum_cartesian")
    program, state = system._program, State(jnp.zeros(()), q, 0.1 * q, params, {})
    longer, shorter = (x.precompute(q, params, {}) for x in (program, program.regular()))
    expected = program.acceleration(state, longer)
    poison = lambda unread: jax.tree.map(lambda x: jnp.nan * x, unread)  # noqa: E731
    longer, shorter = (poison(longer), shorter) if definite else (longer, poison(shorter))
    either = longer._replace(definite=jnp.array(definite), alone=shorter)
    np.testing.assert_allclose(program.acceleration(state, either), expected, rtol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize(
    "name", mostly_full(QUASI, "chaplygin_sleigh", "nonholonomic_particle", "heavy_symmetric_top")
)
def test_an_evaluation_in_quasi_velocities_stays_below_its_ceilings(name):
    """No multipliers or matrices; divisions only by cos(theta) or 1 + y^2, which may vanish."""
    system, params, q, _ = case(name)
    array = replace(system._terms, quasi=system.quasi, in_u=system._in_u)
    program = replace(system._program, array=array)
    constants = program.precompute(q, params, {})
    u = jnp.zeros(len(system.quasi.free))

    def rates(constants, params, t, q, u):
        return program.quasi_rates(State(t, q, u, params, {}), constants)

    program = operations(rates, constants, params, jnp.zeros(()), q, u)
    functions, divisions = QUASI[name]
    assert count(program, "sincos") <= functions
    assert count(program, "div") <= divisions
    assert names(program) <= SCALAR | PACKING | {"dynamic_slice", "broadcast_in_dim"}
    assert max(len(shape) for o in program for shape in o.shapes) <= 1
    with_multipliers = evaluation(case(name), regular=True)
    arithmetic = ("add", "sub", "mul", "div", "neg", "sincos")
    assert count(program, *arithmetic) < count(with_multipliers, *arithmetic)


@pytest.mark.full
@pytest.mark.parametrize(
    "name", mostly_full(["chaplygin_sleigh", "rolling_disk"], "chaplygin_sleigh")
)
def test_a_step_in_quasi_velocities_has_no_constraint(name):
    """Neither matrices nor Newton iterations; the compiled loop calls no library."""
    system, params, q0, _ = case(name)
    u0 = jnp.linspace(0.1, 0.2, len(system.quasi.names))

    def end(params, q0, u0):
        motion = jl.simulate(
            system, q0, None, u0=u0, ts=jnp.array([0.0, 1.0]), params=params, throw=False
        )
        return motion.q[-1]

    step = loop(operations(end, params, q0, u0, iterations=1))
    matrices = {"cholesky", "triangular_solve", "custom_linear_solve", "scan", "lu", "geqrf"}
    assert names(step).isdisjoint(matrices)
    assert not [o for o in step if o.inside.count("while") > 1]
    assert count(step, "sincos") <= STAGES * QUASI[name][0]
    text = jax.jit(end).lower(params, q0, u0).compile().as_text()
    assert {"dot", "custom-call"}.isdisjoint(instructions(in_loops(text)))


def test_a_step_with_constraints_has_no_matrix():
    """Neither in its stages nor in the projection; the only inner loops are Newton's."""
    end, start = solve(case("double_pendulum_cartesian"))
    step = loop(operations(end, *start, iterations=1))
    matrices = {"cholesky", "triangular_solve", "custom_linear_solve", "sort", "lu"}
    assert names(step).isdisjoint(matrices)
    assert all(o.shapes == ((),) for o in step if o.name == "dot_general")
    newton = [o for o in step if o.inside.count("while") > 1]
    assert newton
    assert "cond" not in names(newton)


@pytest.mark.parametrize("name", ["top", "cart_pendulum"])
def test_step_evaluates_the_equations_once_per_stage(name):
    """The same numbers times the stages, and the step-size control, which has no matrix."""
    end, start = solve(case(name))
    step = loop(operations(end, *start, iterations=1))
    functions, divisions = CEILINGS[name]
    assert count(step, "sincos") <= STAGES * functions
    assert count(step, "div") <= STAGES * divisions + STEP
    assert names(step).isdisjoint({"cholesky", "triangular_solve", "custom_linear_solve", "scan"})
    assert count(step, "dot_general") == 0


def test_counters_find_operations_of_the_array_program():
    """The counters themselves: the array program of the same system exceeds every ceiling."""
    system, *rest = case("top")
    arrays = jl.System(system.lagrangian, {"q": (3,)}, lowering="array")
    program = evaluation(Case(arrays, *rest))
    assert {"dot_general", "custom_linear_solve"} <= names(program) - SCALAR - PACKING
    assert count(program, "sin", "cos") > CEILINGS["top"][0]
    assert max(len(shape) for o in program for shape in o.shapes) > 1


# ---- The compiled program ------------------------------------------------------------------------

CALLED = re.compile(
    r"(?:body|condition|calls|to_apply|true_computation|false_computation)=%?([\w.\-]+)"
)
CALLED_TOGETHER = re.compile(r"(?:branch|called)_computations=\{([^}]*)\}")


@cache
def compiled(name):
    """The optimized HLO of a whole solve."""
    end, start = solve(case(name))
    return jax.jit(end).lower(*start).compile().as_text()


def in_loops(text):
    """The lines of all computations that are reached from the body of a loop."""
    lines, of = {}, None
    for line in text.splitlines():
        if line.endswith("{") and " = " not in line.split("->")[0]:
            of = line.removeprefix("ENTRY ").split()[0].lstrip("%").split("(")[0]
            lines[of] = []
        elif of is not None:
            lines[of].append(line)
    reached = set()
    waiting = re.findall(r"body=%?([\w.\-]+)", text)
    while waiting:
        name = waiting.pop()
        if name in reached:
            continue
        reached.add(name)
        for line in lines[name]:
            waiting += CALLED.findall(line)
            for group in CALLED_TOGETHER.findall(line):
                waiting += [x.strip().lstrip("%") for x in group.split(",")]
    return [line for name in reached for line in lines[name]]


def instructions(lines):
    """The operation of every line of HLO."""
    return {m[1] for line in lines if (m := re.search(r"\s([a-z][a-z\-]*)\(", line))}


@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    mostly_full((*CEILINGS, *CONSTRAINED), "pendulum", "top", "cart_pendulum"),
)
def test_compiled_solve_has_no_library_call_and_no_array_product(name):
    """No LAPACK in the whole solve, no dot in its loops."""
    assert "custom-call" not in instructions(compiled(name).splitlines())
    inside = instructions(in_loops(compiled(name)))
    assert {"dot", "custom-call"}.isdisjoint(inside)
    assert {"multiply", "add"} <= inside


def test_hlo_parser_finds_products_and_libraries():
    """The parser itself: a loop with both, on arrays too large for unrolling."""

    def body(c):
        return c[0] + 1, jnp.linalg.cholesky(c[1] @ c[1].T)

    def run(A):
        return jax.lax.while_loop(lambda c: c[0] < 3, body, (0, A))[1]

    text = jax.jit(run).lower(jnp.eye(40)).compile().as_text()
    assert {"dot", "custom-call"} <= instructions(in_loops(text))
