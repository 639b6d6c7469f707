"""Calls compiled to one native function: values, derivatives, batches, and what they compile to."""

import re
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._core import _xla
from jaxlag._core._jaxprs import equations
from jaxlag._core._native_call import native_call
from systems.catalogue import ENTRIES

MARK = "xla_cpu_small_call"
MARKED = pytest.mark.skipif(not _xla.may_mark(), reason="only on tested versions of jaxlib")


def function(x, k, others):
    """Of arrays of several kinds; some arguments are results, unused or empty."""
    A = jnp.eye(3) + 0.1 * jnp.outer(x, x)
    y = jnp.linalg.qr(A)[1] @ x
    y = jax.lax.while_loop(lambda c: c[0] < k, lambda c: (c[0] + 1, jnp.sin(c[1]) + x), (0, y))[1]
    return {"y": y, "same": x, "k": k + 1, "any": jnp.any(y > 0.5), "two": 2.0}, others["empty"]


X, K = jnp.array([0.3, -0.2, 0.5]), jnp.array(2)
OTHERS = {"empty": jnp.zeros((0, 3)), "unused": jnp.arange(4), "flag": jnp.array([True])}


def called(x, k, others=OTHERS):
    return native_call(function, x, k, others)


def close(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert jnp.asarray(x).dtype == jnp.asarray(y).dtype
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14)


def test_results_are_those_of_the_function():
    right = function(X, K, OTHERS)
    close(called(X, K), right)
    close(jax.jit(called)(X, K), right)


@pytest.mark.parametrize("jit", [False, True])
def test_derivatives_and_batches_are_those_of_the_function(jit):
    def first(call):
        return lambda x: call(x, K, OTHERS)[0]["y"]

    xs = jnp.stack([X, 2.0 * X])
    transforms = (
        lambda f: jax.jacfwd(f)(X),
        lambda f: jax.vmap(f)(xs),
        lambda f: jax.vmap(jax.jacfwd(f))(xs),
        lambda f: jax.jacfwd(jax.vmap(f))(xs),
        lambda f: jax.jvp(f, (X,), (X,)),
    )
    for transform in transforms:
        of = (lambda f, t=transform: jax.jit(lambda: t(f))()) if jit else transform
        close(of(first(called)), of(first(function)))


def test_reverse_derivatives():
    def loss(call):
        return lambda x: jnp.sum(call(lambda x: jnp.cumsum(jnp.sin(x)) @ x, x) ** 2)

    found = jax.jit(jax.grad(loss(native_call)))(X)
    close(found, jax.grad(loss(lambda f, x: f(x)))(X))


def test_functions_with_effects_stay():
    def noisy(x):
        jax.debug.callback(lambda x: None, x)
        return 2.0 * x

    program = jax.make_jaxpr(lambda x: native_call(noisy, x))(X)
    assert all(eqn.primitive.name != "native_call" for eqn in equations(program))
    close(jax.jit(lambda x: native_call(noisy, x))(X), 2.0 * X)


@MARKED
def test_it_is_one_function():
    lowered = jax.jit(called).lower(X, K)
    assert MARK in lowered.as_text()
    assert "custom-call" not in str(lowered.compile().as_text())


@MARKED
def test_without_a_form_it_compiles_as_it_is(monkeypatch):
    def sorting(x):
        return jnp.sort(x) * 2.0

    compiled = jax.jit(lambda x: native_call(sorting, x)).lower(X).compile()
    assert MARK not in str(compiled.as_text())
    close(compiled(X), jnp.sort(X) * 2.0)
    monkeypatch.setenv(_xla.ATTRIBUTE_SWITCH, "0")
    assert MARK not in jax.jit(lambda x: called(x, K)).lower(X).as_text()


def odd(x, k):
    """A hidden operation of JAX 0.12, an unused random key, and more numbers than XLA adds up."""
    times = jnp.linspace(-1.0, 1.0, 9)
    return jnp.interp(x, times, times**2), jnp.sum(jnp.ones(20_000) * x[0]), k


def test_what_cannot_be_native_is_computed_too():
    key = jax.random.key(0)
    found = jax.jit(lambda x: native_call(lambda x, k: odd(x, k)[:2], x, key))(X)
    for a, b in zip(found, odd(X, key), strict=False):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    exported = jax.export.export(jax.jit(lambda x: native_call(lambda x: jnp.sum(x * x), x)))
    symbol = jax.ShapeDtypeStruct(jax.export.symbolic_shape("b"), X.dtype)
    np.testing.assert_allclose(exported(symbol).call(X), X @ X, rtol=1e-14)


@MARKED
@pytest.mark.full
def test_a_solve_inside_jit_is_one_function():
    """With constraints: checks of the start, projection, steps and saved states."""
    entry: Any = ENTRIES["double_pendulum_cartesian"]
    system, (q0, v0) = entry.system, entry.start()
    params = jax.tree.map(jnp.asarray, dict(entry.example.params))
    ts = jnp.linspace(0.0, 0.2, 3)

    def end(q0, v0, params):
        motion = jl.simulate(system, q0, v0, ts, params, method="tsit5", throw=False)
        return motion.q, motion.v, motion.raw_status

    compiled = jax.jit(end).lower(q0, v0, params).compile()
    text = str(compiled.as_text())
    body = text[text.index("\nENTRY") :]
    assert not re.search(r" (dot|reduce|conditional|while|custom-call)\(", body)
    assert len(re.findall(r" (fusion|copy|concatenate|call)\(", body)) <= 16
    alone = jl.simulate(system, q0, v0, ts, params, method="tsit5")
    np.testing.assert_allclose(compiled(q0, v0, params)[0], alone.q, rtol=0, atol=1e-12)
