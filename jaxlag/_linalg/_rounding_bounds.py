"""Rounding bounds of a function by stochastic arithmetic.

If the exact value of a result is 0, the computed number has no scale to be compared with. The scale
follows from the operations: several runs change each result of an operation by random multiples of
its rounding, and the difference of their results is the bound. Exact operations, such as moves of
numbers, change nothing. Choices are those of the unchanged run. Loops and library calls count as
one operation each.

Source: Vignes, A stochastic arithmetic for reliable scientific computation, Mathematics and
Computers in Simulation 35 (1993) 233.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array

from jaxlag._core._jaxprs import called

RUNS = 4
STRENGTH = 256.0
"""Roundings by which results are changed: so many that the runs' own rounding is negligible."""

NEARBY = 8
"""Number of states; so many results are very unlikely to agree by chance."""

_TABLE = 1021
_EXACT = frozenset(
    [
        "abs",
        "argmax",
        "argmin",
        "broadcast_in_dim",
        "ceil",
        "clamp",
        "concatenate",
        "convert_element_type",
        "copy",
        "copy_p",
        "cummax",
        "cummin",
        "dynamic_slice",
        "dynamic_update_slice",
        "expand_dims",
        "floor",
        "gather",
        "imag",
        "iota",
        "is_finite",
        "max",
        "min",
        "neg",
        "optimization_barrier",
        "pad",
        "real",
        "reduce_max",
        "reduce_min",
        "reduce_precision",
        "reshape",
        "rev",
        "round",
        "scatter",
        "select_n",
        "sign",
        "slice",
        "sort",
        "split",
        "squeeze",
        "stop_gradient",
        "transpose",
    ]
)


class Bounded(NamedTuple):
    """A function of arrays that computes its own rounding bounds.

    Attributes:
        value: the function.
        bounds: its results, and their changes, as of `with_rounding`.
    """

    value: Callable[..., Array]
    bounds: Callable[..., tuple[Array, Array]]

    def __call__(self, *args: Array) -> Array:
        """The results."""
        return self.value(*args)

    def chosen(self, choose: Callable[[Array], Array]) -> "Bounded":
        """The same function, of whose results some entries are chosen, and others set to 0."""

        def bounds(*args: Array) -> tuple[Array, Array]:
            results, changes = self.bounds(*args)
            return choose(results), choose(changes)

        return Bounded(lambda *args: choose(self.value(*args)), bounds)


def chosen(function: Callable, choose: Callable[[Array], Array]) -> Callable:
    """choose(function(...)), which keeps its rounding bounds if it is `Bounded`."""
    if isinstance(function, Bounded):
        return function.chosen(choose)
    return lambda *args: choose(function(*args))


def with_rounding(function: Callable, *args: Array) -> tuple[Any, Any]:
    """(results, their changes by one rounding of every operation and of the arguments).

    Args:
        function: of arrays, with arrays as results; or `Bounded`.
        args: its arguments.

    Returns:
        Changes are absolute; NaN if unknown, as beside the end of a domain.
    """
    args = jax.lax.stop_gradient(args)
    if isinstance(function, Bounded):
        return jax.lax.stop_gradient(function.bounds(*args))
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
    leaves = jax.tree.leaves(args)
    table = random_signs(np.random.default_rng(7), RUNS, _TABLE)

    def run(signs: Array) -> tuple[list[Any], list[Any]]:
        changed = _Changed(signs)
        return changed.run(closed, leaves, [changed(x) for x in leaves])

    exact, runs = jax.vmap(run, out_axes=(None, 0))(jnp.asarray(table))
    found = [
        jnp.max(jnp.abs(several - one[None]), axis=0) / STRENGTH
        for several, one in zip(runs, exact, strict=True)
    ]
    tree = jax.tree.structure(shape)
    return jax.lax.stop_gradient((jax.tree.unflatten(tree, exact), jax.tree.unflatten(tree, found)))


def random_signs(draw: np.random.Generator, *shape: int) -> np.ndarray:
    """Random numbers between 1/2 and 1, of both signs: changes in units of the rounding."""
    return draw.uniform(0.5, 1.0, shape) * draw.choice([-1.0, 1.0], shape)


def with_scatter(function: Callable, *args: Array) -> tuple[Any, Any]:
    """(results, their spread over states nearby), from one program.

    For a result that does not depend on the arguments the spread is its rounding.

    Args:
        function: of arrays, with arrays as results.
        args: its arguments.
    """
    args = jax.lax.stop_gradient(args)
    draw = np.random.default_rng(11)

    def around(x: Array) -> Array:
        off = draw.uniform(-1.0, 1.0, (NEARBY, *x.shape)) * float(jnp.finfo(x.dtype).eps) ** 0.5
        beside = x[None] + jnp.asarray(off, x.dtype) * (1.0 + jnp.abs(x))[None]
        return jnp.concatenate([x[None], beside])

    found = jax.vmap(function)(*map(around, args))
    here = jax.tree.map(lambda x: x[0], found)
    scatter = jax.tree.map(lambda x: jnp.max(x, axis=0) - jnp.min(x, axis=0), found)
    return jax.lax.stop_gradient((here, scatter))


class _Changed:
    """One run; every change takes the next entries of a row of random numbers."""

    def __init__(self, signs: Array) -> None:
        self.signs, self.place = signs, 0
        self.factors: dict[Any, Array] = {}

    def __call__(self, x: Any) -> Any:
        """Each element changed by some roundings of its size."""
        if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
            return x
        x = jnp.asarray(x)
        if x.dtype not in self.factors:
            amount = STRENGTH * float(jnp.finfo(x.dtype).eps)
            self.factors[x.dtype] = 1.0 + amount * self.signs.astype(x.dtype)
        part, size = self.factors[x.dtype], x.size
        if size < _TABLE:
            start = self.place % (_TABLE - size)
            part = part[start : start + size]
            self.place += size
        else:
            part = jnp.resize(part, (size,))
        return x * part.reshape(x.shape)

    def run(
        self, closed: ClosedJaxpr, exact: Sequence[Any], given: Sequence[Any]
    ) -> tuple[list[Any], list[Any]]:
        """(the results, the changed results)."""
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, [(c, c) for c in closed.consts], strict=True))
        values |= dict(zip(jaxpr.invars, zip(exact, given, strict=True), strict=True))

        def pairs(atoms: Sequence[Any]) -> tuple[list[Any], list[Any]]:
            found = [(x.val, x.val) if isinstance(x, Literal) else values[x] for x in atoms]
            return [x for x, _ in found], [x for _, x in found]

        for eqn in jaxpr.eqns:
            results = self._eqn(eqn, *pairs(eqn.invars))
            values |= dict(zip(eqn.outvars, zip(*results, strict=True), strict=True))
        return pairs(jaxpr.outvars)

    def _eqn(self, eqn: Any, exact: list[Any], given: list[Any]) -> tuple[list[Any], list[Any]]:
        name = eqn.primitive.name
        closed = called(eqn)
        if closed is not None:
            return self.run(closed, exact, given)

        def bind(values: list[Any]) -> list[Any]:
            params = eqn.primitive.get_bind_params(eqn.params)
            found = eqn.primitive.bind(*values, **params)
            return list(found) if eqn.primitive.multiple_results else [found]

        plain = bind(exact)
        if not any(jnp.issubdtype(x.dtype, jnp.floating) for x in plain):
            return plain, plain
        if name == "select_n":
            given = [exact[0], *given[1:]]
        if name in _EXACT:
            return plain, bind(given)
        # A sum is rounded in proportion to its terms, which may be far larger.
        if any(np.shape(x) not in ((), plain[0].shape) for x in given) or len(plain) > 1:
            given = [self(x) for x in given]
        return plain, [self(x) for x in bind(given)]
