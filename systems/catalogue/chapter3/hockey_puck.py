r"""Hockey puck on smooth ice, pushed off its center by a force that turns with it.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, secs. 3.11-3.12 (Figs. 3.25-3.28,
eqs. 3.161-3.168).

    y ^        .------.
      |      .'   j1   '.
      |     /     ^      \
      |    |    G +--> i1 |       theta: turn of the body axes i1, j1
      |     \     | R    /
      |      '.   |    .'
      |        '--D---'---> F1    at D = G - R j1, along i1
      +-----------------------------> x

Coordinates
    theta   turn of the puck [rad], positive counterclockwise from above
    x, y    its center G in the plane of the ice [m]

Parameters
    M       mass [kg]
    kappa   radius of gyration about G [m]
    R       radius of the puck [m]
    F1      force [N], constant in the body axes

    T = 1/2 M kappa^2 theta'^2 + 1/2 M (x'^2 + y'^2)      V = 0
    Q = (F1 R, F1 cos(theta), F1 sin(theta))

The spin grows evenly: M kappa^2 theta' - F1 R t is constant. A cord that unwinds from the puck
would not turn with it: see `hockey_puck_cord`. Misprint: item 9 of the list is dV/dq2, printed
dV/dq1.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 M kappa^2 theta'^2 + 1/2 M (x'^2 + y'^2) [J]."""
    w, x_rate, y_rate = v
    return 0.5 * params["M"] * ((params["kappa"] * w) ** 2 + x_rate**2 + y_rate**2)


def potential(t, q, params):
    """V = 0: the ice is level."""
    return jnp.zeros_like(q[0])


def rim(t, q, params):
    """The point D = G - R j1 of the rim [m]."""
    theta, x, y = q
    return jnp.stack([x + params["R"] * jnp.sin(theta), y - params["R"] * jnp.cos(theta)])


def push(t, q, v, params):
    """F1 along i1, x and y components [N]."""
    return params["F1"] * jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])


def applied_force(t, q, v, a, params):
    """Generalized force Q of the push (N m, N, N)."""
    return system.generalized_force(q, v, params, t=t)


def initial_spin(t, q, v, a, params):
    """M kappa^2 theta' - F1 R t, the angular momentum about G at t = 0 [kg m^2/s]."""
    return params["M"] * params["kappa"] ** 2 * v[0] - params["F1"] * params["R"] * t


system = jl.System(
    coordinates=("theta", "x", "y"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(rim, push, "push"),),
)

entry = Entry(
    name="hockey_puck",
    book="ch. 3, secs. 3.11-3.12, Figs. 3.25-3.28, eqs. 3.161-3.168",
    system=system,
    coordinate_units=("rad", "m", "m"),
    parameter_units={"M": "kg", "kappa": "m", "R": "m", "F1": "N"},
    example=Example(
        params={"M": 0.16, "kappa": 0.027, "R": 0.038, "F1": 0.01},
        q0=(0.0, 0.0, 0.0),
        v0=(-2.0, 0.0, 0.0),
        duration=3.0,
    ),
    extras={"Q": applied_force},
    invariants={"initial_spin": initial_spin},
)
