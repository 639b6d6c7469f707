"""Programs for usual and unusual mass matrices, and reasons for none, with the part by name."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._lowering._acceleration_program import Choices, State
from jaxlag._lowering._emit._emit import INTERPRET_FROM
from jaxlag._lowering._lower import usually_definite
from jaxlag._lowering._scalar_program import ScalarProgram
from jaxlag._lowering._symbolic._program_key import key_of
from jaxlag._tracing import _params
from tests._jaxprs import count, operations

POINTS = 4
NAMES = ["first", "second", "third", "fourth"]
Q = jnp.array([1.0, 0.1, 1.9, 0.5, 2.9, 0.4, 3.4, 1.3])
V = jnp.array([0.1, 0.4, -0.2, 0.3, 0.5, -0.1, 0.2, 0.6])


def chain(massless: bool):
    """Points on rods in Cartesian coordinates; one of them may be declared without mass."""

    def lagrangian(t, q, v, p):
        m = p["m"].at[1].set(0.0) if massless else p["m"]
        r, w = q.reshape(-1, 2), v.reshape(-1, 2)
        return jnp.sum(0.5 * m * jnp.sum(w**2, axis=1) - m * p["g"] * r[:, 1])

    def rods(t, q, p):
        steps = jnp.diff(q.reshape(-1, 2), axis=0, prepend=jnp.zeros((1, 2)))
        return 0.5 * jnp.sum(steps**2, axis=1)

    return jl.System(lagrangian, {"r": 2 * POINTS}, constraints=[jl.Holonomic(rods, names=NAMES)])


PARAMS = {"m": jnp.array([1.0, 0.7, 1.3, 0.9]), "g": jnp.array(9.81)}
WITHOUT = PARAMS | {"m": PARAMS["m"].at[1].set(0.0)}


def evaluation(system):
    """a of (m, q) as in a loop, with M definite or not found at run time."""
    program = system._program
    assert isinstance(program, ScalarProgram)
    program = replace(program, in_loop=True)

    def definite(params):
        return lambda: jnp.all(params["m"] > 0)

    def a(params, q, v):
        constants = program.precompute(q, params, {}, Choices(definite=definite(params)))
        return program.acceleration(State(jnp.zeros(()), q, v, params, {}), constants)

    return a


@pytest.mark.parametrize(("massless", "sample"), [(False, None), (True, None), (False, WITHOUT)])
def test_random_state_tells_the_usual_mass_matrix(massless, sample):
    system = chain(massless)
    key = key_of(system._terms, Q, PARAMS, {}, None)
    sample = _params.UNKNOWN if sample is None else _params.sample(sample)
    assert usually_definite(key, sample) is (not massless and sample is _params.UNKNOWN)


@pytest.mark.parametrize(
    "mass",
    [lambda q: jnp.array([1.0, 1e-10]), lambda q: jnp.stack([1.0 + 0.0 * q[0], jnp.sqrt(q[0])])],
    ids=["units apart", "not finite in half of the states"],
)
def test_small_inertias_and_domains_are_usual(mass):
    system = jl.System(lambda t, q, v, p: 0.5 * mass(q) @ v**2, ("x", "y"))
    key = key_of(system._terms, jnp.ones(2), {}, {}, None)
    assert usually_definite(key, _params.UNKNOWN)


@pytest.mark.full
@pytest.mark.parametrize("massless", [False, True])
def test_only_the_usual_program_is_written_out(massless):
    """The other one is a table for a loop; if masses vanish in every case, there is no other."""
    system = chain(massless)
    whole = system._program
    assert isinstance(whole, ScalarProgram)
    equations = whole.lowered(Q, PARAMS, {}).equations
    assert equations is not None
    general = equations.program
    assert len(general.body) > INTERPRET_FROM
    program = whole if massless else whole.regular()

    def alone(params, q, v):
        state = State(jnp.zeros(()), q, v, params, {})
        return program.acceleration(state, program.precompute(q, params, {}))

    either = operations(evaluation(system), PARAMS, Q, V)
    arithmetic = "add", "sub", "mul", "div"
    expected = count(operations(alone, PARAMS, Q, V), *arithmetic)
    assert expected > 0
    found = count(either, *arithmetic, without=("while", "scan"))
    assert expected <= found <= expected + len(general.prelude)
    assert any("cond" in o.inside for o in either) is not massless


@pytest.mark.full
@pytest.mark.parametrize("params", [PARAMS, WITHOUT], ids=["masses", "one without mass"])
def test_both_programs_give_the_same_accelerations_and_derivatives(params):
    a = evaluation(chain(False))
    known = chain(False).acceleration(Q, V, params)
    np.testing.assert_allclose(jax.jit(a)(params, Q, V), known, rtol=1e-11, atol=1e-11)
    forward = jax.jacfwd(lambda q: a(params, q, V))(Q)
    reverse = jax.jacrev(lambda q: a(params, q, V))(Q)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-10)
    h = 1e-5
    columns = [
        (a(params, Q + h * e, V) - a(params, Q - h * e, V)) / (2 * h) for e in np.eye(Q.size)
    ]
    np.testing.assert_allclose(forward, jnp.stack(columns, axis=1), rtol=1e-6, atol=1e-6)


# ---- Reasons ------------------------------------------------------------------------------------


def first_eigenvalue(t, q, p):
    return jnp.linalg.eigvalsh(jnp.array([[q[0], q[1]], [q[1], 2.0]]))[0]


def pose_of_fork(t, q, p):
    return jl.rotation.about_x(first_eigenvalue(t, q, p)), jnp.zeros(3)


def of_body(t, q, v, p):
    _, w = jl.energy.body_velocity(pose_of_fork, t, q, v, p)
    return 0.5 * v @ v + 0.5 * w @ w


def free(t, q, v, p):
    return 0.5 * v @ v


UNREADABLE = {
    "body": ({"lagrangian": of_body}, r"lagrangian: eigh at .*test_lower.py:\d+.*"),
    "row": (
        {
            "constraints": [
                jl.Holonomic(lambda t, q, p: q[0], names="guide"),
                jl.Holonomic(first_eigenvalue, names="mode"),
            ]
        },
        r"constraint 'mode': eigh at .*test_lower.py:\d+.*\(first_eigenvalue\)",
    ),
    "force": (
        {
            "forces": [
                jl.GeneralizedForce(lambda t, q, v, p: -v, name="drag"),
                jl.GeneralizedForce(lambda t, q, v, p: -jnp.sort(v), name="order"),
            ]
        },
        r"force 'order': sort at .*test_lower.py:\d+.*",
    ),
    "force that reads multipliers": (
        {
            "constraints": [jl.Holonomic(lambda t, q, p: q[0], names="guide")],
            "forces": [
                jl.GeneralizedForce(lambda t, q, v, p: -v, name="drag"),
                jl.GeneralizedForce(
                    lambda t, q, v, p, lam: -lam["guide"] * jnp.sort(v), "rubbing", reaction=True
                ),
            ],
        },
        r"force 'rubbing': sort at .*test_lower.py:\d+.*",
    ),
}


@pytest.mark.parametrize("part", UNREADABLE)
def test_part_without_scalar_form_is_named_with_its_line(part):
    declaration, reason = UNREADABLE[part]
    system = jl.System(**{"lagrangian": free, "coordinates": ("x", "y")} | declaration)
    assert re.search(rf"array program \({reason}\)", system.explain({}))


@pytest.mark.full
def test_longest_parts_of_long_code_are_named():
    """Rows of 81 products, M = 1 and h = 0."""

    def waves(t, q, p):
        return jnp.sum(jnp.sin(jnp.outer(q, q)), axis=0)[:3]

    rows = jl.Holonomic(waves, names=[f"wave {i}" for i in range(3)])
    system = jl.System(free, {"r": 9}, constraints=[rows])
    found = re.search(r"array program \((.*)\)", system.explain({}))
    assert found is not None
    assert re.fullmatch(
        r"\d+ operations, \d+ more once per solve: more than 1500; "
        r"row 'wave \d' \d+, row 'wave \d' \d+, row 'wave \d' \d+",
        found[1],
    )


@pytest.mark.full
def test_a_long_force_is_the_longest_part():
    def push(t, q, v, p):
        return jnp.sum(jnp.sin(jnp.outer(q, v) + q[:, None, None]), axis=(0, 1))

    force = jl.GeneralizedForce(push, name="push")
    text = jl.System(free, {"r": 9}, forces=[force]).explain({})
    assert re.search(r"array program \(\d+ operations.*: more than 1500; Q \d+\)", text)


@pytest.mark.full
def test_an_entry_that_rounding_leaves_on_one_side_is_eliminated():
    """B^T M B of columns that are orthogonal in M: 0 above the diagonal, 1e-17 below it."""
    m, B = np.array([0.9, 0.9, 1.0, 1.0]), np.eye(4)
    B[:2, :2] = [[1.1, 0.1], [0.6, -0.18333333333333335]]
    B[2:, 1] = 0.5

    def lagrangian(t, q, v, p):
        return 0.5 * jnp.sum(m * v**2) - jnp.sum(jnp.cos(q))

    modal = jl.QuasiVelocities(kinematics=lambda t, q, u, p: B @ u, names=("a", "b", "c", "d"))
    system = jl.System(lagrangian, {"x": (4,)}, quasi=modal, lowering="scalar")
    q, u = jnp.linspace(0.1, 0.4, 4), jnp.linspace(0.5, 0.2, 4)
    assert "scalar program" in system.explain(None)
    ts = jnp.array([0.0, 0.1])
    found = jl.simulate(system, q, None, ts, u0=u).q[-1]
    plain = jl.System(lagrangian, {"x": (4,)})
    np.testing.assert_allclose(found, jl.simulate(plain, q, B @ u, ts).q[-1], atol=1e-9)


@pytest.mark.full
def test_rows_of_quasi_velocities_do_not_count_as_operations():
    """They satisfy the rows: no multipliers are eliminated."""

    def kinematics(t, q, u, p):
        arms = q.reshape(-1, 2) - q[:2]
        return (u[:2] + u[2] * jnp.stack([-arms[:, 1], arms[:, 0]], axis=1)).reshape(-1)

    def distances(t, q, p):
        r = q.reshape(-1, 2)
        return jnp.concatenate([jnp.sum((r[k:] - r[:-k]) ** 2, axis=1) - k**2 for k in (1, 2)])

    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v,
        {"r": (15, 2)},
        constraints=(jl.Holonomic(distances, "distance"),),
        quasi=jl.QuasiVelocities(kinematics=kinematics, names=("along", "across", "turn")),
    )
    assert "lowering      scalar program" in system.explain(None)
