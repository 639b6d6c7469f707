"""Numpy arrays of nodes."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxlag._lowering._graph._expression import Graph


class Missing(Exception):
    """An operation without scalar form."""


def broadcast(graph: Graph, make: Callable, *operands: np.ndarray) -> np.ndarray:
    """One node for each element; operands of one shape, or of size 1 along an axis."""
    arrays = np.broadcast_arrays(*(nodes(graph, array) for array in operands))
    out = np.empty(arrays[0].shape, object)
    for index in np.ndindex(out.shape):
        out[index] = make(*(array[index] for array in arrays))
    return out


def nodes(graph: Graph, array: np.ndarray) -> np.ndarray:
    if array.dtype == object:
        return array
    out = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        value = array[index].item()
        out[index] = graph.const(value if isinstance(value, bool) else float(value))
    return out


def each(make: Callable, array: np.ndarray) -> np.ndarray:
    """One node for each node; known values stay."""
    if array.dtype != object:
        return array
    out = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        out[index] = make(array[index])
    return out


def scalar(node: Any) -> np.ndarray:
    out = np.empty((), object)
    out[()] = node
    return out


def take(row: list, index: np.ndarray) -> np.ndarray:
    out = np.empty(index.shape, object)
    for place in np.ndindex(index.shape):
        out[place] = row[int(index[place])]
    return out
