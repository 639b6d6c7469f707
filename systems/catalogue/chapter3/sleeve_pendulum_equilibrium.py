r"""Sleeve on a rod held by a spring, at rest.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Examples 7 and 14 (Figs. 3.12-3.14 and 3.24,
eq. 3.100).

    ----A----
        |
        \     spring k, unstretched length L0,
        /     from A to the upper end of the sleeve
        |
       |||    sleeve M2, length L2, mass center at x1 from A
       |||
        |     rod M1, length L1, hanging at theta = 0

Coordinates
    x1      distance of the sleeve's mass center from the hinge A along the rod [m]
    theta   angle of the rod from the downward vertical [rad]

Parameters
    M1, L1   rod: mass [kg], length [m]
    M2, L2   sleeve: mass [kg], length [m]
    k, L0    spring: stiffness [N/m], unstretched length [m]
    g        gravity [m/s^2]

V is that of the moving sleeve pendulum; a state of rest needs no T. The virtual work vanishes for
theta = 0 and k (x1 - L0 - L2/2) = M2 g.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import StaticEntry, StaticExample
from systems.catalogue.chapter3 import sleeve_pendulum


def kinetic(t, q, v, params):
    """T = 0: nothing moves."""
    return jnp.zeros_like(v[0])


def guess(params):
    """The rod hanging, the spring unstretched."""
    return params["L0"] + 0.5 * params["L2"], 0.0


def spring_stretch(rest, params):
    """Stretch x1 - L0 - L2/2 of the spring [m]."""
    return rest["x1"] - params["L0"] - 0.5 * params["L2"]


system = jl.System(
    coordinates=sleeve_pendulum.system.coordinates.names,
    kinetic=kinetic,
    potential=sleeve_pendulum.potential,
)

entry = StaticEntry(
    name="sleeve_pendulum_equilibrium",
    book="ch. 3, Examples 7 and 14, eq. 3.100",
    system=system,
    coordinate_units=("m", "rad"),
    parameter_units={
        "M1": "kg",
        "M2": "kg",
        "L1": "m",
        "L2": "m",
        "L0": "m",
        "k": "N/m",
        "g": "m/s^2",
    },
    example=StaticExample(
        params={"M1": 1.2, "M2": 0.8, "L1": 1.1, "L2": 0.2, "L0": 0.35, "k": 60.0, "g": 9.81},
    ),
    guess=guess,
    values={"spring_stretch": spring_stretch},
)
