"""States within a step by the Hermite polynomial through its ends."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._integration._quintic_hermite import hermite
from jaxlag._integration._record import Reach, reached_time

EPS = np.finfo(float).eps


def ends(q, integral, t):
    """(y, dy/dt) of coordinates and of an integral, given as functions of time."""
    v, w = (jax.jacfwd(f) for f in (q, integral))
    y = jnp.concatenate([q(t), v(t), integral(t)])
    return y, jnp.concatenate([v(t), jax.jacfwd(v)(t), w(t)])


def through(q, integral, t0, t1, t):
    (y0, f0), (y1, f1) = ends(q, integral, t0), ends(q, integral, t1)
    return hermite(t0, y0, f0, t1, y1, f1, t, 2)


def test_polynomials_are_reproduced_inside_and_beyond_the_step():
    """Of degree 5 in the coordinates, of degree 3 in integrals."""
    c = jnp.array([[0.3, -1.2, 0.7, 2.1, -0.4, 0.9], [1.0, 0.2, -0.8, 0.1, 1.3, -0.6]])
    q = lambda t: jnp.array([jnp.polyval(c[0], t), jnp.polyval(c[1], t)])  # noqa: E731
    work = lambda t: jnp.polyval(c[0, :4], t)[None]  # noqa: E731
    t0, t1 = jnp.array(0.4), jnp.array(1.1)
    for t in (0.4, 0.55, 1.1, 1.8):
        expected = ends(q, work, jnp.array(t))[0]
        # 16 roundings of the largest coefficient, at most 45 of x = 2
        np.testing.assert_allclose(
            through(q, work, t0, t1, jnp.array(t)), expected, atol=16 * 45 * EPS
        )


def test_errors_are_of_order_6_and_5():
    """Of coordinates and of velocities; of order 4 for integrals."""
    q = lambda t: jnp.array([jnp.sin(t), jnp.exp(-t)])  # noqa: E731
    work = lambda t: jnp.exp(t)[None]  # noqa: E731
    steps, part = np.array([0.2, 0.1, 0.05]), 0.3
    off = []
    for h in steps:
        t0, t1, t = jnp.array(0.7), jnp.array(0.7 + h), jnp.array(0.7 + part * h)
        error = jnp.abs(through(q, work, t0, t1, t) - ends(q, work, t)[0])
        off.append(jnp.stack([jnp.max(error[:2]), jnp.max(error[2:4]), error[4]]))
    slopes = np.polyfit(np.log(steps), np.log(np.array(off)), 1)[0]
    np.testing.assert_allclose(slopes, [6.0, 5.0, 4.0], atol=0.1)


def test_reached_time_follows_from_the_kind_of_step():
    """The end of a step to this time, of the step that contains it, or half of the way."""
    t0, t, end = jnp.array(1.0), jnp.array(1.5), jnp.array(4.0)
    found = [float(reached_time(jnp.array(int(reach)), t0, t, end)) for reach in Reach]
    assert found == [1.5, 4.0, 1.25]
