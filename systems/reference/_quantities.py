"""Quantities of a system at one state, by name."""

from collections.abc import Mapping
from functools import cache, partial, singledispatch

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

import jaxlag as jl
from systems.catalogue._entry import AbstractEntry, Entry, PrescribedEntry, StaticEntry


def quantities(
    entry: Entry, params: Mapping[str, ArrayLike], t: Array, q: Array, v: Array
) -> dict[str, Array]:
    """Every quantity of the state (t, q, v), including those of the entry.

    Args:
        entry: the system, n coordinates.
        params: parameter name -> value.
        t: time [s], shape ().
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).

    Returns:
        `q`, `v`, `a`; `u`, if there are quasi-velocities; with constraints `lambda` and
        `constraint_force`, A^T lambda; `energy.T`, `energy.V`, `energy.E`; `extras.H`, `extras.p`
        and `extras.p_dot`, which is dp/dt along the motion; the entry's other `extras.*` and
        `invariants.*`.
    """
    system = entry.system
    a = system.acceleration(q, v, params, t=t)
    T = system.kinetic(q, v, params, t=t)
    V = system.potential(q, params=params, t=t)

    def momentum(t: Array, q: Array, v: Array) -> Array:
        return system.momentum(q, v, params, t=t)

    p, p_dot = jax.jvp(momentum, (t, q, v), (jnp.ones_like(t), v, a))
    H = system.energy(q, v, params, t=t)
    groups = {
        "energy": {"T": T, "V": V, "E": T + V},
        "extras": {"H": H, "p": p, "p_dot": p_dot}
        | {name: f(t, q, v, a, params) for name, f in entry.extras.items()},
        "invariants": {name: f(t, q, v, a, params) for name, f in entry.invariants.items()},
    }
    state = {"q": q, "v": v, "a": a}
    if entry.quasi_velocities:
        state["u"] = system.quasi_velocities(q, v, params, t=t)
    return state | _reactions(entry, params, t, q, v) | _named(groups)


def file_quantities(
    entry: Entry, params: Mapping[str, ArrayLike], t: Array, q: Array, v: Array
) -> dict[str, Array]:
    """The quantities that a reference file may hold for the state (t, q, v) of the system.

    These are all of `quantities`. If the entry has a chart, `q`, `v` and `a` are those of its
    coordinates, without quantities of the other coordinates or of the constraints.
    """
    found = quantities(entry, params, t, q, v)
    if entry.chart is None:
        return found
    own = {name: found[name][entry.file_columns] for name in ("q", "v", "a")}
    return {name: x for name, x in (found | own).items() if name not in _OF_ALL_COORDINATES}


_OF_ALL_COORDINATES = ("lambda", "constraint_force", "extras.H", "extras.p", "extras.p_dot")


def static_quantities(
    entry: StaticEntry, params: Mapping[str, ArrayLike], rest: jl.Equilibrium
) -> dict[str, Array]:
    """The entry's values of the state of rest, and `q` if the entry has no chart."""
    values = {name: jnp.asarray(f(rest, params)) for name, f in entry.values.items()}
    return values if entry.chart is not None else {"q": rest.q} | values


def prescribed_quantities(
    entry: PrescribedEntry,
    params: Mapping[str, ArrayLike],
    t: Array,
    q: Array,
    v: Array,
    a: Array,
) -> dict[str, Array]:
    """`q`, `v`, `a`, the `generalized_force` that they require, and the entry's `extras.*`."""
    force = jl.inverse_dynamics(entry.system, q, v, a, params, t=t)
    extras = {name: f(t, q, v, a, params) for name, f in entry.extras.items()}
    return {"q": q, "v": v, "a": a, "generalized_force": force} | _named({"extras": extras})


@cache
def shapes(entry: AbstractEntry) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every quantity in reference files, without computing them."""
    abstract = jax.eval_shape(partial(_at_zero, entry), entry.example.params)
    return {name: value.shape for name, value in abstract.items()}


@singledispatch
def _at_zero(entry: AbstractEntry, params: Mapping[str, ArrayLike]) -> dict[str, Array]:
    raise NotImplementedError(f"no quantities are known of {entry.kind} systems")


@_at_zero.register
def _(entry: Entry, params: Mapping) -> dict:
    zero = jnp.zeros(len(entry.coordinates))
    return file_quantities(entry, params, jnp.zeros(()), zero, zero)


@_at_zero.register
def _(entry: StaticEntry, params: Mapping) -> dict:
    return static_quantities(entry, params, entry.rest(params))


@_at_zero.register
def _(entry: PrescribedEntry, params: Mapping) -> dict:
    zero = jnp.zeros(len(entry.coordinates))
    return prescribed_quantities(entry, params, jnp.zeros(()), zero, zero, zero)


def _reactions(
    entry: Entry, params: Mapping[str, ArrayLike], t: Array, q: Array, v: Array
) -> dict[str, Array]:
    """`lambda`, one for each of the entry's constraints, and `constraint_force`, if any."""
    if not entry.constraints:
        return {}
    lam = entry.system.multipliers(q, v, params, t=t)
    return {
        "lambda": jnp.stack([lam[name] for name in entry.constraints]),
        "constraint_force": entry.system.constraint_force(q, v, params, t=t),
    }


def _named(groups: Mapping[str, Mapping[str, ArrayLike]]) -> dict[str, Array]:
    return {
        f"{group}.{name}": jnp.asarray(value)
        for group, members in groups.items()
        for name, value in members.items()
    }
