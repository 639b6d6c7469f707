"""The fuzzer's constrained systems, quasi-velocities and loops: draws, references, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.fuzz import (
    _loops,
    _mechanism_motions,
    _random_bodies,
    _random_mechanisms,
    _random_quasi,
)
from bench.fuzz._mechanism_programs import compared, prepare
from bench.fuzz._random_mechanisms import Mechanism, Quasi, Row, smaller, values
from bench.fuzz._random_systems import Drawn
from bench.fuzz._reference_solution import Unclear
from jaxlag._linalg import _row_residuals
from jaxlag._lowering import ArrayTerms, _array_terms
from jaxlag._lowering import QuasiState as Rates
from jaxlag._lowering._jaxpr import _from_jaxpr
from jaxlag._lowering._scalar_program import ScalarProgram
from jaxlag._tracing import _traced_function

NUMBERS = {"a": [0.1, 0.2, 0.3], "b": 2.0, "k": 1.0}


def mechanism(*rows, q, v, masses=None, quasi=None, potential="9.81 * q[1]", **changes):
    """A mass point, or another system with these inertias."""
    masses = (2.0,) * len(q) if masses is None else masses
    units = changes.pop("units", (1.0,) * len(q))
    dtype = changes.pop("dtype", "float64")
    drawn = Drawn(len(q), (), (potential,), (), masses, NUMBERS, units, 1.0, dtype, False)
    return Mechanism(drawn, rows, 0.5, tuple(q), tuple(v), quasi=quasi, **changes)


ROD = Row("holonomic", "q[0] ** 2 + q[1] ** 2 - 1.0")
AGAIN = Row("Pfaffian", "3.0 * (q[0] * v[0] + q[1] * v[1])", "dependent")
VOID = Row("holonomic", "(jnp.sin(q[0]) ** 2 + jnp.cos(q[0]) ** 2 - 1.0) * q[1]", "void")
AT = {"q": (0.6, -0.8), "v": (0.8, 0.6)}
DOUBLED = mechanism(ROD, AGAIN, VOID, **AT)
# At x = 0.6 the second row equals the first, but requires another acceleration.
BENT = mechanism(ROD, Row("holonomic", f"{ROD.text} + (q[0] - 0.6) ** 2", "bent"), **AT)
TURNED = Quasi(("q[0] * v[0] + q[1] * v[1]", "q[0] * v[1] - q[1] * v[0]"), None, 2, (0,))
IN_QUASI = mechanism(quasi=TURNED, **AT)


# ---- Drawn systems -------------------------------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize("module", [_random_mechanisms, _random_quasi, _random_bodies])
def test_every_seed_draws_a_different_mechanism(module):
    drawn = [module.draw(seed) for seed in range(40)]
    assert drawn == [module.draw(seed) for seed in range(40)]
    assert len({x.written for x in drawn}) == len(drawn)
    assert {x.drawn.dtype for x in drawn} == {"float32", "float64"}


def test_rows_of_every_kind_are_drawn():
    drawn = [_random_mechanisms.draw(seed) for seed in range(150)]
    rows = [row for x in drawn for row in x.rows]
    assert {row.role for row in rows} == {"base", "dependent", "void", "bent"}
    assert {row.kind for row in rows} == {"holonomic", "Pfaffian"}
    assert any("sin(t)" in row.text and row.kind == "holonomic" for row in rows)
    assert any(0.0 in x.drawn.masses for x in drawn)
    assert any(len(x.rows) > x.drawn.n for x in drawn)
    units = [u for x in drawn for u in x.drawn.units]
    assert min(units) < 1e-5
    assert max(units) > 1e5


def test_quasi_velocities_of_every_kind_are_drawn():
    drawn = [_random_quasi.draw(seed) for seed in range(150)]
    quasi = [x.quasi for x in drawn]
    assert {(x.U is None, x.written_in) for x in quasi} == {
        (True, "v"),
        (True, "u"),
        (False, "v"),
        (False, "u"),
    }
    assert any(x.constrained for x in quasi)
    assert any(x.singular for x in quasi)
    assert any(x.quasi.size < x.drawn.n for x in drawn)
    assert any(row.kind == "holonomic" for x in drawn for row in x.rows)


def test_smaller_mechanisms_are_shorter():
    drawn = _random_mechanisms.draw(4)
    found = list(smaller(drawn))
    assert len(found) > 2
    assert min(len(x.written) for x in found) < len(drawn.written)


# ---- References ----------------------------------------------------------------------------------


def test_reference_of_a_pendulum_equals_its_closed_form():
    """Rod of 1 m, two rows that share its tension by least norm, and a void one."""
    found = prepare(DOUBLED._replace(v=(1.6, 1.2)), 4)
    units = found.equations.units
    assert found.equations.outcome == "solution"
    assert found.equations.base.tolist() in ([0], [1])
    # Masses are 2: lengths of the rows in units of inertia are |A| / sqrt(2).
    speed, gravity = 4.0, 9.81 / 2.0
    tension = speed + gravity * 0.8  # per mass, towards the pivot
    a = np.array([0.0, -gravity]) - tension * np.array([0.6, -0.8])
    np.testing.assert_allclose(found.right.a * units, a, rtol=1e-14)
    lam = found.right.mu / found.equations.lengths
    # Unit rows share 2 tension equally.
    np.testing.assert_allclose(lam, [-tension / 2.0, -tension / 3.0, 0.0], rtol=1e-14)


def test_derivatives_of_the_reference_agree_with_differences():
    """Along the direction that satisfies the constraints, also for a row times a function."""
    weighted = Row("holonomic", f"(1.5 + jnp.sin(q[0])) * ({ROD.text})", "dependent")
    whole = mechanism(ROD, weighted, q=(0.6, -0.8, 0.3), v=(0.8, 0.6, -0.4))
    found = prepare(whole, 1)
    step, ends = 1e-5, []
    for sign in (1.0, -1.0):
        state, dots = found.state, found.direction
        q = state.q + sign * step * dots.q
        angle = np.arctan2(q[1], q[0])  # along the circle
        q = np.array([np.cos(angle), np.sin(angle), q[2]])
        v = state.v + sign * step * dots.v
        moved = whole._replace(q=tuple(q), v=tuple(v))
        end = prepare(moved, 1)
        equations, right = end.equations, end.right
        ends.append((right.a * equations.units, right.mu / equations.lengths))
    units, lengths = found.equations.units, found.equations.lengths
    rates = found.right.da * units, found.right.dmu / lengths
    for one, other, rate in zip(*ends, rates, strict=True):
        np.testing.assert_allclose((one - other) / (2 * step), rate, rtol=1e-7, atol=1e-8)


@pytest.mark.full
@pytest.mark.parametrize(
    ("changed", "outcome"),
    [
        (BENT, "contradictory"),
        (BENT._replace(rest=0), "solution"),
        (mechanism(ROD, **AT, masses=(2.0, 0.0)), "solution"),
        (mechanism(ROD, q=(0.6, -0.8, 0.1), v=(0.8, 0.6, 0.0), masses=(2.0, 2.0, 0.0)), "singular"),
    ],
    ids=["bent", "bent at rest", "a massless link", "a coordinate without inertia"],
)
def test_mechanisms_have_the_expected_outcome(changed, outcome):
    assert prepare(changed, 1).equations.outcome == outcome
    assert compared(changed).kind == "equal"


def test_directions_satisfy_rows_of_every_size():
    """One of 1e-9 beside one of 1e9: their residuals are constant along the direction."""
    rows = (
        Row("Pfaffian", "1e9 * ((1.6 + 0.4 * jnp.sin(q[1])) * v[0] + 0.3 * v[1])"),
        Row("Pfaffian", "1e-9 * (v[1] + 0.5 * jnp.cos(q[0]) * v[2])"),
    )
    whole = mechanism(*rows, q=(0.3, -0.2, 0.5), v=(0.8, 0.6, -0.4), masses=(1e18, 1.0, 1e-18))
    found = prepare(whole, 1)
    moved, v = found.rates.A @ found.state.v, found.state.v
    left = moved + found.terms.A @ found.direction.v
    size = np.linalg.norm(found.terms.A, axis=1) * np.linalg.norm(v)
    assert np.all(np.abs(left) < 1e-14 * size)
    assert np.linalg.norm(found.direction.v) > 1e-3


def test_nearly_contradictory_rows_are_omitted_in_float32():
    """The contradiction, 1e-3, is far above rounding: a program may solve for either row."""
    bent = Row("holonomic", f"{ROD.text} + 2e-3 * (q[0] - 0.6) ** 2", "bent")
    with pytest.raises(Unclear, match="nearly contradict"):
        prepare(mechanism(ROD, bent, **AT, dtype="float32"), 1)


def test_nearly_dependent_rows_are_omitted():
    near = Row("holonomic", f"{ROD.text} + 1e-6 * (q[0] - 0.6)", "dependent")
    with pytest.raises(Unclear, match="nearly dependent"):
        prepare(mechanism(ROD, near, **AT), 1)
    assert compared(mechanism(ROD, near, **AT)).kind.startswith("not compared: ")


def test_bodies_of_every_kind_are_drawn():
    drawn = [_random_bodies.draw(seed) for seed in range(100)]
    assert {x.drawn.lagrangian.count("RigidBody") for x in drawn} == {1, 2, 3}
    assert {x.drawn.n for x in drawn} == set(range(1, 7))
    assert {len(x.rows) for x in drawn} == set(range(5))
    assert {row.kind for x in drawn for row in x.rows} == {"holonomic", "Pfaffian"}
    written = " ".join(x.written for x in drawn)
    assert all(f"about_{axis}" in written for axis in "xyz")
    assert "R, r: (R, r" in written  # a slider
    # Bodies hang on bodies, and rows join two of them.
    assert any("*(lambda R, r:" in x.drawn.lagrangian for x in drawn)
    assert any("- (lambda R, r:" in row.text for x in drawn for row in x.rows)


# ---- Detected errors -----------------------------------------------------------------------------


def found_in(*kinds):
    """The quantities that differ; asserts that some do."""
    results = [compared(x) for x in kinds]
    assert all(x.kind == "differs" for x in results), results
    return [x.what for x in results]


@pytest.mark.full
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_sound_programs_are_equal(dtype):
    for sound in (DOUBLED, BENT, IN_QUASI):
        found = compared(sound._replace(drawn=sound.drawn._replace(dtype=dtype)))
        assert found.kind == "equal", found
        assert found.worst < 0.5


@pytest.mark.full
def test_multipliers_without_least_norm_are_detected(monkeypatch):
    monkeypatch.setattr(_array_terms, "shared", lambda A, lam, *_: lam)
    assert found_in(DOUBLED) == ["arrays: lam"]


@pytest.mark.full
def test_bias_of_the_other_sign_is_detected(monkeypatch):
    right = ArrayTerms.gamma
    monkeypatch.setattr(ArrayTerms, "gamma", lambda self, *args: -right(self, *args))
    (what,) = found_in(DOUBLED)
    assert what.endswith((": a", ": lam", ": da", ": dlam"))


def test_unreported_contradiction_is_detected(monkeypatch):
    monkeypatch.setattr(_array_terms, "redundant_rows_hold", lambda *_: jnp.array(True))
    assert found_in(BENT) == ["arrays: a number where rows or masses are contradictory"]


@pytest.mark.full
def test_refused_solution_is_detected(monkeypatch):
    monkeypatch.setattr(_array_terms, "redundant_rows_hold", lambda *_: jnp.array(False))
    assert found_in(DOUBLED) == ["arrays: a is no number"]


@pytest.mark.full
def test_void_row_that_counts_is_detected(monkeypatch):
    """Its rounding is solved with, or it has a multiplier."""

    def all_nonzero(rows, q, A, sure=False):
        whole = jnp.ones(A.shape[0], bool)
        return _row_residuals.Sizes(whole, ~whole, jnp.linalg.norm(A, axis=1))

    monkeypatch.setattr(_array_terms, "row_sizes", all_nonzero)
    found_in(DOUBLED)


@pytest.mark.full
def test_wrong_scalars_are_detected(monkeypatch):
    right = ScalarProgram._run
    monkeypatch.setattr(
        ScalarProgram, "_run", lambda self, *args: right(self, *args) * (1.0 + 1e-10)
    )
    for what in found_in(DOUBLED, IN_QUASI):
        assert "scalars" in what


@pytest.mark.full
def test_wrong_scalars_of_rigid_bodies_are_detected(monkeypatch):
    """By d'Alembert's principle: poses of three bodies with two rows."""
    bodies = _random_bodies.draw(7)
    lowered = bodies.system._program.lowered(jnp.asarray(bodies.q), values(bodies.drawn), {})
    assert lowered.equations.form == "d'Alembert's principle"
    found = compared(bodies)
    assert (found.kind, found.worst < 0.5) == ("equal", True)
    right = ScalarProgram._run
    monkeypatch.setattr(
        ScalarProgram, "_run", lambda self, *args: right(self, *args) * (1.0 + 1e-10)
    )
    assert "scalars" in found_in(bodies)[0]


@pytest.mark.full
def test_wrong_rates_of_quasi_velocities_are_detected(monkeypatch):
    """The part of v' at u' = 0 is omitted."""

    def velocity_rate(self, du):
        return self._jvp_fn(du)

    monkeypatch.setattr(Rates, "velocity_rate", velocity_rate)
    (what,) = found_in(IN_QUASI)
    assert what.startswith("quasi, arrays: ")


def test_singular_kinematics_that_give_numbers_are_detected(monkeypatch):
    rows = ("(q[0] - 0.6) * v[0]", "v[1]")
    singular = mechanism(quasi=Quasi(rows, None, 2, singular=True), **AT)
    assert compared(singular).kind == "equal"
    kind = type(singular.system.quasi)
    monkeypatch.setattr(kind, "regular", lambda self, *_: jnp.array(True))
    monkeypatch.setattr(kind, "velocities", lambda self, t, q, u, p: u)
    assert found_in(singular) == [
        "quasi, arrays: a number where rows or masses are singular kinematics"
    ]


LOOPED = _loops.Looped(
    DOUBLED.drawn._replace(potential=("q[0] ** 2",)),
    *(
        _loops.having(DOUBLED._replace(rows=()).system, DOUBLED.drawn, f)
        for f in (_loops.ruled, jnp.tanh)
    ),
    0.5,
    np.array([0.6, -0.8]),
    np.array([0.8, 0.6]),
    "scan",
    "nothing",
    "grad",
    "jvp",
)


@pytest.mark.parametrize("loop", _loops.LOOPS)
def test_loops_equal_unrolled_code(loop):
    found = _loops.compared(LOOPED._replace(loop=loop, within="checkpoint"))
    assert (found.kind, found.what) == ("equal", "second derivative")
    assert found.worst < 0.5


def test_rule_that_is_dropped_in_a_loop_is_detected(monkeypatch):
    """JAX drops it where a reverse derivative splits the body of a scan."""
    monkeypatch.setattr(_traced_function, "with_rules_kept", lambda program: program)
    monkeypatch.setattr(_from_jaxpr, "with_rule_kept", lambda eqn: eqn)
    system = _loops.having(DOUBLED._replace(rows=()).system, DOUBLED.drawn, _loops.ruled)
    looped = LOOPED._replace(system=system)
    jax.clear_caches()
    assert _loops.compared(looped).kind == "differs"


@pytest.mark.full
def test_motions_are_compared_by_their_ends_and_statuses(monkeypatch):
    assert _mechanism_motions.compared(DOUBLED).kind == "equal"
    assert _mechanism_motions.compared(BENT).kind == "equal"
    assert _mechanism_motions.compared(IN_QUASI).kind == "equal"
    monkeypatch.setitem(_mechanism_motions.NAMED, "contradictory", {"nonfinite"})
    found = _mechanism_motions.compared(BENT)
    assert (found.kind, found.worst) == ("differs", np.inf)
    monkeypatch.setattr(_mechanism_motions, "LOCAL", 1e-9)
    assert _mechanism_motions.compared(DOUBLED).kind == "differs"


@pytest.mark.full
def test_weight_of_a_row_of_rounding_may_overflow():
    """In float32, 1 over the square of its rounding: omitted rows are not multiplied by 0."""
    drawn = _random_mechanisms.draw(294)
    assert (drawn.drawn.dtype, drawn.rows[1].role) == ("float32", "void")
    assert compared(drawn).kind == "equal"
