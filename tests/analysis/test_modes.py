"""Natural modes against closed forms, with their derivatives; tables and figures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

EPS = np.finfo(float).eps
G = 9.81
N = 20


def double_pendulum():
    """Two equal point masses on massless rods; angles of both rods to the vertical."""

    def lagrangian(t, q, v, p):
        m, length = p["m"], p["l"]
        turn = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
        return m * length**2 * turn + m * G * length * (2.0 * jnp.cos(q[0]) + jnp.cos(q[1]))

    return jl.System(lagrangian, ("theta1", "theta2"))


def cart():
    """A free cart with a damped pendulum; the cart's position is cyclic."""

    def lagrangian(t, q, v, p):
        turn = 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[1]) + G * jnp.cos(q[1])
        return 0.5 * (1.0 + p["m"]) * v[0] ** 2 + turn

    friction = jl.Rayleigh(lambda t, q, v, p: 0.5 * p["c"] * v[1] ** 2, "friction")
    return jl.System(lagrangian, ("x", "theta"), forces=[friction])


def linear_of(A, mass=None):
    """Linearized equations of two coordinates x, y with this matrix."""
    k = len(A)
    names = ("x", "y")[: k // 2]
    zero = jnp.zeros((k, 0))
    return jl.Linearization(
        jnp.array(A),
        zero,
        zero.T,
        jnp.zeros((0, 0)),
        jnp.zeros(k),
        jnp.zeros(0),
        jnp.eye(k),
        jnp.eye(k // 2) if mass is None else jnp.array(mass),
        None,
        (*names, *(f"{x}'" for x in names)),
        (),
        (),
        names,
        tuple((x, ()) for x in (*names, *(f"{x}'" for x in names))),
    )


def second_order(M, C, K):
    """A of M x'' + C x' + K x = 0."""
    n = len(M)
    return np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]]
    )


@pytest.fixture(scope="module")
def pendulums():
    """(params, modes) of the double pendulum at rest."""
    params = {"m": 0.7, "l": 0.4}
    return params, jl.modes(jl.linearize(double_pendulum(), [0.0, 0.0], [0.0, 0.0], params))


def test_double_pendulum(pendulums):
    """Frequencies sqrt((2 -+ sqrt 2) g / l), theta2 = +-sqrt 2 theta1."""
    params, modes = pendulums
    w = np.sqrt((2.0 + np.sqrt(2.0) * np.array([-1, -1, 1, 1])) * G / params["l"])
    np.testing.assert_allclose(modes.angular_frequencies, w, rtol=20 * EPS)
    np.testing.assert_allclose(modes.natural_frequencies, w, rtol=20 * EPS)
    np.testing.assert_allclose(modes.frequencies, w / (2 * np.pi), rtol=20 * EPS)
    np.testing.assert_allclose(modes.eigenvalues, 1j * w * [1, -1, 1, -1], atol=50 * EPS * w[-1])
    np.testing.assert_allclose(modes.damping_ratios, 0.0, atol=50 * EPS)
    ratio = modes.shapes["theta2"] / modes.shapes["theta1"]
    np.testing.assert_allclose(ratio, np.sqrt(2.0) * np.array([1, 1, -1, -1]), rtol=50 * EPS)
    rates = modes.shapes["theta1'"] / modes.shapes["theta1"]
    np.testing.assert_allclose(rates, modes.eigenvalues, atol=50 * EPS * w[-1])
    assert not modes.stable
    assert not modes.unstable
    assert np.all(modes.simple)


def test_shapes_are_orthonormal_by_the_mass_matrix(pendulums):
    params, modes = pendulums
    M = params["m"] * params["l"] ** 2 * np.array([[2.0, 1.0], [1.0, 1.0]])
    np.testing.assert_allclose(modes.linear.mass, M, rtol=10 * EPS)
    shapes = modes.mass_normalized_shapes
    u = np.stack([shapes["theta1"], shapes["theta2"]])[:, ::2]
    np.testing.assert_allclose(u.conj().T @ M @ u, np.eye(2), atol=50 * EPS)
    assert np.max(np.abs(np.imag(u))) < 50 * EPS * np.max(np.abs(u))
    expected = np.kron(np.eye(2), np.ones((2, 2)))
    np.testing.assert_allclose(modes.mac(modes), expected, atol=100 * EPS)


def test_participation_sums_to_one(pendulums):
    """Over states and over modes; half of an undamped mode is in the velocities."""
    _, modes = pendulums
    factors = modes.participation
    np.testing.assert_allclose(np.sum(factors, 0), 1.0, atol=50 * EPS)
    np.testing.assert_allclose(np.sum(factors, 1), 1.0, atol=50 * EPS)
    np.testing.assert_allclose(np.sum(factors[:2], 0), 0.5, atol=50 * EPS)


def test_sensitivity_of_frequencies_to_the_length(pendulums):
    """d omega / dl = -omega / (2 l), forward and reverse."""
    params, modes = pendulums
    at = jnp.zeros(2)

    def frequencies(length):
        linear = jl.linearize(double_pendulum(), at, at, params | {"l": length})
        return jl.modes(linear).angular_frequencies

    expected = -modes.angular_frequencies / (2 * params["l"])
    for mode in (jax.jacfwd, jax.jacrev):
        found = jax.jit(mode(frequencies))(params["l"])
        np.testing.assert_allclose(found, expected, rtol=100 * EPS)


@pytest.mark.full
def test_chain_of_masses():
    """omega_j = 2 sqrt(k / m) sin(j pi / (2 (n + 1))), shapes sin(i j pi / (n + 1))."""

    def lagrangian(t, q, v, p):
        ends = jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)])
        return 0.5 * p["m"] * v @ v - 0.5 * p["k"] * jnp.sum(jnp.diff(ends) ** 2)

    system = jl.System(lagrangian, {"x": (N,)})
    params, zero = {"m": 0.3, "k": 50.0}, jnp.zeros(N)
    modes = jl.modes(jl.linearize(system, zero, zero, params))
    j = np.arange(1, N + 1)
    w = 2.0 * np.sqrt(params["k"] / params["m"]) * np.sin(j * np.pi / (2 * (N + 1)))
    np.testing.assert_allclose(modes.angular_frequencies[::2], w, rtol=1e-13)  # measured 2e-14
    exact = np.sin(np.outer(j, j) * np.pi / (N + 1)) * np.sqrt(2 / (N + 1) / params["m"])
    found = np.asarray(modes.mass_normalized_shapes["x"][::2])
    assert found.shape == (N, N)
    signs = np.sign(np.sum(np.real(found) * exact, axis=1))
    np.testing.assert_allclose(found, signs[:, None] * exact, atol=1e-12)  # measured 2e-14
    assert "and 16 more" in str(modes)


def test_damped_and_gyroscopic_modes_are_complex():
    """lambda^2 + 2 zeta w lambda + w^2; a particle in a rotating frame moves in circles."""
    zeta, w, gyro = 0.1, 3.0, 4.0
    modes = jl.modes(linear_of([[0.0, 1.0], [-(w**2), -2 * zeta * w]]))
    np.testing.assert_allclose(modes.damping_ratios, zeta, rtol=10 * EPS)
    np.testing.assert_allclose(modes.natural_frequencies, w, rtol=10 * EPS)
    damped = w * np.sqrt(1 - zeta**2)
    np.testing.assert_allclose(modes.angular_frequencies, damped, rtol=10 * EPS)
    assert modes.stable
    turning = second_order(np.eye(2), gyro * np.array([[0.0, -1], [1, 0]]), w**2 * np.eye(2))
    modes = jl.modes(linear_of(turning))
    root = np.sqrt(gyro**2 / 4 + w**2)
    expected = root + gyro / 2 * np.array([-1, -1, 1, 1])
    np.testing.assert_allclose(modes.angular_frequencies, expected, rtol=50 * EPS)
    phase = np.angle(modes.shapes["y"] / modes.shapes["x"], deg=True)
    np.testing.assert_allclose(phase, [-90, 90, 90, -90], atol=1e-11)
    assert "at -90 deg" in str(modes)
    np.testing.assert_allclose(modes.mac(modes)[0], [1, 0, 0, 1], atol=50 * EPS)


@pytest.mark.full
def test_amplitudes_of_dropped_coordinates():
    """As without drop; x drifts in the rigid mode. Derivatives of the others stay finite."""
    system, params, at = cart(), {"m": 1.5, "c": 0.2}, jnp.zeros(2)

    def found(c, drop):
        linear = jl.linearize(system, at, at, params | {"c": c}, drop=drop)
        return jl.modes(linear)

    kept, dropped = (found(0.2, drop) for drop in ((), ("x",)))
    assert not np.any(kept.simple[:2])
    np.testing.assert_allclose(dropped.eigenvalues[1:], kept.eigenvalues[2:], rtol=50 * EPS)
    np.testing.assert_allclose(dropped.deviations[:, 1:], kept.deviations[:, 2:], atol=50 * EPS)
    assert np.isnan(dropped.shapes["x"][0])
    assert dropped.shapes["x'"][0] == 1.0
    assert "x drifts" in str(dropped)
    np.testing.assert_allclose(dropped.mac(dropped)[1:, 1:], 1.0, atol=50 * EPS)
    assert np.all(np.isnan(dropped.mac(dropped)[0]))
    assert np.all(np.isnan(dropped.mass_normalized_shapes["theta"][:1]))

    def numbers(c):
        modes = found(c, ("x",))
        scaled = modes.mass_normalized_shapes["x'"][1]
        alike = modes.mac(dropped)[1, 1]
        own = jnp.abs(modes.participation[0, 1])
        return jnp.stack([jnp.real(modes.shapes["x'"][1]), jnp.imag(scaled), own, alike])

    one, other = (jax.jit(mode(numbers))(0.3) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(one, other, atol=1e-13)
    of, h = jax.jit(numbers), 1e-5
    np.testing.assert_allclose(one, (of(0.3 + h) - of(0.3 - h)) / (2 * h), atol=1e-9)
    assert np.all(np.abs(one[:3]) > 1e-4)


def test_stability_is_decided_beyond_rounding():
    """Eigenvalues of 0, in a basis where they are rounding, are neither stable nor unstable."""
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    for real, stable, unstable in ((0.0, False, False), (-1e-6, True, False), (1e-6, False, True)):
        A = basis @ np.diag([real, -1.0, -200.0, -3.0]) @ basis.T
        modes = jl.modes(linear_of(A))
        assert (bool(modes.stable), bool(modes.unstable)) == (stable, unstable)
    assert jl.modes(linear_of([[0.0, 1.0], [-1.0, -2.0]])).stable  # critical damping, defective
    assert str(jl.modes(linear_of([[0.0, 1.0], [1.0, 0.0]]))).endswith("Unstable.")


def test_conjugate_ones_of_repeated_pairs_are_adjacent():
    """Two equal oscillators, and a double pair of size 2."""
    modes = jl.modes(linear_of(second_order(np.eye(2), np.zeros((2, 2)), 4.0 * np.eye(2))))
    np.testing.assert_allclose(modes.eigenvalues, [2j, -2j, 2j, -2j], atol=20 * EPS)
    assert not np.any(modes.simple)
    lines = str(modes).splitlines()
    assert [line[:4] for line in lines[1:3]] == ["1, 2", "3, 4"]
    assert all(line.endswith("(repeated)") for line in lines[1:3])


def test_modes_of_two_states_in_which_the_coordinate_is_at_rest():
    """Two coupled states drive x by their difference: in the mode of their sum it does not move."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 - 2.0 * q[0] ** 2,
        ("x",),
        forces=[jl.GeneralizedForce(lambda t, q, v, p, u: u["z"] - u["y"] + 0.0 * q, "drive")],
        states=jl.States(
            lambda t, q, v, x, p, u: jnp.stack([0.7 * x[1] - 3.0 * x[0], 0.7 * x[0] - 3.0 * x[1]]),
            ("z", "y"),
        ),
    )
    modes = jl.modes(jl.linearize(system, [0.0], [0.0], inputs={"z": 0.0, "y": 0.0}))
    np.testing.assert_allclose(modes.eigenvalues[2:], [-2.3, -3.7], atol=50 * EPS)
    assert modes.shapes["x"][2] == 0.0
    np.testing.assert_allclose(modes.shapes["y"][2], modes.shapes["z"][2], rtol=50 * EPS)
    assert np.isnan(modes.mass_normalized_shapes["x"][2])
    assert str(modes).splitlines()[2].endswith("z 1, y 1")
    assert str(modes).splitlines()[3].endswith("x 1")


def test_dropped_coordinates_that_are_not_driven_do_not_drift():
    """Two carts with friction: in the rigid mode of y, x stays."""
    friction = jl.Rayleigh(lambda t, q, v, p: 0.5 * (v[0] ** 2 + 2.0 * v[1] ** 2), "friction")
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), forces=[friction])
    modes = jl.modes(jl.linearize(system, [0.0, 0.0], [0.0, 0.0], drop=("x",)))
    np.testing.assert_allclose(modes.eigenvalues, [0.0, -1.0, -2.0], atol=20 * EPS)
    np.testing.assert_allclose(modes.shapes["x"], [0.0, 1.0, 0.0], atol=20 * EPS)
    np.testing.assert_allclose(modes.shapes["y"], [1.0, 0.0, 1.0], atol=20 * EPS)


@pytest.mark.full
def test_participation_beside_repeated_eigenvalues():
    """The rigid mode is kept: derivatives in both modes."""

    def factor(c):
        at = jnp.zeros(2)
        modes = jl.modes(jl.linearize(cart(), at, at, {"m": 1.5, "c": c}))
        return jnp.abs(modes.participation[1, 2])

    one, other = (jax.jit(mode(factor))(0.3) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(one, other, rtol=100 * EPS)
    assert abs(one) > 1e-3


def test_modes_of_states_without_motion():
    """A controller's integrator alone: shapes by its name, no mass-normalized ones."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 - 2.0 * q[0] ** 2,
        ("x",),
        states=jl.States(lambda t, q, v, x, p, u: -3.0 * x + 0.0 * q, ("z",)),
    )
    linear = jl.linearize(system, [0.0], [0.0], inputs={"z": 0.0})
    modes = jl.modes(linear)
    np.testing.assert_allclose(modes.eigenvalues, [2j, -2j, -3], atol=20 * EPS)
    np.testing.assert_allclose(modes.shapes["z"], [0, 0, 1], atol=20 * EPS)
    assert np.isnan(modes.mass_normalized_shapes["x"][2])
    assert np.isfinite(modes.mass_normalized_shapes["x"][0])
    assert str(modes).splitlines()[2].endswith("z 1")


@pytest.mark.full
def test_batches_are_root_loci():
    """One call for all points; every one as alone."""
    system, at = cart(), jnp.zeros(2)

    def found(c):
        return jl.modes(jl.linearize(system, at, at, {"m": 1.5, "c": c}, drop=("x",)))

    cs = jnp.linspace(0.1, 1.0, 4)
    batch = jax.jit(jax.vmap(found))(cs)
    assert (len(batch), batch.stable.shape, batch.shapes["theta"].shape) == (4, (4,), (4, 3))
    alone = found(cs[2])
    np.testing.assert_allclose(batch[2].eigenvalues, alone.eigenvalues, atol=50 * EPS)
    np.testing.assert_allclose(jl.modes(batch.linear).eigenvalues, batch.eigenvalues, atol=1e-14)
    assert batch.mac(batch).shape == (4, 3, 3)
    assert batch.participation.shape == (4, 3, 3)
    assert str(batch) == "3 modes of each of a batch of shape (4,)"
    (axes,) = batch.plot().axes
    assert axes.collections[0].get_offsets().shape == (12, 2)


def test_table():
    """Conjugate pairs on one line, rounding as 0."""
    A = second_order(np.diag([1.0, 4.0]), np.diag([0.0, 8.0]), np.diag([2.0, 3.0]))
    assert str(jl.modes(linear_of(A, np.diag([1.0, 4.0])))).splitlines() == [
        "mode  eigenvalue  rad/s  Hz      damping ratio  shape",
        "1     -0.5                                      y 1",
        "2, 3  0 ± 1.414i  1.414  0.2251  0              x 1",
        "4     -1.5                                      y 1",
        "Neither stable nor unstable.",
    ]
    twice = str(jl.modes(linear_of(second_order(np.eye(2), np.zeros((2, 2)), np.eye(2)))))
    assert twice.count("(repeated)") == 2
    assert str(jl.modes(linear_of(np.full((2, 2), np.nan)))).endswith("The eigenvalues are NaN.")


def test_figure_of_shapes(pendulums):
    """The plane of eigenvalues and one compass per pair."""
    _, modes = pendulums
    plane, *compasses = modes.plot().axes
    assert plane.get_xlabel() == "Re eigenvalue in 1/s"
    assert [ax.get_title() for ax in compasses] == ["0 ± 3.79i", "0 ± 9.151i"]
    angles = sorted(abs(float(line.get_xdata()[1])) for line in compasses[1].lines)
    np.testing.assert_allclose(angles, [0.0, np.pi], atol=1e-12)


def test_refusals(pendulums):
    _, modes = pendulums
    with pytest.raises(ValueError, match=r"`linear` must be linearized equations, but it was of "):
        jl.modes(cart())
    with pytest.raises(ValueError, match=r"`other` must be modes, but it was 3"):
        modes.mac(3)
    other = jl.modes(linear_of([[0.0, 1.0], [-1.0, 0.0]]))
    with pytest.raises(ValueError, match=r"must have the coordinates \['theta1', 'theta2'\]"):
        modes.mac(other)
    with pytest.raises(ValueError, match=r"must belong to a batch"):
        modes[0]
    with pytest.raises(ValueError, match=r"`plot` is not supported: numbers are traced"):
        jax.jit(lambda modes: modes.plot())(modes)
    assert jax.jit(lambda modes: jnp.array(len(str(modes))))(modes) == len("4 modes, traced")
    with pytest.raises(KeyError, match="theta3"):
        modes.shapes["theta3"]
    at = [0.0, 0.0]
    names = "x", "theta", "x'", "theta'"
    with pytest.raises(ValueError, match=r"must have states"):
        jl.modes(jl.linearize(cart(), at, at, {"m": 1.5, "c": 0.2}, drop=names))
