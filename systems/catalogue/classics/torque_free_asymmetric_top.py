r"""Free rigid body with three different moments of inertia.

Not in the book; Landau, Lifshitz, Mechanics, sec. 37. The quasi-velocities are declared as in
Pila, "Introduction to Lagrangian Dynamics", ch. 4, sec. 4.3, Example 1.

              ________________
             /               /|
            /_______________/ |      x, y, z    principal axes
            |               | |
            |       G       | /      turns about the mass center G
            |_______________|/

Coordinates
    phi, theta, psi   roll, pitch, yaw [rad]: Rz(psi) Ry(theta) Rx(phi)

Quasi-velocities
    wx, wy, wz        angular velocity along the body axes [rad/s]

Parameters
    I1, I2, I3        moments of inertia about x, y, z [kg m^2]

    T = 1/2 (I1 wx^2 + I2 wy^2 + I3 wz^2)      V = 0
    I1 wx' + (I3 - I2) wy wz = 0
    I2 wy' + (I1 - I3) wx wz = 0
    I3 wz' + (I2 - I1) wx wy = 0

The rates are Jacobi's elliptic functions of the time; about the axis of the intermediate moment the
body flips again and again. Energy and angular momentum along X, Y, Z are constant. The rates do not
determine phi' and psi' at theta = +-pi/2.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _attitude
from systems.catalogue._entry import Entry, Example


def angular_velocity(t, q, v, params):
    """(wx, wy, wz) [rad/s]."""
    return _attitude.body_rates(q, v)


def inertia(params):
    """Moments of inertia about x, y, z [kg m^2]."""
    return jnp.stack([params["I1"], params["I2"], params["I3"]])


def kinetic(t, q, u, params):
    """T in body rates [J]."""
    return 0.5 * inertia(params) @ u**2


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def angular_momentum(q, v, params):
    """Angular momentum along X, Y, Z [kg m^2/s]."""
    return _attitude.matrix(q) @ (inertia(params) * _attitude.body_rates(q, v))


system = jl.System(
    coordinates=("phi", "theta", "psi"),
    kinetic=kinetic,
    potential=potential,
    quasi=jl.QuasiVelocities(angular_velocity, ("wx", "wy", "wz")),
    written_in="u",
)

entry = Entry(
    name="torque_free_asymmetric_top",
    book="not in the book; Landau, Lifshitz, sec. 37; ch. 4, sec. 4.3, Example 1",
    system=system,
    coordinate_units=("rad", "rad", "rad"),
    quasi_units=("rad/s", "rad/s", "rad/s"),
    parameter_units=dict.fromkeys(("I1", "I2", "I3"), "kg m^2"),
    example=Example(
        params={"I1": 2.0, "I2": 1.0, "I3": 3.0},
        q0=(0.0, 0.1, 0.2),
        v0=(1.6, 0.02, 0.01),
        duration=20.0,
    ),
    invariants={
        "angular_momentum_X": lambda t, q, v, a, params: angular_momentum(q, v, params)[0],
        "angular_momentum_Y": lambda t, q, v, a, params: angular_momentum(q, v, params)[1],
        "angular_momentum_Z": lambda t, q, v, a, params: angular_momentum(q, v, params)[2],
    },
)
