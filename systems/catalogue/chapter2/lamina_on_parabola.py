r"""Lamina with one of its points sliding on a smooth parabola.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.5, Example 5, part 2 (Fig. 2.7(2),
eqs. 2.26-2.27). Gravity is an addition: the book stops at T.

     .      y1 ^          .
      .        |         .
       .       |        .
        .      |      .O___     body origin O, at (x1, y1)
          .    |    .  |\   \
             . | .     | \   \    Y is 90 deg counterclockwise from X
    -----------+-------|--\ + \------> x1
                      phi  \___\  + mass center (xb, yb); M, Iz
                            X

Coordinates
    x1, y1   position of O, to the right and upward [m]
    phi      angle of the body axis X from the downward vertical [rad], counterclockwise

Parameters
    M        mass of the lamina [kg]
    Iz       its inertia about O [kg m^2], more than M (xb^2 + yb^2)
    b        shape of the parabola [1/m]
    xb, yb   mass center from O in body axes [m]
    g        gravity [m/s^2]

    T = 1/2 M (x1'^2 + y1'^2) + 1/2 Iz phi'^2
        + M phi' [(y1' sin(phi) + x1' cos(phi)) xb - (x1' sin(phi) - y1' cos(phi)) yb]    (2.26)
    V = M g [y1 - xb cos(phi) + yb sin(phi)]
    parabola:  y1 - b x1^2 = 0, reaction lambda (-2 b x1, 1) on the lamina at O, lambda in N

The code puts the inertial x axis downward and y to the right: the body is turned by phi about z.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def pose(t, q, params):
    """Rotation of the body axes and position of O, x downward and y to the right."""
    x1, y1, phi = q
    return jl.rotation.about_z(phi), jnp.stack([-y1, x1, jnp.zeros_like(x1)])


def lamina(params):
    """The lamina by its inertia about O."""
    center = (params["xb"], params["yb"], 0.0)
    return jl.energy.RigidBody(params["M"], (0.0, 0.0, params["Iz"]), center)


def kinetic(t, q, v, params):
    """T of the lamina [J] (2.16, 2.26)."""
    return lamina(params).kinetic(pose, t, q, v, params)


def potential(t, q, params):
    """V of the weight [J], zero with the mass center at the height of the vertex."""
    return lamina(params).gravity(pose, t, q, params, (params["g"], 0.0, 0.0))


def height_above_parabola(t, q, params):
    """y1 - b x1^2 of the point O [m] (2.27)."""
    return q[1] - params["b"] * q[0] ** 2


system = jl.System(
    coordinates=("x1", "y1", "phi"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(height_above_parabola, "parabola"),),
)

entry = Entry(
    name="lamina_on_parabola",
    book="ch. 2, sec. 2.5, Example 5, Fig. 2.7, eqs. 2.26-2.27",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"parabola": "N"},
    parameter_units={
        "M": "kg",
        "Iz": "kg m^2",
        "b": "1/m",
        "xb": "m",
        "yb": "m",
        "g": "m/s^2",
    },
    example=Example(
        params={"M": 1.5, "Iz": 0.12, "b": 1.25, "xb": 0.12, "yb": 0.05, "g": 9.81},
        q0=(-0.4, 0.2, 0.9),
        v0=(0.0, 0.0, 0.0),
        duration=4.0,
    ),
)
