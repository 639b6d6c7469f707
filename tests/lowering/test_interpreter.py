"""The interpreter of straight-line code: results, derivatives, rounding, and its constant size."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _jaxprs import loop, operations
from _lowered import lowered

import jaxlag as jl
from jaxlag._lowering._emit import _emit, _interpreter, _outlined
from jaxlag._lowering._emit._code import Code, body_of, prelude_of, whole_of
from jaxlag._lowering._emit._execute import straight
from jaxlag._lowering._graph._expression import COS, SIN, Graph, named
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported

EPS = np.finfo(float).eps
ABS = named("abs")
P = {"m": 1.2, "l": 0.7}


def lagrangian(t, q, v, p):
    """Every kind of line: functions, roots, choices, divisions, parts that depend on params."""
    T = 0.5 * p["m"] * v @ v + 0.3 * v[0] * v[1] * jnp.cos(q[0] - q[1] + t)
    V = jnp.where(q[0] > 0.0, q[0] ** 2, jnp.abs(q[1])) - jnp.maximum(jnp.sin(q[0]), q[1])
    V = V + jnp.exp(-(q[1] ** 2)) + jnp.sqrt(1.0 + p["l"] ** 2) * jnp.tanh(q[0]) / (2.0 + q[1])
    return T - V


SYSTEM = jl.System(lagrangian, ("x", "y"))


def code():
    """(code of the body, its given numbers, the function of their array by JAX)."""
    program = lowered(SYSTEM, P).equations.program
    carried = _emit.prelude(program, P, jnp.zeros(0).dtype)
    state = {"t": [0.1], "q": [0.3, 0.8], "v": [0.2, -0.4]}
    read = [state[name][i] for name, i in program.inputs if name not in _emit.FIXED]
    count, one = len(program.carried), jnp.ones(())

    def by_jax(x):
        return jnp.stack(straight(program, x.dtype, [*x[:count], one], list(x[count:]), False))

    return body_of(program), jnp.concatenate([carried[:-1], jnp.stack(read)]), by_jax


def interpreted(code):
    """The function of an array of the given numbers."""
    function = _interpreter.interpreted(code, jnp.zeros(0).dtype, alone=True)
    return lambda x: function(*x)


@pytest.mark.full
def test_results_are_those_of_the_lines():
    body, x, by_jax = code()
    function = interpreted(body)
    np.testing.assert_allclose(jax.jit(function)(x), by_jax(x), rtol=4 * EPS)
    several = jnp.stack([x * (1.0 + 0.01 * i) for i in range(40)])  # more than a chunk of lanes
    found, expected = (jax.vmap(f)(several) for f in (function, by_jax))
    np.testing.assert_allclose(found, expected, rtol=4 * EPS)


def test_places_are_used_again():
    body, *_ = code()
    table = _interpreter.bytecode(body)
    assert len(table.start) < 0.5 * (len(body.lines) + len(body.given))


def test_results_may_be_given_constant_or_repeated():
    graph = Graph()
    q, p = graph.input("q", 0), graph.input("params", 0)
    above = graph.call(named("gt"), q, graph.const(0.5))
    roots = [q, p, graph.const(2.0), graph.mul(q, q), q, graph.select(above, p, graph.one)]
    function = interpreted(whole_of(assemble(graph, roots)))
    expected = [0.7, 0.4, 2.0, 0.7 * 0.7, 0.7, 0.4]
    np.testing.assert_allclose(function(jnp.array([0.7, 0.4])), expected, rtol=EPS)
    slopes = [[1, 0], [0, 1], [0, 0], [1.4, 0], [1, 0], [0, 1]]
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(function)(jnp.array([0.7, 0.4])), slopes, rtol=EPS)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_truth_values_may_be_given(mode):
    """A comparison of params, which the prelude carries into the body."""
    graph = Graph()
    q, p = graph.input("q", 0), graph.input("params", 0)
    above = graph.call(named("gt"), p, graph.const(0.5))
    program = assemble(graph, [graph.select(above, graph.mul(q, q), q)])
    assert len(program.prelude) == 1
    function = interpreted(body_of(program))
    for carried, slope in ((1.0, 1.4), (0.0, 1.0)):
        found = mode(lambda q, c=carried: function(jnp.array([c, 0.0]).at[1].set(q))[0])(0.7)
        np.testing.assert_allclose(found, slope, rtol=EPS)


def test_code_without_lines_or_numbers():
    graph = Graph()
    assert interpreted(whole_of(assemble(graph, [])))(jnp.zeros(0)).shape == (0,)
    found = interpreted(whole_of(assemble(graph, [graph.const(3.0)])))(jnp.zeros(0))
    assert found.tolist() == [3.0]


def test_rows_of_numbers_are_the_numbers():
    body, x, _ = code()
    function = _interpreter.interpreted(body, jnp.zeros(0).dtype, alone=True)
    parts = [x[:2], x[2], x[3:]]
    found = jax.jacrev(lambda *parts: function(*parts), (0, 1, 2))(*parts)
    expected = jax.jacrev(interpreted(body))(x)
    columns = jnp.concatenate([jnp.reshape(part, (len(expected), -1)) for part in found], axis=1)
    np.testing.assert_array_equal(columns, expected)
    np.testing.assert_array_equal(function(*parts), interpreted(body)(x))


@pytest.mark.full
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_lines(mode):
    body, x, by_jax = code()
    function, expected = interpreted(body), mode(by_jax)(x)
    tolerance = 16 * EPS * np.max(np.abs(expected))
    np.testing.assert_allclose(mode(function)(x), expected, rtol=0, atol=tolerance)
    lanes = jax.vmap(mode(function))(jnp.stack([x, 1.1 * x]))
    np.testing.assert_allclose(lanes[0], expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("mode", [jax.jvp, jax.vjp])
@pytest.mark.parametrize(("times", "m"), [(3, 1e13), (1, 1e25)])
def test_derivatives_of_divisions_stay_in_range(times, m, mode):
    """Of ((x / m) / m) / m and x / m in float32, which has no m^3 and no m^2."""
    graph = Graph()
    graph.flat = False
    x, divisor = graph.input("q", 0), graph.input("q", 1)
    root = x
    for _ in range(times):
        root = graph.div(root, divisor)
    program = assemble(graph, [root])
    code = _interpreter.interpreted(whole_of(program), jnp.float32, alone=True)

    def function(*given):
        return code(*(given[i] for _, i in program.inputs))[0]

    size, zero = jnp.float32(m**times * 1e-9), jnp.float32(0.0)
    given = (size, jnp.float32(m))
    if mode is jax.jvp:
        along_x = jax.jvp(function, given, (size, zero))[1]
        along_m = jax.jvp(function, given, (zero, given[1]))[1]
    else:
        bars = jax.vjp(function, *given)[1](size)
        along_x, along_m = bars[0], bars[1] * given[1] / size
    np.testing.assert_allclose([along_x, along_m], [1e-9, -times * 1e-9], rtol=1e-6)


PAIRS = [(a, b) for a in (jax.grad, jax.jacfwd) for b in (jax.grad, jax.jacfwd)]


@pytest.mark.full
@pytest.mark.parametrize(("outer", "inner"), PAIRS)
def test_numbers_that_do_not_move_have_no_tangents(outer, inner):
    """q^2 + q sqrt(p) at p = 0, where the root has an infinite slope."""
    graph = Graph()
    q, p = graph.input("q", 0), graph.input("params", 0)
    program = assemble(graph, [graph.add(graph.mul(q, q), graph.mul(q, graph.sqrt(p)))])
    function = _interpreter.interpreted(whole_of(program), jnp.zeros(0).dtype, alone=True)

    def of_q(q):
        given = {"q": q, "params": jnp.zeros(())}
        return function(*(given[name] for name, _ in program.inputs))[0]

    np.testing.assert_allclose(inner(of_q)(0.7), 1.4, rtol=EPS)
    np.testing.assert_allclose(outer(inner(of_q))(0.7), 2.0, rtol=EPS)


def test_functions_whose_derivatives_have_no_code(monkeypatch):
    """Their derivatives are JAX's, of the same lines."""

    def without(*_):
        raise Unsupported("no code")

    monkeypatch.setattr(_interpreter, "tangent", without)
    body, x, by_jax = code()
    function = interpreted(Code(*body))  # another object: nothing is known of it
    for mode in (jax.jacfwd, jax.jacrev):
        expected = mode(by_jax)(x)
        tolerance = 16 * EPS * np.max(np.abs(expected))
        np.testing.assert_allclose(mode(function)(x), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("outer", "inner"),
    mostly_full(
        [(a, b) for a in (jax.jacfwd, jax.jacrev) for b in (jax.jacfwd, jax.jacrev)],
        [(jax.jacfwd, jax.jacrev)],
    ),
)
def test_second_derivatives_are_those_of_the_lines(outer, inner):
    body, x, by_jax = code()
    function, expected = interpreted(body), outer(inner(by_jax))(x)
    found = jax.jit(outer(inner(function)))(x)
    np.testing.assert_allclose(found, expected, rtol=0, atol=64 * EPS * np.max(np.abs(expected)))


def test_the_prelude_is_a_function_of_params():
    _, x, _ = code()
    program = lowered(SYSTEM, P).equations.program
    given = _emit.fixed_inputs(program, P, x.dtype, {})
    found = interpreted(prelude_of(program))(jnp.stack(list(given.values())))
    np.testing.assert_allclose(found, x[: len(program.carried)], rtol=4 * EPS)


@pytest.mark.full
def test_size_does_not_grow_with_the_code():
    """The same kinds of lines in chains of 3 and of 6 links."""

    def equations(n):
        def L(t, q, v, p):
            x, y = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
            return 0.5 * p * (x @ x + y @ y) + jnp.sum(jnp.cos(q))

        body = body_of(lowered(jl.System(L, {"q": (n,)}), 2.0).equations.program)
        function = _interpreter.interpreted(body, jnp.zeros(0).dtype, alone=True)
        given = [jnp.ones(())] * len(body.given)
        return len(body.lines), len(loop(operations(function, *given, iterations=1)))

    (short, few), (long, many) = equations(3), equations(6)
    assert long > 3 * short
    assert many == few


# ---- Rounding --------------------------------------------------------------------------------


def bounds(build, x):
    """(result, rounding) of one expression in q[0], and its value by the plain interpreter."""
    graph = Graph()
    program = assemble(graph, [build(graph, graph.input("q", 0))])
    given, whole = jnp.array([x]), whole_of(program)
    found = _interpreter.with_changes(whole, np.ones(1, bool), list(given), given.dtype)
    (exact,), (bound,) = found
    assert float(exact) == float(interpreted(whole)(given)[0])
    return float(exact), float(bound)


def test_rounding_has_the_size_of_the_terms():
    """sin^2 + cos^2 - 1 is at most a few roundings of 1."""

    def identity(graph, q):
        squares = [(graph.power(graph.call(f, q), 2), 1.0) for f in (SIN, COS)]
        return graph.sum(squares, -1.0)

    exact, bound = bounds(identity, 0.3)
    assert 0.25 < bound / EPS < 4.0
    assert abs(exact) < 4.0 * bound


def test_exact_lines_add_no_rounding():
    """Of |-q| only the rounding of q itself is left."""
    exact, bound = bounds(lambda graph, q: graph.call(ABS, graph.scale(q, -1.0)), 0.3)
    assert exact == 0.3
    assert 0.25 < bound / (0.3 * EPS) < 1.5


def test_runs_decide_as_the_exact_one():
    """Beside a jump of 100, changed values are on the other side of it."""

    def jump(graph, q):
        above = graph.call(named("gt"), q, graph.const(0.5))
        return graph.select(above, graph.const(100.0), graph.zero)

    assert bounds(jump, 0.5 * (1.0 + 2.0 * EPS)) == (100.0, 0.0)


# ---- Columns of Jacobians --------------------------------------------------------------------


def chain(n):
    """A chain of n links."""

    def L(t, q, v, p):
        x, y = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
        return 0.5 * p["m"] * (x @ x + y @ y) + p["g"] * jnp.sum(jnp.cos(q))

    return jl.System(L, {"q": (n,)})


def in_steps(monkeypatch, system, interpreted_from):
    """Accelerations as the steps of a solve evaluate them: a function of (q, params)."""
    monkeypatch.setattr(_emit, "INLINE_UP_TO", -1)
    monkeypatch.setattr(_emit, "COLUMNS_FROM", interpreted_from)
    program = lowered(system, {"m": 1.2, "g": 9.8}).equations.program

    def accelerations(q, params):
        carried = _emit.prelude(program, params, q.dtype)
        return _emit.body(program, carried, jnp.zeros(()), q, 0.3 - q, {}, jacobians=True)

    return accelerations


@pytest.mark.full
@pytest.mark.parametrize("argument", [0, 1, (0, 1)])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_columns_are_the_single_tangents(monkeypatch, mode, argument):
    """Four coordinates, so four columns or rows; one or two params, with and without the state."""
    function = in_steps(monkeypatch, chain(4), -1)
    q, params = jnp.array([0.3, -0.4, 0.9, 0.1]), {"m": jnp.array(1.2), "g": jnp.array(9.8)}
    found = mode(function, argument)(q, params)
    given = (q, params)

    def along(part, i):
        """A central difference along the i-th number of an argument, and its size."""
        flat, unflatten = jax.flatten_util.ravel_pytree(given[part])

        def at(h):
            moved = list(given)
            moved[part] = unflatten(flat.at[i].add(h))
            return np.asarray(function(*moved))

        return (at(1e-6) - at(-1e-6)) / 2e-6

    parts = argument if isinstance(argument, tuple) else (argument,)
    for part, slopes in zip(parts, found if len(parts) > 1 else (found,), strict=True):
        columns = jnp.concatenate(
            [jnp.reshape(x, (4, -1)) for x in jax.tree.leaves(slopes)], axis=1
        )
        expected = np.stack([along(part, i) for i in range(columns.shape[1])], axis=1)
        np.testing.assert_allclose(columns, expected, atol=1e-8 * np.max(np.abs(expected)))
        singles = [jax.jvp(lambda q: function(q, params), (q,), (e,))[1] for e in np.eye(4)]
        if part == 0:
            atol = 64 * EPS * np.max(np.abs(expected))
            np.testing.assert_allclose(columns, np.stack(singles, 1), rtol=0, atol=atol)


@pytest.mark.full
def test_second_derivatives_beside_columns(monkeypatch):
    function = in_steps(monkeypatch, chain(4), -1)
    q, params = jnp.array([0.3, -0.4, 0.9, 0.1]), {"m": jnp.array(1.2), "g": jnp.array(9.8)}
    found = jax.jacfwd(jax.jacrev(function))(q, params)
    other = in_steps(monkeypatch, chain(4), 10**6)
    expected = jax.jacfwd(jax.jacrev(other))(q, params)
    atol = 256 * EPS * np.max(np.abs(expected))
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@pytest.mark.full
def test_columns_of_long_code_are_not_compiled_line_by_line(monkeypatch):
    params = {"m": 1.2, "g": 9.8}

    def products(n, interpreted_from):
        """Operations of the Jacobian that are not those of the value."""
        function = in_steps(monkeypatch, chain(n), interpreted_from)
        q, counts = jnp.linspace(0.1, 0.9, n), []
        for f in (function, jax.jacfwd(function)):
            counts.append(jax.jit(f).lower(q, params).as_text().count("stablehlo.multiply"))
        return counts[1] - counts[0]

    assert products(6, -1) < products(4, -1) + 8
    assert products(6, 10**6) > 1.5 * products(4, 10**6) > 6 * products(4, -1)


@pytest.mark.full
def test_single_tangents_and_explicit_methods_use_compiled_derivatives(monkeypatch):
    """Code for Jacobians is made only where they are computed."""

    def fails(*_):
        raise AssertionError

    monkeypatch.setattr(_emit, "COLUMNS_FROM", -1)
    monkeypatch.setattr(_emit, "INLINE_UP_TO", -1)
    monkeypatch.setattr(_outlined, "_columns", fails)

    def end(q, method):
        return jl.simulate(
            chain(4), q, jnp.zeros(4), [0.0, 0.1], {"m": 1.2, "g": 9.8}, method=method, dt=0.1
        ).q[-1]

    q = jnp.array([0.3, -0.4, 0.9, 0.1])
    for method in ("tsit5", "euler"):
        assert jax.jacfwd(partial(end, method=method))(q).shape == (4, 4)
    with pytest.raises(AssertionError):
        end(q, "kvaerno3")
