r"""Atwood's machine by three coordinates, the cord two constraints.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 16 (Fig. 3.30).

         =======
            |
          .-o-.    pulley m3, kappa, R, turned by theta; the
         (  .  )   cord does not slip
         |'---'|
      T1 |     | T2
         |     |
       +----+  |
       | m1 | +----+
       +----+ | m2 |
     y1 v     +----+
            y2 v

Coordinates
    y1, y2   descents of m1 and m2 [m]
    theta    turn of the pulley [rad], in the sense in which m1 descends

Parameters
    m1, m2   hanging masses [kg]
    m3       mass of the pulley [kg]
    kappa    its radius of gyration [m]
    R        its radius [m]
    g        gravity [m/s^2]

    T = 1/2 m1 y1'^2 + 1/2 m2 y2'^2 + 1/2 m3 kappa^2 theta'^2      V = -g (m1 y1 + m2 y2)
    cord1:  y1 - R theta = 0, lambda = -T1 in N
    cord2:  y2 + R theta = 0, lambda = -T2 in N
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m1 y1'^2 + 1/2 m2 y2'^2 + 1/2 m3 kappa^2 theta'^2 [J]."""
    y1_rate, y2_rate, w = v
    masses = 0.5 * params["m1"] * y1_rate**2 + 0.5 * params["m2"] * y2_rate**2
    return masses + 0.5 * params["m3"] * (params["kappa"] * w) ** 2


def potential(t, q, params):
    """V = -g (m1 y1 + m2 y2) [J]."""
    return -params["g"] * (params["m1"] * q[0] + params["m2"] * q[1])


def slip(t, q, params):
    """(y1 - R theta, y2 + R theta), descents of the masses minus those of the cord [m]."""
    y1, y2, theta = q
    return jnp.stack([y1 - params["R"] * theta, y2 + params["R"] * theta])


system = jl.System(
    coordinates=("y1", "y2", "theta"),
    kinetic=kinetic,
    potential=potential,
    constraints=(jl.Holonomic(slip, ("cord1", "cord2")),),
)


def exact(t, q0, v0, params):
    """The fall under a constant acceleration."""
    m1, m2, R = params["m1"], params["m2"], params["R"]
    inertia = m1 + m2 + params["m3"] * (params["kappa"] / R) ** 2
    a = (m1 - m2) * params["g"] / inertia
    return _exact.accelerated(t, q0, v0, jnp.stack([a, -a, a / R]))


entry = Entry(
    name="atwood_multipliers",
    book="ch. 3, Example 16, Fig. 3.30",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"cord1": "N", "cord2": "N"},
    parameter_units={"m1": "kg", "m2": "kg", "m3": "kg", "kappa": "m", "R": "m", "g": "m/s^2"},
    example=Example(
        params={"m1": 1.1, "m2": 1.0, "m3": 0.4, "kappa": 0.07, "R": 0.1, "g": 9.81},
        q0=(0.0, 0.0, 0.0),
        v0=(-0.8, 0.8, -8.0),
        duration=4.0,
    ),
    exact=exact,
)
