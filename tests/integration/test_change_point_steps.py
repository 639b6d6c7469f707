"""Choice of steps around a change point, and rows that are left out at it."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from jaxlag._integration._change_points import (
    AHEAD,
    BESIDE,
    LOST,
    ROOM,
    SHORT,
    narrow,
    no_crossing,
    widest_gap,
)
from jaxlag._integration._tableaus import nodes_of
from jaxlag._linalg._kkt import FORMULATIONS, solve_kkt
from jaxlag._simulation._methods import METHODS

EPS = np.finfo(float).eps
NARROW, CLOSE = narrow(float), narrow(float) / 3


@pytest.mark.parametrize("method", ["dopri8", "tsit5", "prince9", "kvaerno5"])
def test_stages_are_far_from_the_change_point(method):
    """The step across is at most the proposed one; its stages are as far away as possible."""
    nodes = np.array([0.0, *nodes_of(METHODS[method]()), 1.0])
    gap = widest_gap(nodes.tolist())
    clearance = np.min(np.abs(nodes - gap))
    assert clearance > 0.03
    t, h = jnp.array(2.0), jnp.array(0.3)
    for left in (0.05, 0.1, 0.25, 0.5, 0.8):
        known = ahead_of(t, left * h, 0.5 * SHORT)
        step = float(known.step(t, h, gap))
        assert step <= h
        if left < gap:
            np.testing.assert_allclose(left * h / step, gap, rtol=1e-12)
        else:  # the next step does, and is about as long as proposed
            across = float(known.step(t + step, h, gap))
            np.testing.assert_allclose((left * 0.3 - step) / across, gap, rtol=1e-12)
            np.testing.assert_allclose(across, ROOM * h, rtol=1e-12)


def ahead_of(t, left, apart):
    """A known change point, `left` ahead of t."""
    return no_crossing(t, 1, float)._replace(time=t + left, independence=jnp.array(apart))


def test_saves_beyond_the_change_point_shorten_the_step():
    """It leads up to a row length of NARROW, by at most 0.9 of the distance; then across."""
    t, h, gap = jnp.array(2.0), jnp.array(0.3), 0.6
    for apart, without in ((0.9 * AHEAD, h), (0.9 * SHORT, 0.1 / gap), (2 * NARROW, 0.1 / gap)):
        known = ahead_of(t, 0.1, apart)
        np.testing.assert_allclose(known.step(t, h, gap, due=jnp.array(2.4)), without, rtol=1e-12)
        lead = 0.1 * (1 - max(NARROW / apart, 0.1))
        np.testing.assert_allclose(known.step(t, h, gap, due=jnp.array(2.25)), lead, rtol=1e-12)
    near = ahead_of(t, 0.1, NARROW)
    np.testing.assert_allclose(near.step(t, h, gap, due=jnp.array(2.25)), 0.1 / gap, rtol=1e-12)
    # Also for a change point so near that no stage would lie before it.
    beside = ahead_of(t, 0.001, 0.5 * NARROW)
    assert float(beside.step(t, h, gap)) == 0.3
    np.testing.assert_allclose(beside.step(t, h, gap, due=jnp.array(2.25)), 0.001 / gap, rtol=1e-12)


def test_last_step_is_short_or_has_no_stage_at_the_change_point():
    """The last step is short, or has the change point between its stages."""
    t, h, gap = jnp.array(2.0), jnp.array(0.3), 0.6
    far, near = ahead_of(t, 0.1, SHORT), ahead_of(t, 0.1, NARROW)
    at = jnp.array(2.1 + 0.04 * CLOSE * 0.1 / SHORT)
    assert far.is_at(t, at)
    assert not far.is_at(t, 2.1 + 1.01 * CLOSE * 0.1 / SHORT)
    assert not far.is_at(t, 2.1 - 1.01 * CLOSE * 0.1 / SHORT)
    np.testing.assert_allclose(far.step(t, h, gap, at), 0.1 * (1 - NARROW / SHORT), rtol=1e-12)
    assert float(near.step(t, h, gap, jnp.array(2.1))) == 0.3  # cut at the end of the motion
    beyond = jnp.array(2.11)
    lead = float(far._replace(independence=jnp.array(0.9 * SHORT)).step(t, h, gap, beyond))
    np.testing.assert_allclose((0.1 - lead) / (0.11 - lead), gap, rtol=1e-9)


def test_time_of_the_change_point_is_extrapolated_linearly():
    """A row length that goes linearly through zero; none if it grows, or is long."""
    t0, t1, t2 = jnp.array(0.0), jnp.array(1.0), jnp.array(1.5)
    begin = no_crossing(t0, 2, float)
    moved = jnp.array([0.006, 0.008])
    first = begin.onwards(t0, t1, jnp.array(0.08), 92 * moved)  # 0.92 of a length of 1
    second = first.onwards(t1, t2, jnp.array(0.04), 4 * moved)
    np.testing.assert_allclose(second.time, 2.0, rtol=1e-12)
    np.testing.assert_allclose(second.span, 100 * moved, rtol=1e-12)
    assert second.is_near
    assert jnp.isinf(second.onwards(t2, jnp.array(2.5), jnp.array(0.08), moved).time)
    assert jnp.isinf(begin.onwards(t0, t1, jnp.array(1.1 * AHEAD), moved).time)
    assert second._replace(independence=jnp.array(BESIDE * 0.03)).is_beside(second)
    assert not second._replace(independence=jnp.array(0.03)).is_beside(second)


def test_dependent_rows_are_accepted_for_a_limited_distance():
    """Over twice the distance that the decrease of the rows implies; at a cusp this is exceeded."""
    t0, t1 = jnp.array(0.0), jnp.array(1.0)
    moved = jnp.array([0.6, 0.8])
    begin = no_crossing(t0, 2, float).onwards(t0, t1, jnp.array(0.05), 0.95 * moved)
    begin = begin.onwards(t0, t1, jnp.array(0.0), 0.05 * moved)
    assert begin.depends
    assert begin.passes
    distance = 2 * LOST
    across = begin.onwards(t0, t1, jnp.array(0.9 * LOST), 0.95 * distance * moved)
    assert across.passes
    assert across.onwards(t0, t1, jnp.array(0.1), 0.1 * moved).passes  # little of it at the point
    assert not across.onwards(t0, t1, jnp.array(LOST), 2 * distance * moved).passes
    # s = d^(3/2), step by step from 1 to the dependent part
    ends = np.geomspace(1.0, LOST ** (2 / 3), 30)
    cusp = no_crossing(t0, 2, float)
    for d0, d1 in itertools.pairwise(ends):
        cusp = cusp.onwards(t0, t1, jnp.array(d1**1.5 * (1 - EPS)), (d0 - d1) * moved)
    assert cusp.depends
    assert not cusp.onwards(t0, t1, jnp.array(0.5 * LOST), ends[-1] * moved).passes


# ---- Rows that are left out ----------------------------------------------------------------------


@pytest.mark.full
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(("n", "m"), mostly_full([(3, 2), (6, 4), (12, 9)], (6, 4)))
def test_a_row_that_depends_on_those_before_it_is_left_out(formulation, n, m):
    """x is as without the row, and its multiplier is zero; otherwise nothing changes."""
    rng = np.random.default_rng(n)
    half = rng.normal(size=(n, n))
    M, A, r = half @ half.T + np.eye(n), rng.normal(size=(m, n)), rng.normal(size=n)
    mix, c = rng.normal(size=m - 1), rng.normal(size=m)
    A[-1], c[-1] = mix @ A[:-1], mix @ c[:-1]

    def solved(rows=slice(None), **options):
        given = (jnp.asarray(x) for x in (M, A[rows], r, c[rows]))
        return solve_kkt(*given, formulation=formulation, **options)

    x, lam = solved(crossing=True)
    expected, of_others = solved(slice(m - 1))
    allowed = 100 * EPS * np.linalg.cond(M)
    np.testing.assert_allclose(x, expected, atol=allowed * np.abs(expected).max())
    np.testing.assert_allclose(lam[:-1], of_others, atol=allowed * np.abs(of_others).max())
    assert lam[-1] == 0
    assert np.isnan(solved()[0]).all()
    A[-1] = rng.normal(size=n)
    for one, other in zip(solved(crossing=True), solved(), strict=True):
        np.testing.assert_array_equal(one, other)
