r"""Ball that rolls on a horizontal plane without slip and without spin about the vertical.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, sec. 3.1 (Fig. 3.5). The book stops at the
constraints; inertia and drive are additions.

       Y ^       .---.
         |     .       .    center at (x, y), R above the plane
         |    (    +----)--> (Fx0 cos(Omega t), Fy0 sin(Omega t))
         |     .       .
         |       '---'      turned by yaw psi, pitch theta, roll phi
         +--------------------> X

Coordinates
    x, y              center of the ball [m]
    psi, theta, phi   yaw, pitch, roll [rad]: Rz(psi) Ry(theta) Rx(phi)    (3.81)

Parameters
    m                 mass [kg]
    R                 radius [m]
    I                 inertia about any axis through the center [kg m^2]
    Fx0, Fy0          amplitudes of the force at the center along X, Y [N]
    Omega             its angular frequency [rad/s]

    omega_X = phi' cos(theta) cos(psi) - theta' sin(psi)
    omega_Y = phi' cos(theta) sin(psi) + theta' cos(psi)
    omega_Z = psi' - phi' sin(theta)
    T = 1/2 m (x'^2 + y'^2) + 1/2 I (omega_X^2 + omega_Y^2 + omega_Z^2)      V = 0
    rolling_x:  x' - R omega_Y = 0, lambda = friction on the ball along X in N
    rolling_y:  y' + R omega_X = 0, lambda = friction along Y in N
    no_spin:    omega_Z = 0, lambda = torque about Z in N m, 0 in this motion
    (m + I/R^2) (x'', y'') = (Fx0 cos(Omega t), Fy0 sin(Omega t))

The mass matrix is singular at theta = +-pi/2.

The book counts four coordinates, two of them angles about X and Y. Then x = R angle + constant
would make the system holonomic; a ball has three angles, and omega_X, omega_Y are not rates of
coordinates.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag.rotation import yaw_pitch_roll
from systems.catalogue import _rolling
from systems.catalogue._entry import Entry, Example


def angular_velocity(q, v):
    """Components of omega along X, Y, Z [rad/s]."""
    return yaw_pitch_roll.space_rates(q[2:], v[2:])


def kinetic(t, q, v, params):
    """T of the mass center and of the rotation [J]."""
    omega = angular_velocity(q, v)
    return 0.5 * params["m"] * v[:2] @ v[:2] + 0.5 * params["I"] * omega @ omega


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def center(t, q, params):
    """Position of the center in the plane [m]."""
    return q[:2]


def drive(t, q, v, params):
    """(Fx0 cos(Omega t), Fy0 sin(Omega t)) [N]."""
    angle = params["Omega"] * t
    return jnp.stack([params["Fx0"] * jnp.cos(angle), params["Fy0"] * jnp.sin(angle)])


def slip_and_spin(t, q, v, params):
    """Velocity of the point of contact along X, Y [m/s], and omega_Z [rad/s]."""
    omega = angular_velocity(q, v)
    return jnp.append(_rolling.of_ball(v[:2], omega, params["R"]), omega[2])


def omega_inertial(t, q, v, a, params):
    """Components of omega along X, Y, Z [rad/s]."""
    return angular_velocity(q, v)


system = jl.System(
    coordinates=("x", "y", "psi", "theta", "phi"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(center, drive, "drive"),),
    constraints=(jl.Pfaffian(slip_and_spin, ("rolling_x", "rolling_y", "no_spin")),),
)

entry = Entry(
    name="rolling_ball_no_spin",
    book="ch. 3, sec. 3.1, Fig. 3.5",
    system=system,
    coordinate_units=("m", "m", "rad", "rad", "rad"),
    multiplier_units={"rolling_x": "N", "rolling_y": "N", "no_spin": "N m"},
    parameter_units={
        "m": "kg",
        "R": "m",
        "I": "kg m^2",
        "Fx0": "N",
        "Fy0": "N",
        "Omega": "rad/s",
    },
    example=Example(
        params={"m": 1.0, "R": 0.2, "I": 0.016, "Fx0": 0.42, "Fy0": 0.56, "Omega": 2.0},
        q0=(0.0, 0.0, 0.0, 0.0, 0.0),
        v0=(0.0, -0.2, 0.0, 0.0, 1.0),
        duration=6.0,
    ),
    extras={"omega_inertial": omega_inertial},
)
