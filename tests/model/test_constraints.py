"""Declared constraints: rows, names and derivatives, and declarations that are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _systems.mechanisms import (
    BOBS,
    FOUR_BAR,
    LED,
    SKATE,
    bobs,
    cartesian,
    closure,
    double_pendulum,
    four_bar,
    led_pendulum,
    led_start,
    rods,
    skate,
    skate_lagrangian,
)
from _user import unchecked  # noqa: F401

import jaxlag as jl
from jaxlag._lowering._row_layout import layout

EPS = np.finfo(float).eps


def random_state(n, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.array(rng.uniform(-1, 1, n)), jnp.array(rng.uniform(-1, 1, n))


def test_rows_of_position_residuals_equal_closed_forms():
    """A = d phi/dq, b = d phi/dt, gamma = second derivative along the motion at a = 0."""
    q, v = random_state(3)
    t, X, w = jnp.array(0.4), LED["X"], LED["Omega"]
    A, b = led_pendulum._terms.rows(t, q, v, LED)
    np.testing.assert_allclose(A, [[1, 0, -np.cos(q[2])], [0, 1, -np.sin(q[2])]], atol=EPS)
    np.testing.assert_allclose(b, [-X * w * np.cos(w * t), 0], atol=2 * EPS)
    gamma = led_pendulum._terms.gamma(t, q, v, LED)
    spin = v[2] ** 2
    expected = [X * w**2 * np.sin(w * t) + spin * np.sin(q[2]), -spin * np.cos(q[2])]
    np.testing.assert_allclose(gamma, expected, atol=8 * EPS)


def test_rows_of_velocity_residuals_equal_closed_forms():
    q, v = random_state(3)
    t = jnp.array(0.0)
    A, b = skate._terms.rows(t, q, v, SKATE)
    np.testing.assert_allclose(A, [[-np.sin(q[2]), np.cos(q[2]), 0]], atol=EPS)
    assert b == 0
    gamma = skate._terms.gamma(t, q, v, SKATE)
    expected = -(np.cos(q[2]) * v[0] + np.sin(q[2]) * v[1]) * v[2]
    np.testing.assert_allclose(gamma, [expected], atol=4 * EPS)


def test_accelerations_satisfy_the_constraints():
    """A a + gamma = 0 and M a + h = Q + A^T lam, also at states off the constraints."""
    q, v = random_state(4, 1)
    t = jnp.array(0.0)
    a = cartesian.acceleration(q, v, BOBS)
    lam = cartesian.multipliers(q, v, BOBS)
    A, _ = cartesian._terms.rows(t, q, v, BOBS)
    gamma = cartesian._terms.gamma(t, q, v, BOBS)
    size = np.linalg.cond(A) * np.abs(gamma).max()
    np.testing.assert_allclose(A @ a, -gamma, atol=50 * EPS * size)
    force = jnp.stack([lam["rod1"], lam["rod2"]]) @ A
    np.testing.assert_allclose(force, cartesian.constraint_force(q, v, BOBS), atol=8 * EPS * size)
    left = cartesian.mass_matrix(q, params=BOBS) @ a + cartesian.bias(q, v, BOBS)
    np.testing.assert_allclose(left, force, atol=50 * EPS * size)


def test_multipliers_have_the_shape_of_the_residual():
    """A constraint with one name has multipliers in the shape of its residual."""
    q, v = led_start()
    lam = led_pendulum.multipliers(q, v, LED)
    assert list(lam) == ["pin"]
    a = led_pendulum.acceleration(q, v, LED)
    # Newton: the force at the pin is m (a - g) of the mass center.
    expected = LED["m"] * (a[:2] - jnp.array([0.0, -9.81]))
    np.testing.assert_allclose(lam["pin"], expected, rtol=1e-14)


def test_residuals_and_rows_have_declared_names():
    q, v = random_state(4)
    position, velocity = cartesian.residuals(q, v, BOBS)
    assert list(position) == list(velocity) == ["rod1", "rod2"]
    np.testing.assert_allclose(jnp.stack(list(position.values())), rods(0.0, q, BOBS))
    position, velocity = skate.residuals(*random_state(3), SKATE)
    assert position == {}
    assert list(velocity) == ["edge"]
    mixed = jl.System(
        skate_lagrangian,
        ("x", "y", "theta"),
        constraints=(
            jl.Pfaffian(lambda t, q, v, params: v[:1], "slot"),
            jl.Holonomic(lambda t, q, params: q[1:] - t, ("wall", "turn")),
        ),
    )
    rows = mixed._rows(SKATE, jnp.dtype(float))
    assert rows.labels == ("slot[0]", "wall", "turn")
    assert rows.holonomic == (False, True, True)
    assert rows.driven_names == ("wall", "turn")
    assert rows.shapes == (("slot", (1,)), ("wall", ()), ("turn", ()))
    np.testing.assert_array_equal(rows.of_all(jnp.array([3.0, 4.0])), [0, 3, 4])


@pytest.mark.full
def test_four_bar_constraint_forces_do_no_work():
    """Constraint forces do no work: power balance through the loop."""
    q = jl.assemble(four_bar, [1.0, 0.4, -1.8], [0.5, 0, 0], FOUR_BAR, hold=("crank", "crank'"))
    force = four_bar.constraint_force(q.q, q.v, FOUR_BAR)
    assert abs(force @ q.v) <= 50 * EPS * np.linalg.norm(force) * np.linalg.norm(q.v)


# ---- Declarations that are refused ---------------------------------------------------------------


def declared(*constraints, forces=()):
    return jl.System(bobs, ("x1", "y1", "x2", "y2"), constraints=constraints, forces=forces)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jl.Holonomic(3.0, "rod"), r"'rod': `phi` must be a function of \(t, q, params\)"),
        (lambda: jl.Holonomic(lambda q: q, "rod"), r"'rod': `phi` must be callable as"),
        (lambda: jl.Pfaffian(lambda t, q, params: q, "e"), r"'e': `residual` must be callable as"),
        (lambda: jl.Holonomic(rods, ""), "Holonomic: `names` must be non-empty strings"),
        (lambda: jl.Holonomic(rods, ()), "Holonomic: `names` must be a name or a sequence"),
        (lambda: jl.Holonomic(rods, (1, 2)), "Holonomic: `names` must be non-empty strings"),
        (
            lambda: jl.Holonomic(rods, ("rod1", "explicit time")),
            "Holonomic: `names` must not contain the name of the power of explicit time, but one",
        ),
        (
            lambda: jl.Pfaffian(lambda t, q, v, params: v, "explicit time"),
            "Pfaffian: `names` must not contain the name of the power of explicit time, but one",
        ),
        (
            lambda: jl.Baumgarte(-1.0, 1.0),
            "Baumgarte: `alpha` must be a number that is not negative",
        ),
        (lambda: declared(rods), "`constraints` must contain Holonomic and Pfaffian objects"),
        (
            lambda: jl.System(bobs, ("x",), constraints=jl.Holonomic(rods, "rod")),
            "`constraints` must be a sequence, but it was a single constraint",
        ),
        (
            lambda: declared(jl.Holonomic(rods, ("a", "b")), jl.Holonomic(rods, ("c", "a"))),
            "`constraints` must have distinct names, but 'a' occurs 2 times",
        ),
        (
            lambda: declared(
                jl.Holonomic(rods, ("a", "b")),
                forces=(jl.GeneralizedForce(lambda t, q, v, params: q, "a"),),
            ),
            "`constraints` must have names that no force has, but 'a'",
        ),
        (
            lambda: declared(
                forces=(jl.GeneralizedForce(lambda t, q, v, params, lam: q, "f", reaction=True),)
            ),
            "force 'f' must belong to a system with constraints if it reads lam",
        ),
        (
            lambda: jl.GeneralizedForce(lambda t, q, v, params: q, "f", contact="floor"),
            "force 'f': `contact` must be given with reaction=True only, but reaction was False",
        ),
        (
            lambda: declared(
                jl.Holonomic(rods, ("a", "b")),
                forces=(
                    jl.GeneralizedForce(
                        lambda t, q, v, params, lam: q, "f", reaction=True, contact="floor"
                    ),
                ),
            ),
            "force 'f': `contact` must be among",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_declarations_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def solved(q, v):
    """(1 + q q^T)^-1 v, by a factorization without a scalar form."""
    return jnp.linalg.solve(jnp.eye(q.shape[0]) + jnp.outer(q, q), v)


@pytest.mark.parametrize(
    ("phi", "sure"),
    [
        (lambda t, q, p: q @ q - 1.0, True),
        (lambda t, q, p: q[0] - 3.0 * q[1], True),
        (lambda t, q, p: jnp.sin(q[0]) - jnp.sin(q[1] + q[2] ** 2), True),
        (lambda t, q, p: (jnp.sin(q[0]) ** 2 + jnp.cos(q[0]) ** 2 - 1.0) * q[1], False),
        (lambda t, q, p: q[0] * (q[1] + 1.0) - q[0] * q[1] - q[0], False),
        (lambda t, q, p: (0.1 + 0.2 - 0.3) * q[0], False),  # the coefficient is rounding
        (lambda t, q, p: p * q[0], False),
        (lambda t, q, p: t * q[0], False),
        (lambda t, q, p: jnp.maximum(q[0], 0.0), False),
        (lambda t, q, p: 0.0 * q[0], False),
    ],
)
def test_layout_marks_rows_that_cannot_be_rounding(phi, sure):
    """From the program alone; the other rows are decided by their values."""
    assert layout((jl.Holonomic(phi, "a"),), jnp.zeros(()), 3, jnp.float64).sure == (sure,)


def test_row_of_constant_zero_has_no_effect():
    """It is accepted and has no effect; another constant is refused, see above."""
    row = jl.Holonomic(lambda t, q, params: jnp.stack([q[0] - q[1], 0.0 * q[0]]), ("a", "zero"))
    system = declared(row)
    q, v = jnp.zeros(4), jnp.array([1.0, 1.0, 0.5, -0.5])
    without = declared(jl.Holonomic(lambda t, q, params: q[:1] - q[1:2], ("a",)))
    np.testing.assert_allclose(
        system.acceleration(q, v, BOBS), without.acceleration(q, v, BOBS), rtol=1e-12
    )
    assert system.multipliers(q, v, BOBS)["zero"] == 0.0


@pytest.mark.parametrize(
    ("constraint", "message"),
    [
        (
            jl.Pfaffian(lambda t, q, v, params: jnp.stack([v[0] + v[1], v[2] * v[3]]), ("a", "b")),
            "constraint 'b': `residual` must be affine in v",
        ),
        (
            jl.Pfaffian(lambda t, q, v, params: jnp.sqrt(1.0 + v @ v), "speed"),
            "constraint 'speed': `residual` must be affine in v",
        ),
        (
            jl.Pfaffian(lambda t, q, v, params: jnp.maximum(v[0] - 3.0, 0.0) - v[1], "fast"),
            "constraint 'fast': `residual` must be affine in v",
        ),
        (
            jl.Pfaffian(lambda t, q, v, params: jnp.floor(v[0]) - v[1], "steps"),
            "constraint 'steps': `residual` must be affine in v",
        ),
        (
            jl.Pfaffian(lambda t, q, v, params: jnp.where(v[0] > 9.0, 1.0, 0.0) + v[1], "jump"),
            "constraint 'jump': `residual` must be affine in v",
        ),
        (
            jl.Pfaffian(lambda t, q, v, params: solved(q, v)[:2] * v[0], ("a", "b")),
            "constraint 'a', 'b': `residual` must be affine in v, .* contains v in the traced",
        ),
        (
            jl.Holonomic(lambda t, q, params: jnp.stack([q[0], params["l1"]]), ("a", "b")),
            "constraint 'b' must contain a coordinate",
        ),
        (
            jl.Holonomic(lambda t, q, params: t + jnp.linalg.det(jnp.eye(2) * t), "a"),
            "constraint 'a' must contain a coordinate",
        ),
        (jl.Holonomic(lambda t, q, params: rods(t, q, params)[:1], ("a", "b")), "return 2 numbers"),
        (jl.Holonomic(lambda t, q, params: jnp.eye(2), "a"), "return a scalar or a vector"),
        (jl.Holonomic(lambda t, q, params: "q", "a"), "'a': `phi` must return an array"),
        (jl.Holonomic(lambda t, q, params: q[:0], "a"), "have at least one row"),
        (jl.Holonomic(lambda t, q, params: q[:2].astype(int), "a"), "return a scalar or a vector"),
    ],
)
def test_invalid_rows_are_refused_at_first_use(constraint, message):
    system, (q, v) = declared(constraint), random_state(4)
    for use in (
        lambda: system.acceleration(q, v, BOBS),
        lambda: jl.simulate(system, q, v, [0.0, 1.0], BOBS),
        lambda: system.check(q, v, BOBS),
    ):
        with pytest.raises(ValueError, match=message):
            use()


@jax.custom_vjp
def squared(x):
    return x**2


squared.defvjp(lambda x: (x**2, x), lambda x, slope: (2.0 * x * slope,))


@pytest.mark.parametrize(
    "row",
    [
        lambda square: jl.Holonomic(lambda t, q, p: square(q[0]) + q[1] ** 2 - 1.0, "rod"),
        lambda square: jl.Pfaffian(lambda t, q, v, p: square(q[0]) * v[0] + v[1], "rod"),
    ],
)
def test_constraints_with_custom_vjp_rules_have_rates(row):
    """Rates along the motion are forward derivatives: they follow from the rule."""
    q, v = jnp.array([0.6, 0.8]), jnp.array([0.8, -0.6])
    found = []
    for square in (squared, lambda x: x**2):
        system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), constraints=(row(square),))
        found.append(system.acceleration(q, v, {}))
    np.testing.assert_allclose(*found, rtol=1e-14)


@pytest.mark.usefixtures("unchecked")
def test_invalid_options_are_refused():
    mechanism = double_pendulum()
    with pytest.raises(ValueError, match="`formulation` must be among"):
        jl.simulate(*mechanism[:3], [0.0, 1.0], BOBS, formulation="penalty")
    with pytest.raises(
        ValueError, match=r"`stabilization` must be 'projection', None or a jl\.Baumgarte"
    ):
        jl.simulate(*mechanism[:3], [0.0, 1.0], BOBS, stabilization="baumgarte")


def late(t):
    return jnp.maximum(t - 2.0, 0.0) ** 3


@pytest.mark.parametrize(
    ("constraint", "driven"),
    [
        (jl.Holonomic(lambda t, q, p: q[0] - late(t), "led"), [True]),
        (jl.Holonomic(lambda t, q, p: jnp.where(t > 1e4, q[0] - t, q[0]), "led"), [True]),
        (jl.Pfaffian(lambda t, q, v, p: jnp.where(q[0] > 9.0, v[0] - 1.0, v[0]), "led"), [True]),
        (jl.Pfaffian(lambda t, q, v, p: jnp.where(q[0] > 9.0, v[1], v[0]), "edge"), [False]),
        (
            jl.Pfaffian(
                lambda t, q, v, p: jnp.stack(
                    [v[0] - jnp.sin(q[0]) * v[1], v[1] - p["l1"], t * v[0]]
                ),
                ("a", "b", "c"),
            ),
            [False, True, False],
        ),
        # Without a scalar form: b counts as zero only if it certainly does not depend on time.
        (jl.Holonomic(lambda t, q, p: solved(q, q)[:2], "pin"), [False, False]),
        (jl.Holonomic(lambda t, q, p: solved(q, q)[0] - late(t), "led"), [True]),
        (jl.Pfaffian(lambda t, q, v, p: solved(q, v)[0] - late(t), "led"), [True]),
        (jl.Pfaffian(lambda t, q, v, p: jnp.sum(p["W"] @ v), "wide"), [True]),
    ],
)
def test_driven_rows_are_those_that_may_do_work(constraint, driven):
    """Wherever b differs from zero, even far from usual states."""
    n = 150 if constraint.names == "wide" else 4
    params = {**BOBS, "W": jnp.ones((n, n))}
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, {"x": (n,)}, constraints=(constraint,))
    assert system._rows(params, jnp.dtype(float)).driven == tuple(driven)


def test_power_of_a_row_that_moves_late():
    """x follows (t - 2)^3 with unit mass: power = 3 (t - 2)^2 6 (t - 2)."""
    led = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y"),
        constraints=(jl.Holonomic(lambda t, q, params: q[0] - late(t), "led"),),
    )
    power = led.power([0.125, 0.0], [0.75, 1.0], t=2.5)
    assert list(power) == ["led"]
    np.testing.assert_allclose(power["led"], 2.25, rtol=8 * EPS)


def test_a_row_may_read_its_coordinates_in_far_states_only():
    constraint = jl.Holonomic(lambda t, q, p: jnp.where(q[0] > 20.0, q[0] * q[1], 1.0), "far")
    system = declared(constraint)
    q, v = random_state(4)
    assert system._rows(BOBS, jnp.dtype(float)).labels == ("far",)
    _, velocity = system.residuals(q.at[0].set(30.0), v, BOBS)
    np.testing.assert_allclose(velocity["far"], 30.0 * v[1] + v[0] * q[1], rtol=4 * EPS)


def test_rows_may_close_over_traced_values():
    def found(x):
        system = declared(
            jl.Holonomic(lambda t, q, p: q[0] - x, "wall"),
            jl.Pfaffian(lambda t, q, v, p: v[1] - x, "belt"),
        )
        assert system._rows(BOBS, jnp.dtype(float)).driven_names == ("belt",)
        return x

    jax.jit(found)(1.0)


def test_row_structure_ignores_values_of_params():
    """A row whose amplitude is zero here still depends on time."""
    system = jl.System(
        bobs,
        ("x1", "y1", "x2", "y2"),
        constraints=(jl.Holonomic(lambda t, q, p: p["k"] * (q[0] - p["X"] * t), "led"),),
    )
    params = {**BOBS, "k": 0.0, "X": 0.0}
    assert system._rows(params, jnp.dtype(float)).driven_names == ("led",)


def test_closure_is_traced_once_per_shape():
    """New values of params do not trace the declaration again."""
    count = []

    def counted(t, q, params):
        count.append(1)
        return closure(t, q, params)

    system = jl.System(
        four_bar.lagrangian,
        ("crank", "coupler", "rocker"),
        constraints=(jl.Holonomic(counted, "pin"),),
    )
    residual = jax.jit(lambda params, q: system.residuals(q, q, params)[0]["pin"])
    first = residual(FOUR_BAR, jnp.ones(3))
    traced = len(count)
    other = residual({**FOUR_BAR, "d": 1.5}, jnp.ones(3))
    assert len(count) == traced
    np.testing.assert_allclose(first - other, [0.5, 0.0], atol=2 * EPS)
