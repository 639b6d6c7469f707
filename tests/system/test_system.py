"""The equations of motion: identities at random states, then Lagrangians with known answers.

Every quantity is a sum of products, each rounded to EPS of its size. Two computations of one number
therefore agree to K EPS times the size of the summands, `size` below; K = 32 roundings.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _consistent import onto_constraints
from _families import mostly_full
from _systems.mechanics import BEAD, GENERAL, RELATIVISTIC, Case, chain
from numpy.linalg import norm

from systems.catalogue import ENTRIES, Entry

K = 32
EPS = np.finfo(float).eps
STATES = 12

BOOK = {
    name: Case(entry.system, dict(entry.example.params), tuple(entry.example.q0))
    for name, entry in ENTRIES.items()
    if isinstance(entry, Entry)
}
CASES = BOOK | GENERAL
CONSTRAINED = {name for name, case in BOOK.items() if case.system.constraints}
PLAIN = (
    *("cart_pendulum", "quadcopter", "falling_stick_friction", "knife_edge_vehicle"),
    *GENERAL,
)
ALL = mostly_full(CASES, *PLAIN)
OF_BOOK = mostly_full(BOOK, *PLAIN)
QUADRATIC = mostly_full([name for name in CASES if name != "relativistic"], *PLAIN)


def random_states(name):
    """(params, t, q, v, x, b) with a leading axis of STATES; x, b: any acceleration and jerk.

    Under constraints (q, v) are projected onto them.
    """
    case = CASES[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    n, speed = len(case.q0), case.largest_speed

    def draw(low, high, *shape):
        return rng.uniform(low, high, (STATES, *shape))

    params = {
        key: np.asarray(value) * draw(0.7, 1.3, *np.shape(value))
        for key, value in case.params.items()
    }
    q = np.asarray(case.q0) + draw(-0.4, 0.4, n)
    v = draw(-speed, speed, n) / np.sqrt(n)
    t, x, b = draw(0.0, 5.0), draw(-5.0, 5.0, n), draw(-9.0, 9.0, n)
    if case.system.constraints:
        move = jax.jit(jax.vmap(partial(onto_constraints, case.system)))
        q, v = map(np.asarray, move(params, t, q, v))
    return params, t, q, v, x, b


def quantities(system, quadratic, params, t, q, v, x, b):
    """All quantities of the identities, at one state."""
    L = partial(system.lagrangian, params=params)
    a = system.acceleration(q, v, params, t=t)

    def energy(t, q, v):
        return system.energy(q, v, params, t=t)

    def curve(s):
        """(t, q, q') on the cubic with velocity v, acceleration x, jerk b at s = 0."""
        return t + s, q + s * v + s**2 * x / 2 + s**3 * b / 6, v + s * x + s**2 * b / 2

    momentum = jax.grad(L, argnums=2)
    _, p_dot = jax.jvp(lambda s: momentum(*curve(s)), (0.0,), (1.0,))
    found = {
        "M": system.mass_matrix(q, v, params, t=t),
        "h": system.bias(q, v, params, t=t),
        "Q": system.generalized_force(q, v, params, t=t),
        "R": system.constraint_force(q, v, params, t=t),
        "p": system.momentum(q, v, params, t=t),
        "H": energy(t, q, v),
        "L": L(t, q, v),
        "a": a,
        "hessian": jax.hessian(L, argnums=2)(t, q, v),
        "H_dot": jax.jvp(energy, (t, q, v), (1.0, v, a))[1],
        "L_t": jax.grad(L)(t, q, v),
        "p_dot": p_dot,
        "L_q": jax.grad(L, argnums=1)(t, q, v),
    }
    if quadratic:
        h = jax.vmap(lambda v: system.bias(q, v, params, t=t))(jnp.stack([-v, 0 * v]))
        found |= {
            "C": system.coriolis_matrix(q, v, params, t=t),
            "M_q": jax.jacfwd(lambda q: system.mass_matrix(q, params=params, t=t))(q),
            "h_back": h[0],
            "h_rest": h[1],
        }
    if system._kinetic is not None:
        found |= {
            "T": system.kinetic(q, v, params, t=t),
            "V": system.potential(q, params=params, t=t),
        }
    return found


class Evaluated(NamedTuple):
    states: tuple
    found: dict

    def __iter__(self):
        """The quantities of one state after another, with t, q, v, x."""
        _, t, q, v, x, _ = self.states
        arrays = self.found | {"t": t, "q": q, "v": v, "x": x}
        for i in range(STATES):
            yield {key: np.asarray(value[i]) for key, value in arrays.items()}


@pytest.fixture(scope="module")
def evaluate(lowering):
    """name -> Evaluated, each system compiled once."""
    known = {}

    def of(name):
        if name not in known:
            function = partial(quantities, CASES[name].system, name != "relativistic")
            states = random_states(name)
            known[name] = Evaluated(states, jax.jit(jax.vmap(function))(*states))
        return known[name]

    return of


def agree(found, expected, *summed):
    """Equal up to K roundings of all summands."""
    size = sum(np.max(norm(np.atleast_1d(x), axis=-1), initial=0.0) for x in summed)
    np.testing.assert_allclose(found, expected, rtol=0, atol=K * EPS * size)


# ---- Identities ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_mass_matrix_is_symmetric_and_positive_definite(name, evaluate):
    for s in evaluate(name):
        agree(s["M"], s["M"].T, s["M"])
        assert np.min(np.linalg.eigvalsh(s["M"])) > K * EPS * norm(s["M"], 2)


@pytest.mark.parametrize("name", ALL)
def test_mass_matrix_is_the_hessian_of_the_lagrangian(name, evaluate):
    for s in evaluate(name):
        agree(s["M"], s["hessian"], s["M"])


@pytest.mark.parametrize("name", ALL)
def test_acceleration_solves_the_equations_of_motion(name, evaluate):
    """M a + h = Q + A^T lam; A^T lam is zero without constraints."""
    for s in evaluate(name):
        # Backward error: the solve is exact for an M that differs by n roundings. h = p' - dL/dq
        # may be small although its two parts are large.
        terms = (norm(s["M"], 2) * s["a"], s["h"], s["Q"], s["R"], s["L_q"])
        agree(s["M"] @ s["a"] + s["h"], s["Q"] + s["R"], *terms)
        assert CASES[name].system.constraints or not np.any(s["R"])


@pytest.mark.parametrize("name", ALL)
def test_mass_and_bias_are_lagranges_equations_along_any_curve(name, evaluate):
    """d/dt dL/dv - dL/dq = M x + h for every acceleration x and any jerk."""
    for s in evaluate(name):
        terms = (norm(s["M"], 2) * s["x"], s["h"], s["p_dot"], s["L_q"])
        agree(s["p_dot"] - s["L_q"], s["M"] @ s["x"] + s["h"], *terms)


@pytest.mark.parametrize("name", ALL)
def test_energy_changes_by_power_and_by_explicit_time(name, evaluate):
    """dH/dt = v . (Q + A^T lam) - dL/dt at fixed q and v, along the motion."""
    for s in evaluate(name):
        power = s["v"] @ (s["Q"] + s["R"])
        forces = (norm(s["M"], 2) * s["a"], s["h"], s["Q"], s["R"], s["L_q"])
        terms = [norm(s["v"]) * x for x in forces]
        agree(s["H_dot"], power - s["L_t"], *terms, s["L_t"])


@pytest.mark.parametrize("name", ALL)
def test_energy_is_the_legendre_transform(name, evaluate):
    for s in evaluate(name):
        agree(s["H"], s["p"] @ s["v"] - s["L"], norm(s["p"]) * s["v"], s["L"])


@pytest.mark.parametrize("name", QUADRATIC)
def test_coriolis_matrix_comes_from_the_christoffel_symbols(name, evaluate):
    for s in evaluate(name):
        D, v = s["M_q"], s["v"]  # D_ijk = dM_ij/dq_k
        along, across = D @ v, np.einsum("ikj,k->ij", D, v)
        agree(s["C"], (along + across - across.T) / 2, along, across, s["M"])


@pytest.mark.parametrize("name", QUADRATIC)
def test_mass_rate_less_twice_coriolis_is_skew(name, evaluate):
    for s in evaluate(name):
        S = s["M_q"] @ s["v"] - 2 * s["C"]
        agree(S, -S.T, s["M_q"] @ s["v"], s["C"], s["M"])


@pytest.mark.parametrize("name", QUADRATIC)
def test_coriolis_force_is_the_quadratic_part_of_the_bias(name, evaluate):
    """Even in v, without its value at rest: [h(v) + h(-v)]/2 - h(0) = C v."""
    for s in evaluate(name):
        even = (s["h"] + s["h_back"]) / 2 - s["h_rest"]
        terms = (s["h"], s["h_back"], s["h_rest"], norm(s["M"], 2) * s["v"] @ s["v"])
        agree(s["C"] @ s["v"], even, *terms)


@pytest.mark.parametrize("name", OF_BOOK)
def test_momentum_is_mass_times_velocity(name, evaluate):
    for s in evaluate(name):
        agree(s["p"], s["M"] @ s["v"], norm(s["M"], 2) * s["v"])


@pytest.mark.parametrize("name", OF_BOOK)
def test_energy_is_the_sum_of_kinetic_and_potential(name, evaluate):
    for s in evaluate(name):
        # V may be a sum that cancels, as in 1 - cos: 1 J represents its terms.
        agree(s["H"], s["T"] + s["V"], norm(s["p"]) * s["v"], s["T"], s["V"], 1.0)
        agree(s["T"], s["v"] @ s["M"] @ s["v"] / 2, norm(s["M"], 2) * s["v"] @ s["v"])


@pytest.mark.parametrize("name", OF_BOOK)
def test_bias_is_mass_rate_times_velocity_less_lagrangian_gradient(name, evaluate):
    """h = M' v - d(T - V)/dq for p = M v and M without time."""
    for s in evaluate(name):
        expected = s["M_q"] @ s["v"] @ s["v"] - s["L_q"]
        agree(s["h"], expected, norm(s["M"], 2) * s["v"] @ s["v"], s["L_q"])


@pytest.mark.full
def test_the_identities_cover_every_system_and_every_kind_of_lagrangian(evaluate):
    """No identity holds only because its terms vanish."""
    large = {
        key: {
            name
            for name in CASES
            if np.max(np.abs(np.asarray(evaluate(name).found.get(key, 0.0)))) > 1e-2
        }
        for key in ("L_t", "C", "Q", "R", "M_q", "h_rest", "L_q")
    }
    assert large["L_t"] == {"driven_pivot", "bead"}
    assert {"double_pendulum", "sleeve_pendulum", "chain", "bead"} <= large["C"] <= large["M_q"]
    assert {"cart_pendulum", "double_pendulum_rayleigh", "mass_spring_dashpot"} <= large["Q"]
    assert large["R"] == CONSTRAINED
    book = set(BOOK)
    # No potential, and an M that is constant or, for the ball, about 0.02 kg m^2.
    free = {"disk_on_shaft", "hockey_puck", "hockey_puck_cord", "rolling_ball_no_spin"}
    without = {name for name in book if not np.any(evaluate(name).found["V"])}
    assert free <= book - large["L_q"] <= without
    assert free <= book - large["h_rest"] <= without
    params, _, _, v, *_ = random_states("charged")
    found = evaluate("charged").found
    assert np.min(norm(found["p"] - params["m"][:, None] * v, axis=1)) > 1e-2  # not M v


# ---- Lagrangians with known answers ----------------------------------------------------------


def test_charge_in_a_magnetic_field_obeys_its_equation(evaluate):
    """m a = e B (v_y, -v_x); p = m v + e A; H = m v^2/2."""
    params, _, q, v, _, _ = random_states("charged")
    found = evaluate("charged").found
    m, e, B = (params[key][:, None] for key in ("m", "e", "B"))
    turned, A = np.stack([v[:, 1], -v[:, 0]], 1), B / 2 * np.stack([-q[:, 1], q[:, 0]], 1)
    np.testing.assert_allclose(found["a"], e * B / m * turned, rtol=K * EPS)
    np.testing.assert_allclose(found["h"], -e * B * turned, rtol=K * EPS)
    agree(found["p"], m * v + e * A, m * v, e * A)
    agree(found["H"], m[:, 0] * np.sum(v**2, 1) / 2, found["L"], norm(found["p"]) * v)
    assert np.max(abs(found["C"])) == 0.0  # gyroscopic terms are not Coriolis terms


def test_pendulum_on_a_driven_pivot_obeys_its_equation(evaluate):
    """l theta'' = -g sin(theta) - x_p'' cos(theta), x_p = X cos(Omega t)."""
    params, t, q, v, _, _ = random_states("driven_pivot")
    found = evaluate("driven_pivot").found
    length, g, X, omega = (params[key] for key in ("l", "g", "X", "Omega"))
    pivot = -X * omega**2 * np.cos(omega * t)
    expected = -(g * np.sin(q[:, 0]) + pivot * np.cos(q[:, 0])) / length
    agree(found["a"][:, 0], expected, g / length, X * omega**2 / length, v**2)


def test_relativistic_particle_obeys_its_equation(evaluate):
    """M = gamma m (1 + gamma^2 v v^T/c^2), gamma m a = F - (v . F) v/c^2, H = gamma m c^2 + V."""
    params, _, q, v, _, _ = random_states("relativistic")
    found = evaluate("relativistic").found
    m, c, g = (params[key][:, None] for key in ("m", "c", "g"))
    gamma = 1 / np.sqrt(1 - np.sum(v**2, 1, keepdims=True) / c**2)
    assert np.max(gamma) > 1.05
    outer = v[:, :, None] * v[:, None, :]
    M = (gamma * m)[:, None] * (np.eye(2) + ((gamma / c) ** 2)[:, None] * outer)
    F = np.concatenate([-m * g, 0 * m], 1)
    a = (F - np.sum(v * F, 1, keepdims=True) * v / c**2) / (gamma * m)
    agree(found["M"], M, M)
    agree(found["p"], gamma * m * v, gamma * m * v)
    agree(found["a"], a, *(np.linalg.cond(M) * norm(g)))
    agree(found["H"], (gamma * m * c**2 + m * g * q[:, :1])[:, 0], m * c**2)
    # On one line, as in textbooks: M = gamma^3 m, a = -g/gamma^3.
    single = {key: value[0] for key, value in params.items()}
    g3 = (1 - (1.5 / single["c"]) ** 2) ** -1.5
    q, v = jnp.zeros(2), jnp.array([1.5, 0.0])
    M = jax.jit(RELATIVISTIC.mass_matrix)(q, v, single)
    a = jax.jit(RELATIVISTIC.acceleration)(q, v, single)
    np.testing.assert_allclose(M[0, 0], g3 * single["m"], rtol=K * EPS)
    np.testing.assert_allclose(a, [-single["g"] / g3, 0.0], rtol=K * EPS)


def test_velocity_must_be_given_if_mass_depends_on_it():
    params = GENERAL["relativistic"].params
    with pytest.raises(
        ValueError,
        match=r"^mass_matrix: `v` must be given, since M depends on the velocities, but it was "
        r"left out\. Call mass_matrix\(q, v, params\)\.$",
    ):
        RELATIVISTIC.mass_matrix([0.0, 0.0], params=params)
    with pytest.raises(
        ValueError,
        match=r"^`coriolis_matrix` of a Lagrangian that is not quadratic .* not supported: its "
        r"mass matrix d2L/dv2 depends on v\. Use bias",
    ):
        RELATIVISTIC.coriolis_matrix([0.0, 0.0], [1.0, 0.0], params)


def test_time_is_read_by_every_method_and_defaults_to_zero():
    params, q, v = GENERAL["bead"].params, jnp.array([0.3]), jnp.array([0.7])
    names = ("mass_matrix", "coriolis_matrix", "momentum", "energy", "bias", "acceleration")

    def values(**t):
        return [jnp.ravel(getattr(BEAD, name)(q, v, params, **t)) for name in names]

    default, zero, later = jax.jit(lambda: (values(), values(t=0.0), values(t=10.0)))()
    np.testing.assert_array_equal(default, zero)
    growth = dict(zip(names, np.divide(later, zero), strict=True))
    for name in names[:4]:
        np.testing.assert_allclose(growth[name], 2.0, rtol=K * EPS)  # all grow as m (1 + t/10)
    assert abs(growth["bias"] - 2) > 0.01  # m' v is constant
    assert abs(growth["acceleration"] - 1) > 0.01


@pytest.mark.full
def test_a_long_chain_hangs_at_rest():
    """n = 12, the library solve: a straight chain at rest stays; M_ij = m l^2 (n - max)."""
    n, params, zero = 12, {"m": 0.4, "l": 0.3, "g": 9.81}, np.zeros(12)
    a, M = jax.jit(
        lambda: (
            chain(n).acceleration(zero, zero, params),
            chain(n).mass_matrix(zero, params=params),
        )
    )()
    np.testing.assert_array_equal(a, zero)
    index = np.arange(n)
    agree(M, 0.4 * 0.3**2 * (n - np.maximum(index[:, None], index)), M)
