"""Accelerations as scalar code: time, operations and compilation, compared with other code.

part "evaluation": one evaluation of the accelerations, as a quarter of a Runge-Kutta step in one
jitted loop, the same for all (_rk4.py). The contenders are

- jaxlag: the scalar program;
- array: jaxlag's array program, with the state as one vector;
- by hand: equations as a good engineer writes them (_by_hand.py);
- sympy: L in symbols, differentiated, with cse, as derived and with trigsimp (_sympy.py);
- called: the same code as a function that every stage calls, which is how jaxlag compiles long
  code; shown, not judged.

part "chain": the same for chains of n links, compared with numba, MuJoCo and Pinocchio (see
_chains.py). part "compile": a whole `jl.simulate` from new functions; `trace_s` includes the
derivation. part "solve": the double pendulum to t = 10, with XLA's setting and without it. The
tolerance is the loosest of a list with an end within 1e-9 of the reference.

`ratio` is the time divided by that of jaxlag for the same system. `error` is relative to the array
program's accelerations (part "solve": the error of the end state).
"""

from collections.abc import Mapping
from importlib.util import find_spec
from math import inf
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from bench._harness.timing import Call, Report, build, interleaved, spread
from bench._harness.workers import under_both_settings
from bench._problems import double_pendulum as pendulum
from bench._problems.scenes import SCENES, Scene, links
from bench.lowering import _chains, _rk4
from bench.lowering._by_hand import BY_HAND
from bench.lowering._rk4 import Equations
from bench.lowering._verdict import OPERATIONS, verdict

STEPS = 10_000
AGREEMENT = 1e-10  # relative
PEER_AGREEMENT = 1e-6
COLUMNS = ("part", "system", "n", "contender", "ratio", "operations", "error", "trace_s")
COLUMNS += ("compile_s", "min_us", "median_us", "repeats")
QUICK = ("pendulum", "cart_pole", "kepler_polar", "symmetric_top")
CHAINS = (2, 3, 4, 6, 8, 12, 16, 32, 64)
TOLERANCES = (1e-7, 3e-8, 1e-8, 3e-9, 1e-9, 3e-10, 1e-10, 3e-11, 1e-11)
ERROR = 1e-9

Row = dict[str, Any]


def run(quick: bool) -> Report:
    """All parts, one after the other."""
    missing = ([] if find_spec("sympy") else ["sympy"]) + _chains.missing()
    rows: list[Row] = []
    for name in QUICK if quick else [name for name in SCENES if name != "chain_8"]:
        rows += evaluation(name, quick)
    for n in [n for n in CHAINS if n in (2, 8) or not quick]:
        rows += chain(n, quick)
    small = [name for name, scene in SCENES.items() if len(scene.q0) <= 4]
    for name in ["double_pendulum_positions"] if quick else small:
        rows.append(compilation(name, SCENES[name], 1 if quick else 2))
    if not quick:
        rows.append(compilation("chain_12", links(12), 2))
    rows += solves(quick)
    operations = {name: _rk4.operations(SCENES[name]) for name in OPERATIONS}
    return Report(rows, *verdict(rows, operations, missing))


def _row(**known: Any) -> Row:
    return {column: known.get(column) for column in COLUMNS}


def contenders(name: str) -> dict[str, tuple[Equations, bool]]:
    """Equations of one system, and whether they take scalars."""
    scene = SCENES[name]
    found = {"jaxlag": _rk4.by_jaxlag(scene, "scalar"), "array": _rk4.by_jaxlag(scene, "array")}
    peers: dict[str, Equations] = {}
    if name in BY_HAND:
        peers["by hand"] = BY_HAND[name]
    if find_spec("sympy"):
        from bench.lowering import _sympy

        if name in _sympy.LAGRANGIANS:
            forms = _sympy.forms(name, scene)
            peers |= {f"sympy {label}": equations for label, equations in forms.items()}
    if len(scene.q0) > 2:
        peers |= {f"{label}, called": _rk4.called(peer) for label, peer in peers.items()}
    return found | {label: (peer, True) for label, peer in peers.items()}


def accelerations(name: str, chosen: Mapping[str, tuple[Equations, bool]]) -> dict[str, np.ndarray]:
    """Accelerations by every contender, near the state of the scene, with all rates nonzero."""
    scene = SCENES[name]
    q, v = np.array(scene.q0) + 0.1, np.array(scene.v0) + 0.1 * np.arange(1, len(scene.q0) + 1)
    params, found = _params(scene), {}
    for label, (equations, scalar) in chosen.items():
        a = jax.jit(lambda q, v, p, equations=equations: equations(p)(q, v))(
            _rk4.parts(q, scalar), _rk4.parts(v, scalar), params
        )
        found[label] = np.concatenate([np.atleast_1d(x) for x in a])
    return found


def evaluation(name: str, quick: bool) -> list[Row]:
    """All contenders of one system in turn."""
    scene, chosen = SCENES[name], contenders(name)
    errors = _agreed(name, accelerations(name, chosen), dict.fromkeys(chosen, AGREEMENT))
    calls, rows = {}, {}
    for label, (equations, scalar) in chosen.items():
        calls[label], cost = _timed(scene, equations, scalar, STEPS)
        rows[label] = {"error": errors[label], **cost}
    rows["jaxlag"]["operations"] = _rk4.operations(scene, "scalar")
    samples = interleaved(calls, 3 if quick else 10, 0.3 if quick else 2.0)
    lanes = dict.fromkeys(calls, _rk4.STAGES * STEPS)
    return _finished("evaluation", name, scene, rows, samples, lanes)


def chain(n: int, quick: bool) -> list[Row]:
    """jaxlag with its defaults, its array program and the other libraries in turn."""
    name, scene, steps = f"chain_{n}", links(n), STEPS // n
    q, v = np.array(scene.q0), np.linspace(0.5, -0.4, n)
    calls, rows, values, lanes = {}, {}, {}, {}
    for label, lowering in (("jaxlag", "auto"), ("array", "array")):
        calls[label], cost = _timed(scene, *_rk4.by_jaxlag(scene, lowering), steps)
        rows[label], lanes[label] = {**cost}, _rk4.STAGES * steps
        rows[label]["operations"] = _rk4.operations(scene, lowering)
        values[label] = np.asarray(_rk4.system(scene, lowering).acceleration(q, v, scene.params))
    for label, peer in _chains.libraries(scene, steps).items():
        calls[label], rows[label], lanes[label] = peer.call, {}, peer.evaluations
        values[label] = peer.acceleration(q, v)
    bounds = dict.fromkeys(calls, PEER_AGREEMENT) | {"jaxlag": AGREEMENT}
    for label, error in _agreed(name, values, bounds).items():
        rows[label]["error"] = error
    samples = interleaved(calls, 3 if quick else 6, 0.5 if quick else 3.0)
    return _finished("chain", name, scene, rows, samples, lanes)


def _timed(scene: Scene, equations: Equations, scalar: bool, steps: int) -> tuple[Call, Row]:
    args = _rk4.parts(scene.q0, scalar), _rk4.parts(scene.v0, scalar), _params(scene)
    program = build(_rk4.loop(equations, steps), *args)
    return lambda: program.call(*args), program.cost()


def _params(scene: Scene) -> Any:
    return jax.tree.map(jnp.asarray, dict(scene.params))


def _agreed(
    name: str, values: Mapping[str, np.ndarray], bounds: Mapping[str, float]
) -> dict[str, float]:
    """Relative differences from the array program; raises an error if one is too large."""
    expected = values["array"]
    size = np.max(np.abs(expected))
    errors = {label: float(np.max(np.abs(a - expected)) / size) for label, a in values.items()}
    for label, error in errors.items():
        if not error <= bounds[label]:
            raise RuntimeError(f"{name}: accelerations of '{label}' are off by {error:.1e}")
    return errors


def _finished(
    part: str,
    name: str,
    scene: Scene,
    rows: Mapping[str, Row],
    samples: Mapping[str, list[float]],
    lanes: Mapping[str, int],
) -> list[Row]:
    own = min(samples["jaxlag"]) / lanes["jaxlag"]
    fixed = {"part": part, "system": name, "n": len(scene.q0)}
    return [
        _row(**fixed, contender=label, ratio=min(taken) / lanes[label] / own, **rows[label],
             **spread(taken, "us", lanes[label]))
        for label, taken in samples.items()
    ]  # fmt: skip


def compilation(name: str, scene: Scene, repeats: int) -> Row:
    """The shortest compilation of a solve from new functions; nothing is run."""
    best = None
    for _ in range(repeats):
        jax.clear_caches()
        fresh = scene._replace(lagrangian=lambda t, q, v, p: scene.lagrangian(t, q, v, p))
        system, ts = _rk4.system(fresh), np.array([0.0, 1.0])

        def solve(q0: Any, v0: Any, params: Any, system: Any = system, ts: Any = ts) -> Any:
            motion = jl.simulate(system, q0, v0, ts, params, throw=False)
            return motion.q, motion.v

        program = build(solve, jnp.asarray(scene.q0), jnp.asarray(scene.v0), _params(scene))
        if best is None or sum(program.cost().values()) < sum(best.values()):
            best = program.cost()
    return _row(part="compile", system=name, n=len(scene.q0), contender="jaxlag", **best or {})


def prepare(quick: bool) -> tuple[dict[str, Call], dict[str, Any]]:
    """The solve in its own process: its call, and the columns known before timing."""
    start, params = pendulum.start(), pendulum.params()
    program = build(pendulum.with_jaxlag(pendulum.times(2)), start, params, jnp.asarray(1e-9))
    expected, error = pendulum.reference(pendulum.times(2)), inf
    for tolerance in TOLERANCES:
        args = start, params, jnp.asarray(tolerance)
        error = float(jnp.max(jnp.abs(program.call(*args).states - expected)))
        if error <= ERROR:
            break
    facts = {"error": error, "tolerance": tolerance, **program.cost()}
    return {"solve": lambda: program.call(*args)}, facts


def solves(quick: bool) -> list[Row]:
    """The double pendulum with XLA's setting and without it, in turn."""
    known, samples = under_both_settings("lowering", quick)
    rows = []
    for setting, all_facts in known.items():
        facts = {key: value for key, value in all_facts.items() if key in COLUMNS}
        label = f"setting {setting}, tolerance {all_facts['tolerance']:g}"
        times = spread(samples[setting, "solve"], "us")
        rows.append(_row(part="solve", system="double_pendulum", n=2, contender=label,
                         **facts, **times))  # fmt: skip
    return rows
