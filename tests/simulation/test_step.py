"""`step`: fixed steps as a plain function."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _jaxprs import names, operations

import jaxlag as jl
from systems.catalogue import find

P = {"m": 2.0, "k": 3.0}


def torque(t, q, v, params, inputs):
    return jnp.stack([inputs["torque"] - jax.lax.cbrt(v[0])])


spring = jl.System(
    lambda t, q, v, p: 0.5 * p["m"] * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2,
    ("x",),
    forces=(jl.GeneralizedForce(torque, "motor"),),
)
one = partial(jl.step, spring, dt=0.1, params=P, inputs={"torque": 0.5})


@pytest.mark.parametrize(("method", "steps"), [("tsit5", 1), ("tsit5", 3), ("euler", 2)])
def test_a_step_is_that_of_simulate(method, steps):
    q, v = one([0.3], [0.2], steps=steps, method=method)
    options = {"inputs": {"torque": 0.5}, "dt": 0.1 / steps, "method": method}
    motion = jl.simulate(spring, [0.3], [0.2], [0.0, 0.1], P, **options)
    np.testing.assert_allclose(q, motion.q[-1], rtol=4e-16)
    np.testing.assert_allclose(v, motion.v[-1], rtol=4e-16)


def test_a_step_costs_the_accelerations_of_its_stages():
    """Six of tsit5, whose seventh is that of the next step; no loops, no record."""
    program = jax.jit(lambda q, v: one(q, v))
    at = jnp.array([0.3]), jnp.array([0.2])
    found = names(operations(program, *at))
    assert not found & {"while", "scan", "cond", "pure_callback", "io_callback"}
    text = program.lower(*at).compile().as_text()
    assert sum(" cbrt(" in line for line in text.splitlines()) == 6


def test_derivatives_of_a_loop_are_those_of_its_steps():
    """Of a policy over 8 intervals: forward, reverse, and central differences."""

    def cost(gain, k):
        def interval(state, _):
            q, v = state
            force = {"torque": -gain[0] * q[0] - gain[1] * v[0]}
            state = jl.step(spring, q, v, 0.1, {"m": 2.0, "k": k}, inputs=force)
            return state, state[0][0] ** 2

        start = jnp.array([0.3]), jnp.array([0.2])
        return jnp.sum(jax.lax.scan(interval, start, None, length=8)[1])

    at = jnp.array([1.0, 0.5]), 3.0
    forward = jax.jit(jax.jacfwd(cost, argnums=(0, 1)))(*at)
    reverse = jax.jit(jax.grad(cost, argnums=(0, 1)))(*at)
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(reverse), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    h, program = 1e-5, jax.jit(cost)
    for i in range(2):
        d = h * jnp.eye(2)[i]
        slope = (program(at[0] + d, 3.0) - program(at[0] - d, 3.0)) / (2 * h)
        np.testing.assert_allclose(reverse[0][i], slope, rtol=1e-8)
    slope = (program(at[0], 3.0 + h) - program(at[0], 3.0 - h)) / (2 * h)
    np.testing.assert_allclose(reverse[1], slope, rtol=1e-8)


def test_a_table_is_read_in_the_interval_of_the_step():
    """Steps that begin on knots give the motion whose steps end on them."""
    table = {"torque": jl.ZeroOrderHold([0.0, 0.1, 0.2, 0.3], [1.0, -1.0, 2.0, 0.0])}
    step = jax.jit(lambda t, q, v: jl.step(spring, q, v, 0.1, P, t=t, inputs=table))
    q, v = jnp.array([0.3]), jnp.array([0.2])
    for t in (0.0, 0.1, 0.2):
        q, v = step(t, q, v)
    ts = [0.0, 0.1, 0.2, 0.3]
    motion = jl.simulate(spring, [0.3], [0.2], ts, P, inputs=table, dt=0.1, method="tsit5")
    np.testing.assert_allclose(jnp.concatenate([q, v]), [*motion.q[-1], *motion.v[-1]], rtol=1e-14)
    assert not np.any(np.isfinite(step(0.25, q, v)))  # beyond the table


@pytest.mark.parametrize("summed", [False, True])
def test_a_step_off_the_knots_by_rounding_reads_the_right_interval(summed):
    """500 steps of 0.02 s, their starts as rounded products or as sums in single precision."""
    count, h = 500, np.float32(0.02)
    held = jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["k"][None], "held")
    free = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(held,))
    table = {"k": jl.ZeroOrderHold(0.02 * np.arange(count + 1), np.arange(count + 1.0))}
    products = np.arange(count).astype(np.float32) * h
    ts = np.cumsum(np.full(count, h)) - h if summed else products
    rate = lambda t: jl.step(free, [0.0], [0.0], 0.02, t=t, inputs=table)[1][0] / 0.02  # noqa: E731
    steps = jax.jit(jax.vmap(rate))(ts.astype(float))
    inside = slice(1, -1)  # sums are off by more than rounding, so that the ends are not defined
    np.testing.assert_allclose(steps[inside], np.arange(count)[inside], rtol=1e-12)


@pytest.mark.parametrize("dt", [0.0, -0.1])
def test_a_traced_step_that_is_not_positive_is_nan(dt):
    assert np.isnan(jax.jit(lambda dt: one([0.3], [0.2], dt=dt))(dt)).all()


def test_a_step_that_fails_is_nan():
    root = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2,
        ("x",),
        forces=(jl.GeneralizedForce(lambda t, q, v, p: jnp.sqrt(q), "root"),),
    )
    ends = jax.vmap(lambda q: jl.step(root, q[None], [-1.0], 0.5, method="heun"))(
        jnp.array([1.0, 0.4])
    )
    assert np.isfinite(ends[0][:, 0]).tolist() == [True, False]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": -0.1}, "`dt` must be positive"),
        ({"dt": None}, r"step: `dt` must be given, .* Write dt=0\.05"),
        ({"steps": 0}, "step: `steps` must be a positive integer"),
        ({"v": None}, r"step: `v` must be given, .* system\.velocities"),
        ({"t": [0.0]}, "step: `t` must be a number"),
        ({"method": diffrax.LeapfrogMidpoint()}, "step: `method` must be a one-step method"),
        ({"formulation": "quasi"}, "`formulation` must be 'auto'"),
        ({"inputs": None}, "`inputs` must have an entry 'torque'"),
        ({"params": {"m": 2.0, "k": np.nan}}, r"`params\['k'\]` must be finite"),
        (
            {"inputs": {"torque": jl.ZeroOrderHold([0.0, 0.05], [1.0, 0.0])}},
            "t and t",
        ),
    ],
)
def test_invalid_arguments_are_named(changes, message):
    given = {"q": [0.3], "v": [0.2]} | changes
    with pytest.raises(ValueError, match=message):
        one(**given)


SYSTEMS = ["double_pendulum_cartesian", "falling_stick_friction", "rolling_disk", "tricycle"]


@pytest.mark.full
@pytest.mark.parametrize("method", ["tsit5", "kvaerno3"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_steps_of_constrained_systems_are_those_of_simulate(name, method):
    """States, and derivatives by params along the consistent starts."""
    entry = find(name)
    system, example = entry.system, entry.example
    leaves, tree = jax.tree.flatten(example.params)
    leaves = [jnp.asarray(x, float) for x in leaves]

    def start(leaves):
        params = jax.tree.unflatten(tree, leaves)
        q, v = jnp.asarray(example.q0), jnp.asarray(example.v0)
        if system.constraints:
            found = jl.assemble(system, q, v, params)
            q, v = found.q, found.v
        return q, v, params

    def stepped(leaves):
        q, v, params = start(leaves)
        return jnp.concatenate(jl.step(system, q, v, 0.02, params, method=method, steps=2))

    def simulated(leaves):
        q, v, params = start(leaves)
        motion = jl.simulate(system, q, v, [0.0, 0.02], params, method=method, dt=0.01)
        return jnp.concatenate([motion.q[-1], motion.v[-1]])

    ours, theirs = stepped(leaves), simulated(leaves)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=4e-16 * (1 + jnp.abs(theirs).max()))
    ours, theirs = jax.jacfwd(stepped)(leaves), jax.jacfwd(simulated)(leaves)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * (1 + jnp.abs(b).max()))


@pytest.mark.full
def test_a_step_across_singular_quasi_velocities_is_nan():
    """u = cos(y) x' across y = pi/2, where `simulate` ends as kinematics_singular."""

    def speeds(t, q, v, p):
        return jnp.stack([jnp.cos(q[1]) * v[0], v[1]])

    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), quasi=jl.QuasiVelocities(speeds, ("a", "b"))
    )
    q, v = jnp.array([0.0, 1.5]), jnp.array([1.0, 1.0])
    before, across = (jl.step(system, q, v, dt, formulation="quasi") for dt in (0.03, 0.2))
    assert np.all(np.isfinite(before))
    assert not np.any(np.isfinite(across))
    assert np.all(np.isfinite(jl.step(system, q, v, 0.2, formulation="multipliers")))
