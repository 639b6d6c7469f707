"""A declared function that is not finite: named, with its line, by `check` and by a motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._model._inputs import check_inputs
from jaxlag._system._nonfinite import nonfinite


def point(t, q, v, p):
    return 0.5 * v @ v - q[1]


def relativistic(t, q, v, p):
    return -jnp.sqrt(1.0 - v @ v)


def root_mass(t, q, v, p):
    return 0.5 * jnp.sqrt(q[0]) * v[0] ** 2 + 0.5 * v[1] ** 2


def root_potential(t, q, v, p):
    return 0.5 * v @ v - jnp.sqrt(q @ q)


def logarithm(t, q, v, p):
    return jnp.stack([jnp.log(q[0]), 0.0 * q[0]])


def scaled(t, q, v, p, inputs):
    return jnp.stack([inputs["gain"] / q[0], 0.0 * q[0]])


def length(t, q, p):
    return jnp.sqrt(q @ q)


def speed(t, q, v, p):
    return v[0] * jnp.log(q[1]) - v[1]


def dissipation(t, q, v, p):
    return jnp.abs(q[0]) ** 0.5 * 0.0 + (v @ v) ** 0.75


def kinetic(t, q, v, p):
    return 0.5 * v @ v


def potential(t, q, p):
    return 1.0 / q[0]


PLANE = ("x", "y")
PUSH = jl.GeneralizedForce(logarithm, "push")
FED = jl.GeneralizedForce(scaled, "fed")
CASES = {
    "L": (jl.System(relativistic, PLANE), [0.0, 0.0], [1.1, 0.0], "lagrangian", False, "sqrt"),
    "M": (jl.System(root_mass, PLANE), [-1.0, 0.0], [1.0, 0.0], "lagrangian", False, "sqrt"),
    "dM": (jl.System(root_mass, PLANE), [0.0, 0.0], [1.0, 0.0], "lagrangian", True, "sqrt"),
    "dV": (jl.System(root_potential, PLANE), [0.0, 0.0], [1.0, 0.0], "lagrangian", True, "sqrt"),
    "V": (
        jl.System(kinetic=kinetic, potential=potential, coordinates=PLANE),
        [0.0, 0.0], [1.0, 0.0], "potential", False, "div",
    ),
    "Q": (
        jl.System(point, PLANE, forces=(PUSH,)),
        [-1.0, 0.0], [0.0, 0.0], "force 'push': Q", False, "log",
    ),
    "input": (
        jl.System(point, PLANE, forces=(FED,)),
        [0.0, 0.0], [0.0, 0.0], "force 'fed': Q", False, "div",
    ),
    "R": (
        jl.System(point, PLANE, forces=(jl.Rayleigh(dissipation, "drag"),)),
        [1.0, 0.0], [0.0, 0.0], "force 'drag': R", True, "pow",
    ),
    "phi": (
        jl.System(point, PLANE, constraints=(jl.Holonomic(length, "rod"),)),
        [0.0, 0.0], [0.0, 0.0], "constraint 'rod': phi", True, "sqrt",
    ),
    "rate": (
        jl.System(point, PLANE, constraints=(jl.Pfaffian(speed, "skate"),)),
        [0.0, 0.0], [0.0, 0.0], "constraint 'skate': residual", False, "log",
    ),
}  # fmt: skip
INPUTS = {"input": {"gain": 2.0}}


def line_of(text):
    """The line of this file with this text, outside of this function."""
    with open(__file__) as file:
        return next(i for i, line in enumerate(file, 1) if text in line and "def " not in line)


LINES = {
    "L": "1.0 - v @ v)",
    "M": "0.5 * jnp.sqrt(q[0])",
    "dM": "0.5 * jnp.sqrt(q[0])",
    "dV": "v @ v - jnp.sqrt(q @ q)",
    "V": "return 1.0 / q[0]",
    "Q": "jnp.log(q[0])",
    "input": 'inputs["gain"] / q[0]',
    "R": "** 0.75",
    "phi": "return jnp.sqrt(q @ q)",
    "rate": "v[0] * jnp.log(q[1])",
}


@pytest.mark.parametrize("case", CASES)
def test_the_function_and_its_line_are_found(case):
    system, q, v, function, derivative, operation = CASES[case]
    inputs = check_inputs(INPUTS.get(case))
    found = nonfinite(system, None, inputs, 0.0, jnp.asarray(q), jnp.asarray(v))
    assert found[:2] == (function, derivative)
    assert found.origin.primitive == operation
    assert found.origin.file == __file__
    assert found.origin.line == line_of(LINES[case])
    assert not np.all(np.isfinite(found.value))


@pytest.mark.parametrize("case", [case for case in CASES if case != "dM"])  # there M is singular
def test_check_refuses_the_state_with_the_line(case):
    system, q, v, function, derivative, operation = CASES[case]
    what = "have finite derivatives" if derivative else "be finite"
    name = function.rpartition(": ")[2]
    place = rf"See {operation} at test_nonfinite\.py:{line_of(LINES[case])}\."
    with pytest.raises(ValueError, match=rf"`{name}` must {what} at .* {place}"):
        system.check(q, v, inputs=INPUTS.get(case))


def test_functions_that_the_equations_do_not_read_there_are_no_finding():
    """d2V/dq2 is infinite at the origin, but the equations contain dV/dq alone."""

    def lagrangian(t, q, v, p):
        return 0.5 * v @ v - jnp.sum(jnp.abs(q) ** 1.5)

    system = jl.System(lagrangian, PLANE)
    assert nonfinite(system, None, {}, 0.0, jnp.zeros(2), jnp.ones(2)) is None
    assert nonfinite(system, None, {}, 0.0, jnp.full(2, jnp.nan), jnp.ones(2)) is None
    system.check([0.0, 0.0], [1.0, 0.0])


def test_the_motion_says_what_is_not_finite():
    """At its start and on its way; not that a coordinate has no inertia."""
    kinds = {"L": "`lagrangian`, by sqrt", "phi": "a derivative of `phi` of constraint 'rod'"}
    for case, text in kinds.items():
        system, q, v, *_ = CASES[case]
        motion = jl.simulate(
            system, q, v, [0.0, 1.0], dt=0.25, method="heun", stabilization=None, throw=False
        )
        assert motion.status == jl.Status.nonfinite
        assert f"Not finite: {text}" in motion.message()
        assert f"test_nonfinite.py:{line_of(LINES[case])}" in motion.message()
    falling = jl.System(point, PLANE, forces=(PUSH,))
    motion = jl.simulate(
        falling, [1.0, 0.0], [-3.0, 0.0], [0.0, 1.0], dt=0.05, method="heun", throw=False
    )
    assert motion.status == jl.Status.nonfinite
    assert 0.2 < motion.last_time < 0.4
    assert "Not finite: `Q` of force 'push', by log at test_nonfinite.py" in motion.message()


@pytest.mark.full
def test_batches_name_the_coordinate_and_the_status():
    system = CASES["M"][0]
    batch = jax.vmap(
        lambda q: jl.simulate(system, q, [1.0, 0.0], [0.0, 0.1], dt=0.05, method="heun")
    )(jnp.array([[1.0, 0.0], [-1.0, 0.0]]))
    assert batch.status.tolist() == [jl.Status.ok, jl.Status.nonfinite]
    assert batch.where.tolist() == [-1, 0]


def test_params_that_cannot_be_examined_hide_no_error():
    """A random key among the params: the motion still ends with its own message."""

    def noisy(t, q, v, p):
        return 0.5 * v @ v - jnp.log(q[0]) * jax.random.uniform(p["key"])

    system = jl.System(noisy, PLANE)
    params = {"key": jax.random.key(0)}
    at = jnp.array([-1.0, 0.0]), jnp.zeros(2)
    assert nonfinite(system, params, {}, 0.0, *at) is None
    options = {"dt": 0.5, "method": "heun", "throw": False}
    motion = jl.simulate(system, *at, [0.0, 1.0], params, **options)
    assert motion.message().startswith("nonfinite")
    with pytest.raises(ValueError, match="must be finite at the given state"):
        system.check(*at, params)
