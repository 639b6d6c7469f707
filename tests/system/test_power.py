"""Power and work of all terms, by name, account for the changes of H."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.mechanics import DRIVEN, GENERAL
from _systems.problems import MOTIONS

import jaxlag as jl

EPS = np.finfo(float).eps
TOLERANCE = 1e-10


def gathered():
    """(system, q, v, params, inputs): friction, inputs, explicit time, L not quadratic."""
    for name, motion in MOTIONS.items():
        yield name, (motion.system, motion.q0, motion.v0, motion.params, motion.inputs)
    for name, case in GENERAL.items():
        n = case.system.size
        q, v = jnp.resize(jnp.array(case.q0), n), jnp.linspace(0.9, -0.6, n)
        yield name, (case.system, q, v, case.params, None)


CASES = dict(gathered())


@pytest.mark.parametrize("name", CASES)
def test_power_terms_add_up_to_the_rate_of_energy(name):
    """dH/dt along (1, v, a) against sum_k v . Q_k - dL/dt, at one state."""
    system, q, v, params, inputs = CASES[name]
    t = jnp.array(0.25)
    a = system.acceleration(q, v, params, t=t, inputs=inputs)

    def H(t, q, v):
        return system.energy(q, v, params, t=t)

    rate = jax.jvp(H, (t, q, v), (jnp.ones_like(t), v, a))[1]
    terms = system.power(q, v, params, t=t, inputs=inputs)
    # Both have the rounding of M a, h and Q, each times v: 64 roundings of the largest product.
    M, h = system.mass_matrix(q, v, params, t=t), system.bias(q, v, params, t=t)
    size = np.abs(v) @ (np.abs(M) @ np.abs(a) + np.abs(h)) + sum(abs(x) for x in terms.values())
    np.testing.assert_allclose(sum(terms.values()), rate, rtol=0, atol=64 * EPS * size)


@pytest.mark.parametrize(
    "name",
    [
        "driven_pendulum",
        "relativistic",
        *(pytest.param(name, marks=pytest.mark.full) for name in ("cart_pendulum", "bead")),
    ],
)
def test_work_of_all_terms_equals_the_change_of_energy(name):
    """H - H(0) = the work of all terms, within some tens of local errors."""
    system, q, v, params, inputs = CASES[name]
    ts = jnp.linspace(0.0, 1.5, 7)
    motion = jl.simulate(
        system, q, v, ts, params, inputs=inputs, rtol=TOLERANCE, atol=TOLERANCE, save=("work",)
    )
    given = sum(motion.work.values(), jnp.zeros(7))
    scale = 1 + np.max(np.abs(motion.energy))
    steps = int(motion.stats["accepted"])
    np.testing.assert_allclose(
        motion.energy - motion.energy[0], given, rtol=0, atol=steps * TOLERANCE * scale
    )
    if motion.work:
        assert max(np.max(np.abs(work)) for work in motion.work.values()) > 1e-3
    assert all(work[0] == 0 for work in motion.work.values())


def test_the_work_of_a_damper_is_minus_twice_its_function():
    """dE/dt = -2 R for linear damping (Pila, sec. 3.7), by quadrature of R over the saves."""
    system, q, v, params, _ = CASES["double_pendulum_rayleigh"]
    ts = jnp.linspace(0.0, 1.5, 2001)
    motion = jl.simulate(system, q, v, ts, params, save=("work", "power"))
    (name,) = motion.power
    assert name == system.forces[0].name
    R = -0.5 * np.asarray(motion.power[name])
    h = 1.5 / 2000
    simpson = h / 3 * (R[0] + 4 * R[1:-1:2].sum() + 2 * R[2:-1:2].sum() + R[-1])
    # Simpson's error is h^4/180 (t1 - t0) R'''' ~ 3e-15 R''''; R'''' is about 1e4 here.
    np.testing.assert_allclose(motion.work[name][-1], -2 * simpson, rtol=1e-8)


def test_explicit_time_has_a_separate_term():
    system, q, v, params, _ = CASES["driven_pivot"]
    assert list(system.power(q, v, params)) == ["explicit time"]
    system, q, v, params, _ = CASES["chain"]
    assert system.power(q, v, params) == {}
    motion = jl.simulate(system, q, v, [0.0, 0.2], params, save=("work",))
    assert motion.work == {}


@pytest.mark.full
def test_power_terms_keep_the_order_of_the_forces():
    """Explicit time last; also through jit, vmap and `save`, which return dicts alphabetically."""
    forces = tuple(
        jl.GeneralizedForce(lambda t, q, v, params: -v, name) for name in ("wind", "brake", "motor")
    )
    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v - t * q[0], coordinates=("x",), forces=forces
    )
    order = ["wind", "brake", "motor", "explicit time"]
    assert list(system.power([0.1], [0.2])) == order
    ts = jnp.array([0.0, 0.1])

    def run(q0, save=("work", "power")):
        return jl.simulate(system, q0, [0.2], ts, save=save)

    motion = run(jnp.array([0.1]))
    assert list(motion.work) == list(motion.power) == order
    assert list(run(jnp.array([0.1]), ()).power) == order
    batch = jax.jit(jax.vmap(run))(jnp.array([[0.1], [0.2]]))
    assert list(batch.work) == list(batch.power) == order
    for name in order:
        np.testing.assert_array_equal(motion.work[name], motion.saved["work"][name])


def test_power_is_the_rate_of_work():
    """The derivative of work at a save, by its time, is the power there.

    That derivative is the last step's, right to its local error 1e-9 over its length.
    """
    motion = MOTIONS["driven_pendulum"]

    def work(t1):
        ts = jnp.stack([jnp.zeros(()), t1])
        inputs, params = motion.inputs, motion.params
        found = jl.simulate(
            motion.system, motion.q0, motion.v0, ts, params, inputs=inputs, save=("work", "power")
        )
        return {k: x[-1] for k, x in found.work.items()}, {k: x[-1] for k, x in found.power.items()}

    rate, power = jax.jacfwd(work, has_aux=True)(jnp.array(1.04))
    assert set(rate) == {"friction", "motor"}
    for name, expected in power.items():
        np.testing.assert_allclose(rate[name], expected, rtol=1e-7)


def test_work_is_integrated_only_on_request():
    """Without it the state has 2 n components; reading `work` raises an error with advice."""
    system, q, v, params, _ = CASES["double_pendulum_rayleigh"]
    ts = jnp.array([0.0, 0.3])

    def program(save):
        return str(jax.make_jaxpr(lambda q: jl.simulate(system, q, v, ts, params, save=save).q)(q))

    assert "f64[5]" not in program(())
    assert "f64[5]" in program(("work",))
    motion = jl.simulate(system, q, v, ts, params)
    with pytest.raises(
        ValueError, match=r"^`work` of a motion with save=\(\) is not supported: .*save=\(\"work"
    ):
        _ = motion.work


@pytest.mark.full
def test_work_has_batches_and_derivatives():
    system, q, v, params, _ = CASES["cart_pendulum"]
    ts = jnp.array([0.0, 0.4, 1.0])

    def work(b, ts=ts):
        found = jl.simulate(system, q, v, ts, params | {"b": b}, save=("work",))
        return jnp.stack(list(found.work.values()), axis=-1)

    b = jnp.array([0.3, 0.7, 2.0])
    many = jax.vmap(work)(b)
    for one, alone in zip(many, map(work, b), strict=True):
        np.testing.assert_allclose(one, alone, rtol=1e-8, atol=1e-9)
    forward, reverse = jax.jacfwd(work)(b[1]), jax.jacrev(work)(b[1])
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-12)
    step = 1e-4
    central = (work(b[1] + step) - work(b[1] - step)) / (2 * step)
    np.testing.assert_allclose(forward, central, rtol=0, atol=1e-5)  # tolerance 1e-9 over 2e-4


@pytest.mark.full
def test_work_backwards_in_time_has_the_opposite_sign():
    system, q, v, params, _ = CASES["cart_pendulum"]
    ts = jnp.array([0.0, 0.4, 1.0])
    forward = jl.simulate(system, q, v, ts, params, save=("work",))
    backward = jl.simulate(system, forward.q[-1], forward.v[-1], ts[::-1], params, save=("work",))
    for name, W in forward.work.items():
        np.testing.assert_allclose(backward.work[name][-1], -W[-1], atol=1e-6)


def test_saves_that_are_not_reached_have_nan_work():
    system, q, v, params, _ = CASES["cart_pendulum"]
    motion = jl.simulate(
        system, q, v, [0.0, 0.1, 5.0], params, save=("work", "power"), max_steps=8, throw=False
    )
    assert motion.status == jl.Status.max_steps
    for series in (*motion.work.values(), *motion.power.values()):
        assert np.isfinite(series[:2]).all()
        assert np.isnan(series[2])


DRAG = jl.Rayleigh(lambda t, q, v, params: 0.05 * v @ v, "drag")
WELL = jl.System(lambda t, q, v, params: 0.5 * v @ v - jnp.log(q[0]), ("x", "y"), forces=(DRAG,))


def into_the_well(v0, save=("work",)):
    """The force at x = 0 is unbounded; from v0 < 0 the motion ends there."""
    return jl.simulate(WELL, [1.0, 0.0], [v0, 0.5], [0.0, 0.1, 1.0], save=save, throw=False)


def test_message_of_a_failed_motion_with_work_names_the_coordinate():
    """The state of the failed step contains work besides (q, v); the message names x."""
    motion = into_the_well(-3.0)
    assert motion.status == jl.Status.step_below_resolution
    assert motion.message().startswith("step_below_resolution ('x')")
    assert motion.status == into_the_well(-3.0, save=()).status

    def found(v0):
        motion = into_the_well(v0)
        return motion.status, motion.where

    status, where = jax.jit(jax.vmap(found))(jnp.array([-3.0, 3.0]))
    np.testing.assert_array_equal(status, [jl.Status.step_below_resolution, jl.Status.ok])
    np.testing.assert_array_equal(where, [0, -1])


@pytest.mark.full
def test_perturbation_growth_does_not_depend_on_work():
    """Work is not a perturbed variable; under jit the complete status is needed."""

    def growth(save):
        def kappa(v0):
            return jl.lyapunov(into_the_well(v0, save)).kappa[-1]

        return jax.jit(kappa)(3.0)

    np.testing.assert_allclose(growth(("work",)), growth(()), rtol=1e-5)


def test_driven_pivot_agrees_with_the_force_on_the_pivot():
    """Explicit time does the work of the drive less the change of the terms that H omits.

    H = T2 - T0 + V and T + V differ by T1 + 2 T0. The horizontal force of the pivot times its speed
    is the rate of T + V, by Newton's law for the bob.
    """
    params = {"m": 0.7, "l": 0.5, "g": 9.81, "X": 0.2, "Omega": 3.0}
    m, length, X, omega = (params[k] for k in ("m", "l", "X", "Omega"))
    t, q, v = jnp.array(0.4), jnp.array([0.5]), jnp.array([1.2])
    a = DRIVEN.acceleration(q, v, params, t=t)

    def pivot_rate(t):
        return -X * omega * jnp.sin(omega * t)

    def omitted_terms(t, q, v):  # T + V - H = T1 + 2 T0
        return m * pivot_rate(t) * length * v[0] * jnp.cos(q[0]) + m * pivot_rate(t) ** 2

    def x_rate(t, q, v):
        return pivot_rate(t) + length * v[0] * jnp.cos(q[0])

    point_and_rates = (t, q, v), (jnp.ones_like(t), v, a)
    force = m * jax.jvp(x_rate, *point_and_rates)[1]
    (power,) = DRIVEN.power(q, v, params, t=t).values()
    np.testing.assert_allclose(
        power + jax.jvp(omitted_terms, *point_and_rates)[1], force * pivot_rate(t), rtol=64 * EPS
    )
