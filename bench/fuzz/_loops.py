"""Second derivatives through random loops, compared with the unrolled loop, forward over forward.

A few steps of a random system run in `lax.scan`, `fori_loop` or `lax.map`, alone or within
`checkpoint`, `jit`, `cond` or `vmap`. L contains functions with custom derivative rules. Two
derivatives are taken, each by jvp, grad, jacfwd or jacrev, and reduced to one number. JAX splits
the bodies of loops for reverse derivatives, and could lose the custom rules. The unrolled program
has no loop to split.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxlag as jl
from bench.fuzz import _random_mechanisms, _random_quasi, _random_systems
from bench.fuzz._comparison import SLACK, Compared, worst
from bench.fuzz._random_mechanisms import values
from bench.fuzz._random_systems import Drawn
from bench.fuzz._rounding import evaluated

STEPS = 3
NUDGES = 4
LOOPS = ("scan", "fori_loop", "map")
WITHIN = ("nothing", "checkpoint", "jit", "cond", "vmap")
DERIVATIVES = ("jvp", "grad", "jacfwd", "jacrev")


@jax.custom_jvp
def ruled(x: Any) -> Any:
    """tanh(x); only the custom rule has the derivative."""
    return lax.stop_gradient(jnp.tanh(x))


@ruled.defjvp
def _ruled(primals: Any, tangents: Any) -> Any:
    (x,), (dx,) = primals, tangents
    return ruled(x), (1.0 - ruled(x) ** 2) * dx


class Looped(NamedTuple):
    """A random computation.

    Attributes:
        drawn: L, params and units.
        system: the declared system, in which L has a custom derivative rule.
        plain: the same system without the rule.
        q, v, t: a state.
        loop, within: the loop of the steps, and the transformation around it.
        inner, outer: the transformations that take the derivatives.
        simulates: whether a step is a short motion.
    """

    drawn: Drawn
    system: jl.System
    plain: jl.System
    t: float
    q: np.ndarray
    v: np.ndarray
    loop: str
    within: str
    inner: str
    outer: str
    simulates: bool = False

    @property
    def written(self) -> str:
        """A description with source code."""
        how = f"{self.outer} of {self.inner} of {self.loop} within {self.within}"
        what = "motions" if self.simulates else "accelerations"
        drawn = self.drawn
        given = f"params = {drawn.params!r}; units = {drawn.units!r}"
        state = f"t, q, v = {self.t!r}, {self.q.tolist()!r}, {self.v.tolist()!r}"
        how = f"{how}, lowering {self.system.lowering!r}"
        return f"{how}, {what}; L = {drawn.lagrangian} + ruled(...); {given}; {state}"


def draw(seed: int, simulates: bool = False) -> Looped:
    """The computation of a seed."""
    rng = np.random.default_rng([seed, 2])
    kind = rng.integers(2 if simulates else 4)
    if kind == 2:
        mechanism = _random_mechanisms.draw(seed, 2.0, smooth=True)
    elif kind == 3:
        mechanism = _random_quasi.draw(seed, 2.0, smooth=True)
    else:
        mechanism = None
    if mechanism is None:
        drawn = _random_systems.draw(seed)
        q, v = rng.uniform(-1.0, 1.0, (2, drawn.n)) * np.array(drawn.units)
        t, system = 0.3, drawn.system
    else:
        drawn, system, t = mechanism.drawn, mechanism.system, mechanism.t
        q, v = np.array(mechanism.q), np.array(mechanism.v)
    names = [str(rng.choice(x)) for x in (LOOPS, WITHIN, DERIVATIVES, DERIVATIVES)]
    lowering = str(rng.choice(["auto", "array"]))
    with_rule, plain = (having(system, drawn, f, lowering) for f in (ruled, jnp.tanh))
    return Looped(drawn, with_rule, plain, t, q, v, *names, simulates)


def having(system: jl.System, drawn: Drawn, f: Callable, lowering: str = "auto") -> jl.System:
    """The system with an additional potential f(x_0 + b x_0^2)."""
    L = _random_systems.function("t, q, v, p", drawn.lagrangian)
    unit, scale = drawn.units[0], drawn.scale

    def lagrangian(t: Any, q: Any, v: Any, p: Any) -> Any:
        x = q[0] / unit
        return L(t, q, v, p) - scale * f(x + p["b"] * x**2)

    quasi = system.quasi
    bound = () if quasi is None else quasi.constrained
    own = [c for c in system.constraints if c.names != bound or not bound]
    return jl.System(
        lagrangian,
        {"q": (drawn.n,)},
        forces=system.forces,
        constraints=own,
        quasi=quasi,
        written_in=system.written_in,
        lowering=lowering,
    )


def compared(looped: Looped) -> Compared:
    """Compare the loop with the unrolled loop."""
    drawn = looped.drawn
    dtype = jnp.dtype(drawn.dtype)
    eps, rng = float(jnp.finfo(dtype).eps), np.random.default_rng(3)
    units = np.array(drawn.units)
    z = np.concatenate([looped.q / units, looped.v / units, drawn.params["a"], [drawn.params["b"]]])
    z = z.astype(dtype)
    d, w = (rng.uniform(0.5, 1.0, z.size).astype(dtype) for _ in range(2))
    if looped.simulates:
        found, right = (jax.jit(f)(z, d, w) for f in (_looping(looped), _unrolled(looped)))
        off = abs(float(found) - float(right)) / (1e-6 * (1.0 + abs(float(right))))
        if not np.isfinite(float(right)):
            return Compared("not compared: motions that fail")
        return worst({"second derivative of motions": off if np.isfinite(off) else np.inf})
    right = jax.make_jaxpr(_unrolled(looped))(z, d, w)
    x = float(evaluated(right, [z, d, w])[0])
    if not np.isfinite(x):
        return Compared("not compared: no number")
    near = []
    for _ in range(NUDGES):
        nudged = (z * (1.0 + eps * rng.uniform(-1.0, 1.0, z.shape))).astype(dtype)
        near.append(float(evaluated(right, [nudged, d, w], eps, rng)[0]))
    y = float(evaluated(jax.make_jaxpr(_looping(looped))(z, d, w), [z, d, w])[0])
    spread = max(abs(k - x) for k in near)
    if not np.isfinite(spread) or spread > 1e-3 * abs(x):
        return Compared("not compared: no digits")
    off = abs(y - x) / (SLACK * (spread + eps * abs(x)) + np.finfo(float).tiny)
    return worst({"second derivative": off if np.isfinite(off) else np.inf})


def _step(looped: Looped, system: jl.System) -> Callable:
    """(state in units, fraction of a step, params) -> the next state."""
    drawn = looped.drawn
    units = jnp.asarray(drawn.units, drawn.dtype)
    n, h = drawn.n, 0.02

    def step(x: Any, k: Any, p: Any) -> Any:
        q, v = units * x[:n], units * x[n:]
        if looped.simulates:
            ts = jnp.asarray([0.0, 0.05]) + looped.t
            motion = jl.simulate(system, q, v, ts, p, throw=False, max_steps=200)
            return jnp.concatenate([motion.q[-1] / units, motion.v[-1] / units])
        a = system.acceleration(q, v, p, t=looped.t) / units
        v = x[n:] + h * k * a
        return jnp.concatenate([x[:n] + h * k * v, v])

    return step


def _value(looped: Looped, z: Any, run: Callable) -> Any:
    n = looped.drawn.n
    p = values(looped.drawn) | {"a": z[2 * n : -1], "b": z[-1]}
    return jnp.sum(jnp.sin(run(z[: 2 * n], p)))


def _ks(looped: Looped, z: Any) -> Any:
    return jnp.linspace(0.5, 1.0, 2 if looped.simulates else STEPS).astype(z.dtype)


def _unrolled(looped: Looped) -> Callable:
    """(z, d, w) -> d^T H w, unrolled and forward over forward."""
    step = _step(looped, looped.plain)

    def value(z: Any) -> Any:
        def run(x: Any, p: Any) -> Any:
            ks = _ks(looped, z)
            if looped.loop == "map":
                return sum(step(k * x, k, p) for k in ks)
            for k in ks:
                x = step(x, k, p)
            return x

        return _value(looped, z, run)

    def second(z: Any, d: Any, w: Any) -> Any:
        return jax.jvp(lambda z: jax.jvp(value, (z,), (d,))[1], (z,), (w,))[1]

    return second


def _looping(looped: Looped) -> Callable:
    """(z, d, w) -> d^T H w, in a loop, by the drawn derivatives."""
    step = _step(looped, looped.system)

    def run(x: Any, p: Any) -> Any:
        ks = _ks(looped, x)
        if looped.loop == "map":
            return jnp.sum(lax.map(lambda k: step(k * x, k, p), ks), axis=0)
        if looped.loop == "scan":
            return lax.scan(lambda x, k: (step(x, k, p), None), x, ks)[0]
        return lax.fori_loop(0, len(ks), lambda i, x: step(x, ks[i], p), x)

    def wrapped(x: Any, p: Any) -> Any:
        if looped.within == "checkpoint":
            return jax.checkpoint(run)(x, p)
        if looped.within == "jit":
            return jax.jit(run)(x, p)
        if looped.within == "cond":
            return lax.cond(p["b"] > -1.0, run, lambda x, p: x, x, p)
        if looped.within == "vmap":
            return jax.vmap(run, (0, None))(jnp.stack([x, x]), p)[0]
        return run(x, p)

    def value(z: Any) -> Any:
        return _value(looped, z, wrapped)

    def second(z: Any, d: Any, w: Any) -> Any:
        def inner(z: Any) -> Any:
            if looped.inner == "jvp":
                return jax.jvp(value, (z,), (d,))[1]
            by = {"grad": jax.grad, "jacfwd": jax.jacfwd, "jacrev": jax.jacrev}[looped.inner]
            return by(value)(z) @ d

        if looped.outer == "jvp":
            return jax.jvp(inner, (z,), (w,))[1]
        by = {"grad": jax.grad, "jacfwd": jax.jacfwd, "jacrev": jax.jacrev}[looped.outer]
        return by(inner)(z) @ w

    return second
