r"""Disk rolling down a slope on a cart, both held by springs.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 12 (Fig. 3.22, eqs. 3.144-3.154).

           K1
          o\/\/\._
    |/|   |'.     (_)--> F1 cos(Omega t), at the center of the disk m, R
    |/| K2|  '.     '.
    |/|/\/|    '.     'x1
    |/|-[=|  m0  '._ theta
    |/| b |_________'.
    =====O======O========   |--> X

Coordinates
    X       displacement of the cart to the right, zero with K2 unstretched [m]
    x1      displacement of the disk's center down the slope, relative to the cart, from
            its static position [m], where K1 holds the disk: K1 x_static = m g sin(theta)

Parameters
    m0, m   masses of cart and disk [kg]
    R       radius of the disk [m]
    theta   slope against the horizontal [rad], falling to the right, constant
    K1      spring between disk and cart [N/m]
    K2, b   spring [N/m] and damper [N s/m] between cart and wall
    F1      amplitude of the horizontal force on the disk's center [N]
    Omega   its angular frequency [rad/s]
    g       gravity [m/s^2]

    T = 1/2 m0 X'^2 + 1/2 m (X'^2 + 2 X' x1' cos(theta) + x1'^2) + 1/4 m x1'^2
    V = 1/2 K1 x1^2 + 1/2 K2 X^2      R = 1/2 b X'^2
    Q = (F1 cos(Omega t), F1 cos(Omega t) cos(theta))
    friction on the disk along +x1: -(m/2) x1''

The disk rolls, so that its spin energy 1/2 (m R^2/2) (x1'/R)^2 is free of R; g is taken up by the
static position. Neither enters the equations of motion.

Misprints: L has +1/2 K2 X^2 where both springs are negative. theta is used for the slope and for
the roll angle as well, and omega_z = -x1'/R disagrees in sign with x1 = R theta (T is the same).
In dL/dx1' a plus follows the 1/2: it is m X' cos(theta) + m x1' + m x1'/2.
"""

import jax.numpy as jnp

import jaxlag as jl
from jaxlag import energy
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def disk_center(t, q, params):
    """Center of the disk, to the right and upward [m], from its static position at X = 0."""
    X, x1 = q
    slope = params["theta"]
    return jnp.stack([X + x1 * jnp.cos(slope), -x1 * jnp.sin(slope)])


def kinetic(t, q, v, params):
    """T of the cart and of the rolling disk [J]."""
    cart = 0.5 * params["m0"] * v[0] ** 2
    rolling = 0.25 * params["m"] * v[1] ** 2
    return cart + energy.particles(disk_center, params["m"], t, q, v, params) + rolling


def potential(t, q, params):
    """V = 1/2 K1 x1^2 + 1/2 K2 X^2 [J], zero in the static position."""
    X, x1 = q
    return 0.5 * params["K1"] * x1**2 + 0.5 * params["K2"] * X**2


def drive(t, q, v, params):
    """Horizontal force F1 cos(Omega t) [N]."""
    return jnp.array([params["F1"] * jnp.cos(params["Omega"] * t), 0.0])


def dissipation(t, q, v, params):
    """R = 1/2 b X'^2 [W]."""
    return 0.5 * params["b"] * v[0] ** 2


def friction(t, q, v, a, params):
    """Friction at the contact on the disk, along +x1 [N]."""
    return -0.5 * params["m"] * a[1]


def applied_force(t, q, v, a, params):
    """Generalized force Q of the drive (N), without the damper."""
    return system.generalized_force(q, v, params, t=t, names=("drive",))


system = jl.System(
    coordinates=("X", "x1"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(disk_center, drive, "drive"), jl.Rayleigh(dissipation, "damper")),
)


def exact(t, q0, v0, params):
    """The damped and driven linear motion."""
    m, along = params["m"], jnp.cos(params["theta"])
    M = jnp.array([[params["m0"] + m, m * along], [m * along, 1.5 * m]])
    C = jnp.diag(jnp.array([params["b"], 0.0]))
    K = jnp.diag(jnp.stack([params["K2"], params["K1"]]))
    force = params["F1"] * jnp.array([1.0, along])
    return _exact.oscillating(t, q0, v0, M, C, K, jnp.zeros(2), force, params["Omega"])


entry = Entry(
    name="disk_on_moving_cart",
    book="ch. 3, Example 12, Fig. 3.22, eqs. 3.144-3.154",
    system=system,
    coordinate_units=("m", "m"),
    parameter_units={
        "m0": "kg",
        "m": "kg",
        "R": "m",
        "theta": "rad",
        "K1": "N/m",
        "K2": "N/m",
        "b": "N s/m",
        "F1": "N",
        "Omega": "rad/s",
        "g": "m/s^2",
    },
    example=Example(
        params={
            "m0": 2.0,
            "m": 1.5,
            "R": 0.15,
            "theta": 0.6,
            "K1": 60.0,
            "K2": 90.0,
            "b": 2.0,
            "F1": 4.0,
            "Omega": 3.0,
            "g": 9.81,
        },
        q0=(0.0, 0.2),
        v0=(0.0, 0.0),
        duration=12.0,
    ),
    extras={"friction_x1": friction, "Q": applied_force},
    exact=exact,
)
