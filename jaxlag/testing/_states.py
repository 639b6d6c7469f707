"""States at which derivatives of declared functions are checked."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxlag._core._errors import invalid

STATES = ("given", "rest", "zero", "equal", "one", "random")
_RANDOM = 3  # states of that kind


def states(
    names: Sequence[str], q: Array, v: Array, u: Array | None, x: Array | None = None
) -> dict[str, dict]:
    """Name -> q, v and, unless they are None, u and x, of the distinct ones among those requested.

    u and x are changed like v.
    """
    if isinstance(names, str) or not names or not set(names) <= set(STATES):
        must, was = f"be names among {list(STATES)}", f"it was {names!r}"
        raise invalid("check_derivatives: states", must, was, 'Write states=("given", "rest").')
    known = {"q": q, "v": v, "u": u, "x": x}
    given = {name: value for name, value in known.items() if value is not None}
    rng = np.random.default_rng(0)

    def each(**change: Callable[[Array], Array]) -> dict:
        return {name: change["q" if name == "q" else "v"](x) for name, x in given.items()}

    def largest(x: Array) -> Array:
        entry = x[jnp.argmax(jnp.abs(x))]
        return jnp.where(entry == 0, jnp.ones_like(entry), entry)

    def equal(x: Array) -> Array:
        return jnp.full_like(x, largest(x))

    def one(x: Array) -> Array:
        return jnp.zeros_like(x).at[0].set(largest(x))

    def near(x: Array) -> Array:
        size = jnp.where(x == 0, 1.0, jnp.abs(x)).astype(x.dtype)
        return x + size * jnp.asarray(rng.uniform(-0.5, 0.5, x.shape), x.dtype)

    all_states = {"given": given}
    all_states["rest"] = each(q=jnp.asarray, v=jnp.zeros_like)
    all_states["zero"] = each(q=jnp.zeros_like, v=jnp.zeros_like)
    all_states["equal"] = each(q=equal, v=equal)
    all_states["one"] = each(q=one, v=one)
    all_states |= {f"random {k + 1}": each(q=near, v=near) for k in range(_RANDOM)}
    distinct: dict[str, dict] = {}
    for name, own in all_states.items():
        met = any(all(np.array_equal(own[k], y[k]) for k in own) for y in distinct.values())
        if name.split()[0] in names and not met:
            distinct[name] = own
    return distinct
