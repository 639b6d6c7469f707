"""Accelerations compared with other code: they are right, timed alike and judged."""

import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from bench import lowering
from bench._harness import results
from bench._harness.timing import Report
from bench._problems.scenes import SCENES, links
from bench.lowering import _chains, _rk4
from bench.lowering._by_hand import BY_HAND
from bench.lowering._verdict import LIBRARIES, OPERATIONS, verdict


def off(name, contenders):
    """Largest relative difference of the contenders from the array program."""
    found = lowering.accelerations(name, {"array": array_of(name)} | contenders)
    expected = found.pop("array")
    return max(np.max(np.abs(a - expected)) / np.max(np.abs(expected)) for a in found.values())


def array_of(name):
    return _rk4.by_jaxlag(SCENES[name], "array")


@pytest.mark.parametrize("name", mostly_full(BY_HAND, "pendulum", "top"))
def test_hand_written_equations_equal_those_of_the_scene(name):
    plain = BY_HAND[name]
    contenders = {"by hand": (plain, True), "called": (_rk4.called(plain), True)}
    assert off(name, contenders) < lowering.AGREEMENT


@pytest.mark.full
@pytest.mark.parametrize("name", ["pendulum", "cart_pole", "kepler", "top", "chain_3"])
def test_equations_by_sympy_equal_those_of_the_scene(name, monkeypatch):
    pytest.importorskip("sympy")
    from bench.lowering import _sympy

    monkeypatch.setattr(_sympy, "PATIENCE_S", 3.0)
    forms = _sympy.forms(name, SCENES[name])
    assert "as derived" in forms
    assert off(name, {label: (form, True) for label, form in forms.items()}) < lowering.AGREEMENT


def test_sympy_stops_simplifying_when_its_time_is_up(monkeypatch):
    pytest.importorskip("sympy")
    from bench.lowering import _sympy

    monkeypatch.setattr(_sympy, "PATIENCE_S", 0.01)
    monkeypatch.setattr(_sympy, "_tidy", lambda x: time.sleep(5.0))
    assert set(_sympy.forms("cart_pole", SCENES["cart_pole"])) == {"as derived"}


def test_the_scalar_program_is_timed_on_scalars_and_the_array_program_on_arrays():
    scene = SCENES["double_pendulum"]
    assert [_rk4.by_jaxlag(scene, label)[1] for label in ("auto", "array")] == [True, False]
    assert len(_rk4.parts(scene.q0, True)) == 2
    assert [x.shape for x in _rk4.parts(scene.q0, False)] == [(2,)]


def test_the_loop_of_evaluations_integrates():
    steps = 1000
    oscillator = lambda params: lambda q, v: [-params * q[0]]  # noqa: E731
    start = ([jnp.asarray(1.0)], [jnp.asarray(0.0)])
    q, v = jax.jit(_rk4.loop(oscillator, steps))(*start, 400.0)
    phase = 20.0 * steps * _rk4.STEP
    # Runge-Kutta's error at 2e-3 rad a step over 2 rad: phase times the fourth power over 120.
    assert abs(q[0][()] - math.cos(phase)) < 1e-12
    assert abs(v[0][()] + 20.0 * math.sin(phase)) < 2e-11


@pytest.mark.full
@pytest.mark.parametrize("name", LIBRARIES)
@pytest.mark.parametrize("n", [2, 5])
def test_libraries_compute_the_accelerations_of_the_chain(name, n):
    pytest.importorskip(_chains.MODULES[name])
    scene = links(n)
    q, v = np.array(scene.q0), np.linspace(0.5, -0.4, n)
    expected = _rk4.system(scene).acceleration(q, v, scene.params)
    library = _chains.MAKERS[name](scene, 3)
    found = library.acceleration(q, v)
    assert np.max(np.abs(found - expected)) < lowering.PEER_AGREEMENT * np.max(np.abs(expected))
    library.call()
    assert library.evaluations == 12


def test_loop_of_numba_equals_that_of_jax():
    pytest.importorskip("numba")
    scene, steps = links(3), 50
    equations, scalar = _rk4.by_jaxlag(scene)
    args = _rk4.parts(scene.q0, scalar), _rk4.parts(scene.v0, scalar), scene.params
    expected = jnp.array(jax.jit(_rk4.loop(equations, steps))(*args))
    found = np.array(_chains.by_numba(scene, steps).call())
    assert np.max(np.abs(found - expected)) < 1e-13


def test_libraries_that_cannot_be_imported_are_omitted(monkeypatch):
    monkeypatch.setattr(_chains, "MODULES", dict.fromkeys(LIBRARIES, "no_such_module"))
    assert _chains.missing() == list(LIBRARIES)
    assert _chains.libraries(links(2), 3) == {}


def test_contenders_that_disagree_are_not_timed(monkeypatch):
    monkeypatch.setitem(BY_HAND, "pendulum", lambda p: lambda q, v: [jnp.sin(q[0])])
    monkeypatch.setattr(lowering, "find_spec", lambda name: None)
    with pytest.raises(RuntimeError, match="pendulum: accelerations of 'by hand' are off by"):
        lowering.evaluation("pendulum", quick=True)


def made_up(part, system, n, times):
    own = times["jaxlag"]
    return [
        {**dict.fromkeys(lowering.COLUMNS), "part": part, "system": system, "n": n}
        | {"contender": name, "ratio": us / own, "min_us": us, "trace_s": 0.5, "compile_s": us}
        for name, us in times.items()
    ]


def judged(rows):
    counts = OPERATIONS | {"top": 90}
    targets, references = verdict(rows, counts, ["sympy"])
    return {t.claim: (round(t.figure, 9), t.met) for t in targets}, references


def test_rows_of_the_lowering_are_judged():
    rows = made_up("evaluation", "a", 1, {"jaxlag": 1.0, "array": 2.0, "by hand": 2.0})
    times = {"jaxlag": 4.0, "array": 40.0, "by hand": 3.0, "sympy trigsimp": 2.0}
    rows += made_up("evaluation", "b", 3, times | {"by hand, called": 1.0})
    rows += made_up("chain", "chain_8", 8, {"jaxlag": 2.0, "array": 12.0, "numba": 4.0})
    rows += made_up("chain", "chain_16", 16, {"jaxlag": 6.0, "numba": 4.0, "MuJoCo": 3.0})
    rows += made_up("chain", "chain_32", 32, {"jaxlag": 9.0, "numba": 1.0})
    rows += made_up("compile", "b", 3, {"jaxlag": 0.75})
    rows += made_up("compile", "chain_12", 12, {"jaxlag": 4.0})
    rows += made_up("solve", "double_pendulum", 2, {"jaxlag": 1.0, "setting on, x": 130.0})
    targets, references = judged(rows[:-2] + rows[-1:])
    best = "times as long: jaxlag as the best of hand-written and sympy"
    faster = "times faster: the scalar than the array program"
    compiled = "s to derive and compile a solve"
    assert targets == {
        f"{best}, mean of 2": (1.0, True),
        f"{best}, worst (b)": (2.0, False),
        f"{faster}, n = 1": (2.0, True),
        f"{faster}, least for n = 2 to 4": (10.0, False),
        f"{faster}, chain of 8": (6.0, True),
        "times as long: jaxlag as its best neighbour, worst of n <= 16 (n = 16)": (2.0, False),
        f"{compiled}, worst of n <= 4 (b)": (1.25, True),
        f"{compiled}, chain of 12": (4.5, False),
        "ms: double pendulum to 1e-9, setting on": (0.13, True),
        "operations of top": (90.0, False),
        "operations of rigid_body": (85.0, True),
        "operations of aircraft": (410.0, True),
        "operations of chain_8": (720.0, True),
    }
    notes = {what: figure for figure, what in references}
    assert notes["sympy: cannot be imported"] == "left out"
    assert notes["times as long: jaxlag as numba, chain of 32"] == "9"
    both = "times as long: jaxlag as the best of both, theirs also called"
    assert notes[f"{both}, mean of 2; worst b"] == "1.41; 4"


def test_a_system_without_a_scalar_program_misses_its_count():
    rows = made_up("evaluation", "a", 1, {"jaxlag": 1.0, "by hand": 2.0})
    rows += made_up("compile", "a", 1, {"jaxlag": 1.0})
    rows += made_up("compile", "chain_12", 12, {"jaxlag": 1.0})
    targets, _ = verdict(rows, dict.fromkeys(OPERATIONS), [])
    counts = [target for target in targets if target.claim.startswith("operations")]
    assert [target.met for target in counts] == [False] * 4


def test_columns_that_do_not_apply_are_blank():
    text = results.text(Report([{"a": "x", "b": None, "c": 1.0}], [], []))
    assert text.splitlines()[1].split() == ["x", "1"]
