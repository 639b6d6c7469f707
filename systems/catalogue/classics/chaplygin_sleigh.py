r"""Chaplygin sleigh: a body on a smooth plane with a blade that does not slip sideways.

Not in the book; Chaplygin, Mat. Sbornik 28 (1911) 303; Neimark, Fufaev, Dynamics of Nonholonomic
Systems (1972). The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

       y ^        v_n     v
         |          \    /  along the blade
         |           \  /  G   mass center, a ahead of the blade
         |         blade     m, I
         |           /  theta
         +--------------------> x

Coordinates
    x, y       position of the blade [m]
    theta      its direction from x [rad]

Quasi-velocities
    v          velocity of the blade along itself [m/s]
    v_n        velocity of the blade across itself [m/s]: 0
    omega      theta' [rad/s]

Parameters
    m          mass [kg]
    I          inertia about the mass center G [kg m^2]
    a          distance of G ahead of the blade [m]

    T = 1/2 m |velocity of G|^2 + 1/2 I theta'^2      V = 0
    v   =  x' cos(theta) + y' sin(theta)
    v_n = -x' sin(theta) + y' cos(theta),   lambda = m (v omega + a omega') on the blade in N
    v' = a omega^2
    (I + m a^2) omega' = -m a v omega

The energy is constant, and yet v tends to sqrt(2 T/m) and omega to 0 from every start that turns.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def ahead(q):
    """Unit vector along the blade."""
    return jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])


def center(t, q, params):
    """Position of the mass center [m]."""
    return q[:2] + params["a"] * ahead(q)


def kinetic(t, q, v, params):
    """T of the mass center and of the turn about it [J]."""
    moving = energy.particles(center, params["m"], t, q, v, params)
    return moving + 0.5 * params["I"] * v[2] ** 2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def velocities(t, q, v, params):
    """(v, v_n, omega) (m/s, m/s, rad/s)."""
    c, s = ahead(q)
    return jnp.stack([v[0] * c + v[1] * s, -v[0] * s + v[1] * c, v[2]])


system = jl.System(
    coordinates=("x", "y", "theta"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(velocities, ("v", "v_n", "omega"), constrained=("v_n",)),
)


def exact(t, q0, v0, params):
    """A sleigh that turns, by hyperbolic functions, and the path along them."""
    m, a = params["m"], params["a"]
    J = params["I"] + m * a**2
    forward, _, turning = velocities(0.0, q0, v0, params)
    sense, size = jnp.sign(turning), jnp.sqrt(J / m)
    C = jnp.sqrt(forward**2 + (size * turning) ** 2)
    s0, rate = jnp.arctanh(forward / C), m * a * C / J

    def angle(s):
        return sense * size / a * 2 * jnp.arctan(jnp.tanh(s / 2))

    def moved(t):
        """(theta, v) at t."""
        s = s0 + rate * t
        return q0[2] + angle(s) - angle(s0), C * jnp.tanh(s)

    def path(direction):
        def rate(t):
            theta, v = moved(t)
            return v * direction(theta)

        return _exact.integral(rate, t), rate(t)

    (x, x_rate), (y, y_rate) = path(jnp.cos), path(jnp.sin)
    omega = sense * C / size / jnp.cosh(s0 + rate * t)
    q = jnp.stack([q0[0] + x, q0[1] + y, moved(t)[0]])
    return q, jnp.stack([x_rate, y_rate, omega])


entry = Entry(
    name="chaplygin_sleigh",
    book="not in the book; Chaplygin (1911); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad"),
    quasi_units=("m/s", "m/s", "rad/s"),
    multiplier_units={"v_n": "N"},
    parameter_units={"m": "kg", "I": "kg m^2", "a": "m"},
    example=Example(
        params={"m": 2.0, "I": 0.6, "a": 0.4},
        q0=(0.0, 0.0, 0.0),
        v0=(-1.0, 0.0, 0.4),
        duration=8.0,
    ),
    exact=exact,
)
