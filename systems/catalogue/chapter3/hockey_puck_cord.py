r"""Hockey puck on smooth ice, pulled by a cord that unwinds in a fixed direction.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, secs. 3.11-3.12 (Figs. 3.25-3.28,
eqs. 3.161-3.162 and 3.167-3.168).

    y ^        .------.
      |      .'        '.
      |     /            \
      |    |      G       |
      |     \     | R    /
      |      '.   |    .'
      |        '------'--------> F1    shown for gamma = 0; the cord's free
      +-----------------------------> x    part gets longer by R theta

Coordinates
    theta   turn of the puck [rad], positive counterclockwise from above
    x, y    its center G in the plane of the ice [m]

Parameters
    M       mass [kg]
    kappa   radius of gyration about G [m]
    R       radius of the puck, around which the cord is wound [m]
    F1      pull of the cord [N], constant
    gamma   direction of the cord against x [rad], constant; 0 in 3.161-3.162 and 3.167

    T = 1/2 M kappa^2 theta'^2 + 1/2 M (x'^2 + y'^2)      V = 0
    Q = (F1 R, F1 cos(gamma), F1 sin(gamma))

All accelerations are constant: theta'' = F1 R/(M kappa^2), x'' = F1 cos(gamma)/M,
y'' = F1 sin(gamma)/M. The pull acts on the cord's end, whose displacement includes the length that
unwinds. The point where the cord leaves the puck is at rest relative to G; as the point of
application it would give no moment.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example
from systems.catalogue.chapter3 import hockey_puck


def cord_end(t, q, params):
    """The pulled end of the cord [m], up to a constant."""
    theta, x, y = q
    unwound = params["R"] * theta
    c, s = jnp.cos(params["gamma"]), jnp.sin(params["gamma"])
    return jnp.stack([x + unwound * c, y + unwound * s])


def pull(t, q, v, params):
    """F1 along the cord, x and y components [N]."""
    return params["F1"] * jnp.array([jnp.cos(params["gamma"]), jnp.sin(params["gamma"])])


system = jl.System(
    coordinates=("theta", "x", "y"),
    kinetic=hockey_puck.kinetic,
    potential=hockey_puck.potential,
    forces=(jl.PointForce(cord_end, pull, "cord"),),
)


def exact(t, q0, v0, params):
    """The slide and the spin under constant accelerations."""
    spin = params["F1"] * params["R"] / (params["M"] * params["kappa"] ** 2)
    acceleration = pull(t, q0, v0, params) / params["M"]
    return _exact.accelerated(t, q0, v0, jnp.append(spin, acceleration))


entry = Entry(
    name="hockey_puck_cord",
    book="ch. 3, secs. 3.11-3.12, Figs. 3.25-3.28, eqs. 3.161-3.162, 3.167-3.168",
    system=system,
    coordinate_units=hockey_puck.entry.coordinate_units,
    parameter_units={**hockey_puck.entry.parameter_units, "gamma": "rad"},
    example=Example(
        params={**hockey_puck.entry.example.params, "gamma": 0.5},
        q0=(0.0, 0.0, 0.0),
        v0=(-2.0, 0.0, 0.05),
        duration=3.0,
    ),
    invariants={"initial_spin": hockey_puck.initial_spin},
    exact=exact,
)
