r"""Upright wheel that rolls along a curved path on an inclined plane.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.2 (Fig. 3.6, eq. 3.17). Slope and
torques are additions.

       Y ^          .  path
         |        /
         |     ==o==    wheel seen from above, rolling towards phi;
         |    / '       roll angle theta about its axle
         |  .'  phi
         +--------------------> X, downhill; the plane is inclined by beta

Coordinates
    x, y    point of contact in the plane, X downhill [m]
    phi     heading from X [rad], counterclockwise
    theta   roll of the wheel about its axle [rad]

Parameters
    m       mass [kg]
    r       radius [m]
    Iw      inertia about the axle [kg m^2]
    Id      inertia about a diameter [kg m^2]
    g       gravity [m/s^2]
    beta    slope of the plane [rad]
    tau_r   amplitude of the torque about the axle [N m]
    tau_s   steering torque about the normal of the plane [N m], constant
    Omega   angular frequency of the torque about the axle [rad/s]

    T = 1/2 m (x'^2 + y'^2) + 1/2 Iw theta'^2 + 1/2 Id phi'^2
    V = -m g sin(beta) x
    Q = (0, 0, tau_s, tau_r cos(Omega t))
    rolling_x:  x' - r cos(phi) theta' = 0, lambda = force of the ground along X in N    (3.17)
    rolling_y:  y' - r sin(phi) theta' = 0, lambda = force of the ground along Y in N
    (Iw + m r^2) theta'' = tau_r cos(Omega t) + m g sin(beta) r cos(phi)
    Id phi'' = tau_s

3.17 takes phi as the angle of the path; the wheel's own heading needs the equation above.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _rolling
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of the mass center, of the roll and of the turn [J]."""
    x_rate, y_rate, heading_rate, roll = v
    moving = 0.5 * params["m"] * (x_rate**2 + y_rate**2)
    return moving + 0.5 * params["Iw"] * roll**2 + 0.5 * params["Id"] * heading_rate**2


def potential(t, q, params):
    """V = -m g sin(beta) x [J]."""
    return -params["m"] * params["g"] * jnp.sin(params["beta"]) * q[0]


def torques(t, q, v, params):
    """Q = (0, 0, tau_s, tau_r cos(Omega t)) (N, N, N m, N m)."""
    roll = params["tau_r"] * jnp.cos(params["Omega"] * t)
    return jnp.array([0.0, 0.0, params["tau_s"], roll])


def slip(t, q, v, params):
    """Velocity of the wheel at the point of contact along X, Y [m/s] (3.17)."""
    return _rolling.of_upright_wheel(v[:2], q[2], v[3], params["r"])


system = jl.System(
    coordinates=("x", "y", "phi", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(torques, "torques"),),
    constraints=(jl.Pfaffian(slip, ("rolling_x", "rolling_y")),),
)

entry = Entry(
    name="rolling_wheel_curved_path",
    book="ch. 3, sec. 3.2, Fig. 3.6, eq. 3.17",
    system=system,
    coordinate_units=("m", "m", "rad", "rad"),
    multiplier_units={"rolling_x": "N", "rolling_y": "N"},
    parameter_units={
        "m": "kg",
        "r": "m",
        "Iw": "kg m^2",
        "Id": "kg m^2",
        "g": "m/s^2",
        "beta": "rad",
        "tau_r": "N m",
        "tau_s": "N m",
        "Omega": "rad/s",
    },
    example=Example(
        params={
            "m": 1.5,
            "r": 0.3,
            "Iw": 0.07,
            "Id": 0.04,
            "g": 9.81,
            "beta": 0.1,
            "tau_r": 0.4,
            "tau_s": 0.02,
            "Omega": 2.0,
        },
        q0=(0.0, 0.0, 0.0, 0.0),
        v0=(1.2, 0.0, 0.8, 4.0),
        duration=6.0,
    ),
)
