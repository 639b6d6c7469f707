"""Functions on arrays, read as expressions of a graph."""

from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from jaxlag._lowering._graph._eliminate import DOUBLE
from jaxlag._lowering._graph._expression import Graph
from jaxlag._lowering._jaxpr._from_jaxpr import read
from jaxlag._lowering._jaxpr._node_arrays import nodes

# Sums of products, quotients and selected values have several uses in linear algebra. Opened in
# each of them, they made programs 3 to 10 % longer (rolling disk, four-bar, double pendulum in
# Cartesian coordinates).
ONCE = frozenset({"dot_general", "reduce_sum", "div", "rsqrt", "select_n"})


def read_function(graph: Graph, eps: float, function: Callable, *args: Any, **options: Any) -> Any:
    """The results of a function on arrays, with nested lists of nodes for arrays.

    Args:
        graph: of all nodes.
        eps: of the numbers.
        function: of arrays, or of tuples of arrays.
        args: its arguments, with (nested) lists of nodes for arrays.
        options: its keyword arguments without nodes.
    """
    leaves, tree = jax.tree.flatten(args, is_leaf=_is_array)
    arrays = [np.array(x, object) for x in leaves]
    dtype = np.dtype("float64" if eps < DOUBLE else "float32")
    shapes = tuple(x.shape for x in arrays)
    closed, results = _program(function, tuple(options.items()), tree, shapes, dtype)
    found = [nodes(graph, x).tolist() for x in read(graph, closed, *arrays, once=ONCE)]
    return jax.tree.unflatten(results, found)


def _is_array(x: Any) -> bool:
    return isinstance(x, list)


@lru_cache(maxsize=256)
def _program(
    function: Callable,
    options: tuple[tuple[str, Hashable], ...],
    tree: Any,
    shapes: tuple[tuple[int, ...], ...],
    dtype: np.dtype,
) -> tuple[ClosedJaxpr, Any]:
    """The jaxpr of a function, and the structure of its results."""
    args = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes])
    called = jax.make_jaxpr(lambda *x: function(*x, **dict(options)), return_shape=True)
    closed, shape = called(*args)
    return closed, jax.tree.structure(shape)
