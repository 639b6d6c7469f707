r"""Sleeve on a swinging rod, held by a spring from the hinge.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Examples 7 and 14 (Figs. 3.12-3.14 and 3.24,
eqs. 3.93-3.100 and 3.158-3.160).

    ----A----
        |\
        | /     spring k, unstretched length L0,
        | \     from A to the upper end of the sleeve
        |  /
        |  \\\
        |   \\\  sleeve M2, length L2, mass center at x1 from A
        |    \\\
        |      \ --> F0 cos(omega t), horizontal, at its lower end
        |       \
     theta       \  rod M1, length L1

Coordinates
    x1      distance of the sleeve's mass center from the hinge A along the rod [m]
    theta   angle of the rod from the downward vertical [rad], positive
            counterclockwise (rod to the right)

Parameters
    M1, IA, L1   rod: mass [kg], inertia about A [kg m^2], length [m]
    M2, IG, L2   sleeve: mass [kg], inertia about its mass center [kg m^2], length [m]
    k, L0        spring: stiffness [N/m], unstretched length [m];
                 its stretch is x1 - L0 - L2/2
    F0, omega    force: amplitude [N], to the right, angular frequency [rad/s]
    g            gravity [m/s^2]

    T = 1/2 (IA + IG) theta'^2 + 1/2 M2 (x1'^2 + x1^2 theta'^2)
    V = 1/2 k (x1 - L0 - L2/2)^2 + 1/2 L1 M1 g (1 - cos(theta))
        + M2 g (L0 + L2/2 - x1 cos(theta))
    Q_x1    = F0 cos(omega t) sin(theta)
    Q_theta = (x1 + L2/2) F0 cos(omega t) cos(theta)

Misprints: theta1' stands for theta' in 3.98 and 3.158; in 3.159-3.160 the force acts at
r2 = x1 + L2/2 (as in 3.158), not at x1, and the frame changes there without notice
(I downward, J horizontal).
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 (IA + IG) theta'^2 + 1/2 M2 (x1'^2 + x1^2 theta'^2) [J]."""
    x1, _ = q
    x1_rate, w = v
    inertia = params["IA"] + params["IG"]
    return 0.5 * inertia * w**2 + 0.5 * params["M2"] * (x1_rate**2 + (x1 * w) ** 2)


def potential(t, q, params):
    """V of spring, rod and sleeve [J], zero with theta = 0 and the spring unstretched."""
    x1, theta = q
    rest = params["L0"] + 0.5 * params["L2"]
    spring = 0.5 * params["k"] * (x1 - rest) ** 2
    rod = 0.5 * params["L1"] * params["M1"] * params["g"] * (1 - jnp.cos(theta))
    sleeve = params["M2"] * params["g"] * (rest - x1 * jnp.cos(theta))
    return spring + rod + sleeve


def drive(t, q, v, params):
    """Q of the horizontal force at the sleeve's lower end: (N, N m)."""
    x1, theta = q
    force = params["F0"] * jnp.cos(params["omega"] * t)
    arm = x1 + 0.5 * params["L2"]
    return jnp.array([force * jnp.sin(theta), arm * force * jnp.cos(theta)])


def applied_force(t, q, v, a, params):
    """Applied generalized force Q (N, N m)."""
    return system.generalized_force(q, v, params, t=t)


system = jl.System(
    coordinates=("x1", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.GeneralizedForce(drive, "drive"),),
)

entry = Entry(
    name="sleeve_pendulum",
    book="ch. 3, Examples 7 and 14, Figs. 3.12-3.14, 3.24, eqs. 3.93-3.100, 3.158-3.160",
    system=system,
    coordinate_units=("m", "rad"),
    parameter_units={
        "M1": "kg",
        "M2": "kg",
        "IA": "kg m^2",
        "IG": "kg m^2",
        "L1": "m",
        "L2": "m",
        "L0": "m",
        "k": "N/m",
        "F0": "N",
        "omega": "rad/s",
        "g": "m/s^2",
    },
    example=Example(
        params={
            "M1": 1.2,
            "M2": 0.5,
            "IA": 0.4,
            "IG": 0.003,
            "L1": 1.0,
            "L2": 0.12,
            "L0": 0.4,
            "k": 80.0,
            "F0": 1.5,
            "omega": 4.0,
            "g": 9.81,
        },
        q0=(0.5, 0.6),
        v0=(0.0, 0.0),
        duration=6.0,
    ),
    extras={"Q": applied_force},
)
