"""The benchmark of first results: equations by hand, verdicts, one process."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from bench import first_result
from bench._problems import explicit_equations
from bench._problems.declared_scenes import BEGINNINGS
from bench.first_result._one_process import CASES

EPS = np.finfo(float).eps


def expected(motion, y):
    """dy/dt from the declared system."""
    n = motion.q0.size
    q, v = jnp.asarray(y[:n]), jnp.asarray(motion.v0)
    a = motion.system.acceleration(q, v, motion.params)
    if motion.turning is None:
        return jnp.concatenate([v, a])
    return jnp.concatenate([v, jax.jvp(motion.turning, (q, v), (v, a))[1]])


@pytest.mark.full
@pytest.mark.parametrize(
    "name", mostly_full(BEGINNINGS, "cart pendulum", "quadcopter", "rotating body", "5 bodies")
)
def test_equations_by_hand_equal_those_of_the_system(name):
    motion = BEGINNINGS[name]()
    y = motion.start()
    right = np.asarray(expected(motion, y))
    # Some hundred roundings, through a solve of up to 12 unknowns with a condition of about 1e3.
    allowed = 1e5 * EPS * np.max(np.abs(right))
    np.testing.assert_allclose(motion.by_hand()(0.0, y, motion.params), right, rtol=0, atol=allowed)
    if motion.rates is not None:
        found = motion.rates(explicit_equations.PLAIN, motion.params, 0.0, [float(x) for x in y])
        np.testing.assert_allclose(found, right, rtol=0, atol=allowed)


def row(scene, case, **figures):
    plain = {"cold_s": 1.0, "warm_s": 0.5, "diffrax_s": 1.0, "run_ms": 1.0, "diffrax_run_ms": 2.0}
    return {"scene": scene, "case": case, **plain, **figures}


def test_the_worst_row_of_every_kind_is_judged():
    rows = [row(scene, case) for scene in first_result.SCENES for case in CASES]
    targets, references = first_result.judged(rows)
    assert len(targets) == 9
    assert all(target.met for target in targets)
    assert references[0].figure == "0 of 45"
    for figure, scene, case, claim in (
        ({"cold_s": 1.6}, "cart pendulum", "101 rows", "rows, n <= 4"),
        ({"cold_s": 3.1}, "rotating body", "grad", "a gradient, n <= 4"),
        ({"cold_s": 2.6}, "quadcopter", "2 rows", "rows, the quadcopter"),
        ({"cold_s": 8.1}, "chain of 12", "grad", "a gradient, chains"),
        ({"warm_s": 1.6}, "5 bodies", "vmap of grad", "with the persistent cache"),
        ({"diffrax_s": 0.8}, "5 bodies", "2 rows", "as diffrax by hand: rows"),
    ):
        changed = [x | figure if (x["scene"], x["case"]) == (scene, case) else x for x in rows]
        missed = [t.claim for t in first_result.judged(changed)[0] if not t.met]
        assert any(claim in found for found in missed)


def test_different_ends_stop_the_benchmark(monkeypatch):
    def first(side, scene, case, cache):
        end = [1.0] if side == "jaxlag" else [1.1]
        spent = dict.fromkeys(("import_s", "derive_s", "lower_s", "compile_s", "run_ms"), 0.1)
        return {"first_s": 1.0, "end": end, **spent}

    monkeypatch.setattr(first_result, "first", first)
    with pytest.raises(RuntimeError, match=r"^simple pendulum: .* end 4\.8e-02 apart"):
        first_result.run(quick=True)


@pytest.mark.full
def test_process_reports_its_times():
    found = first_result.first("jaxlag", "simple pendulum", "2 rows", None)
    for part in ("derive_s", "lower_s", "compile_s"):  # they overlap
        assert 0 < found[part] < found["first_s"]
    assert found["run_ms"] < 1e3 * found["first_s"]
    assert len(found["end"]) == 1
