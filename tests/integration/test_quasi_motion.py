"""Quasi-velocities: projected and Boltzmann-Hamel equations, derivatives, batches, inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _systems.quasi_systems import NAMES, PARAMS, declared, in_u, in_v, of_u, random_states, skewed
from _user import unchecked  # noqa: F401
from numpy.linalg import cond, norm

import jaxlag as jl
from jaxlag._core._status import Status

EPS = np.finfo(float).eps
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.mark.parametrize(
    ("lagrangian", "written_in"),
    mostly_full([(in_v, "v"), (in_u, "u"), (of_u, "u")], (in_v, "v"), (in_u, "u")),
    ids=["v", "same", "u"],
)
def test_equations_equal_those_of_lagrange(lagrangian, written_in):
    """a from u' and v = B u + c equals a from M a + h = Q, at random states."""
    system = declared(lagrangian, written_in)
    found = jax.jit(lambda q, v, t: system._quasi_reactions(q, v, PARAMS, t=t)["a"])
    expected = jax.jit(lambda q, v, t: system.acceleration(q, v, PARAMS, t=t))
    theta = jax.jit(lambda t, q: jax.jacfwd(lambda v: skewed(t, q, v, PARAMS))(q))
    mass = jax.jit(lambda q, v, t: system.mass_matrix(q, v, PARAMS, t=t))
    for t, q, v in random_states():
        kappa = cond(theta(t, q)) ** 2 * cond(mass(q, v, t))
        a, right = found(q, v, t), expected(q, v, t)
        # Measured 2026-11-22: at most 4 eps kappa (1 + |a|).
        assert norm(a - right) <= 64 * EPS * kappa * (1.0 + norm(right))


@pytest.mark.full
@pytest.mark.parametrize(
    "lagrangian", mostly_full([in_v, in_u, of_u], in_u), ids=["v", "same", "u"]
)
@pytest.mark.parametrize("constrained", mostly_full([["b"], ["a", "c"]], ["b"]))
def test_multipliers_equal_those_of_the_multiplier_equations(lagrangian, constrained):
    """a and lam of the quasi-velocity equations equal those of the multiplier equations."""
    written_in = "v" if lagrangian is in_v else "u"
    system = declared(lagrangian, written_in, tuple(constrained))
    bound = [NAMES.index(name) for name in constrained]
    for t, q, v in random_states(3):
        u = np.array(system.quasi_velocities(q, v, PARAMS, t=t))
        u[bound] = 0.0
        v = system.velocities(q, u, PARAMS, t=t)
        found = system._quasi_reactions(q, v, PARAMS, t=t)
        a, lam = system.acceleration(q, v, PARAMS, t=t), system.multipliers(q, v, PARAMS, t=t)
        scale = 1.0 + norm(a) + max(abs(x) for x in lam.values())
        # Measured 2026-11-22: at most 2e-14 of the scale.
        assert norm(found["a"] - a) <= 1e-12 * scale
        assert set(found["multipliers"]) == set(lam) == set(constrained)
        for name, value in lam.items():
            assert abs(found["multipliers"][name] - value) <= 1e-12 * scale
        force = system.constraint_force(q, v, PARAMS, t=t)
        assert norm(found["constraint_force"] - force) <= 1e-12 * scale


@pytest.mark.full
@pytest.mark.parametrize(("lagrangian", "backwards"), [(of_u, True), (in_v, False)], ids=["u", "v"])
def test_both_formulations_give_the_same_motion(lagrangian, backwards):
    """q, v, u to 1e-10, lam to 1e-9, with explicit time, an affine U and a force."""
    system = declared(lagrangian, "v" if lagrangian is in_v else "u", ("b",))
    ts = np.linspace(0.2, 1.5, 4)[:: -1 if backwards else 1]
    start = {"q0": [0.3, -0.2, 0.5], "v0": None, "u0": {"a": 0.7, "c": -0.4}}
    one, other = (
        jl.simulate(system, ts=ts, params=PARAMS, formulation=f, **start, **TIGHT)
        for f in ("quasi", "multipliers")
    )
    assert one.formulation == "quasi"
    for name in ("q", "v", "u"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-10)
    np.testing.assert_allclose(one.lam["b"], other.lam["b"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.a, other.a, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(one["b"], one.u[:, 1])
    # The row holds to rounding without projection.
    assert np.max(np.abs(one["b"])) <= 64 * EPS


# ---- Derivatives, batches, saved quantities, inputs ----------------------------------------------


def blown(t, q, v, params):
    """A blade on drifting, oscillating ice: speeds along and across, with time, and rotation."""
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    along = c * v[0] + s * v[1] + 0.2 * t
    return jnp.stack([along, -s * v[0] + c * v[1] - params["w"] * jnp.sin(t), v[2]])


def sprung(t, q, v, params):
    """A sleigh on springs; its mass center is ahead of the blade."""
    m, J, a = params["m"]
    x, y = v[0] - a * jnp.sin(q[2]) * v[2], v[1] + a * jnp.cos(q[2]) * v[2]
    return 0.5 * m * (x * x + y * y) + 0.5 * J * v[2] ** 2 - 0.5 * (1.0 + 0.1 * t) * (q @ q)


def on_springs(forces=()):
    quasi = jl.QuasiVelocities(blown, NAMES, ("b",))
    return jl.System(sprung, ("x", "y", "z"), forces=forces, quasi=quasi)


@pytest.mark.full
def test_the_direction_of_time_may_be_traced():
    system = on_springs()

    @jax.jit
    def end(ts):
        motion = jl.simulate(
            system, [0.3, -0.2, 0.5], None, u0=[0.7, 0.0, -0.4], ts=ts, params=PARAMS, **TIGHT
        )
        return motion.q[-1], motion.v[-1]

    ts = jnp.array([0.2, 0.9])
    state = end(ts)
    backward = jl.simulate(system, *state, ts[::-1], PARAMS, **TIGHT)
    np.testing.assert_allclose(backward.q[-1], [0.3, -0.2, 0.5], atol=1e-10)
    again = end(ts[::-1])
    assert bool(jnp.all(jnp.isfinite(again[0])))


def end_of(system, formulation="quasi", **options):
    def end(x):
        params = {"m": x["m"], "w": x["w"]}
        motion = jl.simulate(
            system,
            x["q0"],
            None,
            u0=x["u0"],
            ts=jnp.array([0.0, 0.5, 1.0]),
            params=params,
            formulation=formulation,
            **options,
        )
        return jnp.concatenate([motion.q[-1], motion.v[-1], motion.u[1]])

    return end


X = {
    "m": PARAMS["m"],
    "w": jnp.asarray(PARAMS["w"]),
    "q0": jnp.array([0.3, -0.2, 0.5]),
    "u0": {"a": jnp.array(0.7), "c": jnp.array(-0.4)},
}


@pytest.mark.full
def test_derivatives_agree_with_differences():
    """Fixed steps make the map smooth, so that central differences apply."""
    system = on_springs()
    end = end_of(system, dt=0.05)
    rng = np.random.default_rng(0)
    dx = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=np.shape(x))), X)
    y, dy = jax.jit(lambda x, dx: jax.jvp(end, (x,), (dx,)))(X, dx)
    weights = jnp.linspace(1.0, 2.0, y.shape[0])
    gradient = jax.jit(jax.grad(lambda x: weights @ end(x)))(X)
    dot = sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (gradient, dx)), strict=True))
    # Measured 2026-11-22: 3e-16 of the scale.
    assert abs(weights @ dy - dot) <= 1e-13 * jnp.sum(jnp.abs(weights * dy))
    h = 1e-5
    ahead, behind = (jax.tree.map(lambda x, d, s=s: x + s * h * d, X, dx) for s in (1, -1))
    run = jax.jit(end)
    slope = (run(ahead) - run(behind)) / (2 * h)
    np.testing.assert_allclose(dy, slope, atol=1e-8 * (1.0 + norm(dy)))


@pytest.mark.full
def test_derivatives_of_both_formulations_agree():
    """Along a family of consistent starts, to 1e-8."""
    system = on_springs()
    one, other = (
        jax.jit(jax.jacfwd(end_of(system, formulation, **TIGHT)))(X)
        for formulation in ("quasi", "multipliers")
    )
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)


@pytest.mark.full
def test_lanes_equal_single_runs():
    system = on_springs()

    def end(a):
        motion = jl.simulate(
            system,
            X["q0"],
            None,
            u0={"a": a, "c": -0.4},
            ts=jnp.array([0.0, 1.0]),
            params=PARAMS,
            dt=0.05,
        )
        return motion.q[-1], motion.u[-1], motion.status

    speeds = jnp.linspace(0.1, 2.0, 5)
    q, u, status = jax.jit(jax.vmap(end))(speeds)
    assert np.all(np.asarray(status) == int(Status.ok))
    for k, a in enumerate(speeds):
        np.testing.assert_allclose(q[k], end(a)[0], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(u[k], end(a)[1], rtol=1e-12, atol=1e-12)


@pytest.mark.full
def test_saved_quantities_equal_later_ones_and_work_is_the_energy_change():
    """Work of a force that follows an input, of feedback, and of a row whose b is not zero."""

    def pull(t, q, v, params, inputs):
        return jnp.stack([inputs["thrust"], inputs["brake"], jnp.zeros_like(t)])

    def brake(t, q, v, params):
        return -0.4 * v[1]

    def drag(t, q, v, params):
        return 0.5 * 0.2 * v[2] ** 2

    system = on_springs((jl.GeneralizedForce(pull, "pull"), jl.Rayleigh(drag, "drag")))
    inputs = {
        "thrust": jl.ZeroOrderHold(jnp.array([0.0, 0.4, 2.0]), jnp.array([1.0, -0.5, 0.0])),
        "brake": jl.Feedback(brake),
    }
    names = ("a", "multipliers", "u", "constraint_force", "energy")
    arguments = {
        "v0": None,
        "u0": X["u0"],
        "ts": np.linspace(0.0, 1.0, 3),
        "params": PARAMS,
        "inputs": inputs,
    }
    motion = jl.simulate(system, X["q0"], save=(*names, "work"), **arguments, **TIGHT)
    other = jl.simulate(system, X["q0"], formulation="multipliers", **arguments, **TIGHT)
    for name in names:
        found = getattr(motion, name)
        for a, b in zip(*map(jax.tree.leaves, (found, getattr(other, name))), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
    assert set(motion.work) == {"pull", "drag", "b", "explicit time"}
    change = motion.energy - motion.energy[0]
    # Measured 2026-11-22: 5e-13.
    np.testing.assert_allclose(sum(motion.work.values()), change, atol=1e-11)


@pytest.mark.full
def test_lagrangian_with_a_loop_equals_the_plain_one():
    """An L without scalar form uses arrays, and gives the same motion."""

    def looped(t, q, v, params):
        def add(k, total):
            return total + 0.5 * params["m"][k] * v[k] ** 2

        return jax.lax.fori_loop(0, 3, add, 0.0) - 0.5 * params["w"] * (q @ q)

    def plain(t, q, v, params):
        return 0.5 * params["m"] @ v**2 - 0.5 * params["w"] * (q @ q)

    ends = []
    for lagrangian in (looped, plain):
        system = declared(lagrangian, "v", ("b",), forces=())
        motion = jl.simulate(
            system, X["q0"], None, u0=X["u0"], ts=[0.0, 1.0], params=PARAMS, **TIGHT
        )
        ends.append(np.concatenate([motion.q[-1], motion.u[-1], [motion.lam["b"][-1]]]))
    np.testing.assert_allclose(*ends, atol=1e-10)
