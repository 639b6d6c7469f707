"""How far rounding may move what a function gives: every operation of it is rounded in other ways.

A number that is 0 but for rounding has no size of its own to compare it with. What it is made of
tells: each result of an operation is changed by some roundings of its size, at random, in several
runs side by side; so far the results differ. Operations that are exact, as moves of numbers are,
change nothing, and choices are made as without changes. Loops and library calls are taken as one
operation each.

Source: Vignes, A stochastic arithmetic for reliable scientific computation, Mathematics and
Computers in Simulation 35 (1993) 233.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

RUNS = 4
STRENGTH = 256.0
"""Roundings by which results are changed: so many that the rounding of the runs is none to them."""

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
_INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr")
_CALLS = frozenset(
    [
        "checkpoint",
        "closed_call",
        "core_call",
        "custom_jvp_call",
        "custom_vjp_call",
        "custom_vjp_call_jaxpr",
        "jit",
        "pjit",
        "remat",
        "remat2",
    ]
)


def with_rounding(function: Callable, *args: Array) -> tuple[Any, Any]:
    """(Results, what one rounding of every operation, and of the arguments, may change in them).

    Args:
        function: of arrays, with arrays as results.
        args: its arguments.

    Returns:
        Changes are absolute; NaN where they are not known, as beside the end of a domain.
    """
    args = jax.lax.stop_gradient(args)
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
    exact = jaxpr_as_fun(closed)(*jax.tree.leaves(args))
    draw = np.random.default_rng(7)
    table = draw.uniform(0.5, 1.0, (RUNS, _TABLE)) * draw.choice([-1.0, 1.0], (RUNS, _TABLE))

    def run(signs: Array) -> list[Array]:
        changed = _Changed(signs)
        given = [changed(x) for x in jax.tree.leaves(args)]
        return changed.run(closed, jax.tree.leaves(args), given)[1]

    runs = jax.vmap(run)(jnp.asarray(table))
    found = [
        jnp.max(jnp.abs(several - one), axis=0) / STRENGTH
        for several, one in zip(runs, exact, strict=True)
    ]
    tree = jax.tree.structure(shape)
    return jax.lax.stop_gradient((jax.tree.unflatten(tree, exact), jax.tree.unflatten(tree, found)))


class _Changed:
    """One run; every change takes the next numbers of a row of random ones."""

    def __init__(self, signs: Array) -> None:
        self.signs, self.place = signs, 0

    def __call__(self, x: Any) -> Any:
        """Each element changed by some roundings of its size."""
        if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
            return x
        x = jnp.asarray(x)
        factor = jnp.ones((), x.dtype)
        for axis, size in enumerate((1, *x.shape)):
            start = self.place % _TABLE
            self.place += size + 1
            if start + size > _TABLE:
                start = 0
            part = self.signs[start : start + size].astype(x.dtype)
            if size > _TABLE:
                part = jnp.resize(self.signs.astype(x.dtype), (size,))
            if axis == 0:
                factor = part[0]
            elif size > 1:
                factor = factor * jnp.reshape(part, (size,) + (1,) * (x.ndim - axis))
        amount = STRENGTH * float(jnp.finfo(x.dtype).eps)
        return x * (1.0 + amount * factor)

    def run(
        self, closed: ClosedJaxpr, exact: Sequence[Any], given: Sequence[Any]
    ) -> tuple[list[Any], list[Any]]:
        """(the results, the results changed)."""
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
        inner = next((eqn.params[key] for key in _INNER if key in eqn.params), None)
        if name in _CALLS and inner is not None:
            closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
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
        # A sum is rounded by its terms, which may be far larger.
        if any(np.shape(x) not in ((), plain[0].shape) for x in given) or len(plain) > 1:
            given = [self(x) for x in given]
        return plain, [self(x) for x in bind(given)]
