"""Programs of a solve: the part before the loop, one evaluation, and the whole."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from _jaxprs import operations
from _systems.problems import MOTIONS

import jaxlag as jl
from bench._problems.scenes import SCENES
from jaxlag._lowering import State
from systems.catalogue import ENTRIES

SCALAR = {"add", "sub", "mul", "div", "neg", "sincos", "sqrt", "tanh", "gt", "and", "select_n"}
PACKING = {"slice", "squeeze", "stack", "reshape", "jit", "custom_jvp_call"}
# Divisions of the step-size control: 1/h; with it, those of the increments of q and v, of their
# errors and of the errors of unweighted stages; the error over its tolerance; two in the factor of
# h.
STEP = 9


class Case(NamedTuple):
    """A system at a state; `inputs` by name."""

    system: jl.System
    params: Any
    q0: jax.Array
    inputs: dict


def case(name):
    if name in SCENES:
        scene = SCENES[name]
        system = jl.System(scene.lagrangian, {"q": (len(scene.q0),)})
        return Case(system, floats(scene.params), floats(scene.q0), {})
    if name in MOTIONS:
        motion = MOTIONS[name]
        inputs = {} if motion.inputs is None else {"tau": jnp.array(0.3)}
        return Case(motion.system, floats(motion.params), motion.q0, inputs)
    entry = ENTRIES[name]
    return Case(entry.system, floats(entry.example.params), floats(entry.example.q0), {})


def floats(values):
    if isinstance(values, tuple):
        return jnp.array(values)
    return {name: jnp.asarray(x, float) for name, x in values.items()}


def prelude(case):
    """Operations done once per solve."""
    system, params, q, inputs = case
    return operations(lambda params: system._program.precompute(q, params, inputs), params)


def evaluation(case, regular=False):
    """Operations of one acceleration inside a solve; `regular` if M is known to be regular."""
    system, params, q, inputs = case
    program = system._program.regular() if regular else system._program
    constants = program.precompute(q, params, inputs)

    def acceleration(constants, params, t, q, v, inputs):
        return program.acceleration(State(t, q, v, params, inputs), constants)

    return operations(acceleration, constants, params, jnp.zeros(()), q, q, inputs)


def solve(case):
    """A solve as a function of (params, q0, v0), and its arguments."""
    system, params, q0, inputs = case

    def end(params, q0, v0):
        ts = jnp.array([0.0, 1.0])
        return jl.simulate(system, q0, v0, ts, params, inputs=inputs or None, throw=False).q[-1]

    return end, (params, q0, 0.1 * q0)
