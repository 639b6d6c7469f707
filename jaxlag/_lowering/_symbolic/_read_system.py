"""Conversion of a declared system to scalar expressions."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlag._core._jaxprs import equations
from jaxlag._lowering._array_terms import ArrayTerms
from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported, read
from jaxlag._lowering._row_layout import layout_of
from jaxlag._lowering._symbolic._constraint_solve import Constrained
from jaxlag._lowering._symbolic._program_key import Key, traced
from jaxlag._lowering._symbolic._shared_reactions import Sharing
from jaxlag._lowering._symbolic._symbolic_system import Kinematics, SymbolicSystem
from jaxlag._model._constraints import AbstractConstraint
from jaxlag._model._forces import reads_lam
from jaxlag._tracing import _params
from jaxlag._tracing._index_check import check_indices
from jaxlag._tracing._signature import real_scalar


def read_scene(key: Key) -> SymbolicSystem:
    """L, Q, the constraints and the kinematics as nodes of one graph.

    Raises:
        Unsupported: a part without scalar form.
    """
    _check_kinds("params", key.params)
    _check_kinds("inputs", key.inputs)
    graph, n = Graph(), key.size
    t = graph.input("t", 0)
    # The velocities of a state (q, u) are not inputs of its equations.
    names = "q", "v" if key.quasi is None else "speed"
    q, v = ([graph.input(name, i) for i in range(n)] for name in names)
    params, inputs = _inputs(graph, "params", key.params), _inputs(graph, "inputs", key.inputs)
    state = [_array([t], ()), _array(q, (n,)), _array(v, (n,))]
    kinematics, at = None, state
    if key.quasi is not None:
        with _named("quasi"):
            kinematics = _kinematics(key, graph, state, params)
        at = state if key.in_u is None else [*state[:2], _array(list(kinematics.u), (-1,))]
    lagrangian = real_scalar("lagrangian", key.in_u or key.lagrangian)
    of_L = traced(key, lagrangian, False, speeds=at[2].size)
    check_indices(of_L, [None, "q", "v" if key.in_u is None else "u", *(None for _ in params)])
    with _named("lagrangian"):
        (L,) = read(graph, of_L, *at, *params)
    force = _force(key, graph, [*state, *params, *inputs])
    bound = _constrained(key, graph, state, params, inputs) if _included(key) else None
    count = sum(1 for _ in equations(of_L.jaxpr))
    return SymbolicSystem(graph, t, q, v, _node(graph, L.item()), force, bound, kinematics, count)


def with_forces(scene: SymbolicSystem, key: Key) -> SymbolicSystem:
    """The system of a key, from its terms without forces, on a graph of its own.

    Raises:
        Unsupported: a force without scalar form.
    """
    _check_kinds("inputs", key.inputs)
    graph, bound = scene.graph.copy(), scene.constrained
    state = [_array([scene.t], ()), *(_array(list(x), (-1,)) for x in (scene.q, scene.v))]
    given = [*state, *_inputs(graph, "params", key.params), *_inputs(graph, "inputs", key.inputs)]
    force = _force(key, graph, given)
    if bound is not None:
        bound = bound._replace(
            formulation=key.formulation, regular=key.regular, crossing=key.crossing
        )
        if any(map(reads_lam, key.forces)):
            bound = _with_reactions(key, graph, bound, given)
    return scene._replace(graph=graph, force=force, constrained=bound)


def _force(key: Key, graph: Graph, given: list) -> list[Node] | None:
    """Q, if there are forces."""
    if not key.forces:
        return None

    def of(forces: tuple) -> Any:
        return traced(key, ArrayTerms(key.lagrangian, forces).force, True)

    return _sum_of(key.forces, graph, of, given)


def _sum_of(forces: tuple, graph: Graph, of: Callable[[tuple], Any], given: list) -> list[Node]:
    """The generalized force of all forces.

    Args:
        forces: as declared.
        graph: of all nodes.
        of: the program of some forces.
        given: its arguments.

    Raises:
        Unsupported: a force without scalar form, by its name.
    """
    try:
        (Q,) = read(graph, of(forces), *given)
    except Unsupported:
        for force in forces:
            with _named(f"force {force.name!r}"):
                read(graph.copy(), of((force,)), *given)
        raise
    return [_node(graph, x) for x in Q]


@contextmanager
def _named(part: str) -> Iterator[None]:
    """Reasons why a part has no scalar form begin with its name."""
    try:
        yield
    except Unsupported as unsupported:
        raise Unsupported(f"{part}: {unsupported}") from None


def _with_reactions(key: Key, graph: Graph, bound: Constrained, given: list) -> Constrained:
    """The constraints, with the forces that read multipliers."""
    terms, m = ArrayTerms(key.lagrangian, key.forces, _included(key)), len(bound.velocity)
    chosen, sharing = np.flatnonzero(rows_that_forces_read(key, terms)).tolist(), None
    if bound.active_rows is not None and len(chosen) > 1 and not key.contact_rows_independent:
        sharing = Sharing(chosen, [graph.input("nonzero", x.data[1]) for x in bound.active_rows])

    def of(forces: tuple) -> Any:
        terms = ArrayTerms(key.lagrangian, forces, _included(key))
        return traced(key, terms.reactive, True, m)

    reactive = tuple(filter(reads_lam, key.forces))
    reaction = _sum_of(reactive, graph, of, [*given, _array(list(bound.lam), (m,))])
    return bound._replace(reaction=reaction, sharing=sharing)


def _included(key: Key) -> tuple[AbstractConstraint, ...]:
    """The constraints in the equations; quasi-velocities satisfy Pfaffian ones by definition."""
    if key.quasi is None:
        return key.constraints
    return tuple(c for c in key.constraints if c.holonomic)


def _kinematics(key: Key, graph: Graph, state: list, params: list) -> Kinematics:
    quasi = key.quasi
    assert quasi is not None
    free = [graph.input("v", k) for k in range(len(quasi.free))]
    bound = [graph.input("bound", k) for k in range(len(quasi.bound))]
    u: list[Node] = [graph.zero] * quasi.size
    for nodes, places in ((free, quasi.free), (bound, quasi.bound)):
        for node, place in zip(nodes, places, strict=True):
            u[int(place)] = node
    U = V = None
    if quasi.U is not None:
        (found,) = read(graph, traced(key, quasi.of, False), *state, *params)
        U = [_node(graph, x) for x in found]
    if quasi.kinematics is not None:
        code = traced(key, quasi.velocities, False, speeds=quasi.size)
        (found,) = read(graph, code, *state[:2], _array(u, (quasi.size,)), *params)
        V = [_node(graph, x) for x in found]
    return Kinematics(u, free, bound, U, V, key.in_u is not None)


def _constrained(key: Key, graph: Graph, state: list, params: list, inputs: list) -> Constrained:
    included, given = _included(key), [*state, *params]
    graph.cancelled = False
    try:
        rates, phi = _rows(key, graph, included, given)
    except Unsupported:
        for constraint in included:
            with _named(f"constraint {', '.join(constraint.all_names)!r}"):
                _rows(key, graph.copy(), (constraint,), given)
        raise
    cancelled, m = graph.cancelled, rates.size
    layout = layout_of(key.constraints, key.params, key.static, key.size, key.dtype)
    every = layout.holonomic
    chosen = [k for k, holonomic in enumerate(every) if holonomic or key.quasi is None]
    active_rows = [graph.input("active_rows", k) for k in chosen] if layout.chooses else None
    holonomic = [every[k] for k in chosen]
    lam = [graph.input("lam", k) for k in range(m)]
    damping = None
    if key.baumgarte is not None:
        damping = 2.0 * key.baumgarte.alpha, key.baumgarte.beta**2
    bound = Constrained(
        [_node(graph, x) for x in rates],
        [_node(graph, x) for x in phi],
        holonomic,
        active_rows,
        key.formulation,
        damping,
        key.regular,
        lam=lam,
        crossing=key.crossing,
        cancelled=cancelled,
        labels=[layout.labels[k] for k in chosen],
    )
    if any(map(reads_lam, key.forces)):
        return _with_reactions(key, graph, bound, [*given, *inputs])
    return bound


def _rows(
    key: Key, graph: Graph, constraints: tuple[AbstractConstraint, ...], given: list
) -> tuple[np.ndarray, np.ndarray]:
    """A v + b, and phi of the holonomic rows."""
    terms = ArrayTerms(key.lagrangian, (), constraints)

    def position(t: Any, q: Any, v: Any, params: Any) -> Any:
        return terms.position(t, q, params)

    (rates,) = read(graph, traced(key, terms.velocity, False), *given)
    (phi,) = read(graph, traced(key, position, False), *given)
    return rates, phi


def rows_that_forces_read(key: Key, terms: ArrayTerms) -> tuple[bool, ...]:
    """For every row, whether forces read its multiplier."""
    found: list[tuple[bool, ...]] = []

    def look(t: Any, q: Any, v: Any, params: Any, inputs: Any) -> Any:
        found.append(terms.rows_read(t, q, v, params, inputs))
        return t

    traced(key, look, True)
    return found[0]


def _node(graph: Graph, x: Any) -> Node:
    return x if isinstance(x, Node) else graph.const(float(x))


def _check_kinds(name: str, like: _params.Static) -> None:
    kinds = {leaf.dtype for leaf in jax.tree.leaves(like.tree)}
    if any(jnp.issubdtype(kind, jnp.integer) for kind in kinds):
        raise Unsupported(f"integers among the {name}, whose division differs from that of floats")


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
