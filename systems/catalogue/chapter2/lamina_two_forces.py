r"""Lamina sliding freely in its plane under two forces that turn with it.

Pila, "Introduction to Lagrangian Dynamics", ch. 2, sec. 2.5, Example 4 (Fig. 2.6,
eqs. 2.20-2.22).

      Y1
      ^        Y                    f1
      |         \      _________   /
      |          \    /         \ /
      |           \  /    +      o (x1, y1)    + mass center (xb, yb)
      |            \/            |
      |            O___          |
      |            |   ---___    |      O   at (x, y)
      |     f2 --> o         ---___
      |      (x2, y2) \______/      X       at the angle theta to X1
      +--------------------------------> X1

Coordinates
    x, y    position of the body origin O in the fixed axes X1, Y1 [m]
    theta   angle of the body axis X from X1 [rad], counterclockwise

Parameters
    M               mass [kg]
    Iz              inertia about O [kg m^2]
    xb, yb          mass center in body axes [m]
    x1, y1, x2, y2  points where the forces act, in body axes [m]
    f1x, f1y        force at the first point, components along the BODY axes [N], constant
    f2x, f2y        force at the second point, likewise [N]

    T = 1/2 M (x'^2 + y'^2) + 1/2 Iz theta'^2
        + M theta' [(y' xb - x' yb) cos(theta) - (x' xb + y' yb) sin(theta)]        (2.21)
    V = 0
    Q_x     = (f1x + f2x) cos(theta) - (f1y + f2y) sin(theta)
    Q_y     = (f1x + f2x) sin(theta) + (f1y + f2y) cos(theta)
    Q_theta = f1y x1 - f1x y1 + f2y x2 - f2x y2                                     (2.22)

Misprints: the third line of 2.21 has y' xb + x' yb inside for y' xb - x' yb; its last line is
right. After 2.22 the book puts F_x = f1x + f2x and F_y = f1y + f2y, which forces along the body
axes are not: along x and y they must be turned as above.
"""

import jax.numpy as jnp

import jaxlag as jl
from systems.catalogue._entry import Entry, Example


def pose(t, q, params):
    """Rotation of the body axes and position of O."""
    x, y, theta = q
    return jl.rotation.about_z(theta), jnp.array([x, y, 0.0])


def kinetic(t, q, v, params):
    """T of the lamina [J] (2.16, 2.21)."""
    center = (params["xb"], params["yb"], 0.0)
    lamina = jl.energy.RigidBody(params["M"], (0.0, 0.0, params["Iz"]), center)
    return lamina.kinetic(pose, t, q, v, params)


def potential(t, q, params):
    """V = 0 [J]."""
    return jnp.zeros_like(q[0])


def points(t, q, params):
    """Where the two forces act [m], shape (2, 3)."""
    R, origin = pose(t, q, params)
    first = (params["x1"], params["y1"], 0.0)
    second = (params["x2"], params["y2"], 0.0)
    return origin + jnp.array([first, second]) @ R.T


def following_forces(t, q, v, params):
    """The two forces in fixed axes [N], shape (2, 3)."""
    R, _ = pose(t, q, params)
    first = (params["f1x"], params["f1y"], 0.0)
    second = (params["f2x"], params["f2y"], 0.0)
    return jnp.array([first, second]) @ R.T


def applied_force(t, q, v, a, params):
    """Generalized force Q (N, N, N m)."""
    return system.generalized_force(q, v, params, t=t)


def spin_less_impulse(t, q, v, a, params):
    """Angular momentum about the mass center minus the torque about it times t [N m s]."""
    xb, yb = params["xb"], params["yb"]
    first = (params["x1"] - xb) * params["f1y"] - (params["y1"] - yb) * params["f1x"]
    second = (params["x2"] - xb) * params["f2y"] - (params["y2"] - yb) * params["f2x"]
    central = params["Iz"] - params["M"] * (xb**2 + yb**2)
    return central * v[2] - (first + second) * t


system = jl.System(
    coordinates=("x", "y", "theta"),
    kinetic=kinetic,
    potential=potential,
    forces=(jl.PointForce(points, following_forces, "f1 and f2"),),
)

geometry = {"M": "kg", "Iz": "kg m^2", **dict.fromkeys(("xb", "yb", "x1", "y1", "x2", "y2"), "m")}
"""Units of the parameters of the lamina and of the points where forces act."""

entry = Entry(
    name="lamina_two_forces",
    book="ch. 2, sec. 2.5, Example 4, Fig. 2.6, eqs. 2.20-2.22",
    system=system,
    coordinate_units=("m", "m", "rad"),
    parameter_units={**geometry, **dict.fromkeys(("f1x", "f1y", "f2x", "f2y"), "N")},
    example=Example(
        params={
            "M": 1.5,
            "Iz": 0.25,
            "xb": 0.15,
            "yb": 0.1,
            "x1": 0.5,
            "y1": 0.1,
            "x2": -0.2,
            "y2": 0.3,
            "f1x": 0.8,
            "f1y": 1.0,
            "f2x": 0.4,
            "f2y": 0.3,
        },
        q0=(0.0, 0.0, 0.0),
        v0=(0.2, 0.0, 0.5),
        duration=6.0,
    ),
    extras={"Q": applied_force},
    invariants={"spin_less_impulse": spin_less_impulse},
)
