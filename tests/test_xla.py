"""The setting that makes XLA compile a solver loop to one native function."""

import os
import subprocess
import sys

import pytest

from jaxlag import _xla

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


def child(before="", first="", **environment):
    code = SOLVE.format(before=before, first=first)
    env = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAXLAG_XLA_FLAGS")}
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


def test_existing_options_are_kept():
    done = child(
        XLA_FLAGS="--xla_backend_extra_options=xla_cpu_enable_concurrency_optimized_scheduler=false"
    )
    assert done.stdout.splitlines()[1] == "True"


@pytest.mark.skipif(not _xla.needed(), reason="this jax raised the bound itself")
def test_switch_leaves_everything_alone():
    done = child(JAXLAG_XLA_FLAGS="0")
    assert "entry loops left: 0" not in done.stdout
    assert "JAXLAG_XLA_FLAGS=0" in done.stdout
    assert "Warning" not in done.stderr


@pytest.mark.skipif(not _xla.needed(), reason="this jax raised the bound itself")
def test_compilation_before_import_is_said_once():
    done = child(first="jax.jit(lambda x: x + 1)(1.0)")
    assert done.stderr.count("Solves will be several times slower") == 1
    assert "its loop setting came too late" in done.stdout


def test_merging():
    flag = f"{_xla.EXTRA}{_xla.OPTION}={_xla.BYTES}"
    assert _xla.merged("") == flag
    assert _xla.merged("--a=1") == f"--a=1 {flag}"
    assert (
        _xla.merged(f"{_xla.EXTRA}x=1 --a=1") == f"{_xla.EXTRA}x=1,{_xla.OPTION}={_xla.BYTES} --a=1"
    )
    own = f"{_xla.EXTRA}{_xla.OPTION}=5"
    assert _xla.merged(own) == own
