"""What a system's motion carries along: every quantity of its states, by name."""

from collections.abc import Mapping
from functools import cache, partial

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from systems._entry import Entry


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
    named = {
        f"{group}.{name}": jnp.asarray(value)
        for group, members in groups.items()
        for name, value in members.items()
    }
    return {"q": q, "v": v, "a": a} | named


@cache
def shapes(entry: Entry) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every quantity at one state, found without computing any."""
    t = jnp.zeros(())
    q = jnp.zeros(len(entry.coordinates))
    abstract = jax.eval_shape(partial(quantities, entry), entry.example.params, t, q, q)
    return {name: value.shape for name, value in abstract.items()}
