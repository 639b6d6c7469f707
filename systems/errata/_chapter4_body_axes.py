"""Errata of chapter 4, eqs. 4.103 to 4.170: equations along body axes."""

import jax
import jax.numpy as jnp
from numpy import array, cross, eye, sin

from jaxlag import energy, rotation
from systems.errata import _attitude as attitude
from systems.errata._chapter4_to_70 import derivatives
from systems.errata._erratum import Erratum, State, around, motion, rate

MASSES = {"m1": 0.5, "m2": 1.5, "m3": 0.8, "m4": 1.2}
SIZES = {"a": 0.9, "b": 0.7, "c": 0.5}
"""Parameters of the body below."""

# A rigid body of four particles, its mass center away from its origin O.


def _arms(params):
    a, b, c = params["a"], params["b"], params["c"]
    return [[a, b, -c], [-0.5 * a, b, c], [a, -0.3 * b, 1.2 * c], [0.4 * a, 0.8 * b, 0.1 * c]]


def masses(params):
    """Of the four particles."""
    return jnp.stack([params[name] for name in MASSES])


def particles(t, q, params):
    """Their positions, inertial components, with q = (X, Y, Z, phi, theta, psi)."""
    R, origin = attitude.pose(t, q, params)
    return origin + jnp.stack([jnp.stack(arm) for arm in _arms(params)]) @ R.T


def needed(s: State):
    """(force, torque about O), body components, required for a motion of the body."""
    r, _, acceleration = motion(particles, s, s.a)
    pulls = masses(s.params)[:, None] * acceleration
    R, origin = attitude.pose(s.t, s.q, s.params)
    return R.T @ jnp.sum(pulls, 0), R.T @ jnp.sum(jnp.cross(r - origin, pulls), 0)


def kinetic(t, q, v, params):
    """T."""
    return energy.particles(particles, masses(params), t, q, v, params)


def center(t, q, params):
    """The mass center, inertial components."""
    return masses(params) @ particles(t, q, params) / jnp.sum(masses(params))


def rotational_rate(s: State):
    """d/dt dT/domega + omega x dT/domega: rate of dT/domega in inertial axes, about the moving O.

    dT/domega is the sum of (r - r_O) x m r'.
    """

    def total(t, q, v):
        r, speeds = particles(t, q, s.params), energy.velocity(particles, t, q, v, s.params)
        return jnp.sum(masses(s.params)[:, None] * jnp.cross(r - q[:3], speeds), 0)

    return attitude.rotation_matrix(s.q[3:]).T @ rate(total, s, s.a)


def mass_properties(s: State):
    """(m, rc, I_O) of the formulas: mass, mass center and inertia matrix about O."""
    m, r = array(s.values(*MASSES)), array(_arms(s.params))
    products = (m[:, None] * r).T @ r
    return m.sum(), m @ r / m.sum(), products.trace() * eye(3) - products


# Small turns and rates of vectors.

_STEP = 0.01


def _increment(s: State):
    """(dR of R^T dR)_32, for increments of the angles."""
    angles, steps = jnp.asarray(s.q), _STEP * jnp.asarray(s.v)
    return rotation.body_rates(*jax.jvp(attitude.rotation_matrix, (angles,), (steps,)))[0]


def _increment_formula(s: State, psi: float):
    return _STEP * s.v[0] - psi * sin(s.q[1])


def _third_row_by_vI(s: State):
    D = attitude.direction_cosines(s.q[3:]).T
    return array([D[0], D[1], D[1]])


def _turning_of_velocity(s: State):
    """Body components of dV/dt minus the rates of the body components of V."""

    def components(t, q, v):
        return energy.body_velocity(attitude.pose, t, q, v, s.params)[0]

    return attitude.rotation_matrix(s.q[3:]).T @ s.a[:3] - rate(components, s, s.a)


def _omega_cross_V(s: State):
    return cross(attitude.body_rates(s)[0], attitude.body_speeds(s)[0])


# Euler's equations.


def _euler(s: State, second: int, third: int):
    """With the rates of these body rates in the second and third line."""
    inertia, (w, w_rate) = attitude.moments(s), attitude.body_rates(s)
    return inertia * w_rate[[0, second, third]] + cross(w, inertia * w)


# Body axes at an origin that is not the mass center.


def _arm_rate(s: State):
    """Body components of d(r_c - r_O)/dt."""

    def arm(t, q, params):
        return center(t, q, params) - q[:3]

    velocity = energy.velocity(arm, s.t, s.q, s.v, s.params)
    return attitude.rotation_matrix(s.q[3:]).T @ velocity


def _momentum(s: State):
    """dT/dV at fixed body rates."""
    by_velocity = jax.grad(kinetic, argnums=2)(s.t, s.q, jnp.asarray(s.v), s.params)[:3]
    return attitude.rotation_matrix(s.q[3:]).T @ by_velocity


def _center_velocity(s: State):
    V, _ = attitude.body_speeds(s)
    return V + _omega_cross_rc(s)


def _omega_cross_rc(s: State):
    _, rc, _ = mass_properties(s)
    return cross(attitude.body_rates(s)[0], rc)


def _third_term(s: State):
    """V_O x dT/dV."""
    m, _, _ = mass_properties(s)
    return m * cross(attitude.body_speeds(s)[0], _omega_cross_rc(s))


_turning = around({}, (0.5, 0.4, 0.7))
_spinning = around(attitude.SPINNING, (0.5, 0.4, 0.7))
_flying = around({**MASSES, **SIZES}, (0.0, 0.0, 0.0, 0.5, 0.4, 0.7))

ERRATA = (
    Erratum(
        place="4.103, entry (3,2) of a small turn",
        wrong="psi' sin(theta) for dpsi sin(theta)",
        draw=_turning,
        engine=_increment,
        printed=lambda s: _increment_formula(s, s.v[2]),
        right=lambda s: _increment_formula(s, _STEP * s.v[2]),
    ),
    Erratum(
        place="Text after 4.106, term of dV/dt from the turning axes",
        wrong="-omega x V for omega x V",
        draw=_flying,
        engine=_turning_of_velocity,
        printed=lambda s: -_omega_cross_V(s),
        right=_omega_cross_V,
    ),
    Erratum(
        place="4.108, derivatives of (u, v, w) by (u_I, v_I, w_I)",
        wrong="dv_I for dw_I in the third row",
        draw=_flying,
        engine=derivatives,
        printed=_third_row_by_vI,
        right=lambda s: attitude.direction_cosines(s.q[3:]).T,
    ),
    Erratum(
        place="4.141, Euler's equations, second and third line",
        wrong="Iy p', Iz p' for Iy q', Iz r'",
        draw=_spinning,
        engine=attitude.needed_torque,
        printed=lambda s: _euler(s, 0, 0),
        right=lambda s: _euler(s, 1, 2),
    ),
    Erratum(
        place="4.153-4.163, rate of the arm rc from O to the mass center",
        wrong="V_c for omega x rc; 0 in body axes",
        draw=_flying,
        engine=_arm_rate,
        printed=_center_velocity,
        right=_omega_cross_rc,
    ),
    Erratum(
        place="4.169, momentum of the mass center",
        wrong="without the factor m",
        draw=_flying,
        engine=_momentum,
        printed=_center_velocity,
        right=lambda s: mass_properties(s)[0] * _center_velocity(s),
    ),
    Erratum(
        place="4.170, third term of the equation of moments about O",
        wrong="V_c x dL/dV = 0 for V_O x dL/dV",
        draw=_flying,
        engine=lambda s: needed(s)[1] - rotational_rate(s),
        printed=lambda s: [0.0, 0.0, 0.0],
        right=_third_term,
    ),
)

TEXT_ONLY = (
    ("Text after 4.106", "-Omega x V is right only if Omega-hat is read as -[omega]x"),
    (
        "4.130, K",
        "not constant: the transpose of the matrix that takes (p, q, r) to angle rates",
    ),
    ("4.141", "right only where the origin is the mass center or a fixed point"),
    ("4.145, 4.173", "(xc', yc', zc') is the velocity of O; rc does not change in body axes"),
)
