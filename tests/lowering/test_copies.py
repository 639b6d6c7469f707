"""Number of copies of the equations in a compiled motion and its gradient."""

from functools import partial

import jax
import jax.numpy as jnp
import pytest
from _jaxprs import operations

import jaxlag as jl

# ---- Copies of the equations ---------------------------------------------------------------------


def _odd(t, q, v, params):
    """A force with one operation that nothing else contains."""
    return jax.lax.erf_inv(0.1 * jnp.sin(q)) - q


def copies(lowering, function_of, size=2):
    """Number of occurrences of the force in the program of `function_of(system)`."""

    def lagrangian(t, q, v, params):
        return 0.5 * v @ v + 0.1 * jnp.sum(jnp.cos(q[:, None] - q)) * v[0] ** 2

    system = jl.System(
        lagrangian,
        {"x": (size,)},
        forces=(jl.GeneralizedForce(_odd, "odd"),),
        lowering=lowering,
    )
    program = operations(*function_of(system), iterations=1)
    return len([o for o in program if o.name == "erf_inv"])


def motion_of(system, save=(), saves=11):
    n = system.size

    def run(q0):
        ts = jnp.linspace(0.0, 1.0, saves)
        motion = jl.simulate(system, q0, jnp.ones(n), ts, save=save, throw=False)
        return motion.q, motion.v, motion.ok, motion.saved

    return run, jnp.full(n, 0.3)


def gradient_of(system):
    run, q0 = motion_of(system)
    return jax.grad(lambda q0: jnp.sum(run(q0)[0] ** 2)), q0


def test_program_contains_equations_once_in_its_loop_and_once_before():
    """On arrays: in the loop over stages, and for the first stage and first step size."""
    assert copies("array", motion_of) == 2
    assert copies("array", partial(motion_of, save=("a", "energy"))) == 3


@pytest.mark.full
def test_gradient_contains_equations_once_per_loop():
    """One copy for each loop, and two before the loops.

    The loops are those of the recorded motion, of the states between checkpoints and of the
    transposed step. The other copies are for the first step size and for the rates of
    perturbations.
    """
    assert copies("array", gradient_of) == 5


@pytest.mark.full
def test_long_scalar_program_is_interpreted_before_its_loop():
    """Nine components of the force in the loop; the interpreter has each operation once."""
    assert copies("scalar", motion_of, size=9) == 9 + 1
