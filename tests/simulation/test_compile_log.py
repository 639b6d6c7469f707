"""Messages about long compilations."""

import itertools
import logging
from functools import partial

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
    assert "JAX_COMPILATION_CACHE_DIR" in text
    assert "lowering='array'" in text
    called(monkeypatch, 12.0, dt=0.25, method="heun")  # compiled already: no message
    assert len(caplog.records) == 1


@pytest.mark.full
def test_log_is_empty_under_transforms_and_omits_advice_in_use(monkeypatch, caplog):
    caplog.set_level(logging.WARNING, logger="jaxlag")
    jax.jit(lambda k: called(monkeypatch, 12.0, dt=k).q)(jnp.array(0.5))
    assert not caplog.records
    arrays = jl.System(PAIR.lagrangian, ("x", "y"), lowering="array")
    called(monkeypatch, 12.0, arrays, dt=0.5)
    assert "lowering" not in caplog.records[0].getMessage()
