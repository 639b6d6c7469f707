r"""Slider-crank: a crank, a connecting rod and a slider, closed by two constraints.

Not in the book; the constraints are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 3, eqs. 3.10-3.11 and 3.118.

        y ^
          |        B
          |       o.
          |   r  /  `.  l    uniform links, m1 and m2
          |     /     `.
          |    / theta  `.  C
    ------+---O---------+-[o]+----> x    slider m3 on its smooth guide
                           x

Coordinates
    theta        angle of the crank O-B from the guide [rad], counterclockwise
    phi          angle of the rod B-C from the guide [rad], counterclockwise: negative with B
                 above the guide
    x            distance of the slider from O [m]

Parameters
    r, l         lengths of crank and rod [m], r < l
    m1, m2, m3   masses of crank, rod and slider [kg]
    g            gravity [m/s^2]

    T = 1/2 (m1 r^2/3 + m2 r^2) theta'^2 + 1/2 m2 r l theta' phi' cos(theta - phi)
        + 1/2 m2 l^2/3 phi'^2 + 1/2 m3 x'^2
    V = (m1/2 + m2) g r sin(theta) + m2/2 g l sin(phi)
    pin_x:  r cos(theta) + l cos(phi) - x = 0, lambda = force on the rod at C along x in N
    pin_y:  r sin(theta) + l sin(phi) = 0, lambda = force on the rod at C along y in N
    m3 x'' = -lambda of pin_x; the guide carries m3 g + lambda of pin_y

With r < l the crank turns all the way round: there is no dead point, for the rod is never at right
angles to the guide.
"""

import math

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _links
from systems.catalogue._entry import Entry, Example


def lengths(params):
    """(r, l) [m]."""
    return jnp.stack([params["r"], params["l"]])


def masses(params):
    """(m1, m2) of the links [kg]."""
    return jnp.stack([params["m1"], params["m2"]])


def kinetic(t, q, v, params):
    """T of the links and of the slider [J]."""
    moving = _links.kinetic(masses(params), lengths(params), q[:2], v[:2])
    return moving + 0.5 * params["m3"] * v[2] ** 2


def potential(t, q, params):
    """V of the weights of the links [J], zero at the height of the guide."""
    return _links.potential(masses(params), lengths(params), q[:2], params["g"])


def gap(t, q, params):
    """End C of the rod from the slider's pin, along x and y [m]."""
    x, y = _links.heads(lengths(params), q[:2])[-1]
    return jnp.stack([x - q[2], y])


def guide_force(t, q, v, a, params):
    """Force of the guide on the slider, upward [N]."""
    return params["m3"] * params["g"] + system.multipliers(q, v, params, t=t)["pin_y"]


system = jl.System(
    coordinates=("theta", "phi", "x"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(gap, ("pin_x", "pin_y")),),
)

entry = Entry(
    name="slider_crank",
    book="not in the book; ch. 3, eqs. 3.10-3.11 and 3.118",
    system=system,
    coordinate_units=("rad", "rad", "m"),
    multiplier_units={"pin_x": "N", "pin_y": "N"},
    parameter_units={"r": "m", "l": "m", "m1": "kg", "m2": "kg", "m3": "kg", "g": "m/s^2"},
    example=Example(
        params={"r": 0.3, "l": 0.5, "m1": 0.6, "m2": 0.4, "m3": 1.2, "g": 9.81},
        q0=(0.5 * math.pi, -math.asin(0.6), 0.4),
        v0=(8.0, 0.0, -2.4),
        duration=3.0,
    ),
    extras={"guide_force": guide_force},
)
