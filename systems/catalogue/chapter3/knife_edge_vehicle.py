r"""Vehicle on a knife edge, driven along the edge on an inclined plane.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.3, eqs. 3.12-3.13). The book
stops at the constraint; masses, slope and drives are additions.

       Y ^        j      i, along the edge
         |         \   /
         |          \ /   G   mass center, a ahead of A
         |         / A    m, I
         |        /    theta
         |      edge
         +--------------------> X, downhill; the plane is inclined by beta

Coordinates
    X_A, Y_A   position of the edge A in the plane, X downhill [m]
    theta      angle of the edge from X [rad], counterclockwise

Parameters
    m          mass [kg]
    I          inertia about the mass center G [kg m^2]
    a          distance of G ahead of A [m]; 0 in the simplest reading of the book
    g          gravity [m/s^2]
    beta       slope of the plane [rad]
    F0         amplitude of the drive along the edge at A [N]
    tau0       amplitude of the torque [N m]
    Omega      angular frequency of both [rad/s]

    T = 1/2 m [(X' - a theta' sin(theta))^2 + (Y' + a theta' cos(theta))^2] + 1/2 I theta'^2
    V = -m g sin(beta) (X + a cos(theta))
    Q = (F0 cos(Omega t) cos(theta), F0 cos(Omega t) sin(theta), tau0 sin(Omega t))
    edge:  -X' sin(theta) + Y' cos(theta) = 0, lambda = force on A along j in N

Misprint: the last form of 3.13, X' - Y'/tan(theta) = 0, is singular at theta = 0; the form above
is not.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue._entry import Entry, Example


def edge(t, q, params):
    """Position of A [m]."""
    return q[:2]


def center(t, q, params):
    """Position of the mass center G [m]."""
    return q[:2] + params["a"] * forward(q)


def forward(q):
    """Unit vector along the edge."""
    return jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])


def kinetic(t, q, v, params):
    """T of the mass center and of the turn about it [J]."""
    moving = energy.particles(center, params["m"], t, q, v, params)
    return moving + 0.5 * params["I"] * v[2] ** 2


def potential(t, q, params):
    """V = -m g sin(beta) (X + a cos(theta)) [J]."""
    downhill = params["g"] * jnp.sin(params["beta"]) * jnp.array([1.0, 0.0])
    return energy.gravity(params["m"], center(t, q, params), downhill)


def drive(t, q, v, params):
    """F0 cos(Omega t) along the edge [N]."""
    return params["F0"] * jnp.cos(params["Omega"] * t) * forward(q)


def turning(t, q, v, params):
    """theta' [rad/s]."""
    return v[2]


def torque(t, q, v, params):
    """tau0 sin(Omega t) [N m]."""
    return params["tau0"] * jnp.sin(params["Omega"] * t)


def sideways_velocity(t, q, v, params):
    """Velocity of A across the edge, along j [m/s] (3.13)."""
    return -v[0] * jnp.sin(q[2]) + v[1] * jnp.cos(q[2])


def forward_velocity(t, q, v, a, params):
    """u = X' cos(theta) + Y' sin(theta), the speed of A along the edge [m/s]."""
    return v[:2] @ forward(q)


system = jl.System(
    coordinates=("X_A", "Y_A", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(edge, drive, "drive"), jl.Torque(turning, torque, "torque")),
    constraints=(jl.Pfaffian(sideways_velocity, "edge"),),
)

entry = Entry(
    name="knife_edge_vehicle",
    book="ch. 3, sec. 3.1, Fig. 3.3, eqs. 3.12-3.13",
    system=system,
    coordinate_units=("m", "m", "rad"),
    multiplier_units={"edge": "N"},
    parameter_units={
        "m": "kg",
        "I": "kg m^2",
        "a": "m",
        "g": "m/s^2",
        "beta": "rad",
        "F0": "N",
        "tau0": "N m",
        "Omega": "rad/s",
    },
    example=Example(
        params={
            "m": 1.2,
            "I": 0.15,
            "a": 0.1,
            "g": 9.81,
            "beta": 0.15,
            "F0": 0.8,
            "tau0": 0.05,
            "Omega": 2.0,
        },
        q0=(0.0, 0.0, 0.0),
        v0=(0.5, 0.0, 1.5),
        duration=6.0,
    ),
    extras={"u_forward": forward_velocity},
)
