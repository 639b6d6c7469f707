"""Forces that bend: found in the program, and derivatives across them as good as the motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._kinks import has_kinks

G = 9.81
X = jnp.array([0.3, -0.2, 0.5])

BENT = {
    "minimum": lambda x: jnp.minimum(x[0], 0.0),
    "where": lambda x: jnp.where(x[0] > 0, x[0], 2 * x[0]),
    "abs": lambda x: jnp.abs(x[0]),
    "largest": jnp.max,
    "relu": lambda x: jax.nn.relu(x[0]),
    "cond": lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x[1]),
    "in a loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, c: jnp.maximum(c, x[0]), x[1]),
    "under jit": jax.jit(lambda x: jnp.clip(x[0], -1.0, 1.0)),
    "table": lambda x: jnp.interp(x[0], X, X),
    "round": lambda x: x[0] - jnp.round(x[0]),
}
SMOOTH = {
    "sine": lambda x: jnp.sin(x[0]),
    "norm": lambda x: jl.math.norm(x) + jnp.linalg.norm(x),
    "angle": lambda x: jl.math.atan2(x[0], x[1]) + jl.math.sinc(x[2]) + jl.math.cosc_sqrt(x[0]),
    "softplus": lambda x: jax.nn.softplus(x[0]),
    "a place": lambda x: jnp.where(x[0] == 0, 1.0, jnp.sin(x[0])),
    "determinant": lambda x: jnp.linalg.det(jnp.eye(3) * x[0]),
    "loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, c: c * x[i], 1.0),
    "network": lambda x: jnp.sum(jax.nn.gelu(jnp.tanh(x))),
}


def bends(function, *fixed):
    program = jax.make_jaxpr(function)(X, *fixed).jaxpr
    return has_kinks(program, [i == 0 for i in range(len(program.invars))])


@pytest.mark.parametrize("name", BENT)
def test_a_program_that_bends(name):
    assert bends(BENT[name])


@pytest.mark.parametrize("name", SMOOTH)
def test_a_program_that_does_not(name):
    assert not bends(SMOOTH[name])


def test_what_does_not_move_is_compared_freely():
    assert not bends(lambda x, p: jnp.where(p > 0, x[0], jnp.sin(x[0])), jnp.array(1.0))
    assert not bends(lambda x, i: x[jnp.where(i > 1, i, 0)], jnp.array(2))


def floor(t, q, v, params):
    return 0.5 * v[0] ** 2 - G * q[0] - 0.5 * params["k"] * jnp.minimum(q[0], 0.0) ** 2


def height(h, k, t):
    """Of a ball on springs of k, dropped from h at rest, at t."""
    fall, w = jnp.sqrt(2 * h / G), jnp.sqrt(k)
    contact = 2 * (jnp.pi - jnp.arctan(fall * w)) / w
    r = t % (2 * fall + contact)
    in_contact = -G / k + G / k * jnp.cos(w * (r - fall)) - G * fall / w * jnp.sin(w * (r - fall))
    up = h - G * (r - 2 * fall - contact) ** 2 / 2
    return jnp.where(r < fall, h - G * r**2 / 2, jnp.where(r < fall + contact, in_contact, up))


@pytest.fixture(scope="module")
def ball():
    """From (h, k, method) to the height after 1.5 s: two flights from 1 m."""
    system = jl.System(floor, ("x",))

    def end(h, k, method="auto"):
        motion = jl.simulate(system, h[None], jnp.zeros(1), [0.0, 1.5], {"k": k}, method=method)
        return motion["x"][-1]

    return end


@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_derivatives_across_a_bend(ball, mode):
    """In height and stiffness: 1 to 2 % off where the motion was right to 1e-8 m.

    Worst of 300 heights and stiffnesses: 4e-5; of these four 1e-7 and 2e-6.
    """
    k = jnp.array([1e3, 1e4, 8e4, 1e6])
    h = jnp.ones(4)
    found = jax.jit(jax.vmap(mode(ball, (0, 1))))(h, k)
    exact = jax.vmap(jax.grad(height, (0, 1)), in_axes=(0, 0, None))(h, k, 1.5)
    np.testing.assert_allclose(found[0], exact[0], rtol=1e-5)
    np.testing.assert_allclose(found[1], exact[1], rtol=1e-5)


@pytest.mark.full
@pytest.mark.parametrize("method", ["prince9", "tsit5", "dopri5", "bosh3", "kvaerno5"])
def test_derivatives_across_a_bend_by_other_methods(ball, method):
    slopes = jax.grad(ball, (0, 1))(jnp.array(1.0), jnp.array(1e4), method)
    exact = jax.grad(height, (0, 1))(1.0, 1e4, 1.5)
    np.testing.assert_allclose(slopes, exact, rtol=1e-3 if method == "kvaerno5" else 1e-4)


def test_smooth_motions_keep_their_steps():
    """A spring of a length: a norm compares within, but nothing bends. A switch far away does."""

    def lagrangian(t, q, v, params):
        stretch = jl.math.norm(q) - 1.0
        far = jnp.where(q[0] > 1e3, q[0], 0.0) if params["switch"] else 0.0
        return 0.5 * (v @ v) - 4.0 * stretch**2 - q[1] + far

    system = jl.System(lagrangian, ("x", "y"))

    def end(q0, switch):
        params = {"switch": switch}
        motion = jl.simulate(system, q0, [0.0, 0.0], [0.0, 3.0], params)
        return motion.q[-1, 0], motion.stats["accepted"] + motion.stats["rejected"]

    for switch, more in ((False, 1.0), (True, 1.6)):
        q0 = jnp.array([1.2, 0.1])
        plain = int(end(q0, switch)[1])
        (_, count), _ = jax.value_and_grad(end, has_aux=True)(q0, switch)
        assert plain <= int(count) <= more * plain
