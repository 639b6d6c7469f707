"""Exported programs with symbolic numbers of motions and of times."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import jaxlag as jl

PENDULUM = jl.System(
    lambda t, q, v, params: 0.5 * v @ v - params["g"] * (1 - jnp.cos(q[0])), ("angle",)
)
ROD = jl.System(
    lambda t, q, v, params: 0.5 * v @ v - params["g"] * q[1],
    ("x", "y"),
    constraints=(jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod"),),
)
LINES = jl.System(PENDULUM.lagrangian, ("angle",), lowering="array")
STARTS = {"angle": jnp.array([0.6]), "x": jnp.array([0.6, 0.8])}


def vector(count):
    return jax.ShapeDtypeStruct((count,), jnp.float64)


def agree(function, sizes, rtol=0.0):
    """An exported function of (b,) params and (k,) times equals the function at other sizes.

    Chunks of lanes may have other sizes than without symbols: then rounding differs.
    """
    by = jax.jit(jax.vmap(function, (0, None)))
    b, k = export.symbolic_shape("b, k", constraints=["k >= 2"])
    exported = export.export(by)(vector(b), vector(k))
    for b, k in sizes:
        args = jnp.linspace(1.0, 2.0, b), jnp.linspace(0.0, 0.5, k)
        for x, y in zip(*map(jax.tree.leaves, (exported.call(*args), by(*args))), strict=True):
            np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol)


def end(system, **options):
    start = STARTS[system.coordinates.labels[0]]

    def of(g, ts):
        motion = jl.simulate(
            system, start, jnp.zeros_like(start), ts, {"g": g}, throw=False, **options
        )
        return motion.q, motion.ok

    return of


def test_exported_solves_accept_any_number_of_motions_and_times():
    agree(end(PENDULUM, method="bosh3", dt=0.1), [(3, 2), (20, 5)], rtol=1e-14)


@pytest.mark.full
@pytest.mark.parametrize("system", [PENDULUM, ROD, LINES], ids=["scalars", "rod", "arrays"])
@pytest.mark.parametrize("method", ["auto", "kvaerno5"])
def test_exported_adaptive_solves_agree(system, method):
    # The tolerance of a step: steps of a lane do not depend on other lanes, but round differently.
    sizes = [(1, 2), (16, 3), (17, 4)] if system is PENDULUM else [(17, 4)]
    agree(end(system, method=method), sizes, rtol=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("gradient", ["recorded", "forward"])
def test_exported_derivatives_agree(gradient):
    motion = end(PENDULUM, gradient=gradient, dt=0.05, max_steps=64)
    agree(jax.grad(lambda g, ts: jnp.sum(motion(g, ts)[0])), [(20, 5)], rtol=1e-12)


def test_unknown_properties_of_symbols_are_named():
    (k,) = export.symbolic_shape("k")
    for count, options, message in (
        (k, {}, r'at least 2 times, .* was \(k,\)\. Write jax\.export.*constraints=\["k >= 2"\]'),
        (k + 1, {"gradient_memory": 1e6}, r"`gradient_memory` must be left out .* is symbolic"),
    ):
        ended = jax.jit(lambda ts, options=options: end(PENDULUM, **options)(1.0, ts))
        with pytest.raises(ValueError, match=message):
            export.export(ended)(vector(count))
