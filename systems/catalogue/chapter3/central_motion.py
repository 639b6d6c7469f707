r"""Particle under a central force: an attracting center and a spring to it.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 19; the book leaves V(r) general,
here V(r) = -K/r + c r^2/2.

                     O  m
                  .
            r  .
            .
         .  )  phi
        +------------------- fixed axis
     center

Coordinates
    r     distance from the center [m], positive
    phi   angle of the radius from a fixed axis [rad], positive counterclockwise

Parameters
    m     mass [kg]
    K     strength of the attraction, force K/r^2 [N m^2]
    c     stiffness of the spring, force c r [N/m]

    T = 1/2 m (r'^2 + r^2 phi'^2)      V = -K/r + 1/2 c r^2
    p_r = m r',  p_phi = m r^2 phi' (constant)
    H = p_r^2/(2 m) + p_phi^2/(2 m r^2) + V(r)
    p_r' = p_phi^2/(m r^3) - dV/dr

Misprint: p_r' is printed with p_phi^2/(2 m r^3); the 2 does not belong there.
"""

import jax

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m (r'^2 + r^2 phi'^2) [J]."""
    r, _ = q
    r_rate, w = v
    return 0.5 * params["m"] * (r_rate**2 + (r * w) ** 2)


def potential(t, q, params):
    """V = -K/r + 1/2 c r^2 [J]."""
    r = q[0]
    return -params["K"] / r + 0.5 * params["c"] * r**2


def angular_momentum(t, q, v, a, params):
    """p_phi = m r^2 phi' [kg m^2/s]."""
    return params["m"] * q[0] ** 2 * v[1]


def radial_momentum_rate(t, q, v, a, params):
    """p_r' = p_phi^2/(m r^3) - dV/dr [N]."""
    p_phi = angular_momentum(t, q, v, a, params)
    force = jax.grad(potential, argnums=1)(t, q, params)[0]
    return p_phi**2 / (params["m"] * q[0] ** 3) - force


system = jl.System(coordinates=("r", "phi"), kinetic=kinetic, potential=potential)

entry = Entry(
    name="central_motion",
    book="ch. 3, Example 19",
    system=system,
    coordinate_units=("m", "rad"),
    parameter_units={"m": "kg", "K": "N m^2", "c": "N/m"},
    example=Example(
        params={"m": 1.0, "K": 4.0, "c": 0.3}, q0=(1.0, 0.0), v0=(0.0, 2.4), duration=12.0
    ),
    extras={"p_r_dot": radial_momentum_rate},
    invariants={"p_phi": angular_momentum},
)
