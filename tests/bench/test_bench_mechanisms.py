"""The benchmark of mechanisms: consistent starts, independent equations, peers, verdicts."""

import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj

from bench import mechanisms
from bench.mechanisms import _bodies, _by_hand, _equations
from bench.mechanisms._bodies import GROUND, Body, Placed
from bench.mechanisms._scenes import SCENES

EPS = np.finfo(float).eps
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.full
@pytest.mark.parametrize("name", SCENES)
def test_starts_are_consistent(name):
    scene = SCENES[name]()
    if scene.phi is not None:
        phi = np.asarray(scene.phi(0.0, jnp.asarray(scene.q0), scene.params))
        # Positions of up to 5 m, squares of them; published digits of the squeezer.
        assert np.max(np.abs(phi)) < 1e3 * EPS
    rows = _by_hand.rows_of(scene)
    if rows is not None:
        state = jnp.asarray(scene.q0), jnp.asarray(scene.v0)
        rate = np.asarray(jax.jit(rows)(*state, scene.params))
        assert np.max(np.abs(rate)) < 1e3 * EPS * (1.0 + np.max(np.abs(scene.v0)))


# ---- Equations on numbers ------------------------------------------------------------------------


def swing(amplitude, rate, t):
    """Angle from the downward vertical of a pendulum released at `amplitude`."""
    k = np.sin(amplitude / 2.0)
    _, cn, dn, _ = ellipj(rate * t, k**2)
    return 2.0 * np.arcsin(k * cn / dn)


def test_one_link_is_a_compound_pendulum():
    m, half, J, g, t = 0.7, 0.4, 0.05, 9.81, 1.3
    links = _equations.Links(np.array([[half]]), np.array([m]), np.array([J]), g)
    found = links.end(np.array([1.2 - 0.5 * np.pi]), np.zeros(1), t)[0] + 0.5 * np.pi
    expected = swing(1.2, np.sqrt(m * g * half / (J + m * half**2)), t)
    assert abs(found - expected) < 1e-10  # the tolerance of a step is 1e-12


def test_a_body_on_a_hinge_is_a_compound_pendulum():
    m, half, J, g, t = 0.7, 0.4, 0.05, 9.81, 1.3
    body = Body(m, np.diag([0.3, J, 0.2]))
    angle = 1.2

    def turned(x):
        return np.array([[np.cos(x), 0, np.sin(x)], [0, 1, 0], [-np.sin(x), 0, np.cos(x)]])

    hinge = _bodies.hinge(0, GROUND, half * UP, np.zeros(3), [0, 1, 0], [0, 1, 0])
    start = Placed(-half * turned(angle)[:, 2], turned(angle), np.zeros(3), np.zeros(3))
    load = lambda now: (-m * g * UP[None], np.zeros((1, 3)))  # noqa: E731
    (end,) = _bodies.end([body], [hinge], [start], load, t)
    expected = swing(angle, np.sqrt(m * g * half / (J + m * half**2)), t)
    assert np.max(np.abs(end.R - turned(expected))) < 1e-10
    assert np.max(np.abs(end.r + half * end.R[:, 2])) < 1e-10


def test_a_leaning_wheel_rolls_without_slip_and_keeps_its_energy():
    """Contact forces of a rolling wheel do no work; z is downward."""
    m, radius, g = 2.0, 0.3, 9.81
    J = np.diag([0.05, 0.1, 0.05])
    lean = 0.3
    R = np.array(
        [[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]], float
    )
    w = R @ np.array([0.6, -14.0, 0.5])

    def arm(R):
        d = UP - R[2, 1] * R[:, 1]
        return radius * d / np.linalg.norm(d)

    start = Placed(-arm(R), R, -np.cross(w, arm(R)), w)

    def energy(x):
        return 0.5 * m * x.v @ x.v + 0.5 * x.w @ (x.R @ J @ x.R.T) @ x.w - m * g * x.r[2]

    load = lambda now: (m * g * UP[None], np.zeros((1, 3)))  # noqa: E731
    (end,) = _bodies.end([Body(m, J)], [_bodies.wheel(0, radius, UP)], [start], load, 1.5)
    assert abs(energy(end) / energy(start) - 1.0) < 1e-10  # the tolerance of a step is 1e-12
    assert np.max(np.abs(end.v + np.cross(end.w, arm(end.R)))) < 1e-9
    assert abs(end.r[2] + arm(end.R)[2]) < 1e-9
    assert abs(end.R[2, 1] - R[2, 1]) > 0.01  # it leans otherwise than at the start
    assert np.hypot(*(end.r - start.r)[:2]) > 1.0


def test_a_rope_keeps_its_length_and_swings():
    fixed, bob = Body(1e12, np.eye(3)), Body(0.5, np.eye(3))
    length, angle, t = 0.8, 0.9, 1.1
    start = [
        Placed(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3)),
        Placed(length * np.array([np.sin(angle), 0, -np.cos(angle)]), np.eye(3), *np.zeros((2, 3))),
    ]
    load = lambda now: (-0.5 * 9.81 * np.outer([0.0, 1.0], UP), np.zeros((2, 3)))  # noqa: E731
    rope = _bodies.rope(0, 1, np.zeros(3))
    end = _bodies.end([fixed, bob], [rope], start, load, t)[1]
    x = swing(angle, np.sqrt(9.81 / length), t)
    expected = length * np.array([np.sin(x), 0.0, -np.cos(x)])
    assert np.max(np.abs(end.r - expected)) < 1e-9  # the support moves by 1e-12


# ---- Peers ---------------------------------------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize("name", ["2 four-bars", "governor"])
def test_equations_by_sympy_equal_those_by_hand(name, tmp_path):
    sympy = pytest.importorskip("sympy")
    from bench.mechanisms import _sympy

    assert sympy
    scene = SCENES[name]()
    y = np.concatenate([scene.q0, scene.v0])
    expected = np.asarray(jax.jit(_by_hand.field(scene))(0.0, jnp.asarray(y), dict(scene.params)))
    code, params = _sympy.derived(scene), _sympy.numbers(scene)
    # Some hundred roundings through a solve with a condition of about 1e4.
    bound = 1e6 * EPS * np.max(np.abs(expected))
    found = np.array(_sympy.in_python(code, params)(0.0, y))
    assert np.max(np.abs(found - expected)) < bound
    found = _sympy.InC(code, params, str(tmp_path)).acceleration(y)
    assert np.max(np.abs(found - expected[y.size // 2 :])) < bound


# ---- Processes and verdicts ----------------------------------------------------------------------


def test_a_case_that_takes_too_long_or_fails_says_so(monkeypatch):
    def late(*args, timeout, **_):
        raise subprocess.TimeoutExpired(args, timeout)

    monkeypatch.setattr(mechanisms.subprocess, "run", late)
    assert mechanisms.first("arm", "solve") == {"first_s": 90.0, "note": "stopped after 90 s"}
    done = subprocess.CompletedProcess([], 1, "", "Traceback\nValueError: no\n")
    monkeypatch.setattr(mechanisms.subprocess, "run", lambda *args, **_: done)
    assert mechanisms.first("arm", "solve") == {"note": "failed: ValueError: no"}


def test_ends_are_compared_with_the_independent_ones(monkeypatch):
    scene = SCENES["2 four-bars"]()
    monkeypatch.setitem(mechanisms.SCENES, "2 four-bars", lambda: scene._replace(end=lambda: end))
    end = np.array([1.0, 1.0, 1.0, 0.0, 0.0])
    ends = {"solve": end, "kvaerno5": end + 2e-3}

    def first(name, case):
        found = {"first_s": 1.0, "end": ends.get(case, end).tolist()}
        return found | ({"along": 1.0, "difference": 1.5} if case == "gradient" else {})

    monkeypatch.setattr(mechanisms, "first", first)
    rows = {row["case"]: row for row in mechanisms.measured("2 four-bars", quick=False)}
    assert rows["solve"]["apart"] == 0.0
    assert np.isclose(rows["kvaerno5"]["apart"], 2e-3)
    assert (rows["solve"]["n"], rows["solve"]["rows"]) == (5, 4)
    assert "variational4" in rows
    assert "null_space" in rows


def row(scene, case, **figures):
    plain = {"first_s": 1.0, "run_ms": 1.0, "solve_ms": 1.0, "evaluation_ns": 100.0}
    plain |= {"operations": 3000, "apart": 1e-9, "off": 0.0, "note": None}
    return {"scene": scene, "case": case, **plain, **figures}


def test_the_worst_scene_of_every_kind_is_judged():
    cases = ("solve", "explain", "null_space", "kvaerno5", "variational4", "gradient")
    cases += ("acceleration", "assemble", "by hand", "sympy", "mujoco")
    rows = [row(scene, case) for scene in SCENES for case in cases]
    targets, references = mechanisms.judged(rows)
    assert all(target.met for target in targets)
    assert references[0].figure == "12 of 12"
    for figure, scene, case, claim in (
        ({"first_s": 5.1}, "arm", "solve", "n <= 8 with up to 6 rows"),
        ({"first_s": 8.1}, "20 rods", "solve", "the larger ones"),
        ({"first_s": 2.1}, "walker", "null_space", "by default: null_space"),
        ({"first_s": 2.1}, "six-bar", "kvaerno5", "by default: kvaerno5"),
        ({"first_s": 2.1}, "governor", "variational4", "by default: variational4"),
        ({"run_ms": 2.1}, "squeezer", "gradient", "as the solve: a gradient"),
        ({"evaluation_ns": 1e4}, "20 rods", "solve", "an evaluation, geometric mean"),
        ({"first_s": 2.1}, "8 four-bars", "explain", "s of derivation"),
        ({"operations": 4001}, "bicycle", "solve", "operations of the bicycle"),
        ({"run_ms": 5.1}, "bicycle", "solve", "ms of the bicycle's run"),
        ({"first_s": 5.1}, "bicycle", "assemble", "assemble, bicycle"),
        ({"apart": 2e-6}, "tensegrity", "solve", "an end or a gradient apart"),
        ({"off": 2e-8}, "arm", "mujoco", "difference of accelerations"),
        ({"note": "failed: ValueError: no"}, "arm", "by hand", "cases that failed"),
    ):
        changed = [x | figure if (x["scene"], x["case"]) == (scene, case) else x for x in rows]
        missed = [t.claim for t in mechanisms.judged(changed)[0] if not t.met]
        assert any(claim in found for found in missed), claim
