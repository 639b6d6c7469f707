"""Rotations: matrices, rates and parametrizations, against the book's tables, scipy and jvp.

Entries of R are at most 1 and take some three roundings, so that identities of one or two of their
products hold to some 10 EPS. A comment at each bound gives the worst error of the samples.
"""

import re

import jax
import numpy as np
import pytest
from _rotations import (
    ALL,
    ANGLES,
    COUNT,
    EPS,
    LOCK,
    anywhere,
    batch,
    crosses,
    cube,
    every,
    every_angles,
    principal,
    worst,
)
from scipy.spatial.transform import Rotation

from jaxlag import rotation
from jaxlag.rotation import quaternion, yaw_pitch_roll, zxz

# ---- Matrices ----------------------------------------------------------------------------------


def test_elementary_rotations_follow_the_right_hand_rule():
    """Right-hand rule: about x from y to z, about y from z to x, about z from x to y."""
    x, y, z = np.eye(3)
    for rotate, axis, start, end in (
        (rotation.about_x, x, y, z),
        (rotation.about_y, y, z, x),
        (rotation.about_z, z, x, y),
    ):
        R = np.asarray(rotate(0.3))
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


def test_yaw_pitch_roll_equals_the_matrix_of_the_book():
    for x in anywhere("yaw_pitch_roll", np.random.default_rng(0), 20):
        T = rotation.direction_cosines(yaw_pitch_roll.matrix(x))
        assert worst(T, book_direction_cosines(*x)) <= 4 * EPS  # worst 0


def test_angles_are_successive_elementary_rotations():
    """Intrinsic rotations multiply from left to right; the order matters."""

    def differences(x):
        a, b, c = x
        rotations = rotation.about_x, rotation.about_y, rotation.about_z
        X, Y, Z = ([rotate(angle) for angle in (a, b, c)] for rotate in rotations)
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
    # scipy halves and composes angles of 10 rad: its rounding is some EPS larger.
    assert worst(batch(ALL[kind].matrix, x), theirs.as_matrix()) <= 8 * EPS  # worst 2.5


@every
def test_each_direction_cosine_is_its_cofactor(kind):
    """The book's nine identities, which imply T T^T = E and det T = 1."""
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


def test_skew_rotates_with_its_vector():
    rng = np.random.default_rng(6)
    a, R = rng.normal(size=(COUNT, 3)), batch(zxz.matrix, anywhere("zxz", rng))
    turned = R @ crosses(a) @ R.transpose(0, 2, 1)
    assert worst(turned, crosses(np.einsum("nij,nj->ni", R, a))) <= 12 * EPS  # worst 4, |a| <= 4


# ---- Rates -------------------------------------------------------------------------------------


@every
def test_rates_give_the_derivative_of_the_matrix(kind):
    """dR/dt = R [w_body]x = [w_space]x R by jvp along x + t x_dot; w_space = R w_body."""
    rng = np.random.default_rng(7)
    x, p = anywhere(kind, rng), ALL[kind]
    size = np.linalg.norm(x, axis=1)[:, None] if kind == "quaternion" else 1.0
    x_dot = rng.normal(size=x.shape) * size  # so that w is about 1 to 10 rad/s

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


def test_rates_of_yaw_pitch_roll_equal_those_of_the_book():
    """M, its inverse and det M = cos(theta), printed for (phi, theta, psi): the reverse order."""
    for x in principal("yaw_pitch_roll", np.random.default_rng(8), 20):
        sT, sF, cT, cF = np.sin(x[1]), np.sin(x[2]), np.cos(x[1]), np.cos(x[2])
        M = np.array([[1, 0, -sT], [0, cF, sF * cT], [0, -sF, cF * cT]])
        M_inverse = np.array([[1, sF * sT / cT, cF * sT / cT], [0, cF, -sF], [0, sF / cT, cF / cT]])
        W = np.asarray(yaw_pitch_roll.body_rate_matrix(x))
        columns = [yaw_pitch_roll.from_body_rates(x, w) for w in np.eye(3)]
        assert worst(W, M[:, ::-1]) <= 2 * EPS
        assert worst(np.stack(columns, 1), M_inverse[::-1]) <= 2 * EPS / cT  # worst 0.4
        assert abs(np.linalg.det(W[:, ::-1]) - cT) <= 4 * EPS


def test_determinants_of_the_rate_matrices_equal_closed_forms():
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
def test_rates_are_invertible(kind, frame):
    """The part of a quaternion's x_dot along x is no rotation, and is omitted."""
    rng = np.random.default_rng(10)
    p, x = ALL[kind], principal(kind, rng)
    x_dot, w = rng.normal(size=x.shape), rng.normal(size=(COUNT, 3))
    rates, invert = getattr(p, f"{frame}_rates"), getattr(p, f"from_{frame}_rates")
    x_dot_again = batch(lambda x, x_dot: invert(x, rates(x, x_dot)), x, x_dot)
    w_again = batch(lambda x, w: rates(x, invert(x, w)), x, w)
    if kind == "quaternion":
        radial = np.sum(x * x_dot, axis=1)[:, None] * x
        assert worst(np.sum(x * x_dot_again, axis=1), 0) <= 5 * EPS  # worst 1.5
        x_dot = x_dot - radial
    # Some roundings of |x_dot|, |w| <= 5, times 1/|det W| <= 5 at 0.2 rad from lock.
    assert worst(x_dot_again, x_dot) <= 25 * EPS  # worst 8
    assert worst(w_again, w) <= 25 * EPS  # worst 8


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
        # A change of norm alone is no rotation: terms of |e||e_dot|/(e.e) = 1 cancel.
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
def test_from_matrix_inverts_matrix_in_the_principal_ranges(kind):
    x = principal(kind, np.random.default_rng(13))
    found = batch(lambda x: ALL[kind].from_matrix(ALL[kind].matrix(x)), x)
    # Angles are ratios of entries of at least sin(0.2), and are at most pi.
    assert worst(found, x) <= 5 * EPS  # worst 1
    if kind == "quaternion":  # every component was the largest one for some
        assert set(np.argmax(np.abs(x), axis=1)) == {0, 1, 2, 3}


@every
def test_from_matrix_reproduces_any_rotation(kind):
    """Several revolutions, and the 24 rotations of a cube: with gimbal lock, or with e0 = 0."""
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


def test_quaternions_of_half_turns_are_accurate():
    """All four branches by value; at 1e-9 rad from a half turn no digits cancel."""
    for i, e in enumerate(np.eye(4)):
        R = -np.eye(3) if i else np.eye(3)
        R[max(i - 1, 0), max(i - 1, 0)] = 1.0
        np.testing.assert_array_equal(quaternion.from_matrix(R), e)
        near = e + 1e-9 * np.array([1.0, -2.0, 3.0, 0.5])
        near /= np.linalg.norm(near)
        found = quaternion.from_matrix(quaternion.matrix(near))
        assert worst(found, near) <= 4 * EPS  # worst 0


# ---- Errors ------------------------------------------------------------------------------------

E = np.eye(3)
WRONG = {
    "`a` must have shape (3,), but its shape was (4,).": lambda: rotation.skew(np.ones(4)),
    "`S` must have shape (3, 3), but its shape was (3,).": lambda: rotation.unskew(np.ones(3)),
    "`angle` must have shape (), but its shape was (2,). Use jax.vmap": lambda: rotation.about_x(
        np.ones(2)
    ),
    "`rotations` must hold at least one matrix, but none was given.": lambda: rotation.compose(),
    "`rotations[1]` must have shape (3, 3), but its shape was (2, 2).": lambda: rotation.compose(
        E, np.eye(2)
    ),
    "`R` must have shape (3, 3), but its shape was (3, 2).": lambda: rotation.direction_cosines(
        E[:, :2]
    ),
    "`R_dot` must have shape (3, 3), but its shape was (3,).": lambda: rotation.body_rates(E, E[0]),
    "`R` must have shape (3, 3), but its shape was (5, 3, 3). Use jax.vmap": (
        lambda: rotation.space_rates(np.ones((5, 3, 3)), E)
    ),
    "`x` must have shape (3,), but its shape was (4,).": lambda: zxz.matrix(np.ones(4)),
    "`x` must have shape (4,), but its shape was (3,).": lambda: quaternion.space_rates(E[0], E[0]),
    "`x_dot` must have shape (4,), but its shape was (3,).": lambda: quaternion.body_rates(
        np.ones(4), E[0]
    ),
    "`w` must have shape (3,), but its shape was (4,).": lambda: quaternion.from_space_rates(
        np.ones(4), np.ones(4)
    ),
    "`R` must have shape (3, 3), but its shape was (4, 4).": lambda: quaternion.from_matrix(
        np.eye(4)
    ),
    "`b` must have shape (4,), but its shape was (3,).": lambda: quaternion.multiply(
        np.ones(4), np.ones(3)
    ),
    "`a` must have shape (4,), but its shape was ().": lambda: quaternion.conjugate(1.0),
    "`x` must be real numbers, but it was 'yaw'.": lambda: yaw_pitch_roll.matrix("yaw"),
    "`x` must be real, but its dtype was complex128.": lambda: yaw_pitch_roll.body_rate_matrix(
        np.ones(3) * 1j
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_errors_name_the_argument(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        WRONG[message]()
