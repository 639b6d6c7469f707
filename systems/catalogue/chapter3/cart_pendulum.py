r"""Cart on a spring and a damper with a hanging uniform rod.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 8 (Figs. 3.15-3.17,
eqs. 3.101-3.108).

    |/|     k     +-----------+
    |/|---/\/\/---|           |
    |/|           |  m1   o   |---> F(t) = F0 cos(Omega t)
    |/|----[==----|       |\  |
    |/|     b     +-------|-\-+
    =================O====|==\==O===   |--> x
                          |   \
                       theta   \  rod m2, l
                                \ --> F2 sin(Omega t), horizontal

Coordinates
    x       displacement of the cart to the right from the unstretched spring [m]
    theta   angle of the rod from the downward vertical [rad], positive
            counterclockwise (free end to the right)

Parameters
    m1, m2   masses of cart and rod [kg]
    l        length of the rod [m]; its central inertia is m2 l^2/12
    k, b     stiffness [N/m], damping [N s/m]
    g        gravity [m/s^2]
    F0, F2   amplitudes of the forces on the cart and on the rod's free end [N]
    Omega    angular frequency of both [rad/s]

    T = 1/2 m1 x'^2 + 1/2 m2 [x'^2 + l^2 theta'^2/4 + l x' theta' cos(theta)]
        + 1/2 (m2 l^2/12) theta'^2
    V = 1/2 k x^2 + m2 g (l/2) (1 - cos(theta))      R = 1/2 b x'^2
    Q = (F0 cos(Omega t) + F2 sin(Omega t), F2 sin(Omega t) l cos(theta))

The book's remark that the parallel axis theorem cannot be used here is loose: about a moving
pin T needs the cross term in x' theta', which is there.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T of cart and rod [J]."""
    m2, length = params["m2"], params["l"]
    _, theta = q
    x_rate, w = v
    center_squared = x_rate**2 + 0.25 * (length * w) ** 2 + length * x_rate * w * jnp.cos(theta)
    cart = 0.5 * params["m1"] * x_rate**2
    return cart + 0.5 * m2 * center_squared + 0.5 * (m2 * length**2 / 12) * w**2


def potential(t, q, params):
    """V = 1/2 k x^2 + m2 g (l/2) (1 - cos(theta)) [J]."""
    x, theta = q
    rod = 0.5 * params["m2"] * params["g"] * params["l"] * (1 - jnp.cos(theta))
    return 0.5 * params["k"] * x**2 + rod


def cart_force(t, q, v, params):
    """Q of F0 cos(Omega t) on the cart: (N, N m)."""
    return jnp.array([params["F0"] * jnp.cos(params["Omega"] * t), 0.0])


def end_force(t, q, v, params):
    """Q of the horizontal F2 sin(Omega t) at the rod's free end: (N, N m)."""
    force = params["F2"] * jnp.sin(params["Omega"] * t)
    return jnp.array([force, force * params["l"] * jnp.cos(q[1])])


def dissipation(t, q, v, params):
    """R = 1/2 b x'^2 [W]."""
    return 0.5 * params["b"] * v[0] ** 2


def applied_force(t, q, v, a, params):
    """Generalized force Q of the two drives (N, N m), without the damper."""
    return system.generalized_force(q, v, params, t=t, names=("cart", "rod end"))


system = jl.System(
    coordinates=("x", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(
        jl.GeneralizedForce(cart_force, "cart"),
        jl.GeneralizedForce(end_force, "rod end"),
        jl.Rayleigh(dissipation, "damper"),
    ),
)

entry = Entry(
    name="cart_pendulum",
    book="ch. 3, Example 8, Figs. 3.15-3.17, eqs. 3.101-3.108",
    system=system,
    coordinate_units=("m", "rad"),
    parameter_units={
        "m1": "kg",
        "m2": "kg",
        "l": "m",
        "k": "N/m",
        "b": "N s/m",
        "g": "m/s^2",
        "F0": "N",
        "F2": "N",
        "Omega": "rad/s",
    },
    example=Example(
        params={
            "m1": 2.0,
            "m2": 0.7,
            "l": 0.8,
            "k": 25.0,
            "b": 0.9,
            "g": 9.81,
            "F0": 2.0,
            "F2": 0.5,
            "Omega": 2.5,
        },
        q0=(0.0, 0.8),
        v0=(0.0, 0.0),
        duration=10.0,
    ),
    extras={"Q": applied_force},
)
