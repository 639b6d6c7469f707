"""The fuzzer: systems that it draws, errors that it detects, reports that it writes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from bench import fuzz
from bench.fuzz import _system_programs
from bench.fuzz._comparison import Compared
from bench.fuzz._random_systems import ONE, TWO, Drawn, draw, smaller, text
from bench.fuzz._rounding import CALLS, NUMPY, evaluated
from jaxlag._lowering import ScalarProgram
from jaxlag._system._inspection import check_traceable
from jaxlag._tracing._input_values import InputValues

SEEDS = range(40)
SMALL = Drawn(
    n=1,
    kinetic=(),
    potential=("({0}) * jnp.sin({1})", ('p["b"]',), ("q[0]",)),
    force=(("-({0})", ("v[0]",)),),
    masses=(2.0,),
    params={"a": [0.1, 0.2, 0.3], "b": 3.0, "k": 1.0},
    units=(1.0,),
    scale=1.0,
    dtype="float64",
    second=False,
)


def test_every_seed_draws_a_different_system():
    drawn = [draw(seed) for seed in SEEDS]
    assert drawn == [draw(seed) for seed in SEEDS]
    assert len({x.lagrangian for x in drawn}) == len(drawn)
    assert {x.dtype for x in drawn} == {"float32", "float64"}
    assert {x.n for x in drawn} == {1, 2, 3, 4, 5}
    used = " ".join(x.lagrangian for x in map(draw, range(300)))
    for template in (*ONE, *TWO):  # by the longest piece that every use contains
        assert max(template.replace("{1}", "{0}").split("{0}"), key=len) in used


def test_every_operation_exists_in_jax():
    q = jnp.array([0.3, -0.7])
    for template in (*ONE, *TWO):
        tree = (template, ("q[0]",), ("q[1]",))[: 2 + (template in TWO)]
        drawn = SMALL._replace(n=2, potential=tree, masses=(1.0, 1.0), units=(1.0, 1.0), force=())
        params = {"a": jnp.ones(3), "b": 1.0, "k": 1.0}
        L = jax.eval_shape(lambda d=drawn, p=params: d.system.lagrangian(0.0, q, q, p))
        assert L.shape == (), text(tree)


def test_smaller_systems_are_valid():
    drawn = draw(5)
    found = list(smaller(drawn))
    assert len(found) > 5
    assert min(len(x.lagrangian) for x in found) < len(drawn.lagrangian)
    for other in found[:5]:
        params = {"a": jnp.ones(3), "b": 1.0, "k": 1.0}
        check_traceable(other.system, params, jnp.float64, InputValues({}))


@pytest.mark.full
def test_wrong_program_is_detected_and_reported(monkeypatch):
    right = ScalarProgram.acceleration

    def wrong(self, *args, **options):
        a = right(self, *args, **options)
        return a + 1e-6 * jnp.sin(a)

    kind = fuzz.FREE._replace(draw=lambda seed: SMALL)
    monkeypatch.setattr(fuzz, "kind_of", lambda seed: kind)
    assert _system_programs.compared(SMALL).kind == "equal"
    monkeypatch.setattr(ScalarProgram, "acceleration", wrong)
    report = fuzz.run(True, seconds=1e-3, first=7)
    find = report.rows[-1]
    assert find["kind"].startswith("seed 7: ")
    assert find["systems"] > 1.0
    # Reduced as long as it differs: no force remains.
    assert find["declared"].startswith("L = 1.0 * (0.5 * (2.0 * v[0] ** 2) - (")
    assert "; Q = []; params = {'a': [0.1, " in find["declared"]
    assert [target.met for target in report.targets] == [False, True]


def test_a_run_draws_every_kind():
    """Of ten systems 3 are free, 3 constrained, 2 quasi, 1 has bodies, 1 a loop; some move."""
    names = [fuzz.kind_of(seed).name for seed in range(400)]
    assert set(names) == {kind.name for kind in fuzz.KINDS}
    parts = "free", "constrained", "quasi", "bodies"
    of = {part: sum(part in name for name in names) for part in parts}
    assert of == {"free": 120, "constrained": 120, "quasi": 80, "bodies": 40}
    assert 0 < sum("mov" in name or "motion" in name for name in names) < 20


def test_a_run_counts_what_it_compared(monkeypatch):
    """Until enough are equal; systems that cannot be compared do not count."""
    kind = fuzz.QUASI._replace(
        draw=lambda seed: seed,
        compared=lambda seed: Compared("equal" if seed % 2 else "not compared: odd", 0.25),
    )
    monkeypatch.setattr(fuzz, "kind_of", lambda seed: kind)
    monkeypatch.setattr(fuzz, "SYSTEMS", 3)
    report = fuzz.run(False)
    assert {row["kind"]: row["systems"] for row in report.rows} == {
        "equal": 3,
        "not compared: odd": 3,
        "equal, quasi": 3,
        "worst of the equal, over the bound": 0.25,
    }
    assert all(target.met for target in report.targets)


@pytest.mark.parametrize(
    ("off", "least", "most"),
    [(0.0, 0.0, 0.0), (1e-15, 0.0, 0.1), (1e-9, 1e3, 1e6), (np.nan, np.inf, np.inf)],
)
def test_differences_are_measured_relative_to_rounding(off, least, most):
    right = np.array([[[1.0, 2.0]], [[1.0 + 1e-15, 2.0]]])
    found = right[0] + off
    assert least <= _system_programs._off(right, found, right[0], 2.0**-52) <= most
    # If the array program has no value, any result is right.
    assert _system_programs._off(np.full_like(right, np.nan), found, right[0], 2.0**-52) == 0.0


def test_random_rounding_shows_the_digits_of_a_result():
    """(1 + x) - 1 has the digits of 1 + x; a result that is only moved has all digits."""

    def cancels(x):
        return jax.jit(lambda x: (1.0 + x) - 1.0)(x), -jnp.stack([x, x])[::-1]

    traced = jax.make_jaxpr(cancels)(1e-6)
    plain, moved = evaluated(traced, [jnp.asarray(1e-6)])
    assert (plain, *moved) == ((1.0 + 1e-6) - 1.0, -1e-6, -1e-6)
    rng = np.random.default_rng(0)
    eps = 2.0**-52
    several = [evaluated(traced, [jnp.asarray(1e-6)], eps, rng) for _ in range(20)]
    off = [float(abs(x[0] - 1e-6)) for x in several]
    assert 0.3 * eps < max(off) <= 1.7 * eps  # eps / 2 rounds once more
    assert all((x[1] == -1e-6).all() for x in several)


X = np.array([[0.3, -1.7, 0.0], [2.5, -0.4, 1.1]])
WHOLE = np.array([[3, -2, 0], [-5, 2, 7]], np.int32)


def _moves(x):
    y = lax.pad(x, x[0, 0], ((1, 0, 2), (0, 2, 0)))
    z = lax.pad(x, x[0, 0], ((-1, 0, 0), (0, -2, 1)))
    parts = [*lax.split(x, (1, 2), axis=1), jnp.concatenate([x, x[:, ::-1]], 1), x[:, ::2]]
    stacked = [jnp.stack([x, 2 * x], 1), *jnp.unstack(x, axis=1), x.T, x.reshape(3, 2), x[1, 2]]
    unchanged = [lax.stop_gradient(x), jnp.copy(x), lax.broadcast_in_dim(x[0], (2, 3, 4), (1,))]
    return y, z, parts, stacked, unchanged


def _numbers(x, k):
    signs = [-x, jnp.abs(x), jnp.sign(x), x % 2, jnp.maximum(x, k), jnp.minimum(x, k)]
    truths = [x > k, x >= k, x < k, x <= k, x == k, x != k, (x > k) & (x < 1), ~(x > k) | (x == 0)]
    sums = [x.sum(0), x.max(1), x.min(0), x @ k.T, jnp.einsum("ij,ij->i", x, k)]
    return signs, truths, sums, [x + k, x - k, x * k, x // k, jnp.where(x > k, x, k)]


def _functions(x):
    s = jnp.abs(x) + 0.1
    plain = [f(x) for f in (jnp.sin, jnp.cos, jnp.tanh, jnp.exp, jnp.expm1, jnp.floor)]
    positive = [f(s) for f in (jnp.sqrt, lax.rsqrt, jnp.log, jnp.log1p)]
    powers = [x**3, s**-3, jnp.square(x), x / s, jnp.arctan2(x, s)]
    return plain, positive, powers, x.astype(jnp.float32), x.astype(int), WHOLE.astype(float) * x


def _solves(x):
    def solve(b):
        return lax.custom_linear_solve(lambda y: 2.0 * y, b, lambda _, b: 0.5 * b, symmetric=True)

    return solve(x), jax.jvp(solve, (x,), (x,))[1], jax.vjp(solve, x)[1](x)[0]


def _loops(x):
    def step(carry, x_i):
        return 0.5 * carry + x_i, carry * x_i

    once = lax.scan(step, x[0], x)
    backward = lax.scan(step, x[0], x, reverse=True)
    branch = lax.cond(x[0, 0] > 0.0, jnp.sin, jnp.cos, x)
    grown = jax.grad(lambda x: lax.fori_loop(0, 3, lambda i, y: jnp.sin(y + i), x).sum())(x)
    key = jax.random.key(3)
    return once, backward, branch, grown, jax.random.normal(jax.random.split(key)[0], (3,))


def _primitives(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        if eqn.primitive.name in CALLS:
            yield from _primitives(eqn.params[CALLS[eqn.primitive.name]].jaxpr)


CALLED = [
    (_moves, X),
    (_numbers, X, X[::-1].copy()),
    (_numbers, WHOLE, WHOLE[::-1] + (WHOLE[::-1] == 0)),
    (_functions, X),
    (_loops, X),
    (_solves, X),
    (lambda x: jax.linearize(jnp.sin, x)[1](x) + lax.iota(float, 3), X[0]),
]


@pytest.mark.full
@pytest.mark.parametrize("case", CALLED, ids=lambda case: case[0].__name__.strip("_"))
def test_operations_equal_those_of_jax(case):
    f, *args = case
    traced = jax.make_jaxpr(f)(*args)
    found = evaluated(traced, args)
    right = jax.tree.leaves(f(*map(jnp.asarray, args)))
    for x, y in zip(found, map(np.asarray, right), strict=True):
        assert x.dtype == y.dtype
        assert x.shape == y.shape
        if x.dtype.kind == "f":
            np.testing.assert_array_max_ulp(x, y, 4)
        else:
            np.testing.assert_array_equal(x, y)


def test_every_operation_is_tested():
    tried = {name for f, *args in CALLED for name in _primitives(jax.make_jaxpr(f)(*args).jaxpr)}
    tried |= {"add_any"}  # from sums in derivatives
    assert set(NUMPY) <= tried


def test_random_rounding_applies_inside_loops():
    traced = jax.make_jaxpr(lambda x: lax.scan(lambda c, _: (c * x, None), x, None, 3)[0])(1.1)
    rng = np.random.default_rng(0)
    off = [float(evaluated(traced, [np.float64(1.1)], 1e-3, rng)[0]) / 1.1**4 - 1 for _ in range(9)]
    assert 1e-3 < max(map(abs, off)) < 3e-3  # of three operations, more than one rounding
