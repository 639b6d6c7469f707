"""The fuzzer: what it draws, that it finds what is wrong, and what it leaves behind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench import fuzz
from bench._random_systems import ONE, TWO, Drawn, draw, smaller, text
from bench._rounding import evaluated
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
    assert find["declared"].startswith("L = 1.0 * (0.5 * (2.0 * v[0] ** 2) - (")
    assert "; Q = []; params = {'a': [0.1, " in find["declared"]
    assert [target.met for target in report.targets] == [False, True]


@pytest.mark.parametrize(
    ("off", "least", "most"),
    [(0.0, 0.0, 0.0), (1e-15, 0.0, 0.1), (1e-9, 1e3, 1e6), (np.nan, np.inf, np.inf)],
)
def test_differences_are_measured_by_what_roundings_change(off, least, most):
    right = np.array([[[1.0, 2.0]], [[1.0 + 1e-15, 2.0]]])
    found = right[0] + off
    assert least <= fuzz._off(right, found, right[0], 2.0**-52) <= most
    # Where the array program has no value, anything is right.
    assert fuzz._off(np.full_like(right, np.nan), found, right[0], 2.0**-52) == 0.0


def test_roundings_show_the_digits_that_a_result_has():
    """(1 + x) - 1 has the digits that 1 + x has; what is only moved has all."""

    def cancels(x):
        return jax.jit(lambda x: (1.0 + x) - 1.0)(x), -jnp.stack([x, x])[::-1]

    traced = jax.make_jaxpr(cancels)(1e-6)
    plain, moved = evaluated(traced, [jnp.asarray(1e-6)])
    assert (plain, *moved) == ((1.0 + 1e-6) - 1.0, -1e-6, -1e-6)
    rng = np.random.default_rng(0)
    eps = 2.0**-52
    several = [evaluated(traced, [jnp.asarray(1e-6)], eps, rng) for _ in range(20)]
    off = [float(abs(x[0] - 1e-6)) for x in several]
    assert 0.3 * eps < max(off) <= 1.7 * eps  # eps / 2 rounds once more
    assert all((x[1] == -1e-6).all() for x in several)
