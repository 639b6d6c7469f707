"""Solvers of our own: order, error estimate, interpolation, against the same methods of diffrax."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

EPS = np.finfo(float).eps


def swing(t, y, args):
    """A pendulum pushed by cos t; y a vector."""
    return jnp.stack([y[1], -jnp.sin(y[0]) + args * jnp.cos(t)])


def swing_by_parts(t, y, args):
    """The same with y a dict."""
    return {"angle": y["rate"], "rate": -jnp.sin(y["angle"]) + args * jnp.cos(t)}


Y0, PUSH = jnp.array([1.0, 0.2]), jnp.array(0.3)


def one_step(solver, h, y0=Y0, field=swing):
    term = diffrax.ODETerm(field)
    t0, t1 = jnp.array(0.3), jnp.array(0.3) + h
    memory = solver.init(term, t0, t1, y0, PUSH)
    return solver.step(term, t0, t1, y0, PUSH, memory, made_jump=False)


def test_a_step_is_that_of_the_same_method_with_a_loop():
    """To 32 roundings: y1, the error estimate's size h |k|, stages and the next first stage."""
    y1, error, dense, last, _ = one_step(jl.solvers.Dopri8(), 0.2)
    y1_, error_, dense_, (_, last_), _ = one_step(diffrax.Dopri8(), 0.2)
    for a, b in ((y1, y1_), (error, error_), (dense["k"], dense_["k"]), (last, last_)):
        np.testing.assert_allclose(a, b, rtol=0, atol=32 * EPS * 2)


def test_states_may_be_pytrees():
    y0 = {"angle": jnp.array(1.0), "rate": jnp.array(0.2)}
    y1 = one_step(jl.solvers.Dopri8(), 0.2, y0, swing_by_parts)[0]
    flat = one_step(jl.solvers.Dopri8(), 0.2)[0]
    np.testing.assert_allclose([y1["angle"], y1["rate"]], flat, rtol=4 * EPS)


def test_order_of_the_step_and_of_its_error_estimate():
    """Local errors fall as h^9 and h^8, within 0.1 in the exponent."""
    fine = jax.jit(
        lambda h: diffrax.diffeqsolve(
            diffrax.ODETerm(swing),
            diffrax.Dopri8(),
            0.3,
            0.3 + h,
            h / 16,
            Y0,
            PUSH,
            stepsize_controller=diffrax.ConstantStepSize(),
        ).ys[0]
    )
    h = 0.8 * 2.0 ** -(np.arange(3) ** 0.5)
    steps = [one_step(jl.solvers.Dopri8(), x) for x in h]
    errors = [np.linalg.norm(step[0] - fine(x)) for step, x in zip(steps, h, strict=True)]
    slope = np.polyfit(np.log(h), np.log(errors), 1)[0]
    assert abs(slope - 9) < 0.35, slope
    estimates = [np.linalg.norm(step[1]) for step in steps]
    assert abs(np.polyfit(np.log(h), np.log(estimates), 1)[0] - 8) < 0.35


def test_it_is_a_solver_of_diffrax():
    """Dense output and derivatives in any mode, as from the method with a loop."""

    def solve(solver, push):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(swing),
            solver,
            0.0,
            5.0,
            None,
            Y0,
            push,
            saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, 5.0, 11)),
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
        ).ys

    found, expected = (
        jax.jit(lambda push, s=s: (solve(s, push), jax.jacrev(lambda p: solve(s, p))(push)))(PUSH)
        for s in (jl.solvers.Dopri8(), diffrax.Dopri8())
    )
    # Rounding moves the steps a little: both are within the tolerance of the truth.
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-8)


@pytest.mark.parametrize("made_jump", [False, True])
def test_steps_share_a_stage_unless_the_field_jumped(made_jump):
    solver, term = jl.solvers.Dopri8(), diffrax.ODETerm(swing)
    _, _, _, last, _ = one_step(solver, 0.2)
    wrong = last + 1.0
    step = jax.jit(
        lambda jump: solver.step(
            term, jnp.array(0.3), jnp.array(0.5), Y0, PUSH, wrong, made_jump=jump
        )[0]
    )
    moved = np.abs(step(jnp.array(made_jump)) - one_step(solver, 0.2)[0]).max()
    assert (moved < 32 * EPS) == made_jump
