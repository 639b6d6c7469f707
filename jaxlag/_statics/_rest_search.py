"""Sequence of searches for a state of rest; each runs only if those before it failed."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._statics._relaxation import relax
from jaxlag._statics._root_search import Balance, judge, search

STARTS = 4  # of relaxation: q0, and states around it


class Rest(NamedTuple):
    """The end point of a search, its balance of forces, and the number of steps."""

    z: Float[Array, " k"]
    balance: Balance
    steps: Int[Array, ""]


class _State(NamedTuple):
    rest: Rest
    spread: Float[Array, " n"]
    spent: Int[Array, ""]
    count: Int[Array, ""]


def find_rest(
    forces: Callable,
    phi: Callable,
    whole: Callable,
    q0: Float[Array, " n"],
    rtol: Float[Array, ""],
    max_steps: int,
) -> Rest:
    """The root of all equations near q0, else one at the end of a relaxation.

    The first search starts at q0, the second where the system relaxes from q0, the others
    where it relaxes from a few states around it, as far from q0 as the searches have gone. The
    result is the first root found, or without one the end of the first search.

    Args:
        forces: q -> ((Q, h), A), forces and constraint rows.
        phi: q -> residuals of the constraints.
        whole: z -> all equations at z = (q, lam).
        q0: start.
        rtol: see `equilibrium`.
        max_steps: bound on the steps of the first search, and of all later ones together.
    """
    n, m = q0.shape[0], phi(q0).shape[0]

    def net(q: Array) -> tuple[Array, Array]:
        (Q, h), A = forces(q)
        return Q - h, A

    def attempt(start: Array) -> Rest:
        F, A = net(start)
        lam = jnp.linalg.lstsq(A.T, -F)[0] if m else jnp.zeros((0,), q0.dtype)
        z, steps = search(max_steps, whole, jnp.concatenate([start, lam]))
        (Q, h), A = forces(z[:n])
        present = jnp.abs(Q) + jnp.abs(h) + jnp.abs(z[n:]) @ jnp.abs(A)
        present = jnp.concatenate([present, jnp.zeros_like(z[n:])])
        balance = judge(whole, present, z, jnp.concatenate([q0, lam]), rtol)
        return Rest(z, balance, steps.astype(jnp.int32))

    def body(s: _State) -> _State:
        found = s.rest.balance.found
        around = jnp.asarray(_directions(n), q0.dtype)[s.count]
        bound = jnp.where((s.count == 0) | found, 0, max_steps - s.spent)
        q, steps = relax(net, phi, q0 + s.spread * around, bound)
        # Lanes of a batch that are done start where they ended: that takes fewest steps.
        q = jnp.where(found, s.rest.z[:n], q)
        now = attempt(q)
        now = now._replace(steps=now.steps + steps)
        counts = now.balance.found | (s.count == 0)
        rest = jax.tree.map(lambda x, y: jnp.where(counts, x, y), now, s.rest)
        moved = jnp.maximum(jnp.abs(q - q0), jnp.abs(now.z[:n] - q0))
        spread = jnp.maximum(s.spread, jnp.where(jnp.isfinite(moved), moved, 0))
        spent = jnp.where(s.count == 0, 0, s.spent + now.steps)
        return _State(rest, spread, spent, s.count + 1)

    def cond_fun(s: _State) -> Bool[Array, ""]:
        return ~s.rest.balance.found & (s.count <= STARTS) & (s.spent < max_steps)

    z, no = jnp.zeros((n + m,), q0.dtype), jnp.zeros((), bool)
    none = Rest(z, Balance(no, no, z, jnp.outer(z, z), z), jnp.zeros((), jnp.int32))
    init = _State(none, jnp.abs(q0), none.steps, none.steps)
    return jax.lax.while_loop(cond_fun, body, init).rest


def _directions(n: int) -> np.ndarray:
    """A direction for each attempt with entries in -1 to 1; zero for the first two."""
    around = np.random.default_rng(0).uniform(-1, 1, (STARTS + 1, n))
    around[:2] = 0
    return around
