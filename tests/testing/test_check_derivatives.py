"""The check of derivatives: states and functions, the report, invalid arguments."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _checked import (
    PARAMS,
    Q,
    V,
    check,
    checked,
    file_of,
    here,
    length,
    line_of,
    places,
    right,
    rule_of,
    scan_body,
    scanned,
    system_of,
)
from _families import mostly_full

import jaxlag as jl
from jaxlag import testing
from jaxlag._model._forces import AbstractForce
from systems.catalogue import ENTRIES
from tests._user import unchecked  # noqa: F401

# ---- States and functions ---------------------------------------------------------------------


def test_default_states_are_special_and_random():
    report = check(lambda q, params: q[0], q=[0.5, -2.0], v=[0.0, 0.0])
    states = report.states
    assert list(states) == ["given", "zero", "equal", "one", "random 1", "random 2", "random 3"]
    assert states["given"] == ((0.5, -2.0), (0.0, 0.0))  # at rest already
    assert states["equal"] == ((-2.0, -2.0), (1.0, 1.0))
    assert states["one"] == ((-2.0, 0.0), (1.0, 0.0))
    for k in (1, 2, 3):
        q, v = states[f"random {k}"]
        assert 0.25 <= q[0] <= 0.75
        assert -3.0 <= q[1] <= -1.0
        assert all(0 < abs(x) <= 0.5 for x in v)
    assert states == check(lambda q, params: q[0], q=[0.5, -2.0], v=[0.0, 0.0]).states


def test_states_may_be_chosen():
    system = system_of(length)
    report = testing.check_derivatives(system, Q, V, PARAMS, states=("given", "rest", "random"))
    assert list(report.states) == ["given", "rest", "random 1", "random 2", "random 3"]
    assert report.ok
    assert not testing.check_derivatives(system, Q, V, PARAMS, states=["zero"]).ok


def bad_arm(t, q, params):
    return jnp.stack([jnp.sqrt(q @ q), q[0]])  # wrong


def bad_push(t, q, v, params, inputs):
    return jnp.stack([inputs["u"] / jnp.sqrt(v @ v), v[0]])  # wrong


def bad_rate(t, q, v, params):
    return v[0] + jnp.abs(q[0]) ** 1.5  # wrong


def bad_torque(t, q, v, params):
    return jnp.arctan2(v[1], v[0])  # wrong


def bad_loss(t, q, v, params):
    return jnp.linalg.norm(v)  # wrong


def bad_row(t, q, params):
    return q[0] + q[1] ** 2.5  # wrong


def bad_speeds(t, q, v, params):
    return jnp.stack([v[0], v[1] * (1.0 + jnp.sqrt(q[1]))])  # wrong


def bad_friction(t, q, v, params, inputs, lam):
    normal = inputs["mu"] * lam["rod"]
    return jnp.stack([-normal * jnp.sqrt(v[0]), 0.0 * v[0]])  # wrong


def bad_signal(t, q, v, params):
    return jnp.sqrt(v[0] ** 2)  # wrong


FORCES = {
    bad_arm: ("force 'f': position", "sqrt", 1, jl.PointForce(bad_arm, lambda *x: x[2], "f")),
    bad_push: ("force 'f': force", "div", 0, jl.PointForce(lambda t, q, p: q, bad_push, "f")),
    bad_rate: ("force 'f': angular_velocity", "pow", 2, jl.Torque(bad_rate, bad_loss, "f")),
    bad_torque: ("force 'f': torque", "atan2", 1, jl.Torque(lambda *x: x[2][0], bad_torque, "f")),
    bad_loss: ("force 'f': R", "sqrt", 1, jl.Rayleigh(bad_loss, "f")),
}


@pytest.mark.parametrize("function", FORCES, ids=lambda f: f.__name__)
def test_functions_of_forces_are_checked(function):
    name, primitive, order, force = FORCES[function]
    system = jl.System(lambda t, q, v, params: v @ v, ("x", "y"), forces=(force,))
    report = testing.check_derivatives(system, Q, V, {}, inputs={"u": 2.0})
    found = [f for f in report.findings if f.function == name]
    assert {(Path(f.file).name, f.line) for f in found} == {
        (file_of(function), line_of(function, "# wrong"))
    }
    assert {(f.primitive, f.order) for f in found} == {(primitive, order)}
    assert "zero" in {f.state for f in found}


def test_inputs_that_depend_on_the_state_are_checked():
    def push(t, q, v, params, inputs):
        return jnp.stack([inputs["u"], v[0]])

    force = jl.GeneralizedForce(push, "push")
    system = jl.System(lambda t, q, v, params: v @ v, ("x", "y"), forces=(force,))
    inputs = {"u": jl.Feedback(bad_signal)}
    report = testing.check_derivatives(system, Q, V, {}, inputs=inputs)
    assert places(report) == here("sqrt", bad_signal, "# wrong")
    assert {f.state for f in report.findings} == {"rest", "zero"}
    with pytest.raises(ValueError, match="`inputs` must have an entry 'u'"):
        testing.check_derivatives(system, Q, V, {})


class Springs(AbstractForce):
    """A force of a user class whose derivative is not finite at q = 0."""

    name: str = eqx.field(static=True, default="springs")

    def __call__(self, t, q, v, params, inputs):
        return -jnp.sqrt(q * q)  # wrong


def test_force_of_a_user_class_is_checked_as_a_whole():
    system = jl.System(lambda t, q, v, params: v @ v, ("x", "y"), forces=(Springs(),))
    report = testing.check_derivatives(system, Q, V, {}, states=("given", "zero"))
    assert dict(report.functions) == {"lagrangian": 3, "force 'springs'": 1}
    assert places(report) == here("sqrt", Springs, "# wrong")


def test_constraints_reactions_and_quasi_velocities_are_checked():
    friction = jl.GeneralizedForce(bad_friction, "friction", reaction=True)
    system = jl.System(
        lambda t, q, u, params: 0.5 * params["m"] * u @ u,
        ("x", "y"),
        forces=(friction,),
        constraints=(
            jl.Holonomic(bad_row, "rod"),
            jl.Pfaffian(lambda t, q, v, params: v[0] - q[1] * v[1], "edge"),
        ),
        quasi=jl.QuasiVelocities(bad_speeds, ("along", "across")),
        written_in="u",
    )
    inputs = {"mu": 0.3}
    report = testing.check_derivatives(system, Q, [0.3, 0.4], {"m": 2.0}, inputs=inputs)
    assert dict(report.functions) == {
        "lagrangian": 3,
        "force 'friction': Q": 1,
        "constraint 'rod': phi": 3,
        "constraint 'edge': residual": 2,
        "quasi-velocities: U": 3,
    }
    found = {(f.function, f.primitive, f.line, f.order) for f in report.findings}
    assert found == {
        ("force 'friction': Q", "sqrt", line_of(bad_friction, "# wrong"), 1),
        ("constraint 'rod': phi", "pow", line_of(bad_row, "# wrong"), 3),
        ("quasi-velocities: U", "sqrt", line_of(bad_speeds, "# wrong"), 1),
    }


def test_kinetic_and_potential_energy_are_checked_separately():
    def kinetic(t, q, v, params):
        return v @ v

    def potential(t, q, params):
        return jnp.sqrt(q @ q)  # wrong

    system = jl.System(coordinates=("x", "y"), kinetic=kinetic, potential=potential)
    report = testing.check_derivatives(system, Q, V, {})
    assert [name for name, _ in report.functions] == ["kinetic", "potential"]
    assert {f.function for f in report.findings} == {"potential"}
    assert places(report) == here("sqrt", potential, "# wrong")


@pytest.mark.parametrize("factor", [1.0, 1.01])
def test_float32_functions_are_checked(factor):
    function = rule_of(lambda x: factor * right(x))

    def potential(q, params):
        return function(q[0]) + q[1] ** 3

    single = np.float32
    report = check(potential, {"k": single(1.5)}, np.array(Q, single), np.array(V, single))
    assert report.ok == (factor == 1.0)


CLEAN = (
    "cart_pendulum",
    "double_pendulum",
    "falling_stick_friction",
    "spherical_pendulum_elastic",
    "vertical_rolling_disk",
)


@pytest.mark.parametrize("name", mostly_full(CLEAN, *CLEAN[:2]))
def test_systems_of_the_book_pass(name):
    """Among them a dissipative one, one with friction by reactions, one in quasi-velocities."""
    entry = ENTRIES[name]
    report = testing.check_derivatives(entry.system, *entry.start(), entry.example.params)
    assert report.ok, report
    assert "all are finite and agree" in str(report)


def test_singular_potential_is_reported():
    entry = ENTRIES["central_motion"]
    report = testing.check_derivatives(entry.system, *entry.start(), entry.example.params)
    (finding,) = report.findings
    place = (finding.function, finding.state, finding.order, finding.primitive)
    assert place == ("potential", "zero", 0, "div")
    assert Path(finding.file).name == "central_motion.py"


# ---- The report -------------------------------------------------------------------------------


def test_the_report_is_a_table():
    """One line for equal findings at several states."""
    report = checked(scanned)
    text = str(report).splitlines()
    assert text[0] == "derivatives of lagrangian (order 3)"
    assert text[1].startswith("at given, rest, zero, equal, one, random 1")
    assert text[2].split() == ["function", "order", "in", "what", "where", "states"]
    line = line_of(scan_body, "# wrong")
    cells = ["lagrangian", "1", "q", "not", "finite", "sqrt", "at", f"{file_of(scan_body)}:{line}"]
    assert text[3].split() == [*cells, "zero,", "one"]
    assert len(text) == 5
    assert "jaxlag.math.norm" in text[4]


def test_reports_are_not_changed():
    report = checked(length)
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.findings = ()


# ---- Invalid arguments ------------------------------------------------------------------------


def test_invalid_arguments_are_refused():
    system = system_of(length)
    fine = {"params": PARAMS, "q": Q, "v": V}
    for change, message in (
        ({"q": [1.0]}, r"`q` must have shape \(2,\), but its shape was \(1,\)"),
        ({"v": [1.0, 2.0, 3.0]}, r"`v` must have shape \(2,\)"),
        ({"q": [1.0, np.nan]}, "check_derivatives: `q` must be finite"),
        ({"v": [np.inf, 1.0]}, "check_derivatives: `v` must be finite"),
        ({"params": {"k": np.inf}}, "check_derivatives: `params` must be finite"),
        ({"t": np.nan}, "`t` must be finite"),
        ({"t": "now"}, "`t` must be a number"),
        ({"states": ("given", "moving")}, r"`states` must be names among \['given', 'rest'"),
        ({"states": "given"}, r"Write states=\(\"given\", \"rest\"\)"),
        ({"states": ()}, "`states` must be names"),
    ):
        with pytest.raises(ValueError, match=message):
            testing.check_derivatives(system, **{**fine, **change})
    with pytest.raises(
        ValueError, match=r"`q` must have concrete values.*Call check_derivatives outside jit"
    ):
        jax.jit(lambda q: testing.check_derivatives(system, q, V, PARAMS))(jnp.array(Q))


@pytest.mark.usefixtures("unchecked")
def test_other_types_than_systems_are_refused():
    with pytest.raises(ValueError, match=r"`system` must be a jl.System, but it was 3"):
        testing.check_derivatives(3, Q, V, PARAMS)
    with pytest.raises(ValueError, match="`inputs` must be a dict"):
        testing.check_derivatives(system_of(length), Q, V, PARAMS, inputs=[1.0])


def test_functions_of_wrong_shapes_are_refused():
    system = jl.System(lambda t, q, v, params: v, ("x", "y"))
    with pytest.raises(ValueError, match="`lagrangian` must return a real scalar"):
        testing.check_derivatives(system, Q, V, {})


def test_kink_in_one_argument_does_not_excuse_others():
    """1/2 (|q| - l)^2 at q = 0 and l = 0: its Hessian is 1, but it is computed as 0."""

    def spring(q, params):
        return 0.5 * (jl.math.norm(q) - params["c"]) ** 2

    report = check(spring, q=[0.0, 0.0])
    (finding,) = (f for f in report.findings if f.state == "given")
    assert (finding.kind, finding.order) == ("wrong", 2)
    assert "of q alone" in finding.hint
