"""Motions of the benchmark `first-result`: as a user declares them, and as equations by hand.

The equations by hand are written for JAX on scalars for few coordinates and on arrays for many.
For heyoka they are expressions.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._problems import explicit_equations
from bench._problems.explicit_equations import Functions, Numbers
from bench._problems.scenes import links
from systems import cart_pendulum, double_pendulum, quadcopter, rotating_body_on_frame
from systems import simple_pendulum as pendulum_on_string
from systems.catalogue import Entry

Law = Callable[[Functions, Mapping[str, Any], Any, Numbers], list[Any]]  # (f, p, t, y) -> dy/dt


class Beginning(NamedTuple):
    """A system, a start and a span of 2 s or less.

    Attributes:
        rates: the explicit equations on scalars; None if these would not be written by hand.
        field: dy/dt on arrays, if one would write arrays for JAX by hand.
        turning: function of (q, v) that gives the part of y after the coordinates; None: v.
    """

    system: jl.System
    params: Mapping[str, Any]
    q0: np.ndarray
    v0: np.ndarray
    t1: float
    rates: Law | None = None
    field: Callable[[Any, Array, Any], Array] | None = None
    turning: Callable[[Any, Any], Any] | None = None

    def start(self) -> np.ndarray:
        """y at t = 0."""
        w0 = self.v0 if self.turning is None else self.turning(self.q0, self.v0)
        return np.concatenate([self.q0, np.asarray(w0)])

    def by_hand(self) -> Callable[[Any, Array, Any], Array]:
        """dy/dt for diffrax."""
        if self.field is not None:
            return self.field
        rates, functions = self.rates, explicit_equations.functions(jnp)
        assert rates is not None
        return lambda t, y, p: jnp.stack(rates(functions, p, t, list(y)))


def _timeless(rates: explicit_equations.Rates) -> Law:
    return lambda f, p, t, y: rates(f, p, y)


def _of(entry: Entry, rates: Law, turning: Callable | None = None) -> Beginning:
    example = entry.example
    q0, v0 = np.array(example.q0, float), np.array(example.v0, float)
    span = min(example.duration, 2.0)
    return Beginning(entry.system, example.params, q0, v0, span, rates, turning=turning)


def simple_pendulum(f: Functions, p: Mapping[str, Any], t: Any, y: Numbers) -> list[Any]:
    """y: the angle from the downward vertical, its rate."""
    return [y[1], -(p["g"] / p["h1"]) * f.sin(y[0])]


def on_cart(f: Functions, p: Mapping[str, Any], t: Any, y: Numbers) -> list[Any]:
    """y: position of the cart, angle of the rod from the downward vertical, their rates."""
    half, end_force = 0.5 * p["l"], f.sin(p["Omega"] * t) * p["F2"]
    x, theta, x_rate, w = y
    s, c = f.sin(theta), f.cos(theta)
    M11, M12, M22 = p["m1"] + p["m2"], p["m2"] * half * c, p["m2"] * half * p["l"] / 1.5
    drive = p["F0"] * f.cos(p["Omega"] * t) + end_force
    r1 = drive + p["m2"] * half * s * w * w - p["k"] * x - p["b"] * x_rate
    r2 = end_force * p["l"] * c - p["m2"] * p["g"] * half * s
    det = M11 * M22 - M12 * M12
    return [x_rate, w, (M22 * r1 - M12 * r2) / det, (M11 * r2 - M12 * r1) / det]


def hovering(f: Functions, p: Mapping[str, Any], t: Any, y: Numbers) -> list[Any]:
    """y: position, yaw, pitch, roll; velocity, angular velocity in body axes."""
    _, _, _, psi, theta, phi, *V, w1, w2, w3 = y
    f1, f2, f3, f4 = (p["k"] * p[name] * p[name] for name in ("w1", "w2", "w3", "w4"))
    h = p["Im"] * (p["w2"] + p["w4"] - p["w1"] - p["w3"])
    drag = p["b"] / p["k"] * (f1 - f2 + f3 - f4)
    lift = (f1 + f2 + f3 + f4) / p["m"]
    s, c = f.sin, f.cos
    s1, c1, s2, c2, s3, c3 = s(psi), c(psi), s(theta), c(theta), s(phi), c(phi)
    yaw_rate = (s3 * w2 + c3 * w3) / c2
    x, y_, z = p["Ix"], p["Iy"], p["Iz"]
    return [
        *V,
        yaw_rate,
        c3 * w2 - s3 * w3,
        w1 + s2 * yaw_rate,
        lift * (c1 * s2 * c3 + s1 * s3),
        lift * (s1 * s2 * c3 - c1 * s3),
        lift * (c2 * c3) - p["g"],
        ((f2 - f4) * p["l"] - w2 * h + (y_ - z) * (w2 * w3)) / x,
        ((f3 - f1) * p["l"] + w1 * h + (z - x) * (w3 * w1)) / y_,
        (drag + (x - y_) * (w1 * w2)) / z,
    ]


def _body_rates(q: Any, v: Any) -> Any:
    return jnp.concatenate([v[:3], jl.rotation.yaw_pitch_roll.body_rates(q[3:], v[3:])])


def on_frame(f: Functions, p: Mapping[str, Any], t: Any, y: Numbers) -> list[Any]:
    """y: angles of the frame and of the body on it, their rates; Euler's equations projected."""
    M, c = p["M"], (p["xb"], p["yb"], p["zb"])
    squares = [x * x for x in c]
    I1 = p["A"] + M * (squares[1] + squares[2])
    I2 = p["B"] + M * (squares[0] + squares[2])
    I3 = p["C"] + M * (squares[0] + squares[1])
    I12, I13, I23 = (-M * c[i] * c[j] for i, j in ((0, 1), (0, 2), (1, 2)))

    def moment(w: Numbers) -> list[Any]:
        return [
            I1 * w[0] + I12 * w[1] + I13 * w[2],
            I12 * w[0] + I2 * w[1] + I23 * w[2],
            I13 * w[0] + I23 * w[1] + I3 * w[2],
        ]

    _, phi, psi_dot, spin = y
    tilt = p["theta"] + 0.0 * phi  # an expression, not a number
    s, k, s_phi, c_phi = f.sin(tilt), f.cos(tilt), f.sin(phi), f.cos(phi)
    axis = (s * s_phi, s * c_phi, k)
    w = (psi_dot * axis[0], psi_dot * axis[1], spin + psi_dot * k)
    h, swung = moment(w), moment((psi_dot * spin * axis[1], -psi_dot * spin * axis[0], 0.0 * spin))
    b = [
        swung[0] + w[1] * h[2] - w[2] * h[1],
        swung[1] + w[2] * h[0] - w[0] * h[2],
        swung[2] + w[0] * h[1] - w[1] * h[0],
    ]
    about = moment(axis)
    M11 = axis[0] * about[0] + axis[1] * about[1] + axis[2] * about[2]
    M12, M22 = about[2], I3
    r1 = p["tau"] - (axis[0] * b[0] + axis[1] * b[1] + axis[2] * b[2])
    r2 = -M * p["g"] * s * (c[0] * c_phi - c[1] * s_phi) - b[2]
    det = M11 * M22 - M12 * M12
    return [psi_dot, spin, (M22 * r1 - M12 * r2) / det, (M11 * r2 - M12 * r1) / det]


def chain_on_arrays(n: int) -> Callable[[Any, Array, Any], Array]:
    """dy/dt of `bench._problems.scenes.links(n)`, written by hand for JAX."""
    later = np.maximum.outer(np.arange(n), np.arange(n))

    def field(t: Any, y: Array, p: Any) -> Array:
        q, v = y[:n], y[n:]
        carried = jnp.cumsum(p["m"][::-1])[::-1]
        A = jnp.outer(p["l"], p["l"]) * carried[later]
        between = q[:, None] - q[None, :]
        gravity = carried * p["g"] * p["l"] * jnp.sin(q)
        a = jnp.linalg.solve(A * jnp.cos(between), -(A * jnp.sin(between)) @ v**2 - gravity)
        return jnp.concatenate([v, a])

    return field


def _chain(n: int) -> Beginning:
    scene = links(n)
    system = jl.System(scene.lagrangian, [f"q{i}" for i in range(n)])
    q0, v0, rates = np.array(scene.q0), np.zeros(n), _timeless(explicit_equations.chain)
    return Beginning(system, scene.params, q0, v0, 1.0, rates, chain_on_arrays(n))


BODIES, AXES = 5, 3
PAIRS = [(i, j) for i in range(BODIES) for j in range(i)]


def attraction(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L of bodies that attract each other."""
    r, v = q.reshape(BODIES, AXES), v.reshape(BODIES, AXES)
    first, second = np.array(PAIRS).T
    distances = jnp.sqrt(jnp.sum((r[first] - r[second]) ** 2, axis=1))
    T = 0.5 * p["m"] @ jnp.sum(v**2, axis=1)
    return T + p["gamma"] * jnp.sum(p["m"][first] * p["m"][second] / distances)


def _bodies_on_arrays(t: Any, y: Array, p: Any) -> Array:
    r = y[: BODIES * AXES].reshape(BODIES, AXES)
    d = r[None] - r[:, None]
    square = jnp.sum(d**2, axis=2) + jnp.eye(BODIES)
    a = p["gamma"] * jnp.sum((p["m"] / (square * jnp.sqrt(square)))[:, :, None] * d, axis=1)
    return jnp.concatenate([y[BODIES * AXES :], a.reshape(-1)])


def bodies(f: Functions, p: Mapping[str, Any], t: Any, y: Numbers) -> list[Any]:
    """y: positions of the bodies one after the other, then their velocities."""
    half = BODIES * AXES
    a: list[Any] = [0.0] * half
    for i, j in PAIRS:
        d = [y[AXES * j + k] - y[AXES * i + k] for k in range(AXES)]
        factor = p["gamma"] * f.over_cube(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        for k in range(AXES):
            a[AXES * i + k] = a[AXES * i + k] + p["m"][j] * (factor * d[k])
            a[AXES * j + k] = a[AXES * j + k] - p["m"][i] * (factor * d[k])
    return [*y[half:], *a]


def _bodies() -> Beginning:
    rng = np.random.default_rng(1)
    q0 = 2.0 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0.5], [0, -1, -0.5]])
    system = jl.System(attraction, [f"{x}{i}" for i in range(BODIES) for x in "xyz"])
    params = {"m": np.array([1.0, 0.2, 0.3, 0.1, 0.2]), "gamma": 1.0}
    v0 = 0.3 * rng.normal(size=q0.size)
    return Beginning(system, params, q0.ravel(), v0, 2.0, bodies, _bodies_on_arrays)


def learned(q: Array, p: Any) -> Array:
    """V(q) of a network with two hidden layers."""
    hidden = jnp.tanh(p["W1"] @ q + p["b1"])
    return p["w3"] @ jnp.tanh(p["W2"] @ hidden + p["b2"])


def _network() -> Beginning:
    n, width, rng = 4, 16, np.random.default_rng(2)
    params = {
        "W1": rng.normal(size=(width, n)) / np.sqrt(n),
        "b1": rng.normal(size=width),
        "W2": rng.normal(size=(width, width)) / np.sqrt(width),
        "b2": rng.normal(size=width),
        "w3": rng.normal(size=width),
        "m": np.array([1.0, 0.5, 0.8, 1.2]),
    }

    def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Array:
        return 0.5 * p["m"] @ v**2 - learned(q, p)

    def field(t: Any, y: Array, p: Any) -> Array:
        return jnp.concatenate([y[n:], -jax.grad(learned)(y[:n], p) / p["m"]])

    system = jl.System(lagrangian, [f"q{i}" for i in range(n)])
    q0, v0 = np.linspace(-0.5, 0.5, n), np.linspace(0.3, -0.3, n)
    return Beginning(system, params, q0, v0, 2.0, None, field)


BEGINNINGS: dict[str, Callable[[], Beginning]] = {
    "simple pendulum": lambda: _of(pendulum_on_string.entry, simple_pendulum),
    "double pendulum": lambda: _of(
        double_pendulum.entry, _timeless(explicit_equations.double_pendulum)
    ),
    "cart pendulum": lambda: _of(cart_pendulum.entry, on_cart),
    "quadcopter": lambda: _of(quadcopter.entry, hovering, _body_rates),
    "rotating body": lambda: _of(rotating_body_on_frame.entry, on_frame),
    "chain of 8": lambda: _chain(8),
    "chain of 12": lambda: _chain(12),
    "5 bodies": _bodies,
    "network potential": _network,
}
