"""The setting that makes XLA compile a solver loop to one native function."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

from jaxlag._core import _xla
from jaxlag._lowering import State
from systems import double_pendulum

SOLVE = """
{before}
import jax, jax.numpy as jnp
{first}
import jaxlag as jl
jax.config.update("jax_enable_x64", True)
L = lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0])
pendulum = jl.System(L, ("theta",), lowering="array")
run = lambda q0: jl.simulate(pendulum, q0, [0.0], [0.0, 1.0], 9.81).q
text = jax.jit(run).lower(jnp.array([1.0])).compile().as_text()
# The outermost loop, not only small ones inside it.
entry = text[text.index("ENTRY"):].splitlines()
print("entry loops left:", sum(" while(" in line for line in entry))
print("small_call" in text)
print(pendulum.explain(9.81))
"""


INTERPRETED = """
import jax, jax.numpy as jnp
import jaxlag as jl
from jaxlag._lowering import _term_codes
from jaxlag._lowering._emit import _emit
_term_codes.LONG = _emit.INTERPRET_FROM = -1
jax.config.update("jax_enable_x64", True)
rod = jl.Holonomic(lambda t, q, p: q @ q - 1.0, "rod")
L = lambda t, q, v, p: 0.5 * v @ v - p * q[1]
bob = jl.System(L, ("x", "y"), constraints=(rod,))
run = lambda q0: jl.simulate(bob, q0, [0.0, 0.1], [0.0, 1.0], 9.81).q
text = jax.jit(run).lower(jnp.array([1.0, 0.0])).compile().as_text()
entry = text[text.index("ENTRY"):].splitlines()
print("entry loops left:", sum(" while(" in line for line in entry))
print("functions chosen by a number:", " conditional(" in text)
"""


def child(before="", first="", code="", **environment):
    code = code or SOLVE.format(before=before, first=first)
    env = {
        k: v
        for k, v in os.environ.items()
        if k not in ("XLA_FLAGS", _xla.SWITCH, _xla.ATTRIBUTE_SWITCH)
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=env | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


def test_solver_loop_is_one_native_function():
    done = child()
    assert done.stdout.splitlines()[:2] == ["entry loops left: 0", "True"]
    assert "solver loops compile to one native function" in done.stdout
    assert "Warning" not in done.stderr


@pytest.mark.full
def test_loop_with_interpreted_code_is_one_native_function():
    """With XLA's emitters of fusions, which the tests switch off, a scatter would prevent that."""
    lines = child(code=INTERPRETED).stdout.splitlines()
    assert lines == ["entry loops left: 0", "functions chosen by a number: True"]


@pytest.mark.full
def test_existing_options_stay_set():
    done = child(
        XLA_FLAGS="--xla_backend_extra_options=xla_cpu_enable_concurrency_optimized_scheduler=false"
    )
    assert done.stdout.splitlines()[1] == "True"


OLD = pytest.mark.skipif(not _xla.needed(), reason="this jax raised the bound itself")


@pytest.mark.full
@OLD
def test_switches_disable_the_setting():
    done = child(JAXLAG_XLA_FLAGS="0", JAXLAG_XLA_ATTRIBUTES="0")
    assert "entry loops left: 0" not in done.stdout
    assert "JAXLAG_XLA_FLAGS=0 and JAXLAG_XLA_ATTRIBUTES=0" in done.stdout
    assert "Warning" not in done.stderr


@pytest.mark.full
@OLD
def test_compilation_before_import_warns_once():
    done = child(first="jax.jit(lambda x: x + 1)(1.0)", JAXLAG_XLA_ATTRIBUTES="0")
    assert done.stderr.count("Solves will be several times slower") == 1
    assert "its loop setting came too late" in done.stdout


EVERYTHING = """
import json
import jax, jax.numpy as jnp, numpy as np
import jaxlag as jl
jax.config.update("jax_enable_x64", True)
def L(t, q, v, p):
    c = jnp.cos(q[0] - q[1])
    T = p["m"] * v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * c
    return T + 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
push = jl.GeneralizedForce(lambda t, q, v, p, inputs: jnp.stack([inputs["u"], 0 * q[0]]), "push")
held = {"u": jl.ZeroOrderHold(jnp.linspace(0.0, 2.0, 9), jnp.sin(jnp.arange(9.0)))}
free = jl.System(L, ("a", "b"))
driven = jl.System(L, ("a", "b"), forces=(push,))
def end(q0, inputs=None, count=3):
    system = free if inputs is None else driven
    ts = np.linspace(0.0, 1.5, count)
    return jl.simulate(system, q0, [0.1, 0.2], ts, {"m": 1.0}, inputs=inputs, throw=False).q[-1]
def moved(stop):
    ts = jnp.linspace(0.0, stop, 40)
    inputs = {"u": jl.ZeroOrderHold(jnp.linspace(0.0, stop, 9), jnp.sin(jnp.arange(9.0)))}
    return jl.simulate(driven, q0, [0.1, 0.2], ts, {"m": 1.0}, inputs=inputs).q.sum()
q0 = jnp.array([0.7, -0.4])
batch = q0 + 0.01 * jnp.arange(19.0)[:, None]
def policy(width):
    W = np.eye(width)
    def f(t, q, v, p):
        return jnp.tanh(W @ jnp.concatenate([q, v, jnp.ones(width - 4)]))[0]
    return {"u": jl.Feedback(f)}
programs = [
    lambda q: end(q), lambda q: end(q, held), lambda q: end(q, None, 200),
    lambda q: jax.vmap(lambda q: end(q, None, 2))(batch),
    lambda q: jax.vmap(lambda q: end(q, held))(batch),
    lambda q: jax.vmap(lambda q: end(q, None, 101))(batch),
    jax.grad(lambda q: end(q)[0]), jax.jacfwd(end), jax.hessian(lambda q: end(q)[1]),
    lambda q: jax.vmap(jax.grad(lambda q: end(q, held)[0]))(batch[:3]),
    lambda q: jax.vmap(jax.grad(moved))(jnp.linspace(1.0, 1.5, 19)),
    lambda q: jax.vmap(jax.jacfwd(moved))(jnp.linspace(1.0, 1.5, 19)),
    lambda q: jax.vmap(lambda q: end(q, policy(32), 2))(batch),
    jax.jacfwd(lambda q: end(q, policy(32), 2)),
]
compiled = [jax.jit(f).lower(q0).compile() for f in programs]
texts = [c.as_text() for c in compiled]
print(json.dumps([np.asarray(c(q0)).tolist() for c in compiled]))
print(['xla_cpu_small_call="true"' in text for text in texts])
print(free.explain({"m": 1.0}).splitlines()[-1])
"""


@pytest.mark.full  # minutes, in two separate processes
@OLD
def test_attributes_have_the_effect_of_the_setting():
    """Every transformation, in a separate process: the attributes are internal to XLA."""
    found = {}
    for attributes in "01":
        done = child(code=EVERYTHING, JAXLAG_XLA_FLAGS="0", JAXLAG_XLA_ATTRIBUTES=attributes)
        numbers, used, explanation = done.stdout.splitlines()
        found[attributes] = json.loads(numbers)
        # XLA itself marks small loops, such as the search in a table. The last two programs
        # multiply by a large matrix.
        marked = [True] * 12 + [False] * 2
        assert attributes == "0" or used == str(marked)
        assert ("by attributes of their calls" in explanation) == (attributes == "1")
    for a, b in zip(found["0"], found["1"], strict=True):
        # One rounding in a fused product changes a step, within rtol = atol = 1e-9.
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)


def test_attributes_are_used_only_for_tested_versions(monkeypatch):
    monkeypatch.setattr(_xla, "in_force", lambda: False)
    monkeypatch.setattr(_xla, "ATTRIBUTES_TESTED", (jaxlib.__version__,))
    assert _xla.by_attribute()
    monkeypatch.setattr(_xla, "ATTRIBUTES_TESTED", ())
    assert not _xla.by_attribute()
    monkeypatch.setattr(_xla, "ATTRIBUTES_TESTED", (jaxlib.__version__,))
    monkeypatch.setenv(_xla.ATTRIBUTE_SWITCH, "0")
    assert not _xla.by_attribute()


def test_options_are_used_outside_of_all_transforms(monkeypatch):
    """Inside them JAX refuses options, and the outermost jit decides."""
    monkeypatch.setattr(_xla, "TESTED", (jaxlib.__version__,))
    monkeypatch.setattr(_xla, "_OPTIONS", {"xla_cpu_enable_fast_math": False})
    program = _xla.QuickJit(jnp.sin)
    program(1.0)
    assert (program._alone._cache_size(), program._inside._cache_size()) == (1, 0)
    transformed = jax.jit, jax.grad, jax.vmap, lambda f: lambda x: jax.jvp(f, (x,), (x,))
    for transform in transformed:
        x = jnp.ones(2) if transform is jax.vmap else 1.0
        transform(lambda x: program(x))(x)
        assert program._alone._cache_size() == 1
    monkeypatch.setattr(_xla, "TESTED", ())
    program = _xla.QuickJit(jnp.sin)
    program(1.0)
    assert program.programs() == 1
    assert program._alone is None


def test_only_plain_operations_are_marked():
    """Calls of a library or of the host, nested in a loop, are left to XLA."""

    def plain(function, x):
        looped = lambda x: jax.lax.scan(lambda c, _: (function(c), None), x, None, 3)[0]  # noqa: E731
        return _xla.is_plain(jax.make_jaxpr(looped)(x).jaxpr)

    M = jnp.eye(3)
    assert plain(lambda x: jnp.sin(x) + M[0] * x, M)
    assert plain(lambda x: jax.lax.cond(x[0, 0] > 0, jnp.cos, jnp.tan, x), M)
    assert not plain(lambda x: x @ x, M)
    # vmap makes a matrix product of it, unless the vector holds coefficients of a method's stages.
    assert not plain(lambda x: jnp.eye(8) @ x, jnp.ones(8))
    body = jax.make_jaxpr(lambda x: jnp.ones(8) @ x)(jnp.ones((8, 4))).jaxpr
    assert _xla.is_plain(body, stages=8)
    assert not _xla.is_plain(body, stages=10)
    assert not plain(jnp.linalg.cholesky, M)
    assert not plain(lambda x: jnp.linalg.solve(x, x), M)
    assert not plain(lambda x: jax.pure_callback(np.sin, x, x), M)


def test_scalar_programs_are_plain():
    """Otherwise every loop would run operation by operation if XLA's setting came too late."""
    program, params = (
        double_pendulum.system._program,
        dict.fromkeys(("m1", "m2", "h1", "h2", "g"), 1.0),
    )
    q = jnp.ones((3, 2))
    one = jax.make_jaxpr(lambda q: program.acceleration(State(jnp.zeros(()), q, q, params, {})))
    lanes = jax.make_jaxpr(
        jax.vmap(lambda q: program.acceleration(State(jnp.zeros(()), q, q, params, {})))
    )
    for traced in (one(q[0]), lanes(q)):
        assert "round" in str(traced)  # sines by polynomial
        assert _xla.is_plain(traced.jaxpr)


def test_merged_flags_extend_existing_ones(monkeypatch):
    monkeypatch.setattr(_xla, "COMPARISONS_TESTED", (jaxlib.__version__,))
    options = f"{_xla.OPTION}={_xla.BYTES},{_xla.COMPARISONS}"
    flag = _xla.EXTRA + options
    assert _xla.merged("") == flag
    assert _xla.merged("--a=1") == f"--a=1 {flag}"
    assert _xla.merged(f"{_xla.EXTRA}x=1 --a=1") == f"{_xla.EXTRA}x=1,{options} --a=1"
    own = f"{_xla.EXTRA}{_xla.OPTION}=5"
    assert _xla.merged(own) == own
    monkeypatch.setattr(_xla, "COMPARISONS_TESTED", ())
    assert _xla.merged("") == f"{_xla.EXTRA}{_xla.OPTION}={_xla.BYTES}"
