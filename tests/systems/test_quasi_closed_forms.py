"""Rolling and sliding bodies in quasi-velocities: closed forms, reduced equations by hand."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _closed_forms import TIGHT, close, close_to_exact, move, space_axes
from numpy import cos, sin
from scipy.integrate import solve_ivp

import jaxlag as jl

# ---- Chaplygin's sleigh --------------------------------------------------------------------------

SLEIGH = {"m": 2.0, "I": 0.9, "a": 0.5}


@pytest.mark.full
@pytest.mark.parametrize(("v0", "omega0"), [(-1.2, 0.3), (0.5, -1.5)])
def test_sleigh_agrees_with_hyperbolic_functions(v0, omega0):
    times, start = np.linspace(0.0, 6.0, 7), (1.0, -0.5, -0.2)
    motion = move("chaplygin_sleigh", SLEIGH, start, {"v": v0, "omega": omega0}, times)
    close_to_exact("chaplygin_sleigh", motion, SLEIGH)
    m, I, a = (SLEIGH[name] for name in ("m", "I", "a"))  # noqa: E741
    close(motion.lam["v_n"], m * I / (I + m * a**2) * motion["v"] * motion["omega"])
    close(motion.energy, np.full(7, motion.energy[0]))


@pytest.mark.full
def test_sleigh_ends_in_forward_motion_from_every_start():
    """At v = sqrt(2 T/m); after backward motion it has rotated by pi sqrt(J/m)/a."""
    m, a, J = SLEIGH["m"], SLEIGH["a"], SLEIGH["I"] + SLEIGH["m"] * SLEIGH["a"] ** 2
    starts = np.array([[-1.0, 1e-6], [-1.0, -1e-6], [-0.3, 0.9], [0.0, -1.1], [0.7, 0.2]])
    ends = [0.0, 90.0]  # e^(-kappa t) of the slowest is below 1e-16 then

    def end(start):
        u0 = {"v": start[0], "omega": start[1]}
        motion = move("chaplygin_sleigh", SLEIGH, (0.0, 0.0, 0.0), u0, ends)
        return jnp.stack([motion["v"][-1], motion["omega"][-1], motion["theta"][-1]])

    v, omega, theta = np.asarray(jax.vmap(end)(jnp.asarray(starts))).T
    close(v, np.sqrt(starts[:, 0] ** 2 + J / m * starts[:, 1] ** 2))
    close(omega, np.zeros(5))
    # The start is short of v = -C by sech(s0) = 1e-6 sqrt(J/m)/C, theta by sqrt(J/m)/a of that.
    whole = np.pi * np.sqrt(J / m) / a
    np.testing.assert_allclose(theta[:2], [whole, -whole], rtol=0, atol=1.01e-6 * J / m / a)


# ---- Suslov's problem ----------------------------------------------------------------------------

SUSLOV = {"I1": 2.0, "I2": 1.5, "I3": 1.2, "I13": 0.4, "I23": -0.3}


def suslov(times, I1, I2, I3, I13, I23, wx, wy):
    """(wx, wy, lambda): sin(s - delta) = tanh(D t + c)."""
    twice = I1 * wx**2 + I2 * wy**2
    ax, ay = np.sqrt(twice / I1), np.sqrt(twice / I2)
    D = np.array([I13 * ax, I23 * ay]) / np.sqrt(I1 * I2)
    size, delta = np.hypot(*D), np.arctan2(D[1], D[0])
    s0 = np.arctan2(wy / ay, wx / ax) - delta
    tau = size * times + np.arctanh(sin(s0))
    up, parallel = np.tanh(tau), np.sign(cos(s0)) / np.cosh(tau)
    wx, wy = (
        ax * (parallel * cos(delta) - up * sin(delta)),
        ay * (up * cos(delta) + parallel * sin(delta)),
    )
    force = I13 * wx + I23 * wy
    lam = -I13 * force * wy / I1 + I23 * force * wx / I2 + (I2 - I1) * wx * wy
    return np.column_stack([wx, wy, lam])


@pytest.mark.full
@pytest.mark.parametrize(("wx", "wy"), [(0.8, -0.5), (-0.9, 0.1)])
def test_suslov_body_agrees_with_hyperbolic_functions(wx, wy):
    """In both ways from one direction to its opposite; the angles avoid gimbal lock."""
    times = np.linspace(0.0, 2.0, 6)
    motion = move("suslov", SUSLOV, (0.1, 0.2, 0.0), {"wx": wx, "wy": wy}, times)
    found = np.column_stack([motion["wx"], motion["wy"], motion.lam["wz"]])
    close(found, suslov(times, **SUSLOV, wx=wx, wy=wy))
    close(motion["wz"], np.zeros(6))
    close(motion.energy, np.full(6, motion.energy[0]))


@pytest.mark.full
def test_the_suslov_body_ends_about_one_fixed_direction():
    """I13 wx + I23 wy = 0, in the direction of s = delta + pi/2, for any start."""
    starts = np.array([[0.02, 0.05], [-0.04, 0.03], [0.05, -0.02], [-0.05, 0.001]])
    params = SUSLOV | {"I13": 1.1, "I23": -0.9}  # fast enough to be there before gimbal lock

    def end(start):
        u0 = {"wx": start[0], "wy": start[1]}
        return move("suslov", params, (0.0, 0.0, 0.0), u0, [0.0, 0.5]).u[-1]

    ends = np.asarray(jax.vmap(end)(jnp.asarray(starts)))
    for found, (wx, wy) in zip(ends, starts, strict=True):
        close(found[:2], suslov(np.array([0.5]), **params, wx=wx, wy=wy)[0, :2])
    # By the closed form, which holds for all times:
    last = np.array([suslov(np.array([1e4]), **params, wx=wx, wy=wy)[0, :2] for wx, wy in starts])
    close(last @ [params["I13"], params["I23"]], np.zeros(4), 1e-15)
    assert np.all(last @ [-params["I23"], params["I13"]] > 0)


# ---- Ball on a turntable -------------------------------------------------------------------------


def turntable(times, m, a, I, Omega, g, alpha, z0, rate0):  # noqa: E741
    """(z, z', z'') of z = x + i y from (1 + k) z'' = i k Omega z' + g sin(alpha)."""
    k = I / (m * a**2)
    w, acceleration = k * Omega / (1 + k), g * sin(alpha) / (1 + k)
    drift = 1j * acceleration / w
    turn = np.exp(1j * w * times)
    z = z0 + drift * times + (rate0 - drift) * (turn - 1) / (1j * w)
    return z, drift + (rate0 - drift) * turn, 1j * w * (rate0 - drift) * turn


@pytest.mark.full
@pytest.mark.parametrize(("k", "alpha"), [(2 / 5, 0.0), (2 / 3, 0.002)], ids=["level", "tilted"])
def test_ball_on_a_turntable_agrees_with_its_closed_form(k, alpha):
    """At 2/7 (solid) and 2/5 (hollow) of the table's rate, once; on the tilt it also drifts.

    The ball is so large that it does not reach gimbal lock.
    """
    params = {"m": 0.3, "a": 1.0, "I": 0.3 * k, "Omega": 3.0, "g": 9.81, "alpha": alpha}
    rate = {2 / 5: 2 / 7, 2 / 3: 2 / 5}[k] * params["Omega"]
    times = np.linspace(0.0, 2 * np.pi / rate, 7)
    start, u0 = (0.05, 0.02, 0.1, 0.2, -0.3), {"wX": 0.1, "wY": -0.05, "wZ": 0.02}
    motion = move("rolling_ball_turntable", params, start, u0, times)
    z0 = start[0] + 1j * start[1]
    rate0 = params["a"] * (u0["wY"] - 1j * u0["wX"]) + 1j * params["Omega"] * z0
    z, z_rate, z_push = turntable(times, **params, z0=z0, rate0=rate0)
    close(motion.q[:, :2], np.column_stack([z.real, z.imag]))
    rolling = z_rate - 1j * params["Omega"] * z  # a (wY - i wX)
    close(motion["wX"], -rolling.imag / params["a"])
    close(motion["wY"], rolling.real / params["a"])
    close(motion["wZ"], np.full(7, u0["wZ"]))
    force = params["m"] * (z_push - params["g"] * sin(alpha))
    close(motion.lam["s_x"], force.real)
    close(motion.lam["s_y"], force.imag)
    drift = 1j * params["g"] * sin(alpha) / (k * params["Omega"]) * times[-1]
    close(motion.q[-1, :2], [(z0 + drift).real, (z0 + drift).imag])
    assert np.ptp(motion.energy) > 1e-3 * motion.energy[0]  # the table does work


# ---- Disks and edges -----------------------------------------------------------------------------


@pytest.mark.full
def test_upright_disk_rolls_on_a_circle():
    """One circle of radius R theta'/phi'."""
    params = {"m": 1.2, "R": 0.4, "I": 0.1, "J": 0.05, "tau_theta": 0.0, "tau_phi": 0.0}
    roll, turn, phi0 = 3.0, -0.8, 0.3
    times = np.linspace(0.0, 2 * np.pi / abs(turn), 7)
    u0 = {"thetadot": roll, "phidot": turn}
    motion = move("vertical_rolling_disk", params, (0.1, -0.2, 0.5, phi0), u0, times)
    close_to_exact("vertical_rolling_disk", motion, params)
    phi, radius = phi0 + turn * times, params["R"] * roll / turn
    x, y = 0.1 + radius * (sin(phi) - sin(phi0)), -0.2 - radius * (cos(phi) - cos(phi0))
    close(motion.q, np.column_stack([x, y, 0.5 + roll * times, phi]))
    force = params["m"] * params["R"] * roll * turn
    lam = np.column_stack([motion.lam["s_x"], motion.lam["s_y"]])
    close(lam, force * np.column_stack([-sin(phi), cos(phi)]))


@pytest.mark.full
def test_the_upright_disk_is_driven_along_a_spiral():
    params = {"m": 2.0, "R": 0.3, "I": 0.09, "J": 0.04, "tau_theta": 0.2, "tau_phi": -0.03}
    times, start = np.linspace(0.0, 4.0, 7), (1.0, 0.5, 0.2, -0.4)
    u0 = {"thetadot": -1.0, "phidot": 0.5}
    motion = move("vertical_rolling_disk", params, start, u0, times)
    q, v = close_to_exact("vertical_rolling_disk", motion, params)
    m, R, phi, roll, turn = params["m"], params["R"], q[:, 3], v[:, 2], v[:, 3]
    spin = params["tau_theta"] / (params["I"] + m * R**2)
    close(motion.lam["s_x"], m * R * (spin * cos(phi) - roll * turn * sin(phi)))
    close(motion.lam["s_y"], m * R * (spin * sin(phi) + roll * turn * cos(phi)))


@pytest.mark.full
@pytest.mark.parametrize(("v0", "turn", "phi0"), [(0.0, 1.5, 0.0), (1.3, -2.0, 0.7)])
def test_the_knife_edge_does_not_slide_down_the_slope(v0, turn, phi0):
    """From rest x stays below g sin(alpha)/(2 phi'^2): a cycloid across the slope."""
    params = {"m": 1.5, "J": 0.2, "g": 9.81, "alpha": 0.3}
    times, gravity = np.linspace(0.0, 6.0, 7), params["g"] * sin(params["alpha"])
    u0 = {"v": v0, "phidot": turn}
    motion = move("knife_edge_incline", params, (0.0, 0.0, phi0), u0, times)
    q, _ = close_to_exact("knife_edge_incline", motion, params)
    phi = phi0 + turn * times
    v = v0 + gravity / turn * (sin(phi) - sin(phi0))
    close(motion["v"], v)
    close(motion.lam["v_n"], -params["m"] * (v * turn + gravity * sin(phi)))
    if v0 == 0:
        close(q[:, 0], gravity / (2 * turn**2) * sin(turn * times) ** 2, 1e-15)


@pytest.mark.full
def test_the_nonholonomic_particle_slows_by_its_constraint():
    """Not by the L with the constraint inserted: that has another motion."""
    m, start, (x_rate, y_rate) = 2.5, (1.0, -1.3, -0.5), (-0.7, 1.1)
    times = np.linspace(0.0, 3.0, 6)
    u0 = {"xdot": x_rate, "ydot": y_rate}
    motion = move("nonholonomic_particle", {"m": m}, start, u0, times)
    q, _ = close_to_exact("nonholonomic_particle", motion, {"m": m})
    y, c = q[:, 1], x_rate * np.sqrt(1 + start[1] ** 2)
    close(motion.lam["s"], m * c * y_rate / (1 + y**2) ** 1.5)  # m z'' of z' = c y/root

    def inserted_constraint(t, q, v, params):
        return 0.5 * m * (v[0] ** 2 * (1 + q[1] ** 2) + v[1] ** 2)

    wrong = jl.System(inserted_constraint, ("x", "y"))
    other = jl.simulate(wrong, start[:2], (x_rate, y_rate), times, **TIGHT)
    assert np.max(np.abs(other["y"] - y)) > 0.1


@pytest.mark.full
def test_steady_rolling_of_the_disk_has_its_closed_form():
    """By hand for w1' = 0: inclined, its center on a circle about a point at rest."""
    m, R, I_d, I_a, g = 1.0, 0.5, 0.0625, 0.125, 9.81
    theta, w2, psi0 = 1.1, 1.4, 0.3
    c, s = cos(theta), sin(theta)
    w3 = (I_d * w2**2 * c / s - m * g * R * c) / ((I_a + m * R**2) * w2)
    turn = w2 / s
    params = {"m": m, "R": R, "I_d": I_d, "I_a": I_a, "g": g}
    times = np.linspace(0.0, 2 * np.pi / turn, 7)
    u0 = {"w1": 0.0, "w2": w2, "w3": w3}
    motion = move("rolling_disk", params, (0.2, 0.1, psi0, theta, 0.0), u0, times)
    psi, radius = psi0 + turn * times, -R * w3 / turn
    x, y = 0.2 + radius * (sin(psi) - sin(psi0)), 0.1 - radius * (cos(psi) - cos(psi0))
    phi = (w3 - turn * c) * times
    close(motion.q, np.column_stack([x, y, psi, np.full(7, theta), phi]))
    force = m * radius * turn**2
    lam = np.column_stack([motion.lam["s_x"], motion.lam["s_y"]])
    close(lam, force * np.column_stack([-sin(psi), cos(psi)]))


@pytest.mark.full
def test_disk_obeys_the_reduced_equations():
    m, R, I_d, I_a, g = 0.8, 0.4, 0.03, 0.07, 9.81
    times = np.linspace(0.0, 2.0, 7)

    def rates(t, state):
        _, _, psi, theta, _, w1, w2, w3 = state
        c, s = cos(theta), sin(theta)
        gravity = m * g * R * c
        return [
            -R * w3 * cos(psi) + R * w1 * s * sin(psi),
            -R * w3 * sin(psi) - R * w1 * s * cos(psi),
            w2 / s,
            w1,
            w3 - w2 * c / s,
            (I_d * w2**2 * c / s - (I_a + m * R**2) * w2 * w3 - gravity) / (I_d + m * R**2),
            (I_a * w1 * w3 - I_d * w1 * w2 * c / s) / I_d,
            m * R**2 * w1 * w2 / (I_a + m * R**2),
        ]

    start = [0.0, 0.0, 0.2, 1.2, 0.0, 0.3, 0.5, -6.0]
    expected = by_dop853(rates, start, times)
    params = {"m": m, "R": R, "I_d": I_d, "I_a": I_a, "g": g}
    u0 = dict(zip(("w1", "w2", "w3"), start[5:], strict=True))
    motion = move("rolling_disk", params, start[:5], u0, times)
    close(np.column_stack([motion.q, motion.u[:, :3]]), expected)
    close(motion.energy, np.full(7, motion.energy[0]))


def by_dop853(rates, start, times):
    """The solution of the reduced equations at `times`."""
    span, method = (times[0], times[-1]), "DOP853"
    found = solve_ivp(rates, span, start, method, t_eval=times, rtol=1e-13, atol=1e-14)
    return found.y.T


# ---- Chaplygin's ball ----------------------------------------------------------------------------


@pytest.mark.full
def test_ball_conserves_energy_and_momentum_about_the_contact():
    """By hand, not by the file: I omega + a n x m r', with n from contact to center."""
    params = {"m": 1.3, "a": 0.3, "I1": 0.02, "I2": 0.03, "I3": 0.045}
    u0 = {"wx": 0.9, "wy": 0.6, "wz": -0.7}
    motion = move("chaplygin_ball", params, (0.0, 0.0, 0.2, 0.1, -0.3), u0, np.linspace(0, 1.2, 7))
    moments, up = np.array([params["I1"], params["I2"], params["I3"]]), np.array([0.0, 0.0, 1.0])
    found = []
    for q, v, u in zip(*map(np.asarray, (motion.q, motion.v, motion.u)), strict=True):
        orbital = params["m"] * params["a"] * np.cross(up, [*v[:2], 0.0])
        found.append(space_axes(q[2:]) @ (moments * u[:3]) + orbital)
    close(found, np.tile(found[0], (7, 1)))
    assert np.ptp(motion.u[:, :3], axis=0).min() > 0.05
    close(motion.energy, np.full(7, motion.energy[0]))


# ---- Snakeboard ----------------------------------------------------------------------------------

BOARD = {"m": 4.0, "r": 0.25, "J": 0.2, "J_r": 0.12, "J_w": 0.05}
NO_TORQUE = {"a_psi": 0.0, "w_psi": 1.0, "a_phi": 0.0, "w_phi": 1.0}
GAIT = {"a_psi": 0.5, "w_psi": 3.0, "a_phi": -0.25, "w_phi": 3.0}


def board_rates(t, state, m, r, J, J_r, J_w, a_psi, w_psi, a_phi, w_phi):
    """Rates of (x, y, theta, psi, phi, xi, psi', phi')."""
    _, _, theta, _, phi, xi, rotor, steer = state
    c, s, Jb = cos(phi), sin(phi), J + 2 * J_w
    on_rotor, on_wheels = a_psi * sin(w_psi * t), a_phi * sin(w_phi * t)
    xi_rate = -((Jb - m * r**2) * s * c * xi * steer + on_rotor * s)
    xi_rate /= m * r**2 * c**2 + Jb * s**2
    forward = r * xi * c
    turn_rate = xi_rate * s + xi * c * steer
    return [
        *(forward * cos(theta), forward * sin(theta), xi * s, rotor, steer),
        *(xi_rate, on_rotor / J_r - turn_rate, on_wheels / (2 * J_w)),
    ]


@pytest.mark.full
@pytest.mark.parametrize("torques", [NO_TORQUE, GAIT], ids=["coasting", "gait"])
def test_snakeboard_obeys_the_reduced_equations(torques):
    params, times = BOARD | torques, np.linspace(0.0, 6.0, 7)
    start = [0.0, 0.0, 0.1, 0.2, 0.1, 0.0 if torques is GAIT else 1.5, 0.4, 0.25]
    start[7] = 0.833 if torques is GAIT else 0.1
    expected = by_dop853(partial(board_rates, **params), start, times)
    u0 = dict(zip(("xi", "psidot", "phidot"), start[5:], strict=True))
    motion = move("snakeboard", params, start[:5], u0, times)
    close(np.column_stack([motion.q, motion.u[:, :3]]), expected)
    momentum = BOARD["J_r"] * (motion.rate("theta") + motion.rate("psi"))
    if torques is GAIT:
        assert np.hypot(*(motion.q[-1, :2] - motion.q[0, :2])) > 1.0  # by internal torques alone
        assert np.ptp(momentum) > 0.1
    else:
        close(momentum, np.full(7, momentum[0]))
        close(motion.energy, np.full(7, motion.energy[0]))
