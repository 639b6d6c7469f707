r"""Four-bar linkage: crank, coupler and rocker between two pivots, closed by two constraints.

Not in the book; the constraints are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 3, eqs. 3.10-3.11 and 3.118.

                       coupler b    .o C
     y ^             _ . - '         |
       |     B  o- '                 |
       |       /                     |  rocker c
       |   a  /                      |
       |     / theta1                |
       +----O-----------------------oD----> x
                       d

Coordinates
    theta1, theta2, theta3   angles of O-B, B-C and C-D from x [rad], counterclockwise: theta3 is
                             negative with C above D

Parameters
    a, b, c      lengths of crank, coupler and rocker [m]
    d            distance of the pivots [m]
    m1, m2, m3   masses of the three uniform links [kg]
    g            gravity [m/s^2]

    T, V of three uniform links joined head to tail
    pivot_x:  a cos(theta1) + b cos(theta2) + c cos(theta3) - d = 0
    pivot_y:  a sin(theta1) + b sin(theta2) + c sin(theta3) = 0
    lambda = force of the pivot D on the rocker along x and y in N

If the shortest and the longest link together are shorter than the other two, the shortest makes
full turns (Grashof). The example has angles of coupler and rocker with errors of 20 %, as if read
from a sketch. They are assembled with the crank held.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _links
from systems.catalogue._entry import Entry, Example


def lengths(params):
    """(a, b, c) [m]."""
    return jnp.stack([params["a"], params["b"], params["c"]])


def masses(params):
    """(m1, m2, m3) [kg]."""
    return jnp.stack([params["m1"], params["m2"], params["m3"]])


def kinetic(t, q, v, params):
    """T of the three links [J]."""
    return _links.kinetic(masses(params), lengths(params), q, v)


def potential(t, q, params):
    """V of their weights [J], zero at the height of the pivots."""
    return _links.potential(masses(params), lengths(params), q, params["g"])


def gap(t, q, params):
    """End of the rocker from the pivot D, along x and y [m]."""
    x, y = _links.heads(lengths(params), q)[-1]
    return jnp.stack([x - params["d"], y])


system = jl.System(
    coordinates=("theta1", "theta2", "theta3"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(gap, ("pivot_x", "pivot_y")),),
)

entry = Entry(
    name="four_bar",
    book="not in the book; ch. 3, eqs. 3.10-3.11 and 3.118",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    multiplier_units={"pivot_x": "N", "pivot_y": "N"},
    parameter_units={
        "a": "m",
        "b": "m",
        "c": "m",
        "d": "m",
        "m1": "kg",
        "m2": "kg",
        "m3": "kg",
        "g": "m/s^2",
    },
    example=Example(
        params={
            "a": 0.4,
            "b": 1.1,
            "c": 0.8,
            "d": 1.0,
            "m1": 0.8,
            "m2": 1.1,
            "m3": 0.8,
            "g": 9.81,
        },
        q0=(1.0, 0.48, -1.5),
        v0=(9.0, 0.0, 0.0),
        duration=3.0,
        hold=("theta1", "theta1'"),
    ),
)
