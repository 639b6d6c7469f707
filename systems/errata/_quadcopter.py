"""Errata of chapter 3, Example 5: the quadcopter as a rigid body pushed by four rotors."""

import jax.numpy as jnp
from numpy import array, cos, diag, sin

import jaxlag as jl
from jaxlag.rotation import yaw_pitch_roll
from systems.catalogue.chapter3 import quadcopter
from systems.errata._erratum import Erratum, State, around, around_example

# By the engine: the body by its pose, each rotor by a force at its hub.


def _pose(t, q, params):
    return yaw_pitch_roll.matrix(q[3:]), q[:3]


def _hubs(t, q, params):
    R, center = _pose(t, q, params)
    arms = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return center + params["l"] * arms @ R.T


def _lifts(t, q, v, params):
    body_z = _pose(t, q, params)[0][:, 2]
    return jnp.outer(params["k"] * _speeds(params) ** 2, body_z)


def _drag(t, q, v, params):
    signs = jnp.array([1.0, -1.0, 1.0, -1.0])
    return params["b"] * signs @ _speeds(params) ** 2 * jnp.array([0.0, 0.0, 1.0])


def _speeds(params):
    return jnp.stack([params["w1"], params["w2"], params["w3"], params["w4"]])


_BODY = jl.System(
    coordinates=quadcopter.system.coordinates.names,
    kinetic=quadcopter.kinetic,
    potential=quadcopter.potential,
    forces=(
        jl.PointForce(_hubs, _lifts, "lift"),
        jl.Torque(quadcopter.angular_velocity, _drag, "drag"),
    ),
)


def _rotor_kinetic(t, q, v, params):
    """T of the rotors about their shafts: 1, 3 clockwise, 2, 4 counterclockwise from above."""
    relative = jnp.array([-1.0, 1.0, -1.0, 1.0]) * _speeds(params)
    frame_rate = quadcopter.angular_velocity(t, q, v, params)[2]
    return 0.5 * params["Im"] * jnp.sum((frame_rate + relative) ** 2)


_ROTORS = jl.System(
    coordinates=quadcopter.system.coordinates.names,
    kinetic=_rotor_kinetic,
    potential=lambda t, q, params: jnp.zeros_like(q[0]),
)
"""Four rotors that spin at given speeds relative to a massless frame."""


def _turning_energy(s: State):
    """T of the rotation, from the rate of change of the rotation matrix."""
    _, omega = jl.energy.body_velocity(_pose, s.t, s.q, s.v, s.params)
    return 0.5 * jnp.stack(s.values("Ix", "Iy", "Iz")) @ omega**2


def _force_of_translation(s: State):
    """Force along X, Y, Z that a motion requires in addition to lift and weight."""
    return jl.inverse_dynamics(_BODY, s.q, s.v, s.a, s.params, t=s.t)[:3]


def _rotational_force(s: State):
    """Generalized force of lift and drag on (psi, theta, phi)."""
    return _BODY.generalized_force(s.q, s.v, s.params, t=s.t)[3:]


def _gyroscopic_torque(s: State):
    """Torque of the spinning rotors on the frame, body components; all angles are 0."""
    stopped = {**s.params, **{name: 0.0 * s.params[name] for name in ("w1", "w2", "w3", "w4")}}
    needed, without = (jl.inverse_dynamics(_ROTORS, s.q, s.v, s.a, p) for p in (s.params, stopped))
    return (without - needed)[:2:-1]


def _velocity_terms(s: State):
    """J' eta' minus half the gradient of eta'.J eta', for the angles eta."""
    return _BODY.bias(s.q, s.v, s.params, t=s.t)[3:]


# By the formulas.


def _rotor_forces(s: State):
    return s.params["k"] * array(s.values("w1", "w2", "w3", "w4")) ** 2


def _body_torque(s: State):
    f1, f2, f3, f4 = _rotor_forces(s)
    w1, w2, w3, w4 = s.values("w1", "w2", "w3", "w4")
    drag = s.params["b"] * (w1**2 - w2**2 + w3**2 - w4**2)
    return array([(f2 - f4) * s.params["l"], (f3 - f1) * s.params["l"], drag])


def _rates_matrix(s: State):
    """W, with omega = W (psi', theta', phi')."""
    (_, cT, cF), (_, sT, sF) = cos(s.q[3:]), sin(s.q[3:])
    return array([[-sT, 0.0, 1.0], [cT * sF, cF, 0.0], [cT * cF, -sF, 0.0]])


def _rates_matrix_derivatives(s: State):
    """dW/deta_j for each angle in turn, shape (3, 3, 3) with j first."""
    (_, cT, cF), (_, sT, sF) = cos(s.q[3:]), sin(s.q[3:])
    by_theta = [[-cT, 0.0, 0.0], [-sT * sF, 0.0, 0.0], [-sT * cF, 0.0, 0.0]]
    by_phi = [[0.0, 0.0, 0.0], [cT * cF, -sF, 0.0], [-cT * sF, -cF, 0.0]]
    return array([[[0.0] * 3] * 3, by_theta, by_phi])


def _F(s: State, moments):
    """F_ij = 1/2 sum_k dJ_ik/deta_j eta_k', and J' eta' = 2 F eta'."""
    W, inertia = _rates_matrix(s), diag(moments)
    columns = []
    for dW in _rates_matrix_derivatives(s):
        half = dW.T @ inertia @ W
        columns.append(0.5 * (half + half.T) @ s.v[3:])
    return array(columns).T


def _as_printed(s: State, moments):
    """J' eta' - F eta'."""
    return _F(s, moments) @ s.v[3:]


def _right_terms(s: State):
    """J' eta' - F^T eta'."""
    F = _F(s, s.values("Ix", "Iy", "Iz"))
    return (2 * F - F.T) @ s.v[3:]


def _gyroscopic(s: State, signs, pitch: int):
    """-q h, pitch p h, 0 with the spin h = Im (signs . speeds)."""
    spin = s.params["Im"] * array(signs) @ array(s.values("w1", "w2", "w3", "w4"))
    _, q, p = s.v[3:]
    return array([-q * spin, pitch * p * spin, 0.0])


def _rotation_energy(s: State, omega):
    return 0.5 * array(s.values("Ix", "Iy", "Iz")) @ omega**2


def _translation(s: State, sign: int):
    """m X'' + sign (0, 0, m g) minus the thrust."""
    (cP, cT, cF), (sP, sT, sF) = cos(s.q[3:]), sin(s.q[3:])
    body_z = array([cF * sT * cP + sF * sP, cF * sT * sP - sF * cP, cF * cT])
    up = array([0.0, 0.0, sign * s.params["g"]])
    return s.params["m"] * (s.a[:3] + up) - _rotor_forces(s).sum() * body_z


_SIGNED = (-1.0, 1.0, -1.0, 1.0)

_any = around_example(quadcopter.entry)
_level = around(quadcopter.entry.example.params, (0.0,) * 6, dq=(0.4,) * 3 + (0.0,) * 3)
_hover = around(quadcopter.entry.example.params, (0.0,) * 6, dq=(0.4,) * 3 + (0.0,) * 3, dv=0.0)

ERRATA = (
    Erratum(
        place="3.76, T of the quadcopter's rotation",
        wrong="angle rates for the components of omega",
        draw=_any,
        engine=_turning_energy,
        printed=lambda s: _rotation_energy(s, s.v[:2:-1]),
        right=lambda s: _rotation_energy(s, _rates_matrix(s) @ s.v[3:]),
    ),
    Erratum(
        place="3.82, arms of pitch and roll, at zero angles",
        wrong="(f2 - f4) l and (f3 - f1) l interchanged",
        draw=_level,
        engine=lambda s: _rotational_force(s)[1:],
        printed=lambda s: _body_torque(s)[:2],
        right=lambda s: _body_torque(s)[1::-1],
    ),
    Erratum(
        place="3.82, generalized torques of the angles",
        wrong="body torques without W^T",
        draw=_any,
        engine=_rotational_force,
        printed=lambda s: _body_torque(s)[::-1],
        right=lambda s: _rates_matrix(s).T @ _body_torque(s),
    ),
    Erratum(
        place="Ch. 3, Example 5, gyroscopic torque of pitch, at zero angles",
        wrong="-p h for +p h",
        draw=_level,
        engine=_gyroscopic_torque,
        printed=lambda s: _gyroscopic(s, _SIGNED, -1),
        right=lambda s: _gyroscopic(s, _SIGNED, +1),
    ),
    Erratum(
        place="Ch. 3, Example 5, spin h of the rotors, at zero angles",
        wrong="sum of the speeds without their signs",
        draw=_level,
        engine=_gyroscopic_torque,
        printed=lambda s: _gyroscopic(s, (1.0,) * 4, +1),
        right=lambda s: _gyroscopic(s, _SIGNED, +1),
    ),
    Erratum(
        place="3.83, motion of the quadcopter's mass center",
        wrong="m X'' - (0, 0, m g) for m X'' + (0, 0, m g)",
        draw=_any,
        engine=_force_of_translation,
        printed=lambda s: _translation(s, -1),
        right=lambda s: _translation(s, +1),
    ),
    Erratum(
        place="3.86, velocity terms of the angles",
        wrong="F eta' for F^T eta'",
        draw=_any,
        engine=_velocity_terms,
        printed=lambda s: _as_printed(s, s.values("Ix", "Iy", "Iz")),
        right=_right_terms,
    ),
    Erratum(
        place="Ch. 3, Example 5, velocity terms of yaw written out",
        wrong="F eta' for F^T eta', and Ix, Iz interchanged",
        draw=_any,
        engine=lambda s: _velocity_terms(s)[0],
        printed=lambda s: _as_printed(s, s.values("Iz", "Iy", "Ix"))[0],
        right=lambda s: _right_terms(s)[0],
    ),
    Erratum(
        place="Ch. 3, Example 5, psi'', theta'', phi'' in hover",
        wrong="torque_z/Ix and torque_x/Iz, moments interchanged",
        draw=_hover,
        engine=lambda s: _BODY.acceleration(s.q, s.v, s.params, t=s.t)[3:],
        printed=lambda s: _body_torque(s)[::-1] / s.values("Ix", "Iy", "Iz"),
        right=lambda s: _body_torque(s)[::-1] / s.values("Iz", "Iy", "Ix"),
    ),
)

TEXT_ONLY = (
    ("Ch. 3, Example 5, text at 3.82", "the rotors of pitch are 1 and 3, those of roll 2 and 4"),
    ("Ch. 3, Example 5, text at 3.83", "the thrust is along +z of the body, not -z"),
)
