"""Rotations: matrices, rates and parametrisations, against the book's tables, scipy and jvp.

Entries of R are at most 1 and take some three roundings, so identities of one or two products of
them hold to some 10 EPS; the worst found over the samples is written beside each bound.
"""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from scipy.spatial.transform import Rotation

from jaxlag import rotation
from jaxlag.rotation import quaternion, yaw_pitch_roll, zxz

EPS = np.finfo(float).eps
ALL = {"yaw_pitch_roll": yaw_pitch_roll, "zxz": zxz, "quaternion": quaternion}
ANGLES = {name: ALL[name] for name in ("yaw_pitch_roll", "zxz")}
LOCK = {"yaw_pitch_roll": np.cos, "zxz": np.sin}  # |det W|
COUNT = 500

every = pytest.mark.parametrize("kind", ALL)
every_angles = pytest.mark.parametrize("kind", ANGLES)


def anywhere(kind, rng, count=COUNT):
    """Coordinates of any size: angles of several turns, quaternions of norms 0.1 to 10."""
    if kind != "quaternion":
        return rng.uniform(-10.0, 10.0, (count, 3))
    x = rng.normal(size=(count, 4))
    return x / np.linalg.norm(x, axis=1)[:, None] * 10 ** rng.uniform(-1.0, 1.0, (count, 1))


def principal(kind, rng, count=COUNT):
    """Coordinates in their principal ranges, 0.2 rad or more from gimbal lock."""
    if kind == "quaternion":
        x = rng.normal(size=(count, 4))
        x /= np.linalg.norm(x, axis=1)[:, None]
        return x * np.where(x[:, :1] < 0, -1, 1)
    x = rng.uniform(-np.pi, np.pi, (count, 3))
    low, high = (0.2, np.pi - 0.2) if kind == "zxz" else (0.2 - np.pi / 2, np.pi / 2 - 0.2)
    x[:, 1] = rng.uniform(low, high, count)
    return x


def batch(function, *arguments):
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(function))(*arguments))


def worst(found, expected):
    return float(np.max(np.abs(np.asarray(found) - np.asarray(expected))))


def crosses(a):
    return batch(rotation.skew, a)


def cube():
    """The 24 proper rotations that take axes to axes; half and quarter turns among them."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(order)] * np.array(signs)
            if np.linalg.det(R) > 0:
                yield R


# ---- Matrices ----------------------------------------------------------------------------------


def test_elementary_rotations_turn_the_axes_the_right_way():
    """Right-hand rule: about x it is y to z, about y it is z to x, about z it is x to y."""
    x, y, z = np.eye(3)
    for turn, axis, start, end in (
        (rotation.about_x, x, y, z),
        (rotation.about_y, y, z, x),
        (rotation.about_z, z, x, y),
    ):
        R = np.asarray(turn(0.3))
        np.testing.assert_array_equal(R @ axis, axis)
        found = R @ start
        np.testing.assert_allclose(found, np.cos(0.3) * start + np.sin(0.3) * end, atol=EPS)
        np.testing.assert_allclose(R @ end, np.cos(0.3) * end - np.sin(0.3) * start, atol=EPS)


def book_direction_cosines(psi, theta, phi):
    """T_B/I as printed."""
    sP, sT, sF = np.sin([psi, theta, phi])
    cP, cT, cF = np.cos([psi, theta, phi])
    return np.array(
        [
            [cT * cP, cT * sP, -sT],
            [sF * sT * cP - cF * sP, sF * sT * sP + cF * cP, sF * cT],
            [cF * sT * cP + sF * sP, cF * sT * sP - sF * cP, cF * cT],
        ]
    )


def test_yaw_pitch_roll_is_the_matrix_of_the_book():
    for x in anywhere("yaw_pitch_roll", np.random.default_rng(0), 20):
        T = rotation.direction_cosines(yaw_pitch_roll.matrix(x))
        assert worst(T, book_direction_cosines(*x)) <= 4 * EPS  # worst 0


def test_angles_are_successive_elementary_rotations():
    """Intrinsic, so left to right; the order matters."""

    def differences(x):
        a, b, c = x
        turns = rotation.about_x, rotation.about_y, rotation.about_z
        X, Y, Z = ([turn(angle) for angle in (a, b, c)] for turn in turns)
        return (
            yaw_pitch_roll.matrix(x) - rotation.compose(Z[0], Y[1], X[2]),
            zxz.matrix(x) - rotation.compose(Z[0], X[1], Z[2]),
            yaw_pitch_roll.matrix(x) - rotation.compose(X[2], Y[1], Z[0]),
        )

    right_1, right_2, wrong = batch(differences, anywhere("zxz", np.random.default_rng(1)))
    assert worst(right_1, 0) <= 2 * EPS  # worst 0.5
    assert worst(right_2, 0) <= 2 * EPS  # worst 0.5
    assert np.median(np.max(np.abs(wrong), axis=(1, 2))) > 0.5


def test_compose_multiplies_left_to_right():
    A, B, C = (zxz.matrix(x) for x in anywhere("zxz", np.random.default_rng(2), 3))
    np.testing.assert_array_equal(rotation.compose(A), A)
    assert (
        worst(rotation.compose(A, B, C), np.asarray(A) @ np.asarray(B) @ np.asarray(C)) <= 8 * EPS
    )
    assert worst(rotation.compose(A, B), rotation.compose(B, A)) > 0.1


@every
def test_matrices_agree_with_scipy(kind):
    x = anywhere(kind, np.random.default_rng(3))
    theirs = {
        "yaw_pitch_roll": lambda: Rotation.from_euler("ZYX", x),
        "zxz": lambda: Rotation.from_euler("ZXZ", x),
        "quaternion": lambda: Rotation.from_quat(x[:, [1, 2, 3, 0]]),
    }[kind]()
    # Angles of 10 rad are halved and composed by scipy: some EPS more than ours.
    assert worst(batch(ALL[kind].matrix, x), theirs.as_matrix()) <= 8 * EPS  # worst 2.5


@every
def test_each_direction_cosine_is_its_cofactor(kind):
    """The book's nine identities, and with them T T^T = E and det T = 1."""
    x = anywhere(kind, np.random.default_rng(4))
    T = batch(lambda x: rotation.direction_cosines(ALL[kind].matrix(x)), x)
    a = {f"{i + 1}{j + 1}": T[:, i, j] for i in range(3) for j in range(3)}
    cofactors = {
        "11": a["22"] * a["33"] - a["23"] * a["32"],
        "12": a["23"] * a["31"] - a["33"] * a["21"],
        "13": a["21"] * a["32"] - a["31"] * a["22"],
        "21": a["32"] * a["13"] - a["12"] * a["33"],
        "22": a["33"] * a["11"] - a["13"] * a["31"],
        "23": a["31"] * a["12"] - a["11"] * a["32"],
        "31": a["12"] * a["23"] - a["22"] * a["13"],
        "32": a["13"] * a["21"] - a["11"] * a["23"],
        "33": a["11"] * a["22"] - a["12"] * a["21"],
    }
    for entry, cofactor in cofactors.items():
        assert worst(a[entry], cofactor) <= 10 * EPS, entry  # worst 1.5
    assert worst(T @ T.transpose(0, 2, 1), np.eye(3)) <= 10 * EPS  # worst 3
    assert worst(np.linalg.det(T), 1.0) <= 10 * EPS  # worst 4


def test_skew_is_the_cross_product():
    a, b = np.random.default_rng(5).normal(size=(2, COUNT, 3))
    S = crosses(a)
    # The same two products and one subtraction, in another order: |a||b| <= 25.
    assert worst(np.einsum("nij,nj->ni", S, b), np.cross(a, b)) <= 25 * EPS  # worst 0
    np.testing.assert_array_equal(S, -S.transpose(0, 2, 1))
    np.testing.assert_array_equal(batch(rotation.unskew, S), a)
    symmetric = np.einsum("ni,nj->nij", b, b)
    assert worst(batch(rotation.unskew, S + symmetric), a) <= 8 * EPS  # worst 2, from S + b b^T
    bracket = S @ crosses(b) - crosses(b) @ S  # Jacobi's identity
    assert worst(bracket, crosses(np.cross(a, b))) <= 25 * EPS  # worst 0


def test_skew_turns_with_its_vector():
    rng = np.random.default_rng(6)
    a, R = rng.normal(size=(COUNT, 3)), batch(zxz.matrix, anywhere("zxz", rng))
    turned = R @ crosses(a) @ R.transpose(0, 2, 1)
    assert worst(turned, crosses(np.einsum("nij,nj->ni", R, a))) <= 12 * EPS  # worst 4, |a| <= 4


# ---- Rates -------------------------------------------------------------------------------------


@every
def test_the_matrix_moves_with_the_rates(kind):
    """dR/dt = R [w_body]x = [w_space]x R by jvp along x + t x_dot; w_space = R w_body."""
    rng = np.random.default_rng(7)
    x, p = anywhere(kind, rng), ALL[kind]
    size = np.linalg.norm(x, axis=1)[:, None] if kind == "quaternion" else 1.0
    x_dot = rng.normal(size=x.shape) * size  # so that w is some 1 to 10 rad/s

    def all_rates(x, x_dot):
        R, R_dot = jax.jvp(p.matrix, (x,), (x_dot,))
        by_matrix = rotation.body_rates(R, R_dot), rotation.space_rates(R, R_dot)
        return R, R_dot, p.body_rates(x, x_dot), p.space_rates(x, x_dot), *by_matrix

    R, R_dot, w, w_space, w_too, w_space_too = batch(all_rates, x, x_dot)
    largest = float(np.max(np.abs(w)))
    atol = 5 * EPS * largest  # worst 2.3
    assert largest > 3
    assert worst(R_dot, R @ crosses(w)) <= atol
    assert worst(R_dot, crosses(w_space) @ R) <= atol
    assert worst(w_space, np.einsum("nij,nj->ni", R, w)) <= atol
    assert worst(w_too, w) <= atol
    assert worst(w_space_too, w_space) <= atol


def test_rates_of_yaw_pitch_roll_are_those_of_the_book():
    """M, its inverse and det M = cos(theta), printed for (phi, theta, psi): our order reversed."""
    for x in principal("yaw_pitch_roll", np.random.default_rng(8), 20):
        sT, sF, cT, cF = np.sin(x[1]), np.sin(x[2]), np.cos(x[1]), np.cos(x[2])
        M = np.array([[1, 0, -sT], [0, cF, sF * cT], [0, -sF, cF * cT]])
        M_inverse = np.array([[1, sF * sT / cT, cF * sT / cT], [0, cF, -sF], [0, sF / cT, cF / cT]])
        W = np.asarray(yaw_pitch_roll.body_rate_matrix(x))
        columns = [yaw_pitch_roll.from_body_rates(x, w) for w in np.eye(3)]
        assert worst(W, M[:, ::-1]) <= 2 * EPS
        assert worst(np.stack(columns, 1), M_inverse[::-1]) <= 2 * EPS / cT  # worst 0.4
        assert abs(np.linalg.det(W[:, ::-1]) - cT) <= 4 * EPS


def test_determinants_of_the_rate_matrices():
    """-cos(theta) and -sin(theta); W W^T = 4 E/(e.e) for the quaternion."""
    rng = np.random.default_rng(9)
    for kind, expected in LOCK.items():
        x = anywhere(kind, rng)
        det = np.linalg.det(batch(ANGLES[kind].body_rate_matrix, x))
        assert worst(det, -expected(x[:, 1])) <= 4 * EPS  # worst 1
    e = anywhere("quaternion", rng)
    W = batch(quaternion.body_rate_matrix, e) * np.linalg.norm(e, axis=1)[:, None, None]
    assert worst(W @ W.transpose(0, 2, 1), 4 * np.eye(3)) <= 40 * EPS  # worst 12


@every
@pytest.mark.parametrize("frame", ["body", "space"])
def test_rates_can_be_undone(kind, frame):
    """Of a quaternion's x_dot the part along x is no rotation, and is left out."""
    rng = np.random.default_rng(10)
    p, x = ALL[kind], principal(kind, rng)
    x_dot, w = rng.normal(size=x.shape), rng.normal(size=(COUNT, 3))
    rates, undo = getattr(p, f"{frame}_rates"), getattr(p, f"from_{frame}_rates")
    there = batch(lambda x, x_dot: undo(x, rates(x, x_dot)), x, x_dot)
    back = batch(lambda x, w: rates(x, undo(x, w)), x, w)
    if kind == "quaternion":
        along = np.sum(x * x_dot, axis=1)[:, None] * x
        assert worst(np.sum(x * there, axis=1), 0) <= 5 * EPS  # worst 1.5
        x_dot = x_dot - along
    # Some roundings of |x_dot|, |w| <= 5, times 1/|det W| <= 5 at 0.2 rad from lock.
    assert worst(there, x_dot) <= 25 * EPS  # worst 8
    assert worst(back, w) <= 25 * EPS  # worst 8


def test_a_scaled_quaternion_is_the_same_rotation():
    """Powers of two scale exactly, negative ones included; e and e_dot scale alike."""
    rng = np.random.default_rng(11)
    for e, e_dot in zip(anywhere("quaternion", rng, 5), rng.normal(size=(5, 4)), strict=True):
        for scale in (-1.0, 0.25, -16.0):
            same = {
                "matrix": lambda k, e=e: quaternion.matrix(k * e),
                "w": lambda k, e=e, e_dot=e_dot: quaternion.body_rates(k * e, k * e_dot),
                "e_dot": lambda k, e=e: quaternion.from_body_rates(k * e, e[1:]) / k,
            }
            for name, function in same.items():
                np.testing.assert_array_equal(function(scale), function(1.0), name)
        # A change of norm alone turns nothing: cancellation of terms |e||e_dot|/(e.e) = 1.
        assert worst(quaternion.body_rates(e, e), 0) <= 2 * EPS  # worst 0.5


def test_quaternion_products_are_matrix_products():
    rng = np.random.default_rng(12)
    a, b = anywhere("quaternion", rng), anywhere("quaternion", rng)
    A, B = batch(quaternion.matrix, a), batch(quaternion.matrix, b)
    product = batch(lambda a, b: quaternion.matrix(quaternion.multiply(a, b)), a, b)
    assert worst(product, A @ B) <= 10 * EPS  # worst 3.5
    inverse = batch(lambda a: quaternion.matrix(quaternion.conjugate(a)), a)
    np.testing.assert_array_equal(inverse, A.transpose(0, 2, 1))
    i, j, k = np.eye(4)[1:]
    np.testing.assert_array_equal(quaternion.multiply(i, j), k)
    np.testing.assert_array_equal(quaternion.multiply(j, i), -k)
    ones = batch(lambda a: quaternion.multiply(a, quaternion.conjugate(a)), a)
    squares = np.sum(a * a, axis=1)
    assert worst(ones / squares[:, None], np.eye(4)[0]) <= 4 * EPS  # worst 1


# ---- Coordinates from matrices -----------------------------------------------------------------


@every
def test_from_matrix_undoes_matrix_in_the_principal_ranges(kind):
    x = principal(kind, np.random.default_rng(13))
    found = batch(lambda x: ALL[kind].from_matrix(ALL[kind].matrix(x)), x)
    # Angles are ratios of entries of size sin(0.2) or more, and at most pi themselves.
    assert worst(found, x) <= 5 * EPS  # worst 1
    if kind == "quaternion":  # every component was the largest one for some
        assert set(np.argmax(np.abs(x), axis=1)) == {0, 1, 2, 3}


@every
def test_from_matrix_reproduces_any_rotation(kind):
    """Several turns away, and the 24 turns of a cube, where angles are locked and e0 may be 0."""
    p, any_R = ALL[kind], batch(zxz.matrix, anywhere("zxz", np.random.default_rng(14)))
    R = np.concatenate([any_R, np.stack(list(cube()))])
    x, again = batch(lambda R: (p.from_matrix(R), p.matrix(p.from_matrix(R))), R)
    assert worst(again, R) <= 8 * EPS  # worst 1.8
    if kind == "quaternion":
        assert worst(np.linalg.norm(x, axis=1), 1) <= 4 * EPS  # worst 1
        assert np.all(x[:, 0] >= 0)
    else:
        low, high = (0, np.pi) if kind == "zxz" else (-np.pi / 2, np.pi / 2)
        assert np.all((x[:, 1] >= low) & (x[:, 1] <= high))
        assert np.all(np.abs(x) <= np.pi)


@every_angles
def test_from_matrix_reproduces_rotations_near_gimbal_lock(kind):
    """From 0.1 rad down to the lock itself, also with rounding of R that fits no angles."""
    p, rng = ANGLES[kind], np.random.default_rng(15)
    locks = (0.0, np.pi) if kind == "zxz" else (np.pi / 2, -np.pi / 2)
    distances = (0.0, *10.0 ** np.arange(-20.0, 0.0))
    theta = np.repeat([lock + d for lock in locks for d in distances], 20)
    x = rng.uniform(-np.pi, np.pi, (len(theta), 3))
    x[:, 1] = theta
    R = batch(p.matrix, x)
    noisy = R + EPS * rng.uniform(-1, 1, R.shape)
    given = np.concatenate([R, noisy])
    again = batch(lambda R: p.matrix(p.from_matrix(R)), given)
    assert worst(again, given) <= 8 * EPS  # worst 2.8


def test_at_exact_gimbal_lock_the_first_angle_is_zero():
    for R in cube():
        psi, theta, _ = yaw_pitch_roll.from_matrix(R)
        locked = R[0, 0] == R[1, 0] == 0
        assert bool(abs(theta) == np.pi / 2) == locked
        assert not locked or psi == 0
        phi, theta, _ = zxz.from_matrix(R)
        locked = R[0, 2] == R[1, 2] == 0
        assert (float(theta) in (0, np.pi)) == locked
        assert not locked or phi == 0
    np.testing.assert_array_equal(zxz.from_matrix(np.eye(3)), np.zeros(3))


def test_quaternions_of_half_turns():
    """All four branches by value; at 1e-9 rad from a half turn nothing is lost to cancellation."""
    for i, e in enumerate(np.eye(4)):
        R = -np.eye(3) if i else np.eye(3)
        R[max(i - 1, 0), max(i - 1, 0)] = 1.0
        np.testing.assert_array_equal(quaternion.from_matrix(R), e)
        near = e + 1e-9 * np.array([1.0, -2.0, 3.0, 0.5])
        near /= np.linalg.norm(near)
        found = quaternion.from_matrix(quaternion.matrix(near))
        assert worst(found, near) <= 4 * EPS  # worst 0


# ---- Gimbal lock -------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("frame", ["body", "space"])
@every_angles
def test_at_gimbal_lock_two_rates_are_not_finite(kind, frame, dtype):
    """Also at the representable angles nearest to it, and for the w of some finite x_dot."""
    p, rng = ANGLES[kind], np.random.default_rng(16)
    lock = np.pi * np.arange(-4, 5) + (np.pi / 2 if kind == "yaw_pitch_roll" else 0.0)
    x = rng.uniform(-np.pi, np.pi, (len(lock), 3)).astype(dtype)
    x[:, 1] = lock
    x_dot, w = rng.normal(size=(2, *x.shape)).astype(dtype)
    reachable = batch(getattr(p, f"{frame}_rates"), x, x_dot)
    undo = getattr(p, f"from_{frame}_rates")
    for rates in (reachable, w, np.zeros_like(w)):
        found = batch(undo, x, rates)
        assert found.dtype == dtype
        assert not np.any(np.isfinite(found[:, [0, 2]]))
    theta_dot = batch(undo, x, reachable)[:, 1]
    assert worst(theta_dot, x_dot[:, 1]) <= 12 * np.finfo(dtype).eps  # worst 3, |w| <= 6
    slope = batch(jax.jacfwd(undo), x, reachable)[:, [0, 2], 1]
    assert not np.any(np.isfinite(slope))


@every_angles
def test_near_gimbal_lock_the_error_grows_as_its_inverse_distance(kind):
    p, rng = ANGLES[kind], np.random.default_rng(17)
    lock = np.pi / 2 if kind == "yaw_pitch_roll" else 0.0
    theta = lock - np.repeat(10.0 ** np.arange(-1.0, -15.0, -1.0), 50)
    x = rng.uniform(-np.pi, np.pi, (len(theta), 3))
    x[:, 1] = theta
    x_dot = rng.normal(size=x.shape)

    def there(x, x_dot):
        return (
            p.from_body_rates(x, p.body_rates(x, x_dot)),
            p.from_space_rates(x, p.space_rates(x, x_dot)),
        )

    determinant = np.abs(LOCK[kind](theta))[:, None]
    for found in batch(there, x, x_dot):
        # Each w is |x_dot| <= 8 times some roundings, divided by the determinant.
        assert worst((found - x_dot) * determinant, 0) <= 8 * EPS  # worst 2.3


def test_the_smallest_nutation_is_not_taken_for_lock():
    """sin(theta) = theta is exact there, whatever its size."""
    found = zxz.from_body_rates([0.0, 1e-200, 0.0], [0.5, 3e-200, 0.0])
    np.testing.assert_allclose(found, [3.0, 0.5, -3.0], rtol=4 * EPS)


@every_angles
def test_from_matrix_has_no_derivative_at_gimbal_lock(kind):
    """NaN in the first and last angle along any rotation, by forward and reverse mode."""
    R = jnp.eye(3) if kind == "zxz" else jnp.eye(3)[jnp.array([1, 2, 0])]
    from_matrix = ANGLES[kind].from_matrix
    for w in np.eye(3):
        R_dot = R @ rotation.skew(w)
        for jacobian in (jax.jacfwd, jax.jacrev):
            moved = jnp.sum(jacobian(from_matrix)(R) * R_dot, axis=(1, 2))
            assert np.all(np.isnan(moved[jnp.array([0, 2])]))


@pytest.mark.parametrize(("dtype", "powers"), [(np.float64, (-565, 565)), (np.float32, (-77, 90))])
def test_quaternions_of_extreme_norms_are_rotations(dtype, powers):
    """Squares of 2^-565 and 2^565 under- and overflow; R and its derivatives in e/s do not."""
    e, e_dot = (np.random.default_rng(23).normal(size=(2, 4))).astype(dtype)

    def rates(x, x_dot):
        moved = jax.jvp(quaternion.matrix, (x,), (x_dot,))[1]
        return quaternion.matrix(x), quaternion.body_rates(x, x_dot), moved

    expected = rates(e, e_dot)
    for power in powers:
        scale = dtype(2.0) ** dtype(power)
        for found, right in zip(rates(scale * e, scale * e_dot), expected, strict=True):
            np.testing.assert_array_equal(found, right)


def test_the_scale_of_a_quaternion_has_no_part_in_its_derivatives():
    """To second order, forward and reverse, against R written out with sums of squares."""

    def plain(x):
        a, b, c, d = x
        first = jnp.stack([a * a + b * b - c * c - d * d, 2 * (b * c + a * d), 2 * (b * d - a * c)])
        return first / (x @ x)

    def ours(x):
        return quaternion.matrix(x)[:, 0]

    x = jnp.array([0.7, -1.3, 0.2, 0.9])
    for order in range(3):
        found, expected = jax.jit(lambda x, f=ours, g=plain: (f(x), g(x)))(x)
        np.testing.assert_allclose(found, expected, atol=32 * EPS * np.max(np.abs(expected)))
        ours, plain = (jax.jacfwd if order else jax.jacrev)(ours), jax.jacfwd(plain)


def test_the_zero_quaternion_is_no_rotation():
    assert np.all(np.isnan(quaternion.matrix(np.zeros(4))))
    assert np.all(np.isnan(quaternion.body_rates(np.zeros(4), np.ones(4))))


# ---- Derivatives, batches, precision -----------------------------------------------------------


def functions(p):
    """Of x alone; x_dot and w are fixed, coordinates from matrices go along rotations."""

    def x_dot(x):
        return jnp.array([0.3, -0.8, 0.5, 1.1], x.dtype)[: len(p.names)]

    def w(x):
        return jnp.array([0.7, -0.2, 0.4], x.dtype)

    return {
        "matrix": p.matrix,
        "body_rates": lambda x: p.body_rates(x, x_dot(x)),
        "space_rates": lambda x: p.space_rates(x, x_dot(x)),
        "body_rate_matrix": p.body_rate_matrix,
        "from_body_rates": lambda x: p.from_body_rates(x, w(x)),
        "from_space_rates": lambda x: p.from_space_rates(x, w(x)),
        "from_matrix": lambda x: p.from_matrix(p.matrix(x)),
    }


@every
@pytest.mark.parametrize("name", mostly_full(functions(zxz), "from_matrix", "from_space_rates"))
def test_derivatives_agree_with_central_differences(kind, name):
    p, h = ALL[kind], 1e-5
    function = functions(p)[name]
    x = principal(kind, np.random.default_rng(18), 20)
    forward, reverse = batch(lambda x: (jax.jacfwd(function)(x), jax.jacrev(function)(x)), x)
    steps = h * np.concatenate([np.eye(x.shape[1]), -np.eye(x.shape[1])])
    ahead, behind = np.split(batch(jax.vmap(function), x + steps[:, None]), 2)
    differences = np.moveaxis(ahead - behind, 0, -1) / (2 * h)
    scale = np.max(np.abs(forward))
    assert worst(forward, reverse) <= 8 * EPS * scale  # worst 3
    # h^2/6 of the third derivative, at most 6/0.2^2 of the first, and EPS/h of the values.
    atol = (h**2 / 0.2**2 + 10 * EPS / h) * scale
    assert worst(forward, differences) <= atol
    assert scale > 0.1


@every
def test_from_matrix_is_differentiable_along_rotations(kind):
    """d/dt from_matrix(R) = from_body_rates(x, w) for R_dot = R [w]x."""
    p, rng = ALL[kind], np.random.default_rng(19)
    x, w = principal(kind, rng), rng.normal(size=(COUNT, 3))

    def moved(x, w):
        R = p.matrix(x)
        return jax.jvp(p.from_matrix, (R,), (R @ rotation.skew(w),))[1]

    assert worst(batch(moved, x, w), batch(p.from_body_rates, x, w)) <= 50 * EPS  # worst 16


def by_parametrisation(p, x, a, b):
    x_dot = p.from_body_rates(x, a)
    rates = x_dot, p.from_space_rates(x, a), p.body_rates(x, x_dot), p.space_rates(x, x_dot)
    return p.matrix(x), p.from_matrix(p.matrix(x)), p.body_rate_matrix(x), rates


def by_matrix(p, x, a, b):
    R = rotation.compose(rotation.about_x(a[0]), rotation.about_y(a[1]), rotation.about_z(a[2]))
    R_dot = R @ rotation.skew(b)
    return (
        rotation.direction_cosines(R),
        rotation.body_rates(R, R_dot),
        rotation.space_rates(R, R_dot),
        rotation.unskew(R),
    )


def by_quaternion(p, x, a, b):
    return p.multiply(x, p.conjugate(jnp.concatenate([a, b[:1]])))


@pytest.mark.parametrize(
    ("kind", "function"),
    [
        *((kind, by_parametrisation) for kind in ALL),
        ("zxz", by_matrix),
        ("quaternion", by_quaternion),
    ],
)
def test_single_precision_stays_single(kind, function):
    p, rng = ALL[kind], np.random.default_rng(20)
    x = principal(kind, rng, 50).astype(np.float32)
    a, b = rng.normal(size=(2, 50, 3)).astype(np.float32)
    single = batch(lambda *given: function(p, *given), x, a, b)
    double = batch(lambda *given: function(p, *given), *(z.astype(float) for z in (x, a, b)))
    eps = float(np.finfo(np.float32).eps)
    for found, expected in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        assert (found.dtype, expected.dtype) == (np.float32, np.float64)
        # As in double: |a|, |b| <= 5 and 1/|det W| <= 5.
        assert worst(found, expected) <= 25 * eps  # worst 5.5


@every
def test_gradients_in_single_precision_stay_single(kind):
    x = jnp.asarray(principal(kind, np.random.default_rng(21), 1)[0], jnp.float32)
    for function in functions(ALL[kind]).values():
        gradient = jax.eval_shape(jax.grad(lambda x, f=function: jnp.sum(f(x))), x)
        assert gradient.dtype == jnp.float32


def test_numbers_and_lists_are_taken():
    expected = np.asarray(zxz.matrix(np.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(zxz.matrix([1, 2, 3]), expected)
    np.testing.assert_array_equal(zxz.matrix((1.0, 2, 3.0)), expected)
    np.testing.assert_array_equal(rotation.skew([1, 2, 3]), [[0, -3, 2], [3, 0, -1], [-2, 1, 0]])


def test_the_names_are_the_coordinates():
    assert yaw_pitch_roll.names == ("psi", "theta", "phi")
    assert zxz.names == ("phi", "theta", "psi")
    assert quaternion.names == ("e0", "e1", "e2", "e3")


# ---- Errors ------------------------------------------------------------------------------------

E = np.eye(3)
WRONG = {
    "a must have shape (3,), but its shape was (4,).": lambda: rotation.skew(np.ones(4)),
    "S must have shape (3, 3), but its shape was (3,).": lambda: rotation.unskew(np.ones(3)),
    "angle must have shape (), but its shape was (2,). Use jax.vmap": lambda: rotation.about_x(
        np.ones(2)
    ),
    "rotations must hold at least one matrix, but none was given.": lambda: rotation.compose(),
    "rotations[1] must have shape (3, 3), but its shape was (2, 2).": lambda: rotation.compose(
        E, np.eye(2)
    ),
    "R must have shape (3, 3), but its shape was (3, 2).": lambda: rotation.direction_cosines(
        E[:, :2]
    ),
    "R_dot must have shape (3, 3), but its shape was (3,).": lambda: rotation.body_rates(E, E[0]),
    "R must have shape (3, 3), but its shape was (5, 3, 3). Use jax.vmap": (
        lambda: rotation.space_rates(np.ones((5, 3, 3)), E)
    ),
    "x must have shape (3,), but its shape was (4,).": lambda: zxz.matrix(np.ones(4)),
    "x must have shape (4,), but its shape was (3,).": lambda: quaternion.space_rates(E[0], E[0]),
    "x_dot must have shape (4,), but its shape was (3,).": lambda: quaternion.body_rates(
        np.ones(4), E[0]
    ),
    "w must have shape (3,), but its shape was (4,).": lambda: quaternion.from_space_rates(
        np.ones(4), np.ones(4)
    ),
    "R must have shape (3, 3), but its shape was (4, 4).": lambda: quaternion.from_matrix(
        np.eye(4)
    ),
    "b must have shape (4,), but its shape was (3,).": lambda: quaternion.multiply(
        np.ones(4), np.ones(3)
    ),
    "a must have shape (4,), but its shape was ().": lambda: quaternion.conjugate(1.0),
    "x must be real numbers, but it was 'yaw'.": lambda: yaw_pitch_roll.matrix("yaw"),
    "x must be real, but its dtype was complex128.": lambda: yaw_pitch_roll.body_rate_matrix(
        np.ones(3) * 1j
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_errors_name_the_argument(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        WRONG[message]()
