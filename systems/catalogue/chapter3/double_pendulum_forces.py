r"""Double pendulum pulled at its joint and at its end by forces of fixed direction.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 10 (Fig. 3.20, eqs. 3.131-3.134).

    ----o----
        |\
        | \ l1
        |  \
        |   O  m1 ---> (Bx, By)
   theta1   |\
            | \ l2                      x to the right, y upward
            |  \
            |   O  m2 ---> (Fx, Fy) cos(Omega t)
         theta2

Coordinates
    theta1, theta2   angles of the links, BOTH from the downward vertical [rad],
                     positive counterclockwise (end to the right)

Parameters
    m1, m2           point masses at the joint and at the end [kg]; the book names none
    l1, l2           lengths of the massless links [m]
    g                gravity [m/s^2]
    Bx, By           force on the joint, constant [N]
    Fx, Fy           amplitude of the force on the end [N]
    Omega            its angular frequency [rad/s]

    joint = (l1 sin(theta1), -l1 cos(theta1))
    end   = joint + (l2 sin(theta2), -l2 cos(theta2))
    Q1 = (Fx cos(Omega t) + Bx) l1 cos(theta1) + (Fy cos(Omega t) + By) l1 sin(theta1)
    Q2 = Fx cos(Omega t) l2 cos(theta2) + Fy cos(Omega t) l2 sin(theta2)

T and V are those of the joint and the end, hence of `double_pendulum` with l1, l2 for h1, h2.

Misprints: 3.133 has -Fy l2 sin(theta2) in Q2, 3.134 the right sign. In remarks 1 and 2 the
derivative of the joint by theta1 is (l1 cos(theta1), +l1 sin(theta1)), printed with a minus, and
so By enters Q1 with a plus.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue._entry import Entry, Example


def joint(t, q, params):
    """Position of the joint from the pivot [m]."""
    return params["l1"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])


def end(t, q, params):
    """Position of the end from the pivot [m]."""
    return joint(t, q, params) + params["l2"] * jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])


def kinetic(t, q, v, params):
    """T of the two point masses [J]."""
    T1 = energy.particles(joint, params["m1"], t, q, v, params)
    return T1 + energy.particles(end, params["m2"], t, q, v, params)


def potential(t, q, params):
    """V of their weights [J], zero at the pivot."""
    down = jnp.array([0.0, -params["g"]])
    V1 = energy.gravity(params["m1"], joint(t, q, params), down)
    return V1 + energy.gravity(params["m2"], end(t, q, params), down)


def joint_force(t, q, v, params):
    """(Bx, By) [N]."""
    return jnp.array([params["Bx"], params["By"]])


def end_force(t, q, v, params):
    """(Fx, Fy) cos(Omega t) [N]."""
    return jnp.array([params["Fx"], params["Fy"]]) * jnp.cos(params["Omega"] * t)


def applied_force(t, q, v, a, params):
    """Generalized force Q of both (N m)."""
    return system.generalized_force(q, v, params, t=t)


system = jl.System(
    coordinates=("theta1", "theta2"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.PointForce(joint, joint_force, "joint force"),
        jl.PointForce(end, end_force, "end force"),
    ),
)

entry = Entry(
    name="double_pendulum_forces",
    book="ch. 3, Example 10, Fig. 3.20, eqs. 3.131-3.134",
    system=system,
    coordinate_units=("rad", "rad"),
    parameter_units={
        "m1": "kg",
        "m2": "kg",
        "l1": "m",
        "l2": "m",
        "g": "m/s^2",
        "Fx": "N",
        "Fy": "N",
        "Bx": "N",
        "By": "N",
        "Omega": "rad/s",
    },
    example=Example(
        params={
            "m1": 1.2,
            "m2": 0.5,
            "l1": 0.8,
            "l2": 0.6,
            "g": 9.81,
            "Fx": 1.0,
            "Fy": 0.4,
            "Bx": 2.5,
            "By": 0.5,
            "Omega": 2.5,
        },
        q0=(0.0, 0.0),
        v0=(0.0, 0.0),
        duration=10.0,
    ),
    extras={"Q": applied_force},
)
