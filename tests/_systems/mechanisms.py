"""Mechanisms with constraints and consistent starts that several tests share."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxlag as jl

G = 9.81


class Mechanism(NamedTuple):
    """A constrained system and a consistent start."""

    system: jl.System
    q0: Any
    v0: Any
    params: Any


# ---- Double pendulum of point masses, in Cartesian and in minimal coordinates --------------------


def bobs(t, q, v, params):
    m = jnp.stack([params["m1"], params["m1"], params["m2"], params["m2"]])
    return 0.5 * jnp.sum(m * v**2) - G * (params["m1"] * q[1] + params["m2"] * q[3])


def rods(t, q, params):
    d = q[2:] - q[:2]
    return jnp.stack([q[:2] @ q[:2] - params["l1"] ** 2, d @ d - params["l2"] ** 2])


def angles(t, q, v, params):
    m1, m2, l1, l2 = (params[name] for name in ("m1", "m2", "l1", "l2"))
    both = 2 * l1 * l2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    T = 0.5 * m1 * (l1 * v[0]) ** 2
    T += 0.5 * m2 * ((l1 * v[0]) ** 2 + (l2 * v[1]) ** 2 + both)
    return T + G * ((m1 + m2) * l1 * jnp.cos(q[0]) + m2 * l2 * jnp.cos(q[1]))


BOBS = {"m1": 1.0, "m2": 0.6, "l1": 0.9, "l2": 0.7}
NAMES = ("x1", "y1", "x2", "y2")
cartesian = jl.System(bobs, NAMES, constraints=(jl.Holonomic(rods, ("rod1", "rod2")),))
minimal = jl.System(angles, ("theta1", "theta2"))


def to_cartesian(theta, omega, params=BOBS):
    """(q, v) of the bobs; a chart of all consistent states, differentiable."""
    arms = jnp.stack([params["l1"], params["l2"]])
    out = jnp.stack([arms * jnp.sin(theta), -arms * jnp.cos(theta)], -1)
    rate = jnp.stack([arms * jnp.cos(theta) * omega, arms * jnp.sin(theta) * omega], -1)
    return jnp.cumsum(out, 0).reshape(-1), jnp.cumsum(rate, 0).reshape(-1)


THETA, OMEGA = jnp.array([1.0, 0.5]), jnp.array([0.3, -0.4])


def double_pendulum(system=cartesian):
    return Mechanism(system, *to_cartesian(THETA, OMEGA), BOBS)


# ---- Planar four-bar: crank, coupler, rocker, by their angles, closed by two rows ----------------


def links(t, q, v, params):
    """Uniform slender links a, b, c joined head to tail from the origin; mass 1 kg/m."""
    lengths = jnp.stack([params["a"], params["b"], params["c"]])
    across = jnp.stack([jnp.cos(q), jnp.sin(q)], -1) * lengths[:, None]
    rates = jnp.stack([-jnp.sin(q), jnp.cos(q)], -1) * (lengths * v)[:, None]
    heads = jnp.cumsum(rates, 0)
    centers = heads - 0.5 * rates
    height = jnp.cumsum(across[:, 1]) - 0.5 * across[:, 1]
    T = 0.5 * jnp.sum(lengths * jnp.sum(centers**2, 1)) + jnp.sum(lengths**3 * v**2) / 24
    return T - G * jnp.sum(lengths * height)


def closure(t, q, params):
    """Position of the head of the last link relative to the other pivot (d, 0)."""
    lengths = jnp.stack([params["a"], params["b"], params["c"]])
    return jnp.stack([lengths @ jnp.cos(q) - params["d"], lengths @ jnp.sin(q)])


FOUR_BAR = {"a": 0.4, "b": 1.1, "c": 0.8, "d": 1.0}
four_bar = jl.System(
    links, ("crank", "coupler", "rocker"), constraints=(jl.Holonomic(closure, "pin"),)
)


def four_bar_start(crank=1.0, params=FOUR_BAR):
    """The open configuration for a crank angle, by the law of cosines."""
    a, b, c, d = (params[name] for name in "abcd")
    gap = np.array([d - a * np.cos(crank), -a * np.sin(crank)])
    length = np.hypot(*gap)
    up = np.arctan2(gap[1], gap[0])
    at_b = np.arccos((b**2 + length**2 - c**2) / (2 * b * length))
    at_c = np.arccos((c**2 + length**2 - b**2) / (2 * c * length))
    return jnp.array([crank, up + at_b, up - at_c])


# ---- Slider-crank: crank r, rod l, slider at x on the line y = 0 -------------------------------


def crank_slider(t, q, v, params):
    r, length, x = params["r"], params["l"], v[2]
    T = 0.5 * params["J"] * v[0] ** 2 + 0.5 * params["Jr"] * v[1] ** 2 + 0.5 * params["m"] * x**2
    return T + 0.0 * (r + length)


def slider_rows(t, q, params):
    r, length = params["r"], params["l"]
    x = r * jnp.cos(q[0]) + length * jnp.cos(q[1]) - q[2]
    return jnp.stack([x, r * jnp.sin(q[0]) + length * jnp.sin(q[1])])


SLIDER = {"r": 0.5, "l": 1.0, "J": 0.3, "Jr": 0.1, "m": 0.7}
slider_crank = jl.System(
    crank_slider, ("crank", "rod", "x"), constraints=(jl.Holonomic(slider_rows, ("x", "y")),)
)


def slider_start(crank, rate, params=SLIDER):
    r, length = params["r"], params["l"]
    rod = -np.arcsin(r * np.sin(crank) / length)
    rod_rate = -r * np.cos(crank) * rate / (length * np.cos(rod))
    x = r * np.cos(crank) + length * np.cos(rod)
    x_rate = -r * np.sin(crank) * rate - length * np.sin(rod) * rod_rate
    return jnp.array([crank, rod, x]), jnp.array([rate, rod_rate, x_rate])


# ---- A knife edge on a plane: nonholonomic -------------------------------------------------------


def skate_lagrangian(t, q, v, params):
    return 0.5 * params["m"] * (v[0] ** 2 + v[1] ** 2) + 0.5 * params["I"] * v[2] ** 2


def edge(t, q, v, params):
    return -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]


skate = jl.System(skate_lagrangian, ("x", "y", "theta"), constraints=(jl.Pfaffian(edge, "edge"),))
SKATE = {"m": 1.5, "I": 0.2}


# ---- A pendulum whose pivot has a prescribed motion along the x axis: rheonomic ------------------


def led(t, q, params):
    x = params["X"] * jnp.sin(params["Omega"] * t)
    return jnp.stack([q[0] - x - jnp.sin(q[2]), q[1] + jnp.cos(q[2])])


def body(t, q, v, params):
    T = 0.5 * params["m"] * (v[0] ** 2 + v[1] ** 2) + 0.5 * params["I"] * v[2] ** 2
    return T - params["m"] * G * q[1]


led_pendulum = jl.System(body, ("x", "y", "theta"), constraints=(jl.Holonomic(led, "pin"),))
LED = {"m": 1.3, "I": 0.2, "X": 0.3, "Omega": 2.0}


def led_start(theta=0.7, omega=0.4, params=LED):
    rate = params["X"] * params["Omega"]
    q = jnp.array([np.sin(theta), -np.cos(theta), theta])
    return q, jnp.array([rate + np.cos(theta) * omega, np.sin(theta) * omega, omega])
