r"""Mass and spring at the ends of a link, at rest.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 9 (Fig. 3.18, eqs. 3.120-3.127).

    |       k       B
    |---/\/\/\/------o . . . . . . .|     end B on a horizontal guide,
    |              -->  `.   theta  |     the spring stretched by x
                    x      `.       |
                             `.     | y
                          L    `.   v
                                 `. |
                                    O A   m on a vertical guide

Coordinates
    x       stretch of the spring, displacement of B along its guide [m]
    y       drop of the mass at A [m]
    theta   angle of the link from the horizontal [rad], 0 with the spring unstretched

Parameters
    m       mass [kg]
    L       length of the massless link [m]
    k       stiffness of the spring [N/m]
    g       gravity [m/s^2]

    V = 1/2 k x^2 - m g y; a state of rest needs no T
    f1:  x - L (1 - cos(theta)) = 0, lambda1 = k x = m g cot(theta) in N
    f2:  y - L sin(theta) = 0, lambda2 = -m g in N
    lambda1 L sin(theta) + lambda2 L cos(theta) = 0
    (1 - cos(theta)) tan(theta) = m g/(k L)

There is one state of rest with theta between 0 and pi/2, and it is stable.
"""

import math

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Chart, StaticEntry, StaticExample


def kinetic(t, q, v, params):
    """T = 0: nothing moves."""
    return jnp.zeros_like(v[0])


def potential(t, q, params):
    """V = 1/2 k x^2 - m g y [J]."""
    x, y, _ = q
    return 0.5 * params["k"] * x**2 - params["m"] * params["g"] * y


def guides(t, q, params):
    """(f1, f2) = (x - L (1 - cos(theta)), y - L sin(theta)) [m]."""
    return q[:2] - on_guides(t, q[2:], params)[:2]


def on_guides(t, q, params):
    """(x, y, theta) with the ends of the link on their guides, from (theta)."""
    (theta,) = q
    ends = params["L"] * jnp.stack([1 - jnp.cos(theta), jnp.sin(theta)])
    return jnp.append(ends, theta)


def guess(params):
    """The link half way, at 45 degrees."""
    return on_guides(0.0, (0.25 * math.pi,), params)


def spring_force(rest, params):
    """Pull k x of the spring [N]."""
    return params["k"] * rest["x"]


def stiffness_along_guides(rest, params):
    """d2V/dtheta2 [N m], V of the link with its ends on their guides."""
    _, tangent = chart.state(0.0, rest.q[2:], jnp.ones(1), params)
    return tangent @ rest.stiffness @ tangent


chart = Chart(coordinates=("theta",), configuration=on_guides)

system = jl.System(
    coordinates=("x", "y", "theta"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(guides, ("f1", "f2")),),
)

entry = StaticEntry(
    name="link_spring_mass_equilibrium",
    book="ch. 3, Example 9, Fig. 3.18, eqs. 3.120-3.127",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"f1": "N", "f2": "N"},
    parameter_units={"m": "kg", "L": "m", "k": "N/m", "g": "m/s^2"},
    example=StaticExample(params={"m": 2.0, "L": 0.5, "k": 150.0, "g": 9.81}),
    chart=chart,
    guess=guess,
    values={
        "x": lambda rest, params: rest["x"],
        "y": lambda rest, params: rest["y"],
        "theta": lambda rest, params: rest["theta"],
        "lambda1": lambda rest, params: rest.multipliers["f1"],
        "lambda2": lambda rest, params: rest.multipliers["f2"],
        "spring_force": spring_force,
        "d2V_dtheta2": stiffness_along_guides,
    },
)
