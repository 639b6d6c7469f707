"""Terms of constrained systems by interpreted code: equal to those on arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _consistent import onto_constraints
from _families import mostly_full

import jaxlag as jl
from jaxlag._linalg._row_residuals import row_sizes
from jaxlag._lowering import ArrayTerms, _term_codes
from jaxlag._lowering._emit import _emit
from jaxlag._lowering._interpreted_terms import InterpretedTerms
from systems.catalogue import ENTRIES

EPS = np.finfo(float).eps
CONSTRAINED = [name for name, entry in ENTRIES.items() if entry.system.constraints]


@pytest.fixture
def all_interpreted(monkeypatch):
    """Short code is interpreted, too."""
    monkeypatch.setattr(_term_codes, "LONG", -1)
    monkeypatch.setattr(_emit, "INTERPRET_FROM", -1)


def fresh(system):
    """The same system with a Lagrangian of its own, so that no program exists."""

    def lagrangian(t, q, v, params):
        return system.lagrangian(t, q, v, params)

    declared = {"constraints": system.constraints, "forces": system.forces}
    return jl.System(lagrangian, system.coordinates.shapes, **declared)


def both(name):
    """(terms by the interpreter, on arrays, state, params) of a system of the catalog."""
    entry = ENTRIES[name]
    system, params = entry.system, jax.tree.map(jnp.asarray, dict(entry.example.params))
    rng = np.random.default_rng(3)
    q, v = rng.uniform(-1.0, 1.0, (2, system.size))
    q, v = onto_constraints(system, params, 0.2, q, v)
    array = ArrayTerms(system.lagrangian, (), system.constraints)
    program = jl.System(
        system.lagrangian, system.coordinates.shapes, constraints=system.constraints
    )._program
    terms = program.terms(q, params)
    return terms, array, (jnp.array(0.2), q, v), params


@pytest.mark.parametrize("name", mostly_full(CONSTRAINED, *CONSTRAINED[:3]))
def test_terms_are_those_on_arrays(name, all_interpreted):
    terms, array, (t, q, v), params = both(name)
    if not isinstance(terms, InterpretedTerms):
        pytest.skip("no scalar program")
    pairs = [
        (terms.mass(t, q, v, params), array.mass(t, q, v, params)),
        (terms.bias(t, q, v, params), array.bias(t, q, v, params)),
        (terms.position(t, q, params), array.position(t, q, params)),
        (terms.velocity(t, q, v, params), array.velocity(t, q, v, params)),
        (terms.gamma_of(params)(t, q, v), array.gamma(t, q, v, params)),
        *zip(terms.rows(t, q, v, params), array.rows(t, q, v, params), strict=True),
    ]
    for found, expected in pairs:
        size = 1.0 + np.max(np.abs(expected), initial=0.0)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e3 * EPS * size)


@pytest.mark.parametrize("name", mostly_full(CONSTRAINED, *CONSTRAINED[:3]))
def test_accelerations_and_reactions_are_those_on_arrays(name, all_interpreted):
    terms, array, state, params = both(name)
    if not isinstance(terms, InterpretedTerms):
        pytest.skip("no scalar program")
    found, expected = (
        jax.jit(lambda t, q, v, p, by=by: array.reactions(t, q, v, p, {}, by))(*state, params)
        for by in (terms, None)
    )
    for x, y in zip(found, expected, strict=True):
        # Some hundred roundings through M and A M^-1 A^T, each with a condition of up to 1e3.
        np.testing.assert_allclose(x, y, rtol=0, atol=1e7 * EPS * (1.0 + np.max(np.abs(y))))


def closed_chain():
    """Two links on a rail, closed by a row that follows from the others up to rounding."""

    def lagrangian(t, q, v, p):
        x = q[0] + p["l"] * jnp.sin(q[1])
        y = -p["l"] * jnp.cos(q[1])
        T = 0.5 * p["m"] * (v[0] ** 2 + (p["l"] * v[1]) ** 2 + v[2] ** 2)
        return T + 0.1 * v[0] * v[1] * jnp.cos(q[1]) - p["m"] * 9.81 * (y + q[2]) - 0.3 * x**2

    def closure(t, q, p):
        s, c = jnp.sin(q[1]), jnp.cos(q[1])
        height = q[2] + p["l"] * c
        return jnp.stack([height, 2.0 * height, (s**2 + c**2 - 1.0) * q[0]])

    rows = (jl.Holonomic(closure, "closure"),)
    return jl.System(lagrangian, ("x", "a", "z"), constraints=rows)


CHAIN = {"m": 1.3, "l": 0.7}
START = np.array([0.2, 0.5, -0.7 * np.cos(0.5)]), np.array([0.1, 0.3, 0.7 * 0.3 * np.sin(0.5)])


@pytest.mark.full
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_accelerations(mode, all_interpreted):
    """In the state as on arrays, in the mass against differences."""
    system, (q, v) = fresh(closed_chain()), map(jnp.asarray, START)
    array = ArrayTerms(system.lagrangian, (), system.constraints)

    def acceleration(q, v, m):
        return system.acceleration(q, v, CHAIN | {"m": m})

    def on_arrays(q, v):
        return array.reactions(jnp.zeros(()), q, v, CHAIN, {})[0]

    *found, by_mass = mode(acceleration, (0, 1, 2))(q, v, CHAIN["m"])
    for x, y in zip(found, jax.jit(mode(on_arrays, (0, 1)))(q, v), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e6 * EPS * (1.0 + np.max(np.abs(y))))
    h = 1e-5
    ahead, back = (acceleration(q, v, CHAIN["m"] + s * h) for s in (1.0, -1.0))
    # Differences of a second order: h^2 and roundings over h.
    np.testing.assert_allclose(by_mass, (ahead - back) / (2 * h), rtol=0, atol=1e-8)


@pytest.mark.full
def test_multipliers_share_the_reaction_of_dependent_rows(all_interpreted):
    system, (q, v) = fresh(closed_chain()), map(jnp.asarray, START)
    array = ArrayTerms(system.lagrangian, (), system.constraints)
    a, lam = array.reactions(jnp.zeros(()), q, v, CHAIN, {})
    found = jnp.ravel(jnp.concatenate(list(system.multipliers(q, v, CHAIN).values())))
    assert abs(lam[1] - 0.5 * lam[0]) < 1e6 * EPS  # lengths 1 and 2, equal forces
    assert lam[2] == 0.0
    size = float(np.max(np.abs(lam)))
    np.testing.assert_allclose(found, lam, rtol=0, atol=1e6 * EPS * size)
    np.testing.assert_allclose(system.acceleration(q, v, CHAIN), a, rtol=0, atol=1e6 * EPS * 10.0)


def test_rows_of_rounding_are_void(all_interpreted):
    """The third row is 0 = 0 but for rounding; the second depends on the first, and is not void."""
    system = closed_chain()
    params = jax.tree.map(jnp.asarray, CHAIN)
    q, v = map(jnp.asarray, START)
    terms = system._program.terms(q, params)
    assert isinstance(terms, InterpretedTerms)
    rows = terms.rows_of(jnp.array(0.0), v, params)
    nonzero, void, _ = row_sizes(rows, q, rows(q))
    assert nonzero.tolist() == [True, True, False]
    assert void.tolist() == [False, False, True]


def test_rows_of_rounded_numbers_stay_on_arrays(all_interpreted):
    """A tilted plane: products of its numbers cancel, and only arrays know their rounding."""
    R = np.asarray(jl.rotation.about_x(0.5)) @ np.asarray(jl.rotation.about_y(0.35))

    def lagrangian(t, q, v, p):
        return 0.5 * v @ v - 9.81 * p * q[0]

    def plane(t, q, p):
        return (R.T @ (R @ jnp.stack([q[0], q[1] ** 2, 0.0 * q[0]])))[1:]

    system = jl.System(lagrangian, ("x", "y"), constraints=(jl.Holonomic(plane, ("a", "b")),))
    assert isinstance(system._program.terms(jnp.ones(2), 1.0), ArrayTerms)


def test_precisions_stay_apart(all_interpreted):
    """Times have 64 bits: a state of 32 stays on arrays."""
    terms = closed_chain()._program.terms(jnp.zeros(3, jnp.float32), CHAIN)
    assert isinstance(terms, ArrayTerms)


OPTIONS = {
    "plain": {},
    "fixed": {"dt": 0.01},
    "assembled": {"assemble": True},
    "no stabilization": {"stabilization": None},
    "null space": {"formulation": "null_space"},
}


@pytest.mark.full
@pytest.mark.parametrize("name", mostly_full(list(OPTIONS), "plain", "assembled"))
def test_motions_do_not_depend_on_it(name, monkeypatch):
    """Started off the constraints by 1e-3 where it is assembled."""
    q, v = START
    q = q + 1e-3 if name == "assembled" else q
    ts = np.linspace(0.0, 1.0, 5)

    def go():
        return jl.simulate(fresh(closed_chain()), q, v, ts, CHAIN, **OPTIONS[name])

    expected = go()
    monkeypatch.setattr(_term_codes, "LONG", -1)
    monkeypatch.setattr(_emit, "INTERPRET_FROM", -1)
    found = go()
    assert found.status == expected.status == 0
    np.testing.assert_allclose(found.q, expected.q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.v, expected.v, rtol=0, atol=1e-8)


@pytest.mark.full
def test_an_inconsistent_start_is_named(all_interpreted):
    q, v = START
    with pytest.raises(jl.SimulationError, match="closure"):
        jl.simulate(fresh(closed_chain()), q + np.array([0.0, 0.0, 0.1]), v, [0.0, 1.0], CHAIN)


@pytest.mark.full
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradients_through_the_start_and_assembly(mode, all_interpreted):
    """Of the state assembled from a guess, and of the motion from there, against differences."""
    system, (q, v) = fresh(closed_chain()), START

    def end(l):  # noqa: E741
        options = {"assemble": True, "rtol": 1e-11, "atol": 1e-11}
        return jl.simulate(system, q + 1e-3, v, [0.0, 0.7], CHAIN | {"l": l}, **options).q[-1]

    found = mode(end)(0.7)
    h = 1e-5
    expected = (end(0.7 + h) - end(0.7 - h)) / (2.0 * h)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)
