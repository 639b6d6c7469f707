"""Errata of chapter 4, Example 2: the tricycle, q = (x, y, theta, phi) and wheelbase l."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy import array, cos, sin, tan

import jaxlag as jl
from jaxlag import energy
from systems.errata._erratum import Erratum, State, around, rate

# By the engine: the two contacts, along and across their wheels.


def _front(t, q, params):
    return q[:2] + params["l"] * jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])


def _wheel(angle):
    """Unit vectors (along, across) of a wheel at this angle, as rows of a matrix."""
    return jl.rotation.about_z(angle)[:2, :2].T


def _front_velocity(t, q, v, params):
    """Of the front contact, along and across its wheel."""
    return _wheel(q[2] + q[3]) @ energy.velocity(_front, t, q, v, params)


def _sideways(t, q, v, params):
    """Of the rear and of the front contact, across their wheels."""
    rear = _wheel(q[2])[1] @ v[:2]
    return jnp.stack([rear, _front_velocity(t, q, v, params)[1]])


def _front_speeds(s: State):
    return _front_velocity(s.t, s.q, s.v, s.params)


def _head_kinetic(t, q, v, params):
    """T of the mass m at the steering head."""
    return energy.particles(_front, params["m"], t, q, v, params)


def _fork_kinetic(t, q, v, params):
    def pose(t, q, params):
        return jl.rotation.about_z(q[2] + q[3]), jnp.zeros(3)

    spindle = energy.RigidBody(0.0, jnp.stack([0.0, 0.0, 1.0]) * params["I_phi"])
    return spindle.kinetic(pose, t, q, v, params)


def _body_kinetic(t, q, v, params):
    """T of the frame, with its mass center d ahead of the rear axle."""

    def pose(t, q, params):
        return jl.rotation.about_z(q[2]), jnp.stack([q[0], q[1], jnp.zeros_like(q[0])])

    d, zero = params["d"], jnp.zeros_like(params["d"])
    about_rear = params["I_theta"] + params["m"] * d**2
    inertia = jnp.stack([zero, about_rear, about_rear])
    frame = energy.RigidBody(params["m"], inertia, jnp.stack([d, zero, zero]))
    return frame.kinetic(pose, t, q, v, params)


def _drive(t, q, v, params):
    return params["F"] * _wheel(q[2] + q[3])[0]


def _steering(t, q, v, params):
    zero = jnp.zeros_like(params["tau"])
    return jnp.stack([zero, zero, zero, params["tau"]])


def _tricycle(kinetic):
    return jl.System(
        coordinates=("x", "y", "theta", "phi"),
        kinetic=kinetic,
        potential=lambda t, q, params: jnp.zeros_like(q[0]),
        forces=(jl.PointForce(_front, _drive, "drive"), jl.GeneralizedForce(_steering, "steering")),
        constraints=(jl.Pfaffian(_sideways, ("rear", "front")),),
    )


_HEAD = _tricycle(
    lambda t, q, v, params: _head_kinetic(t, q, v, params) + 0.5 * params["I_phi"] * v[3] ** 2
)
_RIGID = _tricycle(
    lambda t, q, v, params: _body_kinetic(t, q, v, params) + _fork_kinetic(t, q, v, params)
)


def _accelerations(system: jl.System, s: State):
    """(v', phi'') of the motion."""
    a = system.acceleration(s.q, s.v, s.params, t=s.t)
    along = rate(lambda t, q, v: _front_velocity(t, q, v, s.params)[0], s, a)
    return jnp.stack([along, a[3]])


def _rolling_rates(s: State):
    """(x', y', theta', phi') of a tricycle that rolls with the speeds v and phi'."""

    def residual(rates):
        along = _front_velocity(s.t, s.q, rates, s.params)[0]
        across = _sideways(s.t, s.q, rates, s.params)
        return jnp.stack([along - _front_speeds(s)[0], *across, rates[3] - s.v[3]])

    start = jnp.zeros(4)  # the equations are linear
    return -jnp.linalg.solve(jax.jacfwd(residual)(start), residual(start))


# The L of 4.76 in the quasi-velocities of 4.72-4.73, as printed.


def _printed_speeds(q, rates, params):
    cT, sT, cF, sF = jnp.cos(q[2]), jnp.sin(q[2]), jnp.cos(q[3]), jnp.sin(q[3])
    x, y, theta, phi = rates
    v = (x * cT + y * sT) / cF
    return jnp.stack([v, y * cT - x * sT, params["l"] * theta * cT * cF - x * sF, phi])


def _printed_lagrangian(q, u, params):
    matrix = jax.jacfwd(_printed_speeds, argnums=1)(q, jnp.zeros(4), params)
    theta = jnp.linalg.solve(matrix, u)[2]
    translation = params["m"] * (u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
    return 0.5 * (translation + params["I_phi"] * u[3] ** 2 + params["I_theta"] * theta**2)


def _gradient(s: State, by: int):
    """Of that L, by q (0) or u (1)."""
    u = _printed_speeds(s.q, s.v, s.params)
    return jax.grad(_printed_lagrangian, argnums=by)(jnp.asarray(s.q), u, s.params)


def _book_derivatives(s: State):
    """(dL/dv, dL/dv_R, dL/dphi)."""
    by_u = _gradient(s, 1)
    return jnp.stack([by_u[0], by_u[2], _gradient(s, 0)[3]])


# By the formulas.


def _v(s: State):
    cosine, sine = cos(s.q[2] + s.q[3]), sin(s.q[2] + s.q[3])
    return s.v[0] * cosine + s.v[1] * sine + s.params["l"] * s.v[2] * sin(s.q[3])


def _v_printed(s: State):
    return (s.v[0] * cos(s.q[2]) + s.v[1] * sin(s.q[2])) / cos(s.q[3])


def _vY(s: State):
    return s.v[1] * cos(s.q[2]) - s.v[0] * sin(s.q[2])


def _vR(s: State):
    forward = s.v[0] * cos(s.q[2]) + s.v[1] * sin(s.q[2])
    across = s.params["l"] * s.v[2] + _vY(s)
    return across * cos(s.q[3]) - forward * sin(s.q[3])


def _vR_printed(s: State):
    turning = s.params["l"] * s.v[2] * cos(s.q[2]) * cos(s.q[3])
    return turning - s.v[0] * sin(s.q[3])


def _rates(s: State, v: float, angle: int = 3):
    """(x', y', theta', phi') of a tricycle that rolls at v, theta' = v sin(angle)/l."""
    (cT, cF), sT, length = cos(s.q[2:]), sin(s.q[2]), s.params["l"]
    return array([v * cF * cT, v * cF * sT, v * sin(s.q[angle]) / length, s.v[3]])


def _half_squares(s: State, *speeds):
    return 0.5 * s.params["m"] * sum(speed**2 for speed in speeds)


def _turning_derivatives(s: State):
    """dtheta'/d(v, v_R, theta, phi) in the variables of 4.72-4.73."""
    (cT, cF), (sT, sF), length = cos(s.q[2:]), sin(s.q[2:]), s.params["l"]
    v, side = _v_printed(s), (_vR_printed(s) - _vY(s) * sT * sF) / (length * cF)
    by_theta = -_vY(s) * sF / (length * cF) + side * sT / cT**2
    by_phi = v * cF / length - _vY(s) * sT / (length * cT) + side * sF / (cT * cF)
    return sF / length, 1 / (length * cT * cF), by_theta, by_phi


def _book_formula(s: State, I_theta: float):
    """(dL/dv, dL/dv_R, dL/dphi) with this I_theta."""
    by_v, by_vR, _, by_phi = _turning_derivatives(s)
    m, p = s.params["m"], I_theta * s.v[2]
    return [m * _v_printed(s) + p * by_v, m * _vR_printed(s) + p * by_vR, p * by_phi]


def _book_theta(s: State):
    return s.params["I_theta"] * s.v[2] * _turning_derivatives(s)[2]


def _printed_motion(s: State):
    m, I_phi, F, tau = s.values("m", "I_phi", "F", "tau")
    v, slope = _v(s), tan(s.q[3])
    return [F / m - v * s.v[3] * slope, (tau + m * v**2 * slope) / I_phi]


def _head_motion(s: State):
    m, I_phi, F, tau = s.values("m", "I_phi", "F", "tau")
    return [F / m, tau / I_phi]


def _rigid_motion(s: State):
    m, d, I_theta, I_phi, F, tau, length = s.values("m", "d", "I_theta", "I_phi", "F", "tau", "l")
    v, phi_rate, c, sine = _v(s), s.v[3], cos(s.q[3]), sin(s.q[3])
    J = (I_theta + m * d**2) / length**2
    force = F - tau * sine / length - (J - m) * sine * c * v * phi_rate
    v_rate = force / (m * c**2 + J * sine**2)
    return [v_rate, tau / I_phi - (v_rate * sine + v * c * phi_rate) / length]


_any = around(
    {"m": 3.0, "d": 0.3, "l": 1.2, "I_theta": 0.5, "I_phi": 0.2, "F": 4.0, "tau": 0.8},
    (0.0, 0.0, 0.6, 0.5),
)


def _rolling(generator: np.random.Generator) -> State:
    """States in which neither contact slides sideways."""
    s = _any(generator)
    return s._replace(v=_rates(s, s.v[0]))


ERRATA = (
    Erratum(
        place="4.72, speed v of the front wheel",
        wrong="right only where v_R = 0, not finite at phi = pi/2",
        draw=_any,
        engine=lambda s: _front_speeds(s)[0],
        printed=_v_printed,
        right=_v,
    ),
    Erratum(
        place="4.73, sideways speed v_R of the front wheel",
        wrong="where v_Y = 0, cos(theta) times the right one",
        draw=_any,
        engine=lambda s: _front_speeds(s)[1],
        printed=_vR_printed,
        right=_vR,
    ),
    Erratum(
        place="4.76, T of the mass m, at the steering head",
        wrong="(v, v_Y, v_R) of 4.72-4.73 are not its velocity",
        draw=_any,
        engine=lambda s: _head_kinetic(s.t, s.q, s.v, s.params),
        printed=lambda s: _half_squares(s, _v_printed(s), _vY(s), _vR_printed(s)),
        right=lambda s: _half_squares(s, _v(s), _vR(s)),
    ),
    Erratum(
        place="4.76, T of the fork",
        wrong="phi'^2 for (theta' + phi')^2",
        draw=_any,
        engine=lambda s: _fork_kinetic(s.t, s.q, s.v, s.params),
        printed=lambda s: 0.5 * s.params["I_phi"] * s.v[3] ** 2,
        right=lambda s: 0.5 * s.params["I_phi"] * (s.v[2] + s.v[3]) ** 2,
    ),
    Erratum(
        place="4.76, dL/dv, dL/dv_R and dL/dphi of the L printed",
        wrong="theta' in L is a function of these, with I_theta",
        draw=_any,
        engine=_book_derivatives,
        printed=lambda s: _book_formula(s, 0.0),
        right=lambda s: _book_formula(s, s.params["I_theta"]),
    ),
    Erratum(
        place="4.81, rates of the rolling tricycle",
        wrong="theta' = v sin(theta)/l for v sin(phi)/l",
        draw=_any,
        engine=_rolling_rates,
        printed=lambda s: _rates(s, _v(s), 2),
        right=lambda s: _rates(s, _v(s)),
    ),
    Erratum(
        place="4.97-4.98, dL/dtheta of the L printed",
        wrong="dL/dtheta' for dL/dtheta",
        draw=_any,
        engine=lambda s: _gradient(s, 0)[2],
        printed=lambda s: s.params["I_theta"] * s.v[2],
        right=_book_theta,
    ),
    Erratum(
        place="4.98, v' and phi'' with the mass at the steering head",
        wrong="spurious m v phi' tan(phi) and m v^2 tan(phi)",
        draw=_rolling,
        engine=lambda s: _accelerations(_HEAD, s),
        printed=_printed_motion,
        right=_head_motion,
    ),
    Erratum(
        place="4.98, v' and phi'' with frame and fork as rigid bodies",
        wrong="as before; inertia of yaw left out",
        draw=_rolling,
        engine=lambda s: _accelerations(_RIGID, s),
        printed=_printed_motion,
        right=_rigid_motion,
    ),
)

TEXT_ONLY = (
    (
        "4.74",
        "singular at theta = +-pi/2, where v_R = 0 of 4.73 constrains nothing; the right v_R has "
        "no such place",
    ),
    ("4.76, remark on theta'", "dL/dtheta' does enter, except where I_theta = 0"),
    (
        "4.92",
        "no approximation is needed: on the constraints, where l theta' = v sin(phi), rows 1 and 4 "
        "are (phi' tan(phi), 0, -phi' cos(theta), 0) and (-v tan(phi), 0, v cos(theta), 0) exactly",
    ),
    (
        "4.98",
        "the equations printed conserve the energy of the L printed: a test of energy does not "
        "reveal them",
    ),
)
