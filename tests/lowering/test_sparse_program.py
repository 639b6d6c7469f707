"""Sparse programs: the accelerations and motions of whole matrices, and what they leave out."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._core._jaxprs import equations
from jaxlag._lowering._acceleration_program import ArrayProgram, State
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._sparse_program import SparseConstants, find_sparsity
from jaxlag._system._inspection import mass_definite
from jaxlag._tracing import _params

T = jnp.array(0.3)
INERTIA = np.diag([0.02, 0.03, 0.04])
HANGING = {"m": 1.3, "l": 0.7}


def rope(masses, *constraints, lowering="array"):
    """Point masses on a rope that hangs from the origin, in a plane."""

    def lagrangian(t, q, v, p):
        return 0.5 * p["m"] * v @ v - 9.8 * p["m"] * jnp.sum(q[1::2])

    def lengths(t, q, p):
        r = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)])
        return jnp.sum(jnp.diff(r, axis=0) ** 2, axis=1) - p["l"] ** 2

    rows = (jl.Holonomic(lengths, "length"), *constraints)
    return jl.System(lagrangian, {"r": (masses, 2)}, constraints=rows, lowering=lowering)


def hanging(masses):
    """A consistent state of the rope at rest."""
    angle = jnp.linspace(0.3, 1.2, masses)
    parts = jnp.stack([jnp.sin(angle), -jnp.cos(angle)], axis=1) * HANGING["l"]
    return jnp.cumsum(parts, axis=0).reshape(-1), jnp.zeros(2 * masses)


def bodies(count, fixed=False):
    """Rigid bodies by positions and quaternions, each pinned to the next one.

    With `fixed` the first one is pinned at its other end, too. Without the rows of the quaternions'
    lengths M is singular in every body.
    """

    def poses(q):
        return q.reshape(count, 7)[:, :3], q.reshape(count, 7)[:, 3:]

    def rates(e, e_rate):
        w, vector, w_rate, rate = e[:1], e[1:], e_rate[:1], e_rate[1:]
        return 2.0 * (w * rate - w_rate * vector - jnp.cross(vector, rate))

    def turned(e, x):
        w, vector = e[0], e[1:]
        cross = jnp.cross(vector, x)
        return (w**2 - vector @ vector) * x + 2.0 * (vector @ x) * vector + 2.0 * w * cross

    def lagrangian(t, q, v, p):
        (r, e), (r_rate, e_rate) = poses(q), poses(v)
        omega = jax.vmap(rates)(e, e_rate)
        return (
            0.5 * jnp.sum(r_rate**2)
            + 0.5 * jnp.sum((omega @ INERTIA) * omega)
            - 9.8 * jnp.sum(r[:, 2])
        )

    def pins(t, q, p):
        r, e = poses(q)
        arm = jax.vmap(lambda e: turned(e, jnp.array([0.0, 0.0, 0.5])))(e)
        ends = jnp.concatenate([jnp.zeros((1, 3)), (r - arm)[:-1]])
        end = (r - arm)[0] - jnp.array([0.0, np.sin(0.5), -np.cos(0.5)])
        return jnp.concatenate([(r + arm - ends).reshape(-1), *([end] if fixed else [])])

    def lengths(t, q, p):
        return jnp.sum(poses(q)[1] ** 2, axis=1) - 1.0

    rows = jl.Holonomic(pins, "pin"), jl.Holonomic(lengths, "length")
    return jl.System(lagrangian, {"pose": (count, 7)}, constraints=rows, lowering="array")


def lattice(count):
    """A chain of springs on wheels, whose inertias depend on their places."""

    def lagrangian(t, q, v, p):
        inertia = 1.0 + 0.3 * jnp.sin(q)
        return 0.5 * jnp.sum(inertia * v**2) + 0.1 * v[0] * v[1] - 0.5 * jnp.sum(jnp.diff(q) ** 2)

    damper = jl.Rayleigh(lambda t, q, v, p: 0.05 * jnp.sum(v**2), "damper")
    return jl.System(lagrangian, {"x": (count,)}, forces=(damper,), lowering="array")


def skates(count):
    """Points of which neighbours have rods between them; some of them move on skates."""

    def skate(t, q, v, p):
        r, u = q.reshape(-1, 2)[::4], v.reshape(-1, 2)[::4]
        return jnp.cos(r[:, 0]) * u[:, 0] + (1.0 + t) * u[:, 1] - 0.1

    return rope(count, jl.Pfaffian(skate, "skate"))


SCENES = {
    "rope": (rope(12), HANGING, True),
    "rope with skates": (skates(24), HANGING, True),
    "bodies": (bodies(6), {}, False),
    "lattice": (lattice(20), {}, True),
}


def states(system, count):
    rng = np.random.default_rng(0)
    return [jnp.array(rng.normal(size=(2, system.size))) for _ in range(count)]


def programs(system, params, regular):
    """(the terms, the sparse constants, those of whole matrices)."""
    terms = replace(system._terms, regular=regular, blocks_definite=True)
    q = jnp.zeros(system.size)
    sparse = ArrayProgram(terms).precompute(q, params, {})
    assert isinstance(sparse, SparseConstants)
    return terms, sparse, terms.precompute(q, params)


@pytest.mark.full
@pytest.mark.parametrize("name", SCENES)
def test_accelerations_are_those_of_whole_matrices(name):
    """Compared by their residuals: bodies have condition numbers of 1e5."""
    system, params, regular = SCENES[name]
    terms, sparse, dense = programs(system, params, regular)
    program = ArrayProgram(terms)
    found = jax.jit(lambda q, v, c: program.acceleration(State(T, q, v, params, {}), c))
    for q, v in states(system, 2):
        a, expected = found(q, v, sparse), found(q, v, dense)
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(
            a, expected, atol=1e-9 * scale if name == "bodies" else 1e-12 * scale
        )


@pytest.mark.full
@pytest.mark.parametrize("name", ["rope with skates", "bodies"])
def test_projectors_are_those_of_whole_matrices(name):
    """Corrections, effective masses and the sense of rows elsewhere."""
    system, params, regular = SCENES[name]
    terms, sparse, dense = programs(system, params, regular)
    rows = system._rows(params, jnp.result_type(float))
    program, (q, v), c = ArrayProgram(terms), states(system, 1)[0], jnp.linspace(-1, 1, rows.size)

    @jax.jit
    def parts(constants):
        surface = program.projector(State(T, q, v, params, {}), constants, rows, None)
        near, far = q + 0.01 * v, jnp.roll(-q, 1)
        senses = [surface.keeps_sense(T, x, v) for x in (q, near, far)]
        h = jnp.size(surface.position(q))
        corrections = surface.shift(c[:h]), surface.kick(c), surface.columns()
        scales = surface.reach(jnp.abs(v)), surface.units()
        return [*corrections, *scales], surface.masses, senses

    (ours, masses, senses), (theirs, expected, others) = parts(sparse), parts(dense)
    for x, y in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-9 * np.max(np.abs(y)))
    # Rows inside of a block add their weight to its mass, which is compared with itself alone.
    if regular:
        np.testing.assert_allclose(masses, expected, rtol=1e-9)
    assert senses[:2] == others[:2] == [True, True]
    assert bool(senses[2]) == bool(others[2])


@pytest.mark.full
def test_no_array_is_as_large_as_a_whole_matrix():
    """Neither M, A nor A M^-1 A^T: the largest arrays hold a few numbers for each coordinate."""
    system = rope(200)
    terms, sparse, _ = programs(system, HANGING, regular=True)
    program = ArrayProgram(terms)

    def acceleration(q, v):
        return program.acceleration(State(T, q, v, HANGING, {}), sparse)

    traced = jax.make_jaxpr(acceleration)(*hanging(200))
    sizes = [v.aval.size for eqn in equations(traced) for v in eqn.outvars]
    assert max(sizes) <= 16 * system.size


@pytest.mark.parametrize(("name", "once"), [("rope", True), ("lattice", False)])
def test_a_constant_mass_matrix_is_factored_once(name, once):
    _, sparse, _ = programs(*SCENES[name])
    assert (sparse.factor is not None) == once


@pytest.mark.parametrize(
    ("system", "params", "text"),
    [
        (rope(12), HANGING, "M by 1 directional derivative, h by one forward"),
        (rope(12), HANGING, "A by 2 reverse derivatives"),
        (rope(12), HANGING, "M diagonal; A M^-1 A^T banded, half bandwidth 1 of 12"),
        (bodies(6), {}, "blocks of M of up to 4; A M^-1 A^T banded, half bandwidth 6 of 24"),
        (lattice(20), {}, "one factorization per evaluation, blocks of M of up to 2"),
    ],
)
def test_explain_states_the_sparsity(system, params, text):
    assert text in system.explain(params)


def test_explain_states_why_matrices_are_whole():
    def lagrangian(t, q, v, p):
        return 0.5 * jnp.sum(jnp.cumsum(v) ** 2)

    chain = jl.System(lagrangian, {"x": (20,)}, lowering="array")
    assert "matrices not sparse: a block of M has 20 of 20 coordinates" in chain.explain(None)

    def ring(t, q, p):
        return jnp.sin(q[:10] - jnp.mean(q))

    all_coupled = jl.System(
        lambda t, q, v, p: 0.5 * v @ v,
        {"x": (20,)},
        constraints=(jl.Holonomic(ring, "ring"),),
        lowering="array",
    )
    text = "A M^-1 A^T of 10 rows has a half bandwidth of 9 or more"
    assert text in all_coupled.explain(None)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_sparsity_does_not_depend_on_the_precision(dtype):
    """Products are compared with derivatives to the rounding of the state."""
    ties = jl.Holonomic(lambda t, q, p: jnp.sin(q[1::3]) - p * q[::3] ** 2, "tie")
    system = jl.System(
        lambda t, q, v, p: 0.5 * p * jnp.sum((1.0 + q**2) * v**2), {"x": (21,)}, constraints=(ties,)
    )
    found = find_sparsity(system._terms, np.asarray(1.3, dtype), 21, np.dtype(dtype))
    assert found.sparsity is not None, found.reason


def test_only_holonomic_rows_make_a_block_definite():
    """A coordinate without mass: positions are corrected by holonomic rows alone."""

    def massless(row):
        def lagrangian(t, q, v, p):
            return 0.5 * jnp.sum(v[1:] ** 2) - 0.5 * jnp.sum(jnp.diff(q) ** 2)

        def ties(t, q, p):
            return jnp.sin(q[1::4]) + q[2::4] ** 2 - 0.5

        rows = row, jl.Holonomic(ties, "tie")
        return jl.System(lagrangian, {"x": (21,)}, constraints=rows, lowering="array")

    sets = jl.Holonomic(lambda t, q, p: q[0] - t**2, "set")
    moves = jl.Pfaffian(lambda t, q, v, p: v[0] - 2.0 * t, "moved")
    q = jnp.linspace(0.1, 0.5, 21)
    for row, in_blocks in ((sets, True), (moves, False)):
        found = mass_definite(massless(row), {}, T, q, q, _params.UNKNOWN)
        assert (found.alone, found.in_blocks) == (False, in_blocks)


def test_a_rule_that_reaches_further_than_its_values_is_noticed():
    """The value of its result reads one coordinate, its derivative reads two."""

    @jax.custom_jvp
    def smooth(x):
        return x**2

    @smooth.defjvp
    def rule(primals, tangents):
        (x,), (dx,) = primals, tangents
        return x**2, 2.0 * x * jnp.roll(dx, 1)

    def lagrangian(t, q, v, p):
        return 0.5 * jnp.sum(smooth(v)) + 0.5 * v @ v

    terms = ArrayTerms(jl.System(lagrangian, {"x": (20,)}).lagrangian, ())
    found = find_sparsity(terms, None, 20, jnp.result_type(float))
    assert found.sparsity is None or found.sparsity.blocks.size > 1


@pytest.mark.full
def test_motion_is_that_of_the_scalar_program():
    system, (q0, v0), ts = rope(9), hanging(9), jnp.linspace(0.0, 0.4, 3)
    found = jl.simulate(system, q0, v0, ts, HANGING)
    expected = jl.simulate(rope(9, lowering="scalar"), q0, v0, ts, HANGING)
    np.testing.assert_allclose(found.q, expected.q, atol=1e-9)
    assert int(found.stats["accepted"]) == int(expected.stats["accepted"])


@pytest.mark.full
@pytest.mark.parametrize("fixed", [False, True])
def test_a_motion_of_singular_blocks_keeps_its_energy_and_its_rows(fixed):
    """Six bodies that fall from a bent shape, pinned to each other; M is singular in each.

    The pins of a fixed body imply the length of its quaternion. Its row is kept nevertheless, as M
    is singular without it.
    """
    system, angles = bodies(6, fixed), jnp.linspace(0.5, 1.0, 6)
    none = 0.0 * angles
    e = jnp.stack([jnp.cos(angles / 2), jnp.sin(angles / 2), none, none], axis=1)
    arm = 0.5 * jnp.stack([none, -jnp.sin(angles), jnp.cos(angles)], axis=1)
    r = arm - 2.0 * jnp.cumsum(arm, axis=0)
    q0 = jnp.concatenate([r, e], axis=1).reshape(-1)
    ts = jnp.linspace(0.0, 0.3, 3)
    motion = jl.simulate(system, q0, jnp.zeros_like(q0), ts, {}, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(motion.energy, motion.energy[0], atol=1e-6)
    phi = system.residuals(motion.q[-1], motion.v[-1], {})[0]
    assert max(float(jnp.max(jnp.abs(x))) for x in phi.values()) < 1e-12


@pytest.mark.full
@pytest.mark.parametrize("name", ["rope", "rope with skates"])
def test_reactions_are_those_of_whole_matrices(name):
    """Accelerations and reactions of a state, along the nonzeros."""
    system, params, _ = SCENES[name]
    q, v = states(system, 1)[0]
    a, lam = system._terms.reactions(T, q, v, params, {})
    A = system._terms.rows(T, q, v, params)[0]
    found = system.multipliers(q, v, params, t=T)
    allowed = 1e-12 * np.max(np.abs(a))
    np.testing.assert_allclose(system.acceleration(q, v, params, t=T), a, atol=allowed)
    np.testing.assert_allclose(np.concatenate([*found.values()]), lam, atol=allowed)
    force = system.constraint_force(q, v, params, t=T)
    np.testing.assert_allclose(force, lam @ A, atol=allowed)


@pytest.mark.full
def test_reactions_of_dependent_rows_and_of_a_mass_of_zero():
    """Rows that are there twice share their multipliers; a row may replace inertia."""
    twice = jl.Holonomic(lambda t, q, p: jnp.sum(q.reshape(-1, 2)[0] ** 2) - p["l"] ** 2, "twice")
    q, v = hanging(12)
    lam = rope(12, twice).multipliers(q, v, HANGING)
    alone = rope(12).multipliers(q, v, HANGING)["length"]
    np.testing.assert_allclose(lam["twice"], lam["length"][0], rtol=1e-10)
    np.testing.assert_allclose(2.0 * lam["length"][0], alone[0], rtol=1e-10)
    np.testing.assert_allclose(lam["length"][1:], alone[1:], rtol=1e-10)

    # The forces are proportional to the mass. The solve by all rows, which is not taken, has NaN.
    def first(m):
        return rope(12, twice).multipliers(q, v, HANGING | {"m": m})["length"][0]

    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(first)(1.3), lam["length"][0] / 1.3, rtol=1e-10)

    system, m = midpoints(21), jnp.ones(21)
    q = 0.1 * jnp.arange(21.0) ** 2
    q = q.at[1::4].set(0.5 * (q[:-1:4] + q[2::4]))
    params = {"m": m.at[5].set(0.0), "k": 2.0}
    a = system.acceleration(q, 0.0 * q, params)
    lam = system.multipliers(q, 0.0 * q, params)["halfway"]
    loads = jnp.zeros(21).at[1::4].set(lam).at[:-1:4].add(-lam / 2).at[2::4].add(-lam / 2)
    springs = jax.grad(lambda q: -0.5 * params["k"] * jnp.sum(jnp.diff(q) ** 2))(q)
    np.testing.assert_allclose(params["m"] * a, springs + loads, atol=1e-12)
    np.testing.assert_allclose(a[1::4], 0.5 * (a[:-1:4] + a[2::4]), atol=1e-12)


def test_long_code_is_refused_before_it_is_derived():
    """By the number of operations of the elimination alone."""
    system = rope(60, lowering="auto")
    lowered = system._program.lowered(jax.ShapeDtypeStruct((120,), float), HANGING, {})
    assert lowered.reason.startswith("at least 2018 operations")


def midpoints(count):
    """Masses on springs; every fourth one is halfway between its neighbours."""

    def lagrangian(t, q, v, p):
        return 0.5 * jnp.sum(p["m"] * v**2) - 0.5 * p["k"] * jnp.sum(jnp.diff(q) ** 2)

    def halfway(t, q, p):
        return q[1::4] - 0.5 * (q[:-1:4] + q[2::4])

    row = jl.Holonomic(halfway, "halfway")
    return jl.System(lagrangian, {"x": (count,)}, constraints=(row,), lowering="array")


@pytest.mark.full
def test_a_mass_of_zero_among_traced_params_is_named():
    """Known params: whole matrices, as M is positive definite on the constraints alone."""
    system, q, m = midpoints(21), 0.1 * jnp.arange(21.0), jnp.ones(21)

    def moved(m):
        ts = jnp.array([0.0, 0.1])
        return jl.simulate(system, q, -q, ts, {"m": m, "k": 2.0}, dt=0.1, throw=False)

    traced, massless = jax.jit(moved), m.at[5].set(0.0)
    np.testing.assert_allclose(traced(m).q, moved(m).q, atol=1e-13)
    assert int(moved(massless).status) == 0
    text = r"mass_singular \('x\[5\]'\).*rows that couple this coordinate with others"
    with pytest.raises(jl.SimulationError, match=text):
        traced(massless).check()


@pytest.mark.full
def test_gradients_of_a_motion_are_those_of_differences():
    system, (q0, v0), ts = rope(12), hanging(12), jnp.array([0.0, 0.3])

    def reach(m, length):
        scaled, params = q0 * length / HANGING["l"], {"m": m, "l": length}
        motion = jl.simulate(system, scaled, v0, ts, params, rtol=1e-10, atol=1e-10)
        return jnp.sum(jnp.sin(motion.q[-1]))

    at = (1.3, 0.7)
    reverse = jax.jit(jax.grad(reach, (0, 1)))(*at)
    forward = jax.jit(jax.jacfwd(reach, (0, 1)))(*at)
    plain, h = jax.jit(reach), 1e-4
    slope = (plain(1.3, 0.7 + h) - plain(1.3, 0.7 - h)) / (2 * h)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(reverse[1], slope, rtol=1e-6)
    assert abs(float(reverse[0])) < 1e-8  # all masses scale alike


@pytest.mark.full
def test_batches_are_their_single_motions():
    system, (q0, v0), ts = rope(12), hanging(12), jnp.array([0.0, 0.2])
    masses = jnp.linspace(0.5, 2.0, 3)

    def last(m):
        return jl.simulate(system, q0, v0, ts, {"m": m, "l": 0.7}).q[-1]

    batch = jax.jit(jax.vmap(last))(masses)
    for m, q in zip(masses, batch, strict=True):
        np.testing.assert_allclose(q, last(m), atol=1e-9)
