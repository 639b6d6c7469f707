"""Difficult declarations: the scalar program agrees with JAX or falls back with a reason.

The graph is checked without compilation; the full run checks the emitted code.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _lowered import lowered

import jaxlag as jl
from jaxlag._lowering import _lower
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._symbolic._bias_forms import degree
from jaxlag._lowering._symbolic._evaluate import evaluate
from jaxlag._tracing._interpret import NUMPY, interpret

EPS = np.finfo(float).eps
KEY, OLD_KEY = jax.random.key(0), jax.random.PRNGKey(0)
STATES = np.random.default_rng(3).uniform(-1.5, 1.5, (4, 2, 3))


@pytest.fixture(autouse=True)
def _lenient():
    """As for users: integers and real numbers may be mixed."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@jax.custom_jvp
def scaled(x, k):
    """A function with one rule for x and k together."""
    return x * k


@scaled.defjvp
def _(primals, tangents):
    return scaled(*primals), tangents[0] * primals[1]


def kinetic(v):
    return 0.5 * v @ v


def plain(potential):
    """L = v.v/2 - V(q)."""
    return lambda t, q, v, p: kinetic(v) - potential(q)


def halves(q):
    """Integers that Python and C round differently: -1 // 2."""
    return ((jnp.arange(3) - 1) // 2)[: q.size] @ q


# name: (L, number of coordinates); ARRAY has no scalar program, SCALAR has one
ARRAY = {
    "truths in a product": (plain(lambda q: jnp.dot(q > 0, jnp.array([True, True])) * q[0]), 2),
    "a rule for integers": (plain(lambda q: scaled(q[0], 3) ** 2), 2),
    "a rule for truths": (plain(lambda q: scaled(q[0], q[1] > 0) ** 2), 2),
    "infinite power": (plain(lambda q: (0.1 * jnp.sin(q[0])) ** jnp.inf), 2),
    "mixed precision": (plain(lambda q: jnp.float32(2.0) * q[0].astype(jnp.float32) ** 2), 2),
    "sorting": (plain(lambda q: jnp.sort(q)[0] ** 2), 2),
    "an index that moves": (plain(lambda q: q[jnp.argmax(q)] ** 2), 2),
    "complex numbers": (plain(lambda q: jnp.real(jnp.exp(1j * q[0]))), 2),
    "Fourier": (plain(lambda q: jnp.abs(jnp.fft.fft(q)).sum()), 2),
    "a matrix inverted": (plain(lambda q: jnp.linalg.inv(jnp.eye(2) + jnp.outer(q, q))[0, 0]), 2),
    "a norm of zero": (plain(lambda q: jnp.linalg.norm(q - q)), 2),
    "narrow integers": (
        plain(lambda q: ((q > 0).astype(jnp.int8) * jnp.int8(100)).astype(float).sum() * q[0]),
        2,
    ),
    "bits": (plain(lambda q: jnp.sum(~(q > 0).astype(jnp.int32)).astype(float) * q[0]), 2),
}
SCALAR = {
    "a stopped velocity": (
        lambda t, q, v, p: 0.5 * v @ v - 0.5 * q @ q - jax.lax.stop_gradient(2 * v[0]) * q[0],
        1,
    ),
    "a clipped velocity": (
        lambda t, q, v, p: kinetic(v) + jnp.sin(q[1]) * jnp.clip(v[0], -0.5, 0.5),
        2,
    ),
    "a choice by velocity": (
        lambda t, q, v, p: kinetic(v) - jnp.where(v[0] > 0.2, 5 * q[0], q[0]),
        1,
    ),
    "speed as a root": (lambda t, q, v, p: kinetic(v) + jnp.sqrt(1.0 + (v @ v) ** 2), 2),
    "|v|": (lambda t, q, v, p: kinetic(v) - jnp.abs(v[0]) * q[1], 2),
    "|q|": (plain(lambda q: jnp.abs(q[0])), 2),
    "a slope with a corner": (plain(lambda q: jnp.where(q[0] > 0, 1.0, -2.0) * q[0]), 2),
    "integer division": (plain(halves), 2),
    "integers that wrap": (
        plain(lambda q: (jnp.int8(100) + jnp.int8(100)).astype(float) * q[0]),
        2,
    ),
    "nothing summed": (plain(lambda q: jnp.sum(q[:0]) + q[0] ** 2), 2),
    "nothing multiplied": (plain(lambda q: jnp.prod(q[:0]) * q[0] ** 2), 2),
    "the largest of nothing": (plain(lambda q: jnp.max(q[:0], initial=1.5) * q[0] ** 2), 2),
    "and, not": (plain(lambda q: jnp.where((q[0] > 0) & ~(q[1] > 0), q[0], q[1]) ** 2), 2),
    "bits of numbers": (plain(lambda q: (jnp.arange(2) & 1) @ q), 2),
    "known truths": (plain(lambda q: jnp.dot(jnp.array([True, False]), True) @ q), 2),
    "random numbers": (plain(lambda q: jax.random.normal(KEY, (2,)) @ q), 2),
    "random numbers, old key": (plain(lambda q: jax.random.normal(OLD_KEY, (2,)) @ q), 2),
    "hypot": (plain(lambda q: jnp.hypot(q[0], q[1])), 2),
    "mod": (plain(lambda q: jnp.mod(q[0], 1.0) ** 2), 2),
    "fmod": (plain(lambda q: jnp.fmod(q[0], 0.3)), 2),
    "a filling of one's own": (
        plain(lambda q: jnp.take(q, jnp.array([0, 5]), mode="fill", fill_value=7.0).sum() * q[0]),
        2,
    ),
    "NaN for a filling": (
        plain(lambda q: jnp.where(q[0] > 9, jnp.take(q, 5, mode="fill"), 1.0) * q[0] ** 2),
        2,
    ),
    "a clipped index": (plain(lambda q: jnp.take(q, jnp.array([0, 5]), mode="clip") @ q), 2),
    "the larger of two": (plain(lambda q: jnp.maximum(q[0] ** 2, q[1] ** 2)), 2),
    "a choice of programs": (
        plain(lambda q: jax.lax.cond(q[0] > 0, lambda x: x**2, lambda x: 2 * x**2, q[0])),
        2,
    ),
    "rounding": (plain(lambda q: jnp.round(q[0]) * q[0]), 2),
    "floor": (plain(lambda q: jnp.floor(2.0 * q[0]) * q[1]), 2),
    "Bessel": (plain(lambda q: jax.scipy.special.i0(q[0])), 2),
    "log-sum-exp": (plain(jax.nn.logsumexp), 2),
    "relu": (plain(lambda q: jax.nn.relu(q).sum()), 2),
    "nan_to_num": (plain(lambda q: jnp.nan_to_num(q).sum()), 2),
    "arctan2": (plain(lambda q: jnp.arctan2(q[0], q[1])), 2),
    "a polynomial": (plain(lambda q: jnp.polyval(jnp.array([1.0, 2.0, 3.0]), q[0])), 2),
    "a triangle": (
        lambda t, q, v, p: (
            0.5 * jnp.sum((jnp.tril(jnp.outer(q, q)).T @ v) ** 2) + kinetic(v) - jnp.cos(q[0])
        ),
        2,
    ),
    "a derivative in L": (plain(lambda q: jax.grad(lambda x: jnp.sum(x**3))(q) @ q), 2),
    "vmap in L": (plain(lambda q: jax.vmap(lambda x: x**2 * jnp.sin(x))(q).sum()), 2),
    "a running product": (plain(lambda q: jnp.cumprod(q)[-1] * q[0]), 2),
    "a running maximum": (plain(lambda q: jax.lax.cummax(q) @ q), 2),
    "a table read off": (plain(lambda q: jnp.array([1.0, 4.0, 9.0])[jnp.array([2, 0])] @ q), 2),
    "differences of coordinates": (
        plain(lambda q: (q[0] - q[1]) ** 4 + (q[0] - q[2]) ** 4 + jnp.cos(q[1] - q[2])),
        3,
    ),
    "time": (lambda t, q, v, p: 0.5 * (1.0 + t**2) * v @ v - jnp.cos(t) * q[0] ** 2, 2),
    "terms linear in v": (lambda t, q, v, p: kinetic(v) + q[0] * v[1] - t * v[0] * q[1], 2),
    "fourth powers of v": (lambda t, q, v, p: kinetic(v) + 0.1 * jnp.sum(v**4) * q[0] ** 2, 2),
}
ALL = ARRAY | SCALAR


def declared(name, lowering="auto"):
    lagrangian, n = ALL[name]
    return jl.System(lagrangian, tuple(f"x{i}" for i in range(n)), lowering=lowering)


def by_array_program(system, q, v):
    """M a + h = 0 with M and h by JAX, interpreted in numpy."""
    array = system._terms
    at = np.array(0.3), q, v
    M, h = (
        interpret(jax.make_jaxpr(lambda t, q, v, f=f: f(t, q, v, None))(*at), *at)[0]
        for f in (array.mass, array.bias)
    )
    return np.linalg.solve(M, -h)


@pytest.mark.full
@pytest.mark.parametrize("name", SCALAR)
def test_the_graph_agrees_with_jax(name):
    system = declared(name)
    found = lowered(system)
    assert found.equations is not None, found.reason
    for q, v in STATES[:, :, : system.size]:
        values = {("t", 0): 0.3, ("sense", 0): 1.0}
        values |= {("q", i): x for i, x in enumerate(q)} | {("v", i): x for i, x in enumerate(v)}
        a = [float(x) for x in evaluate(found.equations.accelerations, values)]
        expected = by_array_program(system, q, v)
        np.testing.assert_allclose(a, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ARRAY)
def test_fallbacks_to_the_array_program_have_a_reason(name):
    found = lowered(declared(name))
    assert found.equations is None
    # No reason is an internal error: each is one of the expected ones.
    assert "no scalar program" not in found.reason
    assert found.reason


@pytest.mark.full
@pytest.mark.parametrize("name", ALL)
def test_the_code_agrees_with_jax(name):
    auto, array = declared(name), declared(name, "array")
    for q, v in STATES[:, :, : auto.size]:
        a, b = (np.asarray(s.acceleration(q, v, t=0.3)) for s in (auto, array))
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


# ---- Conditions of the forms ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["a stopped velocity", "a clipped velocity", "a choice by velocity", "|v|", "speed as a root"],
)
def test_quadratic_forms_are_used_only_for_quadratic_lagrangians(name):
    """In most of these M does not depend on v, although L is not a polynomial."""
    system = declared(name)
    equations = lowered(system).equations
    assert equations.form.startswith("derivative of the momentum")
    assert "L quadratic in v" not in system.explain(None)


def test_degrees_of_expressions_are_right():
    graph = Graph()
    x, y = graph.input("v", 0), graph.input("q", 0)
    half = graph.scale(graph.mul(x, x, graph.call(*_sine(y))), 0.5)
    wanted = {
        2.0: [half, graph.add(half, x), graph.mul(x, x)],
        1.0: [x, graph.mul(x, graph.power(y, -3))],
        0.0: [y, graph.one, graph.call(*_sine(y))],
        3.0: [graph.mul(half, x)],
        np.inf: [graph.call(*_sine(x)), graph.power(x, -1), graph.stop(x)],
    }
    for expected, roots in wanted.items():
        for root in roots:
            assert degree([root], [x]) == expected
    assert degree([x, half], [x]) == 2.0


def _sine(x):
    from jaxlag._lowering._graph._expression import SIN

    return SIN, x


@pytest.mark.parametrize("name", ["|q|", "a slope with a corner"])
def test_kinks_are_not_reported_as_linear(name):
    assert "equations linear" not in declared(name).explain(None)


def test_linear_equations_are_reported():
    springs = plain(lambda q: 0.5 * (q[0] - q[1]) ** 2 + q[0])
    assert "equations linear" in jl.System(springs, ("x", "y")).explain(None)


def test_time_dependent_mass_is_reported():
    text = declared("time").explain(None)
    assert "M depends on t;" in text


# ---- What fails ----------------------------------------------------------------------------------


def test_internal_errors_fall_back_with_a_reason(monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("somewhere\nelse")

    monkeypatch.setattr(_lower, "derive", broken)
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - q @ q, ("x",))
    assert lowered(system).reason == "no scalar program: ZeroDivisionError: somewhere"
    np.testing.assert_allclose(system.acceleration([0.5], [0.0]), [-1.0])


def test_errors_of_the_declaration_are_raised():
    system = jl.System(lambda t, q, v, p: 0.5 * v * v, ("x", "y"))
    with pytest.raises(
        ValueError, match=r"^`lagrangian` must return a real scalar, but it returned"
    ):
        system.acceleration([0.0, 0.0], [0.0, 0.0])


MOVED = {
    "broadcast_in_dim": lambda x: jnp.broadcast_to(x[:, None], (2, 4, 3)),
    "reshape": lambda x: x.reshape(3, 2),
    "transpose": lambda x: x.T,
    "squeeze": lambda x: x[:1].squeeze(),
    "concatenate": lambda x: jnp.concatenate([x, 2 * x], axis=1),
    "stack": lambda x: jnp.stack([x, 2 * x], axis=1),
    "rev": lambda x: x[:, ::-1],
    "slice": lambda x: x[:, 1:3],
    "reduce_sum": lambda x: x.sum(0),
    "reduce_max": lambda x: x.max(1),
    "reduce_min": lambda x: x.min(1),
    "reduce_prod": lambda x: x.prod(0),
    "cumsum": lambda x: jnp.cumsum(x, axis=1),
    "cumprod": lambda x: jax.lax.cumprod(x, axis=1, reverse=True),
    "dot_general": lambda x: jnp.einsum("ij,kj->ki", x, 2 * x),
    "select_n": lambda x: jnp.where(x > 0.2, x, -x),
    "integer_pow": lambda x: x**-3,
    "pow": lambda x: jnp.abs(x) ** 1.5,
    "div": lambda x: x / (1.0 + x),
    "rsqrt": lambda x: jax.lax.rsqrt(1.0 + x**2),
    "unstack": lambda x: sum(jnp.unstack(x, axis=1)),
    "split": lambda x: jnp.split(x, 3, axis=1)[1],
    "pad": lambda x: jax.lax.pad(x, 1.0, ((1, -1, 0), (0, 2, 1))),
    "iota": lambda x: jax.lax.broadcasted_iota(jnp.int32, x.shape, 1) + x,
}


def test_interpreter_agrees_with_jax():
    """It checks the programs, so it is checked itself; all in one compiled program."""
    x = np.random.default_rng(0).uniform(0.1, 2.0, (2, 3))
    programs = {name: jax.make_jaxpr(f)(x) for name, f in MOVED.items()}
    expected = jax.jit(lambda x: {name: f(x) for name, f in MOVED.items()})(x)
    for name, closed in programs.items():
        assert name in str(closed)
        np.testing.assert_allclose(interpret(closed, x)[0], expected[name], rtol=8 * EPS)
    shared = {"broadcast_in_dim", "reshape", "transpose", "squeeze", "concatenate", "stack"}
    assert shared | {"rev", "slice"} <= set(MOVED) & set(NUMPY)


# ---- Singular, ties, integers -----------------------------------------------------------


def test_one_singular_block_makes_all_accelerations_nan():
    """For any coordinate, as in the array program; the motion fails at its start."""
    lagrangian = lambda t, q, v, p: 0.5 * p @ v**2 - q @ q  # noqa: E731
    system = jl.System(lagrangian, ("x", "y"))
    for masses in ([1.0, 0.0], [0.0, 1.0], [1.0, -1.0]):
        params = np.array(masses)
        assert np.all(np.isnan(system.acceleration([1.0, 2.0], [0.0, 0.0], params)))
    motion = jl.simulate(
        system, [1.0, 2.0], [0.0, 0.0], [0.0, 1.0], np.array([1.0, 0.0]), throw=False
    )
    assert motion.status == jl.Status.mass_singular
    assert np.all(np.isnan(motion.q[-1]))


TIES = {
    "max": jnp.max,
    "min": jnp.min,
    "maximum": lambda q: jnp.maximum(q[0], q[1]),
    "clip": lambda q: jnp.clip(q[0], 1.0, 2.0) + q[1],
    "abs": lambda q: jnp.abs(q[0] - q[1]),
    "1-norm": lambda q: jnp.linalg.norm(q, 1),
    "max-norm": lambda q: jnp.linalg.norm(q, jnp.inf),
    "relu": lambda q: jax.nn.relu(q[0] - 1.0) + q[1],
    "cummax": lambda q: jax.lax.cummax(q)[1],
    "logaddexp": lambda q: jnp.logaddexp(q[0], q[1]),
    "hypot": lambda q: jnp.hypot(q[0] - 1.0, q[1] - 1.0),
    "norm": lambda q: jnp.linalg.norm(q - 1.0),
}


@pytest.mark.full
@pytest.mark.parametrize("name", TIES)
def test_ties_have_the_derivative_of_jax(name):
    """At exactly equal arguments: q = (1, 1)."""
    equations = lowered(jl.System(plain(TIES[name]), ("x", "y"))).equations
    assert equations is not None
    values = {("q", 0): 1.0, ("q", 1): 1.0, ("v", 0): 0.0, ("v", 1): 0.0, ("t", 0): 0.0}
    found = [float(x) for x in evaluate(equations.accelerations, values)]
    slope = jax.make_jaxpr(jax.grad(TIES[name]))(jnp.ones(2))
    np.testing.assert_array_equal(found, -interpret(slope, np.ones(2))[0])


@pytest.mark.parametrize("u", [2, np.array(2), np.int32(2), jl.TimeFunction(lambda t: 2)])
def test_integers_are_accepted_as_inputs(u):
    force = jl.GeneralizedForce(lambda t, q, v, p, u: jnp.stack([u["u"]]), "push")
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x",), forces=[force])
    Q = system.generalized_force([0.0], [0.0], t=0.0, inputs={"u": u})
    np.testing.assert_array_equal(Q, [2.0])
