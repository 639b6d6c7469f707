r"""Pendulum bob released at rest, its speed found from the energy.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.10 (Fig. 2.15, eqs. 2.69-2.71).

    ------o- - - - - - - - - -O   released here: V = W l, T = 0
          |\         l
          | \
          |  \
          |   \
          |    O  weight W
       theta

    - - - - - - - - -  V = 0, at the bottom

Coordinates
    theta   angle of the string from the downward vertical [rad], positive
            counterclockwise

Parameters
    W       weight of the bob [N], its mass is W/g
    l       length of the string [m]
    g       gravity [m/s^2]

    T = 1/2 (W/g) l^2 theta'^2      V = W l (1 - cos(theta))

From rest at theta = pi/2 on, T + V = W l, and the bob passes the bottom at sqrt(2 g l).
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 (W/g) l^2 theta'^2 [J]."""
    return 0.5 * params["W"] / params["g"] * (params["l"] * v[0]) ** 2


def potential(t, q, params):
    """V = W l (1 - cos(theta)) [J], zero at the bottom."""
    return params["W"] * params["l"] * (1 - jnp.cos(q[0]))


def speed(t, q, v, a, params):
    """Speed of the bob, l |theta'| [m/s]."""
    return params["l"] * jnp.abs(v[0])


def bottom_speed(t, q, v, a, params):
    """Speed at the bottom by the energy at this state, sqrt(2 g (T + V)/W) [m/s]."""
    return jnp.sqrt(2 * params["g"] * system.energy(q, v, params, t=t) / params["W"])


system = jl.System(coordinates=("theta",), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """The swing by Jacobi's functions, while the bob does not turn over."""
    return _exact.swinging(t, q0, v0, jnp.sqrt(params["g"] / params["l"]))


entry = Entry(
    name="pendulum_bob_energy",
    book="ch. 2, sec. 2.10, Fig. 2.15, eqs. 2.69-2.71",
    system=system,
    coordinate_units=("rad",),
    parameter_units={"W": "N", "l": "m", "g": "m/s^2"},
    example=Example(
        params={"W": 10.0, "l": 0.9, "g": 9.81},
        q0=(2.2,),
        v0=(0.0,),
        duration=5.0,
    ),
    extras={"speed": speed, "v2_at_bottom": bottom_speed},
    exact=exact,
)
