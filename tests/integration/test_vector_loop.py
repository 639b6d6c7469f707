"""Loops over lanes on numbers: the parts of a turn, and motions equal to those by other loops."""

import functools
import os
import subprocess
import sys
from collections import Counter

import diffrax
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxlag as jl
from jaxlag import Status
from jaxlag._core import _batching, _xla
from jaxlag._core._buffer_entries import set_entry
from jaxlag._core._jaxprs import equations
from jaxlag._integration import _vector_loop
from jaxlag._integration._vector_loop import NotVectorizable, _lane_loop, lane_loop
from jaxlag._integration._vector_loop._divisions import with_fewer_divisions
from jaxlag._integration._vector_loop._flat_program import flat
from jaxlag._integration._vector_loop._lane_map import lane_map
from jaxlag._integration._vector_loop._on_numbers import on_numbers

EPS = np.finfo(float).eps


# ---- The parts -----------------------------------------------------------------------------------


def test_map_over_lanes_calls_the_function_for_each():
    """Of numbers of several dtypes, with more results of one dtype than arguments of it."""
    rows = jnp.linspace(0.0, 1.0, 16), jnp.arange(16, dtype=jnp.int32)

    def function(x, k):
        return [x * x, k + 1, k > 3, 2.0 * x, x + 1.0]

    kinds = [jnp.float64, jnp.int32, jnp.bool_, jnp.float64, jnp.float64]
    found = jax.jit(lambda *rows: lane_map(function, rows, kinds))(*rows)
    for a, b in zip(found, jax.vmap(function)(*rows), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def every_form(x, k, b):
    """Moves, sums, selections, comparisons and powers of small arrays, and calls."""
    y = jnp.concatenate([x[::-1], 2.0 * x[:1], jnp.stack([x[1], x[2]])]).reshape(2, 3).T
    y = jnp.where(y > 0.3, y, jnp.where(b, y**3, jax.jit(jnp.sqrt)(jnp.abs(y))))
    largest = jnp.max(y, axis=0, keepdims=True)
    parts = jnp.sum(y, 1), jnp.prod(y, 0), jnp.any(y > 1.0), jnp.all(y < 9.0, 0), jnp.min(y)
    products = x @ x, y @ x[:2], jnp.outer(x, x), jnp.einsum("ij,ik->ijk", y, y)
    parts += products, [(s * x) ** 0.3 for s in (-1.0, jnp.inf, 0.0)]
    more = jax.nn.relu(y) ** 0.25, lax.clamp(0.1, x, 0.5), k // 2 + jnp.arange(3), jnp.exp(-y)
    return parts, more, jnp.squeeze(largest), jnp.sign(x) * jnp.floor(3.0 * x), jnp.isfinite(y)


def test_programs_on_numbers_have_the_values_of_those_on_arrays():
    x, k, b = jnp.array([0.2, -0.7, 1.3]), jnp.array(5), jnp.array(True)
    program, _ = flat(lambda *args: jax.tree.leaves(every_form(*args)), x, k, b)
    numbers = on_numbers(program, program.inputs, program.outputs)
    assert all(numbers.avals[x].shape == () for one in numbers.operations for x in one.results)
    found = iter(numbers([], [*x, k, b]))
    for whole in jax.tree.leaves(every_form(x, k, b)):
        alone = jnp.array([next(found) for _ in range(whole.size)]).reshape(whole.shape)
        np.testing.assert_allclose(alone, whole, rtol=4 * EPS, atol=4 * EPS)
    assert next(found, None) is None


def test_shared_and_double_divisions_become_products():
    def function(x, y, z):
        per_step = 1.0 / y
        return [x / per_step, z / per_step, x / z, y / z, x / (x + y)]

    given = jnp.array(0.7), jnp.array(1e-3), jnp.array(3.0)
    program, _ = flat(function, *given)
    fewer = with_fewer_divisions(program)
    counts = [Counter(one.name for one in p.operations)["div"] for p in (program, fewer)]
    assert counts == [6, 3]  # 1 / y, 1 / z and the last
    np.testing.assert_allclose(fewer([], given), program([], given), rtol=EPS, atol=0)
    # Quotients of integers are none of these.
    program, _ = flat(lambda k, n: [k // n, (k + 1) // n], jnp.array(7), jnp.array(2))
    assert [int(x) for x in with_fewer_divisions(program)([], [7, 2])] == [3, 4]


# ---- Loops ---------------------------------------------------------------------------------------

TABLE = np.array([0.0, 0.5, 1.5, 3.0, 7.0])


def collect(start, factor):
    """x grows by a factor until 5; the first values beyond the entries of a table are kept.

    The state has numbers that change and nobody needs, that do not change, and a buffer.
    """

    def cond(c):
        return c[0] < 5.0

    def body(c):
        x, due, kept, count, unneeded, _ = c
        going = x < 5.0
        grown = jnp.where(going, x * factor, x)
        passed = going & (grown > jnp.asarray(TABLE)[due])
        kept = set_entry(kept, jnp.where(passed, due, 4), grown)
        turns = count + jnp.where(going, 1, 0)
        return grown, due + jnp.where(passed, 1, 0), kept, turns, unneeded + grown, factor

    zero = jnp.zeros((), jnp.int64)
    init = start, zero, jnp.zeros(5), zero, jnp.array(0.0), factor
    return cond, body, lambda c: (c[2][:4], c[3]), init


def by_hand(start, factor):
    x, due, kept, count = start, 0, np.zeros(5), 0
    while x < 5.0:
        x, count = x * factor, count + 1
        passed = x > TABLE[due]
        kept[due if passed else 4] = x
        due += passed
    return kept[:4], count


@pytest.mark.parametrize("count", [1, 16, 33, 100])
def test_loop_over_lanes_ends_for_each_by_itself(count):
    """Fewer, as many and more than there are lanes; some are done at the start."""
    starts, factors = np.linspace(0.1, 5.2, count), np.linspace(1.2, 1.6, count)
    kept, counts = jax.jit(jax.vmap(lambda *x: lane_loop(*collect(*x))))(starts, factors)
    for i, (start, factor) in enumerate(zip(starts, factors, strict=True)):
        right, turns = by_hand(start, factor)
        np.testing.assert_allclose(kept[i], right, rtol=turns * EPS, atol=0)
        assert counts[i] == turns


def test_operations_on_nothing_come_before_a_turn():
    def loop(x):
        body = lambda x: x + jnp.sum(x[:0]) + x[:0] @ x[:0] + 1.0  # noqa: E731
        return lane_loop(lambda x: x[0] < 3.0, body, lambda x: x, x)

    np.testing.assert_array_equal(jax.vmap(loop)(jnp.zeros((5, 2))), np.full((5, 2), 3.0))


def maps_over_lanes(function, *args):
    """Number of operands of each lane map in a program."""
    program = equations(jax.make_jaxpr(function)(*args))
    return [len(eqn.outvars) for eqn in program if eqn.primitive.name == "reduce_window"]


def test_numbers_that_nothing_depends_on_are_left_out():
    """x, due, the number of turns, the table's entry, the factor and the write's index."""
    loop = jax.vmap(lambda *x: lane_loop(*collect(*x)))
    assert maps_over_lanes(loop, np.ones(16), np.full(16, 1.5)) == [6]


@pytest.mark.parametrize(
    ("rewrite", "name"),
    [
        (lambda x: jnp.sort(x * jnp.sin(x))[0] + x, "sort"),
        (lambda x: x + jnp.cumsum(x), "cumsum"),
    ],
)
def test_operations_without_a_form_on_numbers_are_named(rewrite, name):
    def loop(x):
        def body(x):
            for _ in range(_vector_loop._turn.MOST_BEFORE):
                x = jnp.sin(x)
            return rewrite(x)

        return lane_loop(lambda x: x[0] < 1.0, body, lambda x: x, x)

    with pytest.raises(NotVectorizable, match=name):
        jax.vmap(loop)(jnp.ones((16, 3)))


def thinned(start):
    """The numbers start, start + 1, ... up to 20; a buffer of 4 keeps one of `stride` of them.

    When it is full, every second one is dropped.
    """

    def cond(c):
        return c[0] < 20.0

    def body(c):
        x, k, stride, kept = c
        place = jnp.where(k % stride == 0, k // stride, 4)
        return x + 1.0, k + 1, stride, set_entry(kept, place, x)

    def is_full(c):
        return cond(c) & (c[1] >= 4 * c[2])

    def halved(c):
        x, k, stride, kept = c
        return x, k, 2 * stride, kept.at[:2].set(kept[:4:2])

    zero, one = jnp.zeros((), jnp.int64), jnp.ones((), jnp.int64)
    return cond, body, lambda c: c[1:], (start, zero, one, jnp.zeros(5)), is_full, halved


@pytest.mark.parametrize("starts", [[0.0], np.linspace(0.0, 20.5, 33), np.linspace(20.5, 0.0, 33)])
@pytest.mark.parametrize("times", [0, 1, 2])
def test_what_is_due_seldom_comes_between_turns(starts, times):
    """For buffers that are results as they are, once or twice, and for others.

    The last trajectory is the longest or the shortest: lanes without one do not write.
    """

    def loop(start):
        cond, body, results, *more = thinned(start)

        def given_back(c):
            counts, strides, kept = results(c)
            return counts, strides, kept if times else kept + 0.0, kept if times == 2 else counts

        return lane_loop(cond, body, given_back, *more)

    counts, strides, kept, again = jax.jit(jax.vmap(loop))(np.asarray(starts))
    np.testing.assert_array_equal(again, kept if times == 2 else counts)
    for i, start in enumerate(starts):
        steps = max(0, int(np.ceil(20.0 - start)))
        stride = 1
        while steps > 4 * stride:
            stride *= 2
        assert (counts[i], strides[i]) == (steps, stride)
        right = start + np.arange(0, steps, stride)
        np.testing.assert_array_equal(kept[i][: right.size], right)


# ---- Motions -------------------------------------------------------------------------------------


def pendulum(t, q, v, p):
    return 0.5 * p["J"] * v[0] ** 2 + p["mgl"] * jnp.cos(q[0])


SYSTEM = jl.System(pendulum, ("theta",))
TS = np.linspace(0.0, 2.0, 6)
TOLERANCE = 1e-6
ADAPTIVE = {"rtol": TOLERANCE, "atol": TOLERANCE}
CONTROLLED = (
    jl.solvers.Dopri5(),
    diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE, pcoeff=0.1, icoeff=0.9, dtmax=0.3),
)
# Rounding of an error estimate far below the tolerance changes the next step, and the states by a
# small part of the tolerance: up to 1e-9, measured.
CLOSE = {"rtol": 0, "atol": 1e-2 * TOLERANCE}


def options_of(method="tsit5", **options):
    controlled = "dt" in options or isinstance(method, tuple)
    return {"method": method, "throw": False} | options | ({} if controlled else ADAPTIVE)


def one(q0, params, **options):
    return jl.simulate(SYSTEM, q0, [0.3], TS, params, **options_of(**options))


def lanes(count):
    rng = np.random.default_rng(4)
    params = {"J": rng.uniform(0.1, 0.3, count), "mgl": rng.uniform(1.0, 4.0, count)}
    return jnp.asarray(rng.uniform(-2.0, 2.0, (count, 1))), jax.tree.map(jnp.asarray, params)


@pytest.fixture
def wide(monkeypatch):
    """A function that chooses between vectorized loops over some lanes, or none."""

    def choose(lanes, at_once=1024):
        monkeypatch.setattr(_lane_loop, "WIDTH", lanes)
        monkeypatch.setattr(_batching, "VECTORIZED", at_once)
        monkeypatch.setattr(_batching, "VECTORIZED_FROM", 1 if lanes else 10**9)
        monkeypatch.setattr(_batching, "TURNS", 1)
        jax.clear_caches()

    yield choose
    jax.clear_caches()


CPU = pytest.mark.skipif(not _xla.vectorizes(), reason="only on tested versions of jaxlib")


def same(a, b, **close):
    np.testing.assert_allclose(a.q, b.q, **close)
    np.testing.assert_allclose(a.v, b.v, **close)
    for name in ("accepted", "rejected"):
        np.testing.assert_array_equal(a.stats[name], b.stats[name])
    np.testing.assert_array_equal(a.status, b.status)


@CPU
def test_motions_equal_those_of_single_runs_and_do_not_depend_on_neighbours(wide):
    """37 in 16 lanes, and in 32 lanes in two parts and another order: the same bits.

    One is refused, one fails at its last step.
    """
    q0, params = lanes(37)
    params["J"] = params["J"].at[5].set(0.0)
    params["mgl"] = params["mgl"].at[6].set(1e5)  # fast beyond `max_steps`
    run = functools.partial(one, max_steps=300)
    alone = jax.jit(run)
    some = 0, 5, 6, 36
    singles = [alone(q0[i], jax.tree.map(lambda x, i=i: x[i], params)) for i in some]
    wide(16)
    found = jax.jit(jax.vmap(run))(q0, params)
    assert found.status[5] == Status.mass_singular
    assert found.status[6] == Status.max_steps
    for i, single in zip(some, singles, strict=True):
        same(found[i], single, **CLOSE)
    wide(32, at_once=20)
    order = np.random.default_rng(0).permutation(37)
    other = jax.jit(jax.vmap(run))(q0[order], jax.tree.map(lambda x: x[order], params))
    same(other, jax.tree.map(lambda x: x[order], found), rtol=0, atol=0)


@CPU
def test_a_loop_of_a_few_steps_is_not_vectorized():
    """Nor one of few lanes: each call has a fixed cost."""

    def vectorized(count, **options):
        return bool(maps_over_lanes(jax.vmap(lambda *x: one(*x, **options)), *lanes(count)))

    assert vectorized(64)
    assert vectorized(64, method=CONTROLLED)
    assert not vectorized(63)
    assert not vectorized(64, max_steps=16)
    (count,) = jax.export.symbolic_shape("b", constraints=["b >= 64"])
    assert not _batching.is_faster_vectorized(count, 16)


@pytest.mark.full
@CPU
@pytest.mark.parametrize("options", [{"dt": 0.01}, {"method": "dopri8"}, {"method": CONTROLLED}])
@pytest.mark.parametrize("reverse", [False, True])
def test_methods_agree_with_other_loops(wide, options, reverse):
    """Fixed and adaptive steps, both directions of time, a failed lane, one at its last step."""
    q0, params = lanes(20)
    fixed = "dt" in options
    params["mgl"] = params["mgl"].at[3].set(jnp.nan if fixed else 1e5)  # the latter is fast
    ts = TS[::-1] if reverse else TS

    def run(q0, params):
        return jl.simulate(SYSTEM, q0, [0.3], ts, params, **options_of(max_steps=300, **options))

    found = []
    for size in (None, 16):
        wide(size)
        found.append(jax.jit(jax.vmap(run))(q0, params))
    same(*found, **({"rtol": 0, "atol": 1e4 * EPS} if fixed else CLOSE))
    assert found[0].status[3] == (Status.nonfinite if fixed else Status.max_steps)


def child(code):
    """What a process without the options of the tests prints: these switch vector code off."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={k: v for k, v in os.environ.items() if not k.startswith(("XLA", "JAX"))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.full
@CPU
def test_code_is_vectorized():
    """Products of vectors in the code that LLVM made."""
    assert max(map(int, child(VECTOR_CODE))) > 100


VECTOR_CODE = """
import os, pathlib, re, tempfile
folder = tempfile.mkdtemp()
os.environ["XLA_FLAGS"] = f"--xla_dump_to={folder}"
import jax, jax.numpy as jnp
import jaxlag as jl
jax.config.update("jax_enable_x64", True)
L = lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0]) + 1.0 / jnp.sqrt(2.0 + q[0] ** 2)
pendulum = jl.System(L, ("theta",))
run = lambda q0: jl.simulate(pendulum, q0, [0.0], [0.0, 1.0], 9.81, throw=False).q
jax.jit(jax.vmap(run)).lower(jnp.ones((64, 1))).compile()
for path in pathlib.Path(folder).glob("*ir-with-opt.ll"):
    print(len(re.findall("fmul [a-z ]*<[48] x double>", path.read_text())))
"""


@pytest.mark.full
@CPU
def test_sines_are_as_accurate_in_vector_code():
    """XLA lets LLVM reassociate sums there, which would spoil the reduction modulo pi."""
    assert [float(x) for x in child(SINES)] <= [2.0, 2.0, 0.0]


SINES = """
import jax, jax.numpy as jnp, numpy as np
import jaxlag as jl
jax.config.update("jax_enable_x64", True)
from jaxlag._integration._vector_loop._lane_map import lane_map
from jaxlag._lowering._emit._sincos import sincos

def several(x, t, h):  # beside other results, so that nothing is a loop of its own
    s, c = sincos(x)
    return [s, c, (t + h) - t, x + s, c * t]

rng = np.random.default_rng(0)
x = np.concatenate([rng.uniform(-m, m, 2**14) for m in (3.0, 1e3, 1e6)])
t, h = np.full(x.shape, 1e3), rng.uniform(0.0, 1e-3, x.shape)
mapped = jax.jit(lambda *rows: lane_map(several, rows, [x.dtype] * 5))
s, c, step, *_ = map(np.asarray, mapped(x, t, h))
exact, eps = x.astype(np.longdouble), np.finfo(float).eps
print(np.max(np.abs((s - np.sin(exact)) / np.sin(exact))) / eps)
print(np.max(np.abs(c - np.cos(exact))) / eps)
print(np.max(np.abs(step - ((t + h) - t))))
"""
