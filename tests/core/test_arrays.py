"""Precision of states given by the user."""

import jax
import jax.numpy as jnp
import pytest

import jaxlag as jl
from jaxlag._core._arrays import array_of

PARAMS = {"m": 2.0, "k": 8.0}
Q0, V0, TS = [1.0, 2.0], [0.0, 1.0], [0.0, 1.0]


def lagrangian(t, q, v, params):
    return 0.5 * params["m"] * v @ v - 0.5 * params["k"] * q @ q


SYSTEM = jl.System(lagrangian, ("x", "y"))


def run(system=SYSTEM, **changes):
    arguments = {"q0": Q0, "v0": V0, "ts": TS, "params": PARAMS}
    return jl.simulate(system, **(arguments | changes))


HALF = [jnp.float16, jnp.bfloat16]
ROLLING = jl.System(
    lagrangian,
    ("x", "y"),
    quasi=jl.QuasiVelocities(lambda t, q, v, params: 2 * v, ("a", "b")),
)


@pytest.mark.parametrize("dtype", HALF)
@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda q, v: run(q0=q, v0=v), "`q0` and `v0` must"),
        (lambda q, v: run(q0={"x": q[0], "y": q[1]}, v0=v), "`q0` and `v0` must"),
        (lambda q, v: run(q0=q, v0=v, dt=0.1, method="euler"), "`q0` and `v0` must"),
        (lambda q, v: jax.jit(lambda q: run(q0=q, v0=v).q)(q), "`q0` and `v0` must"),
        (lambda q, v: run(ROLLING, q0=q, v0=None, u0=v), "`q0` and `u0` must"),
        (lambda q, v: jl.equilibrium(SYSTEM, q, PARAMS), "`q0` must"),
        (lambda q, v: jl.assemble(SYSTEM, q, v, PARAMS), "`q` and `v` must"),
        (lambda q, v: jl.inverse_dynamics(SYSTEM, q, v, v, PARAMS), "q, v and a must"),
        (lambda q, v: SYSTEM.acceleration(q, v, PARAMS), "`q` and `v` must"),
        (lambda q, v: SYSTEM.mass_matrix(q, params=PARAMS), "`q` must"),
    ],
)
def test_states_of_16_bits_are_refused(ask, message, dtype):
    q, v = jnp.asarray(Q0, dtype), jnp.asarray(V0, dtype)
    fix = rf"but {dtype.dtype.name} has \d digits .* Write q0?\.astype\(float\)"
    with pytest.raises(ValueError, match=f"^{message} be float32 or float64, {fix}"):
        ask(q, v)


def test_mixed_precisions_use_the_wider_one():
    """16 bits with float32 give float32, as for any two precisions."""
    half = jnp.asarray(Q0, jnp.float16)
    options = {"dt": 0.5, "method": "euler"}
    mixed = run(q0=half, v0=jnp.asarray(V0, jnp.float32), **options)
    assert mixed.q.dtype == jnp.float32


def test_lists_keep_the_precision_of_their_numbers():
    """Python's numbers alone are float64."""
    single = [jnp.float32(1.0), 2.0]
    for numbers, kind in (([1.0, 2], jnp.float64), (single, jnp.float32), ((1.0,), jnp.float64)):
        assert array_of(numbers).dtype == jnp.asarray(numbers).dtype == kind
    with pytest.raises(TypeError):
        array_of([{}])
