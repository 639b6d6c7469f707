"""Invalid quasi-velocities are refused, and singular kinematics end a motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.quasi_systems import (
    BLADE,
    NAMES,
    PARAMS,
    angles,
    declared,
    in_v,
    of_u,
    push,
    sideways,
    skewed,
    sleigh,
    sleigh_rates,
    sleighs,
)
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag._core._errors import SimulationError
from jaxlag._core._status import Status

EPS = np.finfo(float).eps
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.mark.full
def test_singular_kinematics_are_named():
    """At a pitch of 90 degrees the third rate follows from the second; also under jit."""
    system = angles()

    def status(pitch):
        motion = jl.simulate(
            system,
            [0.1, pitch, 0.2],
            None,
            u0=[0.1, 0.2, 0.3],
            ts=[0.0, 0.1],
            params={},
            throw=False,
        )
        return motion.status, motion.where, motion.q

    kinds, where, q = jax.jit(jax.vmap(status))(jnp.array([0.3, np.pi / 2]))
    assert [Status(int(kind)) for kind in kinds] == [Status.ok, Status.kinematics_singular]
    assert int(where[1]) == 2
    assert np.all(np.isfinite(q[0]))
    with pytest.raises(SimulationError, match=r"kinematics_singular \('wz'\).*dU/dv is singular"):
        jl.simulate(
            system, [0.1, np.pi / 2, 0.2], None, u0=[0.1, 0.2, 0.3], ts=[0.0, 0.1], params={}
        )
    assert np.all(np.isnan(system.velocities([0.1, np.pi / 2, 0.2], [0.1, 0.2, 0.3], {})))


def leaning(t, q, v, params):
    return jnp.stack([v[0] + v[1], v[1] * jnp.cos(q[0]) * params["d"]])


def swinging(t, q, v, params):
    return 0.5 * params["m"] * (1.0 + 0.1 * jnp.sin(q[1])) * (v @ v) - q[0] ** 2


@pytest.mark.full
@pytest.mark.parametrize("pitch", [0.5 * np.pi, -0.5 * np.pi, 1.5 * np.pi])
def test_rates_of_rounding_count_as_singular(pitch):
    """Without roll the third rate is 6e-17 yaw', which is rounding."""
    system, q, v = angles(), [0.0, pitch, 0.0], [0.1, 0.2, 0.3]
    for start in ({"v0": None, "u0": v}, {"v0": v}):
        motion = jl.simulate(system, q, ts=[0.0, 0.1], throw=False, **start)
        assert motion.status == Status.kinematics_singular
        assert "'wz'" in motion.message()
    assert np.all(np.isnan(system.velocities(q, v, {})))
    assert np.all(np.isnan(system._quasi_reactions(q, v, {})["a"]))


@pytest.mark.full
def test_lane_with_singular_kinematics_does_not_affect_derivatives():
    quasi = jl.QuasiVelocities(leaning, ("a", "b"))
    system = jl.System(swinging, ("x", "y"), quasi=quasi)

    def total(m, d, formulation):
        def one(d):
            motion = jl.simulate(
                system,
                [0.1, 0.2],
                None,
                u0=jnp.array([0.3, 0.2]),
                ts=jnp.array([0.0, 1.0]),
                params={"m": m, "d": d},
                formulation=formulation,
                method="tsit5",
                throw=False,
            )
            return jnp.where(motion.status == 0, jnp.sum(motion.q[-1]), 0.0), motion.status

        values, status = jax.vmap(one)(d)
        return jnp.sum(values), status

    grad = jax.jit(jax.grad(total, has_aux=True), static_argnums=2)
    d, singular = jnp.array([1.3, 0.0, 0.4]), int(Status.kinematics_singular)
    slope, status = grad(1.2, d, "quasi")
    assert status.tolist() == [0, singular, 0]
    without, _ = grad(1.2, d[::2], "quasi")
    np.testing.assert_allclose(slope, without, rtol=1e-9)
    other, status = grad(1.2, d, "multipliers")
    assert status.tolist() == [0, singular, 0]
    np.testing.assert_allclose(slope, other, rtol=1e-6)


@pytest.mark.full
def test_failures_independent_of_kinematics_keep_their_status():
    """A force ends where dU/dv is singular: with multipliers U is not evaluated."""

    def ending(t, q, v, params):
        return jnp.stack([0.0 * t, jnp.sqrt(0.1 - t), 0.0 * t])

    def turned(t, q, v, params):
        return jnp.stack([v[0], jnp.sin(q[0]) * v[1], v[2]])

    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y", "z"),
        forces=(jl.GeneralizedForce(ending, "ending"),),
        quasi=jl.QuasiVelocities(turned, NAMES),
    )
    with pytest.raises(SimulationError, match=r"nonfinite|step_below_resolution"):
        jl.simulate(system, [0.0] * 3, [0.0] * 3, [0.0, 1.0], formulation="multipliers")


def not_affine(t, q, v, params):
    return jnp.stack([v[0] * v[1], v[1], v[2]])


def not_affine_kinematics(t, q, u, params):
    return jnp.stack([u[0], u[1] ** 2, u[0]])


def one(names=NAMES, U=skewed, **options):
    return jl.QuasiVelocities(U, names, **options)


def system_of(quasi, lagrangian=in_v, **options):
    return jl.System(lagrangian, ("x", "y", "z"), quasi=quasi, **options)


def run(quasi, **options):
    options = {"v0": None, "u0": np.zeros(quasi.size), "ts": [0.0, 1.0], "params": PARAMS} | options
    constraints = options.pop("constraints", ())
    return jl.simulate(system_of(quasi, constraints=constraints), np.zeros(3), **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jl.QuasiVelocities(names=NAMES), "get either U or kinematics, but it got neither"),
        (lambda: one(kinematics=not_affine_kinematics), "it got both"),
        (lambda: one(U=lambda t, q: q), r"callable as \(t, q, v, params\)"),
        (lambda: one(names="abc"), "sequence of names, but it was 'abc'"),
        (lambda: one(names=()), "name at least one"),
        (lambda: one(names=("a", "a", "b")), "distinct, but 'a' occurs 2 times"),
        (lambda: one(names=("a", "", "b")), "non-empty strings"),
        (lambda: one(constrained=("d",)), r"among the names \['a', 'b', 'c'\], but one was 'd'"),
        (lambda: one(constrained=NAMES), "leave out at least one name"),
        (lambda: system_of(one(("a", "b"))), "as many as there are coordinates, 3.*there were 2"),
        (lambda: system_of(one(("a", "b", "c", "d"))), "as there are coordinates, 3.*were 4"),
        (lambda: system_of(one(("x", "b", "c"))), "'x' is also a coordinate"),
        (
            lambda: system_of(one(constrained=("b",)), constraints=(jl.Pfaffian(sideways, "b"),)),
            "'b' is also a constraint",
        ),
        (
            lambda: system_of(one(), forces=(jl.GeneralizedForce(push, "a"),)),
            "'a' is also a force",
        ),
        (lambda: jl.System(in_v, ("x", "y", "z"), written_in="u"), "be used with quasi-velocities"),
        (lambda: system_of(one(), written_in="w"), "`written_in` must be 'v' or 'u'"),
        (lambda: run(one(U=not_affine)), "'a': `U` must be affine in v"),
        (lambda: run(one(U=lambda t, q, v, p: v[:2])), r"`U` must return 3 numbers.*shape \(2,\)"),
        (
            lambda: run(one(U=lambda t, q, v, p: v.at[1].set(q[1]))),
            "'b': `U` must contain a velocity",
        ),
        (
            lambda: run(jl.QuasiVelocities(kinematics=sleigh_rates, names=("a", "b"))),
            "leave at least 3 that are not constrained.*there were 2",
        ),
        (
            lambda: run(jl.QuasiVelocities(kinematics=not_affine_kinematics, names=NAMES)),
            r"`kinematics` must be affine in u, but the derivative of v\[1\]",
        ),
        (
            lambda: run(one(), u0=[0.0, 1.0]),
            r"`u0` must have shape \(3,\), but its shape was \(2,\)",
        ),
        (lambda: run(one(), u0={"a": 0.0}), r"`u0` must name \['a', 'b', 'c'\].*named \['a'\]"),
        (lambda: run(one(), u0=[0.0, np.nan, 1.0]), r"u0\[1\] \('b'\) was nan"),
        (lambda: run(one(), v0=np.zeros(3)), "^exactly one of `v0` and `u0` must be given"),
        (
            lambda: run(one(), formulation="quasi", constraints=(BLADE,)),
            r"`formulation` must be among .*do not satisfy the rows \['v_n'\]",
        ),
        (
            lambda: run(
                one(constrained=("b",)), formulation="quasi", stabilization=jl.Baumgarte(1.0, 1.0)
            ),
            "Baumgarte's terms need",
        ),
        (
            lambda: jl.simulate(PLAIN, [0.0] * 3, None, u0=[0.0] * 3, ts=[0.0, 1.0], params=PARAMS),
            "`u0` must be given for a system with quasi-velocities",
        ),
        (
            lambda: jl.simulate(PLAIN, [0.0] * 3, [0.0] * 3, [0.0, 1.0], PARAMS, save=("u",)),
            "`save` must name quantities of the system, but one was 'u'",
        ),
        (
            lambda: PLAIN.quasi_velocities([0.0] * 3, [0.0] * 3, PARAMS),
            r"^`System\.quasi_velocities` without quasi-velocities is not supported",
        ),
    ],
)
def test_invalid_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


PLAIN = jl.System(in_v, ("x", "y", "z"))


def test_other_types_are_refused(unchecked):  # noqa: F811
    with pytest.raises(ValueError, match=r"be a jl.QuasiVelocities, but it was 'u'"):
        system_of("u")


@pytest.mark.full
def test_additional_rows_are_solved_with_multipliers():
    """If quasi-velocities do not satisfy a row, "auto" means multipliers."""
    motion = run(one(), constraints=(BLADE,), u0=np.zeros(3))
    assert motion.formulation == "multipliers"
    np.testing.assert_allclose(motion.u[0], 0.0, atol=8 * EPS)


def braked(t, q, v, params, lam):
    return -0.2 * lam["b"] * v


@pytest.mark.full
def test_forces_may_read_multipliers_of_quasi_velocities():
    """Such systems are solved with multipliers; the quasi-velocity formulation has none."""
    force = jl.GeneralizedForce(braked, "brake", reaction=True)
    quasi = one(constrained=("b",))
    system = system_of(quasi, forces=(force,))
    start = {"v0": None, "u0": {"a": 0.4, "c": -0.3}, "ts": [0.0, 0.2], "params": PARAMS, "dt": 0.1}
    motion = jl.simulate(system, np.zeros(3), method="tsit5", **start)
    assert motion.formulation == "multipliers"
    np.testing.assert_allclose(motion["b"], 0.0, atol=64 * EPS)
    a, force = motion.a[-1], system.constraint_force(motion.q[-1], motion.v[-1], PARAMS, t=0.2)
    brake = braked(0.2, motion.q[-1], motion.v[-1], PARAMS, {"b": motion.lam["b"][-1]})
    M, h = (f(motion.q[-1], motion.v[-1], PARAMS, t=0.2) for f in (system.mass_matrix, system.bias))
    np.testing.assert_allclose(M @ a + h, brake + force, atol=1e-13)
    with pytest.raises(ValueError, match=r"need formulation='multipliers'"):
        jl.simulate(system, np.zeros(3), formulation="quasi", **start)


@pytest.mark.full
def test_kinematics_that_do_not_satisfy_a_row_use_multipliers():
    """Three speeds for three coordinates; the blade's row excludes one of them."""

    def rates(t, q, u, params):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        return jnp.stack([c * u[0] - s * u[2], s * u[0] + c * u[2], u[1]])

    body = jl.QuasiVelocities(kinematics=rates, names=("ahead", "turn", "aside"))
    start = {"ts": [0.0, 1.0], "dt": 0.1, "method": "tsit5"}
    q = [0.0, 0.0, 0.3]
    system = jl.System(sleigh, ("x", "y", "theta"), quasi=body, constraints=(BLADE,))
    motion = jl.simulate(system, q, None, u0=[1.0, 0.4, 0.0], **start)
    assert motion.formulation == "multipliers"
    tall, _ = sleighs()
    other = jl.simulate(tall, q, None, u0=[1.0, 0.4], formulation="multipliers", **start)
    np.testing.assert_allclose(motion.q, other.q, atol=1e-14)


def test_explain_states_the_reduced_state():
    system = declared(of_u, "u", ("b",))
    text = system.explain(PARAMS)
    assert "a, c and q form the state, b being 0" in text
    assert "v and u'" in text or "array program" in text
