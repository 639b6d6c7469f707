"""Blocks on all cores: the same bits in the same order, whatever the number of threads."""

import threading

import jax
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._sweep import _cores
from jaxlag._sweep._plan import Plan

TS = np.linspace(0.0, 1.0, 3)
N = 5000
SPRING = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2, ("x",))


def draw(key, index):
    return jl.Case([1.0], [0.0], {"k": 1.0 + index.astype(float)})


def swept():
    return jl.sweep(SPRING, draw, N, TS, statistics=("x",))


@pytest.fixture
def threads(monkeypatch):
    """Names of the threads that compute blocks."""
    found, rows = [], Plan.rows

    def recorded(*args):
        found.append(threading.current_thread().name)
        return rows(*args)

    monkeypatch.setattr(Plan, "rows", recorded)
    return found


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_trajectories_do_not_depend_on_the_number_of_threads(monkeypatch, threads, count):
    alone = swept()
    monkeypatch.setattr(_cores, "_cores", lambda: count)
    threads.clear()
    run = swept()
    for name in run.values:
        np.testing.assert_array_equal(run[name], alone[name])
    np.testing.assert_array_equal(run.statistics["x"].mean, alone.statistics["x"].mean)
    assert len(threads) == 5
    assert threads[0] == threading.current_thread().name
    assert all(name.startswith("jaxlag-sweep") == (count > 1) for name in threads[1:])


def test_settings_of_a_context_hold_for_all_blocks(monkeypatch, threads):
    monkeypatch.setattr(_cores, "_cores", lambda: 2)
    expected = swept()
    threads.clear()
    with jax.default_device(jax.devices()[0]):
        run = swept()
    np.testing.assert_array_equal(run["x"], expected["x"])
    assert set(threads) == {threading.current_thread().name}


def test_an_error_in_a_thread_is_raised(monkeypatch):
    rows = Plan.rows

    def failing(plan, block, arguments):
        if block == 3:
            raise MemoryError("block 3")
        return rows(plan, block, arguments)

    monkeypatch.setattr(_cores, "_cores", lambda: 2)
    monkeypatch.setattr(Plan, "rows", failing)
    with pytest.raises(MemoryError, match="block 3"):
        swept()
