"""Motions to solve to a given error: declarations for jaxlag, and explicit equations.

SI units, angles in rad. Errors are those of the final coordinates, each divided by 1 + its size.
The chaotic pendulum amplifies an error of the start up to 7000 times, orbits of e = 0.9 up to
700 000 times, the other motions less than 50 times. Rounding errors during the motion are amplified
too. So no solver in double precision reaches errors below about 1e-12 and 1e-10 in these two.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxlag as jl
from bench._problems import explicit_equations
from bench._problems.declared_scenes import chain_on_arrays
from bench._problems.double_pendulum import PARAMS as PENDULUM
from bench._problems.explicit_equations import PLAIN, Rates
from bench._problems.scenes import G, elastic_pendulum, links
from systems import (
    double_pendulum,
    double_pendulum_cartesian,
    heavy_symmetric_top,
    rigid_aircraft,
    rolling_disk,
)
from systems.catalogue import _attitude

DISKS = {"m": 1.0, "R": 0.3, "I_d": 0.0225, "I_a": 0.045, "g": G}


class Motion(NamedTuple):
    """A start and a span, and the equations in every form that is compared.

    Attributes:
        system: the declaration for jaxlag.
        q0: coordinates at the start, (n,) or (lanes, n).
        v0: their rates.
        t1: end, s; it starts at 0.
        rates: the explicit equations.
        lagrangian: L(t, q, v, params), for a first prototype by naive autodiff.
        speeds: the part of y after the coordinates, from (q, v); None: v.
        force: generalized force of the prototype.
        rows: left sides of the constraints on velocities, c(q, v, params) = 0, linear in v.
        field: dy/dt on arrays, if one would write arrays and not scalars for JAX by hand.
        stiff: whether implicit methods have a line.
        loosest: the first tolerance is 10^-loosest; looser ones make orbits fall into the center.
        fewest: smallest number of fixed steps.
    """

    system: jl.System
    params: Mapping[str, Any]
    q0: np.ndarray
    v0: np.ndarray
    t1: float
    rates: Rates
    lagrangian: Callable[[Any, Array, Array, Any], Any]
    speeds: Callable[[Any, Array, Array, Any], Array] | None = None
    force: Callable[[Array, Array, Any], Array] | None = None
    rows: Callable[[Array, Array, Any], Array] | None = None
    field: Callable[[Any, Array, Any], Array] | None = None
    stiff: bool = False
    loosest: float = 2.5
    fewest: int = 32

    @property
    def lanes(self) -> int:
        """How many motions at once."""
        return 1 if self.q0.ndim == 1 else len(self.q0)

    def start(self) -> np.ndarray:
        """y at t = 0, (size,) or (lanes, size)."""
        if self.speeds is None:
            return np.concatenate([self.q0, self.v0], axis=-1)
        w0 = self.speeds(0.0, jnp.asarray(self.q0), jnp.asarray(self.v0), self.params)
        return np.concatenate([self.q0, np.asarray(w0)])

    def error(self, q: Any, reference: Any) -> float:
        """Largest deviation of the final coordinates, each divided by 1 + its size."""
        q = np.asarray(q, float)
        off = np.abs(q - reference) / (1.0 + np.abs(reference))
        return float(np.max(off)) if np.all(np.isfinite(q)) else math.nan

    def evaluate(self, y: Any) -> list[float]:
        """The explicit rates on numbers."""
        return self.rates(PLAIN, self.params, [float(x) for x in y])


def orbit(t: Any, q: Array, v: Array, p: Any) -> Array:
    """A particle about a center of attraction, in the plane."""
    return 0.5 * (v @ v) + p["mu"] / jnp.sqrt(q @ q)


def _kepler(e: float) -> Motion:
    """From the pericenter, semi-major axis 1, 100 periods."""
    return Motion(
        system=jl.System(orbit, ("x", "y")),
        params={"mu": 1.0},
        q0=np.array([1.0 - e, 0.0]),
        v0=np.array([0.0, math.sqrt((1.0 + e) / (1.0 - e))]),
        t1=200.0 * math.pi,
        rates=explicit_equations.kepler,
        lagrangian=orbit,
        loosest=5.0,
        fewest=3200,
    )


def _lagrangian(module: Any) -> Callable:
    return lambda t, q, v, p: module.kinetic(t, q, v, p) - module.potential(t, q, p)


def _pendulum(q0: Any) -> Motion:
    q0 = np.asarray(q0, float)
    return Motion(
        system=double_pendulum.system,
        params=PENDULUM,
        q0=q0,
        v0=np.zeros_like(q0),
        t1=10.0,
        rates=explicit_equations.double_pendulum,
        lagrangian=_lagrangian(double_pendulum),
    )


def lanes() -> Motion:
    """16 double pendulums at rest, from angles of up to 2 rad: some swing and some tumble."""
    return _pendulum(np.random.default_rng(0).uniform(-2.0, 2.0, (16, 2)))


def _top() -> Motion:
    def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Any:
        u = heavy_symmetric_top.angular_velocity(t, q, v, p)
        return heavy_symmetric_top.kinetic(t, q, u, p) - heavy_symmetric_top.potential(t, q, p)

    return Motion(
        system=heavy_symmetric_top.system,
        params=heavy_symmetric_top.entry.example.params,
        q0=np.array([0.0, 0.7, 0.0]),
        v0=np.array([-1.0, 0.0, 50.0]),
        t1=5.0,
        rates=explicit_equations.heavy_top,
        lagrangian=lagrangian,
        speeds=heavy_symmetric_top.angular_velocity,
    )


def _aircraft() -> Motion:
    def lagrangian(t: Any, q: Array, v: Array, p: Any) -> Any:
        u = _attitude.body_velocities(t, q, v, p)
        return rigid_aircraft.kinetic(t, q, u, p) - rigid_aircraft.potential(t, q, p)

    def force(q: Array, v: Array, p: Any) -> Array:
        J_r = jax.jacfwd(lambda q: rigid_aircraft.origin(0.0, q, p))(q)
        J_w = jax.jacfwd(lambda v: _attitude.angular_velocity(0.0, q, v, p))(v)
        F = rigid_aircraft.force(0.0, q, v, p)
        return F @ J_r + rigid_aircraft.moment(0.0, q, v, p) @ J_w

    example = rigid_aircraft.entry.example
    return Motion(
        system=rigid_aircraft.system,
        params=example.params,
        q0=np.array(example.q0),
        v0=np.array(example.v0),
        t1=5.0,
        rates=explicit_equations.rigid_aircraft,
        lagrangian=lagrangian,
        speeds=_attitude.body_velocities,
        force=force,
    )


def _cartesian() -> Motion:
    """The regular double pendulum by the positions of its bobs."""
    s1, c1, s2, c2 = math.sin(1.0), math.cos(1.0), math.sin(0.5), math.cos(0.5)

    def rows(q: Array, v: Array, p: Any) -> Array:
        phi = lambda q: double_pendulum_cartesian.squared_length_excesses(0.0, q, p)  # noqa: E731
        return jax.jvp(phi, (q,), (v,))[1]

    return Motion(
        system=double_pendulum_cartesian.system,
        params=PENDULUM,
        q0=np.array([s1, -c1, s1 + s2, -c1 - c2]),
        v0=np.zeros(4),
        t1=10.0,
        rates=explicit_equations.cartesian_pendulum,
        lagrangian=_lagrangian(double_pendulum_cartesian),
        rows=rows,
    )


def _disk() -> Motion:
    q0 = np.array([0.0, 0.0, 0.0, 1.2, 0.0])
    # It rolls leaning and wobbling, fast enough not to fall.
    u0 = {"w1": 0.3, "w2": 1.0, "w3": 12.0}
    return Motion(
        system=rolling_disk.system,
        params=DISKS,
        q0=q0,
        v0=np.asarray(rolling_disk.system.velocities(q0, u0, DISKS)),
        t1=5.0,
        rates=explicit_equations.rolling_disk,
        lagrangian=_lagrangian(rolling_disk),
        speeds=rolling_disk.angular_velocity,
        rows=lambda q, v, p: rolling_disk.contact_velocity(0.0, q, v, p),
    )


def _elastic() -> Motion:
    """At rest, the spring stretched by the weight: it vibrates by 1e-10 m at 1000 rad/s."""
    params = {"m": 1.0, "l": 1.0, "k": 1e6, "g": G}
    stretch = params["m"] * G * math.cos(1.0) / params["k"]
    return Motion(
        system=jl.System(elastic_pendulum, ("r", "angle")),
        params=params,
        q0=np.array([params["l"] + stretch, 1.0]),
        v0=np.zeros(2),
        t1=10.0,
        rates=explicit_equations.elastic_pendulum,
        lagrangian=elastic_pendulum,
        stiff=True,
    )


def _chain() -> Motion:
    scene = links(8)
    return Motion(
        system=jl.System(scene.lagrangian, [f"q{i}" for i in range(8)]),
        params=scene.params,
        q0=np.array(scene.q0),
        v0=np.zeros(8),
        t1=5.0,
        rates=explicit_equations.chain,
        lagrangian=scene.lagrangian,
        field=chain_on_arrays(8),
    )


MOTIONS: dict[str, Callable[[], Motion]] = {
    "double pendulum, regular": lambda: _pendulum((1.0, 0.5)),
    "double pendulum, chaotic": lambda: _pendulum((2.0, 2.0)),
    "Kepler, e = 0.6": lambda: _kepler(0.6),
    "Kepler, e = 0.9": lambda: _kepler(0.9),
    "heavy top": _top,
    "rigid aircraft": _aircraft,
    "Cartesian double pendulum": _cartesian,
    "rolling disk": _disk,
    "elastic pendulum, k = 1e6": _elastic,
    "chain of 8 links": _chain,
    "16 double pendulums": lanes,
}
