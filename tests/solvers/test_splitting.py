"""Splitting methods: orders, conserved structure, time, work, derivatives, refused systems.

The Henon-Heiles potential, alone or with a force that depends on position and time.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

import jaxlag as jl
from tests.solvers._flows import EPS, end, slopes, symplectic_defect

ORDERS = (2, 4, 6, 8)


def lagrangian(t, q, v, params):
    V = 0.5 * (q @ q) + params["k"] * (q[0] ** 2 * q[1] - q[1] ** 3 / 3)
    return 0.5 * params["m"] * (v @ v) - V


def swirl(t, q, v, params, inputs):
    """A force without potential that depends on time."""
    return params["c"] * jnp.cos(3.0 * t) * jnp.stack([-q[1], q[0]]) + inputs["pull"]


PARAMS = {"k": jnp.array(1.0), "m": jnp.array(0.8), "c": jnp.array(0.5)}
PULL = {"pull": jnp.array([0.05, -0.1])}
Q0, V0 = [0.3, 0.1], [0.1, 0.25]
plain = jl.System(lagrangian, ("x", "y"))
force = jl.GeneralizedForce(swirl, "swirl")
pushed = jl.System(lagrangian, ("x", "y"), forces=(force,))


@pytest.mark.parametrize("order", mostly_full(ORDERS, 4))
def test_order_with_time_and_forces_is_as_stated(order):
    """Forward and backward in time; steps are long enough for errors above 1e-12."""
    method, steps = f"splitting{order}", {2: 40, 4: 10, 6: 5, 8: 5}[order]
    counts = (steps, 2 * steps) if order > 4 else (steps, 2 * steps, 4 * steps)
    for span in ([0.2, 1.7], [0.2, -1.3]):
        found = slopes(pushed, Q0, V0, span, PARAMS, method, counts, inputs=PULL)
        np.testing.assert_allclose(found[-1], order, atol=0.1 if order < 6 else 0.2)


@pytest.mark.full
@pytest.mark.parametrize("order", ORDERS)
def test_map_is_symplectic(order):
    """To 200 roundings of products of |S| over 20 steps; the map of dopri8 is not symplectic."""
    defect, size = symplectic_defect(plain, Q0, V0, PARAMS, f"splitting{order}", 0.3, 20)
    assert defect <= 200 * EPS * size
    if order == 2:
        defect, size = symplectic_defect(plain, Q0, V0, PARAMS, "dopri8", 0.3, 20)
        assert defect > 1e4 * EPS * size


@pytest.mark.parametrize("order", ORDERS)
def test_motion_is_reversible(order):
    """50 steps forward and backward: a few roundings per step, of numbers below 1."""
    method = f"splitting{order}"
    forward = end(pushed, Q0, V0, [0.0, 5.0], PARAMS, inputs=PULL, method=method, dt=0.1)
    backward = end(
        pushed, *jnp.split(forward, 2), [5.0, 0.0], PARAMS, inputs=PULL, method=method, dt=0.1
    )
    np.testing.assert_allclose(backward, [*Q0, *V0], rtol=0, atol=100 * 4 * order * EPS)


def test_energy_has_no_drift_and_angular_momentum_is_conserved():
    """Kepler, e = 0.5, 50 periods: the energy only oscillates; L is constant to rounding."""
    kepler = jl.System(lambda t, q, v, p: 0.5 * (v @ v) + 1.0 / jnp.sqrt(q @ q), ("x", "y"))
    e, period = 0.5, 2 * np.pi
    q0, v0 = [1 - e, 0.0], [0.0, np.sqrt((1 + e) / (1 - e))]
    ts = np.arange(0, 51) * period  # at the pericenter, where the error is largest
    motion = jl.simulate(kepler, q0, v0, ts, method="splitting6", dt=period / 400, max_steps=20_100)
    spin = motion.q[:, 0] * motion.v[:, 1] - motion.q[:, 1] * motion.v[:, 0]
    np.testing.assert_allclose(spin, np.sqrt(1 - e**2), rtol=2 * np.sqrt(20_000 * 12) * EPS)
    error = np.abs(motion.energy - motion.energy[0])
    assert np.max(error[26:]) < 3 * np.max(error[1:26]) < 1e-7


def test_work_is_the_change_of_energy():
    """The work of swirl and pull is the change of energy, to the order of the method."""
    method = "splitting4"

    def gap(count):
        motion = jl.simulate(
            pushed,
            Q0,
            V0,
            [0.0, 1.5],
            PARAMS,
            inputs=PULL,
            method=method,
            dt=1.5 / count,
            save=("work",),
        )
        return motion.energy[-1] - motion.energy[0] - motion.work["swirl"][-1], motion.q[-1]

    (coarse, _), (fine, q) = gap(10), gap(20)
    assert np.log2(abs(coarse / fine)) == pytest.approx(4, abs=0.2)
    without = end(pushed, Q0, V0, [0.0, 1.5], PARAMS, inputs=PULL, method=method, dt=1.5 / 20)
    np.testing.assert_allclose(q, without[:2], rtol=0, atol=20 * 8 * EPS)


def test_array_program_takes_the_same_steps():
    array = jl.System(lagrangian, ("x", "y"), forces=(force,), lowering="array")
    options = {"inputs": PULL, "method": "splitting6", "dt": 0.1}
    a, b = (end(system, Q0, V0, [0.0, 3.0], PARAMS, **options) for system in (pushed, array))
    np.testing.assert_allclose(a, b, rtol=0, atol=30 * 24 * EPS)


@pytest.mark.full
def test_derivatives_equal_those_of_the_steps():
    """Forward, reverse and differences, by the start and by params, single and in lanes."""

    def last(x):
        params = PARAMS | {"k": x[2]}
        return end(pushed, x[:2], V0, [0.0, 1.5], params, inputs=PULL, method="splitting4", dt=0.1)

    x = jnp.array([0.3, 0.1, 1.0])
    forward, reverse = jax.jacfwd(last)(x), jax.jacrev(last)(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-13)
    h = 1e-5
    differences = [(last(x + h * e) - last(x - h * e)) / (2 * h) for e in jnp.eye(3)]
    # h^2 |f'''| / 6 and EPS |f| / h are below 1e-9 here.
    np.testing.assert_allclose(forward, jnp.stack(differences, 1), rtol=1e-8, atol=1e-9)
    lanes = jax.vmap(last)(x + 0.01 * jnp.arange(3.0)[:, None])
    np.testing.assert_allclose(lanes[0], last(x), rtol=0, atol=100 * EPS)


def test_last_step_ends_at_the_end_of_the_span():
    motion = jl.simulate(plain, Q0, V0, [0.0, 1.0], PARAMS, method="splitting2", dt=0.3)
    assert int(motion.stats["accepted"]) == 4
    whole = jl.simulate(plain, Q0, V0, [0.0, 0.9], PARAMS, method="splitting2", dt=0.3)
    rest = jl.simulate(
        plain, whole.q[-1], whole.v[-1], [0.9, 1.0], PARAMS, method="splitting2", dt=0.1
    )
    np.testing.assert_allclose(motion.q[-1], rest.q[-1], rtol=0, atol=8 * EPS)


def test_solver_works_in_diffrax():
    """y = (q, v) of any form; the same results as by `simulate`."""

    def field(t, y, args):
        (x, z), v = y
        a = -jnp.stack([x + 2 * x * z, z + x**2 - z**2]) / PARAMS["m"]
        return (v[0], v[1]), (a[0], a[1])

    start = tuple(map(jnp.asarray, Q0)), tuple(map(jnp.asarray, V0))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field), jl.solvers.Splitting(6), 0.0, 2.0, 0.1, start
    )
    y = jnp.concatenate(jax.tree.leaves(solution.ys))
    expected = end(plain, Q0, V0, [0.0, 2.0], PARAMS, method="splitting6", dt=0.1)
    np.testing.assert_allclose(y, expected, rtol=0, atol=20 * 24 * EPS)


def test_invalid_order_is_refused():
    with pytest.raises(
        ValueError, match=r"Splitting: `order` must be one of 2, 4, 6, 8, but it was 3"
    ):
        jl.solvers.Splitting(3)
