r"""Lamina sliding freely in its plane under two forces of fixed direction.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.5, Example 4 (Fig. 2.6,
eqs. 2.20-2.22), read with the forces resolved on the fixed axes.

      Y1
      ^        Y                 F1, at the same angle to X1 always
      |         \      _________/
      |          \    /        /\
      |           \  /    +   o  \     (x1, y1);   + mass center (xb, yb)
      |            \/            |
      |            O___          |
      |            |   ---___    |      O   at (x, y)
      |     F2 --> o         ---___
      |      (x2, y2) \______/      X       at the angle theta to X1
      +--------------------------------> X1

Coordinates
    x, y    position of the body origin O in the fixed axes X1, Y1 [m]
    theta   angle of the body axis X from X1 [rad], counterclockwise

Parameters
    M               mass [kg]
    Iz              inertia about O [kg m^2]
    xb, yb          mass center in body axes [m]
    x1, y1, x2, y2  points where the forces act, in body axes [m]
    F1X, F1Y        force at the first point, components along X1, Y1 [N], constant
    F2X, F2Y        force at the second point, likewise [N]

T is that of `lamina_two_forces`, V = 0, and

    Q_x = F1X + F2X,   Q_y = F1Y + F2Y
    Q_theta = F1Y (x1 cos(theta) - y1 sin(theta)) - F1X (x1 sin(theta) + y1 cos(theta))
            + F2Y (x2 cos(theta) - y2 sin(theta)) - F2X (x2 sin(theta) + y2 cos(theta))

Here the book's F_x and F_y after 2.22 are right, but 2.22 itself holds only at theta = 0. Such
forces have a potential, -F1 . r1 - F2 . r2; the lamina swings about the angle at which they have
no moment about its mass center.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example
from systems.catalogue.chapter2.lamina_two_forces import geometry, kinetic, points, potential


def fixed_forces(t, q, v, params):
    """The two forces in fixed axes [N], shape (2, 3)."""
    first = (params["F1X"], params["F1Y"], 0.0)
    second = (params["F2X"], params["F2Y"], 0.0)
    return jnp.array([first, second])


def applied_force(t, q, v, a, params):
    """Generalized force Q (N, N, N m)."""
    return system.generalized_force(q, v, params, t=t)


def momentum_less_impulse(t, q, v, a, params):
    """(p_x, p_y) minus the resultant times t [N s]."""
    impulse = jnp.sum(fixed_forces(t, q, v, params), axis=0) * t
    return system.momentum(q, v, params, t=t)[:2] - impulse[:2]


def energy_less_work(t, q, v, a, params):
    """H - F1 . r1 - F2 . r2 [J]."""
    work = jnp.sum(fixed_forces(t, q, v, params) * points(t, q, params))
    return system.energy(q, v, params, t=t) - work


system = jl.System(
    coordinates=("x", "y", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(points, fixed_forces, "F1 and F2"),),
)

entry = Entry(
    name="lamina_two_forces_fixed_direction",
    book="ch. 2, sec. 2.5, Example 4, Fig. 2.6, eqs. 2.20-2.22",
    system=system,
    coordinate_units=("m", "m", "rad"),
    parameter_units={**geometry, **dict.fromkeys(("F1X", "F1Y", "F2X", "F2Y"), "N")},
    example=Example(
        params={
            "M": 1.5,
            "Iz": 0.25,
            "xb": 0.15,
            "yb": 0.1,
            "x1": 0.6,
            "y1": 0.2,
            "x2": -0.2,
            "y2": 0.3,
            "F1X": 3.0,
            "F1Y": 1.0,
            "F2X": -2.0,
            "F2Y": 0.5,
        },
        q0=(0.0, 0.0, 1.5),
        v0=(0.2, -0.1, 0.0),
        duration=6.0,
    ),
    extras={"Q": applied_force},
    invariants={
        "p_less_impulse": momentum_less_impulse,
        "H_less_work": energy_less_work,
    },
)
