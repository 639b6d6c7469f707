r"""Double pendulum at rest under dead loads at its joint and at its end.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 10 (static use of eqs. 3.24-3.25 and
3.133).

    ----o----
        |\
        | \ l1
        |  \
        |   O  m1 ---> (Bx, By)
   theta1   |\
            | \ l2                      x to the right, y upward
            |  \
            |   O  m2 ---> (Fx, Fy)
         theta2

Coordinates
    theta1, theta2   angles of the links, BOTH from the downward vertical [rad],
                     positive counterclockwise (end to the right)

Parameters
    m1, m2   point masses at the joint and at the end [kg]
    l1, l2   lengths of the massless links [m]
    g        gravity [m/s^2]
    Bx, By   force on the joint [N]
    Fx, Fy   force on the end [N]

V and the points are those of the moving pendulum; a state of rest needs no T. Each link hangs
along the resultant of the forces at its lower end:

    theta1 = atan2(Fx + Bx, (m1 + m2) g - Fy - By),   theta2 = atan2(Fx, m2 g - Fy)

This is the stable one of four states of rest; the others have one link or both turned by pi.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import StaticEntry, StaticExample
from systems.catalogue.chapter3 import double_pendulum_forces
from systems.catalogue.chapter3.double_pendulum_forces import end, joint, joint_force, potential


def kinetic(t, q, v, params):
    """T = 0: nothing moves."""
    return jnp.zeros_like(v[0])


def end_force(t, q, v, params):
    """(Fx, Fy) [N]."""
    return jnp.array([params["Fx"], params["Fy"]])


def guess(params):
    """Half a radian from the resultant of the forces at each lower end: near the stable state.

    From angles of zero, large loads lead to other states, in which a link is upside down.
    """
    Fx, down = params["Fx"], params["m2"] * params["g"] - params["Fy"]
    theta1 = jnp.arctan2(Fx + params["Bx"], params["m1"] * params["g"] + down - params["By"])
    return theta1 + 0.5, jnp.arctan2(Fx, down) - 0.5


system = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.PointForce(joint, joint_force, "joint force"),
        jl.PointForce(end, end_force, "end force"),
    ),
)

entry = StaticEntry(
    name="double_pendulum_static_load",
    book="ch. 3, Example 10, eqs. 3.24-3.25 and 3.133",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        name: unit
        for name, unit in double_pendulum_forces.entry.parameter_units.items()
        if name != "Omega"
    },
    example=StaticExample(
        params={
            "m1": 1.2,
            "m2": 0.5,
            "l1": 0.8,
            "l2": 0.6,
            "g": 9.81,
            "Fx": 2.0,
            "Fy": -0.5,
            "Bx": 3.0,
            "By": 1.5,
        },
    ),
    guess=guess,
)
