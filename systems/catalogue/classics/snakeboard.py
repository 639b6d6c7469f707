r"""Snakeboard: two steered wheel sets and a rotor, moved by torques inside.

Not in the book; Lewis, Ostrowski, Murray, Burdick, IEEE Conf. Robotics and Automation (1994) 2391.
The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 2.

       y ^                     /  phi
         |              __ ==(/)   front wheels
         |          psi  _ .-'  r
         |      \   __ .O        O  board at (x, y) with the rotor
         |    --(\) == '    r
         |   phi   \  back wheels, steered the other way      theta: board from x
         +------------------------> x

Coordinates
    x, y         center of the board [m]
    theta        direction of the board from x [rad]
    psi          angle of the rotor from the board [rad]
    phi          front wheels from the board [rad]; the back ones are at -phi

Quasi-velocities
    xi           rate of the motion that the wheels allow [rad/s]
    psidot       psi' [rad/s]
    phidot       phi' [rad/s]
    n_front      velocity of the front wheels across themselves [m/s]: 0
    n_back       velocity of the back wheels across themselves [m/s]: 0

Parameters
    m            mass of all [kg]
    r            half the distance of the axles [m]
    J            inertia of the board [kg m^2]
    J_r          inertia of the rotor [kg m^2]
    J_w          inertia of each wheel set [kg m^2]
    a_psi        amplitude of the torque on the rotor [N m]
    w_psi        its angular frequency [rad/s]
    a_phi        amplitude of the torque on the wheels [N m]
    w_phi        its angular frequency [rad/s]

    T = 1/2 m (x'^2 + y'^2) + 1/2 J theta'^2 + 1/2 J_r (theta' + psi')^2
        + 1/2 J_w [(theta' + phi')^2 + (theta' - phi')^2]      V = 0
    Q = (0, 0, 0, a_psi sin(w_psi t), a_phi sin(w_phi t))
    n_front = -x' sin(theta + phi) + y' cos(theta + phi) + r theta' cos(phi)
    n_back  = -x' sin(theta - phi) + y' cos(theta - phi) - r theta' cos(phi)
              lambda = forces across the wheels in N
    xi = cos(phi)/r (x' cos(theta) + y' sin(theta)) + theta' sin(phi)
    with s = sin(phi), c = cos(phi) and Jb = J + 2 J_w:
    forward speed r xi c,   theta' = xi s
    (m r^2 c^2 + Jb s^2) xi' + (Jb - m r^2) s c xi phi' + a_psi sin(w_psi t) s = 0
    J_r (theta'' + psi'') = a_psi sin(w_psi t),   2 J_w phi'' = a_phi sin(w_phi t)

The two constraints are one at phi = +-pi/2; phi must stay between. Without torques the energy and
the momentum J_r (theta' + psi') are constant.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of board, rotor and wheels [J]."""
    x_rate, y_rate, theta_rate, rotor, steer = v
    moving = 0.5 * params["m"] * (x_rate**2 + y_rate**2) + 0.5 * params["J"] * theta_rate**2
    wheels = 0.5 * params["J_w"] * ((theta_rate + steer) ** 2 + (theta_rate - steer) ** 2)
    return moving + 0.5 * params["J_r"] * (theta_rate + rotor) ** 2 + wheels


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def torques(t, q, v, params):
    """Q = (0, 0, 0, a_psi sin(w_psi t), a_phi sin(w_phi t)) (N, N, N m, N m, N m)."""
    rotor = params["a_psi"] * jnp.sin(params["w_psi"] * t)
    wheels = params["a_phi"] * jnp.sin(params["w_phi"] * t)
    return jnp.array([0.0, 0.0, 0.0, rotor, wheels])


def velocities(t, q, v, params):
    """(xi, psidot, phidot, n_front, n_back) (rad/s, m/s)."""
    theta, phi, r, theta_rate = q[2], q[4], params["r"], v[2]
    along = v[0] * jnp.cos(theta) + v[1] * jnp.sin(theta)
    xi = jnp.cos(phi) / r * along + theta_rate * jnp.sin(phi)
    lever = r * theta_rate * jnp.cos(phi)
    front = -v[0] * jnp.sin(theta + phi) + v[1] * jnp.cos(theta + phi) + lever
    back = -v[0] * jnp.sin(theta - phi) + v[1] * jnp.cos(theta - phi) - lever
    return jnp.stack([xi, v[3], v[4], front, back])


system = jl.System(
    coordinates=("x", "y", "theta", "psi", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(torques, "torques"),),
    quasi=jl.QuasiVelocities(
        velocities,
        ("xi", "psidot", "phidot", "n_front", "n_back"),
        constrained=("n_front", "n_back"),
    ),
)

entry = Entry(
    name="snakeboard",
    book="not in the book; Lewis et al. (1994); ch. 4, sec. 4.3, Example 2",
    system=system,
    coordinate_units=("m", "m", "rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s", "m/s", "m/s"),
    multiplier_units={"n_front": "N", "n_back": "N"},
    parameter_units={
        "m": "kg",
        "r": "m",
        **dict.fromkeys(("J", "J_r", "J_w"), "kg m^2"),
        "a_psi": "N m",
        "w_psi": "rad/s",
        "a_phi": "N m",
        "w_phi": "rad/s",
    },
    example=Example(
        params={
            "m": 5.0,
            "r": 0.25,
            "J": 0.25,
            "J_r": 0.15,
            "J_w": 0.05,
            "a_psi": 0.6,
            "w_psi": 3.0,
            "a_phi": -0.25,
            "w_phi": 3.0,
        },
        q0=(0.0, 0.0, 0.0, 0.0, 0.0),
        v0=(0.0, 0.0, 0.0, 0.0, 0.833),
        duration=10.0,
    ),
)
