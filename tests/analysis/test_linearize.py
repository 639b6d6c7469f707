"""Linearization in minimal coordinates: columns by differences on the constraints, closed forms."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

G = 9.81


class Scene(NamedTuple):
    """A system, params, inputs and a guess of a state."""

    system: jl.System
    params: dict
    inputs: dict
    q: list
    v: list


def skate_with_pendulum():
    """A skate on a belt of growing speed, from which a pendulum hangs by two equal rods.

    Holonomic rows, one of them redundant, and a Pfaffian row that depends on time.
    """

    def lagrangian(t, q, v, p):
        skate = 0.5 * p["m"] * (v[0] ** 2 + v[1] ** 2) + 0.5 * p["I"] * v[2] ** 2
        return skate + 0.5 * (v[3:] @ v[3:]) - G * q[5] - 0.3 * q[0] ** 2

    def rods(t, q, p):
        r = q[3:] - jnp.stack([q[0], q[1], 1.0 + 0.1 * t])
        return jnp.stack([r @ r - p["l"] ** 2, 2.0 * jnp.sqrt(r @ r) - 2.0 * p["l"]])

    def edge(t, q, v, p):
        return -jnp.sin(q[2]) * (v[0] - 0.2 * t) + jnp.cos(q[2]) * v[1]

    def push(t, q, v, p, inputs):
        turned = jnp.stack([jnp.cos(q[2]), jnp.sin(q[2]), 0.2 * v[0]])
        return jnp.concatenate([turned * inputs["thrust"], -p["c"] * v[3:]]) + inputs["load"]

    names = {"x": (), "y": (), "psi": (), "r": (3,)}
    rows = jl.Holonomic(rods, "rod"), jl.Pfaffian(edge, "edge")
    system = jl.System(
        lagrangian, names, forces=[jl.GeneralizedForce(push, "push")], constraints=rows
    )
    params = {"m": 2.0, "I": 0.3, "l": 0.8, "c": 0.1}
    inputs = {"thrust": 0.7, "load": jnp.linspace(0.0, 0.5, 6)}
    return Scene(
        system, params, inputs, [0.1, -0.2, 0.4, 0.5, 0.1, 0.4], [0.5, 0.1, 0.3, 0.2, -0.1, 0.1]
    )


def sleigh(quasi=True):
    """Chaplygin's sleigh: forward speed and turning rate as quasi-velocities, or an edge row."""

    def lagrangian(t, q, v, p):
        spin = jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2])]) * p["a"] * v[2]
        centre = v[:2] + spin
        return 0.5 * p["m"] * centre @ centre + 0.5 * p["I"] * v[2] ** 2

    def along(t, q, v, p):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        return jnp.stack([c * v[0] + s * v[1], v[2], -s * v[0] + c * v[1]])

    names, params = ("x", "y", "psi"), {"m": 1.5, "I": 0.2, "a": 0.4}
    if quasi:
        kinds = {"quasi": jl.QuasiVelocities(along, ("forward", "turn", "side"), ("side",))}
    else:
        edge = jl.Pfaffian(lambda t, q, v, p: along(t, q, v, p)[2], "side")
        kinds = {"constraints": (edge,)}
    v = [0.9 * np.cos(0.3), 0.9 * np.sin(0.3), 0.0]
    return Scene(jl.System(lagrangian, names, **kinds), params, {}, [0.2, -0.1, 0.3], v)


SKATE, T = skate_with_pendulum(), 0.3


@pytest.fixture(scope="module")
def skate():
    """The state and its linearization with all outputs."""
    at = jl.assemble(SKATE.system, SKATE.q, SKATE.v, SKATE.params, t=T)
    outputs = ("r", "psi'", "rod", "edge", lambda t, q, v, params: params["l"] * q[3] * v[0])
    return at, jl.linearize(
        SKATE.system, at.q, at.v, SKATE.params, t=T, inputs=SKATE.inputs, outputs=outputs
    )


def moved(scene, states, at, t, x):
    """The state on the constraints whose independent entries differ by x."""
    labels = scene.system.coordinates.labels
    q, v = at.q, at.v
    for name, change in zip(states, x, strict=True):
        i = labels.index(name.rstrip("'"))
        q, v = (q, v.at[i].add(change)) if name.endswith("'") else (q.at[i].add(change), v)
    return jl.assemble(scene.system, q, v, scene.params, t=t, hold=states)


@pytest.mark.full
def test_columns_are_differences_along_the_constraints(skate):
    """Central differences of accelerations and multipliers of assembled states."""
    at, linear = skate
    scene, k, h = SKATE, len(linear.states), 1e-5
    places = [scene.system.coordinates.labels.index(name.rstrip("'")) for name in linear.states]
    rates = [name.endswith("'") for name in linear.states]

    def everything(state, inputs):
        given = state.q, state.v, scene.params
        a = scene.system.acceleration(*given, t=T, inputs=inputs)
        lam = scene.system.multipliers(*given, t=T, inputs=inputs)
        found = [a[i] if rate else state.v[i] for i, rate in zip(places, rates, strict=True)]
        product = scene.params["l"] * state.q[3] * state.v[0]
        seen = [state.q[3:], state.v[2:3], lam["rod"], lam["edge"][None], product[None]]
        return jnp.stack(found), jnp.concatenate(seen)

    slopes, seen = [], []
    for j in range(k):
        x = h * np.eye(k)[j]
        ends = [
            everything(moved(scene, linear.states, at, T, s * x), scene.inputs) for s in (1, -1)
        ]
        (a, y), (b, z) = ends
        slopes.append((a - b) / (2 * h))
        seen.append((y - z) / (2 * h))
    allowed = 1e-8 * float(jnp.max(jnp.abs(linear.A)))
    np.testing.assert_allclose(linear.A, np.stack(slopes, axis=1), atol=allowed)
    np.testing.assert_allclose(linear.C, np.stack(seen, axis=1), atol=50 * allowed)
    f0, y0 = everything(at, scene.inputs)
    np.testing.assert_allclose(linear.f0, f0, atol=1e-13)
    np.testing.assert_allclose(linear.y0, y0, atol=1e-12)


@pytest.mark.full
def test_columns_of_inputs_are_exact_as_forces_are_linear_in_them(skate):
    at, linear = skate
    assert linear.inputs == ("thrust", *(f"load[{i}]" for i in range(6)))
    given, labels = (at.q, at.v, SKATE.params), SKATE.system.coordinates.labels
    a = SKATE.system.acceleration(*given, t=T, inputs=SKATE.inputs)
    more = SKATE.inputs | {"thrust": 1.7}
    change = SKATE.system.acceleration(*given, t=T, inputs=more) - a
    of = [change[labels.index(name[:-1])] if name.endswith("'") else 0.0 for name in linear.states]
    np.testing.assert_allclose(linear.B[:, 0], of, atol=1e-12)
    lam = SKATE.system.multipliers(*given, t=T, inputs=more)
    before = SKATE.system.multipliers(*given, t=T, inputs=SKATE.inputs)
    place = linear.outputs.index("edge")
    np.testing.assert_allclose(linear.D[place, 0], lam["edge"] - before["edge"], atol=1e-12)


def test_the_basis_is_tangent_to_the_constraints(skate):
    """Along its columns all residuals change by second order alone."""
    at, linear = skate
    terms, n = SKATE.system._terms, SKATE.system.size

    def residuals(y):
        return jnp.concatenate(
            [
                terms.position(jnp.array(T), y[:n], SKATE.params),
                terms.velocity(jnp.array(T), y[:n], y[n:], SKATE.params),
            ]
        )

    slopes = jax.jacfwd(residuals)(jnp.concatenate([at.q, at.v])) @ linear.basis
    np.testing.assert_allclose(slopes, 0.0, atol=1e-13)
    assert len(linear.states) == 2 * n - 1 - 2  # a rod and an edge; velocities also the rod


@pytest.mark.full
def test_quasi_velocities_and_rows_give_the_same_motion():
    """A sleigh straight ahead turns back by m a V / (I + m a^2) per s (its centre leads)."""
    found = []
    for quasi in (True, False):
        scene = sleigh(quasi)
        linear = jl.linearize(
            scene.system, scene.q, scene.v, scene.params, outputs=("x", "y", "psi", "psi'")
        )
        if quasi:
            assert linear.states == ("x", "y", "psi", "forward", "turn")
        A, C = np.asarray(linear.A), np.asarray(linear.C)
        p, damped = scene.params, np.linalg.eigvals(A)
        rate = p["m"] * p["a"] * 0.9 / (p["I"] + p["m"] * p["a"] ** 2)
        np.testing.assert_allclose(damped[np.argmax(np.abs(damped))], -rate, rtol=1e-12)
        # Responses of the outputs to a push on the nose, free of the choice of states.
        push = np.linalg.pinv(C) @ np.array([0.0, 0.0, 0.0, 1.0])
        found.append(np.stack([C @ np.linalg.matrix_power(A, k) @ push for k in range(4)]))
    np.testing.assert_allclose(found[0], found[1], atol=1e-12)


def pendulum(t, q, v, p):
    return 0.5 * p["m"] * v @ v - p["m"] * G * q[1]


HANGING = jl.System(
    pendulum, ("x", "y"), constraints=(jl.Holonomic(lambda t, q, p: q @ q - p["l"] ** 2, "rod"),)
)


@pytest.mark.full
def test_derivatives_with_respect_to_params_and_the_point():
    """A pendulum at the angle s: theta'' = -g sin(theta)/l, in x = l sin(theta)."""
    names = ("x", "x'")

    def frequency(length, s):
        q = length * jnp.stack([jnp.sin(s), -jnp.cos(s)])
        params = {"m": 1.3, "l": length}
        linear = jl.linearize(HANGING, q, jnp.zeros(2), params, independent=names)
        return linear.A[1, 0]

    def expected(length, s):  # of x'' = -(g/l) sin(theta) cos(theta), dx = l cos(theta) dtheta
        return -G / length * jnp.cos(2.0 * s) / jnp.cos(s)

    at = jnp.array(0.7), jnp.array(0.4)
    np.testing.assert_allclose(frequency(*at), expected(*at), rtol=1e-12)
    for modes in (jax.jacfwd, jax.jacrev):
        found = modes(frequency, (0, 1))(*at)
        np.testing.assert_allclose(found, jax.grad(expected, (0, 1))(*at), rtol=1e-11)
    lengths = jnp.linspace(0.5, 1.0, 3)
    batch = jax.vmap(lambda x: frequency(x, 0.4))(lengths)
    np.testing.assert_allclose(batch, expected(lengths, 0.4), rtol=1e-12)


def test_feedback_closes_the_loop_and_states_follow():
    """A motor with an electrical time constant and a spring by feedback, against its matrix."""

    def current(t, q, v, x, p, inputs):
        return (inputs["voltage"] - p["R"] * x - p["k"] * v) / p["L"]

    def torque(t, q, v, p, inputs):
        return (p["k"] * inputs["current"] + inputs["spring"])[None]

    motor = jl.System(
        lambda t, q, v, p: 0.5 * p["J"] * v[0] ** 2,
        ("angle",),
        forces=[jl.GeneralizedForce(torque, "motor")],
        states=jl.States(current, ("current",)),
    )
    p = {"R": 1.0, "k": 0.1, "L": 0.01, "J": 1e-4}
    spring = jl.Feedback(lambda t, q, v, p: -0.02 * q[0])
    inputs = {"voltage": 2.0, "spring": spring, "current": 0.5}
    linear = jl.linearize(motor, [0.3], [1.0], p, inputs=inputs, outputs={"amps": "current"})
    assert linear.states == ("angle", "angle'", "current")
    assert (linear.inputs, linear.outputs) == (("voltage",), ("amps",))
    A = [[0, 1, 0], [-0.02 / 1e-4, 0, 0.1 / 1e-4], [0, -0.1 / 0.01, -1.0 / 0.01]]
    np.testing.assert_allclose(linear.A, A, rtol=1e-14)
    np.testing.assert_allclose(linear.B, [[0.0], [0.0], [100.0]], rtol=1e-14)
    np.testing.assert_allclose(linear.C, [[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(linear.f0, [1.0, 440.0, 140.0], rtol=1e-14)
    np.testing.assert_allclose(linear.y0, [0.5])


@pytest.mark.full
def test_cyclic_coordinates_are_dropped_and_others_refused():
    scene = sleigh()
    free = jl.System(lambda t, q, v, p: 0.5 * v @ v - q[1] ** 2, {"x": (), "z": ()}, constraints=())
    linear = jl.linearize(free, [0.0, 0.1], [1.0, 0.0], None, drop=("x",))
    assert linear.states == ("z", "x'", "z'")
    np.testing.assert_allclose(linear.A, [[0, 0, 1], [0, 0, 0], [-2, 0, 0]])
    with pytest.raises(ValueError, match=r"must leave the others unaffected.*\"z'\" depends"):
        jl.linearize(free, [0.0, 0.1], [1.0, 0.0], None, drop=("z",))
    with pytest.raises(ValueError, match=r"'x' depends on 'psi' by .* Keep 'psi', or drop 'x'"):
        jl.linearize(scene.system, scene.q, scene.v, scene.params, drop=("psi",))
    with pytest.raises(ValueError, match=r"must name states among \['x', .*one was 'w'"):
        jl.linearize(free, [0.0, 0.1], [1.0, 0.0], None, drop=("w",))


LOW = [0.0, -0.7], [0.0, 0.0], {"m": 1.0, "l": 0.7}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"q": [0.0, np.nan]}, r"`q` must be finite"),
        ({"inputs": ("thrust",)}, r"hold only signals that a declared function reads.*'thrust'"),
        ({"inputs": "thrust"}, r"`inputs` must be a sequence of names"),
    ],
)
def test_bad_input_is_refused(change, text):
    q, v, params = LOW
    given = {"system": HANGING, "q": q, "v": v, "params": params} | change
    with pytest.raises(ValueError, match=text):
        jl.linearize(**given)


def test_the_order_of_the_arguments_is_told():
    q, v, params = LOW
    with pytest.raises(ValueError, match=r"`linearize` must get t, inputs.* by name"):
        jl.linearize(HANGING, 0.0, q, v, params)


def test_arrays_as_inputs_need_their_values():
    def push(t, q, v, p, inputs):
        return inputs["load"][:2]

    free = jl.System(
        lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), forces=[jl.GeneralizedForce(push, "push")]
    )
    with pytest.raises(ValueError, match="params") as caught:
        jl.linearize(free, [0.0, 0.0], [0.0, 0.0], inputs=("load",))
    assert any("Give arrays as a dict" in note for note in caught.value.__notes__)
    assert jl.linearize(free, [0.0, 0.0], [0.0, 0.0], inputs={"load": np.ones(2)}).B.shape == (4, 2)


def test_quasi_velocities_that_do_not_determine_the_velocities_are_named():
    quasi = jl.QuasiVelocities(
        lambda t, q, v, p: jnp.stack([v[0] * jnp.cos(q[1]), v[1]]), ("turn", "u")
    )
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), quasi=quasi)
    with pytest.raises(ValueError, match=r"determine the velocities, but 'turn' depended on"):
        jl.linearize(system, [0.0, np.pi / 2], [0.0, 0.0])


def test_a_singular_mass_is_named():
    flat = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - q[1] ** 2, ("x", "y"))
    with pytest.raises(ValueError, match=r"must be a regular point, but .* not finite"):
        jl.linearize(flat, [0.1, 0.2], [0.0, 0.0])


def test_traced_velocities_need_none():
    """The rows depend on t, q and params alone."""
    q, _, params = LOW
    speeds = jnp.array([[0.1, 0.0], [0.7, 0.0]])
    expected = -(G + speeds[:, 0] ** 2 / 0.7) / 0.7

    def of(v):
        return jl.linearize(HANGING, q, v, params).A[1, 0]

    np.testing.assert_allclose(jax.vmap(of)(speeds), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(of)(speeds[0]), expected[0], rtol=1e-12)


def test_states_in_single_precision_have_matrices_in_single_precision():
    q, v, params = LOW
    params = {name: np.float32(x) for name, x in params.items()}
    linear = jl.linearize(HANGING, np.array(q, np.float32), np.array(v, np.float32), params)
    assert {x.dtype for x in jax.tree.leaves(linear)} == {np.dtype(np.float32)}
    np.testing.assert_allclose(linear.A, [[0.0, 1.0], [-G / 0.7, 0.0]], rtol=1e-6)


@pytest.mark.full
def test_forces_that_read_multipliers_in_quasi_velocities():
    """Friction on a floor, by its row alone and in u = 2 x'."""

    def friction(t, q, v, p, lam):
        return jnp.stack([-0.3 * lam["floor"] * jnp.tanh(v[0] / 0.1), 0.0 * q[0]])

    kinds = {
        "forces": [jl.GeneralizedForce(friction, "friction", reaction=True)],
        "constraints": (jl.Holonomic(lambda t, q, p: q[1] - 0.1 * q[0] ** 2, "floor"),),
    }
    quasi = jl.QuasiVelocities(
        lambda t, q, v, p: jnp.stack([2.0 * v[0], v[1] - 0.2 * q[0] * v[0]]), ("u", "w"), ("w",)
    )
    at = [0.5, 0.025], [0.05, 0.005]
    lagrangian, names = lambda t, q, v, p: 0.5 * v @ v - G * q[1], ("x", "y")
    rows = jl.linearize(
        jl.System(lagrangian, names, **kinds), *at, independent=("x", "x'"), outputs=("floor",)
    )
    both = jl.System(lagrangian, names, quasi=quasi, **kinds)
    found = jl.linearize(both, *at, independent=("x",), outputs=("floor",))
    assert found.states == ("x", "u")
    units = np.array([1.0, 2.0])
    size = float(np.max(np.abs(rows.A)))
    np.testing.assert_allclose(found.A / units[:, None] * units, rows.A, atol=1e-14 * size)
    np.testing.assert_allclose(found.f0 / units, rows.f0, atol=1e-14)
    np.testing.assert_allclose(found.C * units, rows.C, atol=1e-13 * float(np.max(np.abs(rows.C))))
    np.testing.assert_allclose(found.y0, rows.y0, rtol=1e-14)
