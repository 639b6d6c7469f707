"""Errata of chapter 4 up to eq. 4.70, in the order of the book."""

import jax
import jax.numpy as jnp
from numpy import array, cos, cross, eye, linalg, sin

from jaxlag import energy, rotation
from systems.errata import _attitude as attitude
from systems.errata._erratum import Erratum, State, around

# Inertial and body axes.


def _turns(s: State):
    phi, theta, psi = s.q
    yaw, pitch, roll = rotation.about_z(psi), rotation.about_y(theta), rotation.about_x(phi)
    return rotation.compose(yaw, pitch, roll)


def _with_a33(s: State):
    """T_I/B with a33 for a32."""
    A = attitude.direction_cosines(s.q)
    T = A.T.copy()
    T[1, 2] = A[2, 2]
    return T


def derivatives(s: State):
    """Row i, column j: d(body component j)/d(inertial component i) of the velocity of O."""

    def components(v):
        return energy.body_velocity(attitude.pose, s.t, s.q, v, s.params)[0]

    return jax.jacfwd(components)(jnp.asarray(s.v))[:, :3].T


def _with_a22(s: State):
    """The derivatives with dv/dv_I for dw/dv_I."""
    A = attitude.direction_cosines(s.q[3:])
    D = A.T.copy()
    D[1, 2] = A[1, 1]
    return D


# Quasi-velocities (p, q, r) of roll, pitch and yaw: Theta_ij is the coefficient of v_i in the j-th.


def _quasi_velocities(q, v):
    def pose(t, q, params):
        return attitude.rotation_matrix(q), jnp.zeros(3)

    return energy.body_velocity(pose, 0.0, q, v, None)[1]


def _Theta(q):
    return jax.jacfwd(_quasi_velocities, argnums=1)(q, jnp.zeros(3)).T


def _Theta_rate(s: State):
    return jax.jvp(_Theta, (jnp.asarray(s.q),), (jnp.asarray(s.v),))[1]


def _eta(s: State):
    """Row k, column j: sum over i of v_i dTheta_ij/dq_k."""
    return jax.jacfwd(_quasi_velocities)(jnp.asarray(s.q), jnp.asarray(s.v)).T


def _rotation_terms(s: State):
    """beta^T (Theta' - eta), beta^T being the inverse of Theta."""
    return jnp.linalg.solve(_Theta(s.q), _Theta_rate(s) - _eta(s))


def _eta_formula(s: State):
    by_phi, by_theta, by_psi = (attitude.rates_matrix_rate(s.q, unit) @ s.v for unit in eye(3))
    return array([by_phi, by_theta, by_psi])


def _eta_printed(s: State):
    by_phi, by_theta, _ = _eta_formula(s)
    return array([by_phi, by_theta, by_theta])


def _eta_12(s: State, angle: int):
    return -s.v[1] * sin(s.q[angle]) + s.v[2] * cos(s.q[0]) * cos(s.q[1])


def _entry_23(s: State, first: int, second: int):
    """-phi' cos(phi) + psi' sin(first) cos(second)."""
    return -s.v[0] * cos(s.q[0]) + s.v[2] * sin(s.q[first]) * cos(s.q[second])


# Euler's equations: torque minus the generalized inertia forces of the angles.


def _euler(s: State):
    w, w_rate = attitude.body_rates(s)
    inertia = attitude.moments(s)
    return inertia * w_rate + cross(w, inertia * w)


def _kinetic_gradient(s: State):
    """dT/d(phi, theta, psi) at fixed rates of these angles."""
    w, _ = attitude.body_rates(s)
    return _eta_formula(s) @ (attitude.moments(s) * w)


_turning = around({}, (0.5, 0.4, 0.7))
_spinning = around(attitude.SPINNING, (0.5, 0.4, 0.7))
_flying = around({}, (0.0, 0.0, 0.0, 0.5, 0.4, 0.7))

ERRATA = (
    Erratum(
        place="4.1-4.3, entry (2,3) of T_I/B",
        wrong="a33 for a32",
        draw=_turning,
        engine=_turns,
        printed=_with_a33,
        right=lambda s: attitude.direction_cosines(s.q).T,
    ),
    Erratum(
        place="4.3, derivatives of (u, v, w) by (u_I, v_I, w_I)",
        wrong="dv/dv_I for dw/dv_I in the third column",
        draw=_flying,
        engine=derivatives,
        printed=_with_a22,
        right=lambda s: attitude.direction_cosines(s.q[3:]).T,
    ),
    Erratum(
        place="4.28, rates of the coordinates, by the Theta' they make in Sec. 4.3",
        wrong="(q1', q3', q3') for (q1', q2', q3')",
        draw=_turning,
        engine=_Theta_rate,
        printed=lambda s: attitude.rates_matrix_rate(s.q, s.v[[0, 2, 2]]).T,
        right=lambda s: attitude.rates_matrix_rate(s.q, s.v).T,
    ),
    Erratum(
        place="4.60-4.63, third row of eta",
        wrong="dTheta/dtheta for dTheta/dpsi",
        draw=_turning,
        engine=_eta,
        printed=_eta_printed,
        right=_eta_formula,
    ),
    Erratum(
        place="4.63, entry (1,2) of eta",
        wrong="-theta' sin(theta) for -theta' sin(phi)",
        draw=_turning,
        engine=lambda s: _eta(s)[0, 1],
        printed=lambda s: _eta_12(s, 1),
        right=lambda s: _eta_12(s, 0),
    ),
    Erratum(
        place="4.65, entry (2,3) of Theta' - eta",
        wrong="psi' cos(theta) sin(phi) for psi' sin(theta) cos(phi)",
        draw=_turning,
        engine=lambda s: (_Theta_rate(s) - _eta(s))[1, 2],
        printed=lambda s: _entry_23(s, 0, 1),
        right=lambda s: _entry_23(s, 1, 0),
    ),
    Erratum(
        place="4.67, beta^T (Theta' - eta) = [omega]x, at any angles",
        wrong="said to need small angles, angle rates for omega",
        draw=_turning,
        engine=_rotation_terms,
        printed=lambda s: attitude.cross_matrix(s.v),
        right=lambda s: attitude.cross_matrix(attitude.body_rates(s)[0]),
    ),
    Erratum(
        place="4.70, dT/d(phi, theta, psi) in the equations of (p, q, r)",
        wrong="of T in angle rates; they are 0 at fixed (p, q, r)",
        draw=_spinning,
        engine=attitude.needed_torque,
        printed=lambda s: (
            _euler(s) - linalg.solve(attitude.rates_matrix(s.q).T, _kinetic_gradient(s))
        ),
        right=_euler,
    ),
)

TEXT_ONLY = (
    ("4.3, 4.111", "T_I/B if row i, column j is d(body component j)/d(inertial component i)"),
    ("4.59", "the first term is theta' times a sine and a cosine; one of them is missing in print"),
)
