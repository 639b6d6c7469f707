"""Motions of work over error: right equations, ends to 20 digits."""

import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from bench._problems import exact_ends
from bench._problems.motions import MOTIONS
from bench.work_precision import _jax, _peers, _straight_line

EPS = np.finfo(float).eps
motion_of = cache(lambda name: MOTIONS[name]())
SINGLE = [name for name in MOTIONS if name != "16 double pendulums"]


def state_near_the_start(motion, seed):
    """A consistent y away from the start."""
    rng = np.random.default_rng(seed)
    y = motion.start()
    if motion.rates.__name__ != "cartesian_pendulum":
        return y + rng.uniform(-0.2, 0.2, y.size) * np.maximum(0.5, np.abs(y)) ** 0.5
    angles, rates = jnp.asarray(rng.uniform(-2, 2, 2)), jnp.asarray(rng.uniform(-2, 2, 2))

    def bobs(q):
        ends = jnp.cumsum(jnp.stack([jnp.sin(q), -jnp.cos(q)], 1), 0)
        return ends.ravel()

    return np.concatenate(jax.jvp(bobs, (angles,), (rates,)))


def acceleration(motion, y):
    """(q, v, a): velocities by the explicit kinematics, accelerations by jaxlag."""
    n = len(motion.q0)
    q, v = jnp.asarray(y[:n]), jnp.asarray(motion.evaluate(y)[:n])
    return q, v, jnp.asarray(motion.system.acceleration(q, v, motion.params))


@pytest.mark.parametrize("name", mostly_full(SINGLE, "heavy top"))
def test_explicit_equations_equal_those_of_the_system(name):
    """So are all forms in which solvers get them."""
    motion = motion_of(name)
    y = state_near_the_start(motion, 1)
    n = len(motion.q0)
    q, v, a = acceleration(motion, y)
    if motion.speeds is None:
        speeds, rates = v, a
    else:
        speeds_of = lambda q, v: motion.speeds(0.0, q, v, motion.params)  # noqa: E731
        speeds, rates = jax.jvp(speeds_of, (q, v), (v, a))
    assert np.allclose(speeds, y[n:], rtol=1e-13, atol=1e-13)
    # Rounding of terms that cancel: k r of the spring, M of the chain (condition about 1e3).
    canceling = motion.params.get("k", 1e2 if n == 8 else 1.0)
    bound = 300 * EPS * max(float(jnp.max(jnp.abs(rates))), canceling)
    expected = np.array(motion.evaluate(y))
    assert np.max(np.abs(expected[n:] - rates)) < bound

    out = [0.0] * len(y)
    assert np.max(np.abs(np.array(_peers.plain(motion)(0.0, y.tolist(), out)) - expected)) < bound
    params = {key: jnp.asarray(value) for key, value in motion.params.items()}
    by_hand = jax.jit(_jax.by_hand(motion))(0.0, jnp.asarray(y), params)
    assert np.max(np.abs(by_hand - expected)) < bound
    naive = jax.jit(_jax.naive(motion))(0.0, jnp.concatenate([q, v]), params)
    assert (
        np.max(np.abs(naive - jnp.concatenate([v, a]))) < 10 * bound
    )  # its solve uses no structure


def test_generated_source_repeats_no_operation():
    motion = MOTIONS["heavy top"]()
    lines = _straight_line.source(motion.rates, motion.params, 6).splitlines()
    right = [line.split(" = ")[1] for line in lines if " = x" in line or " = (" in line]
    operations = [text for text in right if len(text.split()) == 3]
    assert operations
    assert len(set(operations)) == len(operations)


def test_ends_are_stored_for_every_motion_to_20_digits():
    ends = json.loads(exact_ends.PATH.read_text())["ends"]
    assert list(ends) == list(MOTIONS)
    for name, make in MOTIONS.items():
        motion = make()
        assert exact_ends.exact_end(name).shape == motion.q0.shape
        numbers = np.ravel(ends[name])
        assert all(
            len(number.lstrip("-0.").split("E")[0].replace(".", "")) >= 17 for number in numbers
        )


@pytest.mark.parametrize(("name", "e"), [("Kepler, e = 0.6", 0.6), ("Kepler, e = 0.9", 0.9)])
def test_stored_ends_of_orbits_are_their_starts(name, e):
    """After 100 periods they are at their start, up to rounding of the span and of the start."""
    motion = motion_of(name)
    off = np.abs(exact_ends.exact_end(name) - motion.q0)
    # The start has an error of one rounding, the period as much, times its growth with 1 / (1 - e).
    late = motion.t1 * EPS * 4.0 / (1.0 - e)
    assert off[0] < EPS
    assert off[1] < motion.v0[1] * late


@pytest.mark.full
@pytest.mark.parametrize("name", ["rigid aircraft", "rolling disk", "16 double pendulums"])
def test_stored_ends_equal_those_of_a_tight_solve(name):
    motion = motion_of(name)
    line = _jax.with_jaxlag(motion, "dopri8")
    solved = line.read(line.make(1e-13)())
    assert motion.error(solved.q, exact_ends.exact_end(name)) < 1e-9
