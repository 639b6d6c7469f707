"""Rounding bounds of values that vanish up to rounding, and constraint rows of such values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

import jaxlag as jl
from jaxlag._linalg._rounding_bounds import with_rounding
from jaxlag._linalg._row_residuals import row_sizes

TILT = np.asarray(jl.rotation.about_x(0.5)) @ np.asarray(jl.rotation.about_y(0.35))


def identity(q):
    return (jnp.sin(q[0]) ** 2 + jnp.cos(q[0]) ** 2 - 1.0) * q[1]


def tilted(q):
    """The normal component of a vector in a tilted plane, in the axes of the plane."""
    R = jnp.asarray(TILT, q.dtype)
    return (R.T @ (R @ jnp.stack([jnp.cos(q[0]) + q[1], jnp.sin(q[0]), 0.0 * q[0]])))[2]


def converged(q):
    """Newton's method in a loop: rounding does not accumulate; that of sqrt(2) remains."""
    return jax.lax.fori_loop(0, 20, lambda _, x: x - (x * x - 2.0) / (2.0 * x), q[0]) - q[1]


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize(
    ("function", "size"),
    [
        (identity, 1.3 * 2.0),
        (tilted, 1.5),
        (converged, 1.4),
        (lambda q: q[0] - q[1], 1.3),
        (lambda q: 1e-9 * q[1], 1.3e-9),
        (lambda q: jnp.ones(1000, q.dtype) @ jnp.full(1000, q[1]) - 1300.0, 1300.0),
    ],
)
def test_rounding_bound_has_the_size_of_the_terms(function, size, dtype):
    """The bound is right within a factor of 4; values that vanish are below 4 times the bound."""
    q, eps = jnp.array([0.3, 1.3], dtype), float(jnp.finfo(dtype).eps)
    value, rounding = jax.jit(lambda q: with_rounding(function, q))(q)
    assert float(value) == float(jax.jit(function)(q))
    assert 0.25 < float(rounding) / (eps * size) < 4.0
    exact = {identity: 0.0, tilted: 0.0}.get(function)
    if exact is not None:
        assert abs(float(value) - exact) < 4.0 * float(rounding)


@pytest.mark.full
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_rows_that_are_rounding_everywhere_are_void(dtype):
    """Rows that vanish at one state only, and small or scaled rows, are not void."""

    def rows(q):
        functions = [identity, tilted, lambda q: q[1] ** 2, lambda q: 1e-9 * (q[0] - q[1])]
        return jnp.stack([jax.grad(f)(q) for f in functions])

    for q in ([0.3, 0.0], [2.0, 0.0], [-1.1, 0.0]):
        q = jnp.array(q, dtype)
        nonzero, void, size = row_sizes(rows, q, rows(q))
        assert nonzero.tolist() == [False, False, False, True]
        assert void.tolist() == [True, True, False, False]
        assert float(size[1]) > 0.1
    q = jnp.array([1e-6, -2e-6], dtype)  # a mechanism of micrometer size
    nonzero, void, _ = row_sizes(lambda q: jax.jacrev(lambda q: (q @ q)[None])(q), q, 2.0 * q[None])
    assert nonzero.tolist() == [True]
    assert void.tolist() == [False]


# ---- Constraints ---------------------------------------------------------------------------------


def falling(t, q, v, params):
    return 0.5 * v @ v - 9.81 * q[1]


def rod(t, q, params):
    return q @ q - 1.0


ROD = jl.Holonomic(rod, "rod")


def like(q, x):
    """Cast to the dtype of q: time is always float64."""
    return jnp.asarray(x, q.dtype)


VOID = {
    "holonomic": jl.Holonomic(lambda t, q, p: identity(q) + like(q, p) * like(q, t) ** 2, "void"),
    "led": jl.Holonomic(lambda t, q, p: like(q, 1.0 + t) * identity(q) + like(q, p), "void"),
    "Pfaffian": jl.Pfaffian(
        lambda t, q, v, p: identity(q[:1].repeat(2)) * v[1] + like(q, p), "void"
    ),
}
START = np.array([0.6, -0.8]), np.array([0.24, 0.18])
SHORT = {"dt": 0.02, "method": "tsit5", "throw": False}


def systems(kind, alone, lowering="auto"):
    """(system with the row, system without it)."""
    others = () if alone else (ROD,)
    rows = (*others, VOID[kind]), others
    return tuple(jl.System(falling, ("x", "y"), constraints=r, lowering=lowering) for r in rows)


OPTIONS = (
    {},
    {"formulation": "null_space"},
    {"assemble": True},
    {"lowering": "array"},
    {"stabilization": None},
)
DECLARED = [(kind, alone) for kind in VOID for alone in (False, True)]


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "alone", "options", "dtype"),
    mostly_full(
        [(*d, options, jnp.float64) for d in DECLARED for options in OPTIONS]
        + [(*d, {}, jnp.float32) for d in DECLARED],
        ("holonomic", False, {}, jnp.float64),
        ("Pfaffian", True, {}, jnp.float64),
    ),
)
def test_void_rows_change_nothing(kind, alone, options, dtype):
    options = dict(options)
    system, without = systems(kind, alone, options.pop("lowering", "auto"))
    q, v, ts = (jnp.asarray(x, dtype) for x in (*START, [0.0, 0.1]))
    found = jl.simulate(system, q, v, ts, jnp.zeros((), dtype), **SHORT, **options)
    expected = jl.simulate(without, q, v, ts, **SHORT)
    assert found.status == jl.Status.ok, found.message()
    np.testing.assert_allclose(found.q, expected.q, atol=16 * float(jnp.finfo(dtype).eps))
    np.testing.assert_array_equal(found.lam["void"], 0.0)
    a, lam = (of(q, v, 0.0) for of in (system.acceleration, system.multipliers))
    np.testing.assert_allclose(a, without.acceleration(q, v), rtol=1e-5)
    assert lam["void"] == 0


@pytest.mark.full
@pytest.mark.parametrize("gap", mostly_full([1e-3, 1e-9], 1e-9))
@pytest.mark.parametrize(
    ("kind", "alone"),
    mostly_full([(k, a) for k in VOID for a in (False, True)], ("led", True), ("holonomic", False)),
)
def test_contradictory_rows_are_reported(kind, alone, gap):
    """In position, rate or acceleration."""
    system, _ = systems(kind, alone)
    found = jl.simulate(system, *START, [0.0, 0.1], gap, **SHORT)
    if kind == "holonomic" and gap < 1e-6:  # times t^2: too small for a step to detect
        gap = 1e-3
        found = jl.simulate(system, *START, [0.0, 0.1], gap, **SHORT)
    assert found.status == jl.Status.contradictory_rows
    assert "('void')" in found.message()


@pytest.mark.full
@pytest.mark.parametrize("stabilization", mostly_full(["projection", None], "projection"))
def test_rows_that_become_contradictory_are_reported(stabilization):
    late = jl.Holonomic(lambda t, q, p: identity(q) + jnp.maximum(t - 0.05, 0.0) ** 2, "late")
    system = jl.System(falling, ("x", "y"), constraints=(late,))
    found = jl.simulate(system, *START, [0.0, 0.1], stabilization=stabilization, **SHORT)
    assert found.status == jl.Status.rank_change
    assert 0.03 < found.last_time < 0.07


@pytest.mark.full
def test_closure_in_a_tilted_plane_has_one_void_row():
    """Assembly, equilibrium and a batch: the third row is 0 = 0."""

    def closure(t, q, params):
        R = jnp.asarray(TILT, q.dtype)
        r = jnp.stack([q[0] - jnp.sin(q[2]), q[1] + jnp.cos(q[2]), 0.0 * q[0]])
        return R.T @ (R @ r) + params * jnp.array([0.0, 0.0, 1.0])

    system = jl.System(falling, ("x", "y", "theta"), constraints=(jl.Holonomic(closure, "pin"),))
    state = jl.assemble(system, [0.5, -0.9, 0.5], [0.3, 0.0, 0.2], 0.0)
    assert state.dependent == ("pin[2]",)
    rest = jl.equilibrium(system, [0.1, -0.9, 0.15], 0.0)
    np.testing.assert_allclose(rest.q, [0.0, -1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rest.multipliers["pin"], [0.0, 9.81, 0.0], atol=1e-12)
    assert jl.equilibrium(system, [0.1, -0.9, 0.15], 1e-3, throw=False).status != jl.Status.ok
    with pytest.raises(jl.AssemblyError, match=r"contradictory_rows \('pin\[2\]'\)"):
        jl.assemble(system, [0.5, -0.9, 0.5], [0.3, 0.0, 0.2], 1e-9)

    def swung(angle):
        q = jnp.stack([jnp.sin(angle), -jnp.cos(angle), angle])
        return jl.simulate(system, q, 0.0 * q, jnp.array([0.0, 0.2]), 0.0, **SHORT)

    found = jax.vmap(swung)(jnp.linspace(-1.0, 1.0, 5))
    np.testing.assert_array_equal(found.status, int(jl.Status.ok))
    energy = 0.5 * jnp.sum(found.v**2, axis=-1) + 9.81 * found.q[..., 1]
    np.testing.assert_allclose(energy[:, 1], energy[:, 0], atol=1e-6)


@pytest.mark.full
def test_canceling_terms_are_not_contradictory():
    """gamma is 2e3 (v_z^2 - v_y^2): its terms cancel to rounding."""

    def weighted(t, q, params):
        r = q[0] - 1e3 * q[1] ** 2 + 1e3 * q[2] ** 2
        return jnp.stack([r, (2.0 + jnp.sin(q[1])) * r + params * (q[0] ** 2)])

    def free(t, q, v, params):
        return 0.5 * v @ v

    system = jl.System(free, ("x", "y", "z"), constraints=(jl.Holonomic(weighted, "rows"),))
    for y in (0.3, 0.37, 1.234):
        state = [0.0, y, y], [0.0, 0.7, 0.7]
        motion = jl.simulate(system, *state, [0.0, 0.1], 0.0, **SHORT)
        assert motion.status == jl.Status.ok, motion.message()
        np.testing.assert_allclose(motion.q[-1], [0.0, y + 0.07, y + 0.07], atol=1e-12)
    # A row that deviates from the other during the motion is reported.
    state = [0.0, 0.3, 0.2], [0.28, 0.7, 0.7]
    offset = jl.Holonomic(
        lambda t, q, p: weighted(t, q, p) - jnp.array([-50.0, -50.0 * (2.0 + jnp.sin(q[1]))]),
        "rows",
    )
    system = jl.System(free, ("x", "y", "z"), constraints=(offset,))
    v = [140.0, 0.7, 0.7]
    motion = jl.simulate(system, state[0], v, [0.0, 0.1], 1.0, **SHORT)
    assert motion.status == jl.Status.contradictory_rows
