"""JAX's flags for strict promotion and for debugging raise no error in jaxlag."""

import contextlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

FLAGS = {
    "rank promotion": lambda: jax.numpy_rank_promotion("raise"),
    "infs": lambda: jax.debug_infs(True),
    "nans": lambda: jax.debug_nans(True),
    "leaks": jax.checking_leaks,
    "none": contextlib.nullcontext,
}
TS = jnp.array([0.0, 0.05, 0.1])


def pendulum_lagrangian(t, q, v, params):
    return params * (0.5 * v @ v + jnp.cos(q[0])) + 0.1 * q[0]


def rod_lagrangian(t, q, v, params):
    return params * 0.5 * v @ v - 9.81 * q[1]


def along(t, q, v, params):
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    return jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]])


pendulum = jl.System(pendulum_lagrangian, ("a",))
rod_rows = (jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod"),)
rod = jl.System(rod_lagrangian, ("x", "y"), constraints=rod_rows)
skate = jl.System(
    lambda t, q, v, params: params * 0.5 * v @ v - q[0],
    ("x", "y", "a"),
    quasi=jl.QuasiVelocities(along, ("ahead", "across", "turn"), constrained=("across",)),
)


def last(system, q, v, **options):
    def of(params):
        return jl.simulate(system, q, v, TS, params, **options).q[-1, 0]

    return of


def fitted(params):
    motion = jl.simulate(pendulum, [1.0], [0.0], jnp.linspace(0.0, 1.0, 9), 1.3)
    measured = {"a": np.asarray(motion["a"]) + 1e-3 * (-1.0) ** np.arange(9)}
    experiment = jl.Experiment(np.asarray(motion.ts), measured, q0=[1.0], v0=[0.0])
    found = jl.fit(pendulum_of_dict, [experiment], {"m": params}, free=["m"])
    return found.params["m"]


pendulum_of_dict = jl.System(
    lambda t, q, v, params: pendulum_lagrangian(t, q, v, params["m"]), ("a",)
)
JOBS = {
    "eager": jax.grad(last(pendulum, [1.0], [0.0], method="tsit5")),
    "compiled": jax.jit(jax.grad(last(pendulum, [1.0], [0.0], method="tsit5"))),
    "forwards": jax.jacfwd(last(pendulum, [1.0], [0.0], method="tsit5")),
    "array": jax.grad(last(jl.System(pendulum_lagrangian, ("a",), lowering="array"), [1.0], [0.0])),
    "rod": jax.grad(last(rod, [1.0, 0.0], [0.0, 0.0], method="tsit5")),
    "null space": last(rod, [1.0, 0.0], [0.0, 0.0], formulation="null_space"),
    "variational": last(rod, [1.0, 0.0], [0.0, 0.0], method="variational2", dt=0.05),
    "gauss": jax.grad(last(pendulum, [1.0], [0.0], method="gauss4", dt=0.05)),
    "implicit": jax.grad(last(pendulum, [1.0], [0.0], method="kvaerno5")),
    "quasi": jax.grad(last(skate, [0.0, 0.0, 0.3], [0.0, 0.0, 1.0], method="tsit5")),
    "acceleration": lambda p: rod.acceleration(jnp.array([1.0, 0.0]), jnp.zeros(2), p),
    "multipliers": lambda p: rod.multipliers(jnp.array([1.0, 0.0]), jnp.zeros(2), p)["rod"],
    "equilibrium": jax.grad(lambda p: jl.equilibrium(pendulum, [0.2], p).q[0]),
    "hanging": lambda p: jl.equilibrium(rod, [0.1, -0.9], p).multipliers["rod"],
    "assemble": lambda p: jl.assemble(rod, [0.9, 0.1], [0.0, 0.1], p).q,
    "batch": lambda p: jax.vmap(jax.grad(last(pendulum, [1.0], [0.0])))(jnp.stack([p, 2 * p])),
    "fit": fitted,
    "growth": lambda p: jl.lyapunov(jl.simulate(pendulum, [1.0], [0.0], TS, p)).log_norm,
}
PLAIN = {
    "rank promotion": ["compiled", "rod", "acceleration", "equilibrium", "assemble"],
    "infs": ["eager"],
    "nans": ["eager"],
}
LEFT_OUT = {("infs", "growth"), ("infs", "fit")}  # their results contain inf: "never", "unknown"


def check(flag, job):
    with FLAGS[flag]():
        found = JOBS[job](jnp.asarray(1.3))
    assert np.all(np.isfinite(found))


@pytest.mark.full
@pytest.mark.parametrize(("flag", "job"), [(f, job) for f, jobs in PLAIN.items() for job in jobs])
def test_main_jobs_run_under_each_flag(flag, job):
    check(flag, job)


@pytest.mark.full
@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("flag", FLAGS)
def test_all_jobs_run_under_all_flags(flag, job):
    if (flag, job) in LEFT_OUT:
        pytest.skip("some of its numbers are infinite")
    check(flag, job)


WITHOUT_JIT = """
import jax, jax.numpy as jnp, jaxlag as jl
jax.config.update("jax_enable_x64", True)
pendulum = jl.System(lambda t, q, v, p: p * (0.5 * v @ v + jnp.cos(q[0])) + 0.1 * q[0], ("a",))

def end(p):
    return jl.simulate(pendulum, [1.0], [0.0], [0.0, 0.05, 0.1], p, method="tsit5")["a"][-1]

compiled = jax.grad(end)(1.3)
with jax.disable_jit():
    assert abs(jax.grad(end)(1.3) / compiled - 1.0) < 1e-12
"""


@pytest.mark.full
def test_gradients_without_jit_equal_compiled_ones():
    """In a process without type checks: without jit, loop counters are Python integers."""
    subprocess.run([sys.executable, "-c", WITHOUT_JIT], check=True)
