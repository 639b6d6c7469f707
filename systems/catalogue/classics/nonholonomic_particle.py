r"""Free particle with the constraint z' = y x' on its velocity.

Not in the book; Rosenberg, Analytical Dynamics of Discrete Systems (1977). The quasi-velocities
are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

         z ^
           |    .--->   the plane of possible velocities
           |   m        turns with y
           |
           +----------> x
          /
         y

Coordinates
    x, y, z    position [m]

Quasi-velocities
    xdot       x' [m/s]
    ydot       y' [m/s]
    s          z' - y x' [m/s]: 0, with y in units of 1 m

Parameters
    m          mass [kg]

    T = 1/2 m (x'^2 + y'^2 + z'^2)      V = 0
    s = z' - y x',   lambda = m z'' in N
    (1 + y^2) x'' + y x' y' = 0      y'' = 0
    y' = const,   x' = c/sqrt(1 + y^2)

The constraint must not be put into L before L is differentiated: that gives another motion.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m (x'^2 + y'^2 + z'^2) [J]."""
    return 0.5 * params["m"] * v @ v


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def velocities(t, q, v, params):
    """(xdot, ydot, s) [m/s]."""
    return jnp.stack([v[0], v[1], v[2] - q[1] * v[0]])


system = jl.System(
    coordinates=("x", "y", "z"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(velocities, ("xdot", "ydot", "s"), constrained=("s",)),
)


def exact(t, q0, v0, params):
    """Where y' is not 0, by the inverse of the hyperbolic sine."""
    y0, y_rate = q0[1], v0[1]
    y, root0 = y0 + y_rate * t, jnp.sqrt(1 + y0**2)
    root, c = jnp.sqrt(1 + y**2), v0[0] * root0
    x = c / y_rate * (jnp.arcsinh(y) - jnp.arcsinh(y0))
    z = c / y_rate * (root - root0)
    x_rate = c / root
    return q0 + jnp.stack([x, y_rate * t, z]), jnp.stack([x_rate, y_rate, y * x_rate])


entry = Entry(
    name="nonholonomic_particle",
    book="not in the book; Rosenberg (1977); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "m"),
    quasi_units=("m/s", "m/s", "m/s"),
    multiplier_units={"s": "N"},
    parameter_units={"m": "kg"},
    example=Example(
        params={"m": 1.5},
        q0=(0.0, -1.0, 0.0),
        v0=(1.0, 0.6, -1.0),
        duration=5.0,
    ),
    exact=exact,
)
