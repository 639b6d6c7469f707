r"""Two masses between two walls, coupled by three springs.

Pila, "Introduction to Lagrangian Dynamics", ch. 3, Example 2 (Fig. 3.8, eqs. 3.58-3.59).

    |/|          +----+          +----+          |/|
    |/|--/\/\/\--| m1 |--/\/\/\--| m2 |--/\/\/\--|/|
    |/|    k1    +----+    k2    +----+    k3    |/|
    ================================================  smooth
                 |--> x1         |--> x2

Coordinates
    x1, x2       displacements of the masses [m], both to the right, zero where
                 all springs are unstretched

Parameters
    m1, m2       masses [kg]
    k1, k2, k3   stiffnesses [N/m]

    T = 1/2 m1 x1'^2 + 1/2 m2 x2'^2
    V = 1/2 [k1 x1^2 + k2 (x2 - x1)^2 + k3 x2^2]

    m1 x1'' = k2 (x2 - x1) - k1 x1                                        (3.58)
    m2 x2'' = -k2 (x2 - x1) - k3 x2                                       (3.59)
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue import _exact
from systems.catalogue._entry import Entry, Example


def kinetic(t, q, v, params):
    """T = 1/2 m1 x1'^2 + 1/2 m2 x2'^2 [J]."""
    return 0.5 * params["m1"] * v[0] ** 2 + 0.5 * params["m2"] * v[1] ** 2


def potential(t, q, params):
    """V = 1/2 [k1 x1^2 + k2 (x2 - x1)^2 + k3 x2^2] [J], zero for unstretched springs."""
    x1, x2 = q
    return 0.5 * (params["k1"] * x1**2 + params["k2"] * (x2 - x1) ** 2 + params["k3"] * x2**2)


system = jl.System(coordinates=("x1", "x2"), kinetic=kinetic, potential=potential)


def exact(t, q0, v0, params):
    """The linear motion."""
    k1, k2, k3 = params["k1"], params["k2"], params["k3"]
    M = jnp.diag(jnp.stack([params["m1"], params["m2"]]))
    K = jnp.array([[k1 + k2, -k2], [-k2, k2 + k3]])
    zero = jnp.zeros(2)
    return _exact.oscillating(t, q0, v0, M, jnp.zeros((2, 2)), K, zero, zero, 0.0)


entry = Entry(
    name="two_mass_three_springs",
    book="ch. 3, Example 2, Fig. 3.8, eqs. 3.58-3.59",
    system=system,
    coordinate_units=("m", "m"),
    parameter_units={"m1": "kg", "m2": "kg", "k1": "N/m", "k2": "N/m", "k3": "N/m"},
    example=Example(
        params={"m1": 1.0, "m2": 1.2, "k1": 20.0, "k2": 3.0, "k3": 24.0},
        q0=(0.25, 0.0),
        v0=(0.0, 0.0),
        duration=12.0,
    ),
    exact=exact,
)
