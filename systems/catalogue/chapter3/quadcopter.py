r"""Quadcopter with four rotors at constant speeds.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 5 (Fig. 3.10, eqs. 3.74-3.89).

    seen from above:   body x
                         ^
                        (1)         rotors 1, 3 turn clockwise,
                         |  l              2, 4 counterclockwise
    body y <---(2)-------G-------(4)
                         |          rotor i lifts with f_i = k wi^2 along body z
                        (3)

Coordinates
    X, Y, Z           mass center G [m], Z upward
    psi, theta, phi   yaw, pitch, roll [rad]: R = Rz(psi) Ry(theta) Rx(phi)    (3.81)

Parameters
    m                 mass [kg]
    Ix, Iy, Iz        principal moments of inertia [kg m^2]
    l                 arm from G to each rotor [m]
    g                 gravity [m/s^2]
    k, b              thrust [N s^2] and drag torque [N m s^2] per square of rotor speed
    Im                inertia of one rotor about its shaft [kg m^2]
    w1, w2, w3, w4    rotor speeds, positive [rad/s]

    omega = (phi' - psi' sin(theta),
             theta' cos(phi) + psi' cos(theta) sin(phi),
             psi' cos(theta) cos(phi) - theta' sin(phi))                       (3.78)
    T = 1/2 m (X'^2 + Y'^2 + Z'^2) + 1/2 (Ix omega_x^2 + Iy omega_y^2 + Iz omega_z^2)
    V = m g Z
    thrust  u = f1 + f2 + f3 + f4 along body z, at G
    torque  ((f2 - f4) l, (f3 - f1) l, b (w1^2 - w2^2 + w3^2 - w4^2)) - omega x (0, 0, h)
            in body axes, with the spin h = Im (-w1 + w2 - w3 + w4) of the rotors

Yaw and roll cannot be distinguished at theta = +-pi/2, where the mass matrix is singular.

Errors in the book: 3.76 is no kinetic energy, for the angle rates are not components of omega
(3.79 is right). 3.82 swaps the arms of pitch (rotors 1, 3) and roll (2, 4), and uses body torques
as generalized torques of the angles: Q = W^T torque, where omega = W (psi', theta', phi'). The
spin h needs the signs above, and its torque about body y is +omega_x h. In 3.83 m g has the wrong
sign (3.87 is right). The velocity terms of 3.86 and what follows are not 1/2 of the gradient of
(angle rates)^T J (angle rates), so that energy is lost; near hover psi'' = torque_z/Iz and
phi'' = torque_x/Ix, with Ix and Iz interchanged in print.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag.rotation import yaw_pitch_roll
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """Components of omega along the body axes [rad/s] (3.78)."""
    return yaw_pitch_roll.body_rates(q[3:], v[3:])


def kinetic(t, q, v, params):
    """T of the mass center and of the rotation [J] (3.79)."""
    omega = angular_velocity(t, q, v, params)
    inertia = jnp.array([params["Ix"], params["Iy"], params["Iz"]])
    return 0.5 * params["m"] * v[:3] @ v[:3] + 0.5 * inertia @ omega**2


def potential(t, q, params):
    """V = m g Z [J]."""
    return params["m"] * params["g"] * q[2]


def center(t, q, params):
    """Position of the mass center [m]."""
    return q[:3]


def lift(params):
    """Thrust f_i = k wi^2 of each rotor [N]."""
    return params["k"] * _speeds(params) ** 2


def thrust_force(t, q, v, params):
    """Thrust of all rotors, X, Y, Z components [N]."""
    body_z = yaw_pitch_roll.matrix(q[3:])[:, 2]
    return jnp.sum(lift(params)) * body_z


def torque(t, q, v, params):
    """Torque of the rotors on the frame, components along the body axes [N m]."""
    w1, w2, w3, w4 = _speeds(params)
    f1, f2, f3, f4 = lift(params)
    arm = params["l"]
    drag = params["b"] * (w1**2 - w2**2 + w3**2 - w4**2)
    spin = jnp.array([0.0, 0.0, params["Im"] * (-w1 + w2 - w3 + w4)])
    gyroscopic = -jnp.cross(angular_velocity(t, q, v, params), spin)
    return jnp.stack([(f2 - f4) * arm, (f3 - f1) * arm, drag]) + gyroscopic


def _speeds(params):
    return jnp.array([params["w1"], params["w2"], params["w3"], params["w4"]])


def thrust(t, q, v, a, params):
    """Thrust of all rotors together [N]."""
    return jnp.sum(lift(params))


def body_rates(t, q, v, a, params):
    """Components of omega along the body axes [rad/s]."""
    return angular_velocity(t, q, v, params)


def body_torque(t, q, v, a, params):
    """Torque of the rotors along the body axes [N m]."""
    return torque(t, q, v, params)


def applied_force(t, q, v, a, params):
    """Generalized force Q of the rotors (N, N m)."""
    return system.generalized_force(q, v, params, t=t)


system = jl.System(
    coordinates=("X", "Y", "Z", "psi", "theta", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.PointForce(center, thrust_force, "thrust"),
        jl.Torque(angular_velocity, torque, "rotor torque"),
    ),
)

entry = Entry(
    name="quadcopter",
    book="ch. 3, Example 5, Fig. 3.10, eqs. 3.74-3.89",
    system=system,
    coordinate_units=("m", "m", "m", "rad", "rad", "rad"),
    parameter_units={
        "m": "kg",
        "Ix": "kg m^2",
        "Iy": "kg m^2",
        "Iz": "kg m^2",
        "l": "m",
        "g": "m/s^2",
        "k": "N s^2",
        "b": "N m s^2",
        "Im": "kg m^2",
        **dict.fromkeys(("w1", "w2", "w3", "w4"), "rad/s"),
    },
    example=Example(
        params={
            "m": 1.2,
            "Ix": 0.01,
            "Iy": 0.013,
            "Iz": 0.02,
            "l": 0.2,
            "g": 9.81,
            "k": 1e-5,
            "b": 1.6e-7,
            "Im": 5e-5,
            "w1": 561.0,
            "w2": 540.0,
            "w3": 560.0,
            "w4": 540.0,
        },
        q0=(0.0, 0.0, 2.0, 0.0, 0.3, 0.0),
        v0=(0.0, 0.0, 0.0, 0.0, 0.0, 0.3),
        duration=2.0,
    ),
    extras={
        "omega_body": body_rates,
        "tau_body": body_torque,
        "Q": applied_force,
        "thrust": thrust,
    },
)
