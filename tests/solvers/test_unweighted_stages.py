"""Stages without weight in a step and its error estimate, and short forces only they meet."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.solvers._explicit import tableau_of
from jaxlag.solvers._unweighted_stages import unseen

G = 9.81
METHODS = [jl.solvers.Dopri8, jl.solvers.Prince9, jl.solvers.Dopri5, jl.solvers.Tsit5]


@pytest.mark.parametrize("method", METHODS)
def test_unweighted_stages_have_no_weight_in_step_and_estimate(method):
    tableau = tableau_of(method)
    assert (
        tableau.unweighted
        == {
            jl.solvers.Dopri8: (1, 2, 3, 4),
            jl.solvers.Prince9: (1, 2, 3, 5),
            jl.solvers.Dopri5: (1,),
            jl.solvers.Tsit5: (),
        }[method]
    )
    for i in range(len(tableau.b) - 1):
        assert (i in tableau.unweighted) == (tableau.b[i] == 0 and tableau.e[i] == 0)


def test_unseen_error_equals_that_by_hand():
    """By hand: an end that differs from the stage before, an early kick, neither."""
    late = [1.0, 0.5, 0.5, 0.2, 2.0]  # |2.0 - 0.2| > 0.3 * 2.0
    kick = [1.0, 0.5, -7.0, 1.0, 1.1]  # 7.0 > 3 * 1.1
    smooth = [1.0, 0.5, 3.2, 1.0, 1.1]  # 3.2 < 3 * 1.1, 0.1 < 0.3 * 1.1
    k = [jnp.array(stage) for stage in zip(late, kick, smooth, strict=True)]
    np.testing.assert_allclose(unseen(k, (1, 2)), [1.8, 7.0, 0.0], rtol=1e-15)
    np.testing.assert_allclose(unseen(k, (2,)), [0.0, 7.0, 0.0], rtol=1e-15)  # one stage only


@pytest.mark.parametrize("looped", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_estimate_of_a_smooth_step_equals_that_of_the_method(method, looped):
    """At steps of up to a sixth of the period of a pendulum."""

    def swing(t, y, args):
        return jnp.stack([y[1], -jnp.sin(y[0])])

    solver, term = method(looped=looped), diffrax.ODETerm(swing)
    for h in (0.1, 0.5, 1.0):
        given = jnp.array(0.0), jnp.array(h), jnp.array([1.0, 0.2]), None
        memory = solver.init(term, *given)
        _, error, dense, *_ = solver.step(term, *given, memory, made_jump=False)
        expected = np.abs(np.asarray(tableau_of(method).e) @ np.asarray(dense["k"]))
        rounding = len(dense["k"]) * np.finfo(float).eps * np.max(np.abs(dense["k"]))
        np.testing.assert_allclose(np.abs(error), expected, rtol=0, atol=rounding)


# ---- A ball on a stiff floor: flights are parabolas, contacts half sines -----------------------


def spring(t, q, v, params):
    return 0.5 * v[0] ** 2 - G * q[0] - 0.5 * params["k"] * jnp.minimum(q[0], 0.0) ** 2


def softplus(t, q, v, params):
    k, w = params["k"], 2.5e-3
    return 0.5 * v[0] ** 2 - G * q[0] - k * w**2 * jax.nn.softplus(-q[0] / w)


def height(h, k, t):
    """Height at t of a ball on springs that falls from rest at h."""
    fall, w = np.sqrt(2 * h / G), np.sqrt(k)
    contact = 2 * (np.pi - np.arctan(G * fall * w / G)) / w
    r = t % (2 * fall + contact)
    in_contact = -G / k + G / k * np.cos(w * (r - fall)) - G * fall / w * np.sin(w * (r - fall))
    up = h - G * (r - 2 * fall - contact) ** 2 / 2
    return np.where(r < fall, h - G * r**2 / 2, np.where(r < fall + contact, in_contact, up))


def falls(count):
    """Heights, stiffnesses and times of six flights."""
    rng = np.random.default_rng(0)
    h, k = 10 ** rng.uniform(-2, 2, count), 10 ** rng.uniform(4, 9, count)
    return h, k, 6 * np.sqrt(2 * h / G)


def dropped(lagrangian, **options):
    """A function (h, k, t, tolerance) -> end of the motion, vmapped over all but the last."""
    system = jl.System(lagrangian, ("x",))

    def end(h, k, t, tolerance):
        ts = jnp.stack([0.0 * t, t])
        given = {"rtol": tolerance, "atol": tolerance, "max_steps": 20_000} | options
        motion = jl.simulate(system, h[None], jnp.zeros(1), ts, {"k": k}, **given)
        return motion.q[-1, 0], motion.v[-1, 0], motion.energy[-1], motion.status

    return jax.jit(jax.vmap(end, in_axes=(0, 0, 0, None)))


def test_a_ball_does_not_fall_through_a_stiff_floor():
    """The first known case: from 1 m onto 8e4 N/m the motion ended at 3.15 m, status ok."""
    system = jl.System(spring, ("x",))
    motion = jl.simulate(system, [1.0], [0.0], [0.0, 1.5], {"k": 8e4})
    assert abs(float(motion["x"][-1]) - height(1.0, 8e4, 1.5)) < 1e-6


@pytest.mark.parametrize(
    "method",
    ["auto", pytest.param(diffrax.Dopri8(), marks=pytest.mark.full)]
    + [pytest.param(name, marks=pytest.mark.full) for name in ("prince9", "dopri5")]
    + [pytest.param(jl.solvers.Dopri8(looped=True), marks=pytest.mark.full)],
    ids=str,
)
def test_energies_after_bounces_are_right(method):
    """At most 1 % off; 70 and 105 of 1,000 were more, up to 1e6 times, by the default method.

    At 1e-6 the stiffest contacts have errors of 1e-3 in energy: tolerances of 1e-6 m for depths of
    1e-4 m.
    """
    h, k, t = falls(1000)
    run = dropped(spring, method=method)
    for tolerance in (1e-9, 1e-6):
        _, _, energy, status = run(h, k, t, tolerance)
        assert np.all(status == jl.Status.ok)
        off = np.abs(energy / (G * h) - 1)
        few = 2 if method == "dopri5" and tolerance == 1e-6 else 0  # 1.1 % and 1.5 %
        assert np.sum(off > 0.01) <= few


def test_energies_at_a_smooth_wall_are_right():
    """A wall of 2.5 mm: 150 of 400 were wrong at every tolerance."""
    rng = np.random.default_rng(1)
    h, k = 10 ** rng.uniform(-1, 2, 400), 10 ** rng.uniform(5, 7, 400)
    run = dropped(softplus)
    for tolerance in (1e-9, 1e-6):
        _, _, energy, status = run(h, k, 6 * np.sqrt(2 * h / G), tolerance)
        assert np.all(status == jl.Status.ok)
        off = np.abs(energy - G * h - k * 2.5e-3**2 * np.exp(-h / 2.5e-3)) / (G * h)
        assert np.max(off) < 1e-3


def test_steps_of_bounded_length_resolve_a_stiff_floor():
    h, k, t = falls(200)
    _, _, energy, status = dropped(spring, dt_max=jnp.array(0.05))(h, k, t, 1e-9)
    assert np.all(status == jl.Status.ok)
    np.testing.assert_allclose(energy, G * h, rtol=1e-4)


def test_overflow_in_a_steep_barrier_shortens_the_step():
    """exp(-q/w) overflows at stages far inside: the step is repeated with a shorter length."""

    def barrier(t, q, v, params):
        return 0.5 * v[0] ** 2 - G * q[0] - jnp.exp(-q[0] / params["k"])

    h, w = np.array([10.0, 1.0, 10.0, 3.0]), np.array([1e-4, 1e-3, 1e-2, 0.1])
    _, _, energy, status = dropped(barrier)(h, w, 6 * np.sqrt(2 * h / G), 1e-9)
    assert np.all(status == jl.Status.ok)
    np.testing.assert_allclose(energy, G * h, rtol=1e-6)


def test_explain_does_not_advise_a_looser_tolerance_for_bounces():
    for lagrangian in (spring, softplus):
        system = jl.System(lagrangian, ("x",))
        motion = jl.simulate(system, [1.0], [0.0], [0.0, 3.0], {"k": 1e5})
        text = motion.explain()
        assert "loose" not in text
        assert "change fast" in text or "Many steps were rejected" in text
    short = jl.simulate(system, [1.0], [0.0], [0.0, 3.0], {"k": 1e5}, max_steps=50, throw=False)
    assert "loose" not in short.explain()
    assert "Raise max_steps, or shorten ts." in short.message()
