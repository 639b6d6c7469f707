r"""Quadcopter in body axes, Z downward.

Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.5, Example 6 (eqs. 4.202-4.211).

    seen from above:   body x
                         ^
                        (1)         rotors 1, 3 turn counterclockwise,
                         |  l              2, 4 clockwise, about body z
              (2)--------G-------(4) --> body y
                         |          rotor i lifts with f_i = k omega_i^2 against body z
                        (3)

Coordinates
    X, Y, Z              mass center G [m], Z downward
    phi, theta, psi      roll, pitch, yaw [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    u, v, w              velocity of G along the body axes [m/s]
    p, q, r              angular velocity along the body axes [rad/s]

Parameters
    m                    mass [kg]
    g                    gravity [m/s^2]
    Ix, Iy, Iz           principal moments of inertia [kg m^2]
    l                    arm from G to each rotor [m]
    k, b                 thrust [N s^2] and drag torque [N m s^2] per square of rotor speed
    Jr                   inertia of one rotor about its shaft [kg m^2]
    omega                the four rotor speeds, positive [rad/s]

    T = 1/2 m (u^2 + v^2 + w^2) + 1/2 (Ix p^2 + Iy q^2 + Iz r^2)      (V of the book) = -m g Z
    with H = Jr (-omega_1 + omega_2 - omega_3 + omega_4) and tau_i = b omega_i^2:
    u' = r v - q w - g sin(theta)
    v' = p w - r u + g cos(theta) sin(phi)
    w' = q u - p v + g cos(theta) cos(phi) - (f1 + f2 + f3 + f4)/m
    Ix p' = (f2 - f4) l - q H - (Iz - Iy) q r
    Iy q' = (f1 - f3) l + p H - (Ix - Iz) p r
    Iz r' = tau1 - tau2 + tau3 - tau4 - (Iy - Ix) p q

The rates do not determine phi' and psi' at theta = +-pi/2.

Errors in the book: with Z down the thrust of 4.202 is along -z. 4.210 and 4.211 interchange the
arms of roll (rotors 2, 4) and pitch (1, 3), and the vector of 4.210 is that of (psi, theta, phi).
The spin H needs the signs above, and its torque about y is +p H. The third row of 4.206 is zero
only if Ix = Iy.
"""

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from systems.catalogue import _attitude
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, u, params):
    """T in body components, without the spin of the rotors [J]."""
    inertia = jnp.stack([params["Ix"], params["Iy"], params["Iz"]])
    return 0.5 * params["m"] * u[:3] @ u[:3] + 0.5 * inertia @ u[3:] ** 2


def potential(t, q, params):
    """V = -m g Z [J]."""
    return -params["m"] * params["g"] * q[2]


def center(t, q, params):
    """Position of the mass center [m]."""
    return q[:3]


def lift(params):
    """Thrust f_i = k omega_i^2 of each rotor [N]."""
    return params["k"] * params["omega"] ** 2


def thrust(t, q, v, params):
    """Thrust of all rotors, X, Y, Z components [N]."""
    return -jnp.sum(lift(params)) * _attitude.matrix(q[3:])[:, 2]


def rotor_torque(t, q, v, params):
    """Torque of thrusts and drags along the body axes [N m]."""
    f1, f2, f3, f4 = lift(params)
    senses = jnp.array([1.0, -1.0, 1.0, -1.0])
    drag = params["b"] * senses @ params["omega"] ** 2
    return jnp.stack([(f2 - f4) * params["l"], (f1 - f3) * params["l"], drag])


def gyroscopic_torque(t, q, v, params):
    """-omega x (0, 0, H) of the spinning rotors, along the body axes [N m]."""
    spin = params["Jr"] * jnp.array([-1.0, 1.0, -1.0, 1.0]) @ params["omega"]
    p, q_, _ = _attitude.angular_velocity(t, q, v, params)
    return jnp.stack([-q_ * spin, p * spin, jnp.zeros_like(spin)])


system = jl.System(
    coordinates=("X", "Y", "Z", "phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.PointForce(center, thrust, "thrust"),
        jl.Torque(_attitude.angular_velocity, rotor_torque, "rotor torque"),
        jl.Torque(_attitude.angular_velocity, gyroscopic_torque, "gyroscopic torque"),
    ),
    quasi=jl.QuasiVelocities(_attitude.body_velocities, ("u", "v", "w", "p", "q", "r")),
    written_in="u",
)

entry = Entry(
    name="quadcopter_body_axes",
    book="ch. 4, sec. 4.5, Example 6, eqs. 4.202-4.211",
    system=system,
    coordinate_units=("m", "m", "m", "rad", "rad", "rad"),
    quasi_units=("m/s", "m/s", "m/s", "rad/s", "rad/s", "rad/s"),
    parameter_units={
        "m": "kg",
        "g": "m/s^2",
        "Ix": "kg m^2",
        "Iy": "kg m^2",
        "Iz": "kg m^2",
        "l": "m",
        "k": "N s^2",
        "b": "N m s^2",
        "Jr": "kg m^2",
        "omega": "rad/s",
    },
    example=Example(
        params={
            "m": 0.8,
            "g": 9.81,
            "Ix": 0.011,
            "Iy": 0.014,
            "Iz": 0.022,
            "l": 0.22,
            "k": 7.5e-6,
            "b": 1.8e-7,
            "Jr": 1.5e-4,
            "omega": np.array([516.0, 512.0, 511.0, 515.0]),
        },
        q0=(0.0, 0.0, -10.0, 0.1, 0.05, 0.3),
        v0=(1.0, 0.5, -0.3, 0.4, -0.2, 0.3),
        duration=1.5,
    ),
)
