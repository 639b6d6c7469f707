"""Messages about long compilations."""

import itertools
import logging
import re
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import jaxlag as jl
from jaxlag._simulation import _compile_log, _simulate

PAIR = jl.System(lambda t, q, v, p: 0.5 * v @ v - p["k"] * q @ q, ("x", "y"))


def called(patch, seconds, system=PAIR, **options):
    """A simulation in which each reading of the clock is so many seconds after the last."""
    clock = partial(next, itertools.count(0.0, seconds))
    patch.setattr(_simulate, "timed", partial(_compile_log.timed, clock=clock))
    return jl.simulate(system, [0.1, 0.2], [0.0, 0.0], [0.0, 1.0], {"k": 2.0}, **options)


def test_long_compilation_is_logged_once(monkeypatch, caplog):
    caplog.set_level(logging.WARNING, logger="jaxlag")
    called(monkeypatch, 4.0, dt=0.5)
    assert not caplog.records
    called(monkeypatch, 12.0, dt=0.5, method="heun")
    (record,) = caplog.records
    text = record.getMessage()
    assert text.startswith("Compiling the motion of 2 coordinates (x, y) took 12 s")
    assert text.endswith(
        f"It is kept in {jax.config.jax_compilation_cache_dir} for the next process."
    )
    called(monkeypatch, 12.0, dt=0.25, method="heun")  # compiled already: no message
    assert len(caplog.records) == 1


def test_advice_is_the_cache_unless_it_is_used(monkeypatch):
    """The tests use one: see above."""
    monkeypatch.setattr(_compile_log, "jax", SimpleNamespace(config=SimpleNamespace(
        jax_compilation_cache_dir="x", jax_enable_compilation_cache=False)))  # fmt: skip
    assert "Set JAX_COMPILATION_CACHE_DIR to a folder" in _compile_log._message(PAIR, 7.0, None)


def slowest(t, q, p):
    return jnp.linalg.eigvalsh(jnp.array([[q[0], q[1]], [q[1], 2.0]]))[0] - 1.0


@pytest.mark.full
@pytest.mark.parametrize(
    ("declaration", "reason"),
    [
        (
            {"constraints": [jl.Holonomic(slowest, names="slowest mode")]},
            r"computed on arrays: constraint 'slowest mode': eigh at .*test_compile_log.py:\d+",
        ),
        (
            {"forces": [jl.GeneralizedForce(lambda t, q, v, p: -jnp.sort(v), name="sorted")]},
            r"computed on arrays: force 'sorted': sort at .*test_compile_log.py:\d+",
        ),
        ({"forces": [jl.GeneralizedForce(lambda t, q, v, p: -v, name="drag")]}, None),
        (
            {
                "forces": [jl.GeneralizedForce(lambda t, q, v, p: -jnp.sort(v), name="sorted")],
                "lowering": "array",
            },
            None,
        ),
    ],
)
def test_reason_for_arrays_is_logged(monkeypatch, caplog, declaration, reason):
    caplog.set_level(logging.WARNING, logger="jaxlag")
    system = jl.System(PAIR.lagrangian, ("x", "y"), **declaration)
    called(monkeypatch, 12.0, system, dt=0.5, method="heun", throw=False)
    (record,) = caplog.records
    found = re.search(reason or "arrays", record.getMessage())
    assert (found is None) == (reason is None)


def test_methods_without_accelerations_have_no_reason(monkeypatch, caplog):
    caplog.set_level(logging.WARNING, logger="jaxlag")
    force = jl.GeneralizedForce(lambda t, q, v, p: -jnp.sort(v), name="sorted")
    system = jl.System(PAIR.lagrangian, ("x", "y"), forces=[force])
    called(monkeypatch, 12.0, system, dt=0.5, method="variational2")
    (record,) = caplog.records
    assert "arrays" not in record.getMessage()


@pytest.mark.full
def test_log_is_empty_under_transforms(monkeypatch, caplog):
    caplog.set_level(logging.WARNING, logger="jaxlag")
    jax.jit(lambda k: called(monkeypatch, 12.0, dt=k).q)(jnp.array(0.5))
    assert not caplog.records
