"""Systems and options that structure-preserving methods refuse, with the reason."""

import diffrax
import jax.numpy as jnp
import pytest

import jaxlag as jl
from systems import double_pendulum, double_pendulum_cartesian, rolling_disk


def example(module):
    return module.system, *module.entry.start(), module.entry.example.params


def spring(t, q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2


def solve(system, method, q0=(0.3,), v0=(0.0,), params=None, **options):
    options = {"dt": 0.1} | options
    return jl.simulate(system, q0, v0, [0.0, 1.0], params, method=method, **options)


def drag(t, q, v, params):
    return -0.1 * v


DRAG = jl.GeneralizedForce(drag, "drag")
particle = jl.System(spring, ("x",))
moving = jl.System(lambda t, q, v, p: 0.5 * (1 + t) * v[0] ** 2, ("x",))
turning = jl.System(lambda t, q, v, p: 0.5 * (v @ v) + q[0] * v[1], ("x", "y"))
held = jl.System(spring, ("x",), constraints=(jl.Holonomic(lambda t, q, p: q[0] - 0.3, "stop"),))


@pytest.mark.parametrize("method", ["splitting4", "gauss4", "variational2"])
def test_structure_preserving_methods_need_fixed_steps(method):
    with pytest.raises(
        ValueError, match=r"`dt` must be given for \w+, but it was left out.*dt=0.01"
    ):
        solve(particle, method, dt=None)
    pair = (jl.solvers.Splitting(2), diffrax.PIDController(rtol=1e-6, atol=1e-6))
    with pytest.raises(
        ValueError, match=r"`dt` must be given for Splitting, but a step-size contr"
    ):
        solve(particle, pair, dt=None)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (moving, r"T\(v\) - V\(t, q\) with constant mass matrix, but its mass matrix contains t"),
        (turning, r"constant mass matrix, but its bias contains v.*gauss4"),
        (jl.System(spring, ("x",), forces=(DRAG,)), r"the force 'drag' depends on v"),
        (held, r"without constraints, but it has constraints \('stop'\)"),
    ],
)
def test_systems_that_do_not_split_are_refused(system, message):
    rest = [0.3] * system.size
    with pytest.raises(ValueError, match=r"method Splitting must split.*" + message):
        solve(system, "splitting2", rest, [0.0] * system.size)


def test_a_mass_matrix_of_q_does_not_split():
    system, *start = example(double_pendulum)
    with pytest.raises(ValueError, match=r"its mass matrix contains q"):
        solve(system, "splitting2", *start)


def test_unsupported_constraints_of_partitioned_methods_are_refused():
    system, *start = example(double_pendulum_cartesian)
    with pytest.raises(ValueError, match=r"GaussLegendre must be used without constraints.*'varia"):
        solve(system, "gauss4", *start)
    with pytest.raises(ValueError, match=r"formulation was 'null_space'"):
        solve(system, "variational2", *start, formulation="null_space")


def test_baumgarte_with_variational_methods_is_refused():
    system, *start = example(double_pendulum_cartesian)
    with pytest.raises(
        ValueError, match=r"`stabilization` must be left out for LobattoIIIAB, whose steps"
    ):
        solve(system, "variational2", *start, stabilization=jl.Baumgarte(1.0, 1.0))


def test_rolling_with_variational_methods_is_refused():
    system, *start = example(rolling_disk)
    with pytest.raises(ValueError, match=r"LobattoIIIAB must be used with holonomic constraints"):
        solve(system, "variational2", *start, formulation="multipliers")
    with pytest.raises(ValueError, match=r"have a state \(q, v\).*formulation was 'quasi'"):
        solve(system, "variational2", *start)


def test_variational_methods_refuse_friction_by_multipliers():
    def slide(t, q, v, params, inputs, lam):
        return jnp.stack([-0.2 * jnp.abs(lam["floor"]), jnp.zeros_like(t)])

    block = jl.System(
        lambda t, q, v, p: 0.5 * (v @ v) - 9.81 * q[1],
        ("x", "y"),
        forces=(jl.GeneralizedForce(slide, "friction", reaction=True),),
        constraints=(jl.Holonomic(lambda t, q, p: q[1], "floor"),),
    )
    with pytest.raises(ValueError, match=r"forces that depend on multipliers, but 'friction' does"):
        solve(block, "variational4", [0.0, 0.0], [1.0, 0.0])
