"""The fuzzer: what it draws, that it finds what is wrong, and what it leaves behind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench import fuzz
from bench._random_systems import ONE, TWO, Drawn, draw, smaller, text
from jaxlag._lowering import ScalarTerms

SEEDS = range(40)
SMALL = Drawn(
    n=1,
    kinetic=(),
    potential=("({0}) * jnp.sin({1})", ('p["b"]',), ("q[0]",)),
    force=(("-({0})", ("v[0]",)),),
    masses=(2.0,),
    params={"a": [0.1, 0.2, 0.3], "b": 3.0, "k": 1.0},
    units=(1.0,),
    scale=1.0,
    dtype="float64",
    second=False,
)


def test_what_is_drawn_is_a_system_of_its_own_for_every_seed():
    drawn = [draw(seed) for seed in SEEDS]
    assert drawn == [draw(seed) for seed in SEEDS]
    assert len({x.lagrangian for x in drawn}) == len(drawn)
    assert {x.dtype for x in drawn} == {"float32", "float64"}
    assert {x.n for x in drawn} == {1, 2, 3, 4, 5}
    used = " ".join(x.lagrangian for x in map(draw, range(300)))
    for template in (*ONE, *TWO):  # by the longest piece that every use of it has
        assert max(template.replace("{1}", "{0}").split("{0}"), key=len) in used


def test_every_operation_is_one_of_jax():
    q = jnp.array([0.3, -0.7])
    for template in (*ONE, *TWO):
        tree = (template, ("q[0]",), ("q[1]",))[: 2 + (template in TWO)]
        drawn = SMALL._replace(n=2, potential=tree, masses=(1.0, 1.0), units=(1.0, 1.0), force=())
        params = {"a": jnp.ones(3), "b": 1.0, "k": 1.0}
        L = jax.eval_shape(lambda d=drawn, p=params: d.system.lagrangian(0.0, q, q, p))
        assert L.shape == (), text(tree)


def test_smaller_systems_are_smaller_and_systems():
    drawn = draw(5)
    found = list(smaller(drawn))
    assert len(found) > 5
    assert min(len(x.lagrangian) for x in found) < len(drawn.lagrangian)
    for other in found[:5]:
        params = {"a": jnp.ones(3), "b": 1.0, "k": 1.0}
        other.system.check_traceable(params, jnp.float64, {})


def test_a_wrong_program_is_found_and_written_down(monkeypatch):
    right = ScalarTerms.acceleration

    def wrong(self, *args, **options):
        a = right(self, *args, **options)
        return a + 1e-6 * jnp.sin(a)

    monkeypatch.setattr(fuzz, "draw", lambda seed: SMALL)
    assert fuzz.compared(SMALL).kind == "equal"
    monkeypatch.setattr(ScalarTerms, "acceleration", wrong)
    report = fuzz.run(True, seconds=1e-3, first=7)
    find = report.rows[-1]
    assert find["kind"].startswith("seed 7: ")
    assert find["systems"] > 1.0
    # Made smaller as far as it differs: of the force nothing is left.
    assert find["lagrangian"].startswith("1.0 * (0.5 * (2.0 * v[0] ** 2) - (")
    assert find["force"] == []
    assert [target.met for target in report.targets] == [False, True]


@pytest.mark.parametrize(
    ("off", "least", "most"),
    [(0.0, 0.0, 0.0), (1e-15, 0.0, 0.1), (1e-9, 1e2, 1e5), (np.nan, np.inf, np.inf)],
)
def test_differences_are_measured_by_what_nudges_change(off, least, most):
    right = np.array([[[1.0, 2.0]], [[1.0 + 1e-15, 2.0]]])
    found = right + off
    assert least <= fuzz._off(right, found, 2.0**-53, fuzz.SLACK) <= most
    # Where the array program has no value, anything is right.
    assert fuzz._off(np.full_like(right, np.nan), found, 2.0**-53, fuzz.SLACK) == 0.0
