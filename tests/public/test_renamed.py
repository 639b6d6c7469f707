"""Former names, keywords and orders of arguments are refused with the present ones."""

import jax.numpy as jnp
import numpy as np
import pytest
from _user import unchecked  # noqa: F401

import jaxlag as jl


def lagrangian(t, q, v, params):
    return 0.5 * params["m"] * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2


SYSTEM, PARAMS = jl.System(lagrangian, ("x",)), {"m": 1.0, "k": 2.0}
Q, V, TS = [0.3], [0.1], [0.0, 1.0]
DATA = jl.Experiment(np.linspace(0.0, 1.0, 5), {"x": np.linspace(0.0, 1.0, 5)})


@pytest.mark.parametrize(("former", "present"), jl._RENAMED.items())
def test_former_names_give_the_present_ones(former, present):
    with pytest.raises(AttributeError, match=rf"^jaxlag\.{former} is jaxlag\.{present} now$"):
        getattr(jl, former)
    found = jl
    for part in present.split("."):
        found = getattr(found, part)
    assert found.__name__ == present.rpartition(".")[2]


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match=r"^module 'jaxlag' has no attribute 'Springs'$"):
        jl.Springs  # noqa: B018


def check_derivatives(*arguments):
    return jl.testing.check_derivatives(SYSTEM, *arguments)


@pytest.mark.parametrize(
    "method",
    [SYSTEM.energy, SYSTEM.acceleration, SYSTEM.mass_matrix, SYSTEM.check, check_derivatives],
)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((PARAMS, Q, V), r"^`q` must name exactly \['x'\], but it named \['m', 'k'\]\. The order"),
        ((Q, PARAMS, V), r"^`v` must name exactly \['x'\], but it named \['m', 'k'\]\. The order"),
        ((None, Q, V), r"^`q` must be 1 numbers, but it was None\. The order"),
        (
            (Q, V, jnp.array([1.0])),
            r"^`params` must have the entries .* array of shape \(1,\).* order",
        ),
        ((Q, V, [1.0]), r"^`params` must have the entries .* but they were a list.* The order"),
        ((PARAMS, Q, V, 0.2), r"^`\w+` must get .* by name, but it got [45] arguments by position"),
    ],
)
def test_former_order_of_arguments_is_refused(method, arguments, message):
    with pytest.raises(ValueError, match=message):
        method(*arguments)


def fit(**options):
    return jl.fit(SYSTEM, DATA, PARAMS, free=("k",), **options)


def select_model(**options):
    return jl.select_model(SYSTEM, DATA, PARAMS, {}, held_out=DATA, free=("k",), **options)


@pytest.mark.parametrize(
    ("call", "former", "present"),
    [
        (lambda **x: jl.simulate(SYSTEM, Q, V, TS, PARAMS, **x), "project", "stabilization="),
        (lambda **x: jl.equilibrium(SYSTEM, Q, PARAMS, **x), "tol", "rtol="),
        (lambda **x: jl.lyapunov(None, **x), "tol", "step_rtol= and step_atol="),
        (lambda **x: jl.energy.RigidBody(1.0, [1.0] * 3, **x), "centre", "center="),
        (fit, "tolerance", "rtol= and atol="),
        (fit, "max_iterations", "max_steps="),
        (fit, "optimiser", "optimizer="),
        (fit, "method", "simulate_options={'method': ...}"),
        (fit, "project", "simulate_options={'stabilization': ...}"),
        (lambda **x: jl.predict(SYSTEM, DATA, PARAMS, **x), "dt", "simulate_options={'dt': ...}"),
        (select_model, "segments", "fit_options={'segments': ...}"),
        (select_model, "tolerance", "fit_options={'rtol': ..., 'atol': ...}"),
        (select_model, "method", "fit_options={'simulate_options': {'method': ...}}"),
        (lambda **x: jl.Descent(**x), "optimiser", "optimizer="),
    ],
)
def test_former_keywords_give_the_present_ones(call, former, present):
    with pytest.raises(ValueError, match=f"but it got {former}=. Write ") as caught:
        call(**{former: 1})
    assert present in str(caught.value)


def test_new_required_arguments_are_named():
    with pytest.raises(ValueError, match=r"^`ts` must be given, .* Pass ts=jnp\.linspace"):
        jl.simulate(SYSTEM, Q, V)
    with pytest.raises(ValueError, match=r"^`v0` must be given, .* With u0= pass v0=None"):
        jl.simulate(SYSTEM, Q, u0=V, ts=TS)
    with pytest.raises(ValueError, match=r"^`name` must be given, .* Write jl\.Rayleigh\(R, "):
        jl.Rayleigh(lambda t, q, v, params: v @ v)


@pytest.mark.usefixtures("unchecked")
def test_unknown_options_of_a_simulation_are_refused():
    for wrong, message in (
        ({"rtoll": 1e-6}, r"^`simulate_options` must be among .*'rtol'.* but one was 'rtoll'"),
        ({"ts": TS}, "^`ts` must be left out, since jl.fit sets it"),
        (1e-6, "^`simulate_options` must be a dict of options of jl.simulate, but it was 1e-06"),
    ):
        with pytest.raises(ValueError, match=message):
            fit(simulate_options=wrong)


@pytest.mark.usefixtures("unchecked")
def test_unknown_options_of_a_fit_are_refused():
    candidates = {"drag": jl.Candidate(jl.Rayleigh(lambda t, q, v, p: v @ v, "drag"), params0={})}
    for wrong, message in (
        ({"free": ("k",)}, r"^`fit_options` must be among .*'segments'.* but one was 'free'"),
        (3, "^`fit_options` must be a dict of arguments of jl.fit, but it was 3"),
    ):
        with pytest.raises(ValueError, match=message):
            jl.select_model(
                SYSTEM, DATA, PARAMS, candidates, held_out=DATA, free=("k",), fit_options=wrong
            )


def test_renamed_class_of_rotations_gives_the_present_name():
    with pytest.raises(AttributeError, match=r"is jaxlag\.rotation\.AbstractParametrization now$"):
        jl.rotation.AbstractParametrisation  # noqa: B018


def test_multipliers_have_one_name():
    with pytest.raises(
        ValueError, match=r"^`save` must name .* but one was 'lam'\. Write 'multipli"
    ):
        jl.simulate(SYSTEM, Q, V, TS, PARAMS, save=("lam",))
    rest = jl.equilibrium(SYSTEM, Q, PARAMS)
    assert rest.multipliers == {}
    with pytest.raises(AttributeError, match=r"^Equilibrium\.lam is Equilibrium\.multipliers now$"):
        rest.lam  # noqa: B018


def test_private_members_of_a_system_say_so():
    with pytest.raises(AttributeError, match=r"^System\.terms is private now\. .* mass_matrix"):
        SYSTEM.terms  # noqa: B018
    with pytest.raises(AttributeError, match=r"^'System' object has no attribute 'masses'$"):
        SYSTEM.masses  # noqa: B018
