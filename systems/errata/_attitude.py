"""Functions of a body with the angles (phi, theta, psi), for the errata of chapters 1 and 4.

First those of the engine, from `jaxlag.rotation` and particles; then the formulas, written out.
"""

import jax.numpy as jnp
from numpy import array, cos, cross, sin

from jaxlag.rotation import yaw_pitch_roll
from systems.errata._erratum import State, motion

# By the engine.


def rotation_matrix(angles):
    """T_I/B, which transforms body components to inertial ones."""
    return yaw_pitch_roll.matrix(angles[::-1])


def pose(t, q, params):
    """(T_I/B, r_O) of a body with q = (X, Y, Z, phi, theta, psi)."""
    return rotation_matrix(q[3:]), q[:3]


def body_torque(angles, Q):
    """Torque, body components, equivalent to the generalized force Q on the angles."""
    W = yaw_pitch_roll.body_rate_matrix(angles[::-1])[:, ::-1]
    return jnp.linalg.solve(W.T, Q)


def spinning(t, q, params):
    """Six particles of mass m/6 at -+a, -+b, -+c on the body axes, turned by q = angles."""
    arms = jnp.diag(jnp.stack([params["a"], params["b"], params["c"]]))
    return jnp.concatenate([arms, -arms]) @ rotation_matrix(q).T


def needed_torque(s: State):
    """Torque, body components, required for a motion of `spinning`."""
    r, _, acceleration = motion(spinning, s, s.a)
    moment = s.params["m"] / 6 * jnp.sum(jnp.cross(r, acceleration), axis=0)
    return rotation_matrix(s.q).T @ moment


SPINNING = {"m": 3.0, "a": 0.5, "b": 0.8, "c": 0.3}
"""Parameters of `spinning`."""

# By the formulas.


def moments(s: State):
    """(Ix, Iy, Iz) of `spinning`."""
    m, a, b, c = s.values("m", "a", "b", "c")
    return m / 3 * array([b**2 + c**2, a**2 + c**2, a**2 + b**2])


def direction_cosines(angles):
    """T_B/I, entries a_ij."""
    (cF, cT, cP), (sF, sT, sP) = cos(angles), sin(angles)
    return array(
        [
            [cT * cP, cT * sP, -sT],
            [sF * sT * cP - cF * sP, sF * sT * sP + cF * cP, sF * cT],
            [cF * sT * cP + sF * sP, cF * sT * sP - sF * cP, cF * cT],
        ]
    )


def rates_matrix(angles):
    """M, with (p, q, r) = M (phi', theta', psi')."""
    (cF, cT, _), (sF, sT, _) = cos(angles), sin(angles)
    return array([[1.0, 0.0, -sT], [0.0, cF, sF * cT], [0.0, -sF, cF * cT]])


def rates_matrix_rate(angles, rates):
    """M' for these rates of the angles."""
    (cF, cT, _), (sF, sT, _) = cos(angles), sin(angles)
    by_phi = array([[0.0, 0.0, 0.0], [0.0, -sF, cF * cT], [0.0, -cF, -sF * cT]])
    by_theta = array([[0.0, 0.0, -cT], [0.0, 0.0, -sF * sT], [0.0, 0.0, -cF * sT]])
    return by_phi * rates[0] + by_theta * rates[1]


def body_rates(s: State):
    """(w, w'): body rates and their rates; the last entries of q are the angles."""
    angles, rates = s.q[-3:], s.v[-3:]
    M = rates_matrix(angles)
    return M @ rates, M @ s.a[-3:] + rates_matrix_rate(angles, rates) @ rates


def body_speeds(s: State):
    """(V, V'): body components of the velocity of O, and their rates."""
    A, (w, _) = direction_cosines(s.q[3:]), body_rates(s)
    V = A @ s.v[:3]
    return V, A @ s.a[:3] - cross(w, V)


def cross_matrix(a):
    """[a]x, with [a]x b = a x b."""
    x, y, z = a
    return array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
