"""From a declared system to its scalar program, or to the reason why it has none."""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag import _params
from jaxlag._errors import real_scalar
from jaxlag._inputs import InputValues
from jaxlag._lowering._array import ArrayTerms
from jaxlag._lowering._derive import Equations, Scene, derive
from jaxlag._lowering._evaluate import evaluate
from jaxlag._lowering._graph import Graph, Node
from jaxlag._lowering._ingest import Unsupported, read
from jaxlag._lowering._interpret import interpret

OPERATIONS = 1500  # beyond, compiling takes longer than the array program loses
STATES = 8  # random states at which both programs are compared
SLACK = 1e4  # of roundings, between two ways to compute one acceleration


class Key(NamedTuple):
    """What a scalar program is made for: one for each combination of shapes and static values."""

    lagrangian: Callable
    forces: tuple
    size: int
    dtype: Any
    params: _params.Static  # shapes and dtypes
    static: _params.Static  # values that are not traced
    inputs: _params.Static  # shapes and dtypes of the inputs' values
    limit: int | None


class Lowered(NamedTuple):
    """The scalar program of a system, or why there is none.

    Attributes:
        equations: M, h and the code for a; None where the array program is used.
        reason: in words, why there is no scalar program, or how it compared.
        scene: L and Q as nodes.
    """

    equations: Equations | None
    reason: str
    scene: Scene | None


def key_of(terms: ArrayTerms, q: Any, params: Any, inputs: Mapping[str, Any], limit: Any) -> Key:
    """The key of a system with these params and values of its inputs, concrete or traced."""
    traced, static = _params.split(params)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced)
    given = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), dict(inputs)
    )
    return Key(
        terms.lagrangian,
        terms.forces,
        q.shape[0],
        jnp.dtype(q.dtype),
        _params.Static(like),
        _params.Static(static),
        _params.Static(given),
        limit,
    )


@lru_cache(maxsize=256)
def lower(key: Key, sample: _params.Sample) -> Lowered:
    """The scalar program for a key; compared with the array program before it is used.

    Args:
        key: what it is made for.
        sample: params to compare with where they are known, else random ones are used.
    """
    try:
        scene = _scene(key)
        equations = derive(scene, float(jnp.finfo(key.dtype).eps), key.limit)
    except Unsupported as unsupported:
        return Lowered(None, str(unsupported), None)
    operations = equations.program.operations
    if key.limit is not None and operations > key.limit:
        return Lowered(None, f"{operations} operations, more than {key.limit}", scene)
    compared, difference = _compare(key, equations, sample.leaves)
    if not difference <= 1.0:
        found = f"differs from the array program by {SLACK * difference:.1e} roundings"
        return Lowered(None, found, scene)
    words = f"equal to the array program at {compared} of {STATES} random states"
    return Lowered(equations, words, scene)


def _scene(key: Key) -> Scene:
    graph, n = Graph(), key.size
    t = graph.input("t", 0)
    q, v = ([graph.input(name, i) for i in range(n)] for name in "qv")
    params, inputs = _inputs(graph, "params", key.params), _inputs(graph, "inputs", key.inputs)
    state = [_array([t], ()), _array(q, (n,)), _array(v, (n,))]
    lagrangian = real_scalar("lagrangian", key.lagrangian)
    (L,) = read(graph, _traced(key, lagrangian, False), *state, *params)
    force = None
    if key.forces:
        terms = ArrayTerms(key.lagrangian, key.forces)
        (Q,) = read(graph, _traced(key, terms.force, True), *state, *params, *inputs)
        force = [_node(graph, x) for x in Q]
    return Scene(graph, t, q, v, _node(graph, L.item()), force)


def _node(graph: Graph, x: Any) -> Node:
    return x if isinstance(x, Node) else graph.const(float(x))


def _inputs(graph: Graph, name: str, like: _params.Static) -> list[np.ndarray]:
    arrays, count = [], 0
    for leaf in jax.tree.leaves(like.tree):
        nodes = [graph.input(name, count + i) for i in range(int(np.prod(leaf.shape)))]
        count += len(nodes)
        arrays.append(_array(nodes, leaf.shape))
    return arrays


def _array(nodes: list[Node], shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(len(nodes), object)
    array[:] = nodes
    return array.reshape(shape)


def _state(key: Key) -> tuple[Any, Any, Any]:
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q = jax.ShapeDtypeStruct((key.size,), key.dtype)
    return t, q, q


def _traced(key: Key, function: Callable, with_inputs: bool) -> Any:
    """The jaxpr of a function of (t, q, v, params) or (t, q, v, params, inputs)."""

    def flat(t: Any, q: Any, v: Any, params: Any, inputs: Any) -> Any:
        params = _params.join(params, key.static.tree)
        if not with_inputs:
            return function(t, q, v, params)
        return function(t, q, v, params, InputValues(inputs))

    if with_inputs:
        return jax.make_jaxpr(flat)(*_state(key), key.params.tree, key.inputs.tree)
    return jax.make_jaxpr(partial(flat, inputs=None))(*_state(key), key.params.tree)


def _compare(key: Key, equations: Equations, known: list | None) -> tuple[int, float]:
    """(states compared, worst difference of a in units of SLACK roundings).

    At random states, with the known params or random ones; states where the array program is not
    finite are left out.
    """
    terms = ArrayTerms(key.lagrangian, key.forces)
    mass, bias = (_traced(key, f, False) for f in (terms.mass, terms.bias))
    force = _traced(key, terms.force, True) if key.forces else None
    rng = np.random.default_rng(0)
    n, eps = key.size, float(jnp.finfo(key.dtype).eps)
    like, given = jax.tree.leaves(key.params.tree), jax.tree.leaves(key.inputs.tree)
    compared, worst = 0, 0.0
    for _ in range(STATES):
        t, q, v = rng.uniform(0, 1), rng.uniform(-1.5, 1.5, n), rng.uniform(-1.5, 1.5, n)
        params = [np.asarray(x) for x in known or []] or [
            rng.uniform(0.5, 1.5, leaf.shape) for leaf in like
        ]
        inputs = [rng.uniform(-1, 1, leaf.shape) for leaf in given]
        (M,) = interpret(mass, t, q, v, *params)
        (right,) = interpret(bias, t, q, v, *params)
        right = -right
        if force is not None:
            (Q,) = interpret(force, t, q, v, *params, *inputs)
            right = Q + right
        values: dict[tuple[str, int], Any] = {("t", 0): t}
        for name, rows in (("q", [q]), ("v", [v]), ("params", params), ("inputs", inputs)):
            flat = np.concatenate([np.ravel(x) for x in rows]) if rows else []
            values |= {(name, i): x for i, x in enumerate(flat)}
        if not (np.all(np.isfinite(M)) and np.all(np.isfinite(right))):
            continue
        if np.min(np.linalg.eigvalsh(M), initial=1.0) <= 1e-9 * np.linalg.norm(M):
            continue
        a = np.linalg.solve(M, right)
        found = np.array([float(x) for x in evaluate(equations.accelerations, values)])
        size = np.linalg.norm(right) + np.linalg.norm(M) * np.linalg.norm(a) + 1.0
        allowed = SLACK * eps * size * np.linalg.norm(np.linalg.inv(M))
        compared += 1
        worst = max(worst, float(np.max(np.abs(found - a), initial=0.0) / allowed))
        if not np.isfinite(worst):
            return compared, np.inf
    return compared, worst
