"""One state at which a scalar program is compared with the array program."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.linalg import norm

from jaxlag._lowering._graph._expression import Node
from jaxlag._lowering._symbolic._evaluate import evaluate
from jaxlag._lowering._symbolic._program_key import Key

SLACK = 1e4  # roundings between two ways to compute one acceleration


class State(NamedTuple):
    """A state at which programs are compared.

    Attributes:
        t: time.
        q: coordinates.
        v: velocities, or the free quasi-velocities of the state.
        params: leaves of the traced params.
        inputs: leaves of the inputs' values.
        a: any acceleration.
    """

    t: float
    q: np.ndarray
    v: np.ndarray
    params: list
    inputs: list
    a: np.ndarray

    def values(self, active_rows: Any) -> dict[tuple[str, int], Any]:
        """Values of the inputs of a graph."""
        values: dict[tuple[str, int], Any] = {("t", 0): self.t, ("time_direction", 0): 1.0}
        arrays = {"q": [self.q], "v": [self.v], "params": self.params, "inputs": self.inputs}
        for name, rows in arrays.items():
            flat = np.concatenate([np.ravel(x) for x in rows]) if rows else []
            values |= {(name, i): x for i, x in enumerate(flat)}
        values |= {("active_rows", k): float(x) for k, x in enumerate(active_rows)}
        return values | {("nonzero", k): 1.0 for k in range(len(active_rows))}

    @property
    def arguments(self) -> tuple[Any, Any, Any, list, list]:
        """(t, q, v, params, inputs)."""
        return self[:5]


class Results(NamedTuple):
    """The results of both programs at a state.

    Attributes:
        x: those of the array program.
        allowed: allowed difference.
        found: those of the other.
        defined: whether the array program has a value.
    """

    x: np.ndarray
    allowed: Any
    found: np.ndarray
    defined: bool = True


def numbers(roots: Sequence[Node], at: State, active_rows: Any = ()) -> np.ndarray:
    """Values of the roots at a state, with these rows active."""
    return np.array([float(x) for x in evaluate(roots, at.values(active_rows))])


def solution(key: Key, M: Any, right: Any) -> tuple[Any, float] | None:
    """(x with M x = right, allowed difference of another method); None if M is ill-conditioned."""
    if not (np.all(np.isfinite(M)) and np.all(np.isfinite(right))):
        return None
    if not np.linalg.cond(M) < 1e9:
        return None
    x = np.linalg.solve(M, right)
    size = norm(right) + norm(M) * norm(x) + 1.0
    eps = float(jnp.finfo(key.dtype).eps)
    return x, float(SLACK * eps * size * norm(np.linalg.inv(M)))


def random_state(key: Key, rng: np.random.Generator, known: list | None) -> State:
    """A state with numbers of the size of 1, and with the known params or random ones.

    Args:
        key: key of a program.
        rng: draws the numbers.
        known: leaves of the params; None if they are random, too.
    """
    n = key.size
    speeds = n if key.quasi is None else len(key.quasi.free)
    t, q, v = rng.uniform(0, 1), rng.uniform(-1.5, 1.5, n), rng.uniform(-1.5, 1.5, speeds)
    params = [
        rng.uniform(0.5, 1.5, leaf.shape)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
        else rng.integers(1, 4, leaf.shape).astype(leaf.dtype)
        for leaf in jax.tree.leaves(key.params.tree)
    ]
    if known is not None:
        params = [
            np.asarray(x, np.float64 if jnp.issubdtype(x.dtype, jnp.floating) else x.dtype)
            for x in known
        ]
    inputs = [rng.uniform(-1, 1, leaf.shape) for leaf in jax.tree.leaves(key.inputs.tree)]
    return State(t, q, v, params, inputs, rng.uniform(-1.5, 1.5, n))


def is_definite(M: Any) -> bool:
    """Whether M is finite and clearly positive definite."""
    if not np.all(np.isfinite(M)):
        return False
    return bool(np.min(np.linalg.eigvalsh(M), initial=1.0) > 1e-9 * norm(M))
