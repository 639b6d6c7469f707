"""Errata of chapter 4, eqs. 4.170 to 4.211: rigid aircraft and quadcopter, with Z downward."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy import array, cross, diag

import jaxlag as jl
from jaxlag import energy
from jaxlag.rotation import yaw_pitch_roll
from systems.errata import _attitude as attitude
from systems.errata import _chapter4_body_axes as body
from systems.errata._erratum import Erratum, State, around, rate

# Aircraft by the engine: four particles, a force and a torque fixed in the body axes.


def _weight_energy(s: State):
    r = body.particles(s.t, s.q, s.params)
    down = jnp.array([0.0, 0.0, 1.0])
    return energy.gravity(body.masses(s.params), r, s.params["g"] * down)


def _body_rates(t, q, v, params):
    return energy.body_velocity(attitude.pose, t, q, v, params)[1]


def _force(t, q, v, params):
    return attitude.rotation_matrix(q[3:]) @ jnp.stack([params["Fx"], params["Fy"], params["Fz"]])


def _torque(t, q, v, params):
    return jnp.stack([params["Mx"], params["My"], params["Mz"]])


_COORDINATES = ("X", "Y", "Z", "phi", "theta", "psi")

_AIRCRAFT = jl.System(
    coordinates=_COORDINATES,
    kinetic=body.kinetic,
    potential=lambda t, q, params: jnp.zeros_like(q[0]),
    forces=(
        jl.PointForce(lambda t, q, params: q[:3], _force, "at O"),
        jl.PointForce(body.center, _force, "at the mass center"),
        jl.Torque(_body_rates, _torque, "torque"),
    ),
)


def _applied(s: State, *names: str):
    """Torque about O, body components, of the forces with these names."""
    Q = _AIRCRAFT.generalized_force(s.q, s.v, s.params, t=s.t, names=names)
    return attitude.body_torque(s.q[3:], Q[3:])


def _inertia(s: State):
    """d2T/domega2."""

    def spun(w):
        rates = yaw_pitch_roll.from_body_rates(s.q[:2:-1], w)[::-1]
        return body.kinetic(s.t, s.q, jnp.concatenate([jnp.zeros(3), rates]), s.params)

    return jax.hessian(spun)(jnp.zeros(3))


def _power(s: State):
    """dT/dt."""
    return rate(lambda t, q, v: body.kinetic(t, q, v, s.params), s, s.a)


# Aircraft by the formulas.


def _kinetic_formula(s: State, sign: int):
    """T with sign * m V.(omega x rc)."""
    m, rc, inertia = body.mass_properties(s)
    V, w = attitude.body_speeds(s)[0], attitude.body_rates(s)[0]
    return 0.5 * m * V @ V + sign * m * V @ cross(w, rc) + 0.5 * w @ inertia @ w


def _height_energy(s: State, height: float):
    """-m g (height + k.rc)."""
    m, rc, _ = body.mass_properties(s)
    k = attitude.direction_cosines(s.q[3:])[:, 2]
    return -m * s.params["g"] * (height + k @ rc)


def _force_formula(s: State, sign: int):
    """m (V' + omega x V) and sign times the terms with rc."""
    m, rc, _ = body.mass_properties(s)
    (V, V_rate), (w, w_rate) = attitude.body_speeds(s), attitude.body_rates(s)
    return m * (V_rate + cross(w, V) + sign * (cross(w_rate, rc) + cross(w, cross(w, rc))))


def _rotation_formula(s: State, sign: int):
    """d/dt dT/domega + omega x dT/domega, with sign times the terms with V."""
    m, rc, inertia = body.mass_properties(s)
    (V, V_rate), (w, w_rate) = attitude.body_speeds(s), attitude.body_rates(s)
    turning = inertia @ w_rate + cross(w, inertia @ w)
    return turning + sign * m * (cross(rc, V_rate) + cross(w, cross(rc, V)))


def _third_term(s: State):
    """V x dT/dV."""
    m, rc, _ = body.mass_properties(s)
    V, w = attitude.body_speeds(s)[0], attitude.body_rates(s)[0]
    return m * cross(V, cross(w, rc))


def _power_formula(s: State, third: float):
    """F.V + M.omega, M with `third` times its third term."""
    V, w = attitude.body_speeds(s)[0], attitude.body_rates(s)[0]
    moment = _rotation_formula(s, +1) + third * _third_term(s)
    return _force_formula(s, +1) @ V + moment @ w


def _lever(s: State):
    """rc x F."""
    return cross(body.mass_properties(s)[1], s.values("Fx", "Fy", "Fz"))


def _torque_formula(s: State):
    return array(s.values("Mx", "My", "Mz"))


# Quadcopter by the engine: rotors in front, left, rear, right; y is to the right.


def _hubs(t, q, params):
    R, center = attitude.pose(t, q, params)
    arms = jnp.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return center + params["l"] * arms @ R.T


def _thrusts(params):
    return jnp.stack([params["f1"], params["f2"], params["f3"], params["f4"]])


def _frame_kinetic(t, q, v, params):
    return energy.particles(_hubs, params["m"] / 4 * jnp.ones(4), t, q, v, params)


def _frame_potential(t, q, params):
    return -params["m"] * params["g"] * q[2]


_FRAME = jl.System(
    coordinates=_COORDINATES,
    kinetic=_frame_kinetic,
    potential=_frame_potential,
)

_LIFTED = jl.System(
    coordinates=_COORDINATES,
    kinetic=_frame_kinetic,
    potential=_frame_potential,
    forces=(
        jl.PointForce(
            _hubs,
            lambda t, q, v, params: (
                -jnp.outer(_thrusts(params), attitude.rotation_matrix(q[3:])[:, 2])
            ),
            "thrust",
        ),
    ),
)


def _lift_torque(s: State):
    """Torque of the rotors' thrusts about body x and y."""
    Q = _LIFTED.generalized_force(s.q, s.v, s.params, t=s.t)
    return attitude.body_torque(s.q[3:], Q[3:])[:2]


_SENSES = (-1.0, 1.0, -1.0, 1.0)
"""Of the rotors' spins about z, downward."""


def _spin_kinetic(t, q, v, params):
    """T of the rotors about their shafts."""
    relative = jnp.stack([s * params[f"w{i}"] for i, s in enumerate(_SENSES, 1)])
    return 0.5 * params["Jr"] * jnp.sum((_body_rates(t, q, v, params)[2] + relative) ** 2)


_ROTORS = jl.System(
    coordinates=_COORDINATES,
    kinetic=_spin_kinetic,
    potential=lambda t, q, params: jnp.zeros_like(q[0]),
)
"""Four rotors with given rates relative to a massless frame."""


def _gyroscopic_torque(s: State):
    """Torque of the spinning rotors on the frame, body components."""
    stopped = {**s.params, **{f"w{i}": 0.0 * s.params[f"w{i}"] for i in range(1, 5)}}
    needed, without = (jl.inverse_dynamics(_ROTORS, s.q, s.v, s.a, p) for p in (s.params, stopped))
    return attitude.body_torque(s.q[3:], (without - needed)[3:])


# Quadcopter by the formulas.


def _thrust_formula(s: State, sign: int):
    return [0.0, 0.0, sign * sum(s.values("f1", "f2", "f3", "f4"))]


def _gyroscopic(s: State, senses, pitch: int):
    """(-q H, pitch p H, 0)."""
    H = s.params["Jr"] * array(senses) @ s.values("w1", "w2", "w3", "w4")
    p, q, _ = attitude.body_rates(s)[0]
    return array([-q * H, pitch * p * H, 0.0])


def _arms(s: State, *names: str):
    """Torques of roll and pitch by the thrusts with these names, + - + -."""
    a, b, c, d = s.values(*names)
    return [(a - b) * s.params["l"], (c - d) * s.params["l"]]


def _yaw(s: State, product: float):
    """Torque about z, with `product` times the term of p q."""
    (Ix, Iy, Iz), (w, w_rate) = attitude.moments(s), attitude.body_rates(s)
    return Iz * w_rate[2] + product * (Iy - Ix) * w[0] * w[1]


_ANGLES = (0.0, 0.0, 0.0, 0.5, 0.4, 0.7)
_APPLIED = {"g": 9.81, "Fx": 4.0, "Fy": -2.0, "Fz": 3.0, "Mx": 1.5, "My": 0.8, "Mz": -1.1}
_QUADCOPTER = {"g": 9.81, "l": 0.25, "f1": 1.2, "f2": 1.5, "f3": 1.0, "f4": 1.4}
_LEVEL = (0.4, 0.4, 0.4, 0.0, 0.0, 0.0)

_aircraft = around(
    {
        **body.MASSES,
        **body.SIZES,
        **_APPLIED,
    },
    _ANGLES,
    dq=(2.0, 2.0, 2.0, 0.4, 0.4, 0.4),
)
_rotors = around({"Jr": 6e-3, "w1": 300.0, "w2": 340.0, "w3": 310.0, "w4": 360.0}, _ANGLES)
_flying = around({"m": 0.5, **_QUADCOPTER}, _ANGLES)


def _hovering(generator: np.random.Generator) -> State:
    """Level states of rest in which the thrusts just carry the weight."""
    s = around(_QUADCOPTER, (0.0,) * 6, dq=_LEVEL, dv=0.0, da=0.0)(generator)
    mass = sum(s.values("f1", "f2", "f3", "f4")) / s.params["g"]
    return s._replace(params={**s.params, "m": mass})


ERRATA = (
    Erratum(
        place="4.170, dT/dt = F.V + M.omega with the equations of moments",
        wrong="not so without V_O x dL/dV",
        draw=_aircraft,
        engine=_power,
        printed=lambda s: _power_formula(s, 0.0),
        right=lambda s: _power_formula(s, 1.0),
    ),
    Erratum(
        place="4.172-4.175, 4.180, 4.186, T of a rigid body",
        wrong="-m V.(omega x rc) for +, as in 2.16",
        draw=_aircraft,
        engine=lambda s: body.kinetic(s.t, s.q, s.v, s.params),
        printed=lambda s: _kinetic_formula(s, -1),
        right=lambda s: _kinetic_formula(s, +1),
    ),
    Erratum(
        place="4.175, inertia matrix after it, entry (3,3)",
        wrong="-Iz for Iz",
        draw=_aircraft,
        engine=_inertia,
        printed=lambda s: body.mass_properties(s)[2] * (1 - 2 * diag([0.0, 0.0, 1.0])),
        right=lambda s: body.mass_properties(s)[2],
    ),
    Erratum(
        place="4.178, 4.187, V of a rigid body",
        wrong="without the height Z of O",
        draw=_aircraft,
        engine=_weight_energy,
        printed=lambda s: _height_energy(s, 0.0),
        right=lambda s: _height_energy(s, s.q[2]),
    ),
    Erratum(
        place="4.181-4.184, force equations",
        wrong="signs of m omega' x rc and m omega x (omega x rc)",
        draw=_aircraft,
        engine=lambda s: body.needed(s)[0],
        printed=lambda s: _force_formula(s, -1),
        right=lambda s: _force_formula(s, +1),
    ),
    Erratum(
        place="4.185, 4.193, moment about O of a force at O and a torque",
        wrong="rc x F added",
        draw=_aircraft,
        engine=lambda s: _applied(s, "at O", "torque"),
        printed=lambda s: _torque_formula(s) + _lever(s),
        right=_torque_formula,
    ),
    Erratum(
        place="4.188-4.197, rates of dT/domega in the moment equations",
        wrong="signs of m rc x V' and m omega x (rc x V)",
        draw=_aircraft,
        engine=body.rotational_rate,
        printed=lambda s: _rotation_formula(s, -1),
        right=lambda s: _rotation_formula(s, +1),
    ),
    Erratum(
        place="4.197, moment equations about O, with the right signs",
        wrong="without V x dT/dV",
        draw=_aircraft,
        engine=lambda s: body.needed(s)[1],
        printed=lambda s: _rotation_formula(s, +1),
        right=lambda s: _rotation_formula(s, +1) + _third_term(s),
    ),
    Erratum(
        place="4.197, moment about O of a force at the mass center",
        wrong="-rc x F for +rc x F",
        draw=_aircraft,
        engine=lambda s: _applied(s, "at the mass center"),
        printed=lambda s: -_lever(s),
        right=_lever,
    ),
    Erratum(
        place="4.202, force of the rotors in hover, body components",
        wrong="+sum f for -sum f where z is downward",
        draw=_hovering,
        engine=lambda s: jl.inverse_dynamics(_FRAME, s.q, s.v, s.a, s.params)[:3],
        printed=lambda s: _thrust_formula(s, +1),
        right=lambda s: _thrust_formula(s, -1),
    ),
    Erratum(
        place="4.206, third row, torque of yaw",
        wrong="without (Iy - Ix) p q, which is 0 if Ix = Iy",
        draw=around(attitude.SPINNING, (0.5, 0.4, 0.7)),
        engine=lambda s: attitude.needed_torque(s)[2],
        printed=lambda s: _yaw(s, 0.0),
        right=lambda s: _yaw(s, 1.0),
    ),
    Erratum(
        place="4.210-4.211, torques of roll and pitch",
        wrong="(f3 - f1) l, (f2 - f4) l for (f2 - f4) l, (f1 - f3) l",
        draw=_flying,
        engine=_lift_torque,
        printed=lambda s: _arms(s, "f3", "f1", "f2", "f4"),
        right=lambda s: _arms(s, "f2", "f4", "f1", "f3"),
    ),
    Erratum(
        place="Ch. 4, Example 6, gyroscopic torque of pitch",
        wrong="-p H for +p H",
        draw=_rotors,
        engine=_gyroscopic_torque,
        printed=lambda s: _gyroscopic(s, _SENSES, -1),
        right=lambda s: _gyroscopic(s, _SENSES, +1),
    ),
    Erratum(
        place="Ch. 4, Example 6, spin H of the rotors",
        wrong="sum of the rates without their signs",
        draw=_rotors,
        engine=_gyroscopic_torque,
        printed=lambda s: _gyroscopic(s, (1.0,) * 4, +1),
        right=lambda s: _gyroscopic(s, _SENSES, +1),
    ),
)

TEXT_ONLY = (
    ("4.178, 4.187, 4.196-4.197", "(xp, yp, zp) is the mass center (xc, yc, zc)"),
    (
        "4.185, 4.193, 4.197",
        "rc x F belongs there if F is given at the mass center; one given at O has no moment",
    ),
    (
        "4.204",
        "these body components are those of a point straight above or below the inertial origin; "
        "gravity has no moment because L depends on Z alone, an independent coordinate",
    ),
    ("4.210", "the vector is ordered (psi, theta, phi), with the torques of two of them exchanged"),
    ("Ch. 4, Example 6, thrusts that roll", "f2 and f2 is f2 and f4"),
    (
        "Ch. 4, Example 6, clockwise and counterclockwise rotors",
        "seen from above, the sign of the yaw torque is that of z upward; with z downward it needs "
        "the spins (-, +, -, +) about z",
    ),
)
