"""What is known of a system at one state: every quantity by name."""

from collections.abc import Mapping
from functools import cache, partial, singledispatch

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

import jaxlag as jl
from systems._entry import AbstractEntry, Entry, PrescribedEntry, StaticEntry


def quantities(
    entry: Entry, params: Mapping[str, ArrayLike], t: Array, q: Array, v: Array
) -> dict[str, Array]:
    """Every quantity of the state (t, q, v), the entry's own included.

    Args:
        entry: the system, n coordinates.
        params: parameter name -> value.
        t: time [s], shape ().
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).

    Returns:
        `q`, `v`, `a`; `energy.T`, `energy.V`, `energy.E`; `extras.H`, `extras.p` and
        `extras.p_dot`, which is dp/dt along the motion; the entry's further `extras.*` and
        `invariants.*`.
    """
    system = entry.system
    a = system.acceleration(params, q, v, t)
    T = system.kinetic(params, q, v, t)
    V = system.potential(params, q, t=t)

    def momentum(t: Array, q: Array, v: Array) -> Array:
        return system.momentum(params, q, v, t)

    p, p_dot = jax.jvp(momentum, (t, q, v), (jnp.ones_like(t), v, a))
    H = system.energy(params, q, v, t)
    groups = {
        "energy": {"T": T, "V": V, "E": T + V},
        "extras": {"H": H, "p": p, "p_dot": p_dot}
        | {name: f(t, q, v, a, params) for name, f in entry.extras.items()},
        "invariants": {name: f(t, q, v, a, params) for name, f in entry.invariants.items()},
    }
    return {"q": q, "v": v, "a": a} | _named(groups)


def static_quantities(
    entry: StaticEntry, params: Mapping[str, ArrayLike], q: Array
) -> dict[str, Array]:
    """`q` and the entry's values of the state of rest q, shape (n,)."""
    return {"q": q} | {name: jnp.asarray(f(q, params)) for name, f in entry.values.items()}


def prescribed_quantities(
    entry: PrescribedEntry,
    params: Mapping[str, ArrayLike],
    t: Array,
    q: Array,
    v: Array,
    a: Array,
) -> dict[str, Array]:
    """`q`, `v`, `a`, the `generalized_force` that they need, and the entry's `extras.*`."""
    force = jl.inverse_dynamics(entry.system, q, v, a, params, t=t)
    extras = {name: f(t, q, v, a, params) for name, f in entry.extras.items()}
    return {"q": q, "v": v, "a": a, "generalized_force": force} | _named({"extras": extras})


@cache
def shapes(entry: AbstractEntry) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every quantity at one state, found without computing any."""
    abstract = jax.eval_shape(partial(_at_zero, entry), entry.example.params)
    return {name: value.shape for name, value in abstract.items()}


@singledispatch
def _at_zero(entry: AbstractEntry, params: Mapping[str, ArrayLike]) -> dict[str, Array]:
    raise NotImplementedError(f"no quantities are known of {entry.kind} systems")


@_at_zero.register
def _(entry: Entry, params: Mapping) -> dict:
    zero = jnp.zeros(len(entry.coordinates))
    return quantities(entry, params, jnp.zeros(()), zero, zero)


@_at_zero.register
def _(entry: StaticEntry, params: Mapping) -> dict:
    return static_quantities(entry, params, jnp.zeros(len(entry.coordinates)))


@_at_zero.register
def _(entry: PrescribedEntry, params: Mapping) -> dict:
    zero = jnp.zeros(len(entry.coordinates))
    return prescribed_quantities(entry, params, jnp.zeros(()), zero, zero, zero)


def _named(groups: Mapping[str, Mapping[str, ArrayLike]]) -> dict[str, Array]:
    return {
        f"{group}.{name}": jnp.asarray(value)
        for group, members in groups.items()
        for name, value in members.items()
    }
