"""Descriptor form: against minimal coordinates, closed forms, and differences of the equations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxlag as jl

EPS = np.finfo(float).eps
G = 9.81


def hanging(redundant=False):
    """A mass on a rod whose pivot is a driven, damped trolley with a motor of its own dynamics."""

    def lagrangian(t, q, v, p):
        trolley = 0.5 * p["m"] * v[0] ** 2 - 2.0 * q[0] ** 2
        return trolley + 0.5 * (v[1:] @ v[1:]) - G * q[2]

    def rod(t, q, p):
        r = jnp.stack([q[1] - q[0], q[2]])
        phi = r @ r - p["l"] ** 2
        return jnp.stack([phi, 2.0 * phi]) if redundant else phi

    def push(t, q, v, p, inputs):
        force = inputs["u"] + inputs["motor"] - 0.3 * v[0]
        return jnp.stack([force, -0.1 * v[1], 0.0 * v[2]])

    def motor(t, q, v, x, p, inputs):
        return (inputs["u"] - x - 0.5 * v[:1]) / 0.2

    return jl.System(
        lagrangian,
        ("x", "a", "b"),
        forces=[jl.GeneralizedForce(push, "push")],
        constraints=(jl.Holonomic(rod, "rod"),),
        states=jl.States(motor, ("motor",)),
    )


PARAMS = {"m": 1.7, "l": 0.8}
REST = [0.0, 0.0, -0.8]
INPUTS = {"u": 0.0, "motor": 0.0}


def sleigh():
    """Chaplygin's sleigh on a belt: an edge row, turning and sliding at a state of motion."""

    def lagrangian(t, q, v, p):
        centre = v[:2] + p * v[2] * jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])])
        return 0.75 * centre @ centre + 0.1 * v[2] ** 2 - 0.5 * q[0] ** 2

    def edge(t, q, v, p):
        return -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * (v[1] - 0.2 * q[0])

    rows = (jl.Pfaffian(edge, "edge"),)
    return jl.System(lagrangian, ("x", "y", "psi"), constraints=rows)


def finite_eigenvalues(form):
    """Of the pencil s E - A, by ascending |s|."""
    values = scipy.linalg.eigvals(np.asarray(form.A), np.asarray(form.E))
    values = values[np.isfinite(values)]
    return values[np.argsort(np.abs(values))]


@pytest.fixture(scope="module")
def minimal():
    """Redundant rows -> the linearization, with the multipliers as outputs."""

    @functools.cache
    def of(redundant):
        at = REST, [0.0] * 3, PARAMS
        return jl.linearize(hanging(redundant), *at, inputs=INPUTS, outputs=("rod",))

    return of


@pytest.mark.full
def test_finite_eigenvalues_are_those_in_minimal_coordinates(minimal):
    """A holonomic row: 7 variables and a multiplier, 5 finite eigenvalues."""
    form = jl.descriptor_form(hanging(), REST, [0.0] * 3, PARAMS, inputs=INPUTS)
    assert form.variables == ("x", "a", "b", "x'", "a'", "b'", "motor", "rod")
    assert form.inputs == ("u",)
    expected = jl.modes(minimal(False)).eigenvalues
    order = lambda x: sorted(x, key=lambda s: (round(abs(s), 6), -s.imag))  # noqa: E731
    found = finite_eigenvalues(form)
    assert found.shape == (5,)
    np.testing.assert_allclose(order(found), order(expected), atol=5e-14)  # measured 5e-15


@pytest.mark.full
@pytest.mark.parametrize("redundant", [False, True])
def test_solutions_in_minimal_coordinates_satisfy_it(redundant, minimal):
    """E z' = A z + B u along x' = A x + B u, with multipliers as outputs; redundant rows, too."""
    system = hanging(redundant)
    form = jl.descriptor_form(system, REST, [0.0] * 3, PARAMS, inputs=INPUTS)
    linear = minimal(redundant)
    z = np.concatenate([linear.basis, linear.C])
    of_u = np.concatenate([np.zeros((7, 1)), linear.D])
    rates = np.concatenate([linear.basis, np.zeros_like(linear.C)])
    size = np.max(np.abs(form.A))
    np.testing.assert_allclose(form.E @ rates @ linear.A, form.A @ z, atol=20 * EPS * size)
    np.testing.assert_allclose(form.E @ rates @ linear.B, form.A @ of_u + form.B, atol=20 * EPS)
    np.testing.assert_allclose(form.f0, 0.0, atol=20 * EPS * size)


def test_columns_at_a_state_of_motion_by_differences():
    """M a + h - Q - A^T lam and the edge row, at the accelerations and multiplier of the state."""
    system, q = sleigh(), np.array([0.3, 0.1, 0.4])
    forward, p = 0.9, 0.4
    slip = 0.2 * q[0]  # of the belt, across x
    v = np.array([forward * np.cos(q[2]), forward * np.sin(q[2]) + slip, 0.7])
    form = jl.descriptor_form(system, q, v, p)
    a = np.asarray(system.acceleration(q, v, p))
    lam = np.asarray(system.multipliers(q, v, p)["edge"]).reshape(1)
    M = np.asarray(form.E)[3:6, 3:6]

    def right(z):
        """By Lagrange's equations from the gradients of L alone."""
        q, v, lam = np.split(z, [3, 6])
        needed = np.asarray(jl.inverse_dynamics(system, q, v, a, p))
        residual = edge_of(q) @ (v - np.array([0.0, 0.2 * q[0], 0.0]))
        return np.concatenate([v, lam * edge_of(q) - needed, [residual]])

    z, h = np.concatenate([q, v, lam]), 1e-6
    slope = np.stack([(right(z + h * e) - right(z - h * e)) / (2 * h) for e in np.eye(7)], 1)
    np.testing.assert_allclose(form.A, slope, atol=1e-8)  # measured 4e-10
    np.testing.assert_allclose(form.f0, np.concatenate([v, M @ a, [0.0]]), atol=50 * EPS)


def edge_of(q):
    return np.array([-np.sin(q[2]), np.cos(q[2]), 0.0])


@pytest.mark.full
def test_derivatives_and_batches():
    """d/dm and d/dl of all entries: forward, reverse, differences."""
    system = hanging()

    def entries(p):
        form = jl.descriptor_form(system, jnp.array(REST), jnp.zeros(3), p, inputs=INPUTS)
        return jnp.concatenate([form.A, form.E]).ravel()

    of = jax.jit(entries)
    forward, reverse = (jax.jit(mode(entries))(PARAMS) for mode in (jax.jacfwd, jax.jacrev))
    for name, value in PARAMS.items():
        h = 1e-5
        slope = (of(PARAMS | {name: value + h}) - of(PARAMS | {name: value - h})) / (2 * h)
        np.testing.assert_allclose(forward[name], reverse[name], atol=1e-12)
        np.testing.assert_allclose(forward[name], slope, atol=1e-8)

    def with_mass(m):
        return jl.descriptor_form(system, REST, [0.0] * 3, PARAMS | {"m": m}, inputs=INPUTS)

    assert jax.vmap(with_mass)(jnp.array([1.0, 2.0]))[1].E[3, 3] == 2.0


def test_refusals():
    system = hanging()
    with pytest.raises(ValueError, match=r"descriptor_form: `q` must be finite"):
        jl.descriptor_form(system, [0.0, np.inf, 0.0], [0.0] * 3, PARAMS, inputs=INPUTS)
    with pytest.raises(ValueError, match=r"must have values of the states, \['motor'\]"):
        jl.descriptor_form(system, REST, [0.0] * 3, PARAMS, inputs=("u",))
    with pytest.raises(ValueError, match=r"must satisfy the constraints, but phi of 'rod' was"):
        jl.descriptor_form(system, [0.0, 0.0, -0.7], [0.0] * 3, PARAMS, inputs=INPUTS)
    with pytest.raises(ValueError, match=r"The order is \(system, q, v, params\)"):
        jl.descriptor_form(system, REST, [0.0] * 3, PARAMS, 0.0)
