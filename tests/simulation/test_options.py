"""Invalid options of `simulate`: refused by name, with the condition and the value."""

import re
import warnings
from decimal import Decimal
from fractions import Fraction

import diffrax
import jax.numpy as jnp
import pytest
from _refused import SYSTEM, WHOLE, kinetic, refused, run
from _user import unchecked  # noqa: F401

import jaxlag as jl

# ---- Options -------------------------------------------------------------------------------------

STEPS = diffrax.PIDController(rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": kinetic}, "`system` must be a jl.System, but it was <function kinetic"),
        ({"formulation": "quasi"}, "`formulation` must be 'auto', but it was 'quasi'."),
        (
            {"gradient": "adjoint"},
            "`gradient` must be one of 'auto', 'forward', 'recorded', 'checkpoints', but it was "
            "'adjoint'.",
        ),
        (
            {"stabilization": 1},
            "`stabilization` must be 'projection', None or a jl.Baumgarte(alpha, beta), but it was "
            "1.",
        ),
        ({"assemble": None}, "`assemble` must be True or False, but it was None."),
        (
            {"save": ("a", "force")},
            "`save` must name quantities among ['a', 'u', 'p', 'energy', 'kinetic', 'potential', "
            "'power', 'multipliers', 'constraint_force', 'Q', 'input_values', 'state_rates', "
            "'work'], but one was 'force'.",
        ),
        (
            {"save": "energy"},
            "`save` must be a sequence of names, but it was 'energy'. Write save=",
        ),
        ({"save": None}, "`save` must be a sequence of names, but it was None."),
        (
            {"save": ("kinetic",), "system": WHOLE},
            "`save` must name energies that the system declares, but one was 'kinetic'. Declare",
        ),
        ({"max_steps": 0}, "`max_steps` must be a positive integer, but it was 0."),
        ({"max_steps": 10.0}, "`max_steps` must be a positive integer, but it was 10.0."),
        ({"max_steps": True}, "`max_steps` must be a positive integer, but it was True."),
        (
            {"method": "rk4"},
            "`method` must be 'auto', one of ['bosh3', 'dopri5', 'dopri8', 'euler', ",
        ),
        (
            {"method": diffrax.Tsit5},
            "`method` must be a name or a diffrax solver instance, but",
        ),
        ({"method": 5}, "`method` must be a name or a diffrax solver instance, but it was 5."),
        (
            {"method": diffrax.ItoMilstein()},
            "`method` must integrate an ordinary differential equation y' = f(t, y), but ItoMilst",
        ),
        (
            {"method": "euler"},
            "`method` must estimate its error when dt is left out, but Euler has no error estimate."
            " "
            "Give dt= for fixed steps",
        ),
        (
            {"method": (diffrax.Tsit5(), "pid")},
            "`method[1]` must be a diffrax step-size controller",
        ),
        (
            {"method": (diffrax.Tsit5(), diffrax.ConstantStepSize())},
            "`method[1]` must adapt the step, but it was ConstantStepSize. Give dt= for fixed",
        ),
        (
            {"method": (diffrax.Tsit5(), STEPS), "dt": 0.1},
            "`dt` must be left out when method has a controller, but both were given.",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_option_is_refused(changes, message):
    refused(message, **changes)


def test_unknown_method_gets_a_list_of_known_ones():
    with pytest.raises(ValueError, match=r"^`method` .* but it was 'rk4'\.") as caught:
        run(method="rk4")
    for name in ("dopri8", "tsit5", "kvaerno5", "a diffrax solver or (solver, controller)"):
        assert name in str(caught.value)


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("rk4", "'dopri5' with dt="),
        ("RK45", "'tsit5' or 'dopri5'"),
        ("symplectic", "'splitting4' where L = T(v) - V(q)"),
        ("leapfrog", "'splitting2' with dt="),
        ("BDF", "'kvaerno5'"),
        ("dopri_8", "'dopri8'"),
    ],
)
def test_unknown_method_gets_the_nearest_known_one(name, nearest):
    message = f"but it was {name!r}. The nearest is {nearest}"
    with pytest.raises(ValueError, match=re.escape(message)):
        run(method=name)


def test_arguments_in_another_order_are_refused():
    """If the names show it: q, v, t, p."""
    message = (
        r"^`lagrangian` must take \(t, q, v, params\) in this order.* 'q' is in the place of 't'"
    )
    with pytest.raises(ValueError, match=message):
        jl.System(lambda q, v, t, p: 0.5 * v @ v, ("x",))
    with pytest.raises(ValueError, match=r"`phi` must take \(t, q, params\) in this order"):
        jl.Holonomic(lambda q, t, params: q[0], "row")
    jl.System(lambda time, x, v, p: 0.5 * v @ v, ("x",))


def test_parameter_of_shape_1_is_named():
    params = {"k": 1.0, "m": jnp.ones(1)}
    with pytest.raises(ValueError, match=r"of shape \(1,\)\. params\['m'\] has shape \(1,\)"):
        run(jl.System(lambda t, q, v, params: params["m"] * (v @ v), ("x", "y")), params=params)


@pytest.mark.parametrize("parts", ["forces", "constraints"])
def test_none_instead_of_a_sequence_is_refused(parts, unchecked):  # noqa: F811
    with pytest.raises(ValueError, match=rf"^`{parts}` must be a sequence .*Leave it out"):
        jl.System(SYSTEM.lagrangian, ("x", "y"), **{parts: None})


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (
            {"k": Decimal("1.5")},
            r"`params\['k'\]` must be a float, .* Write 1.5\.",
        ),
        ({"k": [1.0, Fraction(1, 2)]}, r"`params\['k'\]\[1\]` must be a float, .* Write 0.5\."),
        ({"k": 1.0, 3: 2.0}, r"`params` must have keys of one type in each dict, .* Use strings\."),
    ],
)
def test_params_of_other_kinds_are_refused(params, message):
    spring = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2, ("x",))
    with pytest.raises(ValueError, match=message):
        jl.simulate(spring, [1.0], [0.0], [0.0, 1.0], params)


def test_a_step_longer_than_the_motion_gets_a_warning():
    free = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",))
    with pytest.warns(UserWarning, match="`dt` = 100 s is longer than ts, 2 s"):
        jl.simulate(free, [0.0], [1.0], [0.0, 2.0], dt=100.0, method="euler")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jl.simulate(free, [0.0], [1.0], [0.0, 2.0], dt=2.0, method="euler")


@pytest.mark.parametrize("ask", ["acceleration", "energy", "momentum", "mass_matrix", "power"])
def test_the_time_of_a_state_is_a_number(ask):
    free = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",))
    method = getattr(free, ask)
    with pytest.raises(ValueError, match=r"`t` must be a number, but its shape was \(1,\)"):
        method([0.0], [1.0], t=jnp.zeros(1))
    with pytest.raises(ValueError, match=r"`t` must be a number, but it was \{'m': 1.0\}\."):
        method([0.0], [1.0], t={"m": 1.0})
