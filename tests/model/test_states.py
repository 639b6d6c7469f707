"""The declaration of states beside the coordinates."""

import jax
import jax.numpy as jnp
import pytest
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag._model._states import OUTPUTS
from jaxlag._simulation._quantities import QUANTITIES


def lagrangian(t, q, v, params):
    return 0.5 * v[0] ** 2


def rate(t, q, v, x, params):
    return -x


def with_rate(function, names=("current",)):
    return jl.System(lagrangian, ("angle",), states=jl.States(function, names))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jl.States(rate, ()), "States: `names` must have at least one name"),
        (lambda: jl.States(rate, ("x", "x")), "States: `names` must be distinct, but 'x' occ"),
        (lambda: jl.States(1.0, ("x",)), "States: `rate` must be a function of"),
        (lambda: jl.States(lambda t, q: q, ("x",)), "States: `rate` must be callable as"),
        (
            lambda: jl.States(lambda t, x, v, q, params: x, ("x",)),
            "States: `rate` must take .* in this order.*'x' is in the place of 'q'",
        ),
        (
            lambda: jl.System(lagrangian, ("angle",), states=rate),
            r"`states` must be a jl.States or None.*Write states=jl.States\(rate, names\)",
        ),
        (
            lambda: with_rate(rate, ("angle",)),
            "States: `names` must differ from other names, but 'angle' is a coordinate",
        ),
        (lambda: with_rate(rate, ("angle'",)), "must differ from other names.*is a velocity"),
        (lambda: with_rate(rate, ("energy",)), "must differ .* 'energy' is an output of a motion"),
        (
            lambda: jl.States(lambda t, q, v, x, inputs: x, ("x",)),
            r"States: `rate` must be callable as \(t, q, v, x, params, inputs\)",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_wrong_declaration_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda t, q, v, x, p: jnp.zeros(2), r"return an array of shape \(1,\).*was \(2,\)"),
        (lambda t, q, v, x, p: "x", "return an array, but it returned 'x'"),
        (
            lambda t, q, v, x, p: jax.lax.complex(x, x),
            "return real numbers, but it returned complex",
        ),
    ],
)
def test_a_rate_of_wrong_form_is_refused_by_check(function, message):
    with pytest.raises(ValueError, match=f"States: `rate` must {message}"):
        with_rate(function).check([0.0], [0.0], inputs={"current": 1.0})


def test_check_names_a_rate_that_is_not_finite():
    broken = with_rate(lambda t, q, v, x, p: jnp.sqrt(x))
    with pytest.raises(ValueError, match=r"states: `rate` must be finite.*test_states.py"):
        broken.check([0.0], [0.0], inputs={"current": -1.0})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"`x0` must be given for a system with states.*Give \['current'\]"),
        ({"x0": [1.0, 2.0]}, r"`x0` must have shape \(1,\).*\['current'\]"),
        ({"x0": {"voltage": 1.0}}, r"`x0` must name exactly \['current'\]"),
        ({"x0": [jnp.nan]}, r"`x0` must be finite, but x0\[0\] \('current'\) was nan"),
        (
            {"x0": [1.0], "inputs": {"current": 1.0}},
            "`inputs` must name no states, but there was 'current'",
        ),
        ({"x0": [1.0], "atol": [1e-9] * 3}, "one for each of 1 coordinates and 1 states"),
        (
            {"x0": [1.0], "atol": {"angle": 1e-6}},
            r"`atol` must name exactly \['angle', 'current'\], but it named \['angle'\]",
        ),
        (
            {"x0": [1.0], "method": "gauss4", "dt": 0.1},
            r"method GaussLegendre must be used without states=.*\['current'\]",
        ),
        (
            {"x0": [1.0], "method": "splitting4", "dt": 0.1},
            "method Splitting must be used without states=",
        ),
        (
            {"x0": [1.0], "method": "variational4", "dt": 0.1},
            "method LobattoIIIAB must be used without states=",
        ),
    ],
)
def test_simulate_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        jl.simulate(with_rate(rate), [0.0], [0.0], [0.0, 1.0], **options)


def test_what_a_system_without_states_refuses():
    plain = jl.System(lagrangian, ("angle",))
    with pytest.raises(ValueError, match="`x0` must be left out for a system without states"):
        jl.simulate(plain, [0.0], [0.0], [0.0, 1.0], x0=[1.0])
    with pytest.raises(ValueError, match=r"`save` must name quantities of the system.*states="):
        jl.simulate(plain, [0.0], [0.0], [0.0, 1.0], save=("state_rates",))
    with pytest.raises(ValueError, match="declared without states="):
        plain.state_rates([0.0], [0.0])


def test_all_outputs_of_motions_are_taken():
    assert {*QUANTITIES, "work"} <= set(OUTPUTS)


def test_fit_refuses_states():
    data = jl.Experiment([0.0, 1.0, 2.0], {"angle": [0.0, 1.0, 2.0]})
    with pytest.raises(ValueError, match="fit: `system` must be without states="):
        jl.fit(with_rate(rate), data, params0={"k": 1.0}, free=("k",))


def test_a_state_that_no_force_reads_is_allowed_and_shown():
    assert "states        current, integrated with (q, v)" in with_rate(rate).explain(None)


def reads(entry):
    return (jl.GeneralizedForce(lambda t, q, v, p, inputs: entry(inputs)[None], "force"),)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (
            with_rate(lambda t, q, v, x, p: jnp.stack([x[0], x[2]]), ("i", "j")),
            r"States: `rate` must take indices from -2 to 1 of x, .* but x\[2\] was taken",
        ),
        (
            with_rate(lambda t, q, v, x, p: jnp.stack([q[3], x[1]]), ("i", "j")),
            r"States: `rate` must take indices from -1 to 0 of q, .* but q\[3\] was taken",
        ),
        (
            jl.System(
                lagrangian,
                ("angle",),
                forces=reads(lambda inputs: inputs["T"][5]),
                states=jl.States(rate, {"T": 3}),
            ),
            r"indices from -3 to 2 of inputs\['T'\], .* but inputs\['T'\]\[5\] was taken",
        ),
    ],
)
def test_indices_beyond_the_states_are_refused(system, message):
    with pytest.raises(ValueError, match=message):
        jl.simulate(system, [0.0], [0.0], [0.0, 1.0], x0=jnp.ones(system.states.size))


def test_derivatives_by_states_are_checked():
    """The square root of a state that may be 0."""
    system = jl.System(
        lagrangian,
        ("angle",),
        forces=reads(lambda inputs: jnp.sqrt(jnp.abs(inputs["level"]))),
        states=jl.States(rate, ("level",)),
    )
    report = jl.testing.check_derivatives(system, [0.3], [0.2], inputs={"level": 0.5})
    assert {finding.function for finding in report.findings} == {"force 'force': Q"}
    assert {finding.state for finding in report.findings} == {"rest", "zero"}
