"""The check of the scalar program against the array program: states compared, errors found."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _lowered import lowered
from _scenes import case

import jaxlag as jl
from bench._problems.scenes import SCENES, links
from jaxlag._lowering import _lower
from systems import lamina_on_parabola, rigid_aircraft

EPS = np.finfo(float).eps


@pytest.mark.parametrize("mass", [np.nan, 0.0])
def test_invalid_params_at_first_use_have_no_effect(mass):
    """A program is made for all params of these shapes, whichever come first."""
    system = jl.System(lambda t, q, v, p: 0.5 * p["m"] * v @ v + jnp.cos(q[0]), ("x",))
    found = lowered(system, {"m": mass})
    assert found.equations is not None
    assert found.reason.startswith("equal to the array program at ")
    np.testing.assert_allclose(
        system.acceleration([0.5], [0.0], {"m": 2.0}), -0.5 * np.sin([0.5]), rtol=4 * EPS
    )


def test_program_right_only_for_given_params_is_not_used(monkeypatch):
    """Wrong for k other than 1: random params show it."""
    derive = _lower.derive

    def wrong(scene, *rest):
        (right, form), graph = derive(scene, *rest), scene.graph
        k = graph.input("params", 0)
        return right._replace(accelerations=[graph.mul(x, k) for x in right.accelerations]), form

    monkeypatch.setattr(_lower, "derive", wrong)
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - p["k"] * jnp.cos(q[0]), ("x",))
    assert "differs from the array program" in lowered(system, {"k": 1.0}).reason


def test_program_finite_where_the_array_program_is_nan_is_not_used(monkeypatch):
    derive = _lower.derive

    def wrong(scene, *rest):
        right, form = derive(scene, *rest)
        return right._replace(accelerations=[scene.graph.one]), form

    monkeypatch.setattr(_lower, "derive", wrong)
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - jnp.sqrt(q[0] - 9.0), ("x",))
    assert "only one of them is finite" in lowered(system).reason


def test_too_few_finite_states_select_the_array_program():
    """L is finite only near a state that random ones miss."""
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - jnp.sqrt(q[0] - 9.0), ("x",))
    assert "only 0 of 32 random states" in lowered(system).reason
    a = system.acceleration([11.0], [0.0])
    np.testing.assert_allclose(a, [-0.5 / np.sqrt(2.0)], rtol=4 * EPS)


@pytest.mark.parametrize(
    ("lagrangian", "n"),
    [
        (lambda t, q, v, p: 0.5 * v[0] ** 2 - q @ q, 2),
        (lambda t, q, v, p: 0.5 * v[0] ** 2 + 0.5 * (v[1] + v[2]) ** 2 - q @ q, 3),
    ],
)
def test_coordinate_without_inertia_makes_accelerations_nan(lagrangian, n):
    """M is singular everywhere: M and h are compared instead of the acceleration."""
    system = jl.System(lagrangian, {"x": (n,)})
    assert lowered(system).reason == "equal to the array program at 8 random states"
    assert np.all(np.isnan(system.acceleration(np.ones(n), np.zeros(n))))


SHAPES = {
    "coordinates": {},
    "quasi-velocities": {
        "quasi": jl.QuasiVelocities(
            lambda t, q, v, p: jnp.stack([v[0] + jnp.sin(q[1]) * v[1], 2.0 * v[1]]), ("u", "w")
        )
    },
    "constraint": {"constraints": (jl.Holonomic(lambda t, q, p: q[0] - q[1] ** 2, "on"),)},
}


def _off(entries, graph):
    """The last entry off by 1e-9."""
    *others, last = entries
    if isinstance(last, list):
        return [*others, _off(last, graph)]
    return [*others, graph.scale(last, 1.0 + 1e-9)]


def _wrong_terms(derived, part, graph):
    """All forms of the terms with an error in one part."""

    def wrong(form):
        if part == "rows":
            return form._replace(rows=form.rows._replace(A=_off(form.rows.A, graph)))
        part_of = {"mass": "M", "bias": "h"}[part]
        return form._replace(**{part_of: _off(getattr(form, part_of), graph)})

    return derived._replace(forms=[wrong(form) for form in derived.forms])


def _wrong_rates(equations, part, graph):
    """Equations in quasi-velocities with an error in one part."""
    if part == "accelerations":  # the velocities come first
        v, others = equations.accelerations[:2], equations.accelerations[2:]
        return equations._replace(accelerations=[*_off(v, graph), *others])
    return equations._replace(**{part: _off(getattr(equations, part), graph)})


@pytest.mark.full
@pytest.mark.parametrize(
    ("shape", "part"),
    [
        *((shape, part) for shape in SHAPES for part in (None, "mass", "bias")),
        ("quasi-velocities", "accelerations"),
        ("constraint", "rows"),
    ],
)
def test_an_indefinite_mass_is_compared_by_its_parts(shape, part, monkeypatch):
    """M is indefinite at every state for these params; an error of 1e-9 in any part is found."""

    def lagrangian(t, q, v, p):
        return 0.5 * (v[0] ** 2 - p["m"] * (1.0 + q[0] ** 2) * v[1] ** 2) - q @ q

    derive, derivation = _lower.derive, _lower.derivation

    def wrong_rates(scene, *rest):
        equations, form = derive(scene, *rest)
        return _wrong_rates(equations, part, scene.graph), form

    def wrong_terms(scene, *rest):
        return _wrong_terms(derivation(scene, *rest), part, scene.graph)

    if part is not None and shape == "quasi-velocities":
        monkeypatch.setattr(_lower, "derive", wrong_rates)
    elif part is not None:
        monkeypatch.setattr(_lower, "derivation", wrong_terms)
    found = lowered(jl.System(lagrangian, ("x", "y"), **SHAPES[shape]), {"m": 2.0})
    assert (found.equations is None) == (part is not None)
    assert found.reason.startswith("equal to" if part is None else "differs from")


@pytest.mark.parametrize("part", ["position", "velocity", "force"])
def test_an_error_of_1e_9_in_a_residual_or_force_is_found(part, monkeypatch):
    """phi does not enter accelerations, but starts and projections."""
    read, with_forces = _lower.read_scene, _lower.with_forces

    def wrong_rows(key):
        scene = read(key)
        off = _off(getattr(scene.constrained, part), scene.graph)
        return scene._replace(constrained=scene.constrained._replace(**{part: off}))

    def wrong_force(scene, key):
        scene = with_forces(scene, key)
        return scene._replace(force=_off(scene.force, scene.graph))

    if part == "force":
        monkeypatch.setattr(_lower, "with_forces", wrong_force)
    else:
        monkeypatch.setattr(_lower, "read_scene", wrong_rows)
    drag = jl.GeneralizedForce(lambda t, q, v, p: -0.1 * v * (1.0 + q**2), "drag")
    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v - q @ q, ("x", "y"), forces=(drag,), **SHAPES["constraint"]
    )
    found = lowered(system)
    assert found.equations is None
    assert found.reason.startswith("differs from")


@pytest.mark.full
@pytest.mark.parametrize("module", [rigid_aircraft, lamina_on_parabola], ids=["u", "constraint"])
def test_traced_params_have_a_scalar_program(module):
    """Random params are not inertias of a body; under jit over params a scalar program is used."""
    found = []
    params = jax.tree.map(jnp.asarray, dict(module.entry.example.params))
    jax.eval_shape(lambda params: found.append(lowered(module.system, params)), params)
    assert found[0].reason.startswith("equal to")


# ---- The comparison before use -------------------------------------------------------------------


def test_a_program_that_differs_is_not_used(monkeypatch):
    """One sign of h is flipped: the reason states the difference, and the array program is used."""
    derive = _lower.derive

    def wrong(scene, *rest):
        right, form = derive(scene, *rest)
        flipped = [scene.graph.scale(x, -1.0) for x in right.accelerations]
        return right._replace(accelerations=flipped), form

    monkeypatch.setattr(_lower, "derive", wrong)
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - p["k"] * jnp.cos(q[0]), ("x",))
    assert "differs from the array program" in system.explain({"k": 2.0})
    a = system.acceleration([0.5], [0.0], {"k": 2.0})
    np.testing.assert_allclose(a, 2.0 * np.sin([0.5]), rtol=4 * EPS)


def test_a_program_that_gives_nan_is_not_used(monkeypatch):
    """Where the array program is finite; comparisons with nan are False."""
    derive = _lower.derive

    def wrong(scene, *rest):
        right, form = derive(scene, *rest)
        return right._replace(accelerations=[scene.graph.const(np.nan)]), form

    monkeypatch.setattr(_lower, "derive", wrong)
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - p["k"] * jnp.sin(q[0]), ("x",))
    assert "differs from the array program" in system.explain({"k": 2.0})


def test_constrained_states_of_indefinite_mass_are_not_compared():
    """Known params besides random ones, for which M may be indefinite on the constraints."""

    def lagrangian(t, q, v, params):
        return 0.5 * ((params["I"] - params["m"]) * v[0] ** 2 + v[1] ** 2) - q[0] * q[1]

    row = jl.Holonomic(lambda t, q, p: q[1] - p["a"] * q[0] ** 2, ("parabola",))
    system = jl.System(lagrangian, ("x", "y"), constraints=(row,))
    assert "scalar program" in system.explain({"I": 9.0, "m": 1.0, "a": 0.2})


def test_a_motion_is_compared_with_its_params():
    """L is finite for none of the random params, which lie between 0.5 and 1.5."""
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - jnp.sqrt(p["k"] - 9.0) * q[0], ("x",))
    params = {"k": 13.0}
    motion = jl.simulate(system, [0.0], [0.0], [0.0, 1.0], params)
    np.testing.assert_allclose(motion["x"][-1], -1.0, rtol=1e-12)
    assert "equal to the array program at 8 random states" in system.explain(params)


@pytest.mark.full
def test_given_params_are_compared():
    """An inertia that random params would make indefinite."""
    declared, params, q0, _ = case("lamina_two_forces_fixed_direction")

    def fresh():
        def lagrangian(t, q, v, params):
            return declared.lagrangian(t, q, v, params)

        return jl.System(lagrangian, declared.coordinates.shapes)

    assert "equal to the array program at 12 random states" in fresh().explain(params)
    simulated = fresh()
    jl.simulate(simulated, q0, np.zeros(3), [0.0, 0.1], params)
    assert "equal to the array program at 12 random states" in simulated.explain(params)


@pytest.mark.full
def test_too_many_operations_select_the_array_program():
    scene = SCENES["chain_8"]
    names = {"q": (8,)}
    short = jl.System(scene.lagrangian, names)
    assert "scalar program" in short.explain(dict(scene.params))
    long = links(16)
    system = jl.System(long.lagrangian, {"q": (16,)})
    assert "array program (at least 1840 operations, more than 1500)" in system.explain(
        dict(long.params)
    )


def test_invalid_lowering_is_refused():
    with pytest.raises(
        ValueError, match=r"^`lowering` must be 'auto', 'scalar' or 'array', but it"
    ):
        jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x",), lowering="fast")
