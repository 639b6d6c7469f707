"""Whipple's bicycle, linearized from its bodies, against the published matrices.

Source: Meijaard, Papadopoulos, Ruina, Schwab, Proc. R. Soc. A 463 (2007) 1955, tables 1 and 2.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxlag as jl
from bench.mechanisms._bicycle import BICYCLE
from bench.mechanisms._scenes import SCENES

CYCLIC = ("x", "y", "yaw", "rear", "front")
INDEPENDENT = (*CYCLIC, "lean", "steer", "lean'", "steer'", "rear'")
KEPT = ("lean", "steer", "lean'", "steer'")

M = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
C1 = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])
K0 = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
K2 = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])

WEAVE = (
    3.52696170990070 + 0.80774027519930j,
    2.68234517512745 + 1.68066296590675j,
    1.70675605663975 + 2.31582447384325j,
    0.41325331521125 + 3.07910818603206j,
    -0.77534188219585 + 4.46486771378823j,
    -1.52644486584142 + 5.87673060598709j,
    -2.13875644258362 + 7.19525913329805j,
    -2.69348683581097 + 8.46037971396931j,
    -3.21675402252485 + 9.69377351531791j,
    -3.72016840437287 + 10.90681139476287j,
)
CAPSIZE = (
    -3.13423125066578,
    -3.07158645641514,
    -2.63366137253667,
    -1.42944427361326,
    -0.32286642900409,
    -0.00406690076970,
    0.10268170574766,
    0.14327879765713,
    0.15790184030917,
    0.16105338653172,
)
CASTERING = (
    -7.11008014637441,
    -8.67387984831735,
    -10.35101467245920,
    -12.15861426576447,
    -14.07838969279822,
    -16.08537123098026,
    -18.15788466125262,
    -20.27940894394569,
    -22.43788559040858,
    -24.62459635017404,
)
"""Eigenvalues at 1 to 10 m/s; those of the weave have a conjugate one."""
AT_REST = -5.53094371765393, -3.13164324790656, 3.13164324790656, 5.53094371765393

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def linear_at():
    """Forward speed, trail -> A in the four published states, f0, the linearization."""
    system = SCENES["bicycle"]().system()

    @jax.jit
    def of(speed, trail):
        params = BICYCLE | {"c": trail}
        v = jnp.zeros(8).at[0].set(speed)
        v = v.at[6].set(-speed / params["r_rear"]).at[7].set(-speed / params["r_front"])
        linear = jl.linearize(system, jnp.zeros(8), v, params, independent=INDEPENDENT, drop=CYCLIC)
        at = np.array([linear.states.index(name) for name in KEPT])
        return linear.A[at][:, at], linear.f0, linear

    return of


@pytest.mark.parametrize("speed", [0.0, 1.0, 3.0, 5.0, 7.0, 10.0])
def test_matrices_are_the_published_ones(linear_at, speed):
    A, f0, _ = linear_at(speed, BICYCLE["c"])
    stiffness = -np.linalg.solve(M, 9.81 * K0 + speed**2 * K2)
    expected = np.block(
        [[np.zeros((2, 2)), np.eye(2)], [stiffness, -np.linalg.solve(M, speed * C1)]]
    )
    np.testing.assert_allclose(A, expected, atol=1e-12 * np.max(np.abs(expected)))
    np.testing.assert_allclose(f0, 0.0, atol=1e-12)


def test_eigenvalues_have_the_published_digits(linear_at):
    """At 0 to 10 m/s. Eigenvalues of the published matrices differ by up to 9e-13 from them."""
    rows = zip(WEAVE, np.conj(WEAVE), CAPSIZE, CASTERING, strict=True)
    for speed, expected in enumerate([AT_REST, *rows]):
        found = np.linalg.eigvals(linear_at(float(speed), BICYCLE["c"])[0])
        differences = np.abs(found[:, None] - np.asarray(expected))
        assert np.max(np.min(differences, axis=0)) < 2e-12, speed
        assert len(set(np.argmin(differences, axis=0))) == 4


def test_derivatives_of_the_matrix_with_respect_to_the_trail(linear_at):
    """Reverse and forward derivatives of A at 5 m/s, against central differences."""
    at = 5.0, BICYCLE["c"]
    forward = jax.jacfwd(lambda *x: linear_at(*x)[0], (0, 1))(*at)
    reverse = jax.jacrev(lambda *x: linear_at(*x)[0], (0, 1))(*at)
    for i, (one, other) in enumerate(zip(forward, reverse, strict=True)):
        np.testing.assert_allclose(one, other, atol=1e-10 * np.max(np.abs(one)))
        h = np.eye(2)[i] * 1e-4 * at[i]
        (above, *_), (below, *_) = linear_at(*np.add(at, h)), linear_at(*np.subtract(at, h))
        slope = (above - below) / (2 * h[i])
        np.testing.assert_allclose(one, slope, atol=1e-6 * np.max(np.abs(slope)))


def test_weave_and_capsize_speeds(linear_at):
    """The published 4.292382536341109 and 6.02426201538837 m/s.

    The derivative of the weave speed with respect to the trail is -(dRe/dtrail) / (dRe/dv).
    """
    trail = BICYCLE["c"]

    @jax.jit
    def growth(speed, trail):
        values = jl.modes(linear_at(speed, trail)[2]).eigenvalues
        return jnp.max(jnp.where(jnp.imag(values) > 0, jnp.real(values), -jnp.inf))

    def weave(trail, guess=4.29):
        return brentq(
            lambda speed: float(growth(speed, trail)), guess - 0.1, guess + 0.1, xtol=1e-13
        )

    def determinant(speed):
        return float(np.linalg.det(linear_at(speed, trail)[0]))

    speed = weave(trail)
    assert speed == pytest.approx(4.292382536341109, abs=1e-12)
    assert brentq(determinant, 5.9, 6.1, xtol=1e-13) == pytest.approx(6.02426201538837, abs=1e-12)
    of_speed, of_trail = jax.jit(jax.grad(growth, (0, 1)))(speed, trail)
    h = 1e-4 * trail
    slope = (weave(trail + h) - weave(trail - h)) / (2 * h)
    assert -of_trail / of_speed == pytest.approx(slope, rel=1e-6)
