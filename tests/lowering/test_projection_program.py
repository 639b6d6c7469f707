"""Corrections of the projection from factors: the columns of the array program, by fewer lines."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _lowered import lowered

import jaxlag as jl
from jaxlag._lowering import Choices, State
from jaxlag._lowering._graph._expression import KNOWN, SIN, Graph
from jaxlag._lowering._graph._partition import partitioned
from jaxlag._lowering._symbolic import _projection_program
from jaxlag._lowering._symbolic._evaluate import evaluate

EPS = np.finfo(float).eps
P = {"m": 1.3, "l": 0.7, "g": 9.8}
BETWEEN = 70  # lines of the columns of two masses, of a definite M and of any


def rope(masses, rolling=False):
    """Point masses in the plane, one hanging from the other; the last may slide along x + y."""
    n = 2 * masses

    def lagrangian(t, q, v, p):
        return 0.5 * p["m"] * v @ v - p["g"] * p["m"] * jnp.sum(q[1::2])

    def lengths(t, q, p):
        r = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)])
        return jnp.sum(jnp.diff(r, axis=0) ** 2, axis=1) - p["l"] ** 2

    rows = [jl.Holonomic(lengths, "length")]
    if rolling:
        rows.append(jl.Pfaffian(lambda t, q, v, p: v[-1] - (1.0 + q[-2] ** 2) * v[-2], "slide"))
    return jl.System(lagrangian, {"q": (n,)}, constraints=tuple(rows), lowering="scalar")


def at(masses):
    """Some state, off the constraints."""
    angle = jnp.linspace(0.3, 1.7, masses)
    r = jnp.cumsum(jnp.stack([jnp.sin(angle), -jnp.cos(angle)], axis=1), axis=0) * 0.72
    return r.reshape(-1), jnp.linspace(-1.0, 1.0, 2 * masses)


def projector(system, q, v, active_rows, crossing, regular, on_arrays=False):
    program = system._program
    program = replace(program, array=replace(program.array, crossing=crossing, regular=regular))
    program = program._on_arrays if on_arrays else program
    constants = program.precompute(q, P, {}, Choices(active_rows=active_rows))
    state = State(jnp.zeros(()), q, v, P, {})
    return program.projector(state, constants, system._rows(P, q.dtype), active_rows)


CASES = [
    (rolling, left_out, crossing, regular)
    for rolling in (False, True)
    for left_out in (False, True)
    for crossing in (False, True)
    for regular in (False, True)
]


@pytest.mark.full
@pytest.mark.parametrize(
    ("rolling", "left_out", "crossing", "regular"),
    mostly_full(CASES, (True, True, True, True), (False, False, False, True)),
)
def test_corrections_are_those_of_the_array_program(
    monkeypatch, rolling, left_out, crossing, regular
):
    monkeypatch.setattr(_projection_program, "LINES", 0)
    monkeypatch.setattr(_projection_program, "FEW", 0)
    system, (q, v) = rope(3, rolling), at(3)
    count = 3 + rolling
    active_rows = jnp.arange(count) != 1 if left_out else None
    given = active_rows, crossing, regular
    c = jnp.linspace(0.5, 1.5, count)
    c = c if active_rows is None else jnp.where(active_rows, c, 0.0)

    def found(q, on_arrays):
        made = projector(system, q, v, *given, on_arrays)
        results = [made.shift(c[:3]), made.kick(c), made.columns(), made.position(q)]
        return results + ([made.masses] if crossing else [])

    # The weights of rows for a singular M are constants of the array program, and in `masses`.
    slopes = jax.jacfwd(lambda q: found(q, True))(q)[: 5 if regular else 4]
    for one, other in zip(found(q, False), found(q, True), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=64 * EPS * np.max(np.abs(other)))
    for mode in (jax.jacfwd, jax.jacrev):
        for one, other in zip(mode(lambda q: found(q, False))(q), slopes, strict=False):
            np.testing.assert_allclose(one, other, rtol=0, atol=512 * EPS * np.max(np.abs(other)))


@pytest.mark.full
def test_lines_of_a_long_rope_grow_with_its_length(monkeypatch):
    """Columns are a full matrix: their lines grow with the cube of the length or faster."""
    monkeypatch.setattr(_projection_program, "LINES", 0)
    monkeypatch.setattr(_projection_program, "FEW", 0)

    def lines(masses):
        surface = lowered(rope(masses), P).equations.surface
        assert surface.solves is not None
        return sum(len(code.body) for code in (surface.correction, *surface.solves))

    few, many = lines(4), lines(8)
    assert many < 2.5 * few


def test_few_rows_have_columns():
    assert lowered(rope(3), P).equations.surface.solves is None


def test_parts_of_expressions_are_computed_before():
    graph = Graph()
    x, y, c = graph.input("q", 0), graph.input("q", 1), graph.input("c", 0)
    sine, total = graph.call(SIN, x), graph.let(graph.add(x, y))
    roots = [graph.div(graph.mul(c, sine), total), sine, graph.const(2.0), c]
    values: list = []
    late = partitioned(graph, roots, [c], values)
    assert values == [sine, total]
    state = {("q", 0): 0.7, ("q", 1): 1.9, ("c", 0): -0.3}
    known = {(KNOWN, i): value for i, value in enumerate(evaluate(values, state))}
    found = evaluate(late, known | {("c", 0): -0.3})
    np.testing.assert_allclose(found, evaluate(roots, state), rtol=4 * EPS)


@pytest.mark.full
@pytest.mark.parametrize(
    "lines", mostly_full([0, 10**9, BETWEEN], BETWEEN), ids={0: "factors", 10**9: "columns"}.get
)
def test_motions_with_a_mass_matrix_unknown_while_tracing(monkeypatch, lines):
    """Two programs, for a definite M and for any: each may have factors or columns."""
    monkeypatch.setattr(_projection_program, "LINES", lines)
    monkeypatch.setattr(_projection_program, "FEW", 0)
    system, (q, v) = rope(2), at(2)
    programs = system._program.regular(), system._program
    found = [program.lowered(q, P, {}).equations.surface.solves for program in programs]
    has_factors = [solves is not None for solves in found]
    assert has_factors == {0: [True, True], 10**9: [False, False], BETWEEN: [False, True]}[lines]
    start = jl.assemble(system, q, v, P)
    ts = jnp.linspace(0.0, 0.2, 3)

    def end(p):
        return jl.simulate(system, start.q, start.v, ts, p).q[-1] @ q

    value, slopes = jax.jit(jax.value_and_grad(end))(P)
    step = 1e-4
    around = [end(P | {"g": P["g"] + sign * step}) for sign in (1.0, -1.0)]
    np.testing.assert_allclose(value, end(P), rtol=0, atol=1e-10)
    np.testing.assert_allclose(slopes["m"], 0.0, atol=1e-9)
    np.testing.assert_allclose(slopes["g"], (around[0] - around[1]) / (2 * step), rtol=1e-5)
