"""Campbell diagrams of rigid rotors on two bearings, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from tests.analysis._eigenvalues import check_eigenvalues, rounding

EPS = float(np.finfo(float).eps)

ROTOR = {"m": 12.0, "I_t": 0.3, "I_p": 0.45}
SYMMETRIC = ROTOR | {"k1": 4e5, "k2": 4e5, "z1": -0.2, "z2": 0.2}
OVERHUNG = ROTOR | {"k1": 5e5, "k2": 3e5, "z1": -0.35, "z2": -0.1}
SPINS = np.linspace(0.0, 1200.0, 9)


def rotor_lagrangian(t, q, v, p):
    """Rx(a) Ry(b) Rz(spin) of a rigid rotor; z1, z2 are the places of the springs on the axis."""
    a, b = q[2], q[3]
    across = (v[2] * jnp.cos(b)) ** 2 + v[3] ** 2
    along = (v[4] + v[2] * jnp.sin(b)) ** 2
    kinetic = p["m"] * v[:2] @ v[:2] + p["I_t"] * across + p["I_p"] * along
    axis = jnp.stack([jnp.sin(b), -jnp.sin(a) * jnp.cos(b)])
    first, second = q[:2] + p["z1"] * axis, q[:2] + p["z2"] * axis
    return 0.5 * (kinetic - p["k1"] * first @ first - p["k2"] * second @ second)


ROTATING = jl.System(rotor_lagrangian, ("x", "y", "a", "b", "spin"))


def campbell(params):
    """The linearized rotor at every spin."""

    def at(spin):
        v = jnp.zeros(5).at[4].set(spin)
        return jl.linearize(ROTATING, jnp.zeros(5), v, params, drop=("spin",))

    return jax.vmap(at)(jnp.asarray(SPINS))


def test_campbell_diagram_of_a_rotor_on_equal_bearings():
    """Cylindrical modes, and conical modes whose forward whirl rises with the spin.

    Source: Friswell, Penny, Garvey, Lees, Dynamics of Rotating Machines (2010), ch. 3.
    """
    linear, p = campbell(SYMMETRIC), SYMMETRIC
    stiffness = p["k1"] + p["k2"]
    gyroscopic = p["I_p"] * SPINS / (2 * p["I_t"])
    root = np.sqrt(gyroscopic**2 + stiffness * p["z2"] ** 2 / p["I_t"])
    cylindrical = np.full_like(SPINS, np.sqrt(stiffness / p["m"]))
    whirl = np.stack([root + gyroscopic, root - gyroscopic, cylindrical, cylindrical], axis=-1)
    zero = np.zeros((len(SPINS), 1))
    check_eigenvalues(linear, np.concatenate([1j * whirl, -1j * whirl, zero], axis=-1))

    # The end of the axis is at (b, -a). In forward whirl b - i a = c exp(i w t): a = i b.
    A, names = linear.A[5], linear.states
    values, vectors = np.linalg.eig(A)
    for place, sign in ((0, 1.0), (1, -1.0)):
        shape = vectors[:, np.argmin(np.abs(values - 1j * whirl[5, place]))]
        a, b = shape[names.index("a")], shape[names.index("b")]
        assert abs(a / b - sign * 1j) <= rounding(A) / whirl[5, place]  # relative


def test_campbell_diagram_of_an_overhung_rotor():
    """Four whirl frequencies of one complex equation, (x + i y, b - i a) = c exp(i w t).

    (K_T - m w^2) (K_R + I_p Omega w - I_t w^2) = K_C^2, with w < 0 for backward whirl.

    Source: Friswell, Penny, Garvey, Lees, Dynamics of Rotating Machines (2010), ch. 3.
    """
    linear, p = campbell(OVERHUNG), OVERHUNG
    k, z = np.array([p["k1"], p["k2"]]), np.array([p["z1"], p["z2"]])
    expected = []
    for spin in SPINS:
        moving = np.array([-p["m"], 0.0, np.sum(k)])
        leaning = np.array([-p["I_t"], p["I_p"] * spin, k @ z**2])
        quartic = np.polymul(moving, leaning) - np.array([0.0, 0.0, 0.0, 0.0, (k @ z) ** 2])
        whirl = np.roots(quartic)
        assert np.sum(whirl.real > 0) == np.sum(whirl.real < 0) == 2
        expected.append([*(1j * whirl), *(-1j * whirl), 0.0])
    check_eigenvalues(linear, np.array(expected))
