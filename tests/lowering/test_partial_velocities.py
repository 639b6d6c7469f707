"""M and h by d'Alembert's principle: against derivatives of the momentum, and what is left out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _lowered import lowered

import jaxlag as jl
from bench.fuzz import _random_systems
from jaxlag import rotation
from jaxlag._lowering._graph._expression import order
from jaxlag._lowering._graph._literals import Literals
from jaxlag._lowering._graph._residues import Residues
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._bias_forms import degree, mass_matrix, momentum_form
from jaxlag._lowering._symbolic._evaluate import evaluate
from jaxlag._lowering._symbolic._partial_velocities import principle_of_dalembert, terms_of
from jaxlag._lowering._symbolic._program_key import key_of
from jaxlag._lowering._symbolic._read_system import read_scene
from jaxlag._lowering._symbolic._value_numbering import merged
from jaxlag.rotation import about_x, about_y, about_z

EPS = np.finfo(float).eps
BODY = {"m": jnp.array(2.0), "I": jnp.diag(jnp.array([0.3, 0.5, 0.2])) + 0.05, "g": jnp.array(9.81)}


def arm(t, q, params):
    """Poses of three links with hinges about z, y and x."""
    R, r, poses = jnp.eye(3), jnp.zeros(3), []
    for k, about in enumerate((about_z, about_y, about_x)):
        R = R @ about(q[k])
        poses.append((R, r + R @ jnp.array([0.4, 0.1, -0.2])))
        r = r + R @ jnp.array([0.8, 0.0, 0.0])
    return poses


def linkage(t, q, v, params):
    body = jl.energy.RigidBody(params["m"], params["I"])
    total = 0.0
    for k in range(3):

        def pose(t, q, params, k=k):
            return arm(t, q, params)[k]

        total = total + body.kinetic(pose, t, q, v, params)
        total = total - params["m"] * params["g"] * pose(t, q, params)[1][2]
    return total


def spring_pendulum(t, q, v, p):
    r, phi = q
    T = 0.5 * p["m"] * (v[0] ** 2 + (r * v[1]) ** 2)
    return T + p["m"] * p["g"] * r * jnp.cos(phi) - 0.5 * (r - 1.0) ** 2


def moved_support(t, q, v, p):
    """A pendulum on a support that moves in time, with a term that is linear in v."""
    vx = 2.0 * jnp.cos(2.0 * t) + jnp.cos(q[0]) * v[0]
    vy = jnp.sin(q[0]) * v[0] + v[1]
    drag = t * q[1] * v[0] + q[0] ** 2 * v[1]
    return 0.5 * p["m"] * (vx**2 + vy**2) + drag + p["g"] * jnp.cos(q[0]) - q[1] ** 4


def double_pendulum(t, q, v, p):
    a = q[0] - q[1]
    T = p["m"] * (v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(a))
    return T + p["g"] * (2.0 * jnp.cos(q[0]) + jnp.cos(q[1]))


def factors_and_a_quotient(t, q, v, p):
    """Coefficients that depend on q and t, odd and even powers of them, and a quotient."""
    shape = (1.0 + q[0] ** 2) * jnp.exp(0.1 * t)
    return (
        shape * v[0] ** 2 * (2.0 + q[1]) / (3.0 + q[0])
        + (q[0] * v[1] + v[0]) * v[1] * q[1] ** 2
        + v[1] ** 2
    )


def nested_potential(t, q, v, p):
    """A position and other terms in one sum, inside a factor: only the position is a load."""
    V = p["m"] * (q[0] + jnp.cos(q[1])) + q[0] * q[1]
    T = 0.5 * p["m"] * (v[0] ** 2 + v[1] ** 2) + 0.5 * v[1] ** 2
    return T - p["g"] * (V + p["m"] * (2.0 * q[0] - V)) - 0.5 * V**2


def stopped_and_chosen(t, q, v, p):
    """Coefficients with a stopped derivative, a choice, and a rule of its own."""
    held = jax.lax.stop_gradient(jnp.sin(q[0])) + 2.0
    side = jnp.where(q[1] > 0.0, 1.0 + q[1], jnp.exp(q[1]))
    T = held * v[0] ** 2 + side * v[1] ** 2 + jl.math.norm(q + 2.0) * v[0] * v[1]
    return T + jnp.maximum(q[0], q[1]) * v[0] - jnp.abs(q[0] * q[1])


SCENES = {
    "linkage": (linkage, 3),
    "spring pendulum": (spring_pendulum, 2),
    "moved support": (moved_support, 2),
    "double pendulum": (double_pendulum, 2),
    "factors": (factors_and_a_quotient, 2),
    "nested potential": (nested_potential, 2),
    "stopped and chosen": (stopped_and_chosen, 2),
}


def scene_of(name):
    """With its numbers as inputs, as in the derivation."""
    lagrangian, n = SCENES[name]
    system = jl.System(lagrangian, tuple(f"q{i}" for i in range(n)))
    scene = read_scene(key_of(system._terms, jnp.zeros(n), BODY, {}, None))
    (L,) = Literals(scene.graph).without([scene.lagrangian])
    return scene._replace(lagrangian=L)


def flat(M, h):
    return [*(x for row in M for x in row), *h]


def values_of(roots, seed):
    rng = np.random.default_rng(seed)
    return {node.data: rng.uniform(-1.5, 1.5) for node in order(roots) if node.op == "input"}


@pytest.mark.full
@pytest.mark.parametrize("name", SCENES)
def test_equal_to_derivatives_of_the_momentum(name):
    scene = scene_of(name)
    graph, L = scene.graph, scene.lagrangian
    found = flat(*principle_of_dalembert(scene, L, Residues()))
    expected = flat(mass_matrix(graph, L, scene.v), momentum_form(scene, L))
    for seed in range(5):
        values = values_of([*found, *expected], seed)
        a, b = (np.array(evaluate(roots, values), float) for roots in (found, expected))
        assert np.max(np.abs(a - b)) < 64 * EPS * np.max(np.abs(b))


@pytest.mark.parametrize("seed", range(40))
def test_equal_for_random_lagrangians(seed):
    """With kinks, choices, stopped derivatives, explicit time and functions with rules."""
    drawn = _random_systems.draw(seed)
    system = drawn.system
    try:
        scene = read_scene(key_of(system._terms, jnp.zeros(system.size), drawn.params, {}, None))
    except Unsupported:
        return
    graph, literals, residues = scene.graph, Literals(scene.graph), Residues()
    (L,) = literals.without([scene.lagrangian])
    found = principle_of_dalembert(scene._replace(lagrangian=L), L, residues)
    if found is None:
        assert degree([L], scene.v) > 2.0
        return
    found = literals.restored(merged(graph, flat(*found), residues))
    expected = flat(
        mass_matrix(graph, scene.lagrangian, scene.v), momentum_form(scene, scene.lagrangian)
    )
    for state in range(3):
        values = values_of([*found, *expected], state)
        with np.errstate(all="ignore"):
            a, b = (np.array(evaluate(roots, values), float) for roots in (found, expected))
        assert np.max(np.abs(a - b)) < 1e-12 * np.max(np.abs(b))  # worst 1e-15


@pytest.mark.parametrize("name", [name for name in SCENES if name != "stopped and chosen"])
def test_equal_as_expressions(name):
    """For all states and params, not only for those that are tried."""
    scene = scene_of(name)
    graph, L, residues = scene.graph, scene.lagrangian, Residues()
    found = flat(*principle_of_dalembert(scene, L, residues))
    expected = flat(mass_matrix(graph, L, scene.v), momentum_form(scene, L))
    assert residues(found) == residues(expected)


def test_linkage_takes_few_operations():
    """Velocities of mass centers have no K, and that of body rates is a product of them."""
    scene = scene_of("linkage")
    graph, L, residues = scene.graph, scene.lagrangian, Residues()
    found = merged(graph, flat(*principle_of_dalembert(scene, L, residues)), residues)
    plain = flat(mass_matrix(graph, L, scene.v), momentum_form(scene, L))
    short, long = (assemble(graph, roots).operations for roots in (found, plain))
    assert short < 0.4 * long  # 666 of 1935


def test_terms_add_up_to_the_lagrangian():
    for name in SCENES:
        scene = scene_of(name)
        graph, L, residues = scene.graph, scene.lagrangian, Residues()
        terms = terms_of(graph, L, scene.v)
        parts = [graph.mul(*each) for kind in terms for each in kind]
        assert residues([graph.add(*parts)]) == residues([L])
        assert all(each[0].fixed for kind in terms for each in kind)


@pytest.mark.parametrize(
    "L",
    [
        lambda t, q, v, p: -jnp.sqrt(1.0 - v[0] ** 2),
        lambda t, q, v, p: v[0] ** 4,
        lambda t, q, v, p: v[0] ** 3 / (1.0 + q[0]),
        lambda t, q, v, p: jnp.maximum(v[0], 0.0) * v[0],
    ],
)
def test_no_polynomial_of_degree_two(L):
    system = jl.System(L, ("x",))
    scene = read_scene(key_of(system._terms, jnp.zeros(1), {}, {}, None))
    assert principle_of_dalembert(scene, scene.lagrangian, Residues()) is None


@pytest.mark.full
def test_the_cheapest_form_is_chosen():
    """A body by a quaternion in a third of the 2087 operations of the others; a pendulum not."""

    def pose(t, q, params):
        return rotation.quaternion.matrix(q[3:]), q[:3]

    def kinetic(t, q, v, params):
        return jl.energy.RigidBody(params["m"], params["I"]).kinetic(pose, t, q, v, params)

    unit = jl.Holonomic(lambda t, q, params: q[3:] @ q[3:] - 1.0, "norm")
    names = ("x", "y", "z", "e0", "e1", "e2", "e3")
    rest = lambda t, q, params: params["g"] * q[2]  # noqa: E731
    body = jl.System(coordinates=names, kinetic=kinetic, potential=rest, constraints=(unit,))
    found = lowered(body, BODY).equations
    assert found.form == "d'Alembert's principle"
    assert found.program.operations < 800
    pendulum = lowered(jl.System(double_pendulum, names[:2]), BODY)
    assert pendulum.equations.form != "d'Alembert's principle"


@pytest.mark.full
def test_inertia_is_used_from_one_side():
    """w.Iw with a traced I: the same operations as with known numbers."""

    def operations(inertia):
        def L(t, q, v, params):
            def pose(t, q, params):
                return about_z(q[0]) @ about_x(q[1]) @ about_y(q[2]), jnp.zeros(3)

            given = params if inertia is None else inertia
            return jl.energy.RigidBody(1.0, given).kinetic(pose, t, q, v, params)

        system = jl.System(L, ("a", "b", "c"))
        scene = read_scene(key_of(system._terms, jnp.zeros(3), BODY["I"], {}, None))
        residues = Residues()
        M, h = principle_of_dalembert(scene, scene.lagrangian, residues)
        return assemble(scene.graph, merged(scene.graph, flat(M, h), residues)).operations

    assert operations(None) <= operations(np.asarray(BODY["I"]))
