r"""Atwood's machine: two masses on a cord over a massive pulley.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 16 (Fig. 3.30, eq. 3.172).

         =======
            |
          .-o-.    pulley m3, kappa, R; the cord
         (  .  )   does not slip
         |'---'|
      T1 |     | T2
         |     |
       +----+  |
       | m1 | +----+
       +----+ | m2 |
     y v      +----+

Coordinate
    y        descent of m1 = rise of m2 = R times the turn of the pulley [m]

Parameters
    m1, m2   hanging masses [kg]
    m3       mass of the pulley [kg]
    kappa    its radius of gyration [m]
    R        its radius [m]
    g        gravity [m/s^2]

    I = m3 kappa^2
    T = 1/2 (m1 + m2 + I/R^2) y'^2      V = -(m1 - m2) g y
    y'' = (m1 - m2) g/(m1 + m2 + I/R^2)
    T1 = m1 (g - y''),  T2 = m2 (g + y'')

The book prints y'' without the pulley, (m1 - m2) g/(m1 + m2), and says how to add it (3.172).
With a massive pulley T1 and T2 differ; that their moments cancel holds for the system as a whole.
"""

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 (m1 + m2 + m3 kappa^2/R^2) y'^2 [J]."""
    pulley = params["m3"] * (params["kappa"] / params["R"]) ** 2
    return 0.5 * (params["m1"] + params["m2"] + pulley) * v[0] ** 2


def potential(t, q, params):
    """V = -(m1 - m2) g y [J]."""
    return -(params["m1"] - params["m2"]) * params["g"] * q[0]


def tension1(t, q, v, a, params):
    """Tension of the cord on m1 [N]."""
    return params["m1"] * (params["g"] - a[0])


def tension2(t, q, v, a, params):
    """Tension of the cord on m2 [N]."""
    return params["m2"] * (params["g"] + a[0])


def massless_pulley(t, q, v, a, params):
    """y'' if the pulley had no mass [m/s^2] (3.172)."""
    m1, m2 = params["m1"], params["m2"]
    return (m1 - m2) * params["g"] / (m1 + m2)


system = jl.System(coordinates=("y",), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """The fall under a constant acceleration."""
    m1, m2 = params["m1"], params["m2"]
    inertia = m1 + m2 + params["m3"] * (params["kappa"] / params["R"]) ** 2
    return _exact.accelerated(t, q0, v0, (m1 - m2) * params["g"] / inertia)


entry = Entry(
    name="atwood_machine",
    book="ch. 3, Example 16, Fig. 3.30, eq. 3.172",
    system=system,
    coordinate_units=("m",),
    parameter_units={"m1": "kg", "m2": "kg", "m3": "kg", "kappa": "m", "R": "m", "g": "m/s^2"},
    example=Example(
        params={"m1": 1.1, "m2": 1.0, "m3": 0.4, "kappa": 0.07, "R": 0.1, "g": 9.81},
        q0=(0.0,),
        v0=(-0.8,),
        duration=4.0,
    ),
    extras={
        "tension1": tension1,
        "tension2": tension2,
        "y_ddot_massless_pulley": massless_pulley,
    },
    exact=exact,
)
