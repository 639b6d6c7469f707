"""Systems in quasi-velocities: one with all terms, a body in angles, a sleigh."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from jaxlag import rotation

# ---- Time, an affine part, L of every degree in v ------------------------------------------------


def skewed(t, q, v, params):
    """U with Theta(t, q) and theta_0(t, q)."""
    x, y, z = q
    c, s = jnp.cos(z + 0.3 * t), jnp.sin(z + 0.3 * t)
    return jnp.stack(
        [
            c * v[0] + s * v[1] + 0.2 * jnp.sin(t) * v[2] + 0.4 * y * jnp.cos(t),
            -s * v[0] + c * v[1] - 0.5 * x * t,
            (2.0 + jnp.sin(x * y)) * v[2] + 0.3 * jnp.sin(y) * v[0] + params["w"] * x,
        ]
    )


def in_v(t, q, v, params):
    """L of (t, q, v): M(t, q), terms linear in v, a potential, explicit time."""
    M = jnp.diag(params["m"]) + 0.2 * jnp.outer(jnp.cos(q), jnp.cos(q)) * (1.0 + 0.1 * t)
    return 0.5 * v @ M @ v + jnp.sin(q[0] + t) * v[1] - 0.5 * params["w"] * (q @ q)


def in_u(t, q, u, params):
    """L of (t, q, u), equal to `in_v` for u = U(t, q, v)."""
    theta = jax.jacfwd(lambda v: skewed(t, q, v, params))(jnp.zeros(3))
    theta_0 = skewed(t, q, jnp.zeros(3), params)
    return in_v(t, q, jnp.linalg.solve(theta, u - theta_0), params)


def of_u(t, q, u, params):
    """An L that is short in u."""
    return 0.5 * params["m"] @ u**2 * (2.0 + jnp.sin(q[1])) - q[0] ** 2 + jnp.cos(t) * u[0] * q[2]


def push(t, q, v, params):
    return jnp.stack([0.3 * v[1], jnp.sin(t) - 0.1 * v[0], q[0]])


NAMES = ("a", "b", "c")
PARAMS = {"m": jnp.array([1.0, 1.7, 0.8]), "w": 0.6}
FORCES = (jl.GeneralizedForce(push, "push"),)


def declared(lagrangian, written_in, constrained=(), **options):
    quasi = jl.QuasiVelocities(skewed, NAMES, constrained)
    options = {"forces": FORCES, "quasi": quasi, "written_in": written_in} | options
    return jl.System(lagrangian, ("x", "y", "z"), **options)


def random_states(count=6, seed=3):
    rng = np.random.default_rng(seed)
    return zip(
        rng.uniform(0.0, 2.0, count),
        rng.uniform(-1.0, 1.0, (count, 3)),
        rng.uniform(-1.0, 1.0, (count, 3)),
        strict=True,
    )


# ---- A free body by yaw, pitch, roll -------------------------------------------------------------

I = jnp.array([1.0, 2.0, 2.5])  # noqa: E741


def body_rates(t, q, v, params):
    return rotation.yaw_pitch_roll.body_rates(q, v)


def spinning(t, q, u, params):
    return 0.5 * I @ u**2


def angles(**options):
    quasi = jl.QuasiVelocities(body_rates, ("wx", "wy", "wz"))
    return jl.System(spinning, ("psi", "theta", "phi"), quasi=quasi, written_in="u", **options)


# ---- A sleigh in tall and in square quasi-velocities ---------------------------------------------


def sleigh_rates(t, q, u, params):
    return jnp.stack([jnp.cos(q[2]) * u[0], jnp.sin(q[2]) * u[0], u[1]])


def sideways(t, q, v, params):
    return -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]


def sleigh_rows(t, q, v, params):
    along = jnp.cos(q[2]) * v[0] + jnp.sin(q[2]) * v[1]
    return jnp.stack([along, sideways(t, q, v, params), v[2]])


def sleigh(t, q, v, params):
    """Mass 1.3 at 0.4 ahead of the blade, inertia 0.2."""
    x = v[0] - 0.4 * jnp.sin(q[2]) * v[2]
    y = v[1] + 0.4 * jnp.cos(q[2]) * v[2]
    return 0.5 * 1.3 * (x * x + y * y) + 0.5 * 0.2 * v[2] ** 2


BLADE = jl.Pfaffian(sideways, "v_n")
TALL = jl.QuasiVelocities(kinematics=sleigh_rates, names=("v", "omega"))
SQUARE = jl.QuasiVelocities(sleigh_rows, ("v", "v_n", "omega"), ("v_n",))


def sleighs():
    return (
        jl.System(sleigh, ("x", "y", "theta"), quasi=TALL, constraints=(BLADE,)),
        jl.System(sleigh, ("x", "y", "theta"), quasi=SQUARE),
    )
