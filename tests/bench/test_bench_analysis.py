"""The benchmark of linearization: its scenes on all sides, and its verdicts."""

import numpy as np
import pytest

from bench import analysis
from bench.analysis import _one_process
from bench.analysis._scenes import SCENES


def matrix(side, scene):
    first, later = _one_process.MAKERS[side](scene)
    A = np.asarray(first())
    assert np.array_equal(later(), A) or np.max(np.abs(later() - A)) <= 1e-12 * np.max(np.abs(A))
    return A


@pytest.mark.full
@pytest.mark.parametrize("scene", SCENES)
def test_sides_agree(scene):
    A = matrix("jaxlag", scene)
    size = np.max(np.abs(A))
    assert np.max(np.abs(matrix("differences", scene) - A)) <= analysis.TRUNCATION * size
    if scene != "rolling disk":
        pytest.importorskip("sympy")
        assert np.max(np.abs(matrix("sympy", scene) - A)) <= analysis.ROUNDING * size


def row(scene, side, first_s=1.0, later_us=10.0, apart=0.0):
    figures = {"first_s": first_s, "later_us": later_us, "apart": apart}
    return {"scene": scene, "side": side, **figures}


def test_verdicts():
    rows = [
        row("a", "jaxlag", first_s=2.0),
        row("a", "differences", later_us=40.0, apart=1e-9),
        row("a", "sympy", first_s=1.0, later_us=1e5, apart=1e-14),
        row(analysis.BICYCLE, "jaxlag", first_s=7.0),
        row(analysis.BICYCLE, "differences", later_us=10.0, apart=1e-5),
        row("c", "jaxlag"),
        row("c", "differences"),
        row("c", "sympy", None, None, None),
    ]
    targets = {target.claim: target for target in analysis._targets(rows)}
    assert targets["largest difference from sympy's A"].met
    assert not targets["largest difference from differences"].met
    assert abs(targets["differences over linearize, later"].figure - 4 ** (1 / 3)) <= 1e-15
    assert not targets["bicycle, first A [s]"].met
    later, first = analysis._references(rows)
    assert (later.figure, first.figure) == ("1e+04", "0.5")


def test_a_side_that_fails_is_left_out(monkeypatch):
    answers = {"jaxlag": {"first_s": 1.0, "later_us": 1.0, "A": [[2.0]]}}
    monkeypatch.setattr(analysis, "_answer", lambda side, scene: answers.get(side, {}))
    found = {row["side"]: row for row in analysis._of("rolling disk")}
    assert found["jaxlag"]["apart"] == 0.0
    assert found["sympy"]["apart"] is None
